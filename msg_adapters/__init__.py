# SPDX-License-Identifier: Apache-2.0
"""Messages to arrays and back, one module a message family; knows nothing of lifting.

Everything here is duck-typed over attributes: the same code reads rclpy messages and rosbags dataclasses,
and no message package is imported. A family is chosen by its type name as bags spell it. Other packages may add theirs,
see docs/adapters.md; `record`, `by_name` and `split_persons` are for them.
"""

from __future__ import annotations

from msg_adapters import ai, hri, opendr, openpose, point_cloud2, pose_array, yolo, zed
from msg_adapters.camera_info import read_camera_info
from msg_adapters.depth_image import DepthImage, read_depth
from msg_adapters.keypoints import (
    Intrinsics,
    Keypoints2D,
    MessageError,
    Source,
    WrongPointCount,
    by_name,
    join,
    record,
    split_persons,
)
from msg_adapters.plugins import Adapter, Adapters, OnePerson

#: Type name -> Adapter, those that other packages bring after the shipped ones.
SUPPORTED = Adapters(
    {
        "sensor_msgs/msg/PointCloud2": Adapter(point_cloud2.read),
        "geometry_msgs/msg/PoseArray": Adapter(pose_array.read),
        # yolo_ros numbers points only, but those of its pose models are COCO's.
        "yolo_msgs/msg/DetectionArray": Adapter(yolo.read, lambda _: "coco17"),
        "hri_msgs/msg/Skeleton2D": Adapter(hri.read, lambda _: "hri18", one_person=True),
        "zed_msgs/msg/ObjectsStamped": Adapter(zed.read, zed.layout),
        "ai_msgs/msg/PerceptionTargets": Adapter(ai.read),
        "opendr_interface/msg/OpenDRPose2D": Adapter(opendr.read, lambda _: "openpose18", one_person=True),
        "openpose_ros2_msgs/msg/PoseKeyPointsList": Adapter(openpose.read_list, openpose.layout_of_list),
        "ros_openpose/msg/Frame": Adapter(openpose.read_frame, openpose.layout_of_frame),
    }
)

#: Types whose message is one person: those of one stamp are of one image.
ONE_PERSON = OnePerson(SUPPORTED)


def read(type_name: str, msg, points: int, source: Source = Source()) -> Keypoints2D:
    """Reads a 2D keypoint message for a layout of `points` keypoints.

    Raises MessageError with a reason to count by and a sentence that says what to do.
    """
    adapter = SUPPORTED.get(type_name)
    if adapter is None:
        raise MessageError(
            "unknown_type",
            f"{type_name} is no keypoint message that can be read here; readable are {', '.join(SUPPORTED)}",
        )
    return adapter.read(msg, points, source)


def named_layout(type_name: str, msg) -> str | None:
    """The shipped layout whose points the messages of a family are, by what this one says; None = it does not say."""
    return SUPPORTED[type_name].layout(msg) if type_name in SUPPORTED else None


__all__ = [
    "ONE_PERSON",
    "SUPPORTED",
    "Adapter",
    "DepthImage",
    "Intrinsics",
    "Keypoints2D",
    "MessageError",
    "Source",
    "WrongPointCount",
    "by_name",
    "join",
    "named_layout",
    "read",
    "read_camera_info",
    "read_depth",
    "record",
    "split_persons",
]
