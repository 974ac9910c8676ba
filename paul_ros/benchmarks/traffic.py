# SPDX-License-Identifier: Apache-2.0
"""The publisher and the listener of `paul benchmark node`, each a process of its own.

`python -m paul_ros.benchmarks.traffic publish` reads commands from stdin, a line of JSON each, and answers each with
one line. `... listen` writes one ARRIVAL to stdout for every output of a node. Both handle serialised bytes only, to
add little to what is measured.
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
from typing import Any

import numpy as np

#: Names of the measured nodes, which read /NAME/keypoints and publish /NAME/poses.
NODES = ("lifter", "echo")

#: Record of the listener: index in NODES (-1 = ready), then header.stamp of the output and the time of its arrival,
#: both in ns of the system's clock.
ARRIVAL = np.dtype([("node", "<i8"), ("stamp", "<i8"), ("arrival", "<i8")])

#: The stamp follows the four bytes that begin little-endian CDR, in a message that begins with a header.
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
_SECOND = 10**9


def publish() -> None:
    """Answer {} when ready, then obey commands until stdin closes.

    A command to send keypoints has these keys, and the answer is {sent, first, last}: a count and two stamps in ns.

    - node: one of NODES.
    - messages: .npy file of serialised clouds, (K,L) uint8, sent in turn, each stamped with the time of its sending.
    - rate_hz: rate of the messages.
    - count: number of messages, sent once the node has subscribed; null = until the next line, which may be empty.

    A command with `camera_info`, the .npy file of one serialised message, sends that to the lifter until its output is
    in metres.
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
            _send_camera(node, camera, np.load(command["camera_info"])[0].tobytes())
            answer = {}
        else:
            messages = [bytearray(row.tobytes()) for row in np.load(command["messages"])]
            answer = _send(publishers[command["node"]], messages, command["rate_hz"], command["count"])
        print(json.dumps(answer), flush=True)
    rclpy.shutdown()


def _lines() -> Iterator[str]:
    """Yield the lines of stdin, read without a buffer so that select() sees whether one more is there."""
    kept = b""
    while data := os.read(0, 4096):
        *lines, kept = (kept + data).split(b"\n")
        yield from (line.decode() for line in lines if line.strip())


def _send(publisher: Any, messages: list[bytearray], rate: float, count: int | None) -> dict:
    while count and not publisher.get_subscription_count():
        time.sleep(0.01)
    began, sent, first, stamp = time.monotonic(), 0, 0, 0
    while sent != count and (count or not _next_line_waits()):
        time.sleep(max(0.0, began + sent / rate - time.monotonic()))
        message = messages[sent % len(messages)]
        stamp = time.time_ns()
        _STAMP.pack_into(message, _STAMP_AT, *divmod(stamp, _SECOND))
        publisher.publish(bytes(message))
        first, sent = first or stamp, sent + 1
    return {"sent": sent, "first": first, "last": stamp}


def _next_line_waits() -> bool:
    return bool(select.select([0], [], [], 0)[0])


def _send_camera(node: Any, publisher: Any, message: bytes) -> None:
    """Send CameraInfo until ~/layout shows metres: the node may not have matched the first one yet."""
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
    """Write an ARRIVAL of node -1 when ready, then one for every output of the nodes, until a signal."""
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
