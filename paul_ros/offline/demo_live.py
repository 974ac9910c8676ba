# SPDX-License-Identifier: Apache-2.0
"""A live run of the node in three processes.

This one records, `paul_ros.ros.lifter_process` lifts, `demo_player` plays.
"""

from __future__ import annotations

import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from paul_ros.errors import DemoError
from paul_ros.offline.bag_reader import read_messages, read_records
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.demo_recorder import Recorder
from paul_ros.offline.processes import need_ros, process, ros_environment, rss_mb, tail
from paul_ros.offline.replay import NODE_NAME

#: Layout of the keypoints in the shipped bags.
LAYOUT = "coco17"

_TIMEOUT = 30.0  # seconds for a process to start or to end


@dataclass(frozen=True)
class Live:
    """A finished run of the node.

    Attributes:
        recording: bag with the inputs and outputs of the node.
        sent: number of keypoint messages played.
        received: number of PoseArrays recorded.
        start_to_ready_s: seconds from the start of the process to its first ~/layout.
        rss_mb: resident memory after the last frame.
        lift_us_median: median time to lift a message in microseconds, from /diagnostics.
        lift_us_p99: 99th percentile of the same.
    """

    recording: Path
    sent: int
    received: int
    start_to_ready_s: float
    rss_mb: float
    lift_us_median: float
    lift_us_p99: float


def run_live(bag: Path, recording: Path, model: str | None = None) -> Live:
    """Start the node, play a bag to it in real time and record its outputs.

    Args:
        bag: the bag to play, with /camera_info and /keypoints.
        recording: the bag to write.
        model: name of a shipped model, or a path; None = the shipped human model.

    Raises:
        DemoError: the node or the player fails.
        MissingPackageError: ROS 2 is not installed.
    """
    need_ros("the demo")
    environment = ros_environment()
    sent = sum(1 for _ in read_records(bag, ["/keypoints"]))
    with tempfile.TemporaryFile() as log, BagWriter(recording) as writer, Recorder(environment, writer) as recorder:
        began = time.monotonic()
        parameters = ["-p", f"layout:={LAYOUT}", *(["-p", f"model:={model}"] if model else [])]
        with process(["paul_ros.ros.lifter_process", "--ros-args", *parameters], environment, log) as node:
            recorder.spin_until(lambda: recorder.counts[f"{NODE_NAME}/layout"] > 0, node, log, _TIMEOUT)
            ready = time.monotonic() - began
            with process(["paul_ros.offline.demo_player", str(bag)], environment, log) as player:
                recorder.spin_while_messages_come(sent, node, player, log, _TIMEOUT)
                memory = rss_mb(node.pid)
            diagnosed = recorder.counts["/diagnostics"]
            recorder.spin_until(lambda: recorder.counts["/diagnostics"] > diagnosed, node, log, _TIMEOUT)
            _stop(node, log)
        received = recorder.counts[f"{NODE_NAME}/poses"]
    median, p99 = _lift_times(recording)
    return Live(recording, sent, received, ready, memory, median, p99)


def _stop(node: subprocess.Popen, log: BinaryIO) -> None:
    node.send_signal(signal.SIGINT)
    try:
        code = node.wait(_TIMEOUT)
    except subprocess.TimeoutExpired:
        code = None
    if code != 0:
        raise DemoError(f"the node did not end well (exit code {code}): {tail(log)}")


def _lift_times(recording: Path) -> tuple[float, float]:
    """Return the median and the 99th percentile in µs from the last diagnostics."""
    values: dict[str, str] = {}
    for _, _, message, _ in read_messages(recording, ["/diagnostics"]):
        values = {pair.key: pair.value for status in message.status for pair in status.values}
    return float(values["lift_us_median"]), float(values["lift_us_p99"])
