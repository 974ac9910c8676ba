# SPDX-License-Identifier: Apache-2.0
"""The data path of a configured node: subscriptions -> stream -> publishers, with its reports."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

from rclpy.clock import Clock, ClockType, JumpThreshold, ROSClock
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import CameraInfo, Image

import msg_adapters
from paul_ros.ros.advisor import SILENT_SECONDS, Advisor, ThrottledLog
from paul_ros.ros.camera_input import CameraInput
from paul_ros.ros.diagnostics import Health, lacks_camera_info
from paul_ros.ros.keypoint_input import KeypointInput
from paul_ros.ros.output_topics import OutputTopics
from paul_ros.ros.qos import OVERRIDES, input_qos, subscription_events
from paul_ros.ros.trouble import Trouble
from paul_ros.stream.frame import Frame
from paul_ros.stream.person_group import SILENCE_SECONDS
from paul_ros.stream.person_ids import PersonIds
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.session import Session
from paul_ros.stream.stream import LiftStream, open_stream

_SEARCH_SECONDS = 0.05
"""Interval of attempts to subscribe to keypoints."""

_REPORT_SECONDS = 1.0
"""Interval of diagnostics."""


class Pipeline:
    """Hands messages to the stream, publishes its frames, and reports what is wrong.

    It has its model and its publishers from the start. It subscribes, publishes and counts only while it is active.

    Attributes:
        stream: the stream in use.
    """

    def __init__(
        self, node: LifecycleNode, parameters: dict[str, Any], log: ThrottledLog, person_ids: PersonIds
    ) -> None:
        """Load the model and make the publishers.

        Args:
            node: owner of all publishers, subscriptions and timers.
            parameters: values by name.
            log: of warnings.
            person_ids: who is who since the process began.

        Raises:
            ModelError, LayoutError, ParameterError: a parameter cannot be used.
        """
        self._node, self._log = node, log
        self.stream = open_stream(**parameters, session=Session(person_ids))
        self._announced_route = self.stream.route
        self._health, self._advisor, self._trouble = Health(time.monotonic(), self.stream), Advisor(log), Trouble(node)
        self._input = KeypointInput(node, "keypoints", parameters["input_type"], self, log)
        self._topics = OutputTopics(node, parameters, self.on_qos_mismatch)
        self._subscriptions: list[Subscription] = []
        self._timers: list[Timer] = []
        self._camera: CameraInput | None = None
        # Not ROS time: a simulation that stands still would hold back the last image and diagnostics.
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)

    @property
    def active(self) -> bool:
        """True while it subscribes and publishes."""
        return bool(self._timers)

    def activate(self) -> None:
        """Subscribe and publish from now on; raises what rclpy raises for QoS overrides that it cannot use."""
        self._health, self._trouble = Health(time.monotonic(), self.stream), Trouble(self._node)
        self._log.forget()
        # Discovery takes its time: an absent publisher is worth a warning only after a while.
        self._log.hold("no input", SILENT_SECONDS)
        self._camera = CameraInput(self._node, "camera_info", self._on_camera_info, self.on_qos_mismatch)
        self._subscribe(Image, "depth", self._on_depth)
        self._group_ticks = 0
        self._group_timer = self._timer(SILENCE_SECONDS / 2, self._on_group_tick, autostart=False)
        self._search_timer = self._timer(_SEARCH_SECONDS, self._search_input)
        self._timer(_REPORT_SECONDS, self._report)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        clock = self._node.get_clock()
        self._jump_handle = clock.create_jump_callback(back, post_callback=self._on_clock_set_back)
        self._topics.forget_layout()
        self.publish_layout()
        self._search_input()

    def deactivate(self) -> None:
        """Publish what is kept, then neither subscribe nor publish."""
        if self.active:
            self.flush()
            self._jump_handle.unregister()
        for timer in self._timers:
            self._node.destroy_timer(timer)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._input.close()
        if self._camera:
            self._camera.close()
        self._timers, self._subscriptions, self._camera = [], [], None

    def switch(self, stream: LiftStream) -> None:
        """Continue with another stream; the old one lifts what waits for the rest of its image."""
        if self.active:
            self.flush()
        self.stream, self._announced_route = stream, stream.route
        self._log.forget()
        model = stream.lifter.model
        self._node.get_logger().info(f"Lifting with model {model.name} ({model.sha256[:12]}).")

    def flush(self) -> None:
        """Lift and publish the persons that wait for the rest of their image."""
        self._publish(self.stream.flush())

    def publish_layout(self) -> None:
        """Publish what the outputs mean, if that has changed."""
        self._topics.publish_layout(self.stream.describe())

    # --- inputs

    def on_keypoints(self, type_name: str, msg: Any, topic: str, missed: int, received: int) -> None:
        """Lift a message of keypoints; see KeypointListener."""
        self._health.received(time.monotonic())
        self.stream.ledger.drop("missed", REASONS["missed"].advice, missed)
        clock = cast(ROSClock, self._node.get_clock())
        arrival = self._now_ns() if clock.ros_time_is_active else received or time.time_ns()
        self._publish(self.stream.keypoints(type_name, msg, topic, arrival).frame)
        if type_name in msg_adapters.ONE_PERSON:
            self._group_ticks = 0
            self._group_timer.reset()

    def on_no_bodies(self) -> None:
        """Count an empty list of bodies as input, for it is alive; see KeypointListener."""
        self._health.received(time.monotonic())

    def on_qos_mismatch(self, topic: str, warning: str) -> None:
        """Warn of an endpoint whose QoS does not match, at once and as long as it does; see KeypointListener."""
        self._trouble.add_qos_mismatch(topic, warning)
        self._advisor.report_trouble([warning])

    def max_bodies(self) -> int:
        """Return the largest number of bodies to follow; see KeypointListener."""
        return self.stream.max_persons

    def _on_camera_info(self, msg: CameraInfo) -> None:
        self.stream.camera_info(msg)
        self.publish_layout()

    def _on_depth(self, msg: Image) -> None:
        self.stream.depth(msg)

    def _on_group_tick(self) -> None:
        """Flush at the second tick: at the first, if this process was kept from running, a message may be waiting."""
        self._group_ticks += 1
        if self._group_ticks == 2:
            self._group_timer.cancel()
            self.flush()

    def _on_clock_set_back(self, jump: Any) -> None:
        """Start anew in simulated time that was set back, as when a bag loops."""
        self.flush()
        self._health.forget_latency()
        self.stream.ledger.note("clock_set_back")
        self._advisor.report_clock_set_back(-jump.delta.nanoseconds / 1e9)

    def _search_input(self) -> None:
        self._search_latched_camera()
        if self._input.try_subscribe():
            self._search_timer.cancel()

    def _search_latched_camera(self) -> None:
        if self._camera:
            self._camera.check_publishers()

    def _subscribe(self, kind: Any, topic: str, callback: Callable[[Any], None]) -> None:
        events = subscription_events(self._node.resolve_topic_name(topic), self.on_qos_mismatch)
        self._subscriptions.append(
            self._node.create_subscription(
                kind, topic, callback, input_qos(), qos_overriding_options=OVERRIDES, event_callbacks=events
            )
        )

    def _timer(self, seconds: float, callback: Callable[[], None], autostart: bool = True) -> Timer:
        timer = self._node.create_timer(seconds, callback, clock=self._steady_clock, autostart=autostart)
        self._timers.append(timer)
        return timer

    # --- outputs

    def _publish(self, frame: Frame | None) -> None:
        if frame is not None:
            if self.stream.route is not self._announced_route:
                self._announce_layouts()
            with self.stream.guard():
                self._topics.publish_frame(frame)
                self._health.published(frame, self._now_ns())

    def _now_ns(self) -> int:
        """Return the present by the clock of the stamps; for system time rclpy's own call takes ten times as long."""
        clock = cast(ROSClock, self._node.get_clock())
        return int(clock.now().nanoseconds) if clock.ros_time_is_active else time.time_ns()

    def _announce_layouts(self) -> None:
        """Log the layout of the input once it is found, and publish it before the frame that showed it."""
        self._announced_route = route = self.stream.route
        self._node.get_logger().info(
            f"{self._input.topic} is taken to have the points of {route.given.name}. Set the parameter `layout` if it "
            f"has others. Outputs have the points of {route.output.name}."
        )
        self.publish_layout()

    def _report(self) -> None:
        """Publish /diagnostics and log what is wrong, once a second."""
        if not self._input.check_type():
            self._search_timer.reset()
        self._search_latched_camera()
        input_type = self._input.type_name or "none"
        trouble = [*self._trouble.sentences(), *self._input.trouble]
        report = self._health.report(time.monotonic(), self.stream, self._input.problem, input_type, trouble)
        self._advisor.report_reasons(report.warnings, self.stream.ledger)
        self._advisor.report_trouble(trouble)
        if self._input.type_name and not self._input.problem:
            self._advisor.report_silence(report.silent_seconds, self._input.topic, self._input.has_publisher)
        # Not before a frame was lifted: CameraInfo may come a little later than the keypoints.
        if report.lifting and lacks_camera_info(self.stream):
            self._advisor.report_model_units(self.stream.describe()["scale_source"])
        self._topics.publish_diagnostics(report)
