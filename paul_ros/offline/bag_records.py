# SPDX-License-Identifier: Apache-2.0
"""Bag messages: serialised records, and messages decoded or made from their definitions, without ROS.

`rosbags` does the work; it comes with the extra `bags` and is imported when the first message is decoded or made.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from msg_adapters.definitions import definitions
from paul_ros.errors import BagError
from paul_ros.extras import require

MAX_LOG_TIME = 2**63 - 1
"""Largest log time in nanoseconds that ROS knows."""

CDR = "cdr"
"""Serialization of ROS 2 messages."""

_RANKS = {"sensor_msgs/msg/CameraInfo": 0, "sensor_msgs/msg/Image": 1}
_LAST_RANK = 2


@dataclass(frozen=True)
class Record:
    """One serialised message of a bag, with the definition that explains its bytes.

    Attributes:
        topic: name of the topic.
        type_name: ROS type, as 'sensor_msgs/msg/PointCloud2'; of messages that are not ROS 2's, a name with the
            serialization in brackets, as 'events (json)'.
        data: CDR with its 4-byte encapsulation header.
        log_time: nanoseconds.
        definition: text of the type and of all types it contains; '' = not recorded.
        encoding: language of the definition, 'ros2msg' or 'ros2idl'.
        qos: offered QoS profiles in the YAML of rosbag2; '' = not recorded.
        type_hash: hash of the definition as of REP-2016, as 'RIHS01_...'; '' = not recorded.
    """

    topic: str
    type_name: str
    data: bytes
    log_time: int
    definition: str = ""
    encoding: str = "ros2msg"
    qos: str = ""
    type_hash: str = ""

    @property
    def order(self) -> tuple[int, int]:
        """Place in a recording: by log time, and at equal times cameras and depths before what they explain."""
        return self.log_time, _RANKS.get(self.type_name, _LAST_RANK)

    def message(self) -> Any:
        """Return the decoded message, a dataclass with the field names of the rclpy message.

        Raises:
            BagError: the bytes do not fit the definition, or the definition cannot be read.
        """
        try:
            if self.definition.strip():
                store = _typestore(self.type_name, self.definition, self.encoding)
                return store.deserialize_cdr(self.data, self.type_name)
            return self._decoded_by_known_definition()
        except BagError:
            raise
        except Exception as error:  # rosbags raises many kinds for bytes that do not fit their definition
            raise BagError(f"a {self.type_name} message on {self.topic} does not decode: {error}") from error

    def _decoded_by_known_definition(self) -> Any:
        if self.type_name in jazzy_typestore().types:
            return jazzy_typestore().deserialize_cdr(self.data, self.type_name)
        for store in _stores_of_known_versions(self.type_name, self.type_hash):
            with contextlib.suppress(Exception):  # as many kinds: the bytes are of another version
                return store.deserialize_cdr(self.data, self.type_name)
        package = self.type_name.partition("/")[0]
        raise BagError(
            f"a {self.type_name} message on {self.topic} does not decode: its definition was not recorded. Install and "
            f"source the package {package} where `ros2 bag record` runs, and record it again with storage mcap"
        )


def type_name(name: str, serialization: str) -> str:
    """Return the name of a type for `Record`; `name` is '' where the recording has none."""
    if serialization == CDR and name:
        return name
    return f"{name or 'message without type'} ({serialization or 'unknown'})"


class BagMessages:
    """A message factory for the writers of `msg_adapters`: make(type_name, **every_field) returns a dataclass."""

    def __init__(self, texts: dict[str, str] | None = None) -> None:
        """Load the message types of ROS 2 Jazzy.

        Args:
            texts: type name -> text of its .msg file, for types that Jazzy's standard messages lack.
        """
        self._store = jazzy_typestore()
        if texts:
            from rosbags.typesys import get_types_from_msg

            self._store = _new_jazzy_typestore()  # the shared one must not learn these types
            for name, text in texts.items():
                self._store.register(get_types_from_msg(text, name))

    def __call__(self, type_name: str, /, **fields: Any) -> Any:
        return self._store.types[type_name](**fields)

    @staticmethod
    def octets(data: bytes) -> Any:
        """Return bytes as the array that a uint8[] field holds."""
        import numpy as np

        return np.frombuffer(data, np.uint8)

    def serialise(self, message: Any) -> bytes:
        """Return a message as little-endian CDR."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def known_definition(self, type_name: str) -> str:
        """Return the same as `definition`, or '' for a type that this factory does not know."""
        return self.definition(type_name) if type_name in self._store.types else ""

    def definition(self, type_name: str) -> str:
        """Return the ros2msg text of a type and of all types it contains."""
        return self._store.generate_msgdef(type_name, ros_version=2)[0]


def _new_jazzy_typestore() -> Any:
    require("bags", "rosbags")
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=1)
def jazzy_typestore() -> Any:
    """Return the shared rosbags typestore of ROS 2 Jazzy."""
    return _new_jazzy_typestore()


@lru_cache(maxsize=256)
def _stores_of_known_versions(type_name: str, type_hash: str) -> list[Any]:
    """Return typestores with the versions of a foreign type that the adapters know.

    Args:
        type_name: of the type.
        type_hash: of the recorded definition; excludes other versions. '' = not recorded.
    """
    stores = [BagMessages(texts)._store for texts in definitions(type_name)]
    return [store for store in stores if not type_hash or store.hash_rihs01(type_name) == type_hash]


@lru_cache(maxsize=256)
def _typestore(type_name: str, definition: str, encoding: str) -> Any:
    """Return a typestore for one definition: two bags may define a type of one name differently.

    Raises:
        BagError: the definition is in another language, or cannot be parsed.
    """
    require("bags", "rosbags")
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    if encoding == "ros2msg":
        store.register(get_types_from_msg(definition, type_name))
    elif encoding == "ros2idl":
        types: dict = {}
        for part in definition.split("=" * 80 + "\n"):
            if part.strip():
                types.update(get_types_from_idl(part.split("\n", 1)[1]))
        store.register(types)
    else:
        raise BagError(f"{type_name} is defined in {encoding!r}; only ros2msg and ros2idl are supported")
    return store
