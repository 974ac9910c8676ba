# SPDX-License-Identifier: Apache-2.0
"""OnP against a naive multi-start search, its certificate, and what degenerate input gets."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from paul_ros.onp import onp

SCALES = ("free", "unit")


def random_problems(count, points, noise, seed, flat=1.0):
    """Shapes (N,3,P), their noisy views (N,2,P) and the true rotations; scales over six decades."""
    rng = np.random.default_rng(seed)
    S = rng.standard_normal((count, 3, points)) * np.array([1.0, 1.0, flat])[:, None]
    R = Rotation.random(count, random_state=seed).as_matrix()
    W = R[:, :2] @ S + noise * rng.standard_normal((count, 2, points))
    return S, W, R


def naive_residual(S, W, w, free, starts=12):
    """Best weighted root mean square found by BFGS from many random rotations: the naive twin."""
    S = S - np.average(S, axis=1, weights=w)[:, None]
    W = W - np.average(W, axis=1, weights=w)[:, None]

    def cost(x):
        scale = np.exp(x[3]) if free else 1.0
        return (w * (scale * Rotation.from_rotvec(x[:3]).as_matrix()[:2] @ S - W) ** 2).sum()

    first = Rotation.random(starts, random_state=0).as_rotvec()
    return np.sqrt(min(minimize(cost, [*x, 0.0], method="BFGS").fun for x in first) / w.sum())


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("points,noise,flat", [(4, 0.1, 1), (6, 0.3, 1), (17, 0.3, 1), (17, 0.1, 0.05), (8, 0.8, 1)])
def test_no_search_finds_a_better_pose(scale, points, noise, flat):
    S, W, _ = random_problems(12, points, noise, seed=points, flat=flat)
    weights = np.random.default_rng(1).random((12, points)) + 0.1
    found = onp(S, W, weights, scale)
    best = [naive_residual(s, w, m, scale == "free") for s, w, m in zip(S, W, weights)]
    assert (found.residual <= np.array(best) * (1 + 1e-6) + 1e-9).all()


@pytest.mark.parametrize("scale", SCALES)
def test_exact_views_give_the_exact_pose(scale):
    S, W, R = random_problems(200, 17, 0.0, seed=3)
    found = onp(S, W, scale=scale)
    np.testing.assert_allclose(found.R, R, atol=1e-7)
    np.testing.assert_allclose(found.scale, 1, rtol=1e-7)
    assert found.certified.all() and (found.ambiguity < 1e-6).all()


@pytest.mark.parametrize("scale", SCALES)
def test_certified_share_and_rotations(scale):
    S, W, _ = random_problems(2000, 17, 0.3, seed=4)
    found = onp(S, W, scale=scale)
    assert found.certified.mean() >= 0.995
    for R in (found.R, found.R_mirror):
        np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(R), 1)
    assert (found.residual <= found.residual_mirror).all()


def test_residual_is_that_of_the_returned_pose():
    S, W, _ = random_problems(50, 9, 0.2, seed=5)
    weights = np.random.default_rng(5).random((50, 9))
    W = W + np.array([3.0, -7.0])[:, None]
    found = onp(S, W, weights)
    back = found.scale[:, None, None] * found.R[:, :2] @ S + found.translation[..., None]
    rms = np.sqrt((weights * ((back - W) ** 2).sum(1)).sum(1) / weights.sum(1))
    np.testing.assert_allclose(found.residual, rms, rtol=1e-9)


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6])
def test_free_scale_follows_the_image_and_the_shape(factor):
    S, W, _ = random_problems(20, 8, 0.1, seed=6)
    plain, larger = onp(S, W), onp(S, factor * W)
    np.testing.assert_allclose(larger.scale, factor * plain.scale, rtol=1e-7)
    np.testing.assert_allclose(larger.R, plain.R, atol=1e-6)
    np.testing.assert_allclose(onp(factor * S, W).R, plain.R, atol=1e-6)


def test_turning_the_image_turns_the_pose():
    S, W, _ = random_problems(20, 8, 0.2, seed=7)
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    np.testing.assert_allclose(onp(S, turn[:2, :2] @ W).R, turn @ onp(S, W).R, atol=1e-6)


def test_hidden_points_count_for_nothing():
    S, W, _ = random_problems(20, 10, 0.2, seed=8)
    visible = np.ones((20, 10), bool)
    visible[:, 7:] = False
    broken_S, broken_W = S.copy(), W.copy()
    broken_S[:, :, 7:], broken_W[:, :, 7:] = np.nan, np.inf
    np.testing.assert_allclose(onp(broken_S, broken_W, visible).R, onp(S[:, :, :7], W[:, :, :7]).R, atol=1e-9)


def test_planar_shapes_are_reported_as_ambiguous():
    S, W, _ = random_problems(50, 12, 0.05, seed=9, flat=0.0)
    found = onp(S, W)
    assert found.determined.all()
    np.testing.assert_allclose(found.ambiguity, 1, atol=1e-6)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("case", ["coincident", "collinear", "no weight", "two points", "image is one point"])
def test_degenerate_input_is_flagged_and_finite(scale, case):
    S, W, _ = random_problems(3, 6, 0.1, seed=10)
    weights = np.ones((3, 6))
    if case == "coincident":
        S = np.broadcast_to(S[:, :, :1], S.shape)
    elif case == "collinear":
        S = S[:, :, :1] * np.arange(6.0)
    elif case == "no weight":
        weights[:] = 0
    elif case == "two points":
        weights[:, 2:] = 0
    else:
        W = np.broadcast_to(W[:, :, :1], W.shape)
    found = onp(S, W, weights, scale)
    assert not found.determined.any() and not found.certified.any()
    for value in found:
        assert np.isfinite(value).all()
    assert np.isfinite(found.ambiguity).all()


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_visible_points_that_are_not_finite_spoil_their_own_row_only(scale, bad):
    S, W, _ = random_problems(3, 8, 0.1, seed=11)
    good = onp(S, W, scale=scale)
    S[0, 1, 2], W[1, 0, 3] = bad, bad
    found = onp(S, W, scale=scale)
    np.testing.assert_array_equal(found.determined, [False, False, True])
    np.testing.assert_allclose(found.R[2], good.R[2])
    for value in found:
        assert np.isfinite(value).all()


def test_no_problems_give_no_poses():
    assert onp(np.empty((0, 3, 5)), np.empty((0, 2, 5))).R.shape == (0, 3, 3)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"S \(N,3,P\)"):
        onp(np.zeros((2, 3, 5)), np.zeros((2, 2, 4)))
    with pytest.raises(ValueError, match="weights"):
        onp(np.zeros((2, 3, 5)), np.zeros((2, 2, 5)), np.ones((2, 4)))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("points", [3, 4, 8])
def test_turning_the_shape_changes_nothing(scale, points):
    """The search takes other ways then; two ways to different optima would show one of them wrong, certified or not."""
    S, W, _ = random_problems(1500, points, 0.5, seed=points, flat=0.5)
    found = onp(S, W, scale=scale)
    for seed in range(4):
        turn = Rotation.random(len(S), random_state=seed).as_matrix()
        # Costs are exact to 1e-16, so residuals, their roots, to 1e-8.
        np.testing.assert_allclose(onp(turn @ S, W, scale=scale).residual, found.residual, atol=1e-7)


def test_every_free_scale_optimum_is_certified():
    """There the certificate is necessary as well, so that what is not certified was not found."""
    for points, noise, flat in ((4, 1.0, 0.2), (9, 0.4, 0.05), (17, 2.0, 1.0)):
        S, W, _ = random_problems(2000, points, noise, seed=12, flat=flat)
        assert onp(S, W).certified.all()
