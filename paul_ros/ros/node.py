# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node `lifter`: a thin, managed shell over LiftStream.

Subscribes `keypoints` (2D), `camera_info` and `depth` (optional); publishes ~/poses, ~/bodies, ~/keypoints3d,
~/markers, ~/layout and /diagnostics. Headers are the input's own.
"""

from __future__ import annotations

import os
import signal
import sys

if __name__ == "__main__":
    # All that follows takes a third of a second to import; a signal then is no fault.
    for _number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(_number, lambda *_: sys.exit(0))

# Before numpy: its threads cost up to 100x on matrices as small as these, and rob the robot's other nodes.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import functools
import json
import re
import threading
import time
from collections import Counter
from dataclasses import replace

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String

import msg_adapters
from paul_ros.errors import LayoutError, ModelError
from paul_ros.ros.diagnostics import Aloud, Health, Report, listed, percentiles, unscaled
from paul_ros.ros.endpoints import (
    NOT_POSSIBLE,
    OVERRIDES,
    RosMake,
    descriptor,
    input_qos,
    latched_qos,
    message_class,
    output_qos,
    unheard,
    unhearing,
)
from paul_ros.ros.keypoint_input import KeypointInput
from paul_ros.stream.parameters import LIVE, PARAMETERS, as_markdown
from paul_ros.stream.stream import OPTIONAL, OUTPUTS, PACKED, Frame, LiftStream, open_stream

_LOOK_SECONDS = 0.05
_REPORT_SECONDS = 1.0
#: Without keypoints, before a warning.
_SILENT_SECONDS = 5.0
#: Detectors that send a message a person send those of one image in one go: two such silences tell that they are all.
_SILENCE_SECONDS = 0.005
#: What is odd but used, as model units, is worth a warning so often: who has no CameraInfo knows it.
_NOTES_SECONDS = 60.0
#: An idle node looks this often whether a signal asked it to end.
_STOP_SECONDS = 0.2
#: Parameters that take another stream.
_SWITCHING = ("model", "layout", "output_layout")
#: What parameters are refused with.
_REFUSALS = (ModelError, LayoutError, *NOT_POSSIBLE)


def _transition(callback):
    """Says aloud what goes wrong in a transition: rclpy swallows it."""

    @functools.wraps(callback)
    def guarded(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return callback(self, state)
        except Exception as error:
            self.get_logger().error(f"{callback.__name__.removeprefix('on_')}: {type(error).__name__}: {error}")
            return TransitionCallbackReturn.ERROR

    return guarded


class LifterNode(LifecycleNode):
    """Subscribes, hands messages to the stream, publishes what comes back, and says aloud what is wrong.

    A managed node (design.ros2.org, Managed nodes). Configured, it has its model and its publishers; while it is
    active, and only then, it has subscriptions, publishes and counts.

    stream: None unless it is configured.
    """

    def __init__(self) -> None:
        """Raises what parameters are refused with, where one has a value that no parameter of its kind may have."""
        super().__init__("lifter")
        self._make = RosMake()
        self._writers = {name: make() for name, make in PACKED.items()}
        self._warn = Aloud(self.get_logger().warning)
        # Not ROS time: a simulation that stands still would hold the last image back, and diagnostics too.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._values = {
            parameter.name: self.declare_parameter(parameter.name, parameter.default, descriptor(parameter)).value
            for parameter in PARAMETERS
        }
        self.stream: LiftStream | None = None
        self._input: KeypointInput | None = None
        self._refusal: Exception | None = None
        self._starting = False
        self._ended = "nothing was lifted"
        self._outputs: dict = {}
        self._subscribed: list = []
        self._timers_on: list = []
        self.add_on_set_parameters_callback(self._take_parameters)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        self._jumps = self.get_clock().create_jump_callback(back, post_callback=self._on_jump)

    @property
    def active(self) -> bool:
        """Whether it lifts."""
        return bool(self._timers_on)

    def start(self) -> None:
        """Configures and activates; raises what was refused."""
        self._starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self._refusal or RuntimeError("the node could not be started, see the log")
        self._starting = False

    def end(self) -> None:
        """The transition to the last state; what it holds is published before."""
        if self._state_machine.current_state[1] != "finalized":
            self.trigger_shutdown()

    def summary(self) -> str:
        """What was done, in one line."""
        return f"lifter: {self._summed(self.stream) if self.stream else self._ended}"

    # --- transitions

    @_transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Loads the model and makes the publishers; what it cannot use it refuses, and may be asked again."""
        try:
            self._configure()
        except _REFUSALS as error:
            self._clean()
            return self._refuse(error)
        return TransitionCallbackReturn.SUCCESS

    @_transition
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribes and publishes from now on."""
        super().on_activate(state)
        try:
            self._activate()
        except _REFUSALS as error:
            self._deactivate()
            super().on_deactivate(state)
            return self._refuse(error)
        return TransitionCallbackReturn.SUCCESS

    @_transition
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publishes what it holds, then neither listens nor publishes."""
        self._deactivate()
        return super().on_deactivate(state)

    @_transition
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forgets the model and all that was counted."""
        self._clean()
        return TransitionCallbackReturn.SUCCESS

    @_transition
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From any state."""
        self._deactivate()
        self._clean()
        return TransitionCallbackReturn.SUCCESS

    @_transition
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Back to unconfigured, whatever went wrong."""
        return self.on_shutdown(state)

    def _configure(self) -> None:
        self.stream = open_stream(**self._values)
        self._input = KeypointInput(
            self,
            "keypoints",
            self._values["input_type"],
            self._on_keypoints,
            lambda: self.stream.max_persons,
            self._warn,
            self._on_nobody,
            self._on_mismatch,
        )
        self._health = Health(time.monotonic())
        self._told, self._described = self.stream.route, {}
        self._reported, self._noted = Counter(), Counter()
        self._outputs = {
            name: self._publisher(message_class(type_name), f"~/{name}") for name, type_name in OUTPUTS.items()
        }
        self._outputs.update(self._optional_outputs())
        self._layout = self._publisher(String, "~/layout", latched_qos())
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics")

    def _optional_outputs(self) -> dict:
        """Name -> publisher. Raises ValueError where a parameter asks for what is not installed."""
        made = {}
        if self._values["publish_tf"]:
            try:
                made["transforms"] = self._publisher(message_class(OPTIONAL["transforms"]), "/tf")
            except ImportError as error:
                raise ValueError(
                    f"publish_tf needs tf2_msgs, which cannot be imported ({error}); install it"
                ) from error
        try:
            made["annotations"] = self._publisher(message_class(OPTIONAL["annotations"]), "~/annotations")
        except ImportError:
            self.get_logger().info("no ~/annotations: foxglove_msgs is not installed")
        return made

    def _activate(self) -> None:
        self._health = Health(time.monotonic(), self.stream.drops, self.stream.notes)
        # Discovery takes its time: that nobody publishes is worth a warning only after a while.
        self._warn.hold("no input")
        self._silences, self._described = 0, {}
        self._subscribed = [
            self._subscription(CameraInfo, "camera_info", self._on_camera_info),
            self._subscription(Image, "depth", self._on_depth),
        ]
        self._silence = self.create_timer(_SILENCE_SECONDS, self._on_silence, clock=self._steady, autostart=False)
        self._looking = self.create_timer(_LOOK_SECONDS, self._look, clock=self._steady)
        report = self.create_timer(_REPORT_SECONDS, self._report, clock=self._steady)
        self._timers_on = [self._silence, self._looking, report]
        self._publish_layout()
        self._look()

    def _deactivate(self) -> None:
        if self.active:
            self.flush()
        for timer in self._timers_on:
            self.destroy_timer(timer)
        for subscription in self._subscribed:
            self.destroy_subscription(subscription)
        if self._input:
            self._input.close()
        self._timers_on, self._subscribed = [], []

    def _clean(self) -> None:
        for publisher in list(self._managed_entities):
            self.destroy_lifecycle_publisher(publisher)
        if self.stream:
            self._ended = self._summed(self.stream)
        self.stream, self._input, self._outputs = None, None, {}

    def _refuse(self, error: Exception) -> TransitionCallbackReturn:
        self._refusal = error
        if not self._starting:
            self.get_logger().error(one_line(error))
        return TransitionCallbackReturn.FAILURE

    def _publisher(self, kind: type, topic: str, qos=None):
        resolved = self.resolve_topic_name(topic)
        return self.create_lifecycle_publisher(
            kind,
            topic,
            qos or output_qos(),
            qos_overriding_options=OVERRIDES,
            event_callbacks=unhearing(resolved, self._on_mismatch),
        )

    def _subscription(self, kind: type, topic: str, callback):
        resolved = self.resolve_topic_name(topic)
        return self.create_subscription(
            kind,
            topic,
            callback,
            input_qos(),
            qos_overriding_options=OVERRIDES,
            event_callbacks=unheard(resolved, self._on_mismatch),
        )

    # --- parameters

    def _take_parameters(self, parameters) -> SetParametersResult:
        """All of them or none; one that the node cannot have is refused with the reason, and all stays as it was."""
        given = {parameter.name: parameter.value for parameter in parameters if parameter.name in LIVE}
        values = {**self._values, **given}
        try:
            # Before the model is loaded nothing tells whether it can be; configuring does.
            if self.stream and given:
                self._apply(given, values)
        except _REFUSALS as error:
            return SetParametersResult(successful=False, reason=one_line(error))
        self._values = values
        return SetParametersResult(successful=True)

    def _apply(self, given: dict, values: dict) -> None:
        if any(name in given for name in _SWITCHING):
            self._switch(open_stream(**values))
        # In the order of the table: person_height is the only one that the model may refuse, and the first.
        for name in LIVE:
            if name in given and name not in _SWITCHING:
                setattr(self.stream, name, given[name])
        if self.active:
            self._publish_layout()

    def _switch(self, stream: LiftStream) -> None:
        """From now on by this stream; what waits for the rest of its image is lifted by the old one."""
        if self.active:
            self.flush()
        stream.take_over(self.stream)
        self.stream, self._told = stream, stream.route
        model = stream.lifter.model
        self.get_logger().info(f"lifting with model {model.name} ({model.sha256[:12]})")

    # --- what comes in

    def _look(self) -> None:
        if self._input.look():
            self._looking.cancel()

    def _on_camera_info(self, msg: CameraInfo) -> None:
        self.stream.camera_info(msg)
        self._report_drops()
        self._publish_layout()

    def _on_depth(self, msg: Image) -> None:
        self.stream.depth(msg)
        self._report_drops()

    def _on_keypoints(self, type_name: str, msg, topic: str, missed: int) -> None:
        self._health.came(time.monotonic())
        if missed:
            self.stream.drops["missed"] += missed
            self.stream.explanations["missed"] = "Lost on the way, or newer came before they could be lifted"
        self._take(self.stream.keypoints(type_name, msg, topic))
        if type_name in msg_adapters.ONE_PERSON:
            self._silences = 0
            self._silence.reset()

    def _on_nobody(self) -> None:
        """The input lives, it only shows nobody."""
        self._health.came(time.monotonic())

    def _on_silence(self) -> None:
        """Flushes at the second tick: at the first, if this process was kept from running, a message may be waiting."""
        self._silences += 1
        if self._silences == 2:
            self._silence.cancel()
            self.flush()

    def _on_jump(self, jump) -> None:
        """Simulated time was set back, as by a bag that loops."""
        if self.active:
            self.flush()
            self._health.forget_latency()
            self.stream.notes["clock_set_back"] += 1
            self._warn("clock_set_back", f"time was set back by {-jump.delta.nanoseconds / 1e9:.1f} s")

    # --- what goes out

    def flush(self) -> None:
        """Lifts and publishes the persons that the stream keeps for more of their image."""
        self._take(self.stream.flush())

    def _take(self, frame: Frame | None) -> None:
        if frame is not None:
            if self.stream.route is not self._told:
                self._tell_layouts()
            with self.stream.guard():
                self._publish(frame)
                self._health.went(frame, self._now())
        self._report_drops()

    def _publish(self, frame: Frame) -> None:
        """Builds what somebody listens to and then publishes it, so that a fault leaves no half frame."""
        heard = [name for name, publisher in self._outputs.items() if publisher.get_subscription_count()]
        built = {name: frame.serialised(name, self._writers[name]) for name in heard if name in PACKED}
        if len(built) < len(heard):
            frame = replace(frame, header=self._make.header(frame.header))
            built |= {name: frame.message(name, self._make) for name in heard if name not in PACKED}
        for name, message in built.items():
            self._outputs[name].publish(message)

    def _now(self) -> int:
        """ns by the clock that stamps are of; rclpy's own call takes ten times as long where it is the system's."""
        clock = self.get_clock()
        return clock.now().nanoseconds if clock.ros_time_is_active else time.time_ns()

    def _tell_layouts(self) -> None:
        """Once, when the first message has shown which layout the detector uses, and before its frame goes out."""
        self._told = self.stream.route
        self.get_logger().info(
            f"{self._input.topic} is taken to have the points of {self._told.given.name}, set the parameter `layout` "
            f"if it has others; published are those of {self._told.output.name}"
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

    def _on_mismatch(self, topic: str, text: str) -> None:
        self._health.mismatch()
        self._warn(f"qos {topic}", text)

    def _report_drops(self) -> None:
        for reason, count in self.stream.drops.items():
            if count != self._reported[reason]:
                self._reported[reason] = count
                explanation = self.stream.explanations.get(reason, "")
                self._warn(reason, f"dropped: {reason}, {count} so far. {explanation}")

    def _report_notes(self) -> None:
        """What was odd but used, where the stream knows what to do about it."""
        for what in self.stream.notes.keys() & self.stream.explanations.keys():
            count = self.stream.notes[what]
            if count != self._noted[what]:
                self._noted[what] = count
                self._warn(what, f"{what}, {count} so far. {self.stream.explanations[what]}", every=_NOTES_SECONDS)

    def _report(self) -> None:
        """/diagnostics (REP-107), once a second."""
        if not self._input.check():
            self._looking.reset()
        source = self._input.type_name or "none"
        report = self._health.report(time.monotonic(), self.stream, self._input.problem, source)
        self._report_notes()
        if self._input.type_name and not self._input.problem and report.waited >= _SILENT_SECONDS:
            self._warn("silent", f"no keypoints for {report.waited:.0f} s on {self._input.topic}{self._input.alone()}")
        # Not before the first second is over: CameraInfo may come a little later than the keypoints.
        if report.frames and unscaled(self.stream):
            why = self._described["scale_source"]
            self._warn("units", f"lifting in model units, not metres: {why}", every=_NOTES_SECONDS)
        message = DiagnosticArray(status=[self._status(report)])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _status(self, report: Report) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=bytes([report.level]),
            name=f"{self.get_fully_qualified_name().lstrip('/')}: lifting",
            message=report.message,
            hardware_id="",
            values=[KeyValue(key=key, value=str(value)) for key, value in report.values.items()],
        )

    @staticmethod
    def _summed(stream: LiftStream) -> str:
        median, p99 = percentiles(stream.lift_us) or (0.0, 0.0)
        counts = stream.counts
        return (
            f"{counts['frames']} frames, {counts['lifted']} of {counts['persons']} persons "
            f"lifted, median {median:.0f} µs, p99 {p99:.0f} µs a frame; "
            f"dropped: {listed(stream.drops)}"
        )


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


def one_line(error: BaseException) -> str:
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
        if node.get_parameter("autostart").value:
            node.start()
    except _REFUSALS as error:
        print(f"lifter: {one_line(error)}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    state = "ready" if node.active else "waiting to be configured,"
    node.get_logger().info(f"{state} {_process_seconds():.2f} s after the process started")
    _spin(node, stop)
    node.end()
    print(node.summary(), file=sys.stderr, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


class _OneThread(SingleThreadedExecutor):
    """Waits once for a message, not twice.

    rclpy's executor wakes itself after every callback, for other threads that may wait for the same callback group: it
    gathers all entities and waits a second time for nothing. Where there is one thread no one else waits.
    """

    def __init__(self) -> None:
        super().__init__()
        self._guard.trigger = lambda: None


def _spin(node: LifterNode, stop: threading.Event) -> None:
    executor = _OneThread()
    executor.add_node(node)
    # Not spin_once's own timeout: that makes and destroys a timer each time.
    node.create_timer(_STOP_SECONDS, lambda: None, clock=Clock(clock_type=ClockType.STEADY_TIME))
    while rclpy.ok() and not stop.is_set():
        executor.spin_once()


if __name__ == "__main__":
    sys.exit(main())
