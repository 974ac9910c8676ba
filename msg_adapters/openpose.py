# SPDX-License-Identifier: Apache-2.0
"""OpenPose in its two forms: openpose_ros2_msgs/PoseKeyPointsList and ros_openpose/Frame.

Pixels and a score for every point of a person, in OpenPose's own order, which the number of points tells:
18 of its COCO model, 25 of BODY_25. Those are placed by name, so they need no layout of their own; any other
number is taken in the layout's order. (0, 0, 0) is missing. There are no ids.
"""

from __future__ import annotations

import numpy as np

from msg_adapters.keypoints import Keypoints2D, Source, WrongPointCount, by_name, nobody, record

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


def read_list(msg, points: int, source: Source) -> Keypoints2D:
    """Reads openpose_ros2_msgs/PoseKeyPointsList: pose_key_points_list[].pose_key_points[] with x, y, score.

    Raises MessageError: wrong_point_count, no_common_names.
    """
    persons = [
        [(point.x, point.y, point.score) for point in person.pose_key_points] for person in msg.pose_key_points_list
    ]
    return _read(persons, points, source, msg.header)


def read_frame(msg, points: int, source: Source) -> Keypoints2D:
    """Reads ros_openpose/Frame: persons[].bodyParts[] with score and pixel x, y; hands are left out.

    Raises MessageError: wrong_point_count, no_common_names.
    """
    persons = [[(part.pixel.x, part.pixel.y, part.score) for part in _body_parts(person)] for person in msg.persons]
    return _read(persons, points, source, msg.header)


def layout_of_list(msg) -> str | None:
    """openpose18 or body25, by the number of points of the first person that has any; None = neither."""
    return _named([len(person.pose_key_points) for person in msg.pose_key_points_list])


def layout_of_frame(msg) -> str | None:
    """The same of the other form."""
    return _named([len(_body_parts(person)) for person in msg.persons])


def _named(counts: list[int]) -> str | None:
    return {len(OPENPOSE18): "openpose18", len(BODY25): "body25"}.get(next(filter(None, counts), 0))


def _body_parts(person) -> list:
    """The package is of ROS 1; ROS 2 forbids capitals in a field's name, so whoever ports it renames the field."""
    return person.bodyParts if hasattr(person, "bodyParts") else person.body_parts


def _read(persons: list[list[tuple]], points: int, source: Source, header) -> Keypoints2D:
    if not persons:
        return nobody(points, header)
    values = np.stack([_placed(person, points, source.names) for person in persons])
    present = (values != 0).any(axis=-1)
    return record(values[..., :2], values[..., 2], ("",) * len(persons), header, present)


def _placed(person: list[tuple], points: int, names: tuple[str, ...]) -> np.ndarray:
    """One person's (x, y, score) as (P, 3); a person without points is one of whom none is visible."""
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
