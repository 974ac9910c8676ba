# SPDX-License-Identifier: Apache-2.0
"""The node's input of keypoints: subscribed as soon as its type is known, and what is wrong with it said aloud."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from rclpy.subscription import Subscription

import msg_adapters
from paul_ros.ros.diagnostics import Aloud
from paul_ros.ros.endpoints import NOT_POSSIBLE, OVERRIDES, input_qos, message_class, unheard
from paul_ros.ros.lost_messages import PublicationNumbers
from paul_ros.ros.ros4hri import BODY, LIST, Tracked

_RAW = "sensor_msgs/msg/PointCloud2"
"""The type whose serialised bytes the stream reads; rclpy's objects would cost more than lifting."""


def readable() -> list[str]:
    """Names of the types that `keypoints` may have."""
    return [*msg_adapters.SUPPORTED, LIST]


class KeypointInput:
    """The subscription of `keypoints`, or, where its topic lists the bodies of ROS4HRI, one for each of these.

    type_name: of the topic, None until it is known and subscribed. problem: why it cannot be read, '' where it can.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        wanted: str,
        take: Callable[[str, object, str, int], None],
        most: Callable[[], int],
        warn: Aloud,
        nobody: Callable[[], None],
        mismatch: Callable[[str, str], None],
    ) -> None:
        """wanted: a type's name, or auto; most(): bodies to follow; mismatch(topic, text): QoS that do not match.

        nobody() is told each list that has no body: then no message of one can come.

        take(type_name, msg, topic, missed) gets each message, a PointCloud2 as serialised bytes, and how many before it
        were published but never came, or were replaced by newer ones while the node was busy. Raises ValueError where
        the wanted type cannot be read.
        """
        if wanted != "auto" and wanted not in readable():
            raise ValueError(f"input_type is {wanted}; it must be auto or one of {', '.join(readable())}")
        self.type_name: str | None = None
        self.problem = ""
        self._node, self._wanted, self._take, self._most = node, wanted, take, most
        self._warn, self._nobody, self._mismatch = warn, nobody, mismatch
        self.topic = node.resolve_topic_name(topic)
        self._subscription: Subscription | None = None
        self._bodies: Tracked | None = None

    def look(self) -> bool:
        """Subscribes if that is possible now; says what is missing where it is not. Whether it is subscribed."""
        types = [self._wanted] if self._wanted != "auto" else self._published_types()
        known = [name for name in types if name in readable()]
        if not types:
            self.problem = ""
            self._warn("no input", f"nobody publishes {self.topic} yet; remap `keypoints` to your detector")
        elif not known:
            self._cannot(
                "unknown type",
                f"{self.topic} has the type {', '.join(types)}, which cannot be read; "
                f"readable are {', '.join(readable())}",
            )
        else:
            self._open(known[0])
        return self.type_name is not None

    def check(self) -> bool:
        """Whether look() has done its work: not where the type is found from the graph and has become another.

        Where the wanted type is not the one that is published, that is said aloud.
        """
        if self.type_name is None:
            return True
        types = self._published_types()
        if not types or self.type_name in types:
            self.problem = ""
            return True
        if self._wanted == "auto":
            self.close()
            return False
        self._cannot(
            "other type",
            f"{self.topic} has the type {', '.join(types)}, but input_type is {self._wanted}: nothing comes from it; "
            "correct input_type, or leave it at auto",
        )
        return True

    def alone(self) -> str:
        """': nobody publishes it ...' where that is so, else ''."""
        return "" if self._published_types() else ": nobody publishes it; remap `keypoints` to your detector"

    def close(self) -> None:
        """Ends all subscriptions; look() may open them again."""
        if self._bodies:
            self._bodies.clear()
        if self._subscription:
            self._node.destroy_subscription(self._subscription)
        self._bodies = self._subscription = self.type_name = None

    def _follow(self, msg) -> None:
        """Reads the bodies that a list names."""
        if not msg.ids:
            self._nobody()
        if left := self._bodies.update(msg.ids, self._most()):
            self._warn("bodies", f"bodies that are not read, by their ids: {', '.join(map(repr, left[:5]))}")

    def _published_types(self) -> list[str]:
        return sorted({info.topic_type for info in self._node.get_publishers_info_by_topic(self.topic)})

    def _cannot(self, key: str, text: str) -> None:
        self.problem = text
        self._warn(key, text)

    def _open(self, type_name: str) -> None:
        try:
            kinds = [message_class(name) for name in ([LIST, BODY] if type_name == LIST else [type_name])]
            self._subscription = self._subscribe(kinds[0], type_name)
        except ImportError as error:
            self._cannot(
                "no package",
                f"{self.topic} has the type {type_name}, whose package cannot be "
                f"imported ({error}); install it or source its workspace",
            )
            return
        except NOT_POSSIBLE as error:
            self._cannot("impossible", f"{self.topic} cannot be subscribed: {error}")
            return
        self.type_name, self.problem = type_name, ""
        self._node.get_logger().info(f"reading {type_name} from {self.topic}")

    def _subscribe(self, kind: type, type_name: str) -> Subscription:
        options = dict(event_callbacks=unheard(self.topic, self._mismatch), qos_overriding_options=OVERRIDES)
        if type_name == LIST:
            self._bodies = Tracked(self.topic, self._open_body, self._node.destroy_subscription)
            return self._node.create_subscription(kind, self.topic, self._follow, input_qos(), **options)
        on_message, raw = self._reader(type_name, self.topic), type_name == _RAW
        return self._node.create_subscription(kind, self.topic, on_message, input_qos(), raw=raw, **options)

    def _open_body(self, topic: str) -> Subscription:
        return self._node.create_subscription(message_class(BODY), topic, self._reader(BODY, topic), input_qos())

    def _reader(self, type_name: str, topic: str) -> Callable:
        numbers = PublicationNumbers()

        def on_message(msg, info: dict) -> None:
            number = info["publication_sequence_number"]
            self._take(type_name, msg, topic, numbers.missed(number, lambda: self._node.count_publishers(topic)))

        return on_message
