# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node `lifter`: a thin shell over LiftStream. The only place that imports rclpy.

Subscribes `keypoints` (2D), `camera_info` and `depth` (optional); publishes ~/poses, ~/bodies, ~/keypoints3d,
~/markers, ~/layout and /diagnostics. Headers are the input's own.
"""

from __future__ import annotations

import os

# Before numpy: its threads cost up to 100x on matrices as small as these, and rob the robot's other nodes.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import array
import functools
import importlib
import json
import re
import signal
import sys
import threading
import time
from collections import Counter

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String

import msg_adapters
from paul_ros.model import ModelError
from paul_ros.parameters import LIVE, PARAMETERS, Parameter, as_markdown
from paul_ros.skeleton import LayoutError
from paul_ros.stream import OUTPUTS, Frame, LiftStream, open_stream

#: Matches every publisher; a few frames deep, so that a hiccup of the scheduler loses none.
_INPUT_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
_OUTPUT_QOS = QoSProfile(depth=10)
_LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LOOK_SECONDS = 0.2
#: Detectors that send a message a person send those of one image in one go: two such silences tell that they are all.
_SILENCE_SECONDS = 0.005
_WARN_SECONDS = 5.0
#: An idle node looks this often whether a signal asked it to end.
_STOP_SECONDS = 0.2


@functools.cache
def message_class(type_name: str) -> type:
    """The class of 'package/msg/Name'; raises ImportError where its package is not installed."""
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except AttributeError:
        raise ImportError(f"{package} has no message {name}") from None


class RosMake:
    """The factory of msg_adapters.outputs for rclpy's message classes."""

    def __call__(self, type_name: str, **fields):
        return message_class(type_name)(**fields)

    @staticmethod
    def octets(data: bytes) -> array.array:
        return array.array("B", data)


class LifterNode(Node):
    """Subscribes, hands messages to the stream, publishes what comes back, and says aloud what is wrong."""

    def __init__(self) -> None:
        """Raises ModelError or LayoutError where the parameters name something that cannot be used."""
        super().__init__("lifter")
        self._make = RosMake()
        # Discovery and the first frames take their time: silence is worth a warning only after a while.
        self._warned = {"no input": time.monotonic(), "silent": time.monotonic()}
        self._reported: Counter = Counter()
        self._described: dict = {}
        self._topic = self.resolve_topic_name("keypoints")
        self._input_type: str | None = None
        self._seen: Counter = Counter()
        self._last_number = 0
        values = self._declare_parameters()
        self.stream = self._open_stream(values)
        self._told = self.stream.route
        self.add_on_set_parameters_callback(self._take_parameters)
        self._outputs = {
            name: self.create_publisher(message_class(type_name), f"~/{name}", _OUTPUT_QOS)
            for name, type_name in OUTPUTS.items()
        }
        self._layout = self.create_publisher(String, "~/layout", _LATCHED_QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", _OUTPUT_QOS)
        self.create_subscription(CameraInfo, "camera_info", self._on_camera_info, _INPUT_QOS)
        self.create_subscription(Image, "depth", self._on_depth, _INPUT_QOS)
        self._publish_layout()
        self._look_timer = self.create_timer(_LOOK_SECONDS, self._look_for_input)
        # Steady: a simulation that stands still would hold the last image back.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._silence_timer = self.create_timer(_SILENCE_SECONDS, self._on_silence, clock=steady, autostart=False)
        self._silences = 0
        self.create_timer(1.0, self._publish_diagnostics)

    def summary(self) -> str:
        """What was done, in one line."""
        counts = self.stream.counts
        median, p99 = _microseconds(self.stream.lift_us)
        return (
            f"lifter: {counts['frames']} frames, {counts['lifted']} of {counts['persons']} persons "
            f"lifted, median {median:.0f} µs, p99 {p99:.0f} µs a frame; "
            f"dropped: {_listed(self.stream.drops)}"
        )

    # --- parameters

    def _declare_parameters(self) -> dict:
        return {
            parameter.name: self.declare_parameter(parameter.name, parameter.default, _descriptor(parameter)).value
            for parameter in PARAMETERS
        }

    def _open_stream(self, values: dict) -> LiftStream:
        self._wanted_type = values["input_type"]
        if self._wanted_type != "auto" and self._wanted_type not in msg_adapters.SUPPORTED:
            raise ValueError(
                f"input_type is {self._wanted_type}; it must be auto or one of {', '.join(msg_adapters.SUPPORTED)}"
            )
        return open_stream(**values)

    def _take_parameters(self, parameters) -> SetParametersResult:
        """Sets those that may change; one that the model cannot have is refused with the reason."""
        try:
            for parameter in parameters:
                if parameter.name in LIVE:
                    setattr(self.stream, parameter.name, parameter.value)
        except ModelError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._publish_layout()
        return SetParametersResult(successful=True)

    # --- topics

    def _look_for_input(self) -> None:
        """Subscribes as soon as the type of the input is known; until then says aloud what is missing."""
        topic, types = self._topic, [self._wanted_type]
        if self._wanted_type == "auto":
            types = sorted({info.topic_type for info in self.get_publishers_info_by_topic(topic)})
        readable = [name for name in types if name in msg_adapters.SUPPORTED]
        if not types:
            self._warn("no input", f"nobody publishes {topic} yet; remap `keypoints` to your detector")
        elif not readable:
            self._warn(
                "unknown type",
                f"{topic} has the type {', '.join(types)}, which cannot be read; "
                f"readable are {', '.join(msg_adapters.SUPPORTED)}",
            )
        else:
            self._subscribe_keypoints(readable[0])

    def _subscribe_keypoints(self, type_name: str) -> None:
        try:
            kind = message_class(type_name)
        except ImportError as error:
            self._warn(
                "no package",
                f"{self._topic} has the type {type_name}, whose package cannot be "
                f"imported ({error}); install it or source its workspace",
            )
            return
        self.create_subscription(kind, self._topic, self._on_keypoints, _INPUT_QOS)
        self._input_type = type_name
        self._look_timer.cancel()
        self.get_logger().info(f"reading {type_name} from {self._topic}")

    # --- messages

    def _on_camera_info(self, msg: CameraInfo) -> None:
        self.stream.camera_info(msg)
        self._report_drops()
        if self.stream.notes["distorted_image"] and "distorted_image" not in self._warned:
            self._warn("distorted_image", self.stream.explanations["distorted_image"])
        self._publish_layout()

    def _on_depth(self, msg: Image) -> None:
        self.stream.depth(msg)
        self._report_drops()

    def _on_keypoints(self, msg, info: dict) -> None:
        self._count_missed(info["publication_sequence_number"])
        self._take(self.stream.keypoints(self._input_type, msg, self._topic))
        if self._input_type in msg_adapters.ONE_PERSON:
            self._silences = 0
            self._silence_timer.reset()

    def _on_silence(self) -> None:
        """Flushes at the second tick: at the first, if this process was kept from running, a message may be waiting."""
        self._silences += 1
        if self._silences == 2:
            self._silence_timer.cancel()
            self.flush()

    def flush(self) -> None:
        """Lifts and publishes the persons that the stream keeps for more of their image."""
        self._take(self.stream.flush())

    def _take(self, frame: Frame | None) -> None:
        if frame is not None:
            if self.stream.route is not self._told:
                self._tell_layouts()
            with self.stream.guard():
                self._publish(frame)
        self._report_drops()

    def _count_missed(self, number: int) -> None:
        """Counts what was published and got lost, or was replaced by newer while this node was busy.

        Of several publishers the numbers cannot be told apart; then nothing is counted.
        """
        missed = number - self._last_number - 1 if self._last_number else 0
        self._last_number = number
        if missed > 0 and self.count_publishers(self._topic) == 1:
            self.stream.drops["missed"] += missed
            self.stream.explanations["missed"] = "Lost on the way, or newer came before they could be lifted"

    def _publish(self, frame: Frame) -> None:
        """Builds what somebody listens to and then publishes it, so that a fault leaves no half frame."""
        built = [
            (publisher, frame.message(name, self._make))
            for name, publisher in self._outputs.items()
            if publisher.get_subscription_count()
        ]
        for publisher, message in built:
            publisher.publish(message)

    def _tell_layouts(self) -> None:
        """Once, when the first message has shown which layout the detector uses, and before its frame goes out."""
        self._told = self.stream.route
        self.get_logger().info(
            f"{self._topic} is taken to have the points of {self._told.given.name}, set the parameter `layout` if it "
            f"has others; published are those of {self._told.output.name}"
        )
        self._publish_layout()

    def _publish_layout(self) -> None:
        """Says what the outputs mean, again whenever that changes."""
        described = self.stream.describe()
        if described == self._described:
            return
        if self._described.get("units", described["units"]) != described["units"]:
            self.get_logger().info(f"units are now {described['units']}: {described['scale_source']}")
        self._described = described
        self._layout.publish(String(data=json.dumps(described)))

    # --- what is wrong, aloud

    def _warn(self, key: str, text: str) -> None:
        """Logs a warning at once, and the same one again at most every _WARN_SECONDS."""
        now = time.monotonic()
        if now - self._warned.get(key, -_WARN_SECONDS) >= _WARN_SECONDS:
            self._warned[key] = now
            self.get_logger().warning(text)

    def _report_drops(self) -> None:
        for reason, count in self.stream.drops.items():
            if count != self._reported[reason]:
                self._reported[reason] = count
                explanation = self.stream.explanations.get(reason, "")
                self._warn(reason, f"dropped: {reason}, {count} so far. {explanation}")

    def _publish_diagnostics(self) -> None:
        frames = self.stream.counts["frames"] - self._seen["frames"]
        dropped = self.stream.drops - self._seen
        self._seen = self.stream.counts + self.stream.drops
        status = self._status(*self._health(frames, dropped))
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
        # Not before the first second is over: CameraInfo may come a little later than the keypoints.
        if frames and self.stream.units == "model" and "units" not in self._warned:
            self._warn("units", f"lifting in model units, not metres: {self._described['scale_source']}")

    def _health(self, frames: int, dropped: Counter) -> tuple[bytes, str]:
        """Level and one line, from what came and what was dropped in the last second."""
        if self._input_type is None:
            return DiagnosticStatus.WARN, "no input yet"
        if frames:
            self._warned["silent"] = time.monotonic()
        elif not dropped:
            self._warn("silent", f"no keypoints for {_WARN_SECONDS:.0f} s")
            return DiagnosticStatus.WARN, "no keypoints in the last second"
        message = f"{frames} frames in the last second, units: {self.stream.units}"
        if not dropped:
            return DiagnosticStatus.OK, message
        level = DiagnosticStatus.ERROR if dropped["internal_error"] else DiagnosticStatus.WARN
        return level, f"{message}; dropped: {_listed(dropped)}"

    def _status(self, level: bytes, message: str) -> DiagnosticStatus:
        stream = self.stream
        median, p99 = _microseconds(stream.lift_us)
        values = {
            **stream.counts,
            **_prefixed("dropped_", stream.drops),
            **_prefixed("noted_", stream.notes),
            "lift_us_median": f"{median:.1f}",
            "lift_us_p99": f"{p99:.1f}",
            "units": stream.units,
            "input_type": self._input_type or "none",
            "model": self._described["model"],
            "model_sha256": self._described["model_sha256"],
        }
        pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        name = self.get_fully_qualified_name().lstrip("/")
        return DiagnosticStatus(level=level, name=f"{name}: lifting", message=message, hardware_id="", values=pairs)


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=parameter.description, read_only=not parameter.live)
    if isinstance(parameter.default, float):
        low, high = parameter.limits
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    elif isinstance(parameter.default, int):
        low, high = parameter.limits
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return descriptor


def _listed(counter: Counter) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counter.items())) or "none"


def _prefixed(prefix: str, counter: Counter) -> dict:
    return {prefix + name: count for name, count in sorted(counter.items())}


def _microseconds(times) -> tuple[float, float]:
    """Median and 99th percentile, 0 before the first."""
    return tuple(np.percentile(times, (50, 99)).tolist()) if times else (0.0, 0.0)


def _process_seconds() -> float:
    """Seconds since this process started, by the kernel's clock."""
    with open("/proc/self/stat", encoding="ascii") as file:
        # The second field, the name, may hold spaces; the start time is the 20th after it.
        ticks = int(file.read().rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


def _parse(argv: list[str]) -> None:
    """There are only ROS arguments; --help tells which, anything else is refused."""
    parser = argparse.ArgumentParser(
        prog="lifter",
        description="Lift 2D keypoints to 3D: subscribes keypoints, camera_info and depth, "
        "publishes ~/poses, ~/bodies, ~/keypoints3d, ~/markers, ~/layout and /diagnostics.",
        epilog="Set parameters with --ros-args -p NAME:=VALUE, topics with --ros-args -r keypoints:=TOPIC."
        f"\n\n{as_markdown()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.parse_args(remove_ros_args(argv)[1:])


def _join_ros(argv: list[str]) -> None:
    """Reads the arguments and starts rclpy; raises ValueError where ROS does not take them."""
    try:
        _parse(argv)
        # rclpy's own handlers would shut the context down in the midst of a frame, which could not be published.
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ValueError(
            f"ROS does not start: {error}; arguments are --ros-args -p NAME:=VALUE, -r FROM:=TO, "
            "--params-file FILE, see --help"
        ) from error


def _one_line(error: Exception) -> str:
    """The error's text without line breaks and the places in rcl's own source that it names."""
    return re.sub(r",? at \S+\.c(pp)?:\d+", "", " ".join(str(error).split()))


def main() -> int:
    """Runs the node until SIGINT or SIGTERM; 0 after a clean end, 1 where it cannot start."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        _join_ros(sys.argv)
        node = LifterNode()
    # rclpy has no common class for its errors, but most are RuntimeErrors.
    except (ModelError, LayoutError, ParameterException, ValueError, RuntimeError) as error:
        print(f"lifter: {_one_line(error)}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    node.get_logger().info(f"ready {_process_seconds():.2f} s after the process started")
    _spin(node, stop)
    print(node.summary(), file=sys.stderr, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


def _spin(node: LifterNode, stop: threading.Event) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok() and not stop.is_set():
        executor.spin_once(timeout_sec=_STOP_SECONDS)
    node.flush()


if __name__ == "__main__":
    sys.exit(main())
