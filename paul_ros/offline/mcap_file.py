# SPDX-License-Identifier: Apache-2.0
"""One mcap file, read in the order of log time, and read on behind damage.

A first walk finds the blocks of the file. Each is loaded when the reading reaches its first log time. So the memory
does not grow with the file.

The package `mcap` parses descriptions. It comes with the extra `bags`.
"""

from __future__ import annotations

import functools
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from paul_ros.offline.bag_records import MAX_LOG_TIME, Record, type_name
from paul_ros.offline.mcap_frames import CHANNEL, CHUNK, CHUNK_HEAD, FRAME, MESSAGE, MESSAGE_HEAD, SCHEMA, Block, Frames
from paul_ros.offline.time_order import merge_by_time

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

_LENGTH = struct.Struct("<Q")
_MAX_CHUNK_BYTES = 1 << 32  # uncompressed; a damaged size must not take all memory


class McapFile:
    """An mcap file.

    Attributes:
        storage: name of the storage, as in metadata.yaml.
        compression: of the chunks, such as 'zstd'; '' = none, or not known before the file is read.
        problems: damage in words, a clause each; grows while the file is read.
        messages: number of messages read, of all topics.
    """

    storage = "mcap"

    def __init__(self, path: Path) -> None:
        """Find the blocks of a file; raises OSError."""
        with open(path, "rb") as stream:
            frames = Frames(stream)
        self.compression = ""
        self.problems = frames.problems
        self._statistics = frames.statistics
        self.messages = 0
        self._blocks = frames.blocks
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._searched = False
        for opcode, content in frames.descriptions:
            self._describe(opcode, content)

    @property
    def stated(self) -> int | None:
        """Number of messages by the file's own statistics; None = unknown."""
        return self._statistics.message_count if self._statistics else None

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time in nanoseconds; None without messages."""
        if not self._blocks:
            return None
        return min(block.first for block in self._blocks), max(block.last for block in self._blocks)

    def topics(self) -> dict[str, tuple[str, int]] | None:
        """Return {topic: (type name, number of messages)} by the file's own statistics; None = unknown."""
        if not self._statistics or self.problems:
            return None
        found: dict[str, tuple[str, int]] = {}
        for number, count in self._statistics.channel_message_counts.items():
            channel = self._channels.get(number)
            if channel is None:
                return None
            if count:
                found[channel.topic] = (self._type_name(channel), count + found.get(channel.topic, ("", 0))[1])
        return found

    def records(self, path: Path, wanted: Callable[[str], bool]) -> Iterator[Record]:
        """Yield the messages on wanted topics in the order of log time.

        Args:
            path: of the file, which may have another name than before.
            wanted: tells whether a topic is read.
        """
        wanted = functools.cache(wanted)
        with open(path, "rb") as stream:
            yield from merge_by_time(
                (block.first, functools.partial(self._block_records, stream, block, wanted)) for block in self._blocks
            )
        if self.stated is not None and self.messages < self.stated and not self.problems:
            self.problems.append("the file states more messages than it holds")

    def _block_records(self, stream: BinaryIO, block: Block, wanted: Callable[[str], bool]) -> Iterator[Record]:
        found = self._load(stream, block, wanted)
        found.sort(key=lambda record: record.order)  # stable: equal ones keep the order of the file
        if found and found[0].log_time < block.first:
            self.problems.append("the times of a chunk are wrong, so messages come late")
        found.reverse()
        while found:
            yield found.pop()  # so that a block with one late message does not keep the others

    def _load(self, stream: BinaryIO, block: Block, wanted: Callable[[str], bool]) -> list[Record]:
        found: list[Record] = []
        try:
            data = self._data(stream, block)
            for opcode, start, end in _inner_frames(data):
                if opcode == MESSAGE:
                    record = self._record(data, start, end, stream, wanted)
                    if record:
                        found.append(record)
                elif opcode in (SCHEMA, CHANNEL):
                    self._describe(opcode, bytes(data[start:end]))
        except Exception as error:  # damaged bytes surface as struct, zstd, lz4, Unicode, CRC and many other errors
            part = "a chunk" if block.chunk else "a part"
            self.problems.append(f"{part} is damaged ({str(error) or type(error).__name__})")
        return found

    def _data(self, stream: BinaryIO, block: Block) -> memoryview:
        """Return the records of a block; of a chunk, decompressed and with the checksum checked."""
        stream.seek(block.start)
        raw = stream.read(block.end - block.start)
        if len(raw) < block.end - block.start:
            raise ValueError("the file ends too early")
        if not block.chunk:
            return memoryview(raw)
        # Parsed here, since `mcap` copies the bytes of a chunk four times: images make chunks large.
        _, _, size, checksum, length = CHUNK_HEAD.unpack_from(raw, FRAME.size)
        at = FRAME.size + CHUNK_HEAD.size + length
        compression = str(raw[at - length : at], "utf-8")
        at += _LENGTH.size
        (length,) = _LENGTH.unpack_from(raw, at - _LENGTH.size)
        if size > _MAX_CHUNK_BYTES:
            raise ValueError(f"it states a size of {size} bytes")
        self.compression = self.compression or compression
        content = _unpacked(compression, memoryview(raw)[at : at + length], size)
        if checksum and checksum != (found := zlib.crc32(content)):
            raise ValueError(f"its checksum is {found}, and it states {checksum}")
        if len(content) != size:
            raise ValueError(f"it has {len(content)} bytes in place of {size}")
        return content

    def _record(
        self, data: memoryview, start: int, end: int, stream: BinaryIO, wanted: Callable[[str], bool]
    ) -> Record | None:
        """Count a message, and return it if its topic is wanted."""
        number, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, start)
        channel = self._channels.get(number) or self._search_channel(number, stream)
        if channel is None:
            self.problems.append(f"messages are of channel {number}, which the file does not describe")
            return None
        if log_time > MAX_LOG_TIME:
            self.problems.append(f"a message on {channel.topic} has no possible log time ({log_time} ns)")
            return None
        self.messages += 1
        if not wanted(channel.topic):
            return None
        schema = self._schemas.get(channel.schema_id)
        return Record(
            channel.topic,
            self._type_name(channel),
            bytes(data[start + MESSAGE_HEAD.size : end]),
            log_time,
            schema.data.decode(errors="replace") if schema else "",
            schema.encoding if schema else "",
            channel.metadata.get("offered_qos_profiles", ""),
            channel.metadata.get("topic_type_hash", ""),
        )

    def _type_name(self, channel: Channel) -> str:
        schema = self._schemas.get(channel.schema_id)
        return type_name(schema.name if schema else "", channel.message_encoding)

    def _search_channel(self, number: int, stream: BinaryIO) -> Channel | None:
        """Read the descriptions in all chunks: a killed recorder leaves no summary that repeats them."""
        if not self._searched:
            self._searched = True
            for block in self._blocks:
                try:
                    data = self._data(stream, block)
                    for opcode, start, end in _inner_frames(data):
                        if opcode in (SCHEMA, CHANNEL):
                            self._describe(opcode, bytes(data[start:end]))
                except Exception:  # noted when the block's own turn comes
                    continue
        return self._channels.get(number)

    def _describe(self, opcode: int, content: bytes) -> None:
        """Keep a schema or a channel; the first description of a number counts."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel, Schema

        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == SCHEMA:
                schema = Schema.read(stream)
                self._schemas.setdefault(schema.id, schema)
            else:
                channel = Channel.read(stream)
                self._channels.setdefault(channel.id, channel)
        except Exception as error:  # as many kinds as in `_load`
            self.problems.append(f"a description of a topic is damaged ({str(error) or type(error).__name__})")


def _unpacked(compression: str, packed: memoryview, size: int) -> memoryview:
    """Return the records of a chunk. The packages come with `mcap`."""
    if compression == "zstd":
        import zstandard

        return memoryview(zstandard.decompress(packed, size))
    if compression == "lz4":
        import lz4.frame

        return memoryview(lz4.frame.decompress(packed))
    if compression:
        raise ValueError(f"its compression is '{compression}', not zstd or lz4")
    return packed


def _inner_frames(data: memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the content of the records in a block."""
    at = 0
    while at < len(data):
        opcode, length = FRAME.unpack_from(data, at)
        start = at + FRAME.size
        at = start + length
        if at > len(data) or opcode == CHUNK:
            raise ValueError("the length of a record is damaged")
        yield opcode, start, at
