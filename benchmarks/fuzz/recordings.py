# SPDX-License-Identifier: Apache-2.0
"""Recordings of several files and storages with lost, cut and foreign parts, judged by what was written.

The oracle knows every message of every file. Nothing may come that was not written, the order must be that of log
times, files that are not touched must be read whole, and a loss must be named.
"""

from __future__ import annotations

import random
import shutil
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.breaking import break_bytes
from benchmarks.fuzz.tally import Tally
from paul_ros.errors import BagError
from paul_ros.offline.bag_reader import Recording, read_records, topics_of
from paul_ros.offline.bag_records import Record

Message = tuple[int, str, bytes]
"""Log time in nanoseconds, topic, data."""

_WRITTEN_TABLES = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)",
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)",
)


def recording_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Write recordings, spoil a part of each, and read them."""
    records = list(read_records(bench.whole_bags[0]))
    for _ in range(cases):
        tally.cases += 1
        folder = bench.folder / "recording"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        written = _write(folder, records, rng)
        spoiled = _spoil(folder, list(written), rng)
        start = time.process_time()
        try:
            recording = Recording(folder)
            found = [(record.log_time, record.topic, record.data) for record in recording.whole_records()]
            topics_of(folder)
        except BagError as error:
            tally.refused += 1
            tally.refuse(error, where)
        except Exception:
            tally.crash(where)
        else:
            damage = recording.damage
            if damage:
                tally.refused += 1
                tally.refuse(damage, where)
            else:
                tally.accepted += 1
            _judge(found, written, spoiled, damage, lambda text: tally.lost(where, text))
        tally.time(time.process_time() - start)


def _write(folder: Path, records: list[Record], rng: random.Random) -> dict[Path, list[Message]]:
    """Write records as splits of any storage; return the messages of each file."""
    count, storage = rng.choice((1, 2, 3, 11)), rng.choice(("mcap", "mcap", "db3"))
    template = rng.choice(("rec_{}", "{}_rec", "a b#_{}"))
    packed = rng.random() < 0.2
    written = {}
    for number in range(count):
        first, end = (2 * len(records) * n // count for n in (number, number + 1))
        some = [(n * 10**8, (records * 2)[n]) for n in range(first, end)]
        if rng.random() < 0.3:  # as a tool that writes topic by topic
            some.sort(key=lambda timed: timed[1].topic)
        path = folder / f"{template.format(number)}.{storage}"
        _write_sqlite(path, some) if storage == "db3" else _write_mcap(path, some, rng)
        if packed:
            path = path.rename(path.with_name(path.name + ".zstd"))
            path.write_bytes(zstandard.ZstdCompressor(write_checksum=True).compress(path.read_bytes()))
        written[path] = [(time_, record.topic, record.data) for time_, record in some]
    if rng.random() < 0.5:
        names = "".join(f"  - '{path.name}'\n" for path in written)
        (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}")
    return written


def _write_mcap(path: Path, some: list[tuple[int, Record]], rng: random.Random) -> None:
    packing = rng.choice(list(CompressionType))
    with open(path, "wb") as file:
        writer = McapWriter(file, chunk_size=rng.choice((300, 5000, 10**6)), compression=packing, enable_data_crcs=True)
        writer.start("ros2", "fuzz")
        channels: dict[str, int] = {}
        if rng.random() < 0.3:
            foreign = writer.register_channel("/foreign", rng.choice(("json", "cdr", "")), 0)
            writer.add_message(foreign, some[0][0] if some else 0, b"{}", 0)
        for log_time, record in some:
            if record.topic not in channels:
                schema = writer.register_schema(record.type_name, record.encoding, record.definition.encode())
                channels[record.topic] = writer.register_channel(record.topic, "cdr", schema)
            writer.add_message(channels[record.topic], log_time, record.data, log_time)
        writer.finish()


def _write_sqlite(path: Path, some: list[tuple[int, Record]]) -> None:
    database = sqlite3.connect(path)
    for table in _WRITTEN_TABLES:
        database.execute(table)
    types = {record.topic: record.type_name for _, record in some}
    numbers = {topic: number for number, topic in enumerate(types, 1)}
    database.executemany(
        "INSERT INTO topics VALUES (?, ?, ?, 'cdr')", [(numbers[topic], topic, kind) for topic, kind in types.items()]
    )
    database.executemany(
        "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
        [(numbers[record.topic], log_time, record.data) for log_time, record in some],
    )
    database.commit()
    database.close()


def _spoil(folder: Path, files: list[Path], rng: random.Random) -> set[Path]:
    """Spoil one part of a recording; return the files that may lack messages."""
    metadata, victim = folder / "metadata.yaml", rng.choice(files)
    kind = rng.choice(("nothing", "remove", "cut", "empty", "break", "metadata"))
    if kind == "remove" and len(files) > 2:
        victim = files[1]  # without metadata.yaml, nobody misses the first or the last file
        victim.unlink()
    elif kind == "cut":
        victim.write_bytes(victim.read_bytes()[: rng.randrange(victim.stat().st_size)])
    elif kind == "empty":
        victim.write_bytes(b"")
    elif kind == "break" and ".mcap" in victim.name:  # SQLite has no checksums, so its damage can pass for messages
        victim.write_bytes(break_bytes(victim.read_bytes(), rng))
    elif kind == "metadata" and metadata.exists():
        metadata.write_bytes(break_bytes(metadata.read_bytes(), rng))
        return set(files)
    else:
        return set()
    return {victim}


def _judge(
    found: list[Message],
    written: dict[Path, list[Message]],
    spoiled: set[Path],
    damage: BagError | None,
    fail: Callable[[str], None],
) -> None:
    """Compare the messages that came with those that were written."""
    came = {message for message in found if message[1] != "/foreign"}
    everything = {message for messages in written.values() for message in messages}
    if [message[0] for message in found] != sorted(message[0] for message in found) and not damage:
        fail("the messages are out of order")
    if came - everything and (not damage or all(".mcap" in path.name for path in spoiled)):
        fail(f"{len(came - everything)} messages were never written")
    untouched = {message for path, messages in written.items() if path not in spoiled for message in messages}
    if untouched - came:
        fail(f"{len(untouched - came)} messages of whole files are lost")
    if len(came) < len(everything) and not damage and len(spoiled) < 2:
        fail(f"{len(everything) - len(came)} messages are lost without a word")
