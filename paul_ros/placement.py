# SPDX-License-Identifier: Apache-2.0
"""From image to rays and from shape units to metres: what the camera's intrinsics add to an orthographic lift.

Weak perspective holds on the optical axis, and people stand beside it.  So each person is first seen by a virtual
camera turned towards it: the rays of its keypoints are rotated until the person's own direction is the optical axis.
Lifting happens there (``paul_ros.pinhole_pose`` adds what perspective is left); the result is rotated back.
With scale ``s`` (normalised image units per model unit) and ``m`` metres per model unit, similar triangles give the
distance ``m / s``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.keypoints import Intrinsics

_HALF_FIELD = 0.5  # cosine of 60 degrees
_EYE = np.eye(3)
_AXIS, _ABOUT_AXIS = _EYE[2], np.array([-1.0, -1.0, 1.0])  # half a turn about it, times the columns of a rotation


@dataclass(frozen=True)
class CentredView:
    """N persons as N virtual cameras see them, each turned to its person.

    Attributes:
        W: (N,2,P) normalised image points (unit focal length) in the virtual cameras; NaN where hidden, or farther than
            60 degrees from the person's direction: taken for a misdetection.
        seen: (N,P) bool, where W is a number.
        turn: (N,3,3) rotations from the virtual cameras to the real one.
    """

    W: np.ndarray
    seen: np.ndarray
    turn: np.ndarray


def centred_view(xy: np.ndarray, visible: np.ndarray, camera: Intrinsics) -> CentredView:
    """Turn a virtual camera towards every person.

    Args:
        xy: (N,P,2) pixels, rectified image; anything where hidden.
        visible: (N,P) bool, at least one point a person.
        camera: pinhole intrinsics in pixels.
    """
    rays = np.ones((len(xy), 3, xy.shape[1]))
    rays[:, 0], rays[:, 1] = (xy[..., 0] - camera.cx) / camera.fx, (xy[..., 1] - camera.cy) / camera.fy
    np.copyto(rays, 0.0, where=~visible[:, None])
    # Unit rays, so that one wild detection cannot turn the camera away from all the others.
    length = np.maximum(np.sqrt((rays * rays).sum(1, keepdims=True)), 1.0)
    towards = (rays / length).sum(2)
    turn = _turn_from_axis(towards / np.sqrt((towards * towards).sum(1, keepdims=True)))
    X = turn.transpose(0, 2, 1) @ rays
    # Of a hidden point all three are 0, which is not within the field.
    seen = X[:, 2:] > _HALF_FIELD * length
    W = np.full(X[:, :2].shape, np.nan)
    np.divide(X[:, :2], X[:, 2:], out=W, where=seen)
    return CentredView(W, seen[:, 0], turn)


def _turn_from_axis(direction: np.ndarray) -> np.ndarray:
    """Smallest rotations (N,3,3) that take the optical axis (0,0,1) to unit directions (N,3) with z > 0.

    Half a turn about the axis, then half a turn about the middle m between the two: ``2 m m^T - 1`` for m of length 1.
    """
    middle = direction + _AXIS
    about_middle = middle[:, :, None] * middle[:, None] / middle[:, 2:, None] - _EYE
    return about_middle * _ABOUT_AXIS


def place(shape: np.ndarray, turn: np.ndarray, metres_per_unit: np.ndarray | float) -> np.ndarray:
    """Put lifted shapes where the camera saw them.

    Args:
        shape: (N,3,P) model units, in the virtual camera's frame.
        turn: (N,3,3) virtual camera to real camera.
        metres_per_unit: size of the model unit, one or one a person.

    Returns:
        points (N,P,3) in metres in the real camera's optical frame (REP-103: z forward, x right, y down).
    """
    return np.reshape(metres_per_unit, (-1, 1, 1)) * (turn @ shape).transpose(0, 2, 1)
