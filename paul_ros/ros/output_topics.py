# SPDX-License-Identifier: Apache-2.0
"""The node's output topics: publishers of frames, of the layout and of diagnostics."""

from __future__ import annotations

import json
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from paul_ros.errors import ParameterError
from paul_ros.ros.diagnostics import Report
from paul_ros.ros.messages import RosMake, diagnostic_array, message_class
from paul_ros.ros.qos import OVERRIDES, WarnOfTopic, latched_qos, output_qos, publisher_events
from paul_ros.stream.frame import Frame
from paul_ros.stream.messages import OUTPUTS, MessageBuilder, Output


class OutputTopics:
    """The publishers of a configured node.

    Attributes:
        frame_publishers: name of an output -> its publisher.
    """

    def __init__(self, node: LifecycleNode, parameters: dict[str, Any], on_qos_mismatch: WarnOfTopic) -> None:
        """Make the publishers.

        Args:
            node: owner of the publishers; it destroys them.
            parameters: values by name.
            on_qos_mismatch: called for each subscriber whose QoS does not match.

        Raises:
            ParameterError: a parameter asks for an output whose message package is not installed.
        """
        self._node, self._on_qos_mismatch = node, on_qos_mismatch
        make = RosMake()
        self._builder = MessageBuilder(make, packed=True, convert_header=make.header)
        self._described: dict[str, Any] = {}
        self.frame_publishers: dict[str, LifecyclePublisher] = {}
        for name, output in OUTPUTS.items():
            if not output.parameter or parameters[output.parameter]:
                if kind := self._message_class(output):
                    self.frame_publishers[name] = self._publisher(kind, output.topic, output_qos())
        self._layout = self._publisher(String, "~/layout", latched_qos())
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics", output_qos())

    def publish_frame(self, frame: Frame) -> None:
        """Build what somebody listens to, then publish it: an error while building leaves no half frame."""
        heard = [name for name, publisher in self.frame_publishers.items() if publisher.get_subscription_count()]
        for name, message in self._builder.messages(frame, heard).items():
            self.frame_publishers[name].publish(message)

    def publish_layout(self, described: dict[str, Any]) -> None:
        """Publish what the outputs mean, if that has changed since the last time."""
        if described == self._described:
            return
        if self._described.get("units", described["units"]) != described["units"]:
            self._node.get_logger().info(_units_changed(described["units"], described["scale_source"]))
        self._described = described
        self._layout.publish(String(data=json.dumps(described)))

    def forget_layout(self) -> None:
        """Publish the layout again at the next opportunity, as after activation."""
        self._described = {}

    def publish_diagnostics(self, report: Report) -> None:
        """Publish a report on /diagnostics."""
        stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostic_array(report, self._node.get_fully_qualified_name(), stamp))

    def _message_class(self, output: Output) -> Any:
        """Return the class of an output's messages; None if it is optional and not installed."""
        try:
            return message_class(output.message_type)
        except ImportError as error:
            package = output.message_type.partition("/")[0]
            if output.parameter:
                raise ParameterError(
                    f"{output.parameter} needs {package}, which cannot be imported ({error}); install it"
                ) from error
            if not output.optional:
                raise
            self._node.get_logger().info(f"{output.topic} is not published: {package} is not installed.")
            return None

    def _publisher(self, kind: Any, topic: str, qos: QoSProfile) -> LifecyclePublisher:
        resolved = self._node.resolve_topic_name(topic)
        return self._node.create_lifecycle_publisher(
            kind,
            topic,
            qos,
            qos_overriding_options=OVERRIDES,
            event_callbacks=publisher_events(resolved, self._on_qos_mismatch),
        )


def _units_changed(units: str, scale_source: str) -> str:
    if units == "m":
        return f"Output is now in metres. {scale_source}."
    return f"Output is now in model units: {scale_source.removeprefix('none: ')}."
