# SPDX-License-Identifier: Apache-2.0
"""Messages to arrays and back, one module a message family; knows nothing of lifting.

Everything here is duck-typed over attributes: the same code reads rclpy messages and rosbags dataclasses,
and no message package is imported. A family is chosen by its type name as bags spell it.
"""

from __future__ import annotations

from msg_adapters import ai, hri, opendr, openpose, point_cloud2, pose_array, yolo, zed
from msg_adapters.camera_info import read_camera_info
from msg_adapters.depth_image import DepthImage, read_depth
from msg_adapters.keypoints import Intrinsics, Keypoints2D, MessageError, Source, WrongPointCount, join

#: Type name -> reader(msg, points, source) -> Keypoints2D.
SUPPORTED = {
    "sensor_msgs/msg/PointCloud2": point_cloud2.read,
    "geometry_msgs/msg/PoseArray": pose_array.read,
    "yolo_msgs/msg/DetectionArray": yolo.read,
    "hri_msgs/msg/Skeleton2D": hri.read,
    "zed_msgs/msg/ObjectsStamped": zed.read,
    "ai_msgs/msg/PerceptionTargets": ai.read,
    "opendr_interface/msg/OpenDRPose2D": opendr.read,
    "openpose_ros2_msgs/msg/PoseKeyPointsList": openpose.read_list,
    "ros_openpose/msg/Frame": openpose.read_frame,
}

#: Type name -> layout(msg), the name of the layout whose points the message names, None where it does not say.
_NAMED = {
    "yolo_msgs/msg/DetectionArray": lambda _: "coco17",
    "hri_msgs/msg/Skeleton2D": lambda _: "hri18",
    "zed_msgs/msg/ObjectsStamped": zed.layout,
    "opendr_interface/msg/OpenDRPose2D": lambda _: "openpose18",
    "openpose_ros2_msgs/msg/PoseKeyPointsList": openpose.layout_of_list,
    "ros_openpose/msg/Frame": openpose.layout_of_frame,
}

#: Types whose message is one person: those of one stamp are of one image.
ONE_PERSON = frozenset({"hri_msgs/msg/Skeleton2D", "opendr_interface/msg/OpenDRPose2D"})


def read(type_name: str, msg, points: int, source: Source = Source()) -> Keypoints2D:
    """Reads a 2D keypoint message for a layout of `points` keypoints.

    Raises MessageError with a reason to count by and a sentence that says what to do.
    """
    reader = SUPPORTED.get(type_name)
    if reader is None:
        raise MessageError(
            "unknown_type",
            f"{type_name} is no keypoint message that can be read here; readable are {', '.join(SUPPORTED)}",
        )
    return reader(msg, points, source)


def named_layout(type_name: str, msg) -> str | None:
    """The shipped layout whose points the messages of a family are, by what this one says; None = it does not say.

    yolo_ros numbers points only, but those of its pose models are COCO's.
    """
    return _NAMED[type_name](msg) if type_name in _NAMED else None


__all__ = [
    "ONE_PERSON",
    "SUPPORTED",
    "DepthImage",
    "Intrinsics",
    "Keypoints2D",
    "MessageError",
    "Source",
    "WrongPointCount",
    "join",
    "named_layout",
    "read",
    "read_camera_info",
    "read_depth",
]
