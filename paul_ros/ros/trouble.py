# SPDX-License-Identifier: Apache-2.0
"""Trouble around the node that lasts: endpoints whose QoS does not match, and simulated time without a clock."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import cast

from rclpy.clock import ROSClock
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from paul_ros.ros.advisor import SILENT_SECONDS


class Trouble:
    """Faults in the surroundings of a node, each until it is mended."""

    def __init__(self, node: Node) -> None:
        """Begin to watch."""
        self._node = node
        self._last_clock = time.monotonic()
        self._qos_warnings: dict[str, str] = {}

    def add_qos_mismatch(self, topic: str, warning: str) -> None:
        """Add a warning about an endpoint of a topic whose QoS does not match."""
        self._qos_warnings[topic] = warning

    def sentences(self) -> list[str]:
        """Return a sentence on each fault, with what to do. A mismatch of QoS is returned once at least."""
        found = [*self._qos_warnings.values(), *self._missing_clock()]
        self._qos_warnings = {
            topic: warning for topic, warning in self._qos_warnings.items() if self._is_mismatched(topic)
        }
        return found

    def _is_mismatched(self, topic: str) -> bool:
        """Return whether a publisher and a subscription of a topic do not match, one of them this node's."""
        publishers = self._node.get_publishers_info_by_topic(topic)
        subscriptions = self._node.get_subscriptions_info_by_topic(topic)
        return any(
            qos_check_compatible(publisher.qos_profile, subscription.qos_profile)[0] == QoSCompatibility.ERROR
            for publisher in publishers
            for subscription in subscriptions
            if self._is_own(publisher) or self._is_own(subscription)
        )

    def _is_own(self, endpoint: TopicEndpointInfo) -> bool:
        own = self._node.get_name(), self._node.get_namespace()
        return (endpoint.node_name, endpoint.node_namespace) == own

    def _missing_clock(self) -> Iterable[str]:
        clock, now = cast(ROSClock, self._node.get_clock()), time.monotonic()
        topic = self._node.resolve_topic_name("/clock")
        # A simulation that stands still has a publisher all the same.
        if not clock.ros_time_is_active or self._node.count_publishers(topic):
            self._last_clock = now
        elif now - self._last_clock >= SILENT_SECONDS:
            yield (
                f"use_sim_time is true, but nobody publishes {topic}, so time stands still. Start the simulator, play "
                "the bag with --clock, or set `use_sim_time` to false."
            )
