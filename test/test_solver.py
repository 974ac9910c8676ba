# SPDX-License-Identifier: Apache-2.0
"""The trainer's solvers of the lower-level problem: their optimum against OnP, their gradients against differences."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from paul_ros.orthographic_n_point import onp
from training.solver import algebraic_camera, centre, solve_camera

SCALES = ("free", "unit")
SCRIPT = Path(__file__).resolve().parent.parent / "benchmarks" / "solver_step.py"


@pytest.fixture(scope="module")
def step():
    """The benchmark, which solves the paper's problem of two streams."""
    spec = importlib.util.spec_from_file_location("solver_step", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def problem(count=6, points=12, noise=0.0, seed=0, flat=1.0):
    """Shapes (N,3,P), true rotations, views (N,2,P) of scale 1 and visibility, two points of each hidden; float64."""
    rng = np.random.default_rng(seed)
    S = torch.from_numpy(rng.standard_normal((count, 3, points)) * [[1.0], [1.0], [flat]])
    R = torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())
    visible = torch.from_numpy(rng.permuted(np.tile(np.arange(points) < points - 2, (count, 1)), axis=1))
    W = R[:, :2] @ S + noise * torch.from_numpy(rng.standard_normal((count, 2, points)))
    return S, R, W + 3, visible


def streams(count=3, noise=0.3):
    """Two streams that differ, their views and visibility."""
    S, _, W, visible = problem(count, noise=noise)
    return S, S + 0.2 * torch.from_numpy(np.random.default_rng(1).standard_normal(S.shape)), W, visible


def streams_cost(S_ae, S_ad, W, visible, R, z):
    """The lower level's cost (N,), as the paper's equation 8 has it, over visible points."""
    target = torch.cat([centre(W, visible), z[:, None]], dim=1)
    return sum(((R @ centre(S, visible) - target) * visible[:, None]).square().sum((1, 2)) for S in (S_ae, S_ad))


@pytest.mark.parametrize("scale", SCALES)
def test_the_exact_solver_finds_the_global_optimum(scale):
    S, _, W, visible = problem(300, noise=0.5, flat=0.3)
    found, optimum = solve_camera(S, W, visible, scale), onp(S.numpy(), W.numpy(), visible.numpy(), scale)
    np.testing.assert_allclose(found.R.numpy(), optimum.R, atol=1e-6)
    np.testing.assert_allclose(found.scale[:, 0, 0].numpy(), optimum.scale, rtol=1e-6)


@pytest.mark.parametrize("solver", [solve_camera, algebraic_camera])
@pytest.mark.parametrize("scale", SCALES)
def test_every_solver_finds_the_camera_of_an_exact_view(scale, solver):
    S, R, W, visible = problem(50)
    found = solver(S, W, visible, scale)
    tolerance = 2e-3 if solver is algebraic_camera else 1e-7  # its ridge
    torch.testing.assert_close(found.R, R, atol=tolerance, rtol=0)
    torch.testing.assert_close(found.scale.flatten(), torch.ones(50, dtype=torch.double), rtol=5 * tolerance, atol=0)
    torch.testing.assert_close(torch.linalg.det(found.R), torch.ones(50, dtype=torch.double))


@pytest.mark.parametrize("solver", [solve_camera, algebraic_camera])
def test_hidden_points_count_for_nothing(solver):
    S, _, W, visible = problem(noise=0.1)
    broken = torch.where(visible[:, None], W, 1e3)
    torch.testing.assert_close(solver(S, W, visible), solver(S, broken, visible))


@pytest.mark.parametrize("solver", [solve_camera, algebraic_camera])
@pytest.mark.parametrize("scale", SCALES)
def test_gradients_against_finite_differences(scale, solver):
    S, _, W, visible = problem(3, noise=0.2)
    inputs = S.requires_grad_(), W.requires_grad_()
    assert torch.autograd.gradcheck(lambda s, w: tuple(solver(s, w, visible, scale)), inputs, atol=1e-6)


@pytest.mark.parametrize("solver", [solve_camera, algebraic_camera])
def test_gradients_are_finite_for_flat_shapes(solver):
    S, _, W, visible = problem(flat=0.0)
    found = solver(S.requires_grad_(), W, visible)
    (found.R.sum() + found.scale.sum()).backward()
    assert torch.isfinite(S.grad).all()


def test_algebraic_gradient_where_singular_values_coincide():
    """An exact view of an isotropic shape: both singular values are 1, where the gradients of U and V are infinite."""
    S = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.double).T[None].contiguous()
    W, visible = S[:, :2].clone(), torch.ones(1, 4, dtype=torch.bool)
    inputs = S.requires_grad_(), W.requires_grad_()
    found = algebraic_camera(*inputs, visible)
    found.R[0, 0, 1].backward()
    assert torch.isfinite(S.grad).all() and torch.isfinite(W.grad).all()
    assert torch.autograd.gradcheck(lambda s, w: tuple(algebraic_camera(s, w, visible)), inputs, atol=1e-6)


def test_algebraic_camera_is_least_squares_then_svd():
    S, _, W, visible = problem(40, noise=0.3)
    found = algebraic_camera(S, W, visible)
    for row in range(40):
        X, Y = (centre(part, visible)[row][:, visible[row]] for part in (S, W))
        U, s, V = torch.linalg.svd(torch.linalg.lstsq(X.T, Y.T).solution.T, full_matrices=False)
        torch.testing.assert_close(found.R[row, :2], U @ V, atol=5e-3, rtol=0)  # its ridge
        torch.testing.assert_close(found.scale[row, 0, 0], s.mean(), atol=5e-3, rtol=0)


def test_streams_are_solved_to_a_lower_cost_than_any_other_pose(step):
    """Rotation and depth of the two-stream problem: below the algebraic pose, and below all poses nearby."""
    S_ae, S_ad, W, visible = streams(100)
    R, z = step.exact_streams(S_ae, S_ad, W, visible)
    best = streams_cost(S_ae, S_ad, W, visible, R, z)
    algebraic = streams_cost(S_ae, S_ad, W, visible, *step.algebraic_streams(S_ae, S_ad, W, visible))
    assert (best <= algebraic + 1e-12).all() and (best < 0.99 * algebraic).any()
    rng = np.random.default_rng(0)
    for size in (1e-3, 0.1, 1.0):
        turn = torch.from_numpy(Rotation.from_rotvec(size * rng.standard_normal((100, 3))).as_matrix())
        moved = z + size * torch.from_numpy(rng.standard_normal(z.shape))
        assert (streams_cost(S_ae, S_ad, W, visible, turn @ R, z) >= best).all()
        assert (streams_cost(S_ae, S_ad, W, visible, R, moved) >= best).all()


@pytest.mark.parametrize("solver", ["exact", "algebraic"])
def test_gradient_of_the_lower_level_cost_against_finite_differences(step, solver):
    """Autograd sees the exact pose as a constant, and the gradient of the cost is right: envelope theorem."""
    S_ae, S_ad, W, visible = streams()
    solve = step.SOLVERS[solver]

    def cost(S_ae, S_ad, W):
        return streams_cost(S_ae, S_ad, W, visible, *solve(S_ae, S_ad, W, visible))

    inputs = tuple(part.requires_grad_() for part in (S_ae, S_ad, W))
    assert solve(*inputs, visible)[0].requires_grad == (solver == "algebraic")
    assert torch.autograd.gradcheck(cost, inputs, atol=1e-6)


def test_shapes_that_are_no_numbers_are_left_to_the_loss():
    S, _, W, visible = problem()
    S[2] = torch.nan
    found = solve_camera(S, W, visible)
    torch.testing.assert_close(found.R[2], torch.eye(3, dtype=torch.double))
    assert torch.isfinite(found.R).all() and found.scale[2] == 0


@pytest.mark.parametrize("scale", SCALES)
def test_collapsed_shapes_get_rotations_all_the_same(scale):
    """In single precision, as in training, where a network's first shapes may lie on a line or in a point."""
    S, _, W, visible = problem(60)
    along = torch.randn(60, 3, 1, generator=torch.Generator().manual_seed(0))
    line, point = along * torch.linspace(-1, 1, 12), along.expand(60, 3, 12)
    for shape in (line, point, 1e-6 * S.float()):
        shape = shape.clone().float().requires_grad_()
        found = solve_camera(shape, W.float(), visible, scale)
        torch.testing.assert_close(torch.linalg.det(found.R), torch.ones(60), atol=1e-4, rtol=0)
        assert torch.isfinite(found.scale).all()
        (found.R[:, 0].sum() + found.scale.sum()).backward()
        assert torch.isfinite(shape.grad).all()
