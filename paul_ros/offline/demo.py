# SPDX-License-Identifier: Apache-2.0
"""`paul demo`: the real node, fed with recorded bags over DDS, its answers recorded and checked.

Three processes: this one records, `python -m paul_ros.ros.lifter_process` lifts, and `python -m
paul_ros.offline.demo BAG` plays.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Callable

import numpy as np

from msg_adapters.keypoints import stamp_ns
from paul_ros.errors import BagError, DemoError
from paul_ros.offline.bag import LATCHED_QOS, BagWriter, Record, read_messages, read_records
from paul_ros.offline.processes import need_ros, process, ros_environment, rss_mb, tail
from paul_ros.offline.replay import CAMERA_INFO, NODE, POSE_ARRAY, LiftedFrame, Replay, evaluate
from paul_ros.offline.replay import replay as replay_bag
from paul_ros.offline.report import table, write_json, write_picture
from paul_ros.stream.stream import open_stream

BAGS = ("one_person", "two_persons_crossing")
LAYOUT = "coco17"
AGREEMENT = 1e-6
"""Live and replayed points may differ by this share of the skeleton's size."""

_CLOUD = "sensor_msgs/msg/PointCloud2"
_PLAYED = {"/camera_info": CAMERA_INFO, "/keypoints": _CLOUD}
_RECORDED = {
    **_PLAYED,
    f"{NODE}/layout": "std_msgs/msg/String",
    f"{NODE}/poses": POSE_ARRAY,
    f"{NODE}/bodies": POSE_ARRAY,
    f"{NODE}/keypoints3d": _CLOUD,
    f"{NODE}/markers": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
_PATIENCE = 30.0  # seconds for a process to start or to end
_SILENCE = 5.0  # seconds without a message after which no more is expected


@dataclass(frozen=True)
class Live:
    """What a run of the node gave. sent, received: keypoint messages played, PoseArrays recorded."""

    recording: Path
    sent: int
    received: int
    start_to_ready_s: float
    rss_mb: float
    lift_us_median: float
    lift_us_p99: float


def demo(out: Path, model: str | None = None) -> None:
    """Run and check both bags; leave lifted bags, report.json and pictures in `out`; print tables and paths.

    report.json has the keys of `paul replay --json` for the first bag and, under its name, for the second; beside
    them `live`, what concerns the node. Raises DemoError, BagError, ModelError.
    """
    out.mkdir(parents=True, exist_ok=True)
    reports, files = [], []
    for index, name in enumerate(BAGS):
        recording = out / ("lifted.mcap" if index == 0 else f"{name}_lifted.mcap")
        picture = out / ("picture.png" if index == 0 else f"{name}.png")
        replayed = replay_bag(find_bag(name), open_stream(model, LAYOUT))
        print(f"playing {name} to the node, {_seconds(replayed):.0f} s ...", file=sys.stderr, flush=True)
        live = run_live(replayed.bag, recording, model)
        done, agreement = compare(replayed, recording)
        reports.append(_report(done, live, agreement))
        write_picture(picture, done)
        print(table(reports[-1]) + "\n" + _live_table(reports[-1]["live"]) + "\n")
        files += [recording, picture]
    write_json(out / "report.json", {**reports[0], **dict(zip(BAGS[1:], reports[1:]))})
    print("\n".join(str(file) for file in (*files, out / "report.json")))
    for name, report in zip(BAGS, reports):
        _demand_agreement(name, report["live"])


def find_bag(name: str) -> Path:
    """A recording beside the source, or in share/paul_ros/bags of the installation. Raises BagError."""
    for parent in Path(__file__).resolve().parents:
        for folder in (parent / "bags", parent / "share" / "paul_ros" / "bags"):
            if (folder / f"{name}.mcap").is_file():
                return folder / f"{name}.mcap"
    raise BagError(f"the recording '{name}' is not installed; `python bags/make_bags.py` in the source makes it")


# --- checking


def compare(replayed: Replay, recording: Path) -> tuple[Replay, dict]:
    """The replay with the live points in place of its own, joined by header.stamp; and how far the two agree.

    Frames that the live node lost are left out.
    """
    order, live = [], {}
    for _, _, message, _ in read_messages(recording, [f"{NODE}/poses"]):
        order.append(stamp_ns(message.header))
        live[order[-1]] = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses]).reshape(-1, 3)
    frames, differences, persons_differ = [], [0.0], 0
    for frame in replayed.frames:
        if frame.stamp not in live:
            continue
        expected = frame.lifted.points[frame.lifted.ok]
        if live[frame.stamp].size != expected.size:
            persons_differ += 1
            continue
        points = live[frame.stamp].reshape(expected.shape)
        differences += _relative_differences(points, expected)
        frames.append(_with_points(frame, points))
    return replace(replayed, frames=frames), {
        "frames_lost": sum(frame.stamp not in live for frame in replayed.frames),
        "frames_unknown": len(set(live) - {frame.stamp for frame in replayed.frames}),
        "frames_with_other_persons": persons_differ,
        "order_kept": order == sorted(set(order)),
        "max_difference_relative": max(differences),
    }


def _relative_differences(points: np.ndarray, expected: np.ndarray) -> list[float]:
    """For each person the largest coordinate difference over the skeleton's largest extent."""
    size = np.ptp(expected, axis=1).max(axis=1)
    return (np.abs(points - expected).max(axis=(1, 2)) / size).tolist()


def _with_points(frame: LiftedFrame, points: np.ndarray) -> LiftedFrame:
    everyone = frame.lifted.points.copy()
    everyone[frame.lifted.ok] = points
    return replace(frame, lifted=replace(frame.lifted, points=everyone))


def _report(done: Replay, live: Live, agreement: dict) -> dict:
    report = {**evaluate(done), "lift_us_median": live.lift_us_median, "lift_us_p99": live.lift_us_p99}
    report["live"] = {
        "frames_sent": live.sent,
        "frames_received": live.received,
        **agreement,
        "start_to_ready_s": live.start_to_ready_s,
        "rss_mb": live.rss_mb,
    }
    return report


def _live_table(live: dict) -> str:
    order = "order kept" if live["order_kept"] else "ORDER BROKEN"
    return "\n".join(
        [
            f"  {'node, start to ready':<22}{live['start_to_ready_s']:>9.2f}{'':>9}  s",
            f"  {'node, memory':<22}{live['rss_mb']:>9.1f}{'':>9}  MB",
            f"  {'node, frames':<22}{live['frames_received']:>9}{'':>9}  of {live['frames_sent']} sent, "
            f"{live['frames_lost']} lost, {order}",
            f"  {'live against replay':<22}{live['max_difference_relative']:>9.1e}{'':>9}  of the skeleton at most",
        ]
    )


def _demand_agreement(name: str, live: dict) -> None:
    if live["frames_lost"] or live["frames_unknown"]:
        raise DemoError(
            f"{name}: the node answered {live['frames_received']} of {live['frames_sent']} frames; is the machine busy?"
        )
    if not live["order_kept"] or live["frames_with_other_persons"] or live["max_difference_relative"] > AGREEMENT:
        raise DemoError(f"{name}: what the node published is not what the replay gives; please report this")


def _seconds(replayed: Replay) -> float:
    return (replayed.frames[-1].stamp - replayed.frames[0].stamp) / 1e9


# --- running


def run_live(bag: Path, recording: Path, model: str | None = None) -> Live:
    """Start the node, play the bag to it in real time, record what all say. Raises DemoError."""
    need_ros("the demo")
    environment = ros_environment()
    sent = sum(1 for _ in read_records(bag, ["/keypoints"]))
    with tempfile.TemporaryFile() as log, BagWriter(recording) as writer, _Recorder(environment, writer) as recorder:
        began = time.monotonic()
        parameters = ["-p", f"layout:={LAYOUT}", *(["-p", f"model:={model}"] if model else [])]
        with process(["paul_ros.ros.lifter_process", "--ros-args", *parameters], environment, log) as node:
            recorder.spin_until(lambda: recorder.counts[f"{NODE}/layout"], node, log, _PATIENCE)
            ready = time.monotonic() - began
            with process(["paul_ros.offline.demo", str(bag)], environment, log) as player:
                recorder.spin_while_messages_come(sent, node, player, log)
                rss = rss_mb(node.pid)
            diagnosed = recorder.counts["/diagnostics"]
            recorder.spin_until(lambda: recorder.counts["/diagnostics"] > diagnosed, node, log, _PATIENCE)
            _end(node, log)
        received = recorder.counts[f"{NODE}/poses"]
    median, p99 = _lift_times(recording)
    return Live(recording, sent, received, ready, rss, median, p99)


def _end(node: subprocess.Popen, log: Any) -> None:
    node.send_signal(signal.SIGINT)
    try:
        code = node.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        code = None
    if code != 0:
        raise DemoError(f"the node did not end well (exit code {code}): {tail(log)}")


class _Recorder:
    """A ROS node that writes every message of _RECORDED to a bag, undecoded."""

    def __init__(self, environment: dict[str, str], writer: BagWriter):
        self._domain = int(environment["ROS_DOMAIN_ID"])
        self._writer = writer
        self.counts = dict.fromkeys(_RECORDED, 0)

    def __enter__(self) -> _Recorder:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile

        self._context = rclpy.Context()
        self._context.init(domain_id=self._domain)
        self._node = rclpy.create_node("demo_recorder", context=self._context)
        for topic, type_name in _RECORDED.items():
            qos = QoSProfile(depth=1000)
            if topic == f"{NODE}/layout":
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self._node.create_subscription(
                _message_class(type_name), topic, self._write(topic, type_name), qos, raw=True
            )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        return self

    def __exit__(self, *error: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _write(self, topic: str, type_name: str) -> Callable[[bytes], None]:
        qos = LATCHED_QOS if topic == f"{NODE}/layout" else ""

        def take(data: bytes) -> None:
            self._writer.write_cdr(topic, type_name, bytes(data), time.time_ns(), qos)
            self.counts[topic] += 1

        return take

    def spin_until(self, condition: Callable[[], Any], node: subprocess.Popen, log: Any, seconds: float) -> None:
        end = time.monotonic() + seconds
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)
            if node.poll() is not None:
                raise DemoError(f"the node ended by itself (exit code {node.returncode}): {tail(log)}")
            if time.monotonic() > end:
                raise DemoError(f"the node did not answer within {seconds:.0f} s: {tail(log)}")

    def spin_while_messages_come(
        self, expected: int, node: subprocess.Popen, player: subprocess.Popen, log: Any
    ) -> None:
        """Until every frame was answered, or nothing has come for a while after the first one."""
        poses = f"{NODE}/poses"
        self.spin_until(lambda: self.counts[poses] or player.poll() is not None, node, log, _PATIENCE)
        if player.poll() is not None:
            raise DemoError(f"the player ended early: {tail(log)}")
        seen, last = 0, time.monotonic()
        while self.counts[poses] < expected and time.monotonic() - last < _SILENCE:
            self._executor.spin_once(timeout_sec=0.05)
            if self.counts[poses] > seen:
                seen, last = self.counts[poses], time.monotonic()


def _message_class(type_name: str) -> type:
    import importlib

    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _lift_times(recording: Path) -> tuple[float, float]:
    """Median and 99th percentile in µs as the node last told them on /diagnostics."""
    values: dict[str, str] = {}
    for _, _, message, _ in read_messages(recording, ["/diagnostics"]):
        values = {pair.key: pair.value for status in message.status for pair in status.values}
    return float(values["lift_us_median"]), float(values["lift_us_p99"])


# --- playing


def play(bag: Path) -> None:
    """Publish camera_info and keypoints of a bag at the pace of their log times, each once.

    Waits before until the node and the recorder are matched and the node knows the camera; waits afterwards
    until stdin closes, so that nothing under way is lost.
    """
    import rclpy

    records = list(read_records(bag, _PLAYED))
    rclpy.init()
    node = rclpy.create_node("demo_player")
    publishers = {topic: node.create_publisher(_message_class(kind), topic, 100) for topic, kind in _PLAYED.items()}
    _wait_for_listeners(node, publishers, next(r for r in records if r.topic == "/camera_info"))
    began, first = time.monotonic(), records[0].log_time
    for record in records:
        time.sleep(max(0.0, began + (record.log_time - first) / 1e9 - time.monotonic()))
        publishers[record.topic].publish(record.data)
    sys.stdin.read()
    rclpy.shutdown()


def _wait_for_listeners(node: Any, publishers: dict, camera_info: Record) -> None:
    """No frame may overtake the first CameraInfo, so it goes ahead until the node's layout tells that it came."""
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    described: dict = {}
    node.create_subscription(
        String,
        f"{NODE}/layout",
        lambda message: described.update(json.loads(message.data)),
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    )
    while not (_matched(publishers) and described and _knows_the_camera(described)):
        if _matched(publishers):
            publishers["/camera_info"].publish(camera_info.data)
        rclpy.spin_once(node, timeout_sec=0.05)


def _knows_the_camera(described: dict) -> bool:
    return described["units"] == "m" or described["metres_per_unit"] is None


def _matched(publishers: dict) -> bool:
    """The node and the recorder both listen to everything."""
    return all(publisher.get_subscription_count() >= 2 for publisher in publishers.values())


if __name__ == "__main__":
    play(Path(sys.argv[1]))
