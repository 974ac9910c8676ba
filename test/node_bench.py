# SPDX-License-Identifier: Apache-2.0
"""The counterpart of the node under test: a publisher and listener, and its messages."""

from __future__ import annotations

import json
import time

import numpy as np
from conftest import LifterProcess, RosMake, header_of, persons_at, seen

from msg_adapters import outputs
from paul_ros.stream.messages import OUTPUTS, STANDARD

MAKE = RosMake()
GOOD = persons_at((0.3, 0, 4))
PATIENCE = 60.0


class Bench:
    """Publishes to one lifter and keeps its answers by output name."""

    def __init__(
        self, ros, lifter: LifterProcess, kind: str = "sensor_msgs/msg/PointCloud2", best_effort: bool = False
    ) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
        from std_msgs.msg import String

        self.ros, self.lifter, self.stamp = ros, lifter, 100_000
        self.node = ros.create_node("bench", namespace=lifter.namespace)
        self.got = {name: [] for name in (*STANDARD, "layout", "diagnostics")}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        self.keypoints = self.node.create_publisher(
            class_of(kind), "keypoints", QoSProfile(depth=10, reliability=reliability)
        )
        self.camera = self.node.create_publisher(class_of("sensor_msgs/msg/CameraInfo"), "camera_info", 10)
        self.depth = self.node.create_publisher(class_of("sensor_msgs/msg/Image"), "depth", 10)
        for name in STANDARD:
            kind = class_of(OUTPUTS[name].message_type)
            self.node.create_subscription(kind, f"lifter/{name}", self.got[name].append, 10)
        self.node.create_subscription(String, "lifter/layout", self.got["layout"].append, latched)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def close(self) -> None:
        self.node.destroy_node()

    def _on_diagnostics(self, msg) -> None:
        for status in msg.status:
            if status.name == f"{self.lifter.namespace}/lifter: lifting":
                stamp = msg.header.stamp
                self.got["diagnostics"].append((stamp.sec * 10**9 + stamp.nanosec, status))

    def until(self, condition, what: str) -> None:
        """Wait for a condition while messages come in; fail with the node's log."""
        end = time.monotonic() + PATIENCE
        while not condition():
            assert self.lifter.process.poll() is None, f"the node ended\n{self.lifter.log()}"
            assert time.monotonic() < end, f"never came: {what}\n{self.lifter.log()}"
            self.ros.spin_once(self.node, timeout_sec=0.02)

    def matched(self) -> None:
        """Wait until both sides have found each other and all outputs answer."""
        self.until(
            lambda: all(p.get_subscription_count() for p in (self.keypoints, self.camera, self.depth)),
            "subscriptions of the node",
        )

        def answered():
            self.send(nobody())
            return all(self.got[name] for name in (*STANDARD, "layout"))

        self.until(answered, "answers on all outputs")

    def send(self, fill) -> int:
        """Publish fill(header) with a new stamp; return the stamp's seconds."""
        self.stamp += 1
        self.keypoints.publish(fill(header_of(MAKE, seconds=self.stamp)))
        return self.stamp

    def answer(self, name: str, seconds: int):
        """Wait for the output with this stamp and return it."""

        def stamped():
            return [msg for msg in self.got[name] if header_in(msg).stamp.sec == seconds]

        self.until(stamped, f"{name} of stamp {seconds}")
        return stamped()[0]

    def lifts(self) -> np.ndarray:
        """Send a good frame and return the persons of its answer, (N, 17, 3)."""
        poses = self.answer("poses", self.send(good())).poses
        assert len(poses) == 17
        return np.array([(p.position.x, p.position.y, p.position.z) for p in poses]).reshape(-1, 17, 3)

    def layout(self) -> dict:
        return json.loads(self.got["layout"][-1].data)

    def units(self) -> str:
        return self.layout()["units"]

    def next_diagnostics(self):
        """Return the first status made after now; an older one may be on its way."""
        now, got = time.time_ns(), self.got["diagnostics"]
        self.until(lambda: got and got[-1][0] > now, "diagnostics")
        return got[-1][1]

    def diagnosed(self) -> dict:
        return {pair.key: pair.value for pair in self.next_diagnostics().values}


def header_in(msg):
    return msg.markers[0].header if hasattr(msg, "markers") else msg.header


def class_of(type_name: str) -> type:
    return type(MAKE(type_name))


def cloud(xy: np.ndarray, ids=None, **changes):
    """Return a function header -> keypoint cloud, with some of its fields changed; the ids are the rows if None."""

    def fill(header):
        rows = [str(person) for person in range(len(xy))]
        msg = outputs.keypoints_cloud(MAKE, header, xy, np.ones(xy.shape[:2]), rows if ids is None else ids)
        for name, value in changes.items():
            setattr(msg, name, value)
        return msg

    return fill


def good():
    return cloud(seen(GOOD))


def nobody():
    return cloud(np.empty((0, 17, 2)))


def set_parameters(bench, **values):
    """Set parameters over their service; return the reason of each refusal, '' if it was accepted."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    client = bench.node.create_client(SetParameters, "lifter/set_parameters")
    bench.until(client.service_is_ready, "the parameter service")
    request = SetParameters.Request(
        parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    )
    future = client.call_async(request)
    bench.until(future.done, "the answer of the parameter service")
    return ["" if result.successful else result.reason for result in future.result().results]
