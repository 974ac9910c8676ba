# SPDX-License-Identifier: Apache-2.0
"""Refinement under the pinhole camera: it finds the optimum and never makes a pose worse."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from paul_ros import pinhole_pose as module
from paul_ros.pinhole_pose import refine

DOCS = Path(__file__).resolve().parent.parent / "docs"


def problems(count: int = 40, noise: float = 0.0, seed: int = 0):
    """Return shapes as large as a person in model units, seen from 5 units away, and poses near the true ones."""
    rng = np.random.default_rng(seed)
    S = rng.standard_normal((count, 3, 12))
    R = Rotation.random(count, random_state=seed).as_matrix()
    T = np.array([0.3, -0.2, 5.0]) + rng.normal(0, 0.3, (count, 3))
    visible = rng.random((count, 12)) < 0.8
    visible[:, :6] = True
    W = image(S, R, T) + noise * rng.standard_normal((count, 2, 12))
    W[~np.repeat(visible[:, None], 2, axis=1)] = np.nan
    near = Rotation.from_rotvec(rng.normal(0, 0.08, (count, 3))).as_matrix() @ R
    return S, W, visible, near, T * (1 + rng.normal(0, 0.03, (count, 1))), R, T


def image(S, R, T):
    X = R @ S + T[:, :, None]
    return X[:, :2] / X[:, 2:]


def cost(missed):
    return (missed**2).sum((1, 2))


def test_exact_images_give_the_exact_pose(monkeypatch):
    monkeypatch.setattr(module, "_STEPS", 8)
    S, W, visible, near, far, R, T = problems()
    pose = refine(S, W, visible, near, far)
    np.testing.assert_allclose(pose.R, R, atol=1e-8)
    np.testing.assert_allclose(pose.T, T, atol=1e-7)
    np.testing.assert_allclose(np.linalg.det(pose.R), 1)


def test_two_steps_come_close(monkeypatch):
    S, W, visible, near, far, _, _ = problems(noise=0.01)
    two = cost(refine(S, W, visible, near, far).missed)
    monkeypatch.setattr(module, "_STEPS", 30)
    best = cost(refine(S, W, visible, near, far).missed)
    assert (two <= 1.02 * best).mean() > 0.95 and (two >= best * (1 - 1e-12)).all()


def test_the_optimum_is_that_of_a_naive_solver(monkeypatch):
    monkeypatch.setattr(module, "_STEPS", 30)
    S, W, visible, near, far, _, _ = problems(count=8, noise=0.02)
    found = cost(refine(S, W, visible, near, far).missed)
    for row in range(len(S)):

        def missed(x, row=row):
            turn = Rotation.from_rotvec(x[:3]).as_matrix() @ near[row]
            return (W[row] - image(S[row][None], turn[None], x[None, 3:])[0])[:, visible[row]].ravel()

        naive = least_squares(missed, np.concatenate([np.zeros(3), far[row]]))
        assert found[row] == pytest.approx(2 * naive.cost, rel=1e-6)


def test_steps_from_far_starts_are_damped_until_they_help(monkeypatch):
    """A tenth of the damping after a step that lowered the error, ten times as much after one that did not."""
    monkeypatch.setattr(module, "_STEPS", 8)
    S, W, visible, _, far, _, _ = problems(noise=0.1, seed=1)
    wild = Rotation.random(len(S), random_state=10).as_matrix()
    dampings, step = [], module._step
    monkeypatch.setattr(module, "_step", lambda pose, damping: step(pose, dampings.append(damping.copy()) or damping))
    before = np.where(visible[:, None], W - image(S, wild, far), 0.0)
    assert (cost(refine(S, W, visible, wild, far).missed) < cost(before)).all()
    factors = np.array(dampings[1:]) / np.array(dampings[:-1])
    np.testing.assert_allclose(dampings[0], 1e-4)
    assert np.isclose(factors, 10).any() and np.isclose(factors, 0.1).any()
    assert (np.isclose(factors, 10) | np.isclose(factors, 0.1)).all()


def test_the_search_goes_on_after_a_step_that_does_not_help(monkeypatch):
    """Such a step is not taken, and the next ones are damped more, until one helps."""
    S, W, visible, _, far, _, _ = problems(noise=0.1, seed=1)
    wild = Rotation.random(len(S), random_state=10).as_matrix()
    costs = []
    for steps in range(12):
        monkeypatch.setattr(module, "_STEPS", steps)
        costs.append(cost(refine(S, W, visible, wild, far).missed))
    costs = np.array(costs)
    failed = costs[1:] == costs[:-1]
    recovered = failed[:-1] & (costs[2:] < costs[1:-1])
    assert recovered.any(0).sum() > 5


@pytest.mark.parametrize("seed", range(3))
def test_no_start_is_made_worse(seed):
    """Starts that are far off, too."""
    S, W, visible, _, far, _, _ = problems(noise=0.1, seed=seed)
    wild = Rotation.random(len(S), random_state=seed + 9).as_matrix()
    before = np.where(visible[:, None], W - image(S, wild, far), 0.0)
    pose = refine(S, W, visible, wild, far)
    assert (cost(pose.missed) <= cost(before) * (1 + 1e-12)).all()
    np.testing.assert_allclose(np.linalg.det(pose.R), 1)


def test_persons_do_not_influence_each_other():
    S, W, visible, near, far, _, _ = problems(noise=0.05)
    together = refine(S, W, visible, near, far)
    alone = refine(S[3:4], W[3:4], visible[3:4], near[3:4], far[3:4])
    np.testing.assert_allclose(together.R[3:4], alone.R, atol=1e-12)


def test_hidden_points_count_for_nothing():
    S, W, visible, near, far, _, _ = problems()
    other = np.where(visible[:, None], W, 77.0)
    np.testing.assert_array_equal(refine(S, W, visible, near, far).T, refine(S, other, visible, near, far).T)
    assert not refine(S, other, visible, near, far).missed[~np.repeat(visible[:, None], 2, axis=1)].any()


@pytest.mark.parametrize("value", [0.0, 1e300])
def test_images_that_no_camera_gives_leave_the_start(value):
    S, W, visible, near, far, _, _ = problems(count=2)
    pose = refine(np.zeros_like(S) if value == 0 else S, np.full_like(W, value), visible, near, far)
    assert np.isfinite(pose.R).all() and np.isfinite(pose.T).all()


def test_the_picture_can_be_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    spec = importlib.util.spec_from_file_location("perspective_picture", DOCS / "perspective_picture.py")
    picture = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(picture)
    picture.DISTANCES, picture._EVERY = (1.5, 4.0), 60
    values = picture.table()
    weak, _, refined = values[0, :, 0].transpose(1, 0, 2)
    assert (refined < 0.25 * weak).all()
    picture.draw(values, tmp_path / "p.png")
    assert 10_000 < (tmp_path / "p.png").stat().st_size < 300_000
