# SPDX-License-Identifier: Apache-2.0
"""The subscriptions to CameraInfo, published with every image or once and latched."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo

from paul_ros.ros.qos import OVERRIDES, WarnOfTopic, input_qos, latched_qos, subscription_events

_REMEMBERED = 32
"""Number of messages that are remembered to find the second copy of one: more than both queues hold."""


class CameraInput:
    """Hands each CameraInfo to a callback once, from volatile and from latched publishers.

    No single subscription serves both. A volatile one gets nothing that was latched before it began, and a
    transient-local one does not match a volatile publisher. So a second subscription lives as long as there is a
    latched publisher: without one it would make drivers warn of its QoS.
    """

    def __init__(self, node: Node, topic: str, on_camera_info: Callable[[CameraInfo], None], warn: WarnOfTopic) -> None:
        """Subscribe.

        Args:
            node: owner of the subscriptions.
            topic: name of the topic.
            on_camera_info: takes a message.
            warn: takes a warning about a publisher whose QoS does not match.

        Raises:
            RCLPY_REFUSALS: a QoS override cannot be used.
        """
        self._node, self._topic, self._on_camera_info = node, node.resolve_topic_name(topic), on_camera_info
        self._stamps: deque[int] = deque(maxlen=_REMEMBERED)
        events = subscription_events(self._topic, warn)
        self._subscription = self._subscribe(input_qos(), event_callbacks=events, qos_overriding_options=OVERRIDES)
        self._latched: Subscription | None = None
        self.check_publishers()

    def check_publishers(self) -> None:
        """Begin or end the subscription to latched publishers, by the graph."""
        publishers = self._node.get_publishers_info_by_topic(self._topic)
        latched = any(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in publishers)
        if latched and self._latched is None:
            silent = SubscriptionEventCallbacks(use_default_callbacks=False)
            self._latched = self._subscribe(latched_qos(), event_callbacks=silent)
        elif not latched and self._latched is not None:
            self._node.destroy_subscription(self._latched)
            self._latched = None

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in filter(None, (self._subscription, self._latched)):
            self._node.destroy_subscription(subscription)

    def _subscribe(self, qos: Any, **options: Any) -> Subscription:
        return self._node.create_subscription(CameraInfo, self._topic, self._taker(), qos, **options)

    def _taker(self) -> Callable[..., None]:
        """Return the callback of a subscription."""

        def take(msg: CameraInfo, info: dict[str, Any]) -> None:
            # A latched publisher's later messages reach both subscriptions, with the publisher's own stamp. Middleware
            # that has no such stamps says 0.
            stamp = info["source_timestamp"]
            if not stamp or stamp not in self._stamps:
                self._stamps.append(stamp)
                self._on_camera_info(msg)

        return take
