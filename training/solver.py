# SPDX-License-Identifier: Apache-2.0
"""The lower level of the bilevel objective: the camera of every shape of a batch, with gradients for every loss.

Two ways:

- ``solve_camera`` is the exact optimum as a differentiable function, by the implicit function theorem.
- ``algebraic_camera`` is the paper's own approximation, least squares projected onto the rotations (section 4.2).

Exact means the global optimum of ``paul_ros.onp``. It is solved on the CPU, which needs only the second moments, 25
numbers a shape.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from paul_ros import viewing_sphere

Scale = viewing_sphere.Scale

_RIDGE = 1e-4
"""Ridge as a share of the shape's squared size; keeps flat shapes solvable."""

_FLAT = 1e-9
"""Least curvature of the cost as a share of the moments; flatter optima are moved as if they had it."""

_TINY = 1e-30


class Camera(NamedTuple):
    """R (N,3,3), det +1, and scale (N,1,1), image units per shape unit (1 in the unit-scale problem)."""

    R: Tensor
    scale: Tensor


def centre(X: Tensor, visible: Tensor) -> Tensor:
    """Return points (...,N,D,P) minus the mean of the visible ones (N,P): the adaptive normalisation of section 4.3.

    The printed line lacks the factor 1/v (v visible points) that its derivation gives. This is the derived form.
    """
    seen = visible[:, None].to(X.dtype)
    return X - X @ (seen / seen.sum(2, keepdim=True)).transpose(1, 2)


def algebraic_camera(S: Tensor, W: Tensor, visible: Tensor, scale: Scale = "free") -> Camera:
    """Solve as the paper does: the least-squares affine camera M, its singular values set to their mean (or to 1).

    U V^T of M's singular value decomposition is its polar factor (M M^T)^(-1/2) M, which has a closed form for two
    rows. The closed form is smooth at equal singular values; U and V are not. Differentiable in S and W.

    Arguments and returned values are those of ``solve_camera``.
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
    """Return the global optimum of orthographic-N-point, differentiable in S and W.

    Args:
        S: (N,3,P) shapes, canonical frame.
        W: (N,2,P) image points; hidden ones may have any finite value.
        visible: (N,P) bool, at least three a shape.
        scale: ``free``, or ``unit`` for scale 1.

    Returns:
        The camera that minimises ``|scale * R[:, :2] @ centre(S) - centre(W)|`` over the visible points. If these
        determine none, R is the identity (and a free scale is 0).
    """
    R, s = _Optimum.apply(S, W, visible, scale)
    return Camera(R, s[:, None, None])


class _Optimum(torch.autograd.Function):
    """The best R (N,3,3) and scale (N,), with their derivatives by the implicit function theorem.

    The cost |M S - W|^2 / 2 of M = s R_xy has zero slope at the optimum. Move the optimum to s e^v exp([w]x) R. The
    slope in x = (w, v) is <M_i, D>, with D = M A - B, A = S S^T, B = W S^T and M_i the derivative of M in x_i. The
    slope stays zero as moments change. Let g be the gradient of a loss in x, u = H^-1 g and U = sum_i u_i M_i. The
    gradient is then -M^T U in A and U in B. In the camera's axes the cost's Hessian H is sparse: turns in the image
    plane and the scale are coupled to tilts only, and are eliminated.
    """

    @staticmethod
    def forward(ctx: Any, S: Tensor, W: Tensor, visible: Tensor, scale: Scale) -> tuple[Tensor, Tensor]:
        X = torch.cat([S, W], dim=1).double()  # single precision would miss points on one line
        X = centre(X, visible) * visible[:, None]
        moments = (X @ X.transpose(1, 2)).cpu().numpy()
        finite = np.isfinite(moments).all((1, 2))
        if not finite.all():
            moments[~finite] = 0.0  # the loss of a diverged training reports it
        poses = viewing_sphere.solve(moments, np.zeros(moments.shape[:2]), scale, rivals=False)
        ctx.save_for_backward(X)
        ctx.optimum = moments, poses.R[:, 0], poses.scale[:, 0], poses.determined, scale
        return torch.from_numpy(poses.R[:, 0]).to(S), torch.from_numpy(poses.scale[:, 0]).to(S)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, in_R: Tensor, in_s: Tensor) -> tuple[Tensor | None, ...]:
        (X,) = ctx.saved_tensors
        in_moments = _slope_in_moments(*ctx.optimum, *(part.double().cpu().numpy() for part in (in_R, in_s)))
        in_X = torch.from_numpy(in_moments).to(X) @ X
        return in_X[:, :3].to(in_R), in_X[:, 3:].to(in_R), None, None


def _slope_in_moments(
    moments: np.ndarray,
    R: np.ndarray,
    s: np.ndarray,
    determined: np.ndarray,
    scale: Scale,
    in_R: np.ndarray,
    in_s: np.ndarray,
) -> np.ndarray:
    """Return a loss's gradient in moments (N,5,5), plus its transpose, from that in R (N,3,3) and s (N,).

    Undetermined poses have gradient 0.
    """
    M = s[:, None, None] * R
    along = M.transpose(0, 2, 1)
    A, B = M @ moments[:, :3, :3] @ along, moments[:, 3:, :3] @ along
    twist = in_R @ R.transpose(0, 2, 1)
    gx, gy, gz = (twist[:, i, j] - twist[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    g_size = in_s * s
    p, q, r = (A[:, i, j] - B[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    ax, ay, across = A[:, 0, 2], A[:, 1, 2], A[:, 0, 0] + A[:, 1, 1]
    least = _FLAT * (across + A[:, 2, 2] + abs(p) + abs(r)) + _TINY
    over_roll = 1 / np.maximum(across - p - r, least)
    over_size = (scale == "free") / np.maximum(across, least)
    # Tilts (x, y), after elimination of the roll z and the size.
    gx = gx + over_roll * ax * gz + over_size * ay * g_size
    gy = gy + over_roll * ay * gz - over_size * ax * g_size
    xx = A[:, 2, 2] - r - over_roll * ax * ax - over_size * ay * ay
    yy = A[:, 2, 2] - p - over_roll * ay * ay - over_size * ax * ax
    xy = q + (over_size - over_roll) * ax * ay
    over = 1 / np.maximum(xx * yy - xy * xy, least * least / _FLAT)
    ux, uy = over * (yy * gx - xy * gy), over * (xx * gy - xy * gx)
    uz = over_roll * (gz + ax * ux + ay * uy)
    size = over_size * (g_size + ay * ux - ax * uy)
    U = np.stack([size, -uz, uy, uz, size, -ux], axis=1).reshape(-1, 2, 3) @ M
    in_A = -along[:, :, :2] @ U
    found = np.zeros_like(moments)
    found[:, :3, :3] = in_A + in_A.transpose(0, 2, 1)
    found[:, 3:, :3], found[:, :3, 3:] = U, U.transpose(0, 2, 1)
    return found * determined[:, None, None]


def _trace(M: Tensor) -> Tensor:
    return M.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]


def _affine_camera(A: Tensor, B: Tensor) -> Tensor:
    """Return the least-squares affine cameras B A^-1 (N,2,3), step 1 of the paper's solver."""
    ridge = _RIDGE * _trace(A).clamp_min(1e-9) * torch.eye(3, dtype=A.dtype, device=A.device)
    return torch.linalg.solve(A + ridge, B, left=False)
