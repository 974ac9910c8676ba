# SPDX-License-Identifier: Apache-2.0
"""The pose of known shapes under a true pinhole camera, from a start under weak perspective.

Weak perspective lets every point of a person be as far away as its middle. Of a person 2 m away that is 10 cm and more
of error, and of one seen from above a wrong slant. Orthographic-N-point gives the start, proven to be the best of its
kind; from there Levenberg's and Marquardt's steps lower the error that the pinhole camera sees.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_STEPS = 2  # they leave a tenth of a pixel and a millimetre of a person 1.5 m away, a third nothing
_DAMPING = 1e-4
_NEAREST = 0.05  # of the distance of a shape's origin: no point is taken to be nearer to the camera
_TINY = 1e-300


class PinholePose(NamedTuple):
    """Poses of N shapes: ``X = R @ S + T`` in shape units, seen at ``X[:2] / X[2]``.

    Attributes:
        R: (N,3,3) det +1, canonical frame to camera frame.
        T: (N,3) shape units.
        missed: (N,2,P) image points less what the poses give, normalised image units; nothing where hidden.
    """

    R: np.ndarray
    T: np.ndarray
    missed: np.ndarray


def refine(S: np.ndarray, W: np.ndarray, visible: np.ndarray, R: np.ndarray, T: np.ndarray) -> PinholePose:
    """The least squares poses near (R, T), or these themselves where no step lowers the error.

    Args:
        S: (N,3,P) shapes.
        W: (N,2,P) normalised image points (unit focal length); anything where hidden.
        visible: (N,P) bool.
        R, T: (N,3,3) and (N,3), the start.
    """
    W = np.where(visible[:, None], W, 0.0)
    with np.errstate(all="ignore"):  # of images that no camera gives; no step from them is better
        best, damping = _State.of(R, R @ S, T, W, visible), np.full((len(S), 1), _DAMPING)
        for _ in range(_STEPS):
            turn, shift = _step(best, damping)
            tried = _State.of(turn @ best.R, turn @ best.Y, best.T + shift, W, visible)
            better = tried.cost < best.cost
            damping *= np.where(better, 0.1, 10.0)[:, None]
            best = tried if better.all() else _State(*map(_choose(better), tried, best))
        return PinholePose(best.R, best.T, best.error)


class _State(NamedTuple):
    """Poses, turned shapes Y (N,3,P), their image (N,2,P), inverse depths (N,P), what is missed (N,2,P), its cost.

    Hidden points are infinitely far away, and so at the image's origin, where W has them too: they add nothing.
    """

    R: np.ndarray
    Y: np.ndarray
    T: np.ndarray
    image: np.ndarray
    inverse: np.ndarray
    error: np.ndarray
    cost: np.ndarray

    @classmethod
    def of(cls, R: np.ndarray, Y: np.ndarray, T: np.ndarray, W: np.ndarray, visible: np.ndarray) -> _State:
        X = Y + T[:, :, None]
        inverse = visible / np.maximum(X[:, 2], _NEAREST * T[:, 2:])
        image = X[:, :2] * inverse[:, None]
        error = W - image
        return cls(R, Y, T, image, inverse, error, (error * error).sum((1, 2)))


def _choose(better: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda yes, no: np.where(better.reshape(-1, *(1,) * (yes.ndim - 1)), yes, no)


def _step(pose: _State, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N,3,3) and shifts (N,3) of one damped Gauss-Newton step.

    A shift t and a turn about a move a point Y + T by t + a x Y, and its image (u, v), with d its inverse depth, by
    d times the first two parts of that less (u, v) times the third.
    """
    N, _, P = pose.Y.shape
    moved = (_TURNED @ pose.Y + _SHIFTED).reshape(N, 6, 3, P)
    J = (moved[:, :, :2] - pose.image[:, None] * moved[:, :, 2:]) * pose.inverse[:, None, None]
    J = J.reshape(N, 6, 2 * P)
    H = J @ J.transpose(0, 2, 1)
    diagonal = H.reshape(N, 36)[:, ::7]
    diagonal *= 1 + damping
    diagonal += _TINY
    step = np.linalg.solve(H, J @ pose.error.reshape(N, 2 * P, 1))[..., 0]
    return _rotation(step[:, 3:]), step[:, :3]


_CROSS = np.zeros((3, 3, 3))
_CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]], _CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0, -1.0
"""a @ _CROSS is the matrix that takes Y to a x Y."""
_SHIFTED, _TURNED = np.eye(6, 3).reshape(18, 1), np.vstack([np.zeros((9, 3)), _CROSS.reshape(9, 3)])
"""How unit shifts along and turns about the three axes move a point Y: by _SHIFTED + _TURNED @ Y, three parts each."""
_HALF_CROSS, _EYE = _CROSS.reshape(3, 9) / 2, np.eye(3)


def _rotation(a: np.ndarray) -> np.ndarray:
    """Cayley's rotations (N,3,3) about the vectors a (N,3), by their lengths up to the third order."""
    K = (a @ _HALF_CROSS).reshape(-1, 3, 3)
    return _EYE + (K + K @ K) * (2.0 / (1.0 + 0.25 * (a[:, None] @ a[:, :, None])))
