# SPDX-License-Identifier: Apache-2.0
"""One file of a recording, of any storage and compression: its times, its messages, and what of it is damaged."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import stat
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from paul_ros.offline import mcap_frames, sqlite_file
from paul_ros.offline.bag_records import Record
from paul_ros.offline.mcap_file import McapFile
from paul_ros.offline.sqlite_file import SqliteFile
from paul_ros.wording import quantity

_ZSTD_MAGIC, _ROS1_MAGIC = b"\x28\xb5\x2f\xfd", b"#ROSBAG V"
_HEAD_BYTES = 16
_ARRAYS = (".npz", ".csv", ".json")  # suffixes of what `paul lift` reads
_NAMED_PROBLEMS = 3  # most kinds of damage that a text names


class Storage(Protocol):
    """Interface of a storage; `McapFile` explains it."""

    storage: str
    compression: str
    problems: list[str]
    messages: int

    @property
    def stated(self) -> int | None:
        """Number of messages by the file's own statistics; None = unknown."""

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time in nanoseconds; None without messages."""

    def topics(self) -> dict[str, tuple[str, int]] | None:
        """Return {topic: (type name, number of messages)} as far as the file tells without being read."""

    def records(self, path: Path, wanted: Callable[[str], bool]) -> Iterator[Record]:
        """Yield the messages on wanted topics by `Record.order`."""


class BagFile:
    """A file of a recording.

    Attributes:
        path: of the file.
        refusal: why nothing of the file can be read, and what to do; '' = it can be read.
        packed: whether the whole file is compressed; then tools of mcap cannot read it.
        compression: 'file: zstd', 'messages: zstd', 'chunks: zstd' or 'chunks: lz4'; '' = none.
    """

    def __init__(self, path: Path) -> None:
        """Recognise a file by its first bytes, and find its times."""
        self.path = path
        self.refusal = ""
        self.compression = ""
        self.packed = False
        self._pack_damage = ""
        self._storage: Storage | None = None
        try:
            if not stat.S_ISREG(path.stat().st_mode):
                self.refusal = "not a regular file; copy the recording to a file first"
            else:
                self.packed = _head(path).startswith(_ZSTD_MAGIC)
                with self._unpacked() as plain:
                    self._open(plain)
                if self._pack_damage:
                    self.problems.append(f"the compressed file is damaged ({self._pack_damage})")
        except OSError as error:
            self.refusal = error.strerror or str(error)

    def _open(self, plain: Path) -> None:
        head = _head(plain)
        if head.startswith(mcap_frames.MAGIC):
            self._storage = McapFile(plain)
        elif head.startswith(sqlite_file.MAGIC):
            self._storage = SqliteFile(plain)
        elif not head and not self.packed:
            self.refusal = "the file is empty (0 bytes); the recording never began"
        elif head.startswith(_ROS1_MAGIC):
            name = self.path.stem
            self.refusal = (
                f"a ROS 1 bag; convert it with `rosbags-convert --src {self.path} --dst {name} --dst-storage mcap`"
            )
        elif self.packed and (self._pack_damage or not head):
            self.refusal = f"the compressed file is damaged ({self._pack_damage or 'it ends too early'})"
        else:
            self.refusal = f"not an mcap or sqlite3 file; {_other_reader(self.path)}"

    @property
    def storage(self) -> str | None:
        """Name of the storage, 'mcap' or 'sqlite3'; None = unknown."""
        return self._storage.storage if self._storage else None

    @property
    def messages(self) -> int:
        """Number of messages read so far, of all topics."""
        return self._storage.messages if self._storage else 0

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time in nanoseconds; None without messages."""
        return self._storage.span if self._storage else None

    @property
    def problems(self) -> list[str]:
        """Damage in words, a clause each, as far as the file was read."""
        return self._storage.problems if self._storage else []

    def topics(self) -> dict[str, tuple[str, int]]:
        """Return {topic: (type name, number of whole messages)}; a file that does not tell is read whole."""
        known = self._storage.topics() if self._storage else {}
        if known is not None:
            return known
        found: dict[str, tuple[str, int]] = {}
        for record in self.records(lambda topic: True):
            found[record.topic] = (record.type_name, found.get(record.topic, ("", 0))[1] + 1)
        return found

    def records(self, wanted: Callable[[str], bool]) -> Iterator[Record]:
        """Yield the messages on wanted topics by `Record.order`."""
        if not self._storage:
            return
        try:
            with self._unpacked() as plain:
                for record in self._storage.records(plain, wanted):
                    if record.data[:4] == _ZSTD_MAGIC:  # CDR begins with 0
                        self.compression = "messages: zstd"
                        yield from self._message_unpacked(record)
                    else:
                        yield record
        except OSError as error:
            self.problems.append(f"it cannot be read on: {error.strerror or error}")
        if not self.compression and self._storage.compression:
            self.compression = f"chunks: {self._storage.compression}"

    def _message_unpacked(self, record: Record) -> Iterator[Record]:
        import zstandard

        try:
            data = zstandard.ZstdDecompressor().decompressobj().decompress(record.data)
        except zstandard.ZstdError as error:
            self.problems.append(f"a compressed message on {record.topic} is damaged ({error})")
        else:
            yield dataclasses.replace(record, data=data)

    @contextlib.contextmanager
    def _unpacked(self) -> Iterator[Path]:
        """Give the path of the file without the compression of the whole file.

        The unpacked file lives as long as the block: the files of a recording are unpacked one after the other.
        """
        if not self.packed:
            yield self.path
            return
        import zstandard

        self.compression = "file: zstd"
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder) / self.path.stem
            with open(self.path, "rb") as packed, open(plain, "wb") as target:
                unpacked = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
                try:
                    shutil.copyfileobj(unpacked, target)
                except zstandard.ZstdError as error:
                    self._pack_damage = str(error)
            yield plain

    @property
    def damage(self) -> str:
        """Damage of the file in a few words, as far as it was read; '' = none."""
        if self.refusal:
            return self.refusal
        counts = Counter(self.problems)
        named = [text if count == 1 else f"{count} times {text}" for text, count in counts.items()][:_NAMED_PROBLEMS]
        if len(counts) > _NAMED_PROBLEMS:
            named.append(f"and {len(counts) - _NAMED_PROBLEMS} more")
        return "; ".join(named)

    @property
    def whole_messages(self) -> str:
        """How many messages were read, and how many the file states to hold, in words."""
        stated = self._storage.stated if self._storage else None
        if stated is None:
            return quantity(self.messages, "whole message")
        return f"All {stated} messages" if self.messages == stated else f"{self.messages} of {stated} messages"


def starts_as_recording(path: Path) -> bool:
    """Return whether a path is a file that begins as those of rosbag2 or ROS 1 do, whatever its name."""
    try:
        return path.is_file() and _head(path).startswith((mcap_frames.MAGIC, sqlite_file.MAGIC, _ROS1_MAGIC))
    except OSError:
        return False


def _other_reader(path: Path) -> str:
    """Return what to do with a file that is no recording, or one of another storage."""
    if path.suffix in _ARRAYS:
        return "`paul lift` reads arrays of keypoints"
    return (
        "if it is a recording of another storage, convert it where it was recorded: "
        f"`ros2 bag convert -i {path} -o out.yaml`, where out.yaml holds "
        f"`output_bags: [{{uri: {path.stem}_mcap, storage_id: mcap, all: true}}]`"
    )


def _head(path: Path) -> bytes:
    with open(path, "rb") as stream:
        return stream.read(_HEAD_BYTES)
