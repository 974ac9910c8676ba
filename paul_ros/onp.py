# SPDX-License-Identifier: Apache-2.0
"""Orthographic-N-point: the rotation (and scale) that best project a known shape onto its 2D points.

Minimise ``sum_j w_j |s R_xy S_j + t - W_j|^2`` over rotations R, translation t and, in the free-scale problem, s > 0.
``docs/onp.md`` derives how this comes down to a smooth function on the sphere of viewing directions, and what proves
an answer to be the best of all; ``paul_ros.viewing_sphere`` solves that, ``paul benchmark onp`` measures it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from paul_ros.viewing_sphere import Scale, solve

_LARGEST = 1e150  # its square is still a number
_EXACT = 1e-6  # of the image's extent: costs are exact to 1e-16, residuals, their roots, to some 1e-8


class OnP(NamedTuple):
    """Optimal poses of N shapes, with the pose that competes with each.

    ``W ~ scale * R[:, :2] @ S + translation``; what is measured in the image has the unit of W.

    Attributes:
        R: (N,3,3) rotations, canonical frame to camera frame (third axis along the view), det +1.
        scale: (N,) image units per shape unit (1 in the unit-scale problem).
        translation: (N,2) image units.
        residual: (N,) weighted root mean square distance to W, image units.
        certified: (N,) bool, the pose is proven to be the global optimum, up to rounding: no other has a mean of
            squared distances smaller by more than 1e-10 of the image's mean square about its mean (in the unit-scale
            problem, of the image's and the shape's together). Where shapes are next to needles or balls and images
            next to lines, rounding makes 1e-7 of that.
        determined: (N,) bool, False where the points fix no pose: fewer than three, all on one line, an image
            without correlation to the shape, shape or image without extent (less than 1e-12 of its distance from the
            origin, or 1e-70) or beyond 1e150, a coordinate or weight that is no number, a negative weight. R is then
            the identity and scale 0 (1 in the unit-scale problem).
        two_fold: (N,) bool, a second optimum was found, the depth reversed, its viewing direction more than 0.05
            radians from the first's; at most 0.4 % of those that exist are not found (docs/onp.md).
        R_mirror, scale_mirror, translation_mirror, residual_mirror: that second optimum; where there is none, the
            Necker reversal of the first (reflected about the axis along which the shape is thinnest).
        extent: (N,) weighted root mean square distance of the image points from their mean, image units.
    """

    R: np.ndarray
    scale: np.ndarray
    translation: np.ndarray
    residual: np.ndarray
    certified: np.ndarray
    determined: np.ndarray
    two_fold: np.ndarray
    R_mirror: np.ndarray
    scale_mirror: np.ndarray
    translation_mirror: np.ndarray
    residual_mirror: np.ndarray
    extent: np.ndarray

    @property
    def ambiguity(self) -> np.ndarray:
        """(N,) in 0..1, residual over that of the second optimum: at 1 the image cannot tell the two apart.

        0 where there is no second optimum. Residuals below ``_EXACT`` of the extent are rounding and count as equal.
        """
        rounding = np.where(self.two_fold, _EXACT * self.extent, 1.0)
        return np.where(self.two_fold, (self.residual + rounding) / (self.residual_mirror + rounding), 0.0)


def onp(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None = None, scale: Scale = "free") -> OnP:
    """Solve N orthographic-N-point problems.

    Args:
        S: (N,3,P) shapes in their canonical frame.
        W: (N,2,P) image points, any unit.
        weights: (N,P) non-negative; bool visibility works. Points of weight 0 are ignored, NaN or not.
        scale: ``"free"`` solves for the scale of weak perspective, ``"unit"`` fixes it to 1.

    Returns:
        The optimum of every problem; degenerate input is flagged in ``determined``, never NaN.

    Raises:
        ValueError: the shapes of the arrays do not fit together, or there is no such scale.
    """
    points = _Points.of(*_checked(S, W, weights))
    poses = solve(points.moments, points.mean, scale)
    camera = poses.scale[..., None, None] * poses.R[:, :, :2]
    residual = points.residuals(camera)
    return OnP(
        R=poses.R[:, 0],
        scale=poses.scale[:, 0],
        translation=poses.translation[:, 0],
        residual=residual[:, 0],
        certified=poses.certified,
        determined=poses.determined,
        two_fold=poses.two_fold,
        R_mirror=poses.R[:, 1],
        scale_mirror=poses.scale[:, 1],
        translation_mirror=poses.translation[:, 1],
        residual_mirror=np.maximum(residual[:, 1], residual[:, 0]),  # a tie may fall either way by rounding
        extent=poses.extent,
    )


def _checked(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None) -> tuple:
    S, W = np.asarray(S, float), np.asarray(W, float)
    if S.ndim != 3 or S.shape[1] != 3 or W.shape != (S.shape[0], 2, S.shape[2]):
        raise ValueError(f"onp needs S (N,3,P) and W (N,2,P), got {S.shape} and {W.shape}")
    if weights is not None:
        weights = np.asarray(weights, float)
        if weights.shape != (S.shape[0], S.shape[2]):
            raise ValueError(f"onp needs weights (N,P) = {(S.shape[0], S.shape[2])}, got {weights.shape}")
    return S, W, weights


class _Points(NamedTuple):
    """Shapes and image points of N problems as one set of 5-vectors about their mean, and its second moments.

    Problems with a number that is none, or a negative weight, are all zeros.
    """

    X: np.ndarray  # (N,5,P)
    w: np.ndarray  # (N,P) of sum 1
    mean: np.ndarray  # (N,5)
    moments: np.ndarray  # (N,5,5)

    @classmethod
    def of(cls, S: np.ndarray, W: np.ndarray, weights: np.ndarray | None) -> _Points:
        X = np.concatenate([S, W], axis=1)
        N, _, P = X.shape
        with np.errstate(all="ignore"):  # what overflows or is no number shows in the moments
            if weights is None:
                w, sound = np.full((N, P), 1.0 / max(P, 1)), True
            else:
                np.copyto(X, 0.0, where=(weights == 0)[:, None])
                sound = weights.min(1, initial=0.0) >= 0
                w = weights / weights.sum(1, keepdims=True)
            mean = (X @ w[..., None])[..., 0]
            X -= mean[..., None]
            moments = (X * w[:, None]) @ X.transpose(0, 2, 1)
            sound &= np.einsum("nii->n", moments) < _LARGEST**2
        if not sound.all():
            for part in (X, w, mean, moments):
                part[~sound] = 0.0
        return cls(X, w, mean, moments)

    def residuals(self, camera: np.ndarray) -> np.ndarray:
        """(N,2) weighted root mean square distances under two cameras (N,2,2,3) a problem."""
        N, P = self.w.shape
        error = (camera.reshape(N, 4, 3) @ self.X[:, :3]).reshape(N, 2, 2, P) - self.X[:, None, 3:]
        square = (error * error).reshape(N, 4, P) @ self.w[..., None]
        return np.sqrt(square[:, ::2, 0] + square[:, 1::2, 0])
