# SPDX-License-Identifier: Apache-2.0
"""The fit of the model's shapes to image points: encode, decode, pose; once more without misdetections."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from paul_ros.model import Model, RigidModel
from paul_ros.normalisation import enough_visible
from paul_ros.orthographic_n_point import onp
from paul_ros.pinhole_pose import refine

_WILD_MEDIANS, _WILD_EXTENT = 3.0, 0.35
"""Limits of misses, in medians of the person's points and as a share of the person's extent (about 11 % of the
height). A point that exceeds both is a misdetection."""


class ShapeFit(NamedTuple):
    """N shapes and their poses, in model units.

    Attributes:
        S: (N,3,P) shapes in the canonical frame.
        R: (N,3,3) rotations, canonical frame to camera frame.
        T: (N,3) translations; T[2] is the inverse of the scale.
        missed: (N,2,P) image points minus projected points; 0 where not used.
        square: (N,P) squared lengths of ``missed``.
        residual: (N,) rms length of ``missed`` over the points used.
        used: (N,P) bool, the points that the fit uses.
        fixed: (N,) bool, the points fix a pose.
        ambiguity: (N,) 0..1, see ``OnP``.
        certified: (N,) bool, see ``OnP``.
        extent: (N,) rms distance of the image points from their mean.
    """

    S: np.ndarray
    R: np.ndarray
    T: np.ndarray
    missed: np.ndarray
    square: np.ndarray
    residual: np.ndarray
    used: np.ndarray
    fixed: np.ndarray
    ambiguity: np.ndarray
    certified: np.ndarray
    extent: np.ndarray


def fit_shapes(model: Model, W: np.ndarray, visible: np.ndarray, pinhole: bool) -> ShapeFit:
    """Fit the model's shapes to image points, and again without misdetections if enough points remain.

    Args:
        model: a model of free scale.
        W: (N,2,P) image points: normalised ones of a pinhole camera, or any under weak perspective.
        visible: (N,P) bool.
        pinhole: whether W are points of a pinhole camera, so that the poses are refined under it.
    """
    fit = _fit(model, W, visible, pinhole)
    if isinstance(model, RigidModel):
        return fit  # large misses are the mean shape's own error
    wild = _misdetections(fit)
    if not wild.any():
        return fit
    sure = visible & ~wild
    again = np.flatnonzero(wild.any(1) & enough_visible(sure, model.layout))
    if not len(again):
        return fit
    second = _fit(model, W[again], sure[again], pinhole)
    for value, new in zip(fit, second):
        value[again] = new
    return fit


def _fit(model: Model, W: np.ndarray, visible: np.ndarray, pinhole: bool) -> ShapeFit:
    # Encode the image points and decode the codes: S = f_d(h(W, M)).
    S = model.shape(W, visible).astype(float)
    # Solve for the pose under weak perspective.
    pose = onp(S, W, visible)
    fixed = pose.determined & (pose.scale > 0)
    scale = np.where(fixed, pose.scale, 1.0)[:, None]
    R, T = pose.R, np.concatenate([pose.translation, np.ones_like(scale)], axis=1) / scale
    # Refine it under the pinhole camera.
    if pinhole:
        R, T, missed = refine(S, W, visible, R, T)
    else:
        missed = np.where(visible[:, None], W - scale[..., None] * (R[:, :2] @ S + T[:, :2, None]), 0.0)
    square = (missed * missed).sum(1)
    residual = np.sqrt(square.sum(1) / np.maximum(visible.sum(1), 1))
    used, certified = visible.copy(), pose.certified.copy()
    return ShapeFit(S, R, T, missed, square, residual, used, fixed, pose.ambiguity, certified, pose.extent)


def _misdetections(fit: ShapeFit) -> np.ndarray:
    """Return (N,P) bool, the points used that miss the fitted shape so far that a detector must be wrong."""
    wild = fit.square > (_WILD_EXTENT * fit.extent)[:, None] ** 2
    if wild.any():
        middle = np.maximum(fit.used.sum(1, keepdims=True) - 1, 0) // 2
        median = np.take_along_axis(np.sort(np.where(fit.used, fit.square, np.inf), axis=1), middle, axis=1)
        wild &= fit.square > _WILD_MEDIANS**2 * median
    return wild
