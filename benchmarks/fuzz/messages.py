# SPDX-License-Identifier: Apache-2.0
"""Whole messages of every supported type, with persons at random places."""

from __future__ import annotations

import array
import random
from collections.abc import Callable, Sequence
from typing import Any

import foreign_messages as foreign
import numpy as np

from msg_adapters import outputs
from paul_ros.layout import load_layout
from paul_ros.offline.bag_records import BagMessages

Pose = dict[str, tuple[float, float]]
"""Keypoint name -> pixel."""

Make = Any
"""Factory of messages: called with a type name and fields."""

COCO = load_layout("coco17").names
BODIES = "/humans/bodies/{}/skeleton2d"
"""Topic of a person of ROS4HRI, by its id."""


class LiveMake(foreign.LiveMake):
    """Factory of messages with attributes like those of rclpy."""

    @staticmethod
    def octets(data: bytes) -> array.array[int]:
        """Return bytes as rclpy does."""
        return array.array("B", data)


class BagMake(BagMessages):
    """Factory of messages like those read from bags."""

    @staticmethod
    def floats(values: Sequence[float]) -> np.ndarray:
        """Return float32 numbers as rosbags does."""
        return np.array(values, np.float32)

    def deserialise(self, data: bytes, type_name: str) -> Any:
        """Return the message that rosbags reads from bytes."""
        return self._store.deserialize_cdr(data, type_name)


def random_pose(rng: random.Random) -> Pose:
    """Return a roughly upright person somewhere in the image."""
    x, y, size = rng.uniform(50, 590), rng.uniform(50, 400), rng.uniform(30, 300)
    heights = {"nose": 0, "eye": -0.02, "ear": 0, "shoulder": 0.15, "elbow": 0.35, "wrist": 0.5, "hip": 0.5}
    heights |= {"knee": 0.75, "ankle": 1.0, "neck": 0.13, "pelvis": 0.5, "toe": 1.03, "heel": 1.02}
    places = {}
    for name in {*COCO, "neck", "pelvis", *foreign.BODY25}:
        side = 0.1 if name.startswith("left") else -0.1 if name.startswith("right") else 0.0
        places[name] = (x + size * (side + rng.uniform(-0.03, 0.03)), y + size * (heights[name.split("_")[-1]]))
    return places


def header(make: Make, rng: random.Random, seconds: int) -> Any:
    """Return a header with this stamp and random nanoseconds."""
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rng.randrange(10**9))
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")


def cloud(make: Make, head: Any, poses: list[Pose], rng: random.Random) -> Any:
    """Return a PointCloud2 of COCO keypoints."""
    xy = np.array([[pose[name] for name in COCO] for pose in poses], float).reshape(-1, len(COCO), 2)
    ids = [str(number) for number in range(len(poses))]
    return outputs.keypoints_cloud(make, head, xy, np.full(xy.shape[:2], 0.9), ids)


def pose_array(make: Make, head: Any, poses: list[Pose], rng: random.Random) -> Any:
    """Return a PoseArray of COCO keypoints, person after person."""

    def place(x: float, y: float) -> Any:
        orientation = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        point = make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.9)
        return make("geometry_msgs/msg/Pose", position=point, orientation=orientation)

    return make(foreign.POSES, header=head, poses=[place(*pose[name]) for pose in poses for name in COCO])


def yolo(make: Make, head: Any, poses: list[Pose], rng: random.Random) -> Any:
    """Return a yolo_ros DetectionArray; some keypoints are missing."""

    def keypoint(number: int, x: float, y: float) -> Any:
        point = make("yolo_msgs/msg/Point2D", x=float(x), y=float(y))
        return make("yolo_msgs/msg/KeyPoint2D", id=number, point=point, score=0.9)

    detections = []
    for ident, pose in enumerate(poses):
        data = [keypoint(index, *pose[name]) for index, name in enumerate(COCO, 1) if rng.random() < 0.9]
        keypoints = make("yolo_msgs/msg/KeyPoint2DArray", data=data)
        named = dict(class_id=0, class_name="person", score=0.9, id=str(ident))
        detections.append(make("yolo_msgs/msg/Detection", keypoints=keypoints, **named))
    return make(foreign.YOLO, header=head, detections=detections)


def perception_targets(make: Make, head: Any, poses: list[Pose], rng: random.Random) -> Any:
    """Return PerceptionTargets of hobot; some lack confidences."""
    targets = [
        foreign.ai_target(make, ident, body_kps=([pose[name] for name in COCO], [0.9] * rng.choice((0, len(COCO)))))
        for ident, pose in enumerate(poses)
    ]
    return foreign.ai(make, head, targets)


Builder = Callable[[Make, Any, list[Pose], random.Random], Any]
"""Builds a message from a factory, a header and poses."""


def _openpose(build: Callable[[Make, Any, list[Any]], Any], order: list[str]) -> Builder:
    return lambda make, head, poses, rng: build(make, head, [foreign.openpose_rows(pose, order) for pose in poses])


BUILDERS: dict[str, Builder] = {
    foreign.CLOUD: cloud,
    foreign.POSES: pose_array,
    foreign.YOLO: yolo,
    foreign.HRI: lambda make, head, poses, rng: foreign.hri(make, head, poses[0] if poses else {}),
    foreign.ZED: lambda make, head, poses, rng: foreign.zed(make, head, poses, rng.randrange(3)),
    foreign.AI: perception_targets,
    foreign.OPENDR: lambda make, head, poses, rng: foreign.opendr(make, head, poses[0] if poses else {}),
    foreign.OPENPOSE_LIST: _openpose(foreign.openpose_list, foreign.OPENPOSE18),
    foreign.OPENPOSE_FRAME: _openpose(foreign.openpose_frame, foreign.BODY25),
}
"""Type name -> builder of its messages."""


_LENSES = (
    ("plumb_bob", [0.0] * 5),
    ("plumb_bob", []),
    ("plumb_bob", [-0.3, 0.1, 0.001, -0.001, 0.02]),
    ("plumb_bob", [0.1] * 3),
    ("", [1e30, 0.0, 0.0, 0.0]),
    ("rational_polynomial", [0.5, -2.6, 0.001, 0.0, 1.5, 0.4, -2.4, 1.4]),
    ("equidistant", [-0.02, 0.01, -0.004, 0.001]),
    ("equidistant", [-5.0, 3.0, 0.0, 0.0]),
    ("fov", [0.9]),
)
"""Distortion models and their coefficients, also some that no lens has."""


def camera_info(make: Make, rng: random.Random) -> Any:
    """Return a CameraInfo of one of many cameras."""
    window = rng.choice(((0, 0, 0, 0), (0, 0, 0, 0), (100, 50, 400, 300), (0, 0, 640, 480), (600, 0, 640, 480)))
    corner = dict(zip(("x_offset", "y_offset", "width", "height"), window))
    region = make("sensor_msgs/msg/RegionOfInterest", **corner, do_rectify=rng.random() < 0.5)
    fx, (model, d) = rng.choice((600.0, 1200.0)), rng.choice(_LENSES)
    p = rng.choice(([0.0] * 12, [fx, 0.0, 320.0, 0.0, 0.0, fx, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]))
    numbers = dict(k=[fx, 0.0, 320.0, 0.0, fx, 240.0, 0.0, 0.0, 1.0], r=[0.0] * 9, p=p, d=d)
    arrays = {name: np.array(values, float) for name, values in numbers.items()}
    binning = dict(binning_x=rng.choice((0, 1, 2)), binning_y=rng.choice((0, 1, 4, 100)))
    size = dict(height=480, width=640, distortion_model=model, **binning, roi=region)
    return make("sensor_msgs/msg/CameraInfo", header=header(make, rng, 1), **size, **arrays)


def depth_image(make: Make, rng: random.Random, seconds: int) -> Any:
    """Return a depth image of 3 m everywhere."""
    values = np.full((48, 64), 3000, "<u2")
    size = dict(height=48, width=64, encoding="16UC1", is_bigendian=0, step=128, data=make.octets(values.tobytes()))
    return make("sensor_msgs/msg/Image", header=header(make, rng, seconds), **size)
