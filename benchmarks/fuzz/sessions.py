# SPDX-License-Identifier: Apache-2.0
"""Sessions: a few cases of one kind that share a stream or a file."""

from __future__ import annotations

import functools
import json
import random
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import foreign_messages as foreign
import numpy as np
import yaml

import msg_adapters
from benchmarks.fuzz.bench import Bench, model_file, sealed
from benchmarks.fuzz.breaking import break_array, break_bytes, break_fields, break_json, break_types
from benchmarks.fuzz.messages import BODIES, BUILDERS, camera_info, cloud, depth_image, header, random_pose
from benchmarks.fuzz.tally import Tally, WrongOutput, persons_in
from msg_adapters import MessageError
from msg_adapters.cdr import CloudReader
from paul_ros.errors import BagError, LayoutError, ModelError
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.offline.bag_reader import read_records
from paul_ros.offline.bag_topics import Topics
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.judge import evaluate
from paul_ros.offline.replay import replay
from paul_ros.stream.stream import LiftStream

# --- messages


def message_session(
    bench: Bench,
    rng: random.Random,
    tally: Tally,
    cases: int,
    where: str,
    spoil: Callable[[Any, random.Random], None],
    strict: bool,
) -> None:
    """Send messages of one type to one stream, with a camera or a depth image now and then.

    Args:
        bench: shared parts.
        rng: source of randomness.
        tally: counts.
        cases: number of cases.
        where: name of the session.
        spoil: breaks a message.
        strict: whether a drop as `internal_error` is a crash.
    """
    make = rng.choice((bench.live, bench.bag))
    type_name = rng.choice(sorted(BUILDERS))
    stream = bench.stream(rng)
    if rng.random() < 0.8:
        stream.camera_info(camera_info(make, rng))
    single, sent = type_name in msg_adapters.ONE_PERSON, 0
    for number in range(cases):
        kind = rng.choice(("keypoints",) * 8 + ("camera", "depth"))
        poses = [random_pose(rng) for _ in range(rng.choice((0, 1, 1, 2, 5)))]
        stamp = number // 3 if single else number
        if kind == "camera":
            msg = camera_info(make, rng)
        elif kind == "depth":
            msg = depth_image(make, rng, stamp)
        else:
            msg = BUILDERS[type_name](make, header(make, rng, stamp), poses, rng)
        spoil(msg, rng)
        before, start = drops(stream), time.process_time()
        try:
            if kind == "camera":
                stream.camera_info(msg)
            elif kind == "depth":
                stream.depth(msg)
            else:
                topic = BODIES.format(rng.choice("abc")) if type_name == foreign.HRI else ""
                answer = stream.keypoints(type_name, msg, topic)
                sent += 1
                publish(answer.frame, stream, bench, rng)
        except Exception:
            tally.crash(f"{where} {type_name} {kind}")
        _count_case(tally, stream, before, start, f"{where} {type_name} {kind}", strict)
    try:
        publish(stream.flush(), stream, bench, rng)
    except Exception:
        tally.crash(f"{where} {type_name} flush")
    _count_lost(stream, sent, single, tally, f"{where} {type_name}")


def drops(stream: LiftStream) -> Counter[str]:
    """Return a copy of the stream's drops: reason -> count."""
    return Counter(stream.ledger.drops)


def _count_case(tally: Tally, stream: LiftStream, before: Counter[str], start: float, where: str, strict: bool) -> None:
    """Count one case by its time and its drops."""
    tally.cases += 1
    tally.time(time.process_time() - start)
    new = drops(stream) - before
    if strict and new["internal_error"]:
        tally.crash(f"{where} internal_error {stream.ledger.advice['internal_error']}")
    tally.drops(new)


def publish(frame: Any, stream: LiftStream, bench: Bench, rng: random.Random) -> None:
    """Check a frame, and publish some as a node would: as objects and as bytes.

    Raises:
        WrongOutput: an output is not finite, or its two forms differ.
    """
    if frame is None:
        return
    _check_finite(frame)
    if rng.random() < 0.1:
        with stream.guard():
            packed = bench.packed.messages(frame)
            for output, message in bench.objects.messages(frame).items():
                data = bench.bag.serialise(message)
                if isinstance(packed[output], bytes) and bench.rewritten(message, packed[output]) != data:
                    raise WrongOutput(f"{output} differs between object and bytes")


def _check_finite(frame: Any) -> None:
    """Raise WrongOutput if a number of a lifted person is not finite."""
    ok = frame.lifted.ok
    arrays = {"points": frame.lifted.points, "root": frame.lifted.root, "attitudes": frame.attitudes}
    arrays["ambiguity"] = frame.lifted.ambiguity
    for name, values in arrays.items():
        if not np.isfinite(values[ok].astype(np.float32)).all():
            raise WrongOutput(f"{name} of a lifted person is not a finite float32")


def _count_lost(stream: LiftStream, sent: int, single: bool, tally: Tally, where: str) -> None:
    """Check that every message is a frame, a person of one, or a drop, and every person is lifted or a drop."""
    dropped, counts = drops(stream), stream.counts
    persons = persons_in(dropped)
    inputs = dropped["bad_intrinsics"] + dropped["depth_encoding"] + dropped["truncated_data"]
    messages = sum(dropped.values()) - persons
    if counts["lifted"] + persons != counts["persons"]:
        tally.lost(where, f"{counts['persons']} persons, {counts['lifted']} lifted, {persons} dropped")
    kept = counts["persons"] if single else counts["frames"]
    # Cameras and depth images have some of the same reasons; the count is exact only without these.
    if not sent <= kept + messages or (not inputs and not dropped["internal_error"] and kept + messages != sent):
        tally.lost(where, f"{sent} messages, {kept} kept, {messages} dropped: {dict(dropped)}")


fields_session = functools.partial(message_session, spoil=break_fields, strict=True)
junk_session = functools.partial(message_session, spoil=break_types, strict=False)


# --- serialised messages


def cdr_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Read serialised messages with one reader, as a subscription does: no message may influence the next."""
    reader, stream, make = CloudReader(), bench.stream(rng), bench.bag
    whole = []
    for number in range(3):
        message = cloud(make, header(make, rng, number), [random_pose(rng) for _ in range(number)], rng)
        whole.append(make.serialise(message))
    for _ in range(cases):
        data = rng.choice(whole) if rng.random() < 0.1 else break_bytes(rng.choice(whole), rng)
        start, before = time.process_time(), drops(stream)
        try:
            _check_like_rosbags(bench, data, reader)
            publish(stream.keypoints(foreign.CLOUD, data).frame, stream, bench, rng)
        except Exception:
            tally.crash(where)
        _count_case(tally, stream, before, start, where, strict=True)
    dropped = drops(stream)
    if stream.counts["frames"] + sum(dropped.values()) - persons_in(dropped) != cases:
        tally.lost(where, f"{cases} messages, {stream.counts['frames']} frames, {dict(dropped)}")


def _check_like_rosbags(bench: Bench, data: bytes, reader: CloudReader) -> None:
    """Raise WrongOutput if rosbags reads something else; messages that either refuses are not compared."""
    try:
        read = reader(data)
    except MessageError:
        return
    try:
        theirs: Any = bench.bag.deserialise(data, foreign.CLOUD)
    except Exception:
        return
    names = [(field.name, field.offset, field.datatype, field.count) for field in read.fields]
    ours, others = _cloud_values(read), _cloud_values(theirs)
    # Names of fields are not compared: rosbags strips final zeros, and keeps what follows a zero in the middle.
    if ours != others or len(names) != len(theirs.fields):
        raise WrongOutput(f"{ours[:6]} {names} is not what rosbags reads, {others[:6]}")


def _cloud_values(msg: Any) -> list[Any]:
    """Return sizes, stamp and data of a PointCloud2."""
    sizes = [getattr(msg, name) for name in ("height", "width", "point_step", "row_step")]
    return [*sizes, msg.header.stamp.sec, msg.header.stamp.nanosec, bytes(msg.data)]


# --- files


def bag_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Read and replay broken bags."""
    for _ in range(cases):
        tally.cases += 1
        start = time.process_time()
        path = bench.folder / "broken.mcap"
        if rng.random() < 0.2:
            _write_broken_messages(bench, rng, path)
        else:
            path.write_bytes(break_bytes(rng.choice(bench.whole_bags).read_bytes(), rng))
        try:
            read = sum(1 for _ in read_records(path))
        except BagError as error:
            read = error.messages_read
            tally.refuse(error, where)
        except Exception:
            tally.crash(f"{where} read")
            continue
        try:
            stream = bench.stream(rng)
            done = replay(path, stream, bench.folder / "out.mcap" if rng.random() < 0.1 else None, Topics())
            json.dumps(evaluate(done), allow_nan=False)
            tally.accepted += 1
            dropped, keypoints = drops(stream), _keypoint_messages(path)
            counted = stream.counts["frames"] + sum(dropped.values()) - persons_in(dropped)
            if done.damage is None and counted < keypoints:
                tally.lost(where, f"{keypoints} keypoint messages of {read}, {counted} counted")
        except (BagError, LayoutError) as error:
            tally.refused += 1
            tally.refuse(error, where)
        except Exception:
            tally.crash(f"{where} replay")
        tally.time(time.process_time() - start)


def _keypoint_messages(path: Path) -> int:
    """Return the number of keypoint messages before the bag's damage."""
    count = 0
    try:
        for _ in read_records(path, ["/keypoints"]):
            count += 1
    except BagError:
        pass
    return count


def _write_broken_messages(bench: Bench, rng: random.Random, path: Path) -> None:
    """Write an intact bag of broken messages."""
    with BagWriter(path, bench.bag, "none") as writer:
        for record in read_records(bench.whole_bags[0]):
            data = break_bytes(record.data, rng) if rng.random() < 0.3 else record.data
            writer.write_cdr(record.topic, record.type_name, data, record.log_time)


def _attempt(use: Callable[[], object], promised: type[Exception], tally: Tally, where: str) -> None:
    """Count one case: accepted, refused by the promised error, or a crash."""
    tally.cases += 1
    start = time.process_time()
    try:
        use()
        tally.accepted += 1
    except promised as error:
        tally.refused += 1
        tally.refuse(error, where)
    except Exception:
        tally.crash(where)
    tally.time(time.process_time() - start)


def model_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Load broken models, and lift with those that load."""
    path = bench.folder / "broken.npz"
    for _ in range(cases):
        path.write_bytes(_broken_model(bench, rng))
        _attempt(lambda: _lift_with(path), ModelError, tally, where)


def _lift_with(path: Path) -> None:
    """Load a model and lift two persons.

    Raises:
        WrongOutput: points are not finite.
    """
    model = load_model(path)
    xy = np.random.default_rng(0).normal(300, 80, (2, len(model.layout.names), 2))
    lifted = Lifter(model).lift(xy, np.ones(xy.shape[:2], bool))
    if not np.isfinite(lifted.points[lifted.ok]).all():
        raise WrongOutput("points of a lifted person are not finite")


def _broken_model(bench: Bench, rng: random.Random) -> bytes:
    """Return a model file with a broken header, a broken array or broken bytes, mostly under a correct checksum."""
    head, arrays = bench.tiny
    kind = rng.randrange(3)
    header_values = break_json(head, rng) if kind == 0 else head
    if kind == 1:
        arrays = {**arrays}
        name = rng.choice(sorted(arrays))
        arrays[name] = break_array(arrays[name], rng)
    data = model_file(header_values, arrays)
    if kind == 2:
        data = break_bytes(data, rng)
    if rng.random() < 0.1:  # the checksum too
        return break_bytes(sealed(data), rng)
    return sealed(data)


def layout_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Load broken layouts."""
    path, whole = bench.folder / "broken.yaml", load_layout("coco17").to_dict()
    text = yaml.safe_dump(whole).encode()
    for _ in range(cases):
        path.write_bytes(break_bytes(text, rng) if rng.random() < 0.5 else _broken_layout(whole, rng))
        _attempt(lambda: load_layout(path), LayoutError, tally, where)


def _broken_layout(whole: dict[str, Any], rng: random.Random) -> bytes:
    return yaml.safe_dump(break_json(whole, rng)).encode() if rng.random() < 0.9 else yaml.safe_dump(whole).encode()
