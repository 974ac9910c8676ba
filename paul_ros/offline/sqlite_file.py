# SPDX-License-Identifier: Apache-2.0
"""One sqlite3 file of rosbag2 (.db3), read in the order of log time, and read on behind damage.

SQLite stores no checksums: damage inside a message is noticed only if the message does not decode.
"""

from __future__ import annotations

import contextlib
import itertools
import operator
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from paul_ros.offline.bag_records import CDR, MAX_LOG_TIME, Record, type_name
from paul_ros.wording import quantity

MAGIC = b"SQLite format 3\0"

_ERRORS = (sqlite3.Error, UnicodeError, MemoryError)  # damaged sizes, and damaged bytes in the text of an error

_HEADER_BYTES = 100
_SMALL_STEPS = 1000  # rows that are tried one by one behind damage; then the steps double


@dataclass(frozen=True)
class _Topic:
    """A row of the table `topics`, with the definition of its type."""

    name: str
    type_name: str
    qos: str = ""
    type_hash: str = ""
    definition: str = ""
    encoding: str = "ros2msg"


class SqliteFile:
    """An sqlite3 file; the attributes are those of `McapFile`."""

    storage = "sqlite3"
    compression = ""

    def __init__(self, path: Path) -> None:
        """Read the topics and the first and last log time of a file."""
        self.problems: list[str] = []
        self.stated: int | None = None
        self.messages = 0
        self.span: tuple[int, int] | None = None
        self._topics: dict[int, _Topic] = {}
        self._counts: dict[str, tuple[str, int]] = {}
        if _is_cut(path):
            self.problems.append("the file ends too early")
        try:
            with _connection(path) as database:
                self._topics = _read_topics(database)
                self.stated, first, last = database.execute(
                    "SELECT count(*), min(timestamp), max(timestamp) FROM messages"
                ).fetchone()
                self.span = (first, last) if self.stated else None
                for number, count in database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"):
                    topic = self._topics[number]
                    self._counts[topic.name] = (topic.type_name, count)
        except (*_ERRORS, KeyError) as error:
            if not self._topics:
                self.problems.append(f"the database is damaged ({error})")
            # The reading notes other damage. Without times, the file comes first.
            self.stated, self.span, self._counts = None, (0, 0) if self._topics else None, {}

    def topics(self) -> dict[str, tuple[str, int]] | None:
        """Return {topic: (type name, number of messages)}; None = unknown, as the database is damaged."""
        if self.problems or not self.stated:
            return None
        return self._counts

    def records(self, path: Path, wanted: Callable[[str], bool]) -> Iterator[Record]:
        """Yield the messages on wanted topics by `Record.order`.

        Args:
            path: of the file, which may have another name than before.
            wanted: tells whether a topic is read.
        """
        for _, tied in itertools.groupby(self._by_time(path, wanted), key=operator.attrgetter("log_time")):
            yield from sorted(tied, key=operator.attrgetter("order"))

    def _by_time(self, path: Path, wanted: Callable[[str], bool]) -> Iterator[Record]:
        if not self._topics:
            return
        with _connection(path) as database:
            last = (-(2**63), -1)
            try:
                rows = database.execute("SELECT timestamp, id, topic_id, data FROM messages ORDER BY timestamp, id")
                for time, row, topic, data in rows:
                    if not _is_after((time, row), last):
                        raise sqlite3.DatabaseError("its index is out of order")
                    yield from self._record(time, topic, data, wanted)
                    last = (time, row)
            except _ERRORS as error:
                self.problems.append(f"the database is damaged ({error})")
                yield from self._salvaged(database, last, wanted)

    def _record(self, time: Any, topic: Any, data: Any, wanted: Callable[[str], bool]) -> Iterator[Record]:
        """Count a message, and yield it if its topic is wanted."""
        described = self._topics.get(topic)
        if described is None or not isinstance(data, bytes) or not isinstance(time, int):
            self.problems.append("a message has no topic or no data")
            return
        if not 0 <= time <= MAX_LOG_TIME:
            self.problems.append(f"a message on {described.name} has no possible log time ({time} ns)")
            return
        self.messages += 1
        if wanted(described.name):
            yield Record(
                described.name,
                described.type_name,
                data,
                time,
                described.definition,
                described.encoding,
                described.qos,
                described.type_hash,
            )

    def _salvaged(
        self, database: sqlite3.Connection, last: tuple[int, int], wanted: Callable[[str], bool]
    ) -> Iterator[Record]:
        """Yield the messages behind the last one that was read, as far as they are whole."""
        lost = 0
        for time, row in sorted(found for found in _whole_rows(database) if found > last):
            try:
                topic, data = database.execute("SELECT topic_id, data FROM messages WHERE id = ?", (row,)).fetchone()
            except (*_ERRORS, TypeError):
                lost += 1
            else:
                yield from self._record(time, topic, data, wanted)
        if lost:
            self.problems.append(f"{quantity(lost, 'message')} cannot be read")


@contextlib.contextmanager
def _connection(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database without writing anything beside it.

    A write-ahead log beside the file holds the last messages of a recorder that was killed, or still records. SQLite
    reads it only in a folder that can be written to.
    """
    with contextlib.ExitStack() as stack:
        if path.stat().st_size % _page_bytes(path):
            path = stack.enter_context(_whole_pages(path))
        log = path.with_name(path.name + "-wal")
        mode = "mode=ro" if log.exists() and log.stat().st_size else "immutable=1"
        database = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True)
        stack.callback(database.close)
        # Otherwise SQLite refuses a whole file that was cut. Nothing is written in this mode.
        database.text_factory = lambda data: data.decode(errors="replace")
        database.execute("PRAGMA writable_schema = ON")
        yield database


def _page_bytes(path: Path) -> int:
    """Return the size of a database's pages; at least 512 (https://sqlite.org/fileformat.html, "Page Size")."""
    with open(path, "rb") as stream:
        size = int.from_bytes(stream.read(_HEADER_BYTES)[16:18], "big")
    return 65536 if size == 1 else max(size, 512)


def _is_cut(path: Path) -> bool:
    """Return whether a database has fewer pages than its header states. A write-ahead log may hold the others."""
    with open(path, "rb") as stream:
        pages = int.from_bytes(stream.read(_HEADER_BYTES)[28:32], "big")
    return path.stat().st_size < pages * _page_bytes(path)


@contextlib.contextmanager
def _whole_pages(path: Path) -> Iterator[Path]:
    """Give a copy of a cut database without the last page: SQLite takes what a page lacks for zeros."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        shutil.copyfile(path, copy)
        os.truncate(copy, path.stat().st_size // _page_bytes(path) * _page_bytes(path))
        yield copy


def _read_topics(database: sqlite3.Connection) -> dict[int, _Topic]:
    """Return topics by their numbers. Recordings before ROS 2 Iron hold no definitions."""
    definitions: dict[str, tuple[str, str]] = {}
    with contextlib.suppress(*_ERRORS):
        for row in _rows(database, "message_definitions"):
            definitions[row["topic_type"]] = (row["encoded_message_definition"], row["encoding"])
    topics = {}
    for row in _rows(database, "topics"):
        definition, encoding = definitions.get(row["type"], ("", "ros2msg"))
        topics[row["id"]] = _Topic(
            row["name"],
            type_name(row["type"], row.get("serialization_format", CDR)),
            row.get("offered_qos_profiles", ""),
            row.get("type_description_hash", ""),
            definition,
            encoding if definition else "ros2msg",
        )
    return topics


def _rows(database: sqlite3.Connection, table: str) -> list[dict[str, Any]]:
    cursor = database.execute(f"SELECT * FROM {table}")
    names = [column[0] for column in cursor.description]
    return [dict(zip(names, row)) for row in cursor]


def _whole_rows(database: sqlite3.Connection) -> Iterator[tuple[int, int]]:
    """Yield (log time, number) of the rows that can be read, stepping over damaged pages."""
    row, failures = -1, 0
    while row < MAX_LOG_TIME:
        try:
            for number, time in database.execute(
                "SELECT id, timestamp FROM messages NOT INDEXED WHERE id > ? ORDER BY id", (row,)
            ):
                if not _is_after((0, number), (0, row)):
                    raise sqlite3.DatabaseError("its rows are out of order")
                row, failures = number, 0
                if isinstance(time, int):  # a damaged row has empty columns
                    yield time, number
            return
        except _ERRORS:
            failures += 1
            row += 1 << max(0, failures - _SMALL_STEPS)


def _is_after(place: tuple[Any, Any], last: tuple[int, int]) -> bool:
    """Return whether (log time, number) follows another; damaged pages can lead in circles."""
    return all(isinstance(value, int) for value in place) and place > last
