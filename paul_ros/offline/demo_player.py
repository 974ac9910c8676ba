# SPDX-License-Identifier: Apache-2.0
"""The demo's player: publishes a bag in real time. Run as `python -m paul_ros.offline.demo_player BAG`."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from paul_ros.offline.bag_reader import read_records
from paul_ros.offline.bag_records import Record
from paul_ros.offline.demo_recorder import PLAYED, message_class
from paul_ros.offline.replay import NODE_NAME


def play(bag: Path) -> None:
    """Publish camera_info and keypoints of a bag once, at the pace of their log times.

    First waits until the node and the recorder are matched and the node knows the camera. Afterwards waits until stdin
    closes, so that no message under way is lost.
    """
    import rclpy

    records = list(read_records(bag, PLAYED))
    rclpy.init()
    node = rclpy.create_node("demo_player")
    publishers = {topic: node.create_publisher(message_class(kind), topic, 100) for topic, kind in PLAYED.items()}
    _wait_for_listeners(node, publishers, next(r for r in records if r.topic == "/camera_info"))
    began, first = time.monotonic(), records[0].log_time
    for record in records:
        time.sleep(max(0.0, began + (record.log_time - first) / 1e9 - time.monotonic()))
        publishers[record.topic].publish(record.data)
    sys.stdin.read()
    rclpy.shutdown()


def _wait_for_listeners(node: Any, publishers: dict[str, Any], camera_info: Record) -> None:
    """Send the first CameraInfo until ~/layout shows that it arrived: no frame may overtake it."""
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    described: dict = {}
    node.create_subscription(
        String,
        f"{NODE_NAME}/layout",
        lambda message: described.update(json.loads(message.data)),
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    )
    while not (_matched(publishers) and described and _knows_the_camera(described)):
        if _matched(publishers):
            publishers["/camera_info"].publish(camera_info.data)
        rclpy.spin_once(node, timeout_sec=0.05)


def _knows_the_camera(described: dict) -> bool:
    return described["units"] == "m" or described["metres_per_unit"] is None


def _matched(publishers: dict[str, Any]) -> bool:
    """Return whether both the node and the recorder listen to every topic."""
    return all(publisher.get_subscription_count() >= 2 for publisher in publishers.values())


if __name__ == "__main__":
    play(Path(sys.argv[1]))
