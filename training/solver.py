# SPDX-License-Identifier: Apache-2.0
"""The lower level of the bilevel objective: the optimal camera of every shape in a batch, differentiable.

The camera is found as in ``paul_ros.onp`` (see there for A, B, c, D and the goal g): least squares first - the paper's
own solver - then Newton steps on the viewing direction up to the optimum, where the paper stops at the start.  Only
the last step is recorded by autograd: at an optimum the derivative of one Newton step is the derivative of the
optimum itself (implicit function theorem), so the gradients of R and scale are exact at the price of one step.
"""

from __future__ import annotations

import torch
from torch import Tensor

_NEWTON_STEPS = 5
_STEP_LIMIT = 0.3  # radians
_RIDGE = 1e-4  # of the shape's size: keeps flat shapes solvable


def centre(X: Tensor, visible: Tensor) -> Tensor:
    """Points (N,D,P) minus the mean of the visible ones (N,P): the adaptive normalisation of section 4.3.

    The printed line lacks the factor 1/v (v visible points) that its derivation gives; this is the derived form.
    """
    seen = visible[:, None].to(X.dtype)
    return X - (X * seen).sum(2, keepdim=True) / seen.sum(2, keepdim=True)


def solve_camera(S: Tensor, W: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Optimal weak-perspective camera of every shape.

    Args:
        S: (N,3,P) shapes, canonical frame.
        W: (N,2,P) image points centred on the mean of the visible ones; anything finite where hidden.
        visible: (N,P) bool, at least three a shape.

    Returns:
        R (N,3,3), det +1, and scale (N,1,1) that minimise ``|scale * R[:, :2] @ centre(S) - W|`` over the visible
        points, to a local optimum.  Differentiable in S and W.
    """
    seen = visible[:, None].to(S.dtype)
    S, W = centre(S, visible) * seen, W * seen
    A, B = S @ S.transpose(1, 2), W @ S.transpose(1, 2)
    with torch.no_grad():
        n = _algebraic_direction(A, B)
        for _ in range(_NEWTON_STEPS):
            step = _newton_step(A, B, n)
            length = step.norm(dim=1, keepdim=True)
            n = _unit(n + step * (_STEP_LIMIT / length.clamp_min(1e-9)).clamp_max(1.0))
    n = _unit(n + _newton_step(A, B, n))
    return _pose(A, B, n)


def _unit(v: Tensor) -> Tensor:
    return v / v.norm(dim=1, keepdim=True)


def _times(M: Tensor, v: Tensor) -> Tensor:
    return (M @ v[..., None])[..., 0]


def _algebraic_direction(A: Tensor, B: Tensor) -> Tensor:
    """Viewing direction (N,3) of the least-squares affine camera, step 1 of the paper's solver."""
    size = A.diagonal(dim1=1, dim2=2).sum(1)[:, None, None].clamp_min(1e-9)
    M = torch.linalg.solve(A + _RIDGE * size * torch.eye(3, dtype=A.dtype, device=A.device), B, left=False)
    n = torch.linalg.cross(M[:, 0], M[:, 1])
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=A.dtype, device=A.device)
    return _unit(torch.where(n.norm(dim=1, keepdim=True) > 1e-9, n, ahead))


def _newton_step(A: Tensor, B: Tensor, n: Tensor) -> Tensor:
    """Newton step (N,3), tangent to n, towards a maximum of the free-scale goal g(n) = T / (tr A - n.A n)."""
    c, D = torch.linalg.cross(B[:, 0], B[:, 1]), B.transpose(1, 2) @ B
    trace_A, trace_D = (X.diagonal(dim1=1, dim2=2).sum(1) for X in (A, D))
    An, Dn = _times(A, n), _times(D, n)
    across = (trace_A - (n * An).sum(1)).clamp_min(1e-9)[:, None]
    g = (trace_D + (n * (2 * c - Dn)).sum(1))[:, None] / across
    dg = (2 * (c - Dn) + 2 * g * An) / across
    twist = dg[:, :, None] * An[:, None]
    hessian = 2 * (g[..., None] * A - D + twist + twist.transpose(1, 2)) / across[..., None]
    E = _tangent(n.detach())
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


def _pose(A: Tensor, B: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (N,3,3) and scale (N,1,1) of the best pose that looks along n."""
    # Built from n itself, not from a frozen basis, so that gradients reach both rows.
    first = _tangent(n.detach())[..., 0]
    e1 = _unit(first - n * (first * n).sum(1, keepdim=True))
    e2 = torch.linalg.cross(n, e1)
    real = (e1 * B[:, 0]).sum(1) + (e2 * B[:, 1]).sum(1)
    imaginary = (e1 * B[:, 1]).sum(1) - (e2 * B[:, 0]).sum(1)
    size = (real.square() + imaginary.square()).clamp_min(1e-18).sqrt()
    cos, sin = (real / size)[:, None], (imaginary / size)[:, None]
    R = torch.stack([cos * e1 - sin * e2, sin * e1 + cos * e2, n], 1)
    across = A.diagonal(dim1=1, dim2=2).sum(1) - (n * _times(A, n)).sum(1)
    return R, (size / across.clamp_min(1e-9))[:, None, None]
