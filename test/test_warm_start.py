# SPDX-License-Identifier: Apache-2.0
"""The linear and the rigid start on small made-up sequences whose truth is known, and on data that fixes no shape."""

from functools import partialmethod

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from training.errors import StartError
from training.start import linear_model, synchronise, warm_start
from training.start.linear_model import LinearModel
from training.start.observations import Observations
from training.start.warm_start import linear_start, rigid_start

EASY = {
    "_STARTS": 8,
    "_START_FRAMES": 30,
    "_CANDIDATES": 1,
    "_BASES": (2, 3, 4),
    "_WARM": ((1.0, 3.0, 6), (0.3, 1.0, 8)),
    "_COOLER": ((0.1, 0.1, 4),),
    "_COOLED": 20,
    "_CANDIDATE": ((0.1, 0.03, 2, 10), (0.03, 0.0, 2, 30)),
    "_DETAIL": ((0.03, 10), (0.0075, 30)),
    "_SETTLING": 3,
    "_RIGID_ITERATIONS": 30,
}
HASTY = {
    "_STARTS": 4,
    "_WARM": ((1.0, 3.0, 2), (0.3, 1.0, 2)),
    "_COOLER": ((0.1, 0.1, 2),),
    "_COOLED": 4,
    "_RIGID": ((1.0, 0.0, 2), (0.3, 0.0, 2)),
    "_RIGID_ITERATIONS": 4,
    "_CANDIDATE": ((0.1, 0.03, 1, 4), (0.03, 0.0, 1, 4)),
    "_DETAIL": ((0.03, 4), (0.002, 8)),
}
"""For tests that only need some start: every step is taken, down to the least noise."""


@pytest.fixture(autouse=True)
def few_starts(monkeypatch):
    """A tenth of a second instead of a minute, which suffices for these easy sequences."""
    torch.set_num_threads(1)
    patch(monkeypatch, warm_start, EASY)
    patch(monkeypatch, linear_model, {"_REFINEMENTS": 2})
    patch(monkeypatch, LinearModel, {"searched": partialmethod(LinearModel.searched, count=40)})
    few = ((0.1, 4), (0.05, 4))
    patch(monkeypatch, synchronise, {"_ROUNDS": 2, "_STAGES": ((2, 3), (3, 4)), "_REFIT": few, "_REBUILT": few})


@pytest.fixture
def hasty(few_starts, monkeypatch):
    patch(monkeypatch, warm_start, HASTY)
    patch(monkeypatch, LinearModel, {"searched": partialmethod(LinearModel.searched, count=5)})


def patch(monkeypatch, module, values):
    for name, value in values.items():
        monkeypatch.setattr(module, name, value)


def body(frames=40, points=12, ways=2, seed=0, spin=None):
    """Camera-frame shapes (F,3,P) of a body with few ways to bend, W (F,2,P) of root mean square coordinate 1."""
    rng = np.random.default_rng(seed)
    V = rng.standard_normal((ways + 1, 3, points)) * np.array([1.0, *[0.3] * ways])[:, None, None]
    S = np.tensordot(np.c_[np.ones(frames), rng.standard_normal((frames, ways))], V, 1)
    S = (Rotation.random(frames, random_state=seed).as_matrix() if spin is None else spin) @ S
    return scaled(S)


def scaled(S):
    S = S - S.mean(2, keepdims=True)
    S = S / np.sqrt((S[:, :2] ** 2).mean())
    return S, S[:, :2]


def shown(W, share=1.0, seed=0):
    visible = np.random.default_rng(seed).random((len(W), W.shape[2])) < share
    visible[:, :4] = True
    return visible


def error(start, S, visible):
    """Mean normalised error (%) of the shapes over all points, one mirror for the whole set."""
    seen = visible[start.rows][:, None]
    truth = S[start.rows] - (S[start.rows] * seen).sum(2, keepdims=True) / seen.sum(2, keepdims=True)
    found = start.rotations @ start.shapes
    size = np.linalg.norm(truth, axis=(1, 2))
    return min(
        100 * (np.linalg.norm(found * [[1], [1], [flip]] - truth, axis=(1, 2)) / size).mean() for flip in (1.0, -1.0)
    )


def check(start, rows, points):
    """Check the properties of every start."""
    assert len(start.rows) == len(start.shapes) == len(start.rotations) == rows
    assert (np.diff(start.rows) > 0).all()
    assert start.shapes.shape == (rows, 3, points) and np.isfinite(start.shapes).all() and np.isfinite(start.score)
    np.testing.assert_allclose(
        start.rotations @ start.rotations.swapaxes(1, 2), np.tile(np.eye(3), (rows, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(start.rotations), 1)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_shapes_are_found_up_to_one_mirror_from_2d_alone(share):
    S, W = body()
    visible = shown(W, share)
    start = linear_start(np.where(visible[:, None], W, np.nan), visible, 1)
    check(start, 40, 12)
    assert error(start, S, visible) < (1.0 if share == 1 else 3.0)
    seen = np.where(visible[:, None], start.shapes, 0)
    np.testing.assert_allclose(seen.sum(2), 0, atol=1e-9)
    # Seen points are where they were seen.
    image = Observations.of(W, visible).W.numpy()
    found = (start.rotations @ start.shapes)[:, :2]
    np.testing.assert_allclose(
        found[np.repeat(visible[:, None], 2, 1)], image[np.repeat(visible[:, None], 2, 1)], atol=1e-9
    )


def test_one_seed_gives_one_start_and_the_progress_grows_to_one(hasty):
    _, W = body(12, 6)
    shares = []
    first, second = (linear_start(W, shown(W), 3, shares.append) for _ in range(2))
    assert all(np.array_equal(one, other) for one, other in zip(vars(first).values(), vars(second).values()))
    half = shares[: len(shares) // 2]
    assert half == sorted(half) and half[-1] == 1.0 and half[0] > 0


def test_the_order_of_the_frames_does_not_matter():
    S, W = body()
    order = np.random.default_rng(5).permutation(len(W))
    visible = shown(W)
    assert error(linear_start(W[order], visible, 0), S[order], visible) < 1.0


def test_the_rigid_start_finds_a_rigid_shape():
    S, W = body(ways=0)
    visible = shown(W, 0.7)
    start = rigid_start(W, visible, 0)
    check(start, 40, 12)
    assert error(start, S, visible) < 0.1
    assert np.ptp(start.shapes - start.shapes[:, :, :1], axis=0).max() < 1e-9
    np.testing.assert_allclose(np.where(visible[:, None], start.shapes, 0).sum(2), 0, atol=1e-9)


def test_points_beyond_the_limit_follow_from_the_others(monkeypatch):
    S, W = body(points=16)
    visible = shown(W, 0.8)
    monkeypatch.setattr(warm_start, "_MAX_POINTS", 10)
    start = linear_start(W, visible, 0)
    check(start, 40, 16)
    assert error(start, S, visible) < 5
    np.testing.assert_allclose(np.where(visible[:, None], start.shapes, 0).sum(2), 0, atol=1e-9)


def test_points_beyond_the_limit_are_the_same_however_they_are_blocked(monkeypatch):
    S, W = body(points=9)
    R = Rotation.random(40, random_state=0).as_matrix()
    visible, points = shown(W, 0.8), np.arange(5)
    shapes = (R.swapaxes(1, 2) @ S)[:, :, points]
    whole = warm_start._extended(shapes, R, W, visible, points)
    monkeypatch.setattr(warm_start, "_BLOCK", 2)
    np.testing.assert_allclose(warm_start._extended(shapes, R, W, visible, points), whole)


def test_frames_beyond_the_limit_have_no_shapes(monkeypatch):
    S, W = body()
    monkeypatch.setattr(warm_start, "_MAX_FRAMES", 32)
    start = linear_start(W, shown(W), 1)
    check(start, 32, 12)
    assert error(start, S, shown(W)) < 1.0


@pytest.mark.parametrize("frames, points", [(5, 8), (2, 6), (30, 5), (30, 4), (30, 3)])
def test_few_frames_and_few_points_have_some_start(frames, points, hasty):
    _, W = body(frames, points)
    for find in (linear_start, rigid_start):
        check(find(W, shown(W), 0), frames, points)


def degenerate(kind):
    """Image points that determine no shape; some are on one line, or always the same."""
    rng = np.random.default_rng(0)
    V = rng.standard_normal((3, 3, 8)) * [[[1.0]], [[0.3]], [[0.3]]]
    code, R = np.c_[np.ones(20), rng.standard_normal((20, 2))], Rotation.random(20, random_state=0).as_matrix()
    if kind == "planar":
        V[:, 2] = 0
    elif kind == "collinear":
        V[:, 1:] = 0
    elif kind == "rigid":
        V[1:] = 0
    elif kind == "twins":
        V[:, :, 1] = V[:, :, 0]
    elif kind == "still camera":
        R[:] = R[0]
    elif kind == "still":
        R[:], code[:] = R[0], code[0]
    W = scaled(R @ np.tensordot(code, V, 1))[1]
    if kind == "noise":
        W = rng.standard_normal(W.shape)
    elif kind == "point":
        W[0] = 0
    elif kind == "outlier":
        W[0] *= 1e3
    return W / np.sqrt((W**2).mean())


@pytest.mark.parametrize(
    "kind", ["planar", "collinear", "rigid", "twins", "still camera", "still", "noise", "point", "outlier"]
)
def test_degenerate_views_do_not_crash(kind, hasty):
    W = degenerate(kind)
    visible = shown(W, 0.7)
    visible[:, -1] = False
    check(linear_start(W, shown(W), 0), 20, 8)
    check(linear_start(W, visible, 0), 20, 8)
    check(rigid_start(W, visible, 0), 20, 8)


def test_frames_with_too_few_points_are_left_out(hasty):
    S, W = body()
    visible = shown(W)
    visible[3], visible[7, 2:] = False, False
    start = linear_start(W, visible, 0)
    check(start, 38, 12)
    assert not {3, 7} & set(start.rows)


def test_too_few_frames_are_refused():
    _, W = body(5, 6)
    visible = shown(W)
    visible[1:] = False
    with pytest.raises(StartError, match="only 1 of 5 frames show 3 points and more.*start: random"):
        linear_start(W, visible, 0)


@pytest.mark.parametrize("find", [linear_start, rigid_start])
def test_infinite_numbers_are_refused(find):
    _, W = body(20, 6)
    with pytest.raises(StartError, match="broke down.*start: random"):
        find(np.where(np.arange(6) == 2, np.inf, W), shown(W), 0)
