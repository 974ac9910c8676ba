# SPDX-License-Identifier: Apache-2.0
"""zed_msgs/ObjectsStamped (ZED cameras): pixels, ids if tracking is on; points are placed by name.

A skeleton has 70 slots for every body_format; only the first 18, 34 or 38 are filled, and the others are zero. NaN,
negative and (0, 0) mean missing. Confidence exists for the whole object only. Objects without a skeleton are ignored.
The header names the camera's own frame (NAME_left_camera_frame: x forward), but the pixels belong to the optical frame,
which CameraInfo names (zed-ros2-wrapper, publishing of bodies).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, by_name, no_persons, record
from msg_adapters.openpose import OPENPOSE18

# '' stands for spine, clavicles, hands and other points that only this SDK has.
# fmt: off
#: BODY_34 of the ZED SDK.
BODY34 = (
    "", "", "", "",
    "", "left_shoulder", "left_elbow", "left_wrist", "", "", "",
    "", "right_shoulder", "right_elbow", "right_wrist", "", "", "",
    "left_hip", "left_knee", "left_ankle", "", "right_hip", "right_knee", "right_ankle", "",
    "", "nose", "left_eye", "left_ear", "right_eye", "right_ear", "left_heel", "right_heel",
)
#: BODY_38 of the ZED SDK.
BODY38 = (
    "", "", "", "", "",
    "nose", "left_eye", "right_eye", "left_ear", "right_ear",
    "", "", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe", "left_heel", "right_heel",
    "", "", "", "", "", "", "", "",
)
# fmt: on
#: Object.body_format -> the order of its points.
_ORDERS = {0: OPENPOSE18, 1: BODY34, 2: BODY38}


def read(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read the objects that have a skeleton; the result's frame_id is CameraInfo's.

    Fields: objects[] with skeleton_available, body_format, skeleton_2d.keypoints[70].kp[2], label_id.

    Raises:
        MessageError: unknown_body_format, no_common_names.
    """
    bodies = [body for body in msg.objects if body.skeleton_available]
    if not bodies:
        return replace(no_persons(points, msg.header), frame_id=source.optical_frame)
    xy = np.stack([_placed(body, source.names) for body in bodies])
    present = (xy >= 0).all(axis=-1) & (xy != 0).any(axis=-1)
    # The SDK sends -1 if tracking is off.
    ids = tuple(str(body.label_id) if body.label_id >= 0 else "" for body in bodies)
    return replace(record(xy, None, ids, msg.header, present), frame_id=source.optical_frame)


def layout(msg: Any) -> str | None:
    """Return openpose18 if all bodies have its format, else None: no shipped layout has the larger formats."""
    formats = {int(body.body_format) for body in msg.objects if body.skeleton_available}
    return "openpose18" if formats == {0} else None


def _placed(body: Any, names: tuple[str, ...]) -> np.ndarray:
    """Return one body's pixels as (P, 2) in the layout's order."""
    order = _ORDERS.get(int(body.body_format))
    if order is None:
        raise MessageError(
            "unknown_body_format",
            f"body_format {body.body_format} is unknown; set 0, 1 or 2 (18, 34 or 38 points) in the camera's body "
            "tracking",
        )
    slots = body.skeleton_2d.keypoints[: len(order)]
    return by_name(np.array([slot.kp for slot in slots], dtype=np.float64), order, names)
