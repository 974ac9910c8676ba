# SPDX-License-Identifier: Apache-2.0
"""Reading of mcap files and rosbag2 folders, message by message, without ROS.

The container is read by `mcap`, which comes with the extra `bags`. A damaged bag yields every message before the
damage, then a BagError that says how many these were.
"""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from paul_ros.errors import BagError
from paul_ros.extras import require
from paul_ros.offline.bag_records import Record

MCAP_MAGIC = b"\x89MCAP0\r\n"
_CHECKSUM_BYTES = 4


def read_messages(path: str | Path, topics: Iterable[str] | None = None) -> Iterator[tuple[str, str, Any, int]]:
    """Decode the messages of a bag in file order.

    Message types need not be installed: the definitions in the bag are used.

    Args:
        path: an .mcap file or a rosbag2 folder.
        topics: names of the topics to read, as `matches` takes them; None = all.

    Yields:
        (topic, type name, decoded message, log time in ns).

    Raises:
        BagError: the bag cannot be read. A damaged file first yields everything before the damage.
    """
    for record in read_records(path, topics):
        yield record.topic, record.type_name, record.message(), record.log_time


def read_records(path: str | Path, topics: Iterable[str] | None = None) -> Iterator[Record]:
    """Read the messages of a bag as `read_messages` does, but leave them serialised."""
    wanted = None if topics is None else frozenset(topics)
    for file in _files(Path(path)):
        yield from _read_file(file, wanted)


@lru_cache(maxsize=1024)
def matches(topic: str, name: str) -> bool:
    """Return whether a topic has a name; * in the name stands for any one part between slashes."""
    parts, wanted = topic.split("/"), name.split("/")
    return len(parts) == len(wanted) and all(want in ("*", part) for part, want in zip(parts, wanted))


def topics_of(path: str | Path) -> dict[str, tuple[str, int]]:
    """Read a whole bag and return {topic: (type name, number of messages)}; raises BagError."""
    found: dict[str, tuple[str, int]] = {}
    for record in read_records(path):
        found[record.topic] = (record.type_name, found.get(record.topic, ("", 0))[1] + 1)
    return found


def _files(path: Path) -> list[Path]:
    """Return the mcap files of a bag in recording order."""
    if not path.exists():
        raise BagError(f"{path}: no such file or folder")
    if path.is_file():
        return [path]
    files = _files_in_metadata(path / "metadata.yaml") if (path / "metadata.yaml").exists() else []
    files = files or sorted(path.glob("*.mcap"))
    if not files:
        raise BagError(f"{path}: no .mcap file in this folder; convert other storages with `ros2 bag convert`")
    return files


def _files_in_metadata(metadata: Path) -> list[Path]:
    try:
        names = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [metadata.parent / Path(name).name for name in names]
    except (yaml.YAMLError, ValueError, RecursionError, KeyError, TypeError):
        return []  # a killed recorder leaves no metadata, or half of it; then the files themselves are listed
    return [file for file in files if file.suffix == ".mcap" and file.exists()]


def _read_file(file: Path, wanted: frozenset[str] | None) -> Iterator[Record]:
    require("bags", "mcap")
    count = 0
    try:
        with _WholeReads(open(file, "rb", buffering=0)) as stream:
            for message, channel, schema in _messages(stream, _check_start(stream, file)):
                if channel.message_encoding != "cdr":
                    raise BagError(
                        f"{file}: {channel.topic} is encoded as {channel.message_encoding!r}, not cdr: not a ROS 2 bag",
                        count,
                    )
                count += 1
                if wanted is None or any(matches(channel.topic, name) for name in wanted):
                    yield Record(
                        channel.topic,
                        schema.name,
                        message.data,
                        message.log_time,
                        schema.data.decode(),
                        schema.encoding,
                        channel.metadata.get("offered_qos_profiles", ""),
                    )
    except BagError:
        raise
    except OSError as error:
        raise BagError(f"{file}: {error.strerror}", count) from error
    except Exception as error:  # damaged bytes surface as struct, zstd, lz4, Unicode, CRC and many other errors
        raise BagError(
            f"{file}: damaged after {count} whole messages ({_cause(error)}); those "
            f"were read. Record it again, or try `mcap recover {file.name}`",
            count,
        ) from error


def _cause(error: Exception) -> str:
    """Return in words why a file cannot be read further."""
    from mcap.exceptions import RecordLengthLimitExceeded

    if isinstance(error, RecordLengthLimitExceeded):
        return "the file ends too early, or the length of a record is damaged"
    return str(error) or type(error).__name__


class _WholeReads(io.BufferedReader):
    """A file whose reads return all bytes or raise: the mcap library accepts a message cut short by the file's end."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if len(data) != size:
            raise ValueError("the file ends too early")
        return data


def _check_start(stream: io.BufferedReader, file: Path) -> int:
    """Return the size of a file that begins as an mcap file, and stay at its start."""
    size = stream.seek(0, os.SEEK_END)
    if size == 0:
        raise BagError(f"{file}: the file is empty (0 bytes); the recording never began")
    stream.seek(0)
    if stream.peek(len(MCAP_MAGIC))[: len(MCAP_MAGIC)] != MCAP_MAGIC:
        raise BagError(
            f"{file}: not an mcap file; convert other bags with `ros2 bag convert`, unpack compressed files with "
            "`zstd -d`"
        )
    stream.seek(0)
    return size


def _messages(stream: io.BufferedReader, size: int) -> Iterator[tuple[Any, Any, Any]]:
    """Yield the messages of an mcap file with their channels and schemas, and check every checksum of the file.

    The mcap library checks the chunks, the data section and the end mark. It ignores the summary's checksum, a missing
    end of the data section, and bytes after the end mark; these are checked here.
    """
    from mcap.records import Channel, DataEnd, Footer, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    summary_start = None
    # A damaged length of a record can exceed the file; the limit stops the library from allocating so much.
    for record in StreamReader(stream, validate_crcs=True, record_size_limit=size).records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            if channel is None:
                raise ValueError(f"a message is of channel {record.channel_id}, which the file does not describe")
            if channel.schema_id not in schemas:
                raise ValueError(f"{channel.topic} has no schema")
            yield record, channel, schemas[channel.schema_id]
        elif isinstance(record, DataEnd):
            summary_start = stream.tell()
        elif isinstance(record, Footer):
            _check_summary(stream, summary_start, record.summary_crc)
    if stream.tell() != size:
        raise ValueError("the file goes on after the end mark")


def _check_summary(stream: io.BufferedReader, start: int | None, checksum: int) -> None:
    """Check the checksum of the summary; the file stays behind the footer.

    mcap specification, "Footer": it covers the summary and the footer up to the checksum itself; 0 = not computed.
    """
    if start is None:
        raise ValueError("the data section has no end")
    footer_end = stream.tell()
    stream.seek(start)
    covered = stream.read(footer_end - _CHECKSUM_BYTES - start)
    stream.seek(footer_end)
    if checksum not in (0, zlib.crc32(covered)):
        raise ValueError("the checksum of the summary is wrong")
