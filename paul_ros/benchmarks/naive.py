# SPDX-License-Identifier: Apache-2.0
"""The optimum by brute force: a search over rotations that uses no theory of the problem, to judge solvers by.

The search begins at 24 rotations spread over all of them. `paul_ros.onp` searches viewing directions from starts in
closed form; the two share no formula and no line of code. Majorisation brings every start near its optimum, as it can
only descend. It converges slowly, so damped Newton steps finish the lowest of them.
"""

from __future__ import annotations

import numpy as np

from paul_ros.benchmarks.rivals import Centred, Pose, best_scale, centred, majorised, pose, spread_rotations

STARTS = 24
_MAJORISING = 100  # steps
_POLISHED = 6  # starts that Newton steps finish
_NEWTON = 12  # steps


def naive_optimum(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None, scale: str) -> Pose:
    """Return the best poses found; arguments as in `paul_ros.benchmarks.rivals`."""
    points = centred(S, W, weights)
    size = np.sqrt(points.A.trace(axis1=1, axis2=2))[:, None, None]
    image = np.sqrt((points.W**2 @ points.w[..., None]).sum(1))[..., None] if scale == "free" else size
    # Made unitless, so that one damping suits all.
    unitless = points._replace(A=points.A / size**2, B=points.B / (size * image))
    R = _polished(unitless, _lowest(unitless, scale), scale)
    return pose(*best_scale(R[:, :2], points, scale), points)


def _cost(Q: np.ndarray, A: np.ndarray, B: np.ndarray, scale: str) -> np.ndarray:
    """Return the weighted mean squared distance (...) under the best scale, less that of the image points."""
    power, along = ((Q @ A) * Q).sum((-2, -1)), (Q * B).sum((-2, -1))
    return -(along**2) / power if scale == "free" else power - 2 * along


def _lowest(points: Centred, scale: str) -> np.ndarray:
    """Return the lowest rotations (N,K,3,3) after majorisation from all starts."""
    N, starts = len(points.A), spread_rotations(STARTS)[:, :2]
    a, axes = np.linalg.eigh(points.A)
    axes = axes[:, None]
    Q, along = starts @ axes, points.B[:, None] @ axes
    Q = np.where((Q * along).sum((2, 3), keepdims=True) < 0, -Q, Q)
    a, along = np.repeat(a, STARTS, axis=0).T.copy(), np.repeat(along, STARTS, axis=1)
    along, Q = (part.reshape(-1, 2, 3).transpose(1, 2, 0).copy() for part in (along, Q))
    Q = majorised(a, along, Q, scale, _MAJORISING).transpose(2, 0, 1).reshape(N, STARTS, 2, 3)
    Q = Q @ axes.transpose(0, 1, 3, 2)
    cost = _cost(Q, points.A[:, None], points.B[:, None], scale)
    Q = np.take_along_axis(Q, np.argsort(cost, axis=1)[:, :_POLISHED, None, None], axis=1)
    return np.concatenate([Q, np.cross(Q[:, :, 0], Q[:, :, 1])[:, :, None]], axis=2)


def _polished(points: Centred, R: np.ndarray, scale: str) -> np.ndarray:
    """Return each problem's best rotation (N,3,3) after Newton steps from its rotations (N,K,3,3)."""
    A, B = points.A[:, None], points.B[:, None]
    damping = np.full(R.shape[:2], 1e-3)
    cost = _cost(R[:, :, :2], A, B, scale)
    for _ in range(_NEWTON):
        slope, bend = _derivatives(R, A, B, scale)
        step = np.linalg.solve(bend + damping[..., None, None] * np.eye(3), -slope[..., None])[..., 0]
        new = _turned(R, step)
        new_cost = _cost(new[:, :, :2], A, B, scale)
        lower = new_cost < cost
        R, cost = np.where(lower[..., None, None], new, R), np.where(lower, new_cost, cost)
        damping = np.where(lower, 0.1 * damping, 10 * damping)
    return np.take_along_axis(R, cost.argmin(1)[:, None, None, None], axis=1)[:, 0]


def _derivatives(R: np.ndarray, A: np.ndarray, B: np.ndarray, scale: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope (...,3) and Hessian (...,3,3) of the cost for turns about the camera's axes."""
    power, power_slope, power_bend = _power(R @ A @ R.swapaxes(-1, -2))
    along, along_slope, along_bend = _along(B @ R.swapaxes(-1, -2))
    if scale == "unit":
        return power_slope - 2 * along_slope, power_bend - 2 * along_bend
    # The cost is -along^2 / power, and the scale is s = along / power.
    s, over = (along / power)[..., None], 1 / power[..., None]
    scale_slope = (along_slope - s * power_slope) * over
    slope = s * s * power_slope - 2 * s * along_slope
    outer = scale_slope[..., :, None] * scale_slope[..., None, :]
    bend = s[..., None] ** 2 * power_bend - 2 * s[..., None] * along_bend - 2 * power[..., None, None] * outer
    return slope, bend


def _power(C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return tr(Q A Q^T), its slope and its Hessian, from C = R A R^T: the trace less the part along the view.

    To second order a turn v takes the view e3 to e3 + (-v1, v0, 0) + (v0 v2, v1 v2, -v0^2 - v1^2) / 2.
    """
    nought = np.zeros(C.shape[:-2])
    xx, yy, zz = C[..., 0, 0], C[..., 1, 1], C[..., 2, 2]
    xy, xz, yz = C[..., 0, 1], C[..., 0, 2], C[..., 1, 2]
    slope = -2 * np.stack([yz, -xz, nought], axis=-1)
    bend = -np.stack([2 * (yy - zz), -2 * xy, xz, -2 * xy, 2 * (xx - zz), yz, xz, yz, nought], axis=-1)
    return xx + yy, slope, bend.reshape(C.shape)


def _along(D: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return tr(Q B^T), its slope and its Hessian, from D = B R^T (...,2,3).

    To second order a turn v takes d to d + v x d + (v (v.d) - d |v|^2) / 2.
    """
    a, b = D[..., 0, :], D[..., 1, :]
    along = a[..., 0] + b[..., 1]
    slope = np.stack([-b[..., 2], a[..., 2], b[..., 0] - a[..., 1]], axis=-1)
    half = np.zeros((*D.shape[:-2], 3, 3))
    half[..., 0, :], half[..., 1, :] = a, b
    return along, slope, (half + half.swapaxes(-1, -2)) / 2 - along[..., None, None] * np.eye(3)


def _turned(R: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return R turned by `step` (...,3), a rotation vector to second order (Cayley's map)."""
    x, y, z = np.moveaxis(step / 2, -1, 0)
    rest = 1 - x * x - y * y - z * z
    rows = (
        (rest + 2 * x * x, 2 * (x * y - z), 2 * (x * z + y)),
        (2 * (x * y + z), rest + 2 * y * y, 2 * (y * z - x)),
        (2 * (x * z - y), 2 * (y * z + x), rest + 2 * z * z),
    )
    turn = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return turn / (2 - rest)[..., None, None] @ R
