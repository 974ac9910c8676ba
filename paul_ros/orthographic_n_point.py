# SPDX-License-Identifier: Apache-2.0
"""Orthographic-N-point: the rotation (and scale) that best project a known shape onto its 2D points.

The function ``onp`` minimises ``sum_j w_j |s R_xy S_j + t - W_j|^2`` over rotations R, translations t and, in the
free-scale problem, s > 0.

The page ``docs/explanation/onp.md`` reduces this to a smooth function on the sphere of viewing directions. It also
derives the proof of global optimality. The module ``paul_ros.viewing_sphere`` has the solver, and
``paul benchmark onp`` measures it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from paul_ros.errors import InputError
from paul_ros.viewing_goal import Scale
from paul_ros.viewing_sphere import solve

_LARGEST = 1e150  # its square is still a number
_EXACT = 1e-6  # share of the image's extent: costs are exact to 1e-16, so residuals, their roots, to about 1e-8


class OnP(NamedTuple):
    """Optimal poses of N shapes, with the strongest rival of each.

    ``W ~ scale * R[:, :2] @ S + translation``. Image units are those of W.

    Attributes:
        R: (N,3,3) rotations, canonical frame to camera frame (third axis along the view), det +1.
        scale: (N,) image units per shape unit (1 in the unit-scale problem).
        translation: (N,2) image units.
        residual: (N,) weighted root mean square distance to W, image units.
        certified: (N,) bool, the pose is proven to be the global optimum, up to rounding. No other pose lowers the
            mean squared distance by more than 1e-10 of the image's mean square about its mean. In the unit-scale
            problem this share refers to image and shape together. For shapes next to needles or balls and images
            next to lines, rounding makes it 1e-7.
        determined: (N,) bool, the points fix a pose; otherwise R is the identity and scale 0 (1 in the unit-scale
            problem). They fix none if fewer than three are given, if all are on one line, or if shape and image are
            uncorrelated. Extents must be at least 1e-12 of the distance from the origin, and from 1e-70 to 1e150.
            Coordinates and weights must be finite, and weights not negative.
        two_fold: (N,) bool, a second, depth-reversed optimum was found, and its viewing direction is more than 0.05
            radians from the first. At most 0.4 % of the existing ones are missed (docs/explanation/onp.md).
        R_mirror, scale_mirror, translation_mirror, residual_mirror: the second optimum; without one, the Necker
            reversal of the first (its reflection about the axis along which the shape is thinnest).
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

    def __repr__(self) -> str:
        """Return the counts; the arrays would fill the screen."""
        poses = f"{len(self.scale)} pose{'' if len(self.scale) == 1 else 's'}"
        certified, two_fold = int(self.certified.sum()), int(self.two_fold.sum())
        return f"OnP({poses}, {int(self.determined.sum())} determined, {certified} certified, {two_fold} two-fold)"

    @property
    def ambiguity(self) -> np.ndarray:
        """(N,) in 0..1, residual over that of the second optimum; 0 without a second optimum.

        At 1 the image cannot distinguish the two. Residuals below 1e-6 of the extent are rounding and count as equal.
        """
        rounding = np.where(self.two_fold, _EXACT * self.extent, 1.0)
        return np.where(self.two_fold, (self.residual + rounding) / (self.residual_mirror + rounding), 0.0)


def onp(S: np.ndarray, W: np.ndarray, weights: np.ndarray | None = None, scale: Scale = "free") -> OnP:
    """Solve N orthographic-N-point problems.

    Args:
        S: (N,3,P) shapes in their canonical frame.
        W: (N,2,P) image points, any unit.
        weights: (N,P) non-negative; bool visibility works. Points of weight 0 are ignored and may be NaN.
        scale: ``"free"`` solves for the scale of weak perspective, ``"unit"`` fixes it to 1.

    Returns:
        The optimum of every problem. It is never NaN; ``determined`` is False for degenerate input.

    Raises:
        InputError: the shapes of the arrays do not fit together, or there is no such scale.

    >>> import numpy as np
    >>> S = np.random.default_rng(0).standard_normal((1, 3, 8))
    >>> pose = onp(S, 5.0 * S[:, :2] + 100.0)
    >>> pose
    OnP(1 pose, 1 determined, 1 certified, 0 two-fold)
    >>> float(pose.scale[0].round(3)), pose.translation[0].round(3).tolist(), bool(pose.certified[0])
    (5.0, [100.0, 100.0], True)
    """
    # Reduce all points to their weighted means and second moments.
    points = _Points.of(*_checked(S, W, weights))
    # Find the best viewing direction and its rival on the sphere.
    poses = solve(points.moments, points.mean, scale)
    # Measure both poses on the points themselves.
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
        residual_mirror=np.maximum(residual[:, 1], residual[:, 0]),  # rounding may break a tie either way
        extent=poses.extent,
    )


def _checked(
    S: np.ndarray, W: np.ndarray, weights: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    try:
        S, W = np.asarray(S, float), np.asarray(W, float)
        weights = weights if weights is None else np.asarray(weights, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"onp needs arrays of numbers: {error}") from None
    if S.ndim != 3 or S.shape[1] != 3 or W.shape != (S.shape[0], 2, S.shape[2]):
        raise InputError(f"onp needs S (N,3,P) and W (N,2,P), got {S.shape} and {W.shape}")
    if weights is not None and weights.shape != (S.shape[0], S.shape[2]):
        raise InputError(f"onp needs weights (N,P) = {(S.shape[0], S.shape[2])}, got {weights.shape}")
    return S, W, weights


class _Points(NamedTuple):
    """Shapes and image points of N problems as 5-vectors about their mean, with second moments.

    Problems with a negative weight, or a number that is not finite, are all zeros.

    Attributes:
        X: (N,5,P) shape x, y, z, image x, y.
        w: (N,P) weights of sum 1.
        mean: (N,5) weighted means.
        moments: (N,5,5) weighted second moments about the mean.
    """

    X: np.ndarray
    w: np.ndarray
    mean: np.ndarray
    moments: np.ndarray

    @classmethod
    def of(cls, S: np.ndarray, W: np.ndarray, weights: np.ndarray | None) -> _Points:
        X = np.concatenate([S, W], axis=1)
        N, _, P = X.shape
        with np.errstate(all="ignore"):  # overflows and NaN show in the moments, which are checked below
            if weights is None:
                w, sound = np.full((N, P), 1.0 / max(P, 1)), np.ones(N, bool)
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
        """Return weighted root mean square distances (N,2) under two cameras per problem (N,2,2,3)."""
        N, P = self.w.shape
        error = (camera.reshape(N, 4, 3) @ self.X[:, :3]).reshape(N, 2, 2, P) - self.X[:, None, 3:]
        square = (error * error).reshape(N, 4, P) @ self.w[..., None]
        return np.sqrt(square[:, ::2, 0] + square[:, 1::2, 0])
