# SPDX-License-Identifier: Apache-2.0
"""Writing of mcap files as ROS 2 writes them, without ROS. `mcap` writes the container; see the extra `bags`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from paul_ros.errors import OutputError
from paul_ros.extras import require
from paul_ros.files import atomic_file
from paul_ros.offline.bag_records import BagMessages, Record
from paul_ros.output_files import check_output

#: Bytes of a chunk. A killed recorder loses its open chunk: 64 KiB are about a second of keypoints.
_CHUNK_BYTES = 64 * 1024

#: Offered QoS of a latched topic, in the YAML of rosbag2 (metadata version 9).
LATCHED_QOS = (
    "- history: keep_last\n  depth: 1\n  reliability: reliable\n  durability: transient_local\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: automatic\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false\n"
)


class BagWriter:
    """A context manager that writes one .mcap file: profile ros2, ros2msg schemas, CDR.

    The bytes go to `PATH.RANDOM.part`, chunk by chunk; see `atomic_file`. The file takes the name PATH in one step when
    the block ends well. A block that raises leaves PATH as it was and removes the `.part` file. A killed process leaves
    the `.part` file, which `read_messages` or `mcap recover` reads up to the last whole chunk. Equal input gives equal
    bytes.

    Attributes:
        path: the file to write.
        count: number of messages written.
    """

    def __init__(self, path: str | Path, messages: BagMessages | None = None, compression: str = "zstd") -> None:
        """Prepare a writer; nothing is opened yet.

        Args:
            path: the file to write.
            messages: factory of the messages that will be written; None = the types of ROS 2 Jazzy.
            compression: of the chunks, 'zstd', 'lz4' or 'none'.
        """
        require("bags", "mcap")
        self.path = Path(path)
        self.count = 0
        self._compression = compression
        self._messages = messages or BagMessages()
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def __enter__(self) -> BagWriter:
        """Open the file. Raises OutputError if it cannot be written."""
        from mcap.writer import CompressionType, Writer

        check_output(self.path)
        # Smaller than a chunk, so that each chunk reaches the system at once.
        self._output = atomic_file(self.path, buffering=4096)
        with self._disk_errors():
            file = self._output.__enter__()
        self._writer = Writer(
            file,
            chunk_size=_CHUNK_BYTES,
            enable_data_crcs=True,
            compression=CompressionType[self._compression.upper()],
        )
        with self._disk_errors():
            self._writer.start(profile="ros2", library="paul_ros")
        return self

    def write(self, topic: str, message: Any, log_time: int, qos: str = "") -> None:
        """Append a message.

        Args:
            topic: name of the topic.
            message: made by BagMessages, or read from a bag if its type is one of Jazzy's.
            log_time: nanoseconds.
            qos: offered QoS profiles in the YAML of rosbag2.

        Raises:
            OutputError: the file cannot be written.
        """
        self.write_cdr(topic, message.__msgtype__, self._messages.serialise(message), log_time, qos)

    def write_cdr(self, topic: str, type_name: str, data: bytes, log_time: int, qos: str = "") -> None:
        """Append a serialised message of a type that this writer's factory knows; else as `write`."""
        definition = "" if (topic, type_name) in self._channels else self._messages.definition(type_name)
        self.write_record(Record(topic, type_name, data, log_time, definition, qos=qos))

    def write_record(self, record: Record) -> None:
        """Append a record of another bag unchanged, with its definition; raises OutputError."""
        channel = self._channels.get((record.topic, record.type_name)) or self._add_channel(record)
        with self._disk_errors():
            # rosbag2 and rosbags too set publish_time = log_time where the middleware gave none.
            self._writer.add_message(channel, record.log_time, record.data, record.log_time)
        self.count += 1

    def _add_channel(self, record: Record) -> int:
        if record.type_name not in self._schemas:
            definition = record.definition or self._messages.known_definition(record.type_name)
            self._schemas[record.type_name] = self._writer.register_schema(
                record.type_name, record.encoding, definition.encode()
            )
        channel = self._writer.register_channel(
            record.topic, "cdr", self._schemas[record.type_name], {"offered_qos_profiles": record.qos}
        )
        self._channels[record.topic, record.type_name] = channel
        return channel

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._disk_errors():
            try:
                if kind is None:
                    self._writer.finish()
            except BaseException as failure:
                self._output.__exit__(type(failure), failure, failure.__traceback__)
                raise
            self._output.__exit__(kind, error, trace)

    @contextlib.contextmanager
    def _disk_errors(self) -> Iterator[None]:
        """Turn an OSError into an OutputError that names the file."""
        try:
            yield
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}") from error
