#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Everything that may come from outside, broken in every way at hand: does anything crash, is any frame lost uncounted?

    python benchmarks/fuzz.py [--cases 100000] [--seed 0] [--only KIND] [--json fuzz.json]

A case is one message, one serialised message, one bag or one model file, made whole and then broken in a few places:

- fields: messages of every type that is read, every field still of its own type: NaN, infinite, huge, negative, odd
  lengths, odd text. Here even a drop as `internal_error` is a crash.
- junk: the same with values of any type, None, nested rubbish and missing fields. No such message can come over DDS.
- cdr: PointCloud2 as bytes, for the reader of serialised messages; what it reads, rosbags must read alike.
- bags: bits flipped, bytes cut off, put in and exchanged, and sound bags of unsound messages; read and replayed.
- models: the file, or what is in it with a checksum that is right.
- layouts: the YAML as text, or the values in it.

A crash is an exception that the documentation of what was called does not promise, a warning of numpy's, or a number
of an output that is not finite. A frame is lost uncounted where a message that was handed in has neither become a frame
(or part of one) nor a drop. Sessions of a few cases share a stream; `--only KIND --session NUMBER` makes one again.
"""

from __future__ import annotations

import argparse
import array
import hashlib
import io
import json
import logging
import os
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

import foreign_messages as foreign
import numpy as np
import yaml

import msg_adapters
from msg_adapters import MessageError, outputs
from msg_adapters.cdr import CloudReader
from paul_ros.errors import BagError, LayoutError, ModelError
from paul_ros.files import write_atomically
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model, weight_shapes
from paul_ros.offline.bag import BagMessages, BagWriter, read_records
from paul_ros.offline.replay import Topics, evaluate, replay
from paul_ros.stream.messages import MessageBuilder
from paul_ros.stream.stream import LiftStream

SESSION = 25  # cases
BODIES = "/humans/bodies/{}/skeleton2d"
COCO = load_layout("coco17").names
#: Share of the cases of each kind.
KINDS = {"fields": 0.40, "junk": 0.15, "cdr": 0.32, "bags": 0.05, "models": 0.05, "layouts": 0.03}
#: Sequences whose length the message's definition fixes, by (name of the field, length).
FIXED = {("skeleton", 18), ("keypoints", 70), ("kp", 2), ("k", 9), ("r", 9), ("p", 12)}
FLOATS = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-9, 1e6, 1.0001e6, -1e30, 1e38, 1.7e308)
INTEGERS = (0, 1, -1, 2, 7, 17, 18, 127, 255, 65535, 2**31 - 1, -(2**31), 2**32 - 1)
TEXTS = ("", "x", "body_kps", "nose", "16UC1", "32FC1", "-1", "ä\u2028\0\n", "7" * 400, "/", "{}", "%s")


def jazzy():
    """rosbags' own store, with the types of the foreign packages."""
    return BagMessages(foreign.DEFINITIONS)


class Make(foreign.LiveMake):
    """Attributes as rclpy's messages have them."""

    @staticmethod
    def octets(data: bytes) -> array.array:
        return array.array("B", data)


class BagMake(BagMessages):
    """Dataclasses as bags give them."""

    @staticmethod
    def floats(values) -> np.ndarray:
        return np.array(values, np.float32)


# --- whole messages


def pose(rng: random.Random) -> dict:
    """A person somewhere in the image, roughly upright."""
    x, y, size = rng.uniform(50, 590), rng.uniform(50, 400), rng.uniform(30, 300)
    heights = {"nose": 0, "eye": -0.02, "ear": 0, "shoulder": 0.15, "elbow": 0.35, "wrist": 0.5, "hip": 0.5}
    heights |= {"knee": 0.75, "ankle": 1.0, "neck": 0.13, "pelvis": 0.5, "toe": 1.03, "heel": 1.02}
    places = {}
    for name in {*COCO, "neck", "pelvis", *foreign.BODY25}:
        side = 0.1 if name.startswith("left") else -0.1 if name.startswith("right") else 0.0
        places[name] = (x + size * (side + rng.uniform(-0.03, 0.03)), y + size * (heights[name.split("_")[-1]]))
    return places


def header(make, rng: random.Random, seconds: int):
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rng.randrange(10**9))
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")


def cloud(make, head, poses, rng):
    xy = np.array([[p[name] for name in COCO] for p in poses], float).reshape(-1, len(COCO), 2)
    ids = [str(number) for number in range(len(poses))]
    return outputs.keypoints_cloud(make, head, xy, np.full(xy.shape[:2], 0.9), ids)


def flat(make, head, poses, rng):
    def place(x: float, y: float):
        turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        point = make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.9)
        return make("geometry_msgs/msg/Pose", position=point, orientation=turn)

    return make(foreign.POSES, header=head, poses=[place(*p[name]) for p in poses for name in COCO])


def yolo(make, head, poses, rng):
    def keypoint(number: int, x: float, y: float):
        point = make("yolo_msgs/msg/Point2D", x=float(x), y=float(y))
        return make("yolo_msgs/msg/KeyPoint2D", id=number, point=point, score=0.9)

    detections = []
    for ident, p in enumerate(poses):
        data = [keypoint(index, *p[name]) for index, name in enumerate(COCO, 1) if rng.random() < 0.9]
        keypoints = make("yolo_msgs/msg/KeyPoint2DArray", data=data)
        named = dict(class_id=0, class_name="person", score=0.9, id=str(ident))
        detections.append(make("yolo_msgs/msg/Detection", keypoints=keypoints, **named))
    return make(foreign.YOLO, header=head, detections=detections)


def ai(make, head, poses, rng):
    targets = [
        foreign.ai_target(make, ident, body_kps=([p[name] for name in COCO], [0.9] * rng.choice((0, len(COCO)))))
        for ident, p in enumerate(poses)
    ]
    return foreign.ai(make, head, targets)


def openpose(build, order):
    return lambda make, head, poses, rng: build(make, head, [foreign.openpose_rows(p, order) for p in poses])


BUILDERS: dict[str, Callable] = {
    foreign.CLOUD: cloud,
    foreign.POSES: flat,
    foreign.YOLO: yolo,
    foreign.HRI: lambda make, head, poses, rng: foreign.hri(make, head, poses[0] if poses else {}),
    foreign.ZED: lambda make, head, poses, rng: foreign.zed(make, head, poses, rng.randrange(3)),
    foreign.AI: ai,
    foreign.OPENDR: lambda make, head, poses, rng: foreign.opendr(make, head, poses[0] if poses else {}),
    foreign.OPENPOSE_LIST: openpose(foreign.openpose_list, foreign.OPENPOSE18),
    foreign.OPENPOSE_FRAME: openpose(foreign.openpose_frame, foreign.BODY25),
}


def camera(make, rng: random.Random):
    region = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    fx = rng.choice((600.0, 1200.0))
    numbers = dict(k=[fx, 0.0, 320.0, 0.0, fx, 240.0, 0.0, 0.0, 1.0], r=[0.0] * 9, p=[0.0] * 12, d=[0.0] * 5)
    arrays = {name: np.array(values) for name, values in numbers.items()}
    size = dict(height=480, width=640, distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=region)
    return make("sensor_msgs/msg/CameraInfo", header=header(make, rng, 1), **size, **arrays)


def depth(make, rng: random.Random, seconds: int):
    values = np.full((48, 64), 3000, "<u2")
    size = dict(height=48, width=64, encoding="16UC1", is_bigendian=0, step=128, data=make.octets(values.tobytes()))
    return make("sensor_msgs/msg/Image", header=header(make, rng, seconds), **size)


# --- breaking them


def slots(thing, found: list | None = None, name: str = "") -> list:
    """Every place of a message that a value can be put: (holder, key, name of the field)."""
    found = [] if found is None else found
    if isinstance(thing, list):
        for index, value in enumerate(thing):
            found.append((thing, index, name))
            slots(value, found, name)
    elif hasattr(thing, "__dict__"):
        for key, value in vars(thing).items():
            if key != "__msgtype__":
                found.append((thing, key, key))
                slots(value, found, key)
    return found


def put(holder, key, value) -> None:
    if isinstance(holder, list):
        holder[key] = value
    else:
        object.__setattr__(holder, key, value)


def get(holder, key):
    return holder[key] if isinstance(holder, list) else getattr(holder, key)


def break_fields(msg, rng: random.Random) -> None:
    """Other values of the same type."""
    places = slots(msg)
    for _ in range(rng.choice((0, 1, 1, 2, 5, 40))):
        holder, key, name = rng.choice(places)
        if not isinstance(holder, list) or key < len(holder):
            put(holder, key, other(get(holder, key), name, rng))


def other(value, name: str, rng: random.Random):
    """A value of the same type and, where the definition fixes it, of the same length."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, np.integer)):
        return abs(rng.choice(INTEGERS)) if name in UNSIGNED else rng.choice(INTEGERS[:-1])
    if isinstance(value, (float, np.floating)):
        return rng.choice((*FLOATS, rng.uniform(-1e4, 1e4)))
    if isinstance(value, str):
        return rng.choice(TEXTS)
    if isinstance(value, (np.ndarray, array.array)):
        return other_numbers(value, name, rng)
    if isinstance(value, list) and (name, len(value)) not in FIXED:
        return other_list(value, rng)
    return value


#: Fields of unsigned integers in the messages' definitions.
UNSIGNED = {"nanosec", "height", "width", "offset", "count", "point_step", "row_step", "track_id", "step", "datatype"}


def other_list(values: list, rng: random.Random) -> list:
    short = rng.randrange(len(values) + 1)
    return rng.choice((values[:short], values[short:], values * 2, [], values[::-1], values[:1] * rng.randrange(200)))


def other_numbers(values, name: str, rng: random.Random):
    numbers = np.array(values)
    if numbers.size:
        for _ in range(rng.choice((1, 3, numbers.size))):
            index = rng.randrange(numbers.size)
            byte = numbers.dtype.kind == "u"
            numbers.flat[index] = rng.randrange(256) if byte else np.float32(rng.choice(FLOATS[:-1]))
    if (name, numbers.size) not in FIXED and rng.random() < 0.5:
        numbers = np.resize(numbers, rng.randrange(2 * numbers.size + 2))
    return array.array(values.typecode, numbers.tolist()) if isinstance(values, array.array) else numbers


def break_types(msg, rng: random.Random) -> None:
    """Values that no message can have."""
    places = slots(msg)
    for _ in range(rng.choice((1, 1, 2, 4))):
        holder, key, _ = rng.choice(places)
        if isinstance(holder, list) and key >= len(holder):
            continue
        if rng.random() < 0.1 and not isinstance(holder, list) and key in vars(holder):
            delattr(holder, key)
        else:
            put(holder, key, junk(rng))


def junk(rng: random.Random):
    nested = [[None, [{}]], "x"]
    plain = (None, "text", b"bytes", 3, -1, 1.5, np.nan, True, 10**400, 1j, [], {}, (), object(), object, nested)
    return rng.choice((*plain, [None] * 17, np.zeros((2, 3)), np.array(["a"]), np.array(None), Make()("x/msg/Y")))


def break_bytes(data: bytes, rng: random.Random) -> bytes:
    """Flipped bits, cut, put in, exchanged, overwritten."""
    data = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(6)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = rng.randbytes(rng.choice((1, 4, 64)))
        elif kind == 3:
            del data[at : at + rng.choice((1, 4, 8, 100))]
        elif kind == 4 and len(data) >= 8:
            at = rng.randrange(len(data) - 7)
            values = (b"\0" * 8, b"\xff" * 8, b"\xff\xff\xff\x7f" * 2, rng.randbytes(8))
            data[at : at + 8] = rng.choice(values)[: rng.choice((1, 4, 8))].ljust(8, b"\0")
        else:
            start, size = rng.randrange(len(data) + 1), rng.randrange(200)
            data[at : at + size] = data[start : start + size]
    return bytes(data) if rng.random() < 0.97 else rng.randbytes(rng.randrange(300))


# --- judging


@dataclass
class Tally:
    """What came of the cases of one kind."""

    cases: int = 0
    accepted: int = 0  # became a frame or part of one, or were read
    refused: int = 0  # counted drops, or an error that is promised
    crashes: int = 0
    uncounted: int = 0
    slowest_ms: float = 0.0  # of this process
    reasons: Counter = field(default_factory=Counter)
    failures: list = field(default_factory=list)

    def crash(self, where: str) -> None:
        """Counts the exception that is being handled, or what `where` says."""
        self.crashes += 1
        self._keep(f"{where}: {traceback.format_exc(limit=-3)}")

    def lost(self, where: str, text: str) -> None:
        self.uncounted += 1
        self._keep(f"{where}: {text}")

    def _keep(self, text: str) -> None:
        if len(self.failures) < 20:
            self.failures.append(text)


class Wrong(Exception):
    """An answer that cannot be right."""


class Bench:
    """The models and makers that all cases share, and a folder for files."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.model = load_model()
        self.live, self.bag = Make(), BagMake(foreign.DEFINITIONS)
        self.tiny = tiny_model(folder)
        self.whole_bags = [tiny_bag(folder / f"{name}.mcap", self.bag, name) for name in ("none", "lz4", "zstd")]

        # As in a node, one of each for all frames.
        self.objects, self.packed = MessageBuilder(self.bag), MessageBuilder(self.bag, packed=True)

    def again(self, message, data: bytes) -> bytes:
        """Bytes of a message of the same type, read and written anew: padding may be anything."""
        return self.bag.serialise(self.bag._store.deserialize_cdr(data, message.__msgtype__))

    def stream(self, rng: random.Random) -> LiftStream:
        layout = rng.choice((None, None, "coco17", "body25", "h36m17"))
        output = rng.choice((None, None, self.model.layout))
        smoothing = rng.choice((0.0, 0.0, 1.0))
        lifter = Lifter(self.model)
        return LiftStream(lifter, load_layout(layout) if layout else None, 0.3, 64, output, smoothing)


def tiny_model(folder: Path) -> tuple[dict, dict]:
    """Header and arrays of a small model, to be broken."""
    layout = load_layout("coco17")
    sizes = {"encoder": {"kind": "residual", "width": 4, "blocks": 1}, "decoder": {"kind": "mlp", "hidden": [4]}}
    plain = {"format": 1, "layout": layout.to_dict(), "bottleneck": 2, "metres_per_unit": 0.3, "stature": 1.7}
    head = {**plain, "misfit": 0.05, "chirality": {"known": True, "source": "made"}, "architecture": sizes}
    numbers = np.random.default_rng(0)
    shapes = weight_shapes(head, len(layout.names))
    return head, {name: numbers.normal(size=size).astype(np.float32) for name, size in shapes.items()}


def tiny_bag(path: Path, make: BagMake, compression: str) -> Path:
    rng = random.Random(1)
    with BagWriter(path, make, compression) as writer:
        writer.write("/camera_info", camera(make, rng), 0)
        for number in range(1, 6):
            head = header(make, rng, number)
            writer.write("/keypoints", cloud(make, head, [pose(rng)], rng), number)
            writer.write("/depth", depth(make, rng, number), number)
            writer.write("/ground_truth/poses", flat(make, head, [pose(rng)], rng), number)
    return path


def finite(frame) -> None:
    """Raises Wrong where an output has a number that is none."""
    ok = frame.lifted.ok
    arrays = {"points": frame.lifted.points, "root": frame.lifted.root, "attitudes": frame.attitudes}
    arrays["ambiguity"] = frame.lifted.ambiguity
    for name, values in arrays.items():
        if not np.isfinite(values[ok].astype(np.float32)).all():
            raise Wrong(f"{name} of a lifted person is no finite float32")


# --- kinds


def message_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str, spoil: Callable) -> None:
    """Messages of one type into one stream, with cameras and depth images now and then."""
    make = rng.choice((bench.live, bench.bag))
    type_name = rng.choice(sorted(BUILDERS))
    stream = bench.stream(rng)
    strict = spoil is break_fields
    if rng.random() < 0.8:
        stream.camera_info(camera(make, rng))
    single, sent = type_name in msg_adapters.ONE_PERSON, 0
    for number in range(cases):
        kind = rng.choice(("keypoints",) * 8 + ("camera", "depth"))
        poses = [pose(rng) for _ in range(rng.choice((0, 1, 1, 2, 5)))]
        stamp = number // 3 if single else number
        if kind == "camera":
            msg = camera(make, rng)
        elif kind == "depth":
            msg = depth(make, rng, stamp)
        else:
            msg = BUILDERS[type_name](make, header(make, rng, stamp), poses, rng)
        spoil(msg, rng)
        before = Counter(stream.ledger.drops)
        start = time.process_time()
        try:
            if kind == "camera":
                stream.camera_info(msg)
            elif kind == "depth":
                stream.depth(msg)
            else:
                topic = BODIES.format(rng.choice("abc")) if type_name == foreign.HRI else ""
                answer = stream.keypoints(type_name, msg, topic)
                sent += 1
                use(answer.frame, stream, bench, rng)
        except Exception:
            tally.crash(f"{where} {type_name} {kind}")
        tally.cases += 1
        tally.slowest_ms = max(tally.slowest_ms, 1000 * (time.process_time() - start))
        new = Counter(stream.ledger.drops) - before
        tally.reasons += new
        if strict and new["internal_error"]:
            tally.crash(f"{where} {type_name} {kind} internal_error {stream.ledger.advice['internal_error']}")
        dropped = sum(new.values()) - persons_in(new)
        tally.refused += dropped > 0
        tally.accepted += not dropped
    try:
        use(stream.flush(), stream, bench, rng)
    except Exception:
        tally.crash(f"{where} {type_name} flush")
    count_lost(stream, sent, single, tally, f"{where} {type_name}")


def persons_in(drops: Counter) -> int:
    """Drops are of messages or of persons; so many are of persons."""
    return sum(count for reason, count in drops.items() if reason.startswith("person_"))


def use(frame, stream: LiftStream, bench: Bench, rng: random.Random) -> None:
    """As a node would: some frames are published, as objects and as bytes; all must be finite."""
    if frame is None:
        return
    finite(frame)
    if rng.random() < 0.1:
        with stream.guard():
            packed = bench.packed.messages(frame)
            for output, message in bench.objects.messages(frame).items():
                data = bench.bag.serialise(message)
                if isinstance(packed[output], bytes) and bench.again(message, packed[output]) != data:
                    raise Wrong(f"{output} is another as bytes")


def count_lost(stream: LiftStream, sent: int, single: bool, tally: Tally, where: str) -> None:
    """Every message is a frame, a person of one, or a drop; every person of a frame is lifted or a drop."""
    persons = persons_in(stream.ledger.drops)
    inputs = (
        stream.ledger.drops["bad_intrinsics"]
        + stream.ledger.drops["depth_encoding"]
        + stream.ledger.drops["truncated_data"]
    )
    counts, messages = stream.counts, sum(stream.ledger.drops.values()) - persons
    if counts["lifted"] + persons != counts["persons"]:
        tally.lost(where, f"{counts['persons']} persons, {counts['lifted']} lifted, {persons} dropped")
    kept = counts["persons"] if single else counts["frames"]
    # Cameras and depth images share the reasons; the bound is exact where none was dropped.
    if not sent <= kept + messages or (
        not inputs and not stream.ledger.drops["internal_error"] and kept + messages != sent
    ):
        tally.lost(where, f"{sent} messages, {kept} kept, {messages} dropped: {dict(stream.ledger.drops)}")


def fields_session(bench, rng, tally, cases, where):
    message_session(bench, rng, tally, cases, where, break_fields)


def junk_session(bench, rng, tally, cases, where):
    message_session(bench, rng, tally, cases, where, break_types)


def cdr_session(bench, rng, tally, cases, where):
    """One reader for all, as in a subscription; its memory of the last message must not leak into the next."""
    reader, stream, make = CloudReader(), bench.stream(rng), bench.bag
    whole = []
    for number in range(3):
        message = cloud(make, header(make, rng, number), [pose(rng) for _ in range(number)], rng)
        whole.append(make.serialise(message))
    for _ in range(cases):
        data = rng.choice(whole) if rng.random() < 0.1 else break_bytes(rng.choice(whole), rng)
        tally.cases += 1
        start, before = time.process_time(), Counter(stream.ledger.drops)
        try:
            same_as_rosbags(bench, data, reader)
            use(stream.keypoints(foreign.CLOUD, data).frame, stream, bench, rng)
        except Exception:
            tally.crash(where)
        tally.slowest_ms = max(tally.slowest_ms, 1000 * (time.process_time() - start))
        new = Counter(stream.ledger.drops) - before
        tally.reasons += new
        if new["internal_error"]:
            tally.crash(f"{where} internal_error {stream.ledger.advice['internal_error']}")
        dropped = sum(new.values()) - persons_in(new)
        tally.refused += dropped > 0
        tally.accepted += not dropped
    persons = persons_in(stream.ledger.drops)
    if stream.counts["frames"] + sum(stream.ledger.drops.values()) - persons != cases:
        tally.lost(where, f"{cases} messages, {stream.counts['frames']} frames, {dict(stream.ledger.drops)}")


def same_as_rosbags(bench: Bench, data: bytes, reader: CloudReader) -> None:
    """Raises Wrong where rosbags reads something else; where either refuses there is nothing to compare."""
    try:
        read = reader(data)
    except MessageError:
        return
    try:
        theirs = bench.bag._store.deserialize_cdr(data, foreign.CLOUD)
    except Exception:
        return
    plain = ("height", "width", "point_step", "row_step")
    mine = [getattr(read, name) for name in plain] + [
        read.header.stamp.sec,
        read.header.stamp.nanosec,
        bytes(read.data),
    ]
    stamp = theirs.header.stamp
    others = [getattr(theirs, name) for name in plain] + [stamp.sec, stamp.nanosec, theirs.data.tobytes()]
    names = [(f.name, f.offset, f.datatype, f.count) for f in read.fields]
    # rosbags leaves the final zeros away one by one, and keeps what follows one in the middle.
    if mine != others or len(names) != len(theirs.fields):
        raise Wrong(f"{mine[:6]} {names} is not what rosbags reads, {others[:6]}")


def bag_session(bench, rng, tally, cases, where):
    for _ in range(cases):
        tally.cases += 1
        start = time.process_time()
        path = bench.folder / "broken.mcap"
        if rng.random() < 0.2:
            sound_bag_of_unsound_messages(bench, rng, path)
        else:
            path.write_bytes(break_bytes(rng.choice(bench.whole_bags).read_bytes(), rng))
        try:
            read = sum(1 for _ in read_records(path))
        except BagError as error:
            read = error.messages_read
            one_line(error, tally, where)
        except Exception:
            tally.crash(f"{where} read")
            continue
        try:
            stream = bench.stream(rng)
            done = replay(path, stream, bench.folder / "out.mcap" if rng.random() < 0.1 else None, Topics())
            json.dumps(evaluate(done), allow_nan=False)
            tally.accepted += 1
            persons = persons_in(stream.ledger.drops)
            keypoints = sum(matches_keypoints(path))
            counted = stream.counts["frames"] + sum(stream.ledger.drops.values()) - persons
            if done.damage is None and counted < keypoints:
                tally.lost(where, f"{keypoints} keypoint messages of {read}, {counted} counted")
        except (BagError, LayoutError) as error:
            tally.refused += 1
            one_line(error, tally, where)
        except Exception:
            tally.crash(f"{where} replay")
        tally.slowest_ms = max(tally.slowest_ms, 1000 * (time.process_time() - start))


def matches_keypoints(path: Path):
    try:
        for record in read_records(path, ["/keypoints"]):
            yield 1
    except BagError:
        return


def one_line(error: Exception, tally: Tally, where: str) -> None:
    tally.reasons[type(error).__name__] += 1
    if not str(error) or "\n" in str(error):
        tally.lost(where, f"the error is not one line: {error!r}")


def sound_bag_of_unsound_messages(bench: Bench, rng: random.Random, path: Path) -> None:
    """Every checksum is right; the messages are not."""
    with BagWriter(path, bench.bag, "none") as writer:
        for record in read_records(bench.whole_bags[0]):
            data = break_bytes(record.data, rng) if rng.random() < 0.3 else record.data
            writer.write_cdr(record.topic, record.type_name, data, record.log_time)


def model_session(bench, rng, tally, cases, where):
    path = bench.folder / "broken.npz"
    for _ in range(cases):
        path.write_bytes(broken_model(bench, rng))
        attempt(lambda: lift_with(path), ModelError, tally, where)


def attempt(use: Callable[[], object], promised: type[Exception], tally: Tally, where: str) -> None:
    """One case: accepted, refused by the error that is promised, or a crash."""
    tally.cases += 1
    start = time.process_time()
    try:
        use()
        tally.accepted += 1
    except promised as error:
        tally.refused += 1
        one_line(error, tally, where)
    except Exception:
        tally.crash(where)
    tally.slowest_ms = max(tally.slowest_ms, 1000 * (time.process_time() - start))


def lift_with(path: Path) -> None:
    model = load_model(path)
    xy = np.random.default_rng(0).normal(300, 80, (2, len(model.layout.names), 2))
    lifted = Lifter(model).lift(xy, np.ones(xy.shape[:2], bool))
    if not np.isfinite(lifted.points[lifted.ok]).all():
        raise Wrong("points of a lifted person are not finite")


def broken_model(bench: Bench, rng: random.Random) -> bytes:
    head, arrays = bench.tiny
    kind = rng.randrange(3)
    text = json.dumps(broken_json(head, rng) if kind == 0 else head).encode()
    if kind == 1:
        arrays = {**arrays}
        name = rng.choice(sorted(arrays))
        arrays[name] = broken_array(arrays[name], rng)
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(text, np.uint8), **arrays)
    data = buffer.getvalue()
    if kind == 2:
        data = break_bytes(data, rng)
    if rng.random() < 0.1:  # the checksum too
        return break_bytes(sealed(data), rng)
    return sealed(data)


def sealed(data: bytes) -> bytes:
    """With the zip comment that makes it a model: room for it, then the checksum of all before it."""
    data = data[:-2] + (64).to_bytes(2, "little") if data[-22:-18] == b"PK\5\6" else data
    return data + hashlib.sha256(data).hexdigest().encode()


def layout_session(bench, rng, tally, cases, where):
    path, whole = bench.folder / "broken.yaml", load_layout("coco17").to_dict()
    text = yaml.safe_dump(whole).encode()
    for _ in range(cases):
        path.write_bytes(break_bytes(text, rng) if rng.random() < 0.5 else broken_layout(whole, rng))
        attempt(lambda: load_layout(path), LayoutError, tally, where)


def broken_layout(whole: dict, rng: random.Random) -> bytes:
    return yaml.safe_dump(broken_json(whole, rng)).encode() if rng.random() < 0.9 else yaml.safe_dump(whole).encode()


def broken_array(values: np.ndarray, rng: random.Random):
    flat = values.copy()
    flat.flat[rng.randrange(flat.size)] = np.float32(rng.choice(FLOATS[:-1]))
    shapes = (values.T, values[:0], values[None], values.ravel(), np.float32(1))
    kinds = (values.astype(np.float64), values.astype(int), values.astype(complex), values.astype("S4"))
    return rng.choice((flat, flat, flat, values * np.float32(1e5), *shapes, *kinds))


def broken_json(head: dict, rng: random.Random):
    head = json.loads(json.dumps(head))
    for _ in range(rng.choice((1, 1, 2, 5))):
        places = json_places(head)
        holder, key = rng.choice(places)
        if rng.random() < 0.2:
            del holder[key]
        elif rng.random() < 0.1 and isinstance(holder, dict):
            holder[rng.choice(("upright", "scale", "image_unit", "x", ""))] = json_junk(rng)
        else:
            holder[key] = json_junk(rng)
    return head if rng.random() < 0.97 else json_junk(rng)


def json_places(thing, found: list | None = None) -> list:
    found = [] if found is None else found
    items = thing.items() if isinstance(thing, dict) else enumerate(thing) if isinstance(thing, list) else ()
    for key, value in items:
        found.append((thing, key))
        json_places(value, found)
    return found


def json_junk(rng: random.Random):
    nested: object = []
    for _ in range(rng.choice((1, 200))):
        nested = [nested]
    numbers = (0, 1, -1, 3, 17, 2**14, 2**14 + 1, 2**40, 10**300, 0.5, 1e-300, float("nan"), float("inf"))
    return rng.choice((*numbers, None, True, False, "", "nose", "left_hip", "residual", {}, [], nested, {"a": [1]}))


SESSIONS = {
    "fields": fields_session,
    "junk": junk_session,
    "cdr": cdr_session,
    "bags": bag_session,
    "models": model_session,
    "layouts": layout_session,
}


def session(bench: Bench, kind: str, number: int, tally: Tally, seed: int = 0, cases: int = SESSION) -> None:
    """One session; the same number and seed make the same cases."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # numpy's would be lines in a robot's log that nobody understands
        SESSIONS[kind](bench, random.Random(f"{seed} {kind} {number}"), tally, cases, f"{kind} {number}")


def fuzz(cases: int, seed: int = 0, kinds=tuple(KINDS), tick: Callable[[int], None] = lambda done: None) -> dict:
    """The report over so many cases."""
    logging.getLogger("paul_ros.stream.stream").setLevel(logging.CRITICAL)  # a traceback for every first internal error
    share = sum(KINDS[kind] for kind in kinds)
    tallies = {kind: Tally() for kind in kinds}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for kind, tally in tallies.items():
            for number in range(max(1, round(cases * KINDS[kind] / share / SESSION))):
                session(bench, kind, number, tally, seed)
                tick(SESSION)
    total = {
        name: sum(getattr(tally, name) for tally in tallies.values()) for name in ("cases", "crashes", "uncounted")
    }
    return {
        **total,
        "seed": seed,
        "seconds": time.perf_counter() - start,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "kinds": {
            kind: {**vars(tally), "reasons": dict(tally.reasons.most_common())} for kind, tally in tallies.items()
        },
    }


def table(report: dict) -> str:
    """The report for people."""
    head = f"{'kind':8}{'cases':>9}{'accepted':>10}{'refused':>9}{'crashes':>9}{'lost uncounted':>16}{'slowest ms':>12}"
    lines = [head]
    for kind, row in report["kinds"].items():
        lines.append(
            f"{kind:8}{row['cases']:9}{row['accepted']:10}{row['refused']:9}{row['crashes']:9}{row['uncounted']:16}"
            f"{row['slowest_ms']:12.1f}"
        )
    lines.append(
        f"{report['cases']} cases, {report['crashes']} crashes, {report['uncounted']} frames lost uncounted; "
        f"{report['seconds']:.0f} s, {report['peak_rss_mb']:.0f} MB at most"
    )
    return "\n".join([*(text for row in report["kinds"].values() for text in row["failures"]), *lines])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=KINDS, help="one kind")
    parser.add_argument("--session", type=int, help="of that kind, with --only")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.session is not None:
        tally = Tally()
        with tempfile.TemporaryDirectory() as folder:
            session(Bench(Path(folder)), arguments.only, arguments.session, tally, arguments.seed)
        print(*tally.failures, sep="\n")
        return bool(tally.failures)
    report = fuzz(arguments.cases, arguments.seed, (arguments.only,) if arguments.only else tuple(KINDS))
    print(table(report))
    if arguments.json:
        write_atomically(arguments.json, json.dumps(report, indent=1).encode())
    return bool(report["crashes"] or report["uncounted"])


if __name__ == "__main__":
    sys.exit(main())
