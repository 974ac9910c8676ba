# SPDX-License-Identifier: Apache-2.0
"""Body axes of lifted persons (REP-155: x out of the chest, y to the left, z to the head), as quaternions.

Hips and shoulders with their usual names define the axes. Without them, the layout's first rule of handedness defines
left and up, and left x up = forward gives the rest. A layout without either, for instance of an object without a
chest, gets the rotation of the model's canonical frame, which is the same for all poses of one shape.
"""

from __future__ import annotations

import numpy as np

from paul_ros.layout import Layout

_CORNERS = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
_LEAST_SINE = 1e-6  # of the angle between left and up; below it they fix no plane


def left_and_up(layout: Layout) -> np.ndarray | None:
    """Return weights (2,P) of points: ``weights @ points`` is a vector to the left and one up.

    Returns:
        None if the layout defines neither.
    """
    left: tuple[int, ...]
    right: tuple[int, ...]
    below: tuple[int, ...]
    above: tuple[int, ...]
    place = {name: index for index, name in enumerate(layout.names)}
    if set(_CORNERS) <= set(place):
        left_hip, right_hip, left_shoulder, right_shoulder = (place[name] for name in _CORNERS)
        left, right = (left_hip, left_shoulder), (right_hip, right_shoulder)
        below, above = (left_hip, right_hip), (left_shoulder, right_shoulder)
    elif layout.handedness:
        rule = layout.handedness[0]
        left, right, below, above = rule.left, rule.right, rule.below, rule.above
    else:
        return None
    measures = np.zeros((2, len(layout.names)))
    for row, sign, points in ((0, 1, left), (0, -1, right), (1, 1, above), (1, -1, below)):
        measures[row, list(points)] += sign / len(points)
    return measures


def body_rotations(points: np.ndarray, rotation: np.ndarray, measures: np.ndarray | None) -> np.ndarray:
    """Return rotations (N,3,3) from body axes to the camera frame.

    Args:
        points: (N,P,3) lifted points, camera frame.
        rotation: (N,3,3) canonical frame to camera frame, the fallback where points or layout fix no axes.
        measures: (2,P) weights from ``left_and_up`` for the layout of the points.
    """
    if measures is None:
        return rotation
    y, z = (measures @ points).transpose(1, 0, 2)
    x = _cross(y, z)
    lengths = np.sqrt([(axis * axis).sum(1) for axis in (x, y, z)])[..., None]
    fixed = lengths[0] > _LEAST_SINE * lengths[1] * lengths[2]
    x, z = x / np.where(fixed, lengths[0], 1.0), z / np.where(fixed, lengths[2], 1.0)
    return np.where(fixed[:, :, None], np.stack([x, _cross(z, x), z], axis=2), rotation)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return cross products of vectors (N,3); for a few vectors numpy's own takes ten times as long."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def quaternions(R: np.ndarray) -> np.ndarray:
    """Return unit quaternions (N,4), in order x, y, z, w with w >= 0, of rotations (N,3,3).

    Four times the outer product of a quaternion with itself is linear in the rotation. Its largest row is the
    quaternion up to length and sign.

    >>> import numpy as np
    >>> quaternions(np.eye(3)[None]).tolist()
    [[0.0, 0.0, 0.0, 1.0]]
    """
    (a, b, c), (d, e, f), (g, h, i) = R.transpose(1, 2, 0)
    square = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    rows = square.transpose(2, 0, 1)
    best = np.einsum("nii->ni", rows).argmax(1)
    q = rows[np.arange(len(R)), best]
    return q / np.linalg.norm(q, axis=1, keepdims=True) * np.where(q[:, 3:] < 0, -1.0, 1.0)


class ContinuousSigns:
    """Signs of quaternions that are continuous from frame to frame.

    q and -q are the same attitude, and every rule for single frames jumps between them somewhere. Here the quaternion
    of a tracked person has the sign nearer to the previous frame's. Without an id, or if the person was not in the
    previous frame, w >= 0.
    """

    def __init__(self) -> None:
        self._last: dict[str, np.ndarray] = {}

    def __call__(self, ids: tuple[str, ...], q: np.ndarray) -> np.ndarray:
        """Return quaternions (N,4) of the persons of the next frame with continuous signs; NaN rows stay NaN.

        Args:
            ids: N person ids, '' where unknown.
            q: (N,4) quaternions of either sign.
        """
        q = np.array([-row if self._is_opposite(name, row) else row for name, row in zip(ids, q)]).reshape(-1, 4)
        self._last = {name: row for name, row in zip(ids, q) if name and np.isfinite(row).all()}
        return q

    def _is_opposite(self, name: str, row: np.ndarray) -> bool:
        return name in self._last and float(self._last[name] @ row) < 0
