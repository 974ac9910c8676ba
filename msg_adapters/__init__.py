# SPDX-License-Identifier: Apache-2.0
"""Messages to arrays and back, one module a message family; knows nothing of lifting.

Everything here is duck-typed over attributes: the same code reads rclpy messages and rosbags dataclasses,
and no message package is imported. A family is chosen by its type name as bags spell it.
"""

from __future__ import annotations

from msg_adapters import point_cloud2, pose_array, yolo
from msg_adapters.camera_info import read_camera_info
from msg_adapters.keypoints import Intrinsics, Keypoints2D, MessageError, WrongPointCount

#: Type name -> reader(msg, points) -> Keypoints2D.
SUPPORTED = {
    "sensor_msgs/msg/PointCloud2": point_cloud2.read,
    "geometry_msgs/msg/PoseArray": pose_array.read,
    "yolo_msgs/msg/DetectionArray": yolo.read,
}


def read(type_name: str, msg, points: int) -> Keypoints2D:
    """Reads a 2D keypoint message whose layout has `points` keypoints.

    Raises MessageError with a reason to count by and a sentence that says what to do.
    """
    reader = SUPPORTED.get(type_name)
    if reader is None:
        raise MessageError(
            "unknown_type",
            f"{type_name} is no keypoint message that can be read here; readable are {', '.join(SUPPORTED)}",
        )
    return reader(msg, points)


__all__ = ["Intrinsics", "Keypoints2D", "MessageError", "SUPPORTED", "WrongPointCount", "read", "read_camera_info"]
