# SPDX-License-Identifier: Apache-2.0
"""One mirror image for all frames: likeness against brute force, shares of agreement, and mixed signs repaired."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from paul_ros.metrics import procrustes
from training.start import synchronise
from training.start.linear_model import LinearModel
from training.start.observations import Observations
from training.start.synchronise import (
    agreeing_share,
    aligned,
    energy_outside,
    fitted,
    flipped,
    likeness,
    mirrored,
    synchronised,
)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    torch.set_num_threads(1)
    for name, value in {
        "_ROUNDS": 2,
        "_STAGES": ((3, 6), (4, 8)),
        "_REFIT": ((0.1, 20), (0.05, 20)),
        "_REBUILT": ((0.05, 8), (0.03, 8)),
    }.items():
        monkeypatch.setattr(synchronise, name, value)


def shapes(count, points=9, seed=0):
    S = torch.from_numpy(np.random.default_rng(seed).standard_normal((count, 3, points)))
    return S - S.mean(2, keepdim=True)


def poses(modes=1, frames=60, points=10, seed=0, apart=1.0, spread=0.4):
    """Camera-frame shapes (F,3,P) of one mirror image, random cameras, and the mode (F,) of each.

    A body bends a little about each of some quite different poses.
    """
    rng = np.random.default_rng(seed)
    mean = rng.standard_normal((3, points))
    way = rng.standard_normal((2, 3, points))
    mode = np.arange(frames) % modes
    S = mean + np.tensordot(spread * rng.standard_normal((frames, 2)), way, 1)
    S = S + apart * rng.standard_normal((modes, 3, points))[mode] * (modes > 1)
    S = Rotation.random(frames, random_state=seed).as_matrix() @ S
    S = S - S.mean(2, keepdims=True)
    return torch.from_numpy(S / np.sqrt((S[:, :2] ** 2).mean())), torch.from_numpy(mode)


def seen(X, visible=None):
    return Observations.of(X[:, :2].numpy(), np.ones((len(X), X.shape[2]), bool) if visible is None else visible)


def flip(X, wrong):
    return torch.where(wrong[:, None, None], mirrored(X), X)


def right_share(X, truth):
    """Share of frames whose depth is on the truth's side, up to one mirror image of them all."""
    right = float(((X[:, 2] * truth[:, 2]).sum(1) > 0).double().mean())
    return max(right, 1 - right)


def generator():
    return np.random.default_rng(0)


# --- likeness


def test_likeness_is_the_best_correlation_of_either_mirror_image():
    X, Y = shapes(5), 3 * shapes(4, seed=1)
    close, sign = likeness(X, Y)
    for i, x in enumerate(X.numpy()):
        for j, y in enumerate(Y.numpy()):
            found = []
            for other in (y, y * [[1], [1], [-1]]):
                R, scale = procrustes(other.T[None], x.T[None])
                found.append(float((x * (R[0] @ other)).sum() / np.linalg.norm(x) / np.linalg.norm(y)))
                assert abs(found[-1] - scale[0] * np.linalg.norm(y) / np.linalg.norm(x)) < 1e-12
            assert abs(float(close[i, j]) - max(found)) < 1e-9
            assert abs(2 * float(sign[i, j]) - (found[0] - found[1])) < 1e-9


def test_likeness_by_search_over_rotations():
    x, y = (S / np.linalg.norm(S) for S in (shapes(1)[0].numpy(), shapes(1, seed=1)[0].numpy()))

    def best(y):
        starts = Rotation.random(20, random_state=0).as_rotvec()
        found = (minimize(lambda r: -(x * (Rotation.from_rotvec(r).as_matrix() @ y)).sum(), start) for start in starts)
        return -min(one.fun for one in found)

    close, sign = likeness(torch.from_numpy(x)[None], torch.from_numpy(y)[None])
    same, other = best(y), best(y * [[1], [1], [-1]])
    assert abs(float(close) - max(same, other)) < 1e-6 and abs(2 * float(sign) - (same - other)) < 1e-6


def test_likeness_of_a_shape_turned_scaled_and_mirrored_is_one():
    X = shapes(6)
    R = torch.from_numpy(Rotation.random(6, random_state=1).as_matrix())
    for turned, side in ((4 * R @ X, 1), (mirrored(R @ X), -1)):
        close, sign = likeness(X, turned)
        torch.testing.assert_close(close.diagonal(), torch.ones(6, dtype=torch.float64))
        assert (side * sign.diagonal() > 0.01).all()
        assert (close - torch.eye(6) < 1).all()


def test_likeness_is_a_number_where_shapes_are_points_lines_or_balls():
    X = shapes(4)
    X[0] = 0
    X[1, 1:] = 0
    X[2, :, 3:] = 0
    X[2, :, :3] = torch.eye(3)
    X[3, :, 3:] = 0
    X[3, :, :3] = torch.eye(3)
    close, sign = likeness(X, X)
    assert close.isfinite().all() and sign.isfinite().all()
    assert close[0].abs().max() < 1e-9 and abs(float(close[1, 1]) - 1) < 1e-4 and abs(float(sign[1, 1])) < 1e-4
    assert abs(float(close[2, 3]) - 1) < 1e-7 and abs(float(sign[2, 3]) - 1 / 3) < 1e-7


@pytest.mark.parametrize("values", [(3, 2, 1), (2, 2, 1), (2, 1, 1), (1, 1, 1), (5, 0, 0), (0, 0, 0), (2, -1, -4)])
def test_eigenvalues_in_closed_form(values):
    Q = torch.from_numpy(Rotation.random(20, random_state=0).as_matrix())
    A = Q @ torch.diag(torch.tensor(values, dtype=torch.float64)) @ Q.transpose(1, 2)
    found = synchronise._eigenvalues(A)
    torch.testing.assert_close(found, torch.tensor(values, dtype=torch.float64).expand(20, 3), atol=1e-7, rtol=0)


# --- aligned


def test_aligned_shapes_of_one_body_fall_together():
    S = shapes(1)
    R = torch.from_numpy(Rotation.random(12, random_state=0).as_matrix())
    together, found = aligned(R @ S)
    torch.testing.assert_close(together, together[:1].expand(12, -1, -1))
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(12, dtype=torch.float64))
    torch.testing.assert_close(found @ R @ S, together)


def test_no_single_turn_brings_an_aligned_shape_nearer_to_the_mean():
    X, _ = poses(frames=20)
    together, _ = aligned(X)
    mean = together.mean(0)
    for turn in Rotation.from_rotvec(0.05 * np.random.default_rng(0).standard_normal((10, 3))).as_matrix():
        worse = (torch.from_numpy(turn) @ together - mean).square().sum((1, 2))
        assert (worse > (together - mean).square().sum((1, 2)) - 1e-3).all()
    assert (together - mean).square().sum() < 0.3 * (X - X.mean(0)).square().sum()


# --- the share that agrees


def test_one_mirror_image_agrees_and_random_ones_half():
    X, _ = poses(frames=300)
    assert agreeing_share(X) > 0.99 and agreeing_share(mirrored(X)) > 0.99
    wrong = torch.from_numpy(np.random.default_rng(1).random(300) < 0.5)
    assert 0.4 < agreeing_share(flip(X, wrong)) < 0.6
    few = torch.arange(300) % 20 == 0
    assert 0.85 < agreeing_share(flip(X, few)) < 0.96


@pytest.mark.parametrize("kind", ["planar", "collinear", "point"])
def test_shapes_equal_to_their_mirror_image_agree(kind):
    X, _ = poses()
    R = torch.from_numpy(Rotation.random(len(X), random_state=3).as_matrix())
    X[:, {"planar": 2, "collinear": 1, "point": 0}[kind] :] = 0
    assert agreeing_share(R @ X) == 1.0


def test_two_frames_agree_or_not():
    X, _ = poses(frames=2, spread=0.05)
    assert agreeing_share(X) == 1.0 and agreeing_share(flip(X, torch.tensor([False, True]))) == 0.0


# --- repairing


def test_a_fitted_model_sees_its_shapes():
    X, _ = poses(frames=30)
    model = fitted(X, seen(X), 4, ())
    assert model.V.shape == (5, 3, 10)
    torch.testing.assert_close(torch.linalg.det(model.R), torch.ones(30, dtype=torch.float64))
    assert (model.in_camera(seen(X), 1e-3) - X).norm() < 0.1 * X.norm()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_mirrored_cluster_is_flipped_back(seed):
    """Neighbours agree within each of two kinds of poses: only all shapes together show the mixture."""
    X, mode = poses(modes=2, seed=seed)
    mixed = flip(X, mode == 1)
    assert agreeing_share(mixed) > 0.9 and right_share(mixed, X) == 0.5
    found = flipped(mixed, 4, 2, generator())
    assert right_share(found, X) == 1.0
    torch.testing.assert_close(found[:, :2], X[:, :2])
    torch.testing.assert_close(found[:, 2].abs(), X[:, 2].abs())


def test_energy_outside_is_what_principal_directions_leave():
    """Many frames use the points' products, few the frames'; as many directions as frames leave none."""
    for frames in (80, 12):
        X, _ = poses(frames=frames)
        together, _ = aligned(X)
        D = (together - together.mean(0)).flatten(1).numpy()
        size = np.linalg.svd(D, compute_uv=False)
        for directions in (0, 2, 5):
            assert energy_outside(X, directions) == pytest.approx((size[directions:] ** 2).sum() / frames, rel=1e-9)
    assert energy_outside(X, 12) == pytest.approx(0, abs=1e-9)


def test_a_correct_model_stays():
    X, _ = poses(modes=2)
    assert right_share(flipped(X, 3, 4, generator()), X) == 1.0


def test_random_signs_are_made_one():
    X, _ = poses(frames=80)
    wrong = torch.from_numpy(np.random.default_rng(1).random(80) < 0.4)
    model = fitted(flip(X, wrong), seen(X), 6, ())
    before = model.in_camera(seen(X), 0.03)
    shares = []
    found = synchronised(model, seen(X), generator(), shares.append)
    assert right_share(before, X) < 0.8 and right_share(found.in_camera(seen(X), 0.03), X) > 0.97
    assert len(found.V) == len(model.V) and shares == sorted(shares) and 0 < shares[-1] <= 1


def test_a_round_that_makes_the_views_less_likely_is_taken_back(monkeypatch):
    X, _ = poses(frames=40)
    wrong = torch.from_numpy(np.random.default_rng(1).random(40) < 0.5)
    model = fitted(X, seen(X), 4, ((0.05, 20), (0.03, 20)))
    monkeypatch.setattr(synchronise, "_AGREEING", 2.0)
    monkeypatch.setattr(synchronise, "_STAGES", ((3, 6),))
    monkeypatch.setattr(synchronise, "flipped", lambda X, *others: flip(X, wrong))
    monkeypatch.setattr(LinearModel, "searched", lambda self, *others: self)
    assert synchronised(model, seen(X), generator(), lambda done: None) is model


def test_a_model_of_one_mirror_image_is_left_alone():
    X, _ = poses(frames=80)
    model = fitted(X, seen(X), 4, ())
    assert synchronised(model, seen(X), generator(), lambda done: None) is model


def test_hidden_points_do_not_hide_that_frames_agree():
    """Shapes centred on the points that each frame shows would differ by their offsets."""
    X, _ = poses(frames=80)
    visible = np.random.default_rng(2).random((80, 10)) < 0.6
    visible[:, :4] = True
    model = fitted(X, seen(X, visible), 4, ())
    assert synchronised(model, seen(X, visible), generator(), lambda done: None) is model


@pytest.mark.parametrize("frames, points", [(2, 6), (3, 4), (5, 8), (20, 3)])
def test_few_frames_and_points(frames, points):
    X, _ = poses(frames=frames, points=points)
    rng = generator()
    model = LinearModel.random(frames, points, points - 1, rng)
    found = synchronised(model, seen(X), rng, lambda done: None)
    assert found.V.isfinite().all() and found.R.isfinite().all() and len(found.V) == points


@pytest.mark.parametrize("kind", ["planar", "collinear", "same", "noise"])
def test_shapes_without_a_sign_do_not_crash(kind):
    X, _ = poses(frames=20, points=6)
    rng = generator()
    if kind == "planar":
        X[:, 2] = 0
    elif kind == "collinear":
        X[:, 1:] = 0
    elif kind == "same":
        X[:] = X[:1]
    else:
        X = shapes(20, 6)
    X = torch.from_numpy(Rotation.random(20, random_state=1).as_matrix()) @ X
    found = flipped(flip(X, torch.arange(20) % 2 == 0), 3, 4, rng)
    assert found.isfinite().all()
