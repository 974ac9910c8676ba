# SPDX-License-Identifier: Apache-2.0
"""ai_msgs/PerceptionTargets (D-Robotics): pixels, with ids.

A target may be a person, a face, a hand or another object. Only its points of type body_kps can be lifted. The message
does not name the points: they have the detector's order, which the parameter `layout` states.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, WrongPointCount, no_persons, record

_BODY = "body_kps"


def read(msg: Any, points: int, _source: Source) -> Keypoints2D:
    """Read the targets that have body keypoints.

    Fields: targets[] with track_id and points[]. The points of type body_kps have point[] (x, y; z is ignored) and
    confidence[], which may be empty. A point at (0, 0) or (-1, -1) is missing.

    Raises:
        MessageError: wrong_point_count, wrong_confidence_count.
    """
    bodies = [(target, group) for target in msg.targets for group in target.points if group.type == _BODY]
    if not bodies:
        return no_persons(points, msg.header)
    xy = np.stack([_pixels(group, points) for _, group in bodies])
    confidence = np.stack([_confidence(group, points) for _, group in bodies])
    ids = tuple(str(int(target.track_id)) for target, _ in bodies)
    return record(xy, confidence, ids, msg.header)


def _pixels(group: Any, points: int) -> np.ndarray:
    count = len(group.point)
    if count != points:
        raise WrongPointCount(f"a body has {count} keypoints, the layout {points}", lambda other: other == count)
    return np.array([(point.x, point.y) for point in group.point], dtype=np.float64)


def _confidence(group: Any, points: int) -> np.ndarray:
    if len(group.confidence) == 0:
        return np.ones(points)
    if len(group.confidence) != points:
        raise MessageError(
            "wrong_confidence_count",
            f"a body has {points} keypoints and {len(group.confidence)} confidences; send one for each, or none",
        )
    return np.array(group.confidence, dtype=np.float64)
