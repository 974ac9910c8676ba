# SPDX-License-Identifier: Apache-2.0
"""The linear model's closed forms against the same written out with dense matrices, and what its steps promise."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from training.start.linear_model import LinearModel, random_rotations, rotations_of
from training.start.moments import Moments
from training.start.observations import Observations

FRAMES, POINTS, BASES, SIGMA = 12, 9, 3, 0.3
GENERATORS = (
    [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
    [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
    [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
)
"""Turns about x, y, z, to first order."""

HIDDEN = pytest.mark.parametrize("hidden", [0.0, 0.3])


def observed(hidden=0.0, frames=FRAMES, seed=0):
    """Frames of a body with two ways to bend and a little noise; some points hidden, with rubbish in their place."""
    rng = np.random.default_rng(seed)
    V = rng.standard_normal((3, 3, POINTS)) * [[[1.0]], [[0.4]], [[0.3]]]
    S = np.tensordot(np.c_[np.ones(frames), rng.standard_normal((frames, 2))], V, 1)
    W = (random_rotations(frames, rng).numpy() @ S)[:, :2] + 0.05 * rng.standard_normal((frames, 2, POINTS))
    visible = rng.random((frames, POINTS)) >= hidden
    visible[:, :4] = True
    return Observations.of(np.where(visible[:, None], W + 7, 1e6), visible)


def model_of(seen, bases=BASES, seed=1):
    """A model that fits the frames somewhat."""
    return LinearModel.random(len(seen), seen.points, bases, np.random.default_rng(seed)).em_step(seen, 0.5, 1.0)


def images(seen, V, R):
    """Bases as the frames' cameras see them (F,K+1,3,P), centred on the visible points, 0 at the others."""
    shown = seen.visible[:, None, None].double()
    turned = torch.einsum("fai,kip->fkap", R, V)
    return (turned - (turned * shown).sum(3, keepdim=True) / shown.sum(3, keepdim=True)) * shown


def dense(seen, V, R, sigma):
    """By matrices (2P,2P): likelihoods (F,), with and without the cameras integrated out; means, covariances of codes.

    W is Gaussian about the mean's image with covariance C = B B^T + sigma^2 I. The constants leave out hidden points
    and the translation, which the images do not determine.
    """
    M = images(seen, V, R)
    size, K = 2 * seen.points, len(V) - 1
    flat = M[:, :, :2].flatten(2)
    residual, B = seen.W.flatten(1) - flat[:, 0], flat[:, 1:].transpose(1, 2)
    C = B @ B.transpose(1, 2) + sigma**2 * torch.eye(size, dtype=torch.float64)
    free = (size - 2 * seen.visible.sum(1) + 2).double()
    weighed = torch.linalg.solve(C, residual[..., None])[..., 0]
    nll = 0.5 * (torch.logdet(C) + (residual * weighed).sum(1) - free * math.log(sigma**2))
    mean = (B.transpose(1, 2) @ weighed[..., None])[..., 0]
    covariance = torch.eye(K, dtype=torch.float64) - B.transpose(1, 2) @ torch.linalg.solve(C, B)
    x, y, z = (M[:, 0] + torch.einsum("fk,fkap->fap", mean, M[:, 1:])).unbind(1)
    none = torch.zeros_like(x)
    T = torch.stack([torch.cat(pair, 1) for pair in ((none, -z), (z, none), (-y, x))], 2)
    sharpness = torch.logdet(T.transpose(1, 2) @ torch.linalg.solve(C, T))
    return nll, nll + 0.5 * sharpness, mean, covariance


@HIDDEN
@pytest.mark.parametrize("bases", [0, BASES])
def test_codes_and_likelihoods_are_those_of_the_dense_gaussian(hidden, bases):
    seen = observed(hidden)
    model = model_of(seen, bases)
    posterior = model.posterior(seen, SIGMA)
    nll, _, mean, covariance = dense(seen, model.V, model.R, SIGMA)
    torch.testing.assert_close(posterior.nll, nll)
    torch.testing.assert_close(posterior.mean, mean)
    torch.testing.assert_close(posterior.covariance, covariance)


@HIDDEN
@pytest.mark.parametrize("bases", [0, BASES])
def test_marginal_likelihood_and_its_gradient_are_those_of_the_dense_gaussian(hidden, bases):
    seen = observed(hidden)
    model = model_of(seen, bases)
    V = model.V.clone().requires_grad_()
    turn = torch.zeros(len(seen), 3, dtype=torch.float64, requires_grad=True)
    ours = Moments.of(seen, V).marginal_nll(rotations_of(turn) @ model.R, SIGMA)
    brute = dense(seen, V, rotations_of(turn) @ model.R, SIGMA)[1]
    torch.testing.assert_close(ours, brute, rtol=1e-6, atol=1e-6)
    for one, other in zip(torch.autograd.grad(ours.sum(), [V, turn]), torch.autograd.grad(brute.sum(), [V, turn])):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


@HIDDEN
def test_points_on_one_line_have_a_marginal_likelihood(hidden):
    # They leave the turn about it open; rounding made the determinant negative.
    rng = np.random.default_rng(0)
    along = rng.standard_normal((4, 1, POINTS)) * np.array([3.0, 4.0, 5.0])[:, None]
    R = random_rotations(200, rng)
    S = np.tensordot(np.c_[np.ones(200), rng.standard_normal((200, 3))], along, 1)
    visible = rng.random((200, POINTS)) >= hidden
    visible[:, :2] = True
    moments = Moments.of(Observations.of((R.numpy() @ S)[:, :2], visible), torch.from_numpy(along))
    for sigma in (0.3, 0.03, 0.002, 0.0005):
        assert torch.isfinite(moments.marginal_nll(R, sigma)).all()


@HIDDEN
def test_expected_products_are_those_of_all_shapes_that_the_codes_allow(hidden):
    seen = observed(hidden)
    model = model_of(seen)
    moments = Moments.of(seen, model.V)
    posterior = moments.posterior(model.R, SIGMA)
    unturned = images(seen, model.V, torch.eye(3, dtype=torch.float64).expand(len(seen), 3, 3))
    expected = torch.einsum("fkl,fkip,fljp->fij", posterior.second, unturned, unturned)
    torch.testing.assert_close(moments.spread(posterior), expected)


@HIDDEN
def test_scores_are_the_likelihoods_of_frames_under_each_camera(hidden):
    seen = observed(hidden)
    model = model_of(seen)
    moments, R = Moments.of(seen, model.V), random_rotations(5, np.random.default_rng(0))
    expected = torch.stack([moments.posterior(one.expand(len(seen), 3, 3), SIGMA).nll for one in R])
    torch.testing.assert_close(moments.scores(R, SIGMA), expected)


@HIDDEN
def test_no_other_camera_has_a_higher_expected_likelihood(hidden):
    seen = observed(hidden)
    model = model_of(seen)
    moments = Moments.of(seen, model.V)
    posterior = moments.posterior(model.R, SIGMA)

    def expected(R):
        M = images(seen, model.V, R)[:, :, :2].flatten(2)
        fit = torch.einsum("fk,fkp->fp", torch.cat([torch.ones(len(seen), 1).double(), posterior.mean], 1), M)
        spread = torch.einsum("fkl,fkp,flp->f", posterior.covariance, M[:, 1:], M[:, 1:])
        return (seen.W.flatten(1) - fit).square().sum(1) + spread

    best = moments.best_rotations(posterior)
    torch.testing.assert_close(torch.linalg.det(best), torch.ones(len(seen), dtype=torch.float64))
    least = expected(best)
    for one in random_rotations(300, np.random.default_rng(0)):
        near = rotations_of(0.05 * one[:1]) @ best
        assert (expected(one.expand(len(seen), 3, 3)) >= least - 1e-9).all()
        assert (expected(near) >= least - 1e-9).all()


def objective(model, seen, sigma, penalty):
    """Expectation maximisation lowers the likelihood without the Laplace term."""
    return float(model.posterior(seen, sigma).nll.mean() + penalty * model.V.square().sum() / (3 * seen.points))


@HIDDEN
@pytest.mark.parametrize("sigma, penalty", [(1.0, 3.0), (0.3, 1.0), (0.1, 0.1), (0.05, 0.0)])
def test_no_step_of_expectation_maximisation_raises_the_objective(hidden, sigma, penalty):
    seen = observed(hidden, frames=30)
    for seed in range(3):
        model = LinearModel.random(len(seen), seen.points, BASES, np.random.default_rng(seed))
        values = [objective(model, seen, sigma, penalty)]
        for _ in range(25):
            model = model.em_step(seen, sigma, penalty)
            values.append(objective(model, seen, sigma, penalty))
        assert (np.diff(values) <= 1e-7).all(), np.diff(values).max()
        assert values[-1] < values[0] - 0.5


@HIDDEN
def test_codes_are_white_after_a_step_without_penalty(hidden):
    seen = observed(hidden, frames=40)
    model = LinearModel.random(len(seen), seen.points, 2, np.random.default_rng(0))
    for _ in range(200):
        model = model.em_step(seen, 0.2, 0.0)
    posterior = model.posterior(seen, 0.2)
    torch.testing.assert_close(posterior.mean.mean(0), torch.zeros(2).double(), atol=0.02, rtol=0)
    second = posterior.second[:, 1:, 1:].mean(0)
    torch.testing.assert_close(second, torch.eye(2).double(), atol=0.05, rtol=0)


@HIDDEN
def test_search_finds_lost_cameras_and_loses_none(hidden):
    seen = observed(hidden, frames=30)
    generator = np.random.default_rng(0)
    model = LinearModel.random(len(seen), seen.points, 2, generator)
    for _ in range(15):
        model = model.em_step(seen, 0.3, 0.1).searched(seen, 0.3, generator, 30)
    known = model.posterior(seen, 0.3).nll
    lost = LinearModel(model.V, random_rotations(len(seen), generator))
    assert (lost.posterior(seen, 0.3).nll > known + 1).float().mean() > 0.5
    assert (lost.searched(seen, 0.3, generator).posterior(seen, 0.3).nll < known + 0.1).float().mean() > 0.85
    assert (model.searched(seen, 0.3, generator).posterior(seen, 0.3).nll <= known).all()


@HIDDEN
def test_polish_goes_on_where_expectation_maximisation_stops_and_leaves_bases_centred(hidden):
    seen = observed(hidden, frames=30)
    model = model_of(seen)
    polished = model.polished(seen, 0.2, 0.1, 30)
    assert polished.objective(seen, 0.2, 0.1) < model.objective(seen, 0.2, 0.1) - 1
    torch.testing.assert_close(polished.V.mean(2), torch.zeros(BASES + 1, 3).double())
    torch.testing.assert_close(polished.R @ polished.R.transpose(1, 2), torch.eye(3).double().expand(30, 3, 3))


def test_new_bases_are_small_and_change_no_shape():
    seen = observed()
    model = model_of(seen)
    wide = model.widened(5, np.random.default_rng(0))
    assert wide.V.shape == (6, 3, POINTS) and torch.equal(wide.V[: BASES + 1], model.V)
    assert 0 < wide.V[BASES + 1 :].abs().max() < 0.1


def test_hidden_points_are_ignored_and_frames_are_centred_on_the_rest():
    rng = np.random.default_rng(0)
    W, visible = rng.standard_normal((4, 2, 6)), np.arange(6) < 4
    visible = np.tile(visible, (4, 1))
    first = Observations.of(W, visible)
    W[:, :, 4:] = np.nan
    second = Observations.of(W + 5, visible)
    torch.testing.assert_close(first.W, second.W)
    torch.testing.assert_close(first.W[:, :, :4].mean(2), torch.zeros(4, 2).double())
    assert not first.W[:, :, 4:].any() and not first.complete
    assert torch.equal(first[np.array([2, 0])].W, first.W[[2, 0]])


def test_random_rotations_are_proper_and_uniform():
    R = random_rotations(20_000, np.random.default_rng(0))
    torch.testing.assert_close(R @ R.transpose(1, 2), torch.eye(3).double().expand(len(R), 3, 3))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R)).double())
    # Every entry is a coordinate of a uniform point of the sphere: uniform on [-1, 1] (Archimedes).
    for entry in R.flatten(1).T:
        levels = torch.sort(entry).values
        assert (levels - torch.linspace(-1, 1, len(R)).double()).abs().max() < 0.04
    # The trace of a uniform rotation has mean 0 and variance 1.
    trace = R.diagonal(dim1=1, dim2=2).sum(1)
    assert abs(trace.mean()) < 0.03 and abs(trace.var() - 1) < 0.03


def test_rotations_of_vectors_are_rodrigues_and_smooth_at_none():
    turn = torch.from_numpy(np.random.default_rng(0).standard_normal((20, 3)))
    torch.testing.assert_close(rotations_of(turn), torch.from_numpy(Rotation.from_rotvec(turn.numpy()).as_matrix()))
    none = torch.zeros(1, 3, dtype=torch.float64)
    torch.testing.assert_close(rotations_of(none), torch.eye(3).double()[None])
    jacobian = torch.autograd.functional.jacobian(rotations_of, none)[0, :, :, 0]
    x, y, z = (torch.tensor(rows).double() for rows in GENERATORS)
    torch.testing.assert_close(jacobian, torch.stack([x, y, z], 2))
    assert torch.autograd.gradcheck(rotations_of, (1e-3 * turn[:2].requires_grad_(),))
