# SPDX-License-Identifier: Apache-2.0
"""Sessions of images whose persons have odd ids, and whose headers lack stamps or frames.

An oracle of its own knows the images, and so which persons belong together, whose id is theirs alone, and which number
and stamp each must have.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import foreign_messages as foreign
import numpy as np

import msg_adapters
from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.messages import BODIES, BUILDERS, COCO, Pose, camera_info, random_pose
from benchmarks.fuzz.tally import Tally, WrongOutput
from msg_adapters import outputs
from paul_ros.lifter import Lifter
from paul_ros.stream.stream import LiftStream

_MS = 10**6  # ns
_TRUSTED_AFTER = 500 * _MS
_OWN_NUMBERS = 2**23
_NUMBERS = ("0", "1", "2", "7", "8388607", "16777216")
_TEXTS = (*_NUMBERS, "8388608", "07", "-1", "", "kjsdf", "abcde", "None", "\u0667", "a b", "9" * 40, "x" * 3000)
_BODIES = ("kjsdf", "abcde", "anna", "b2")

#: Type -> the ids that its messages may have.
_POOLS: dict[str, tuple[str, ...]] = {
    foreign.CLOUD: (*_NUMBERS, ""),
    foreign.YOLO: _TEXTS,
    foreign.AI: (*_NUMBERS, "18446744073709551615"),
    foreign.ZED: ("0", "1", "2", "32767", "-1"),
    foreign.OPENDR: (*_NUMBERS, "-1", "2147483647"),
    foreign.HRI: _BODIES,
}


@dataclass
class _Image:
    """An image as it was sent: ids of its persons, expected stamp (ns) and frame."""

    ids: tuple[str, ...]
    stamp: int
    frame_id: str


@dataclass
class _Oracle:
    """Knowledge of ids so far: stamps at which they were shared, and the numbers that stand for them."""

    shared: dict[str, int] = field(default_factory=dict)
    numbers: dict[str, int] = field(default_factory=dict)

    def check(self, image: _Image, frame: Any) -> None:
        """Raise WrongOutput if a frame is not what its image must become."""
        found, number_of = frame.keypoints.ids, frame.person_numbers.tolist()
        stamp = frame.header.stamp.sec * 10**9 + frame.header.stamp.nanosec
        if (frame.keypoints.stamp, stamp, frame.header.frame_id) != (image.stamp, image.stamp, image.frame_id):
            raise WrongOutput(f"stamp {stamp} and frame {frame.header.frame_id!r} of {image}")
        if found != self.expected(image):
            raise WrongOutput(f"ids {found} of {image}, expected {self.expected(image)}")
        for name, number in zip(found, number_of, strict=True):
            own = name.isascii() and name.isdigit() and str(int(name[:30])) == name and int(name[:30]) < _OWN_NUMBERS
            known = -1 if name == "" else int(name) if own else self.numbers.setdefault(name, int(number))
            if number != known or (name and not own and number < _OWN_NUMBERS):
                raise WrongOutput(f"number {number} of {name[:20]!r}")
        if len(set(self.numbers.values())) < len(self.numbers):
            raise WrongOutput(f"one number for two texts: {self.numbers}")

    def expected(self, image: _Image) -> tuple[str, ...]:
        """Return the ids that a frame must have."""
        count = Counter(image.ids)
        return tuple(
            "" if name.startswith("-") or count[name] > 1 or name in self.shared else name for name in image.ids
        )

    def learn(self, image: _Image) -> None:
        """Trust ids again that were shared long ago, or in this image's future; learn those that are shared now."""
        count = Counter(image.ids)
        recent = {name: stamp for name, stamp in self.shared.items() if 0 < image.stamp - stamp <= _TRUSTED_AFTER}
        self.shared = recent | {name: image.stamp for name in image.ids if name and count[name] > 1}


def ids_session(bench: Bench, rng: random.Random, tally: Tally, cases: int, where: str) -> None:
    """Send images of one type to one stream; a case is an image."""
    make, type_name = rng.choice((bench.live, bench.bag)), rng.choice(sorted(_POOLS))
    stream = LiftStream(Lifter(bench.model), None, 0.3, 64, smoothing=rng.choice((0.0, 1.0)))
    with_camera = rng.random() < 0.8 or type_name == foreign.HRI
    # Persons of whom a lens shows nothing could not be told apart.
    while with_camera and (stream.intrinsics is None or stream.intrinsics.distortion):
        stream.camera_info(camera_info(make, rng))
    oracle, waiting = _Oracle(), list[_Image]()
    now = 1_700_000_000 * 10**9
    lacks_stamp, lacks_frame = rng.random() < 0.3, rng.random() < 0.3
    sent = repeated = 0
    for _ in range(cases):
        tally.cases += 1
        began = time.process_time()
        now += rng.choice((33, 33, 33, 100, 600, -2000)) * _MS
        head, stamp = _header(make, rng, now, lacks_stamp)
        # ZED's own frame is not the optical one.
        frame_id = "camera" if with_camera or not (lacks_frame or type_name == foreign.ZED) else ""
        head.frame_id = "" if lacks_frame else head.frame_id
        ids = _ids(type_name, rng)
        waiting.append(_Image(ids, stamp, frame_id))
        try:
            for topic, msg, again, later in _messages(type_name, make, head, ids, rng):
                sent, repeated = sent + 1, repeated + again
                _check(stream.keypoints(type_name, msg, topic, now + later).frame, waiting, oracle, bench)
            tally.accepted += 1
            now += later
        except Exception:
            tally.crash(f"{where} {type_name}")
            return
        tally.time(time.process_time() - began)
    try:
        _check(stream.flush(), waiting, oracle, bench)
    except Exception:
        tally.crash(f"{where} {type_name} flush")
    dropped = {reason: n for reason, n in stream.ledger.drops.items() if not reason.startswith("person_")}
    drops = {reason: n for reason, n in dropped.items() if reason != "bad_intrinsics"}
    if waiting or drops != ({"repeated_person": repeated} if repeated else {}):
        tally.lost(f"{where} {type_name}", f"{len(waiting)} images are missing, {repeated} repetitions, drops {drops}")


def _check(frame: Any, waiting: list[_Image], oracle: _Oracle, bench: Bench) -> None:
    """Check a frame against the first image that has none yet, and its transforms."""
    if frame is None:
        return
    image = waiting.pop(0)
    oracle.learn(image)
    oracle.check(image, frame)
    built = bench.objects.messages(frame, ["persons", "transforms"])
    names = [transform.child_frame_id for transform in built["transforms"].transforms]
    if len(set(names)) < len(names) or (names and not (image.stamp and image.frame_id)):
        raise WrongOutput(f"transforms {names} of {image}")
    lifted = [name for name, ok in zip(frame.keypoints.ids, frame.lifted.ok, strict=True) if ok]
    if built["persons"].joint_names != lifted or len(built["persons"].transforms) != len(lifted):
        raise WrongOutput(f"persons {built['persons'].joint_names}, not {lifted}")


def _header(make: Any, rng: random.Random, now: int, lacks_stamp: bool) -> tuple[Any, int]:
    """Return a header and the stamp that its frame must have: its own, or the time of arrival."""
    own = now - 40 * _MS
    seconds, nanoseconds = divmod(own, 10**9)
    if lacks_stamp:
        bad = ((0, 0), (-1, 5), (-(2**31), 0), (seconds, 10**9), (seconds, 2**32 - 1))
        seconds, nanoseconds = rng.choice(bad)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="camera"), now if lacks_stamp else own


def _ids(type_name: str, rng: random.Random) -> tuple[str, ...]:
    """Return the ids of one to five persons, often few different ones."""
    pool = _POOLS[type_name]
    if type_name == foreign.HRI:
        return tuple(rng.sample(pool, rng.randint(1, len(pool))))
    some = rng.sample(pool, rng.choice((1, 2, len(pool))))
    return tuple(rng.choice(some) for _ in range(rng.randint(1, 5)))


def _messages(
    type_name: str, make: Any, head: Any, ids: tuple[str, ...], rng: random.Random
) -> list[tuple[str, Any, bool, int]]:
    """Return (topic, message, whether it repeats one, ns after the first message) of one image."""
    poses = [random_pose(rng) for _ in ids]
    if type_name not in msg_adapters.ONE_PERSON:
        return [("/keypoints", _whole(type_name, make, head, ids, poses, rng), False, 0)]
    found: list[tuple[str, Any, bool, int]] = []
    later = 0
    for name, pose in zip(ids, poses):
        if type_name == foreign.HRI:
            topic, message = BODIES.format(name), foreign.hri(make, head, pose)
        else:
            topic, message = "/keypoints", foreign.opendr(make, head, pose, int(name))
        for again in range(1 + (rng.random() < 0.1)):
            found.append((topic, message, bool(again), later))
            later += rng.choice((0, 1, 9)) * _MS
    return found


def _whole(type_name: str, make: Any, head: Any, ids: tuple[str, ...], poses: list[Pose], rng: random.Random) -> Any:
    """Return an image of all persons with these ids."""
    if type_name == foreign.CLOUD:
        xy = np.array([[pose[name] for name in COCO] for pose in poses])
        return outputs.keypoints_cloud(make, head, xy, np.full(xy.shape[:2], 0.9), ids)
    message = BUILDERS[type_name](make, head, poses, rng)
    persons, name, kind = {
        foreign.YOLO: ("detections", "id", str),
        foreign.AI: ("targets", "track_id", int),
        foreign.ZED: ("objects", "label_id", int),
    }[type_name]
    for person, ident in zip(getattr(message, persons), ids):
        setattr(person, name, kind(ident))
    return message
