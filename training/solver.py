# SPDX-License-Identifier: Apache-2.0
"""The lower level of the bilevel objective: the camera of every shape of a batch, with gradients for every loss.

Three ways, for different losses:

- ``solve_streams`` is the paper's lower-level problem itself, its two reconstruction streams, unknown depth and unit
  scale.  Solved exactly, its solution needs no gradient of its own where the training loss is the same squared cost:
  at an optimum the cost does not change with the pose (envelope theorem).
- ``solve_camera`` is the exact optimum as a differentiable function, for every other loss: one Newton step is recorded
  at the optimum, whose derivative is that of the optimum itself (implicit function theorem). ``objective.py`` trains
  with it, for its losses are unsquared and more than one.
- ``algebraic_camera`` is the paper's own approximation, least squares projected onto the rotations (section 4.2).

Exact means the global optimum of ``paul_ros.onp``, which solves on the CPU; only second moments, 25 numbers a shape,
travel there.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from paul_ros import viewing_sphere

Scale = viewing_sphere.Scale

_RIDGE = 1e-4  # of the shape's squared size: keeps flat shapes solvable


class Camera(NamedTuple):
    """R (N,3,3), det +1, and scale (N,1,1), image units per shape unit (1 in the unit-scale problem)."""

    R: Tensor
    scale: Tensor


def centre(X: Tensor, visible: Tensor) -> Tensor:
    """Points (N,D,P) minus the mean of the visible ones (N,P): the adaptive normalisation of section 4.3.

    The printed line lacks the factor 1/v (v visible points) that its derivation gives; this is the derived form.
    """
    seen = visible[:, None].to(X.dtype)
    return X - (X * seen).sum(2, keepdim=True) / seen.sum(2, keepdim=True)


def solve_streams(
    S_ae: Tensor, S_ad: Tensor, W: Tensor, visible: Tensor, solver: Literal["exact", "algebraic"] = "exact"
) -> tuple[Tensor, Tensor]:
    """The paper's lower-level problem (equation 8): rotation and depth that fit both reconstruction streams.

    Minimise ``|R S_ae - [W; z]|^2 + |R S_ad - [W; z]|^2`` over the visible points. The best depth is the mean of the
    two streams' (step 3); what then is left of the streams' difference does not depend on R, so the rest is
    orthographic-N-point of their mean. The paper's step 1 fits an affine camera to both streams instead, as if every
    point had been seen twice.

    Args:
        S_ae, S_ad: (N,3,P) shapes of the auto-encoder and the auto-decoder stream, canonical frame.
        W: (N,2,P) image points; anything finite where hidden.
        visible: (N,P) bool, at least three a shape.
        solver: ``"exact"`` gives the global optimum, without gradient: none is needed where the loss is this cost.
            ``"algebraic"`` gives the paper's approximation, differentiable.

    Returns:
        R (N,3,3) and z (N,P), the depth about the mean of the visible points.

    Raises:
        ValueError: there is no such solver.
    """
    if solver not in ("exact", "algebraic"):
        raise ValueError(f"solver is 'exact' or 'algebraic', not {solver!r}")
    mean = centre(S_ae + S_ad, visible) / 2
    if solver == "exact":
        R = optimal_camera(mean, W, visible, "unit").R
        return R, (R[:, 2:] @ mean.detach())[:, 0]
    both = torch.cat([centre(S_ae, visible), centre(S_ad, visible)], dim=2)
    R = algebraic_camera(both, torch.cat([W, W], dim=2), torch.cat([visible, visible], dim=1), "unit").R
    return R, (R[:, 2:] @ mean)[:, 0]


@torch.no_grad()
def optimal_camera(S: Tensor, W: Tensor, visible: Tensor, scale: Scale = "free") -> Camera:
    """The global optimum of orthographic-N-point, a constant to autograd.

    Args:
        S: (N,3,P) shapes, canonical frame.
        W: (N,2,P) image points; anything finite where hidden.
        visible: (N,P) bool, at least three a shape.

    Returns:
        The camera that minimises ``|scale * R[:, :2] @ centre(S) - centre(W)|`` over the visible points; the identity
        where they fix none (and scale 0 if that is free).
    """
    X = centre(torch.cat([S, W], dim=1), visible) * visible[:, None]
    X = X.double()  # in single precision what lies on one line would not look so
    moments = (X @ X.transpose(1, 2)).cpu().numpy()
    moments[~np.isfinite(moments).all((1, 2))] = 0.0  # a training that diverged: its loss will tell
    poses = viewing_sphere.solve(moments, np.zeros(moments.shape[:2]), scale, rivals=False)
    R, s = (torch.from_numpy(part[:, 0]).to(S) for part in (poses.R, poses.scale))
    return Camera(R, s[:, None, None])


def algebraic_camera(S: Tensor, W: Tensor, visible: Tensor, scale: Scale = "free") -> Camera:
    """The paper's own solver: the least-squares affine camera M, its singular values set to their mean (or to 1).

    U V^T of M's singular value decomposition is its polar factor (M M^T)^(-1/2) M, which for two rows has a closed
    form; that is smooth where the singular values coincide, as U and V are not. Differentiable in S and W.

    Args and returns are those of ``optimal_camera``.
    """
    seen = visible[:, None].to(S.dtype)
    S, W = centre(S, visible) * seen, centre(W, visible) * seen
    M = _affine_camera(S @ S.transpose(1, 2), W @ S.transpose(1, 2))
    G = M @ M.transpose(1, 2)
    # With s and t the singular values of M: root = s t, total = s + t, and sqrt(G) = (G + s t) / (s + t).
    root = torch.linalg.cross(M[:, 0], M[:, 1]).square().sum(1).clamp_min(1e-18).sqrt()
    total = (G.diagonal(dim1=1, dim2=2).sum(1) + 2 * root).sqrt()[:, None, None]
    adjugate = _trace(G) * torch.eye(2, dtype=G.dtype, device=G.device) - G
    Q = (adjugate @ M + root[:, None, None] * M) / (root[:, None, None] * total)
    R = torch.cat([Q, torch.linalg.cross(Q[:, 0], Q[:, 1])[:, None]], dim=1)
    return Camera(R, total / 2 if scale == "free" else torch.ones_like(total))


def solve_camera(S: Tensor, W: Tensor, visible: Tensor, scale: Scale = "free") -> Camera:
    """The global optimum as a function of S and W that autograd can differentiate; see ``optimal_camera``."""
    seen = visible[:, None].to(S.dtype)
    n = optimal_camera(S, W, visible, scale).R[:, 2]
    S, W = centre(S, visible) * seen, centre(W, visible) * seen
    A, B = S @ S.transpose(1, 2), W @ S.transpose(1, 2)
    return _pose(A, B, _unit(n + _newton_step(A, B, n, scale)), scale)


def _unit(v: Tensor) -> Tensor:
    return v / v.norm(dim=1, keepdim=True)


def _times(M: Tensor, v: Tensor) -> Tensor:
    return (M @ v[..., None])[..., 0]


def _trace(M: Tensor) -> Tensor:
    return M.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]


def _affine_camera(A: Tensor, B: Tensor) -> Tensor:
    """(N,2,3) least-squares affine camera B A^-1, step 1 of the paper's solver."""
    ridge = _RIDGE * _trace(A).clamp_min(1e-9) * torch.eye(3, dtype=A.dtype, device=A.device)
    return torch.linalg.solve(A + ridge, B, left=False)


def _goal(A: Tensor, B: Tensor, n: Tensor, scale: Scale) -> tuple[Tensor, Tensor]:
    """Gradient (N,3) and Hessian (N,3,3) of the goal at its optima n; docs/onp.md has A, B, c, D, T and the goals."""
    c, D = torch.linalg.cross(B[:, 0], B[:, 1]), B.transpose(1, 2) @ B
    An, Dn = _times(A, n), _times(D, n)
    T = (_trace(D)[:, 0, 0] + (n * (2 * c - Dn)).sum(1)).clamp_min(1e-18)[:, None]
    dT = 2 * (c - Dn)
    if scale == "unit":
        root = T.sqrt()
        twist = dT[:, :, None] * dT[:, None] / (2 * T * root)[..., None]
        return 2 * An + dT / root, 2 * A - 2 * D / root[..., None] - twist
    across = (_trace(A)[:, 0] - (n * An).sum(1, keepdim=True)).clamp_min(1e-9)
    g = T / across
    dg = (dT + 2 * g * An) / across
    # The products of the two slopes are left out: at an optimum they vanish across n.
    return dg, 2 * (g[..., None] * A - D) / across[..., None]


def _newton_step(A: Tensor, B: Tensor, n: Tensor, scale: Scale) -> Tensor:
    """Newton step (N,3), tangent to n, towards the maximum of the goal."""
    dg, hessian = _goal(A, B, n, scale)
    E = _tangent(n)
    slope = _times(E.transpose(1, 2), dg)
    bend = E.transpose(1, 2) @ hessian @ E
    pull = (n * dg).sum(1)
    a, b, d = bend[:, 0, 0] - pull, bend[:, 0, 1], bend[:, 1, 1] - pull
    shift = _shift(a.detach(), b.detach(), d.detach())
    a, d = a - shift, d - shift
    along = torch.stack([b * slope[:, 1] - d * slope[:, 0], b * slope[:, 0] - a * slope[:, 1]], 1)
    return _times(E, along / (a * d - b * b).clamp_min(1e-12)[:, None])


def _shift(a: Tensor, b: Tensor, d: Tensor) -> Tensor:
    """What to take off the diagonal of [[a, b], [b, d]] to make it negative definite, 0 where it is."""
    middle, radius = (a + d) / 2, torch.hypot((a - d) / 2, b)
    top, bottom = middle + radius, middle - radius
    return torch.where(top < 0, torch.zeros_like(top), top + 0.1 * bottom.abs() + 1e-6)


def _tangent(n: Tensor) -> Tensor:
    """(N,3,2) orthonormal basis of the plane across n (Duff et al., JCGT 2017)."""
    x, y, z = n.unbind(1)
    sign = torch.copysign(torch.ones_like(z), z)
    a = -1 / (sign + z)
    b = x * y * a
    return torch.stack([1 + sign * x * x * a, b, sign * b, sign + y * y * a, -sign * x, -y], 1).view(-1, 3, 2)


def _pose(A: Tensor, B: Tensor, n: Tensor, scale: Scale) -> Camera:
    """The best pose that looks along n."""
    # Built from n itself, not from a frozen basis, so that gradients reach both rows.
    first = _tangent(n.detach())[..., 0]
    e1 = _unit(first - n * (first * n).sum(1, keepdim=True))
    e2 = torch.linalg.cross(n, e1)
    real = (e1 * B[:, 0]).sum(1) + (e2 * B[:, 1]).sum(1)
    imaginary = (e1 * B[:, 1]).sum(1) - (e2 * B[:, 0]).sum(1)
    size = (real.square() + imaginary.square()).clamp_min(1e-18).sqrt()
    cos = torch.where(size > 1e-9, real / size, torch.ones_like(size))[:, None]  # some rotation where any will do
    sin = torch.where(size > 1e-9, imaginary / size, torch.zeros_like(size))[:, None]
    R = torch.stack([cos * e1 - sin * e2, sin * e1 + cos * e2, n], 1)
    if scale == "unit":
        return Camera(R, torch.ones_like(size)[:, None, None])
    across = _trace(A)[:, 0, 0] - (n * _times(A, n)).sum(1)
    return Camera(R, (size / across.clamp_min(1e-9))[:, None, None])
