# SPDX-License-Identifier: Apache-2.0
"""zed_msgs/ObjectsStamped (ZED cameras): pixels, ids where tracking is on; points are placed by name.

A skeleton has 70 slots whatever its body_format; only the first 18, 34 or 38 are filled, the rest is zero.
NaN, negative and (0, 0) mean missing. There is no confidence a keypoint, only one of the whole object. Objects
without a skeleton are none that could be lifted. The header names the camera's own frame (NAME_left_camera_frame: x
forward), where the pixels are of the optical one, whose name CameraInfo has (zed-ros2-wrapper, publishing of bodies).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, by_name, nobody, record
from msg_adapters.openpose import OPENPOSE18

# '' stands for spine, clavicles, hands and other points that the SDK places where no other detector has a point.
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
#: Object.body_format -> its order.
_ORDERS = {0: OPENPOSE18, 1: BODY34, 2: BODY38}


def read(msg, points: int, source: Source) -> Keypoints2D:
    """Reads the objects that have a skeleton as persons of a layout with `points` keypoints; frame_id is CameraInfo's.

    Fields: objects[] with skeleton_available, body_format, skeleton_2d.keypoints[70].kp[2], label_id.
    Raises MessageError: unknown_body_format, no_common_names.
    """
    bodies = [thing for thing in msg.objects if thing.skeleton_available]
    if not bodies:
        return replace(nobody(points, msg.header), frame_id=source.optical_frame)
    xy = np.stack([_placed(body, source.names) for body in bodies])
    present = (xy >= 0).all(axis=-1) & (xy != 0).any(axis=-1)
    # The SDK gives -1 where tracking is off.
    ids = tuple(str(body.label_id) if body.label_id >= 0 else "" for body in bodies)
    return replace(record(xy, None, ids, msg.header, present), frame_id=source.optical_frame)


def layout(msg) -> str | None:
    """openpose18 of the body format with those points; the larger ones are no shipped layout's."""
    formats = {int(thing.body_format) for thing in msg.objects if thing.skeleton_available}
    return "openpose18" if formats == {0} else None


def _placed(body, names: tuple[str, ...]) -> np.ndarray:
    """One body's pixels as (P, 2) of the layout."""
    order = _ORDERS.get(int(body.body_format))
    if order is None:
        raise MessageError(
            "unknown_body_format",
            f"body_format {body.body_format}; known are 0, 1 and 2 (18, 34 and 38 points), set one of those in the "
            "camera's body tracking",
        )
    slots = body.skeleton_2d.keypoints[: len(order)]
    return by_name(np.array([slot.kp for slot in slots], dtype=np.float64), order, names)
