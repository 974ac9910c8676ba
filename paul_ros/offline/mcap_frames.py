# SPDX-License-Identifier: Apache-2.0
"""The frames of an mcap file: found without decompression, with the file's checksums, and found again behind damage.

Format: https://mcap.dev/spec. Each record has a frame: an opcode, a length, and so many bytes of content.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from mcap.records import Statistics

MAGIC = b"\x89MCAP0\r\n"

FOOTER, SCHEMA, CHANNEL, MESSAGE = 0x02, 0x03, 0x04, 0x05
CHUNK, MESSAGE_INDEX, STATISTICS, DATA_END = 0x06, 0x07, 0x0B, 0x0F
"""Opcodes of records."""

FRAME = struct.Struct("<BQ")
"""Opcode, and length of the content."""

MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, log time and publish time; the data follow."""

CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last log time, size and checksum of the records, length of the compression's name."""

_DATA_END_CONTENT = struct.Struct("<I")  # checksum
_FOOTER_CONTENT = struct.Struct("<QQI")  # start of the summary, start of its offsets, checksum
_CHECKSUM_BYTES = 4
_LAST_OPCODE, _FIRST_PRIVATE_OPCODE = 0x0F, 0x80

_RUN_BYTES = 256 * 1024  # of messages outside chunks that are loaded at once
_PIECE_BYTES = 1 << 20  # read at once

#: A search takes such bytes for a possible frame: its length is below 4 GiB.
_POSSIBLE_FRAME = re.compile(rb"[\x03-\x07\x0f]....\x00\x00\x00\x00", re.DOTALL)
_PROOF = 3  # whole records in a row that prove the first of them


@dataclass(slots=True)
class Block:
    """Bytes of a file that are loaded together: a chunk, or a run of messages outside chunks.

    Attributes:
        first: lowest log time in nanoseconds.
        last: highest log time.
        start: place of the first frame.
        end: place behind the last record.
        chunk: whether the block is a chunk.
    """

    first: int
    last: int
    start: int
    end: int
    chunk: bool


class Frames:
    """The walk through the frames of a file.

    Attributes:
        blocks: chunks, and runs of messages outside chunks, in the order of the file.
        descriptions: (opcode, content) of schemas and channels outside chunks.
        statistics: counts of messages in the summary; None = there are none.
        problems: damage in words, a clause each.
    """

    def __init__(self, stream: BinaryIO) -> None:
        """Walk through a file whose start is known to be MAGIC; raises OSError."""
        self.blocks: list[Block] = []
        self.descriptions: list[tuple[int, bytes]] = []
        self.statistics: Statistics | None = None
        self.problems: list[str] = []
        self._stream = stream
        self._size = stream.seek(0, 2)
        data_end = self._walk_data()
        if data_end is not None:
            self._walk_summary(data_end)

    # --- the data section

    def _walk_data(self) -> int | None:
        """Find the blocks; return the place behind the data section, or None if the file ends before."""
        at = described = len(MAGIC)
        while True:
            frame = self._frame(at)
            if frame is None or frame[0] == FOOTER:
                self.problems.append(self._what_is_wrong(at))
                found = self._search(at)
                if found is None:
                    return None
                at = found
                continue
            opcode, end = frame
            if opcode == DATA_END:
                self._check_data(at, end, described)
                return end
            try:
                self._take(opcode, at, end)
            except struct.error:
                self.problems.append(f"the record at byte {at} is too short")
            at = end
            if opcode not in (SCHEMA, CHANNEL):
                described = end

    def _frame(self, at: int) -> tuple[int, int] | None:
        """Return the opcode and the end of the record at a place, or None if there is no whole record."""
        self._stream.seek(at)
        head = self._stream.read(FRAME.size)
        if len(head) < FRAME.size:
            return None
        opcode, length = FRAME.unpack(head)
        end = at + FRAME.size + length
        known = 0 < opcode <= _LAST_OPCODE or opcode >= _FIRST_PRIVATE_OPCODE
        return (opcode, end) if known and end <= self._size else None

    def _what_is_wrong(self, at: int) -> str:
        """Return why the record at a place cannot be read."""
        self._stream.seek(at)
        head = self._stream.read(FRAME.size)
        if len(head) < FRAME.size:
            return "the file ends too early"
        if head[0] == FOOTER:
            return "the data section has no end"
        if 0 < head[0] <= _LAST_OPCODE:
            return "the file ends too early, or the length of a record is damaged"
        return f"no record begins at byte {at}"

    def _search(self, at: int) -> int | None:
        """Return the place of the next record behind a damaged one from which the walk can go on.

        Chunks without compression hold frames too, but their checksum is that of the whole chunk. So the walk of a file
        with chunks, or with their indices, goes on at a chunk.
        """
        self._stream.seek(at)
        chunked = self._stream.read(1) == bytes([CHUNK]) or any(block.chunk for block in self.blocks)
        start = at + 1
        if chunked or self._next(start, (CHUNK, MESSAGE_INDEX)) is not None:
            return self._next(start, (CHUNK, DATA_END))
        return self._next(start, (SCHEMA, CHANNEL, MESSAGE, DATA_END))

    def _next(self, start: int, opcodes: Collection[int]) -> int | None:
        """Return the place of the next record of some kinds."""
        for place in self._possible_frames(start):
            frame = self._frame(place)
            if frame and frame[0] in opcodes and self._is_proven(place):
                return place
        return None

    def _possible_frames(self, start: int) -> Iterator[int]:
        while start < self._size:
            self._stream.seek(start)
            piece = self._stream.read(_PIECE_BYTES)
            offset = 0
            while found := _POSSIBLE_FRAME.search(piece, offset):
                yield start + found.start()
                offset = found.start() + 1
            start += max(1, len(piece) - FRAME.size + 1)

    def _is_proven(self, at: int) -> bool:
        for _ in range(_PROOF):
            frame = self._frame(at)
            if frame is None:
                return False
            at = frame[1]
            if at == self._size:
                break
        return True

    def _take(self, opcode: int, at: int, end: int) -> None:
        """Note a record of the data section; the stream is behind its frame."""
        if opcode == CHUNK:
            first, last, *_ = CHUNK_HEAD.unpack(self._stream.read(CHUNK_HEAD.size))
            self.blocks.append(Block(first, last, at, end, True))
        elif opcode == MESSAGE:
            self._take_message(MESSAGE_HEAD.unpack(self._stream.read(MESSAGE_HEAD.size))[2], at, end)
        elif opcode in (SCHEMA, CHANNEL):
            self.descriptions.append((opcode, self._stream.read(end - at - FRAME.size)))

    def _take_message(self, time: int, at: int, end: int) -> None:
        run = self.blocks[-1] if self.blocks else None
        if run and not run.chunk and run.end == at and end - run.start <= _RUN_BYTES:
            run.first, run.last, run.end = min(run.first, time), max(run.last, time), end
        else:
            self.blocks.append(Block(time, time, at, end, False))

    def _check_data(self, at: int, end: int, described: int) -> None:
        """Check the checksum in the record that ends the data section: of all bytes before it; 0 = not computed.

        The Python package `mcap` 1.6 leaves out the last descriptions of a file without chunks, those of topics without
        messages. They begin at `described`.
        """
        content = self._stream.read(end - at - FRAME.size)
        if len(content) < _DATA_END_CONTENT.size:
            self.problems.append("the end of the data section is damaged")
        elif (checksum := _DATA_END_CONTENT.unpack_from(content)[0]) and checksum not in (
            self._checksum(0, place) for place in {at, described}
        ):
            self.problems.append("the checksum of the data section is wrong")

    def _checksum(self, start: int, end: int) -> int:
        self._stream.seek(start)
        checksum = 0
        while start < end:
            piece = self._stream.read(min(_PIECE_BYTES, end - start))
            if not piece:
                break
            checksum = zlib.crc32(piece, checksum)
            start += len(piece)
        return checksum

    # --- the summary

    def _walk_summary(self, start: int) -> None:
        """Read descriptions and statistics behind the data section, and check the end of the file."""
        descriptions: list[tuple[int, bytes]] = []
        statistics, at = b"", start
        while True:
            frame = self._frame(at)
            if frame is None:
                self.problems.append(f"the index is damaged: {self._what_is_wrong(at)}")
                return
            opcode, end = frame
            content = (
                self._stream.read(end - at - FRAME.size) if opcode in (SCHEMA, CHANNEL, STATISTICS, FOOTER) else b""
            )
            at = end
            if opcode in (SCHEMA, CHANNEL):
                descriptions.append((opcode, content))
            elif opcode == STATISTICS:
                statistics = content
            elif opcode == FOOTER:
                break
        if len(content) < _FOOTER_CONTENT.size:
            self.problems.append("the index is damaged: its end is too short")
            return
        checksum = _FOOTER_CONTENT.unpack_from(content)[2]
        # mcap specification, "Footer": of the summary and the footer up to the checksum itself; 0 = not computed.
        if checksum not in (0, self._checksum(start, at - _CHECKSUM_BYTES)):
            self.problems.append("the checksum of the index is wrong")
            return
        self.statistics = _parsed(statistics) if statistics else None
        self.descriptions += descriptions
        self._check_end(at)

    def _check_end(self, at: int) -> None:
        self._stream.seek(at)
        mark = self._stream.read(len(MAGIC))
        if mark != MAGIC:
            self.problems.append("the end mark is damaged" if len(mark) == len(MAGIC) else "the file ends too early")
        elif at + len(MAGIC) != self._size:
            self.problems.append("the file goes on after the end mark")


def _parsed(content: bytes) -> Statistics | None:
    from mcap.data_stream import ReadDataStream
    from mcap.records import Statistics

    try:
        return Statistics.read(ReadDataStream(BytesIO(content)))
    except Exception:  # the checksum is right, so another version of the format wrote it
        return None
