# SPDX-License-Identifier: Apache-2.0
"""Bags in and out: mcap files as ROS 2 writes them, read in code, record by record, without ROS.

The container is handled by `mcap`, the messages by `rosbags`; both come with the extra `bags` and are imported only
when a bag is opened. A damaged bag gives what can still be read, then a BagError that says how much that was.
"""

from __future__ import annotations

import contextlib
import os
import struct
import tempfile
import zlib
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Iterable, Iterator

from paul_ros.errors import BagError, WriteError

MCAP_MAGIC = b"\x89MCAP0\r\n"
# A recorder that is killed loses its open chunk: small chunks lose about a second of keypoints.
_CHUNK_BYTES = 64 * 1024
_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length (mcap specification, "Records")

LATCHED_QOS = (
    "- history: keep_last\n  depth: 1\n  reliability: reliable\n  durability: transient_local\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: automatic\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""Offered QoS of a latched topic, as rosbag2 (metadata version 9) spells it."""


@dataclass(frozen=True)
class Record:
    """One message of a bag as it lies there: CDR bytes beside the definition that explains them."""

    topic: str
    type_name: str  # 'sensor_msgs/msg/PointCloud2'
    data: bytes  # CDR with its 4-byte encapsulation header
    log_time: int  # ns
    definition: str = ""  # '' = the Jazzy definition of that name
    encoding: str = "ros2msg"
    qos: str = ""

    def message(self) -> Any:
        """The decoded message: a dataclass with the field names of the rclpy message. Raises BagError."""
        try:
            return _typestore(self.type_name, self.definition, self.encoding).deserialize_cdr(self.data, self.type_name)
        except BagError:
            raise
        except Exception as error:  # rosbags raises many kinds for bytes that do not fit their definition
            raise BagError(f"a {self.type_name} message on {self.topic} does not decode: {error}") from error


def read_messages(path: str | Path, topics: Any = None) -> Iterator[tuple[str, str, Any, int]]:
    """Messages of a bag in file order: (topic, type name, decoded message, log time in ns).

    path: an .mcap file or a rosbag2 folder; topics: only these, as matches() takes them, None for all.
    Types need not be installed: the definitions in the bag are used. Raises BagError, for a damaged file after
    everything before the damage was yielded.
    """
    for record in read_records(path, topics):
        yield record.topic, record.type_name, record.message(), record.log_time


def read_records(path: str | Path, topics: Any = None) -> Iterator[Record]:
    """As read_messages, but undecoded, to be copied or decoded later."""
    wanted = None if topics is None else frozenset(topics)
    for file in _files(Path(path)):
        yield from _read_file(file, wanted)


@lru_cache(maxsize=1024)
def matches(topic: str, name: str) -> bool:
    """Whether a topic is the one of that name, in which * stands for any one part between slashes."""
    parts, wanted = topic.split("/"), name.split("/")
    return len(parts) == len(wanted) and all(want in ("*", part) for part, want in zip(parts, wanted))


def topics_of(path: str | Path) -> dict[str, tuple[str, int]]:
    """{topic: (type name, number of messages)} by reading the whole bag. Raises BagError."""
    found: dict[str, tuple[str, int]] = {}
    for record in read_records(path):
        found[record.topic] = (record.type_name, found.get(record.topic, ("", 0))[1] + 1)
    return found


class BagMessages:
    """A message factory for the writers of `msg_adapters`: make(type_name, **every_field) -> message dataclass.

    definitions: {type name: text of its .msg file} for types that Jazzy's standard messages lack.
    """

    def __init__(self, definitions: dict[str, str] | None = None):
        self._store = _jazzy()
        if definitions:
            from rosbags.typesys import get_types_from_msg

            self._store = _fresh_jazzy()
            for name, text in definitions.items():
                self._store.register(get_types_from_msg(text, name))

    def __call__(self, type_name: str, **fields: Any) -> Any:
        return self._store.types[type_name](**fields)

    @staticmethod
    def octets(data: bytes) -> Any:
        """What a uint8[] field wants."""
        import numpy as np

        return np.frombuffer(data, np.uint8)

    def serialise(self, message: Any) -> bytes:
        """Little-endian CDR."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def definition(self, type_name: str) -> str:
        """The ros2msg text of a type with everything it depends on."""
        return self._store.generate_msgdef(type_name, ros_version=2)[0]


class BagWriter:
    """Writes one .mcap file (profile ros2, ros2msg schemas, CDR); a context manager.

    The bytes go to `PATH.part`, chunk by chunk, and take the name PATH in one step when the block ends well. A block
    that fails leaves PATH as it was and nothing else; a writer that is killed leaves the `.part` file too, which
    `read_messages` (or `mcap recover`) reads up to the last whole chunk. Equal input gives equal bytes.
    compression: 'zstd', 'lz4' or 'none'. Raises BagError where the file cannot be written at
    all, WriteError where that shows on the way.
    """

    def __init__(self, path: str | Path, messages: BagMessages | None = None, compression: str = "zstd"):
        _need("mcap")
        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + ".part")
        self.count = 0
        self._compression = compression
        self._messages = messages or BagMessages()
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def __enter__(self) -> BagWriter:
        from mcap.writer import CompressionType, Writer

        check_output(self.path)
        try:
            self._file = open(self.part, "wb", buffering=4096)  # a chunk is more, so it reaches the system at once
        except OSError as error:
            raise BagError(f"cannot write {self.path}: {error.strerror}") from error
        self._writer = Writer(
            self._file,
            chunk_size=_CHUNK_BYTES,
            enable_data_crcs=True,
            compression=CompressionType[self._compression.upper()],
        )
        with self._told():
            self._writer.start(profile="ros2", library="paul_ros")
        return self

    def write(self, topic: str, message: Any, log_time: int, qos: str = "") -> None:
        """Append a message made by BagMessages (or read from a bag whose type Jazzy knows); log_time in ns."""
        self.write_cdr(topic, message.__msgtype__, self._messages.serialise(message), log_time, qos)

    def write_cdr(self, topic: str, type_name: str, data: bytes, log_time: int, qos: str = "") -> None:
        """Append a serialised message of a type that this writer's factory knows."""
        definition = "" if topic in self._channels else self._messages.definition(type_name)
        self.write_record(Record(topic, type_name, data, log_time, definition, qos=qos))

    def write_record(self, record: Record) -> None:
        """Append a record of another bag as it is, with its definition."""
        channel = self._channels.get(record.topic) or self._add_channel(record)
        with self._told():
            # rosbag2 and rosbags set publish_time = log_time too where the middleware gave none.
            self._writer.add_message(channel, record.log_time, record.data, record.log_time)
        self.count += 1

    def _add_channel(self, record: Record) -> int:
        if record.type_name not in self._schemas:
            self._schemas[record.type_name] = self._writer.register_schema(
                record.type_name, record.encoding, record.definition.encode()
            )
        self._channels[record.topic] = self._writer.register_channel(
            record.topic, "cdr", self._schemas[record.type_name], {"offered_qos_profiles": record.qos}
        )
        return self._channels[record.topic]

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        try:
            if kind is None:
                with self._told():
                    self._writer.finish()
                    self._file.flush()
                    os.fsync(self._file.fileno())
                    os.replace(self.part, self.path)
        finally:
            self.part.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # on a full disk closing fails as the writing did
                self._file.close()

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """What the disk refuses, as an error that names the file."""
        try:
            yield
        except OSError as error:
            raise WriteError(f"cannot write {self.path}: {error.strerror}") from error


def check_output(path: Path) -> None:
    """Raises BagError where no file can be written at this path, so that nobody waits for one in vain.

    Makes the folder that it is to lie in.
    """
    if path.is_dir():
        raise BagError(f"cannot write {path}: it is a folder; name a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise BagError(f"cannot write {path}: {error.strerror}") from error


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[str | Path | None]) -> None:
    """Raises BagError where an output would overwrite an input (or a file of a bag folder) or another output.

    Or where it cannot be written at all; None stands for an output or input that was not asked for.
    """
    sources = [Path(source).resolve() for source in inputs if source is not None and Path(source).exists()]
    taken: set[Path] = set()
    for output in filter(None, outputs):
        written = output.resolve()
        for read in sources:
            part = read in written.parents and (written.suffix == ".mcap" or written.name == "metadata.yaml")
            if written == read or part:
                raise BagError(f"{output}: is {'part of ' if part else ''}what is read; name another output")
        if written in taken:
            raise BagError(f"{output}: is named for two outputs; name another one")
        taken.add(written)
        check_output(output)


def _need(module: str) -> None:
    try:
        __import__(module)
    except ImportError as error:
        raise BagError(f"bags need the Python package '{module}': pip install 'paul_ros[bags]'") from error


def _fresh_jazzy() -> Any:
    _need("rosbags")
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


_jazzy = lru_cache(maxsize=1)(_fresh_jazzy)


@lru_cache(maxsize=256)
def _typestore(type_name: str, definition: str, encoding: str) -> Any:
    """A store of its own for each definition: two bags may disagree on a type of one name."""
    if not definition:
        return _jazzy()
    _need("rosbags")
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
        raise BagError(f"{type_name} is described in {encoding!r}; ros2msg and ros2idl can be read")
    return store


def _files(path: Path) -> list[Path]:
    """The mcap files of a bag in recording order."""
    if not path.exists():
        raise BagError(f"{path}: no such bag")
    if path.is_file():
        return [path]
    files = _files_in_metadata(path / "metadata.yaml") if (path / "metadata.yaml").exists() else []
    files = files or sorted(path.glob("*.mcap"))
    if not files:
        raise BagError(
            f"{path}: no .mcap file in this folder; another storage is turned into mcap by `ros2 bag convert`"
        )
    return files


def _files_in_metadata(metadata: Path) -> list[Path]:
    import yaml

    try:
        names = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [metadata.parent / Path(name).name for name in names]
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        return []  # a recorder that was killed leaves no metadata, or half of it; the files speak for themselves
    return [file for file in files if file.suffix == ".mcap" and file.exists()]


@dataclass
class _Progress:
    """What a reading of one file has met so far."""

    file: Path
    count: int = 0
    schemas: dict = field(default_factory=dict)
    channels: dict = field(default_factory=dict)


def _read_file(file: Path, wanted: frozenset | None) -> Iterator[Record]:
    _need("mcap")
    state = _Progress(file)
    try:
        with open(file, "rb") as stream:
            size = _check_start(stream, file)
            for opcode, body in _records(stream, size):
                for record in _messages_in(opcode, body, state):
                    if wanted is None or any(matches(record.topic, name) for name in wanted):
                        yield record
    except BagError:
        raise
    except OSError as error:
        raise BagError(f"{file}: {error.strerror}", state.count) from error
    except Exception as error:  # damaged bytes surface as struct, zstd, lz4, Unicode, CRC and many other errors
        raise BagError(
            f"{file}: damaged after {state.count} whole messages ({error or type(error).__name__}); those "
            f"were read. Record it again, or try `mcap recover {file.name}`",
            state.count,
        ) from error


def _check_start(stream: BinaryIO, file: Path) -> int:
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if size == 0:
        raise BagError(f"{file}: the file is empty (0 bytes); the recording never began")
    start = stream.read(len(MCAP_MAGIC))
    if start != MCAP_MAGIC:
        raise BagError(
            f"{file}: not an mcap file; `ros2 bag convert` turns other bags into mcap, `zstd -d` unpacks "
            "compressed files"
        )
    return size


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """Top-level records (opcode, body) to the end magic, every checksum of the file checked on the way."""
    from mcap.opcode import Opcode

    crc = zlib.crc32(MCAP_MAGIC)
    while True:
        head = stream.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise ValueError("the file ends too early")
        opcode, length = _RECORD_HEAD.unpack(head)
        if length > size - stream.tell():
            raise ValueError("the file ends in the middle of a record")
        body = stream.read(length)
        if opcode == Opcode.FOOTER:
            _check_footer(body, head, crc)
            if stream.read() != MCAP_MAGIC:
                raise ValueError("the end mark is missing")
            return
        if opcode == Opcode.DATA_END:
            _check_crc(struct.unpack("<I", body)[0], crc, "the data section")
            crc = 0  # what follows is the summary, with a checksum of its own
        else:
            crc = zlib.crc32(body, zlib.crc32(head, crc))
        yield opcode, body


def _check_footer(body: bytes, head: bytes, crc: int) -> None:
    """The summary's checksum covers it and the footer up to the checksum itself."""
    _check_crc(struct.unpack("<I", body[16:])[0], zlib.crc32(head + body[:16], crc), "the summary")


def _check_crc(stated: int, found: int, what: str) -> None:
    if stated not in (0, found):  # 0 = not computed, says the specification
        raise ValueError(f"checksum of {what} is wrong")


def _messages_in(opcode: int, body: bytes, state: _Progress) -> Iterator[Record]:
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import breakup_chunk

    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.CHUNK:
        parts = breakup_chunk(Chunk.read(stream), validate_crc=True)
    elif opcode == Opcode.MESSAGE:
        parts = [Message.read(stream, len(body))]
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        parts = [(Schema if opcode == Opcode.SCHEMA else Channel).read(stream)]
    else:
        return
    for part in parts:
        if isinstance(part, Schema):
            state.schemas[part.id] = part
        elif isinstance(part, Channel):
            state.channels[part.id] = part
        else:
            channel = state.channels[part.channel_id]
            state.count += 1
            yield _record(part, channel, state)


def _record(message: Any, channel: Any, state: _Progress) -> Record:
    if channel.message_encoding != "cdr":
        raise BagError(
            f"{state.file}: {channel.topic} is encoded as {channel.message_encoding!r}, not cdr: not a ROS 2 bag",
            state.count,
        )
    schema = state.schemas[channel.schema_id]
    return Record(
        channel.topic,
        schema.name,
        message.data,
        message.log_time,
        schema.data.decode(),
        schema.encoding,
        channel.metadata.get("offered_qos_profiles", ""),
    )
