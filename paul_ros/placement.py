# SPDX-License-Identifier: Apache-2.0
"""Placement: from pixels to rays, and from shape units to metres in the camera frame.

Weak perspective is exact on the optical axis only, but people stand beside it. So a virtual camera is turned towards
each person: the rays of the keypoints are rotated until the person's direction is the optical axis. The person is
lifted there (``paul_ros.pinhole_pose`` adds the remaining perspective), and the result is rotated back. With scale
``s`` (normalised image units per model unit) and ``m`` metres per model unit, similar triangles give the distance
``m / s``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.intrinsics import Intrinsics

_HALF_FIELD = 0.5  # cosine of 60 degrees: a point farther from the person's direction is a misdetection
_EYE = np.eye(3)
_AXIS = _EYE[2]
_ABOUT_AXIS = np.array([-1.0, -1.0, 1.0])  # half a turn about the axis, if it multiplies the columns of a rotation


@dataclass(frozen=True)
class CentredView:
    """N persons in the images of N virtual cameras, each turned towards its person.

    Attributes:
        W: (N,2,P) normalised image points (unit focal length) of the virtual cameras; NaN where not seen.
        seen: (N,P) bool, visible and at most 60 degrees from the person's direction; farther points are
            misdetections.
        turn: (N,3,3) rotations from the virtual cameras to the real one.
    """

    W: np.ndarray
    seen: np.ndarray
    turn: np.ndarray


def centred_view(xy: np.ndarray, visible: np.ndarray, camera: Intrinsics) -> CentredView:
    """Turn a virtual camera towards every person.

    Args:
        xy: (N,P,2) pixels of the rectified image; any value where hidden.
        visible: (N,P) bool, at least one point per person.
        camera: pinhole intrinsics in pixels.
    """
    rays = np.ones((len(xy), 3, xy.shape[1]))
    rays[:, 0], rays[:, 1] = (xy[..., 0] - camera.cx) / camera.fx, (xy[..., 1] - camera.cy) / camera.fy
    np.copyto(rays, 0.0, where=~visible[:, None])
    # Unit rays: one wild detection must not turn the camera away from all other points.
    length = np.maximum(np.sqrt((rays * rays).sum(1, keepdims=True)), 1.0)
    towards = (rays / length).sum(2)
    turn = _turn_from_axis(towards / np.sqrt((towards * towards).sum(1, keepdims=True)))
    X = turn.transpose(0, 2, 1) @ rays
    # The ray of a hidden point is zero, and so outside the field.
    seen = X[:, 2:] > _HALF_FIELD * length
    W = np.full(X[:, :2].shape, np.nan)
    np.divide(X[:, :2], X[:, 2:], out=W, where=seen)
    return CentredView(W, seen[:, 0], turn)


def _turn_from_axis(direction: np.ndarray) -> np.ndarray:
    """Return the smallest rotations (N,3,3) that take the optical axis (0,0,1) to unit directions (N,3) with z > 0.

    They are half a turn about the axis, then half a turn about the unit bisector m of axis and direction:
    ``2 m m^T - 1``.
    """
    middle = direction + _AXIS
    about_middle = middle[:, :, None] * middle[:, None] / middle[:, 2:, None] - _EYE
    return about_middle * _ABOUT_AXIS


def place(shape: np.ndarray, view: CentredView, unit: np.ndarray | float) -> np.ndarray:
    """Turn shapes from the frames of their virtual cameras to the real camera's frame, and scale them.

    Args:
        shape: (N,3,P) model units, in the frames of the virtual cameras.
        view: the virtual cameras.
        unit: wanted length of a model unit, one number, or one per person (N,): metres, or 1 for model units.

    Returns:
        Points (N,P,3) in the real camera's optical frame (REP-103: z forward, x right, y down).
    """
    return np.reshape(unit, (-1, 1, 1)) * (view.turn @ shape).transpose(0, 2, 1)
