# SPDX-License-Identifier: Apache-2.0
"""The node's input of keypoints: finds the type of its topic, subscribes, and warns of what prevents it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.node import Node
from rclpy.subscription import Subscription

import msg_adapters
from paul_ros.errors import ParameterError
from paul_ros.ros.advisor import ThrottledLog
from paul_ros.ros.lost_messages import PublicationNumbers
from paul_ros.ros.messages import message_class
from paul_ros.ros.node_parameters import one_line
from paul_ros.ros.qos import OVERRIDES, input_qos, subscription_events
from paul_ros.ros.ros4hri import BODY, LIST, BodyTopics

AUTO = "auto"
"""Value of `input_type` that takes the type of the topic's publishers."""

_SERIALISED = "sensor_msgs/msg/PointCloud2"
"""Type whose serialised bytes the stream reads: rclpy's objects would cost more than lifting."""

_ID_CHARS = 50
"""Characters of an id in a warning."""


def readable() -> list[str]:
    """Return the types that the topic may have."""
    return [*msg_adapters.SUPPORTED, LIST]


class KeypointListener(Protocol):
    """The receiver of what the input gets."""

    def on_keypoints(self, type_name: str, msg: Any, topic: str, missed: int, received: int) -> None:
        """Take a message.

        Args:
            type_name: such as 'sensor_msgs/msg/PointCloud2'.
            msg: the message; a PointCloud2 as serialised bytes.
            topic: that it came from.
            missed: number of messages before it that were lost, or were replaced while the node was busy.
            received: system time in nanoseconds at which the middleware received it; 0 = unknown.
        """

    def on_no_bodies(self) -> None:
        """Take the news that the list of bodies is empty, so no message of a body can come."""

    def on_qos_mismatch(self, topic: str, warning: str) -> None:
        """Take a warning about a publisher whose QoS does not match."""

    def max_bodies(self) -> int:
        """Return the largest number of bodies to follow."""


class KeypointInput:
    """The subscription of keypoints; one for each body if the topic lists the bodies of ROS4HRI.

    Attributes:
        topic: full name of the topic.
        type_name: type of the topic; None until it is subscribed.
        problem: why the topic cannot be read; '' if it can, or if nobody publishes it yet.
        trouble: a sentence about publishers that are not read beside those that are; none if there are none.
    """

    def __init__(self, node: Node, topic: str, wanted: str, listener: KeypointListener, warn: ThrottledLog) -> None:
        """Make an input that is not subscribed yet.

        Args:
            node: owner of the subscriptions.
            topic: name of the topic.
            wanted: type of the topic, or AUTO.
            listener: receiver of the messages.
            warn: log of what prevents a subscription.

        Raises:
            ParameterError: the wanted type cannot be read.
        """
        if wanted != AUTO and wanted not in readable():
            raise ParameterError(f"input_type is {wanted}; it must be {AUTO} or one of {', '.join(readable())}")
        self.topic = node.resolve_topic_name(topic)
        self.type_name: str | None = None
        self.problem = ""
        self.trouble: list[str] = []
        self._node, self._wanted, self._listener, self._warn = node, wanted, listener, warn
        self._subscription: Subscription | None = None
        self._bodies = BodyTopics(self.topic, self._subscribe_body, node.destroy_subscription)

    def try_subscribe(self) -> bool:
        """Subscribe if that is possible now, else warn of what is missing; return whether it is subscribed."""
        types = [self._wanted] if self._wanted != AUTO else self._published_types()
        known = [name for name in types if name in readable()]
        if not types:
            self.problem = ""
            self._warn("no input", f"Nobody publishes {self.topic} yet. Remap `keypoints` to your detector.")
        elif not known:
            self._report(
                "unknown type",
                f"{self.topic} has the type {', '.join(types)}, which cannot be read. "
                f"Publish one of {', '.join(readable())}.",
            )
        else:
            self._subscribe(known[0])
        return self.type_name is not None

    def check_type(self) -> bool:
        """Compare the subscribed type with the published ones.

        Returns:
            False if the type was found from publishers that are gone: the subscription is closed, and
            `try_subscribe` may find another. A type that was asked for stays, with a warning.
        """
        self.trouble = []
        if self.type_name is None:
            return True
        types = self._published_types()
        if not types or self.type_name in types:
            self.problem = ""
            if others := [name for name in types if name != self.type_name]:
                self.trouble = [
                    f"{self.topic} also has the type {', '.join(others)}: nothing comes from it. Let only "
                    "one detector publish this topic."
                ]
            return True
        if self._wanted == AUTO:
            self.close()
            return False
        self._report(
            "other type",
            f"{self.topic} has the type {', '.join(types)}, but input_type is {self._wanted}: nothing comes from it. "
            f"Correct input_type, or leave it at {AUTO}.",
        )
        return True

    def has_publisher(self) -> bool:
        """Return whether anybody publishes the topic."""
        return bool(self._published_types())

    def close(self) -> None:
        """End all subscriptions; `try_subscribe` may open them again."""
        self._bodies.clear()
        if self._subscription:
            self._node.destroy_subscription(self._subscription)
        self._subscription = self.type_name = None

    def _published_types(self) -> list[str]:
        return sorted({info.topic_type for info in self._node.get_publishers_info_by_topic(self.topic)})

    def _report(self, key: str, problem: str) -> None:
        self.problem = problem
        self._warn(key, problem)

    def _subscribe(self, type_name: str) -> None:
        try:
            if type_name == LIST:
                message_class(BODY)  # bodies are subscribed later, when no warning is made of a missing package
            self._subscription = self._create_subscription(message_class(type_name), type_name)
        except ImportError as error:
            self._report(
                "no package",
                f"{self.topic} has the type {type_name}, whose package cannot be imported ({error}). Install it, or "
                "source its workspace.",
            )
            return
        except Exception as error:  # rclpy, QoS overrides and message packages raise errors of a dozen kinds
            self._report("impossible", f"{self.topic} cannot be subscribed: {one_line(error)}")
            return
        self.type_name, self.problem = type_name, ""
        self._node.get_logger().info(f"Reading {type_name} from {self.topic}.")

    def _create_subscription(self, kind: Any, type_name: str) -> Subscription:
        callback: Callable[..., None] = self._on_list if type_name == LIST else self._reader(type_name, self.topic)
        return self._node.create_subscription(
            kind,
            self.topic,
            callback,
            input_qos(),
            raw=type_name == _SERIALISED,
            event_callbacks=subscription_events(self.topic, self._listener.on_qos_mismatch),
            qos_overriding_options=OVERRIDES,
        )

    def _on_list(self, msg: Any) -> None:
        if not msg.ids:
            self._listener.on_no_bodies()
        if ignored := self._bodies.update(msg.ids, self._listener.max_bodies()):
            names = ", ".join(repr(name[:_ID_CHARS]) for name in ignored[:5])
            self._warn(
                "bodies",
                f"Bodies that are not read, by their ids: {names}. Raise `max_persons`, or publish ids that a topic's "
                "name may hold.",
            )

    def _subscribe_body(self, topic: str) -> Subscription:
        return self._node.create_subscription(message_class(BODY), topic, self._reader(BODY, topic), input_qos())

    def _reader(self, type_name: str, topic: str) -> Callable[..., None]:
        """Return the callback of a subscription, which counts the messages that were lost."""
        numbers = PublicationNumbers()

        def on_message(msg: Any, info: Any) -> None:
            number = info["publication_sequence_number"]
            missed = numbers.missed(number, lambda: self._node.count_publishers(topic))
            self._listener.on_keypoints(type_name, msg, topic, missed, info["received_timestamp"])

        return on_message
