# SPDX-License-Identifier: Apache-2.0
"""The demo's recorder: a ROS node that writes the inputs and outputs of the lifter to a bag, serialised."""

from __future__ import annotations

import importlib
import subprocess
import time
from collections.abc import Callable
from typing import BinaryIO

from paul_ros.errors import DemoError
from paul_ros.offline.bag_topics import CAMERA_INFO_TYPE
from paul_ros.offline.bag_writer import LATCHED_QOS, BagWriter
from paul_ros.offline.processes import tail
from paul_ros.offline.replay import NODE_NAME

_CLOUD = "sensor_msgs/msg/PointCloud2"
_POSES = "geometry_msgs/msg/PoseArray"

#: Topics that the player publishes -> their types.
PLAYED = {"/camera_info": CAMERA_INFO_TYPE, "/keypoints": _CLOUD}

#: Topics that the recorder writes -> their types.
RECORDED = {
    **PLAYED,
    f"{NODE_NAME}/layout": "std_msgs/msg/String",
    f"{NODE_NAME}/poses": _POSES,
    f"{NODE_NAME}/bodies": _POSES,
    f"{NODE_NAME}/persons": "sensor_msgs/msg/MultiDOFJointState",
    f"{NODE_NAME}/keypoints3d": _CLOUD,
    f"{NODE_NAME}/markers": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}

_SILENCE = 5.0  # seconds without a message after which no more are expected


class Recorder:
    """A context manager that subscribes to RECORDED and writes each message to a bag.

    Attributes:
        counts: topic -> number of messages written.
    """

    def __init__(self, environment: dict[str, str], writer: BagWriter) -> None:
        self._domain = int(environment["ROS_DOMAIN_ID"])
        self._writer = writer
        self.counts = dict.fromkeys(RECORDED, 0)

    def __enter__(self) -> Recorder:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile

        self._context = rclpy.Context()
        self._context.init(domain_id=self._domain)
        self._node = rclpy.create_node("demo_recorder", context=self._context)
        for topic, type_name in RECORDED.items():
            qos = QoSProfile(depth=1000)
            if topic == f"{NODE_NAME}/layout":
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self._node.create_subscription(
                message_class(type_name), topic, self._write(topic, type_name), qos, raw=True
            )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        return self

    def __exit__(self, *error: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _write(self, topic: str, type_name: str) -> Callable[[bytes], None]:
        qos = LATCHED_QOS if topic == f"{NODE_NAME}/layout" else ""

        def take(data: bytes) -> None:
            self._writer.write_cdr(topic, type_name, bytes(data), time.time_ns(), qos)
            self.counts[topic] += 1

        return take

    def spin_until(self, condition: Callable[[], bool], node: subprocess.Popen, log: BinaryIO, timeout: float) -> None:
        """Record until a condition holds.

        Raises:
            DemoError: the node ended, or the condition does not hold after `timeout` seconds.
        """
        end = time.monotonic() + timeout
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)
            if node.poll() is not None:
                raise DemoError(f"the node ended by itself (exit code {node.returncode}): {tail(log)}")
            if time.monotonic() > end:
                raise DemoError(f"the node did not answer within {timeout:.0f} s: {tail(log)}")

    def spin_while_messages_come(
        self, expected: int, node: subprocess.Popen, player: subprocess.Popen, log: BinaryIO, timeout: float
    ) -> None:
        """Record until all expected poses came, or none for _SILENCE seconds after the first.

        Raises:
            DemoError: the player or the node ended, or no pose came within `timeout` seconds.
        """
        poses = f"{NODE_NAME}/poses"
        self.spin_until(lambda: self.counts[poses] > 0 or player.poll() is not None, node, log, timeout)
        if player.poll() is not None:
            raise DemoError(f"the player ended early: {tail(log)}")
        seen, last = 0, time.monotonic()
        while self.counts[poses] < expected and time.monotonic() - last < _SILENCE:
            self._executor.spin_once(timeout_sec=0.05)
            if self.counts[poses] > seen:
                seen, last = self.counts[poses], time.monotonic()


def message_class(type_name: str) -> type:
    """Return the rclpy class of a message type, as 'std_msgs/msg/String'."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)
