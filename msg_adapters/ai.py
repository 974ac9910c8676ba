# SPDX-License-Identifier: Apache-2.0
"""ai_msgs/PerceptionTargets (D-Robotics): pixels, with ids.

A target may be a person, a face, a hand or a thing; what can be lifted are the points of type body_kps. Their
order is the detector's, which the message does not tell: the parameter `layout` does.
"""

from __future__ import annotations

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, WrongPointCount, nobody, record

_BODY = "body_kps"


def read(msg, points: int, _source: Source) -> Keypoints2D:
    """Reads the targets that have body keypoints as persons of a layout with `points` keypoints.

    Fields: targets[] with track_id and points[], of those type, point[] (x, y; z is not used) and confidence[], which
    may be empty. (0, 0) is missing. Raises MessageError: wrong_point_count, wrong_confidence_count.
    """
    bodies = [(target, group) for target in msg.targets for group in target.points if group.type == _BODY]
    if not bodies:
        return nobody(points, msg.header)
    xy = np.stack([_pixels(group, points) for _, group in bodies])
    confidence = np.stack([_confidence(group, points) for _, group in bodies])
    ids = _ids([int(target.track_id) for target, _ in bodies])
    return record(xy, confidence, ids, msg.header, present=(xy != 0).any(axis=-1))


def _pixels(group, points: int) -> np.ndarray:
    count = len(group.point)
    if count != points:
        raise WrongPointCount(f"a body has {count} keypoints, the layout {points}", lambda other: other == count)
    return np.array([(point.x, point.y) for point in group.point], dtype=np.float64)


def _confidence(group, points: int) -> np.ndarray:
    if len(group.confidence) == 0:
        return np.ones(points)
    if len(group.confidence) != points:
        raise MessageError(
            "wrong_confidence_count",
            f"a body has {points} keypoints and {len(group.confidence)} confidences; send one for each, or none",
        )
    return np.array(group.confidence, dtype=np.float64)


def _ids(numbers: list[int]) -> tuple[str, ...]:
    """As text; unknown where two persons share one, as the zeros of a detector that does not track."""
    return tuple(map(str, numbers)) if len(set(numbers)) == len(numbers) else ("",) * len(numbers)
