# SPDX-License-Identifier: Apache-2.0
"""Rival solvers of the orthographic-N-point problem, each as fast as plain batched numpy allows.

All have the signature `method(S (N,3,P), W (N,2,P), weights (N,P) or None, scale) -> Pose`, where `scale` is 'free' or
'unit'. A point of weight 0 is hidden, but its coordinates must be finite. No method flags degenerate input. Nothing is
shared with `paul_ros.onp`, which is compared with these.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

_TINY = 1e-300
_RIDGE = 1e-14
_RANK_ONE = 1e-12  # least second singular value of a 2x3 matrix with a polar factor, over the first
_PLANAR = 1e-10  # largest third eigenvalue of A of a planar shape, over the first
_TILT = np.array([[0.8, 0.48, -0.36], [0.0, 0.6, 0.8], [0.6, -0.64, 0.48]])  # a turn away from all axes


class Pose(NamedTuple):
    """Poses of N problems: W ~ scale * R[:, :2] @ S + translation.

    Attributes:
        R: (N,3,3) rotations, canonical frame to camera frame, det +1.
        scale: (N,) image units per shape unit, 1 in the unit-scale problem.
        translation: (N,2) image units.
        residual: (N,) weighted root mean square distance, image units.
    """

    R: np.ndarray
    scale: np.ndarray
    translation: np.ndarray
    residual: np.ndarray


class Centred(NamedTuple):
    """N problems about their weighted means, with their moments.

    Attributes:
        S: (N,3,P) shapes.
        W: (N,2,P) image points.
        w: (N,P) weights of sum 1.
        S_mean: (N,3,1) mean that was taken from S.
        W_mean: (N,2,1) mean that was taken from W.
        A: (N,3,3) moments S w S^T.
        B: (N,2,3) moments W w S^T.
    """

    S: np.ndarray
    W: np.ndarray
    w: np.ndarray
    S_mean: np.ndarray
    W_mean: np.ndarray
    A: np.ndarray
    B: np.ndarray


def centred(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None) -> Centred:
    """Return problems about their means, with which every method begins."""
    S, W = np.asarray(S, float), np.asarray(W, float)
    w = np.ones((len(S), S.shape[2])) if weights is None else np.asarray(weights, float)
    w = w / w.sum(1, keepdims=True)
    S_mean, W_mean = S @ w[..., None], W @ w[..., None]
    S, W = S - S_mean, W - W_mean
    Sw = (S * w[:, None]).transpose(0, 2, 1)
    return Centred(S, W, w, S_mean, W_mean, S @ Sw, W @ Sw)


def pose(Q: np.ndarray, scale: np.ndarray, points: Centred) -> Pose:
    """Return the poses of rotations given by their first two rows Q (N,2,3), with the best translations."""
    x, y = Q[:, 0], Q[:, 1]
    z = x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - x[:, [2, 0, 1]] * y[:, [1, 2, 0]]
    camera = scale[:, None, None] * Q
    error = camera @ points.S - points.W
    residual = np.sqrt(((error * error) @ points.w[..., None]).sum((1, 2)))
    translation = (points.W_mean - camera @ points.S_mean)[..., 0]
    return Pose(np.concatenate([Q, z[:, None]], 1), scale, translation, residual)


def best_scale(Q: np.ndarray, points: Centred, scale: str) -> tuple[np.ndarray, np.ndarray]:
    """Return Q and its least-squares scale (N,); Q is turned by 180 degrees in the image where that is negative."""
    if scale == "unit":
        return Q, np.ones(len(Q))
    along, power = (Q * points.B).sum((1, 2)), ((Q @ points.A) * Q).sum((1, 2))
    return np.where(along < 0, -1.0, 1.0)[:, None, None] * Q, abs(along) / (power + _TINY)


def _affine(points: Centred) -> np.ndarray:
    """Return least-squares affine cameras M = W S^+ (N,2,3).

    A flat shape in a plane of its axes has many; the smallest is returned. An oblique flat shape is flat only up to
    rounding, and so is its camera.
    """
    B = points.B.transpose(0, 2, 1)
    try:
        return np.linalg.solve(points.A, B).transpose(0, 2, 1)
    except np.linalg.LinAlgError:  # faster than a pseudo-inverse, and as good where a row of A is zero
        ridge = _RIDGE * points.A.trace(axis1=1, axis2=2)[:, None, None] * np.eye(3)
        return np.linalg.solve(points.A + ridge, B).transpose(0, 2, 1)


def _lsq_svd(points: Centred) -> tuple[np.ndarray, np.ndarray]:
    U, singular, Vt = np.linalg.svd(_affine(points), full_matrices=False)
    return U @ Vt, singular


def lsq_svd(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None, scale: str) -> Pose:
    """Solve by least squares, then SVD: the algebraic solver of PAUL (Wang and Lucey, CVPR 2021, section 4).

    The singular values of the least-squares affine camera are set to one, in the free-scale problem to their mean.
    """
    points = centred(S, W, weights)
    Q, singular = _lsq_svd(points)
    return pose(Q, singular.mean(1) if scale == "free" else np.ones(len(Q)), points)


def polar(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None, scale: str) -> Pose:
    """Solve by an affine fit for the viewing direction and a polar factor for the rest.

    The viewing direction n is normal to the rows of the affine camera. The best pose that looks along n is the polar
    factor of B (I - n n^T): orthogonal Procrustes (Schoenemann, Psychometrika 1966) in the plane across n. The scale
    is that of least squares. We know no stronger closed form of its kind. The polar factor of the affine camera itself
    is `lsq_svd`, and Gram-Schmidt (QR) of its rows is worse than that at every noise.
    """
    points = centred(S, W, weights)
    x, y = _affine(points).transpose(1, 2, 0)
    n = np.stack([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])
    n /= np.sqrt((n * n).sum(0)) + _TINY
    B = points.B.transpose(1, 2, 0)
    Q = _polar_factor(B - (B * n).sum(1, keepdims=True) * n, np.stack([x, y])).transpose(2, 0, 1)
    return pose(*best_scale(Q, points, scale), points)


def majorise(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None, scale: str, steps: int = 200) -> Pose:
    """Solve by majorisation from the pose of `lsq_svd`, 200 steps by default.

    With alpha the largest eigenvalue of A, the step Q <- polar factor of B - Q (A - alpha I) never raises the cost.
    Sources: Kiers (Psychometrika 1990), ten Berge (Least squares optimization in multivariate analysis, 1993). In the
    free-scale problem, Q and its least-squares scale are updated in turns. The `lsq_svd` of a planar shape looks
    straight at it, where no step moves it, so it is tilted first.
    """
    points = centred(S, W, weights)
    Q = _lsq_svd(points)[0]
    a, axes = np.linalg.eigh(points.A)
    Q = np.where((a[:, 0] < _PLANAR * a[:, 2])[:, None, None], Q @ (axes @ _TILT @ axes.transpose(0, 2, 1)), Q)
    Q, _ = best_scale(Q, points, scale)
    to_axes = (part @ axes for part in (points.B, Q))
    B, Q = (np.ascontiguousarray(part.transpose(1, 2, 0)) for part in to_axes)
    Q = majorised(a.T.copy(), B, Q, scale, steps).transpose(2, 0, 1) @ axes.transpose(0, 2, 1)
    U, _, Vt = np.linalg.svd(Q, full_matrices=False)  # rounding has made the rows oblique
    return pose(*best_scale(U @ Vt, points, scale), points)


def majorised(a: np.ndarray, B: np.ndarray, Q: np.ndarray, scale: str, steps: int) -> np.ndarray:
    """Return Q (2,3,N) after some steps; Q and B (2,3,N) are in the axes of A, whose eigenvalues are a (3,N)."""
    gap = a.max(0) - a
    for _ in range(steps):
        pull = gap
        if scale == "free":
            pull = gap * ((Q * B).sum((0, 1)) / ((Q * Q).sum(0) * a).sum(0))
        Q = _polar_factor(B + pull * Q, Q)
    return Q


def _polar_factor(M: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return (M M^T)^(-1/2) M of M (2,3,N) in closed form, and `otherwise` where M lacks full rank.

    The square root of the 2x2 matrix G = M M^T is (G + sqrt(det G)) / sqrt(tr G + 2 sqrt(det G)).
    """
    x, y = M
    g, h, c = (x * x).sum(0), (y * y).sum(0), (x * y).sum(0)
    trace, root = g + h, np.sqrt(np.maximum(g * h - c * c, 0.0))
    flat = root <= _RANK_ONE * trace
    over = 1.0 / (np.sqrt(trace + 2 * root) * root + flat)
    Q = np.stack([((h + root) * x - c * y) * over, ((g + root) * y - c * x) * over])
    return np.where(flat, otherwise, Q) if flat.any() else Q


def lm_search(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None, scale: str, starts: int = 8) -> Pose:
    """Solve by Levenberg-Marquardt from spread rotations (MINPACK, by `scipy.optimize.least_squares`); keep the best.

    The unknowns are a rotation vector and, in the free-scale problem, the logarithm of the scale. The scale starts at
    the ratio of the points' sizes. The Jacobian is analytic, and centring removes the translation.
    """
    points = centred(S, W, weights)
    first = [_rotation_vector(q) for q in _spread_quaternions(starts)]
    found = [_lm(*row, first, scale) for row in zip(points.S, points.W, np.sqrt(points.w))]
    Q, zoom = (np.array(part) for part in zip(*found))
    return pose(Q, zoom, points)


def _lm(S: np.ndarray, W: np.ndarray, root_w: np.ndarray, starts: list, scale: str) -> tuple[np.ndarray, float]:
    from scipy.optimize import least_squares

    seen = root_w > 0
    S, W = (S * root_w)[:, seen], (W * root_w)[:, seen]
    tail = [math.log(np.linalg.norm(W) / np.linalg.norm(S))] if scale == "free" else []

    def error(x: np.ndarray) -> np.ndarray:
        zoom = math.exp(x[3]) if tail else 1.0
        return (zoom * (_rotation(x)[0][:2] @ S) - W).ravel()

    def jacobian(x: np.ndarray) -> np.ndarray:
        zoom = math.exp(x[3]) if tail else 1.0
        R, J = _rotation(x)
        X, Y, Z = zoom * (R @ S)
        nought = np.zeros_like(X)
        turns = np.array([[nought, Z, -Y], [-Z, nought, X]])  # of x and y by turns about the camera's axes
        columns = np.einsum("ckp,kl->cpl", turns, J).reshape(-1, 3)
        return np.column_stack([columns, np.concatenate([X, Y])]) if tail else columns

    answers = (least_squares(error, [*start, *tail], jacobian, method="lm") for start in starts)
    best = min(answers, key=lambda answer: answer.cost)
    return _rotation(best.x)[0][:2], math.exp(best.x[3]) if tail else 1.0


def _rotation(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (3,3) of a rotation vector, and its left Jacobian J: exp(x + dx) = exp(J dx) exp(x)."""
    a, b, c = x[:3].tolist()
    square = a * a + b * b + c * c
    angle = math.sqrt(square)
    if angle < 1e-4:
        first, second, third = 1 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120
    else:
        first, second = math.sin(angle) / angle, (1 - math.cos(angle)) / square
        third = (1 - first) / square
    K = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    KK = K @ K
    return np.eye(3) + first * K + second * KK, np.eye(3) + second * K + third * KK


def spread_rotations(count: int) -> np.ndarray:
    """Return rotations (count,3,3), spread nearly evenly over all rotations."""
    return np.array([_rotation(_rotation_vector(q))[0] for q in _spread_quaternions(count)])


def _spread_quaternions(count: int) -> np.ndarray:
    """Return unit quaternions x, y, z, w (count,4) on super-Fibonacci spirals (Alexa, CVPR 2022)."""
    i = np.arange(count) + 0.5
    near, far = np.sqrt(i / count), np.sqrt(1 - i / count)
    one, two = 2 * np.pi * i / math.sqrt(2), 2 * np.pi * i / 1.533751168755204288118041
    return np.stack([near * np.sin(one), near * np.cos(one), far * np.sin(two), far * np.cos(two)], axis=1)


def _rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    axis, w = quaternion[:3], quaternion[3]
    length = np.linalg.norm(axis)
    return axis * (2 * math.atan2(length, w) / length)
