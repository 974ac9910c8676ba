# SPDX-License-Identifier: Apache-2.0
"""OpenPose in its two forms: openpose_ros2_msgs/PoseKeyPointsList and ros_openpose/Frame.

Each point of a person has pixels and a score. The number of points tells OpenPose's order: 18 for its COCO model, 25
for BODY_25. Such points are placed by name, so they need no layout of their own. With any other number, points have
the layout's order. A point at (0, 0) or (-1, -1) is missing. Persons have no ids.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_adapters.keypoints import Keypoints2D, Source, WrongPointCount, by_name, no_persons, record

# fmt: off
#: The 18 points of OpenPose's COCO model (OpenPose's output format).
OPENPOSE18 = (
    "nose", "neck",
    "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist",
    "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle",
    "right_eye", "left_eye", "right_ear", "left_ear",
)
#: The 25 points of its BODY_25 model.
BODY25 = (
    "nose", "neck",
    "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist",
    "pelvis", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle",
    "right_eye", "left_eye", "right_ear", "left_ear",
    "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)
# fmt: on
_ORDERS = {len(order): order for order in (OPENPOSE18, BODY25)}
_LAYOUTS = {len(OPENPOSE18): "openpose18", len(BODY25): "body25"}

#: One person's points: (x, y, score) each.
_Person = list[tuple[float, float, float]]


def read_list(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read openpose_ros2_msgs/PoseKeyPointsList: pose_key_points_list[].pose_key_points[] with x, y, score.

    Raises:
        MessageError: wrong_point_count, no_common_names.
    """
    persons = [
        [(point.x, point.y, point.score) for point in person.pose_key_points] for person in msg.pose_key_points_list
    ]
    return _read(persons, points, source, msg.header)


def read_frame(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read ros_openpose/Frame: persons[].bodyParts[] with score and pixel x, y; hands are ignored.

    Raises:
        MessageError: wrong_point_count, no_common_names.
    """
    persons = [[(part.pixel.x, part.pixel.y, part.score) for part in _body_parts(person)] for person in msg.persons]
    return _read(persons, points, source, msg.header)


def layout_of_list(msg: Any) -> str | None:
    """Return openpose18 or body25 by the number of points of the first person that has any, else None."""
    return _layout([len(person.pose_key_points) for person in msg.pose_key_points_list])


def layout_of_frame(msg: Any) -> str | None:
    """Return openpose18 or body25 as `layout_of_list` does."""
    return _layout([len(_body_parts(person)) for person in msg.persons])


def _layout(counts: list[int]) -> str | None:
    return _LAYOUTS.get(next(filter(None, counts), 0))


def _body_parts(person: Any) -> list[Any]:
    """Return the body parts under either name: ROS 2 forbids capitals in field names, so ports rename the field."""
    return person.bodyParts if hasattr(person, "bodyParts") else person.body_parts


def _read(persons: list[_Person], points: int, source: Source, header: Any) -> Keypoints2D:
    if not persons:
        return no_persons(points, header)
    values = np.stack([_placed(person, points, source.names) for person in persons])
    return record(values[..., :2], values[..., 2], ("",) * len(persons), header)


def _placed(person: _Person, points: int, names: tuple[str, ...]) -> np.ndarray:
    """Return one person's (x, y, score) as (P, 3), all NaN for a person without points."""
    if not person:
        return np.full((points, 3), np.nan)
    order = _ORDERS.get(len(person))
    if order is not None:
        return by_name(np.array(person, dtype=np.float64), order, names)
    if len(person) != points:
        raise WrongPointCount(
            f"a person has {len(person)} keypoints, the layout {points}", lambda other: other == len(person)
        )
    return np.array(person, dtype=np.float64)
