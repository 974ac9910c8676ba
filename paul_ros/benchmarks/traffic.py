# SPDX-License-Identifier: Apache-2.0
"""The two ends of `paul benchmark node`, each a process of its own.

`python -m paul_ros.benchmarks.traffic publish` is told what to send by lines of JSON on stdin and answers each with
one; `... listen` writes a record of three numbers to stdout for every message that a node answers with. Both handle
serialised bytes only, so that little of what is measured is their own.
"""

from __future__ import annotations

import json
import os
import select
import struct
import sys
import time
from collections.abc import Iterator
from functools import partial

import numpy as np

NODES = ("lifter", "echo")
"""A node of this name reads /NAME/keypoints and publishes /NAME/poses."""
ARRIVAL = np.dtype([("node", "<i8"), ("stamp", "<i8"), ("arrival", "<i8")])
"""What the listener writes: index in NODES, header.stamp of the answer and when it came, ns of the system's clock."""

#: Little-endian CDR begins with four bytes of its own; a message with a header begins with the stamp.
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
_SECOND = 10**9


def publish() -> None:
    """Says {} when it is ready, then sends keypoints until stdin closes.

    A command has `node`, `messages` (.npy of serialised clouds, (K,L) uint8, sent in turn), `rate_hz` and `count`; null
    for until the next line comes, which may be empty. Every message gets the time of its sending as stamp. With a count
    it waits until the node has subscribed. The answer is {sent, first, last}: how many, the first and the last stamp.
    A command with `camera_info` (.npy of one serialised message) sends that to the lifter until it says that it knows
    the camera.
    """
    import rclpy
    from sensor_msgs.msg import CameraInfo, PointCloud2

    rclpy.init()
    node = rclpy.create_node("benchmark_publisher")
    publishers = {name: node.create_publisher(PointCloud2, f"/{name}/keypoints", 10) for name in NODES}
    camera = node.create_publisher(CameraInfo, "/lifter/camera_info", 10)
    print(json.dumps({}), flush=True)
    for line in _lines():
        command = json.loads(line)
        if "camera_info" in command:
            _tell_camera(node, camera, np.load(command["camera_info"])[0].tobytes())
            answer = {}
        else:
            messages = [bytearray(row.tobytes()) for row in np.load(command["messages"])]
            answer = _send(publishers[command["node"]], messages, command["rate_hz"], command["count"])
        print(json.dumps(answer), flush=True)
    rclpy.shutdown()


def _lines() -> Iterator[str]:
    """Lines of stdin, read without a buffer, so that select() tells truly whether there is one more."""
    kept = b""
    while data := os.read(0, 4096):
        *lines, kept = (kept + data).split(b"\n")
        yield from (line.decode() for line in lines if line.strip())


def _send(publisher, messages: list[bytearray], rate: float, count: int | None) -> dict:
    while count and not publisher.get_subscription_count():
        time.sleep(0.01)
    began, sent, first, stamp = time.monotonic(), 0, 0, 0
    while sent != count and (count or not _told_to_stop()):
        time.sleep(max(0.0, began + sent / rate - time.monotonic()))
        message = messages[sent % len(messages)]
        stamp = time.time_ns()
        _STAMP.pack_into(message, _STAMP_AT, *divmod(stamp, _SECOND))
        publisher.publish(bytes(message))
        first, sent = first or stamp, sent + 1
    return {"sent": sent, "first": first, "last": stamp}


def _told_to_stop() -> bool:
    return bool(select.select([0], [], [], 0)[0])


def _tell_camera(node, publisher, message: bytes) -> None:
    """CameraInfo is sent again until ~/layout says that the output is in metres: a first one may come too early."""
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    described: dict = {}
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    layout = node.create_subscription(
        String, "/lifter/layout", lambda text: described.update(json.loads(text.data)), latched
    )
    while described.get("units") != "m":
        if publisher.get_subscription_count():
            publisher.publish(message)
        rclpy.spin_once(node, timeout_sec=0.05)
    node.destroy_subscription(layout)


def listen() -> None:
    """Writes an ARRIVAL for every message of the nodes, until a signal; one of no node when it is ready."""
    import rclpy
    from geometry_msgs.msg import PoseArray
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import QoSProfile

    rclpy.init()
    node = rclpy.create_node("benchmark_listener")

    def record(index: int, data: bytes) -> None:
        arrival = time.time_ns()
        seconds, rest = _STAMP.unpack_from(data, _STAMP_AT)
        os.write(1, struct.pack("<qqq", index, seconds * _SECOND + rest, arrival))

    for index, name in enumerate(NODES):
        node.create_subscription(PoseArray, f"/{name}/poses", partial(record, index), QoSProfile(depth=1000), raw=True)
    os.write(1, struct.pack("<qqq", -1, 0, time.time_ns()))
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()


if __name__ == "__main__":
    {"publish": publish, "listen": listen}[sys.argv[1]]()
