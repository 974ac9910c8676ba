# SPDX-License-Identifier: Apache-2.0
"""A recording lifted in code, message by message, through the same path as the node, and judged against its truth.

Equal input gives an equal lifted bag, byte for byte. Nothing is dropped for want of time, as a live replay would.
"""

from __future__ import annotations

import contextlib
import json
import platform
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Callable

import numpy as np

import msg_adapters
from msg_adapters import Intrinsics, Keypoints2D
from msg_adapters.keypoints import stamp_ns
from paul_ros import __version__, metrics
from paul_ros.errors import BagError, WriteError, WrongTopicError
from paul_ros.layout import Layout
from paul_ros.lifter import AMBIGUOUS, Lifted, Lifter
from paul_ros.offline.bag import (
    LATCHED_QOS,
    BagMessages,
    BagWriter,
    Record,
    check_outputs,
    matches,
    read_records,
    topics_of,
)
from paul_ros.stream.frame import Frame
from paul_ros.stream.messages import MessageBuilder
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.stream import LiftStream

NODE = "/lifter"
"""Output topics lie below this name, as those of the node of that name do."""
ERRORS = (
    "n_mpjpe_mm",
    "pa_mpjpe_mm",
    "ne_flip_frame_percent",
    "ne_flip_global_percent",
    "root_error_median_mm",
    "root_error_median_percent",
)
"""The error keys of a report, and of the baseline in it."""
LEAST_POINTS = 4
"""That the truth of a person must have: three fit nearly any shape."""

CAMERA_INFO, POSE_ARRAY = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/PoseArray"
DEPTH_IMAGE = "sensor_msgs/msg/Image"
_OPTIONS = {
    "keypoints": "--topic",
    "camera info": "--camera-info-topic",
    "ground truth": "--ground-truth-topic",
    "depth": "--depth-topic",
}
_MM = 1000.0
_FLIP = 0.3  # of a person's size
_FARTHEST = 1e9  # metres; what is farther off, or no number, is no truth
_LEAST_SIZE = 1e-6  # metres; all points in one place are no truth either


@dataclass(frozen=True)
class Topics:
    """What is read from the bag; the defaults are those of the bags in bags/.

    keypoints may have * for a part of its name, for families with a topic a person: /humans/bodies/*/skeleton2d.
    """

    keypoints: str = "/keypoints"
    camera_info: str = "/camera_info"
    truth: str = "/ground_truth/poses"
    depth: str = "/depth"

    @property
    def all(self) -> tuple[str, ...]:
        return self.keypoints, self.camera_info, self.truth, self.depth


@dataclass(frozen=True)
class LiftedFrame:
    """One message: its N persons in the output's layout in 2D and lifted, and what the camera was then.

    given: the keypoints in the model's layout, as they were lifted.
    """

    stamp: int  # ns
    keypoints: Keypoints2D
    lifted: Lifted
    given: Keypoints2D
    camera: Intrinsics | None


@dataclass
class Replay:
    """A replayed bag.

    frames: in the bag's order. truth: stamp -> (N,P,3) metres, camera frame, in the output's layout; row i is the
    person of row i of the keypoints of that stamp; points that the truth lacks are NaN. damage: what was wrong with the
    bag; then only what lies before it is here.
    """

    bag: Path
    stream: LiftStream
    frames: list[LiftedFrame] = field(default_factory=list)
    truth: dict[int, np.ndarray] = field(default_factory=dict)
    damage: BagError | None = None

    @property
    def layout(self) -> Layout:
        """Of frames and truth."""
        return self.stream.route.output

    @property
    def why_not(self) -> list[str]:
        """What to do about messages that were dropped and persons that were left out; each reason once."""
        ledger = self.stream.ledger
        return [text for reason, text in ledger.advice.items() if ledger.drops[reason]]


def replay(
    bag: Path,
    stream: LiftStream,
    out: Path | None = None,
    topics: Topics = Topics(),
    on_frame: Callable[[], None] = lambda: None,
) -> Replay:
    """Lift every keypoint message of a bag; write input and output topics to the bag `out`, if given.

    A bag damaged somewhere in the middle is lifted up to there: `out` is then whole and says what was read, and the
    result names the damage. Raises BagError where nothing can be read, or nothing there is to be lifted.
    """
    check_outputs([out], [bag])
    done = Replay(bag, stream)
    with BagWriter(out) if out else contextlib.nullcontext() as writer:
        shell = _Shell(done, topics, writer)
        try:
            for record in read_records(bag, topics.all):
                if shell.take(record):
                    on_frame()
            shell.finish()
        except (WrongTopicError, WriteError):
            raise
        except BagError as error:
            shell.finish()
            if not done.frames:
                raise
            done.damage = error
        if not shell.keypoint_messages:
            raise BagError(_nothing_there(bag, topics))
    return done


class _Shell:
    """Hands records to the stream and what comes back to the writer; the node's counterpart."""

    def __init__(self, done: Replay, topics: Topics, writer: BagWriter | None):
        self.done, self.topics, self.writer = done, topics, writer
        self.keypoint_messages = 0
        self._make = BagMessages()
        self._builder = MessageBuilder(self._make)
        self._described: dict = {}
        self._truth: dict[int, np.ndarray] = {}
        self._last_time = 0

    def take(self, record: Record) -> bool:
        """True where the record was a keypoint message."""
        if self.writer:
            self.writer.write_record(record)
        if matches(record.topic, self.topics.keypoints):
            self._take_keypoints(record)
            return True
        if record.topic == self.topics.camera_info:
            self._hand(record, "camera info", self.done.stream.camera_info, CAMERA_INFO)
        elif record.topic == self.topics.depth:
            self._hand(record, "depth", self.done.stream.depth, DEPTH_IMAGE)
        else:
            self._hand(record, "ground truth", self._take_truth, POSE_ARRAY)
        return False

    def _hand(self, record: Record, role: str, take: Callable[[object], None], *readable: str) -> None:
        """Decodes and takes; bytes that are no message are a counted drop. Raises WrongTopicError."""
        if record.type_name not in readable:
            raise WrongTopicError(
                f"{record.topic} is a {record.type_name}, not readable as {role} ({' or '.join(readable)} is): "
                f"choose another with {_OPTIONS[role]}"
            )
        try:
            message = record.message()
        except BagError as error:
            self.done.stream.ledger.drop("undecodable", str(error))
        else:
            take(message)

    def _take_keypoints(self, record: Record) -> None:
        self.keypoint_messages += 1
        self._last_time = record.log_time
        self._hand(record, "keypoints", lambda message: self._lift(record, message), *msg_adapters.SUPPORTED)

    def _lift(self, record: Record, message: object) -> None:
        answer = self.done.stream.keypoints(record.type_name, message, record.topic)
        self._write_layout(record.log_time)
        self._take_frame(answer.frame)

    def finish(self) -> None:
        """Takes what the stream has kept for more persons of the last image, and the truth: its layout is known now."""
        self._take_frame(self.done.stream.flush())
        for stamp, flat in self._truth.items():
            self._map_truth(stamp, flat)

    def _take_frame(self, frame: Frame | None) -> None:
        if frame is None:
            return
        camera = self.done.stream.intrinsics
        stamp = frame.keypoints.stamp
        self.done.frames.append(LiftedFrame(stamp, frame.keypoints, frame.lifted, frame.given, camera))
        if self.writer:
            for name, message in self._builder.messages(frame).items():
                self.writer.write(f"{NODE}/{name}", message, self._last_time)

    def _take_truth(self, message: object) -> None:
        flat = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses], float).reshape(-1, 3)
        flat[~(np.abs(flat) < _FARTHEST).all(axis=1)] = np.nan
        self._truth[stamp_ns(message.header)] = flat

    def _map_truth(self, stamp: int, flat: np.ndarray) -> None:
        """It comes in the input's layout."""
        route = self.done.stream.route
        points = len(route.given.names)
        if len(flat) % points:
            self.done.stream.ledger.drop("truth_wrong_point_count", REASONS["truth_wrong_point_count"].advice)
            return
        self.done.truth[stamp] = route.points_out(flat.reshape(-1, points, 3))

    def _write_layout(self, log_time: int) -> None:
        described = self.done.stream.describe()
        if self.writer and described != self._described:
            self._described = described
            message = self._make("std_msgs/msg/String", data=json.dumps(described))
            self.writer.write(f"{NODE}/layout", message, log_time, LATCHED_QOS)


def _nothing_there(bag: Path, topics: Topics) -> str:
    held = [f"{topic} ({kind})" for topic, (kind, _) in topics_of(bag).items()]
    return (
        f"{bag}: no messages on {topics.keypoints}; the bag holds {', '.join(held) or 'none at all'}. "
        "Choose one with --topic"
    )


# --- judging


def evaluate(done: Replay) -> dict:
    """The report of a replay: the fixed keys of `paul replay --json` and some more; None where there is no truth.

    advice: what to do about what was dropped or noted, by the same names.

    Shape errors are over all points, hidden ones too, that the ground truth of a lifted person has: of
    persons_with_truth persons the share points_with_truth_share of the P points. NE and the position of the root need
    metric output, so they are None in model units.
    """
    stream = done.stream
    model = stream.lifter.model
    lifts = [frame.lifted for frame in done.frames]
    ok = [lifted.ok for lifted in lifts]
    times = np.array(stream.lift_us) if stream.lift_us else np.full(1, np.nan)
    return {
        "bag": str(done.bag),
        "frames": stream.counts["frames"],
        "persons": stream.counts["persons"],
        "lifted": stream.counts["lifted"],
        "dropped": dict(sorted(stream.ledger.drops.items())),
        "noted": dict(sorted(stream.ledger.notes.items())),
        "advice": dict(sorted(stream.ledger.advice.items())),
        "units": stream.units,
        **errors(with_truth(done, done.frames), done.layout.root),
        "reprojection_median_px": _median([lift.reprojection[good] for lift, good in zip(lifts, ok)]),
        "certified_share": _mean([lift.certified[good] for lift, good in zip(lifts, ok)]),
        "ambiguous_share": _mean([lift.ambiguity[good] >= AMBIGUOUS for lift, good in zip(lifts, ok)]),
        "lift_us_median": _number(np.median(times)),
        "lift_us_p99": _number(np.percentile(times, 99)),
        **_doubt(done),
        **flips(done.frames),
        "baseline": errors(with_truth(done, rigid_frames(done)), done.layout.root),
        "model": model.name,
        "model_sha256": model.sha256,
        "layout": done.layout.name,
        "input_layout": stream.route.given.name,
        "damage": str(done.damage) if done.damage else None,
        "versions": versions(),
    }


def _doubt(done: Replay) -> dict:
    """Of distance_sigma the median, and the shares of persons whose distance is wrong by at most once or twice that."""
    metric = [frame for frame in done.frames if frame.lifted.units == "m"]
    shares = []
    for frame in metric:
        if len(done.truth.get(frame.stamp, ())) == len(frame.lifted.ok) > 0:
            root = done.truth[frame.stamp][:, list(done.layout.root)].mean(1)
            judged = frame.lifted.ok & np.isfinite(root).all(1)
            off = np.abs(_length(frame.lifted.root) - _length(root))
            shares.append((off / frame.lifted.distance_sigma)[judged])
    return {
        "distance_sigma_median_m": _median([frame.lifted.distance_sigma[frame.lifted.ok] for frame in metric]),
        "distance_within_1_sigma_share": _mean([share <= 1 for share in shares]),
        "distance_within_2_sigma_share": _mean([share <= 2 for share in shares]),
    }


def flips(frames: list[LiftedFrame]) -> dict:
    """How often a person's depth turns over from one frame to the next.

    Of persons with an id that were lifted in two frames one after the other: a flip is where the person, about its mean
    point, is nearer to its mirror image of the frame before, mirrored across the plane that faces the camera, than to
    itself, has moved by more than _FLIP of its own size, and has moved by less than that in the image. So it covers
    both a body that turns front to back and one that takes its mirror image: the 2D tells neither.
    """
    pairs = turned = 0
    before: dict[str, tuple] = {}
    for frame in frames:
        now = {name: (frame, row) for row, name in enumerate(frame.keypoints.ids) if name and frame.lifted.ok[row]}
        both = [(before[name], now[name]) for name in now if name in before]
        pairs += len(both)
        turned += sum(_flipped(*pair) for pair in both)
        before = now
    return {"pairs_of_frames": pairs, "flips_per_1000_frames": 1000 * turned / pairs if pairs else None}


def _flipped(before: tuple[LiftedFrame, int], now: tuple[LiftedFrame, int]) -> bool:
    old, new = (_about_mean(frame.lifted.points[row]) for frame, row in (before, now))
    frame, row = before
    # In model units the root is the origin, and the camera looks along z.
    ray = frame.lifted.root[row] if frame.lifted.units == "m" else np.array([0.0, 0.0, 1.0])
    ray = ray / _length(ray)
    mirrored = old - 2 * (old @ ray)[:, None] * ray
    both = before[0].given.visible[before[1]] & now[0].given.visible[now[1]]
    images = [_about_mean(frame.given.xy[row][both]) for frame, row in (before, now)]
    still = np.linalg.norm(images[1] - images[0]) < _FLIP * np.linalg.norm(images[0])
    moved = np.linalg.norm(new - old)
    return bool(still and np.linalg.norm(new - mirrored) < moved and moved > _FLIP * np.linalg.norm(old))


def _about_mean(points: np.ndarray) -> np.ndarray:
    return points - points.mean(0)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1)


def rigid_frames(done: Replay) -> list[LiftedFrame]:
    """The same frames lifted with the model's mean shape, the baseline."""
    rigid = Lifter(done.stream.lifter.model.rigid())
    return [
        replace(
            frame, lifted=done.stream.route.lifted_out(rigid.lift(frame.given.xy, frame.given.visible, frame.camera))
        )
        for frame in done.frames
    ]


def with_truth(done: Replay, frames: list[LiftedFrame]) -> list[tuple[Lifted, np.ndarray]]:
    """(Lifted of N persons, their truth (N,P,3)) of the frames whose stamp has a truth."""
    return [(frame.lifted, done.truth[frame.stamp]) for frame in frames if frame.stamp in done.truth]


def errors(pairs: list[tuple[Lifted, np.ndarray]], root: tuple[int, ...]) -> dict:
    """Errors of lifted persons against truth; pairs of (Lifted of N persons, truth (N,P,3) in metres)."""
    both = matched(pairs)
    found: dict = {"persons_with_truth": len(both.truth), "points_with_truth_share": None, **dict.fromkeys(ERRORS)}
    if not len(both.truth):
        return found
    found["points_with_truth_share"] = float(both.present.mean())
    found["n_mpjpe_mm"] = _number(_MM * both.distances(metrics.n_mpjpe).mean())
    found["pa_mpjpe_mm"] = _number(_MM * both.distances(metrics.pa_mpjpe).mean())
    if all(lifted.units == "m" for lifted, _ in pairs):
        found.update(_metric_errors(both, list(root)))
    return found


def _metric_errors(both: Matched, root: list[int]) -> dict:
    """Those that need metres: NE, and the root's position of the persons whose truth has it."""
    frame, whole = metrics.normalised_error_flip_frame, metrics.normalised_error_flip_global
    found = {
        "ne_flip_frame_percent": _number(100 * frame(both.predicted, both.truth).mean()),
        "ne_flip_global_percent": _number(100 * whole(both.predicted, both.truth).mean()),
    }
    placed = both.present[:, root].all(axis=1)
    if placed.any():
        true_root = both.truth[placed][:, root].mean(1)
        missed = np.linalg.norm(both.predicted[placed][:, root].mean(1) - true_root, axis=1)
        found["root_error_median_mm"] = _number(_MM * np.median(missed))
        with np.errstate(divide="ignore", invalid="ignore"):  # a truth without position has its root in the camera
            share = missed / np.linalg.norm(true_root, axis=1)
        found["root_error_median_percent"] = _number(100 * np.median(share))
    return found


@dataclass(frozen=True)
class Matched:
    """M lifted persons beside their truth.

    predicted, truth: (M,P,3); where the truth lacks a point, both hold the mean of their others there, so that it
    counts for nothing: it moves no centre and has no error. present: (M,P) bool, the points that the truth has.
    """

    predicted: np.ndarray
    truth: np.ndarray
    present: np.ndarray

    def distances(self, measure: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """(M,) of a measure that is a mean over points: here over those that the truth has."""
        return measure(self.predicted, self.truth) / self.present.mean(axis=1)


def matched(pairs: list[tuple[Lifted, np.ndarray]]) -> Matched:
    """All persons that were lifted and whose truth has LEAST_POINTS points or more, not all in one place."""
    # Before anybody is seen the input's layout may be unknown, and arrays of nobody have another number of points.
    pairs = [(lifted, truth) for lifted, truth in pairs if len(truth) == len(lifted.points) > 0]
    if not pairs:
        return Matched(np.zeros((0, 1, 3)), np.zeros((0, 1, 3)), np.zeros((0, 1), bool))
    truth = np.concatenate([truth for _, truth in pairs])
    present = np.isfinite(truth).all(axis=2)
    usable = np.concatenate([lifted.ok for lifted, _ in pairs]) & (present.sum(axis=1) >= LEAST_POINTS)
    predicted = np.concatenate([lifted.points for lifted, _ in pairs])[usable]
    present = present[usable]
    predicted, truth = _filled(predicted, present), _filled(truth[usable], present)
    sized = np.ptp(truth, axis=1).max(axis=1) > _LEAST_SIZE
    return Matched(predicted[sized], truth[sized], present[sized])


def _filled(points: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Points (M,P,3) with the mean of a person's present ones (M,P) in place of the others."""
    inside = present[..., None]
    mean = np.where(inside, points, 0.0).sum(axis=1, keepdims=True) / present.sum(axis=1)[:, None, None]
    return np.where(inside, points, mean)


def versions() -> dict[str, str | None]:
    """Of what the figures depend on."""
    found: dict[str, str | None] = {"paul_ros": __version__, "python": platform.python_version()}
    for package in ("numpy", "mcap", "rosbags"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def _median(parts: list[np.ndarray]) -> float | None:
    return _number(np.median(np.concatenate(parts))) if any(map(len, parts)) else None


def _mean(parts: list[np.ndarray]) -> float | None:
    return _number(np.concatenate(parts).mean()) if any(map(len, parts)) else None


def _number(value: float) -> float | None:
    """A Python float for JSON, which knows no NaN."""
    return float(value) if np.isfinite(value) else None
