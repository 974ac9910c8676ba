# SPDX-License-Identifier: Apache-2.0
"""Single-frame prediction by a model, and the rigid mean shape as its baseline. NumPy only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from paul_ros import metrics
from paul_ros.lifted import DEGENERATE_POINTS, TOO_FEW_POINTS
from paul_ros.model import Model
from paul_ros.orthographic_n_point import onp

MIN_POINTS = 4
"""Visible points that a frame must have to be judged: nearly any shape fits three points."""

_BLOCK = 256  # frames at a time
_MEAN_ROUNDS = 10
_MEAN_FRAMES = 1000

CountFrames = Callable[[int], object]
"""Function that is called with the number of frames done since its last call."""


@dataclass(frozen=True)
class Prediction:
    """3D shapes of F frames.

    Attributes:
        S: (F,3,P) float32, camera frame, units of W, centred on the mean of the visible points.
        dropped: (F,) short names of the reasons why there is no prediction; '' where there is one.
        certified: (F,) bool, the camera is the proven optimum; None if no camera was solved.
        ambiguity: (F,) from 0 to 1, see ``paul_ros.onp``; None if no camera was solved.
    """

    S: np.ndarray
    dropped: np.ndarray
    certified: np.ndarray | None = None
    ambiguity: np.ndarray | None = None


def predict(model: Model, W: np.ndarray, visible: np.ndarray, count: CountFrames = lambda number: None) -> Prediction:
    """Predict every frame alone: encoder, decoder, orthographic-N-point (the paper's section 4.2).

    The result has the observed scale.  A model of unit scale knows it.  Otherwise it is the camera's scale, so shapes
    are in image units; under an orthographic camera these are the units of the truth.  Visible points stay where the
    model puts them.

    Args:
        model: that predicts.
        W: (F,2,P) image points in any unit; in the training's unit for a model of unit scale.
        visible: (F,P) bool.
        count: called after each block of frames.
    """
    unit = model.header["image_unit"] if model.scale == "unit" else 1.0
    scale: Literal["free", "unit"] = "unit" if model.scale == "unit" else "free"
    S, dropped = np.zeros((len(W), 3, W.shape[2]), np.float32), np.full(len(W), "", object)
    certified, ambiguity = np.zeros(len(W), bool), np.zeros(len(W))
    for rows in blocks(np.arange(len(W))):
        shapes = model.shape(W[rows], visible[rows]).astype(float)
        pose = onp(shapes, W[rows] / unit, visible[rows], scale)
        S[rows] = unit * pose.scale[:, None, None] * centred(pose.R @ shapes, visible[rows])
        dropped[rows] = np.where(pose.determined, "", DEGENERATE_POINTS)
        certified[rows], ambiguity[rows] = pose.certified, pose.ambiguity
        count(len(shapes))
    dropped[visible.sum(1) < MIN_POINTS] = TOO_FEW_POINTS
    return Prediction(S, dropped, certified, ambiguity)


def predict_rigid(mean: np.ndarray, W: np.ndarray, visible: np.ndarray) -> Prediction:
    """Place a mean shape (3,P) before every camera, with the scale that fits best."""
    S, dropped = np.zeros((len(W), 3, W.shape[2]), np.float32), np.full(len(W), "", object)
    for rows in blocks(np.arange(len(W))):
        pose = onp(np.broadcast_to(mean, (len(rows), *mean.shape)), W[rows], visible[rows])
        S[rows] = pose.scale[:, None, None] * centred(pose.R @ mean, visible[rows])
        dropped[rows] = np.where(pose.determined, "", DEGENERATE_POINTS)
    return Prediction(S, dropped)


def rigid_mean(shapes: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the generalised Procrustes mean (3,P) of shapes, each scaled to rms size 1.

    Large sets are sampled.

    Args:
        shapes: (F,3,P) in their cameras' frames.
        rotations: (F,3,3) from the canonical to the camera frame; they give the first alignment.
    """
    rows = np.linspace(0, len(shapes) - 1, min(_MEAN_FRAMES, len(shapes))).astype(int)
    points = (rotations[rows].transpose(0, 2, 1) @ shapes[rows]).transpose(0, 2, 1).astype(float)
    points = points - points.mean(1, keepdims=True)
    points = points / np.sqrt((points**2).sum(2).mean(1))[:, None, None]
    mean = points.mean(0)
    for _ in range(_MEAN_ROUNDS):
        R, _ = metrics.procrustes(points, np.broadcast_to(mean, points.shape))
        mean = np.einsum("nij,npj->pi", R, points) / len(points)
    return mean.T


def centred(X: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Subtract the mean of the visible points (N,P) from points (N,D,P)."""
    seen = visible[:, None]
    return X - np.where(seen, X, 0.0).sum(2, keepdims=True) / np.maximum(seen.sum(2, keepdims=True), 1)


def blocks(rows: np.ndarray) -> list[np.ndarray]:
    """Split frame numbers into parts that fit into memory, even if frames have thousands of points."""
    return [rows[begin : begin + _BLOCK] for begin in range(0, len(rows), _BLOCK)]
