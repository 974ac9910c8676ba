# SPDX-License-Identifier: Apache-2.0
"""Recordings as robots leave them: split, unordered, compressed, cut, beside foreign channels, in other storages.

The oracle knows every message that was written, and which file holds it. The reader must give these messages, each
once, in order of log time. The error must name each file of which a message is missing.
"""

from __future__ import annotations

import random
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.messages import camera_info, cloud, header, random_pose
from benchmarks.fuzz.tally import Tally
from paul_ros.errors import BagError
from paul_ros.offline.bag_reader import read_records
from paul_ros.offline.bag_records import Record
from paul_ros.offline.replay import replay

KEYPOINTS = "/keypoints"
_CLOUD, _INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
_SECOND = 10**9


@dataclass
class Recording:
    """A recording on disk.

    Attributes:
        path: of the file or folder.
        parts: name of each file -> the messages of keypoints that it holds, as bytes.
        hurt: names of files that are cut, overwritten or missing.
        refused: whether reading it must be refused, because it is several recordings.
    """

    path: Path
    parts: dict[str, list[bytes]]
    hurt: set[str]
    refused: bool = False


def recording_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Write recordings and read them."""
    for number in range(cases):
        folder = bench.folder / "recording"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        tally.cases += 1
        name = f"{where} case {number}"
        try:
            made, kind = _make(bench, rng, folder)
            _judge(made, rng, bench, tally, f"{name} {kind}")
        except Exception:
            tally.crash(name)


def _judge(made: Recording, rng: random.Random, bench: Bench, tally: Tally, where: str) -> None:
    """Read a recording and compare it with what was written."""
    read: list[Record] = []
    error = None
    try:
        read.extend(read_records(made.path, [KEYPOINTS]))
    except BagError as caught:
        error = caught
        tally.refuse(caught, where)
    if made.refused:
        if error is None or read:
            tally.misread(where, "several recordings were read as one")
        tally.refused += 1
        return
    got = [record.data for record in read]
    written = [data for part in made.parts.values() for data in part]
    # Nobody can tell that a message outside of chunks was overwritten: it has no checksum.
    if len(set(got)) < len(got) or not (made.hurt or set(got) <= set(written)):
        tally.misread(where, "a message was read twice, or was never written")
    times = [record.log_time for record in read]
    if times != sorted(times):
        tally.misread(where, "messages are not in order of log time")
    for name, part in made.parts.items():
        lost = len(set(part) - set(got))
        if lost and name not in made.hurt:
            tally.lost(where, f"{lost} messages of the whole file {name} were not read: {error}")
        elif lost and (error is None or name not in str(error)):
            tally.lost(where, f"{lost} messages of the damaged file {name} are lost, and it is not named: {error}")
    if error and not made.hurt:
        tally.misread(where, f"a whole recording was refused: {error}")
    tally.refused += error is not None
    tally.accepted += error is None
    if got and not made.hurt and rng.random() < 0.1:
        done = replay(made.path, bench.stream(rng))
        if done.stream.counts["frames"] + sum(done.stream.ledger.drops.values()) < len(got):
            tally.lost(where, "replay counts fewer messages than were read")


def _records(bench: Bench, rng: random.Random) -> list[Record]:
    """Return the messages of a recording in order of log time, each log time once."""
    make = bench.bag
    count, start = rng.randrange(1, 20), 1_700_000_000 * _SECOND
    records = [_record(bench, "/camera_info", _INFO, camera_info(make, rng), start)]
    for number in range(1, count + 1):
        message = cloud(make, header(make, rng, number), [random_pose(rng)], rng)
        records.append(_record(bench, KEYPOINTS, _CLOUD, message, start + number * _SECOND // 30))
    return records


def _record(bench: Bench, topic: str, type_name: str, message: Any, time: int) -> Record:
    return Record(topic, type_name, bench.bag.serialise(message), time, bench.bag.definition(type_name))


def _make(bench: Bench, rng: random.Random, folder: Path) -> tuple[Recording, str]:
    """Write a recording of a random kind; return it and the kind."""
    kind = rng.choice(("file", "splits", "splits", "splits", "sqlite3", "zstd", "two"))
    if kind == "two":
        for name in ("first", "second"):
            _write_mcap(folder / f"{name}.mcap", _records(bench, rng), rng)
        return Recording(folder, {}, set(), refused=True), kind
    records = _records(bench, rng)
    if kind == "sqlite3":
        return _sqlite3(bench, folder, records, rng), kind
    parts = _split(records, rng.randrange(2, 13)) if kind != "file" else [records]
    pattern = rng.choice(("{0}_{1}.mcap", "{1}_{0}.mcap"))
    names = [pattern.format("walk", number) for number in range(len(parts))] if kind != "file" else ["walk.mcap"]
    for name, part in zip(names, parts):
        _write_mcap(folder / name, part, rng)
    made = Recording(folder if kind != "file" else folder / names[0], dict(zip(names, map(_data, parts))), set())
    if kind == "zstd":
        import zstandard

        for name in names:
            whole = (folder / name).read_bytes()
            (folder / f"{name}.zstd").write_bytes(zstandard.compress(whole))
            (folder / name).unlink()
        made.parts = {f"{name}.zstd": part for name, part in made.parts.items()}
    _metadata(folder, list(made.parts), kind, rng)
    if kind in ("file", "splits") and rng.random() < 0.5:
        _hurt(folder, made, rng)
    return made, kind


def _data(records: list[Record]) -> list[bytes]:
    return [record.data for record in records if record.topic == KEYPOINTS]


def _split(records: list[Record], count: int) -> list[list[Record]]:
    """Return the records in so many parts at most, none of them empty, in order of time."""
    size = -(-len(records) // count)
    return [records[at : at + size] for at in range(0, len(records), size)]


def _write_mcap(path: Path, records: list[Record], rng: random.Random) -> None:
    """Write one file: by time or topic by topic, with foreign channels now and then."""
    from mcap.writer import CompressionType, IndexType, Writer

    by_topic = rng.random() < 0.3
    ordered = sorted(records, key=lambda record: (record.topic, record.log_time)) if by_topic else list(records)
    index = IndexType.ALL if rng.random() < 0.8 else IndexType.NONE
    with open(path, "wb") as file:
        writer = Writer(
            file,
            chunk_size=rng.choice((500, 3000, 1 << 20)),
            compression=rng.choice(list(CompressionType)),
            index_types=index,
            use_chunking=rng.random() < 0.9,
        )
        writer.start(profile="ros2", library="fuzz")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        foreign = _foreign(writer, rng) if rng.random() < 0.4 else []
        for record in ordered:
            if record.topic not in channels:
                # Recorders that do not find a definition write an empty one.
                text = record.definition if rng.random() < 0.9 else ""
                schemas[record.topic] = writer.register_schema(record.type_name, "ros2msg", text.encode())
                channels[record.topic] = writer.register_channel(record.topic, "cdr", schemas[record.topic])
            if foreign and rng.random() < 0.5:
                writer.add_message(rng.choice(foreign), record.log_time, b'{"speed": 1}', record.log_time)
            writer.add_message(channels[record.topic], record.log_time, record.data, record.log_time)
        writer.finish()


def _foreign(writer: Any, rng: random.Random) -> list[int]:
    """Register channels that are not of ROS."""
    json = writer.register_schema("Speed", "jsonschema", b"{}")
    made = [
        writer.register_channel("/speed", "json", json),
        writer.register_channel("/blob", "protobuf", writer.register_schema("a.B", "protobuf", b"\x0a\x00")),
        writer.register_channel("/plain", "json", 0),
    ]
    return rng.sample(made, rng.randrange(1, 4))


def _metadata(folder: Path, names: list[str], kind: str, rng: random.Random) -> None:
    """Write metadata.yaml as rosbag2 does, or not at all, or half of it."""
    how = rng.choice(("none", "whole", "half", "empty"))
    if how == "none" or kind == "file":
        return
    information: dict[str, Any] = {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": names,
        "duration": {"nanoseconds": 0},
        "starting_time": {"nanoseconds_since_epoch": 0},
        "message_count": 0,
        "topics_with_message_count": [],
        "compression_format": "zstd" if kind == "zstd" else "",
        "compression_mode": "FILE" if kind == "zstd" else "",
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": information})
    (folder / "metadata.yaml").write_text({"whole": text, "half": text[: len(text) // 2], "empty": ""}[how])


def _hurt(folder: Path, made: Recording, rng: random.Random) -> None:
    """Cut, overwrite or remove one file; a file is removed only if the metadata still names it."""
    name = rng.choice(sorted(made.parts))
    path = folder / name
    data = bytearray(path.read_bytes())
    listed = (folder / "metadata.yaml").exists() and name in (folder / "metadata.yaml").read_text()
    how = rng.choice(("cut", "cut", "overwrite", "remove" if listed and len(made.parts) > 1 else "empty"))
    if how == "remove":
        path.unlink()
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "cut":
        path.write_bytes(data[: rng.randrange(len(data))])
    else:
        at = rng.randrange(8, len(data) - 8)
        data[at : at + rng.randrange(1, 60)] = rng.randbytes(rng.randrange(1, 60))
        path.write_bytes(data)
    made.hurt.add(name)


def _sqlite3(bench: Bench, folder: Path, records: list[Record], rng: random.Random) -> Recording:
    """Write a recording as ROS 2 Humble does by default."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    path = folder / "walk"
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=bench.bag._store)
            for topic, kind in {(record.topic, record.type_name) for record in records}
        }
        for record in records:
            writer.write(connections[record.topic], record.log_time, record.data)
    (name,) = (file.name for file in path.glob("*.db3"))
    return Recording(path, {name: _data(records)}, set())
