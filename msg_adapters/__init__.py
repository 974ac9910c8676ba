# SPDX-License-Identifier: Apache-2.0
"""Convert ROS messages to arrays and back: one module per message family, without any knowledge of lifting.

All code is duck-typed over attributes. It reads the messages of rclpy and of rosbags alike, and imports no message
package. The type name, PACKAGE/msg/NAME, selects the family. Other packages can add families, see
docs/how_to/write_an_adapter.md; `record`, `by_name` and `split_persons` help to write them.
"""

from __future__ import annotations

from typing import Any

from msg_adapters import ai, hri, opendr, openpose, point_cloud2, pose_array, yolo, zed
from msg_adapters.camera_info import image_size, read_camera_info
from msg_adapters.depth_image import DepthImage, read_depth
from msg_adapters.factory import MessageFactory
from msg_adapters.intrinsics import Intrinsics, in_pinhole
from msg_adapters.keypoints import (
    Keypoints2D,
    MessageError,
    Note,
    PointCountError,
    Source,
    UnknownLayout,
    WrongPointCount,
    by_name,
    is_placeholder,
    join,
    record,
    refuse_normalised,
    split_persons,
)
from msg_adapters.plugins import Adapter, Adapters, OnePerson

_YOLO = Adapter(yolo.read, lambda _: "coco17")
_ZED = Adapter(zed.read, zed.layout)

#: Type name -> Adapter: the shipped adapters, then those of other packages.
SUPPORTED = Adapters(
    {
        "sensor_msgs/msg/PointCloud2": Adapter(point_cloud2.read),
        "geometry_msgs/msg/PoseArray": Adapter(pose_array.read),
        # yolo_ros only numbers its points, but its pose models use COCO's order.
        "yolo_msgs/msg/DetectionArray": _YOLO,
        "yolov8_msgs/msg/DetectionArray": _YOLO,  # its name until yolo_ros 4
        "hri_msgs/msg/Skeleton2D": Adapter(hri.read, lambda _: "hri18", one_person=True),
        "zed_msgs/msg/ObjectsStamped": _ZED,
        "zed_interfaces/msg/ObjectsStamped": _ZED,  # its name until zed-ros2-wrapper 5
        "ai_msgs/msg/PerceptionTargets": Adapter(ai.read),
        "opendr_interface/msg/OpenDRPose2D": Adapter(opendr.read, lambda _: "openpose18", one_person=True),
        "openpose_ros2_msgs/msg/PoseKeyPointsList": Adapter(openpose.read_list, openpose.layout_of_list),
        "ros_openpose/msg/Frame": Adapter(openpose.read_frame, openpose.layout_of_frame),
    }
)

#: The types with one person per message: messages with equal stamps are persons of one image.
ONE_PERSON = OnePerson(SUPPORTED)


def read(type_name: str, msg: Any, points: int, source: Source = Source()) -> Keypoints2D:
    """Read a 2D keypoint message.

    Args:
        type_name: PACKAGE/msg/NAME.
        msg: the message, of rclpy or rosbags.
        points: number of keypoints of the layout.
        source: facts beside the message that some families need.

    Raises:
        MessageError: the message cannot be used; has a reason to count by and advice. Any family may raise normalised.
    """
    adapter = SUPPORTED.get(type_name)
    if adapter is None:
        raise MessageError(
            "unknown_type",
            f"{type_name} has no adapter; publish one of {', '.join(SUPPORTED)}, or write an adapter for it",
        )
    keypoints = adapter.read(msg, points, source)
    refuse_normalised(keypoints)
    return keypoints


def named_layout(type_name: str, msg: Any) -> str | None:
    """Return the name of the shipped layout that a message's points have, or None if the message does not tell."""
    return SUPPORTED[type_name].layout(msg) if type_name in SUPPORTED else None


__all__ = [
    "ONE_PERSON",
    "SUPPORTED",
    "Adapter",
    "DepthImage",
    "Intrinsics",
    "Keypoints2D",
    "MessageError",
    "MessageFactory",
    "Note",
    "PointCountError",
    "Source",
    "UnknownLayout",
    "WrongPointCount",
    "by_name",
    "image_size",
    "in_pinhole",
    "is_placeholder",
    "join",
    "named_layout",
    "read",
    "read_camera_info",
    "read_depth",
    "record",
    "refuse_normalised",
    "split_persons",
]
