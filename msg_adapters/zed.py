# SPDX-License-Identifier: Apache-2.0
"""zed_msgs/ObjectsStamped (ZED cameras; formerly zed_interfaces): pixels, ids if tracking is on; placed by name.

A skeleton has 70 slots for every body_format; only the first 18, 34 or 38 are filled, and the others are zero. Versions
before 4.0 have 18 or 34 slots. NaN, negative and (0, 0) mean missing. Objects without a skeleton are ignored. Some
versions have a confidence for each point, in percent; all zeros mean that there is none. The header names the camera's
own frame (NAME_left_camera_frame: x forward), but the pixels belong to the optical frame, which CameraInfo names
(zed-ros2-wrapper, publishing of bodies).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from msg_adapters.keypoints import CONFIDENCE_SLACK, Keypoints2D, MessageError, Source, by_name, no_persons, record
from msg_adapters.openpose import OPENPOSE18

# fmt: off
_ARM = ("clavicle", "shoulder", "elbow", "wrist", "palm", "hand_tip", "thumb")
_LEG = ("hip", "knee", "ankle", "foot")
#: BODY_34 of the ZED SDK.
BODY34 = (
    "pelvis_joint", "navel_spine", "chest_spine", "neck_joint",
    *(f"{side}_{part}" for side in ("left", "right") for part in _ARM),
    *(f"{side}_{part}" for side in ("left", "right") for part in _LEG),
    "head_joint", "nose", "left_eye", "left_ear", "right_eye", "right_ear", "left_heel", "right_heel",
)
#: BODY_38 of the ZED SDK.
BODY38 = (
    "pelvis_joint", "spine_1", "spine_2", "spine_3", "neck_joint", "nose",
    *(
        f"{side}_{part}"
        for part in (
            "eye", "ear", "clavicle", "shoulder", "elbow", "wrist", "hip", "knee", "ankle",
            "big_toe", "small_toe", "heel", "thumb_4", "index_knuckle", "middle_4", "pinky_knuckle",
        )
        for side in ("left", "right")
    ),
)
# fmt: on
#: Object.body_format -> the layout with its points, and their order.
_FORMATS = {0: ("openpose18", OPENPOSE18), 1: ("zed34", BODY34), 2: ("zed38", BODY38)}


def read(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read the objects that have a skeleton; the result's frame_id is CameraInfo's.

    Fields: objects[] with skeleton_available, body_format, skeleton_2d.keypoints[70].kp[2], label_id, and in some
    versions skeleton_keypoint_confidence[70].

    Raises:
        MessageError: unknown_body_format, no_common_names.
    """
    bodies = [body for body in msg.objects if body.skeleton_available]
    if not bodies:
        return replace(no_persons(points, msg.header), frame_id=source.optical_frame)
    values = np.stack([_placed(body, source.names) for body in bodies])
    xy, confidence = values[..., :2], values[..., 2]
    # The SDK sends -1 if tracking is off.
    ids = tuple(str(body.label_id) if body.label_id >= 0 else "" for body in bodies)
    return replace(
        record(xy, confidence, ids, msg.header, present=np.all(xy >= 0, axis=-1)), frame_id=source.optical_frame
    )


def layout(msg: Any) -> str | None:
    """Return openpose18, zed34 or zed38 if all bodies have its format, else None."""
    names = {_format(body)[0] for body in msg.objects if body.skeleton_available}
    return names.pop() if len(names) == 1 else None


def _placed(body: Any, names: tuple[str, ...]) -> np.ndarray:
    """Return one body's pixels and confidences as (P, 3) in the layout's order."""
    _, order = _format(body)
    if not order:
        raise MessageError(
            "unknown_body_format",
            f"body_format {body.body_format} is unknown; set 0, 1 or 2 (18, 34 or 38 points) in the camera's body "
            "tracking",
        )
    slots = body.skeleton_2d.keypoints[: len(order)]
    if len(slots) < len(order):
        raise MessageError(
            "unknown_body_format",
            f"a skeleton has {len(slots)} keypoints, body_format {body.body_format} needs {len(order)}; correct it in "
            "the camera's body tracking",
        )
    xy = np.array([slot.kp for slot in slots], dtype=np.float64)
    return by_name(np.column_stack([xy, _confidence(body, len(order))]), order, names)


def _format(body: Any) -> tuple[str | None, tuple[str, ...]]:
    """Return the layout with a body's points, and their order; None and () if its format is unknown."""
    number = int(getattr(body, "body_format", 0))
    # Versions before 4.0 have 18 or 34 slots, and 2 stands for BODY_34.
    if number and len(body.skeleton_2d.keypoints) == len(BODY34):
        number = 1
    return _FORMATS.get(number, (None, ()))


def _confidence(body: Any, points: int) -> np.ndarray:
    percent = np.array(getattr(body, "skeleton_keypoint_confidence", ()), dtype=np.float64)[:points]
    if len(percent) != points or not (percent > 0).any():
        return np.ones(points)
    # Nobody is seen with less than 1 % everywhere: these are shares.
    unit = 100 if np.nanmax(percent) > 1 + CONFIDENCE_SLACK else 1
    return np.nan_to_num(percent) / unit
