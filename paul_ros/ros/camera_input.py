# SPDX-License-Identifier: Apache-2.0
"""Subscriptions to CameraInfo, published with every image or once and latched."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo

from paul_ros.ros.qos import OVERRIDES, WarnOfTopic, input_qos, latched_qos, subscription_events

_REMEMBERED = 32
"""Number of messages that are remembered to find the second copy of one: more than both queues hold."""


def subscribe_camera_info(
    node: Node, topic: str, on_camera_info: Callable[[CameraInfo], None], warn: WarnOfTopic
) -> list[Subscription]:
    """Subscribe to the CameraInfo of all publishers, volatile and latched; each message is handed on once.

    No single subscription serves both. A volatile one gets nothing that was latched before it began, and a
    transient-local one does not match a volatile publisher.

    Args:
        node: owner of the subscriptions.
        topic: name of the topic.
        on_camera_info: takes a message.
        warn: takes a warning about a publisher whose QoS does not match.

    Raises:
        RCLPY_REFUSALS: a QoS override cannot be used.
    """
    take = _Once(on_camera_info)
    events = subscription_events(node.resolve_topic_name(topic), warn)
    # Volatile publishers never match the second subscription. That is no fault, so it does not warn.
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    return [
        node.create_subscription(
            CameraInfo, topic, take, input_qos(), event_callbacks=events, qos_overriding_options=OVERRIDES
        ),
        node.create_subscription(CameraInfo, topic, take, latched_qos(), event_callbacks=silent),
    ]


class _Once:
    """Hands each message on once: later messages of a latched publisher reach both subscriptions."""

    def __init__(self, on_camera_info: Callable[[CameraInfo], None]) -> None:
        self._on_camera_info = on_camera_info
        self._stamps: deque[int] = deque(maxlen=_REMEMBERED)

    def __call__(self, msg: CameraInfo, info: dict[str, Any]) -> None:
        # The publisher sets this stamp, so both copies have the same.
        stamp = info["source_timestamp"]
        if stamp not in self._stamps:
            self._stamps.append(stamp)
            self._on_camera_info(msg)
