# SPDX-License-Identifier: Apache-2.0
"""Shared by all tests: an isolated ROS domain with field checks on, and both families of message classes."""

from __future__ import annotations

import os

# Before any test imports rclpy, and inherited by the processes that tests start.
os.environ.update(
    ROS_PYTHON_CHECK_FIELDS="1",
    ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
    RMW_IMPLEMENTATION="rmw_fastrtps_cpp",
    ROS_DOMAIN_ID=str(1 + os.getpid() % 100),
)

import array
import importlib
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from foreign_messages import DEFINITIONS
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parent.parent
#: The command of the node's process.
LIFTER = [sys.executable, "-m", "paul_ros.ros.lifter_process"]


class RosMake:
    """Factory of rclpy's message classes."""

    def __call__(self, type_name: str, **fields):
        package, _, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)(**fields)

    @staticmethod
    def octets(data: bytes):
        return array.array("B", data)


class BagMake:
    """Factory of rosbags' dataclasses, with the foreign packages registered."""

    def __init__(self) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        for name, text in DEFINITIONS.items():
            self.store.register(get_types_from_msg(text, name))

    def __call__(self, type_name: str, **fields):
        return self.store.types[type_name](**fields)

    @staticmethod
    def octets(data: bytes):
        return np.frombuffer(data, np.uint8)

    @staticmethod
    def floats(values):
        """A float32[] field."""
        return np.array(values, np.float32)

    def through_cdr(self, msg):
        """The message as a bag gives it back; that also checks that every field is fit to be written."""
        name = msg.__msgtype__
        return self.store.deserialize_cdr(self.store.serialize_cdr(msg, name), name)


@pytest.fixture(scope="session")
def bag_make() -> BagMake:
    return BagMake()


@pytest.fixture(scope="session", params=["rclpy", "rosbags"])
def make(request, bag_make):
    """Every test that asks for it runs with rclpy's classes and with rosbags'."""
    return RosMake() if request.param == "rclpy" else bag_make


def header_of(make, seconds: int = 7, nanoseconds: int = 5, frame: str = "camera_color_optical_frame"):
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


#: A standing person in metres, x right, y down, z forward, who looks at the camera: the COCO points in order.
PERSON = np.array(
    [
        (0, -0.62, -0.12),
        (0.03, -0.66, -0.09),
        (-0.03, -0.66, -0.09),
        (0.07, -0.64, 0),
        (-0.07, -0.64, 0),
        (0.2, -0.4, 0.02),
        (-0.2, -0.4, 0.02),
        (0.3, -0.15, 0.05),
        (-0.25, -0.15, -0.1),
        (0.33, 0.05, -0.1),
        (-0.2, 0, -0.3),
        (0.12, 0.1, 0),
        (-0.12, 0.1, 0),
        (0.14, 0.5, -0.1),
        (-0.13, 0.5, 0.05),
        (0.15, 0.9, 0.05),
        (-0.14, 0.9, 0.1),
    ]
)
FOCAL, CENTRE = 600.0, (320.0, 240.0)


@pytest.fixture(scope="session")
def model_file(tmp_path_factory) -> Path:
    """A model file whose every shape is PERSON: its only weights that are not zero are the last bias."""
    from paul_ros.layout import load_layout
    from paul_ros.model_file import save_model, weight_shapes
    from paul_ros.normalisation import to_unit_size

    layout = load_layout("coco17")
    shape = to_unit_size(PERSON.T[None], layout)[0]
    start, end = np.array(layout.edges).T
    metres = float(np.linalg.norm(PERSON[start] - PERSON[end], axis=1).mean())
    header = {
        "layout": layout.to_dict(),
        "bottleneck": 2,
        "metres_per_unit": metres,
        "stature": 1.7,
        "chirality": {"known": True, "source": "made by hand"},
        "architecture": {
            "encoder": {"kind": "residual", "width": 4, "blocks": 1},
            "decoder": {"kind": "mlp", "hidden": [4]},
        },
    }
    arrays = {name: np.zeros(size) for name, size in weight_shapes(header, 17).items()}
    arrays["mean_shape"], arrays["decoder.1.bias"] = shape, shape.ravel()
    path = tmp_path_factory.mktemp("model") / "stand.npz"
    save_model(path, header, arrays)
    return path


def coco_model():
    """The shipped model as one of COCO-17 alone: its weights for the other points left out."""
    from paul_ros.layout import load_layout
    from paul_ros.model import Model
    from paul_ros.model_file import load_model
    from paul_ros.normalisation import to_unit_size

    human, coco = load_model(), load_layout("coco17")
    own = np.array([human.layout.names.index(name) for name in coco.names])
    rows = np.concatenate([part * len(human.layout.names) + own for part in range(3)])
    last = len(human.header["architecture"]["decoder"]["hidden"])
    weights = {**human.weights, "encoder.input.weight": human.weights["encoder.input.weight"][:, rows]}
    for name in (f"decoder.{last}.weight", f"decoder.{last}.bias"):
        weights[name] = human.weights[name][rows]
    mean = to_unit_size(human.mean_shape[None, :, own], coco)[0]
    unit = np.ptp(human.mean_shape[1, own]) / np.ptp(mean[1])  # its edges have another mean length
    header = {**human.header, "layout": coco.to_dict(), "misfit": human.misfit / unit}
    header["metres_per_unit"] = human.metres_per_unit * float(unit)
    return Model("coco", header, coco, weights, mean, human.sha256)


def persons_at(*places) -> np.ndarray:
    """(N, 17, 3) metres: PERSON at each (x, y, z)."""
    return PERSON + np.array(places, dtype=float).reshape(-1, 1, 3)


def seen(points: np.ndarray) -> np.ndarray:
    """(N, P, 2) pixels of points (N, P, 3) under the tests' camera."""
    return FOCAL * points[..., :2] / points[..., 2:] + CENTRE


def camera_info(make, fx: float = FOCAL, fy: float = FOCAL, cx: float = CENTRE[0]):
    region = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    k = np.array([fx, 0, cx, 0, fy, CENTRE[1], 0, 0, 1])
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header_of(make),
        height=480,
        width=640,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=k,
        r=np.zeros(9),
        p=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


class LifterProcess:
    """The real node as a process of its own, in a namespace of its own; its log is in `log()`."""

    def __init__(self, folder: Path, namespace: str, *ros_args: str) -> None:
        self.namespace = namespace
        self._log = folder / f"{namespace}.log"
        # The wheels' start-up hook marks its work here, and a child that inherits the mark skips it.
        env = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
        with open(self._log, "wb") as log:
            self.process = subprocess.Popen(
                [*LIFTER, "--ros-args", "-r", f"__ns:=/{namespace}", *ros_args],
                cwd=ROOT,
                env=env,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def log(self) -> str:
        return self._log.read_text()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Ends it by a signal; its exit code."""
        self.process.send_signal(number)
        return self.process.wait(20)


@pytest.fixture(scope="session")
def ros():
    """rclpy, started in the test's own process."""
    import rclpy

    rclpy.init()
    yield rclpy
    rclpy.shutdown()


@pytest.fixture(scope="module")
def start_lifter(tmp_path_factory):
    """start_lifter(*ros_args) -> LifterProcess; all are ended with the module."""
    folder, started = tmp_path_factory.mktemp("nodes"), []

    def start(*ros_args: str) -> LifterProcess:
        started.append(LifterProcess(folder, f"test{len(started)}", *ros_args))
        return started[-1]

    yield start
    for lifter in started:
        # Not by SIGKILL: that would leave the middleware's shared memory behind.
        if lifter.process.poll() is None:
            lifter.stop()
