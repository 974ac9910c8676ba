# SPDX-License-Identifier: Apache-2.0
"""Deterministic replay: a bag lifted message by message through the same code as the node.

Equal input gives an equal lifted bag, byte for byte. No message is dropped for lack of time.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from msg_adapters import Intrinsics, Keypoints2D
from msg_adapters.keypoints import stamp_ns
from paul_ros.errors import BagError, WrongTopicError
from paul_ros.layout import Layout
from paul_ros.lifted import Lifted
from paul_ros.offline.bag_reader import matches, read_records
from paul_ros.offline.bag_records import BagMessages, Record
from paul_ros.offline.bag_topics import CAMERA_INFO, DEPTH, KEYPOINTS, TRUTH, BagTopics, Role, Topics
from paul_ros.offline.bag_writer import LATCHED_QOS, BagWriter
from paul_ros.output_files import check_outputs
from paul_ros.stream.frame import Frame
from paul_ros.stream.messages import MessageBuilder
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.stream import LiftStream

#: Name of the replayed node; output topics lie below it, as those of the live node do.
NODE_NAME = "/lifter"

_MAX_COORDINATE = 1e9  # metres; a ground truth beyond this, or not a number, is missing


@dataclass(frozen=True)
class LiftedFrame:
    """One lifted message of N persons.

    Attributes:
        stamp: header.stamp in nanoseconds.
        keypoints: the 2D input in the output's layout.
        lifted: the 3D result in the output's layout.
        given: the 2D input in the model's layout, as it was lifted.
        camera: intrinsics at that time; None = unknown.
    """

    stamp: int
    keypoints: Keypoints2D
    lifted: Lifted
    given: Keypoints2D
    camera: Intrinsics | None


class Listener(Protocol):
    """Receives the frames and the ground truth of a replay as they come, in the order of the bag."""

    def add_frame(self, frame: LiftedFrame) -> None:
        """Take a lifted message."""

    def add_truth(self, stamp: int, points: np.ndarray) -> None:
        """Take the ground truth of a stamp, (N,P,3) metres in the output's layout."""


@dataclass
class Replay:
    """A replayed bag.

    Attributes:
        bag: path of the bag.
        stream: the stream that lifted it, with its counts and drops.
        topics: the topics that were read.
        frames: the kept messages in the order of the bag.
        truth: stamp -> (N,P,3) metres, camera frame, in the output's layout. Row i is the person of row i of the
            keypoints of that stamp. Points without a ground truth are NaN.
        damage: error of a damaged bag, whose messages before the damage are here; None = the bag is whole.
    """

    bag: Path
    stream: LiftStream
    topics: BagTopics
    frames: list[LiftedFrame] = field(default_factory=list)
    truth: dict[int, np.ndarray] = field(default_factory=dict)
    damage: BagError | None = None

    @property
    def layout(self) -> Layout:
        """Layout of the frames and the ground truth."""
        return self.stream.route.output

    @property
    def drop_advice(self) -> list[str]:
        """Advice about dropped messages and persons, once for each reason."""
        return [text for reason, text in self.stream.ledger.advice.items() if self.stream.ledger.drops[reason]]


def replay(
    bag: Path,
    stream: LiftStream,
    out: Path | None = None,
    topics: Topics = Topics(),
    on_frame: Callable[[], None] = lambda: None,
    listener: Listener | None = None,
    keep: int | None = None,
) -> Replay:
    """Lift every keypoint message of a bag.

    A bag that is damaged in the middle is lifted up to the damage, and `out` is then a whole file.

    Args:
        bag: an .mcap file or a rosbag2 folder.
        stream: a new stream, from `open_stream`.
        out: bag to write, with the input topics and the outputs below NODE_NAME; None = write none.
        topics: names of the topics to read.
        on_frame: called after each keypoint message.
        listener: receives all frames and all ground truth.
        keep: number of frames to keep in the result, evenly over the bag, up to the double; None = all.

    Returns:
        The kept frames, their ground truth, and the error of a damaged bag.

    Raises:
        BagError: no message can be read, none is on the keypoint topic, or a topic cannot be chosen.
        WrongTopicError: a topic has a type that cannot be read in its role.
        OutputError: `out` cannot be written, or would overwrite the bag.
    """
    check_outputs([out], [bag])
    found = topics.found_in(bag)
    kept = _KeptFrames(keep)
    listeners = [kept, listener] if listener else [kept]
    done = Replay(bag, stream, found)
    with BagWriter(out) if out else contextlib.nullcontext() as writer:
        node = _OfflineNode(stream, found, writer, listeners)
        try:
            for record in read_records(bag, found.all):
                if node.take(record):
                    on_frame()
            node.finish()
        except WrongTopicError:
            raise
        except BagError as error:
            node.finish()
            if not stream.counts["frames"]:
                raise
            done.damage = error
    done.frames, done.truth = kept.frames, kept.truth
    return done


class _KeptFrames:
    """Keeps frames and their ground truth, all or evenly over the bag.

    Attributes:
        frames: every frame, or every second, fourth, ... so that they are at most the double of the wanted number.
        truth: stamp -> (N,P,3) of the kept frames, and of stamps whose frames may still come.
    """

    def __init__(self, wanted: int | None) -> None:
        self.frames: list[LiftedFrame] = []
        self.truth: dict[int, np.ndarray] = {}
        self._wanted = wanted
        self._step, self._seen, self._last = 1, 0, -1
        self._stamps: set[int] = set()

    def add_frame(self, frame: LiftedFrame) -> None:
        """Keep a frame if it is one of those, and thin the kept ones if they become too many."""
        self._seen += 1
        self._last = frame.stamp
        if (self._seen - 1) % self._step or self._wanted == 0:
            if frame.stamp not in self._stamps:
                self.truth.pop(frame.stamp, None)
            return
        self.frames.append(frame)
        self._stamps.add(frame.stamp)
        if self._wanted is not None and len(self.frames) > 2 * self._wanted:
            self._thin()

    def add_truth(self, stamp: int, points: np.ndarray) -> None:
        """Keep a ground truth unless its frame has come and was not kept."""
        if self._wanted is None or stamp in self._stamps or (stamp > self._last and self._wanted):
            self.truth[stamp] = points

    def _thin(self) -> None:
        self.frames, self._step = self.frames[::2], 2 * self._step
        self._stamps = {frame.stamp for frame in self.frames}
        self.truth = {
            stamp: points for stamp, points in self.truth.items() if stamp in self._stamps or stamp > self._last
        }


class _OfflineNode:
    """The node's counterpart: hands records to the stream, its outputs to the writer, and its frames to listeners."""

    def __init__(
        self, stream: LiftStream, topics: BagTopics, writer: BagWriter | None, listeners: Sequence[Listener]
    ) -> None:
        self.stream, self.topics, self.writer, self.listeners = stream, topics, writer, listeners
        self._make = BagMessages()
        self._builder = MessageBuilder(self._make)
        self._described: dict = {}
        self._early_truth: list[tuple[int, np.ndarray]] = []  # stamp and (N*P,3) while the input's layout is unknown
        self._layout_known = False
        self._last_time = 0

    def take(self, record: Record) -> bool:
        """Process one record; return whether it was a keypoint message."""
        if self.writer:
            self.writer.write_record(record)
        if matches(record.topic, self.topics.keypoints):
            self._take_keypoints(record)
            return True
        if record.topic == self.topics.camera_info:
            self._decode(record, CAMERA_INFO, self.stream.camera_info)
        elif record.topic == self.topics.depth:
            self._decode(record, DEPTH, self.stream.depth)
        else:
            self._decode(record, TRUTH, self._take_truth)
        return False

    def finish(self) -> None:
        """Lift the persons that still wait for others of their image."""
        self._take_frame(self.stream.flush())
        self._pass_early_truth()

    def _decode(self, record: Record, role: Role, take: Callable[[Any], None]) -> None:
        """Decode a record for `take`; count undecodable bytes as a drop.

        Raises:
            WrongTopicError: the topic's type cannot be read in its role.
        """
        role.check(record.topic, record.type_name)
        try:
            message = record.message()
        except BagError as error:
            self.stream.ledger.drop("undecodable", str(error))
        else:
            take(message)

    def _take_keypoints(self, record: Record) -> None:
        self._last_time = record.log_time
        self._decode(record, KEYPOINTS, lambda message: self._lift(record, message))

    def _lift(self, record: Record, message: Any) -> None:
        answer = self.stream.keypoints(record.type_name, message, record.topic, record.log_time)
        described = self.stream.describe()
        self._write_layout(described, record.log_time)
        if not self._layout_known and described["input_layout"]:
            self._pass_early_truth()
            self._layout_known = True
        self._take_frame(answer.frame)

    def _take_frame(self, frame: Frame | None) -> None:
        if frame is None:
            return
        lifted = LiftedFrame(frame.keypoints.stamp, frame.keypoints, frame.lifted, frame.given, frame.camera)
        for listener in self.listeners:
            listener.add_frame(lifted)
        if self.writer:
            for name, message in self._builder.messages(frame).items():
                self.writer.write(f"{NODE_NAME}/{name}", message, self._last_time)

    def _take_truth(self, message: Any) -> None:
        flat = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses], float).reshape(-1, 3)
        # A point in the camera's centre marks a missing one.
        flat[~(np.abs(flat) < _MAX_COORDINATE).all(axis=1) | (flat == 0).all(axis=1)] = np.nan
        stamp = stamp_ns(message.header)
        if self._layout_known:
            self._pass_truth(stamp, flat)
        else:
            self._early_truth.append((stamp, flat))

    def _pass_early_truth(self) -> None:
        for stamp, flat in self._early_truth:
            self._pass_truth(stamp, flat)
        self._early_truth.clear()

    def _pass_truth(self, stamp: int, flat: np.ndarray) -> None:
        """Map a ground truth (N*P,3) to the output's layout and hand it on; a wrong number of points is a drop."""
        points = len(self.stream.route.given.names)
        if len(flat) % points:
            self.stream.ledger.drop("truth_wrong_point_count", REASONS["truth_wrong_point_count"].advice)
            return
        for listener in self.listeners:
            listener.add_truth(stamp, self.stream.route.points_out(flat.reshape(-1, points, 3)))

    def _write_layout(self, described: dict[str, Any], log_time: int) -> None:
        """Write ~/layout whenever it changes, as the node does."""
        if self.writer and described != self._described:
            self._described = described
            message = self._make("std_msgs/msg/String", data=json.dumps(described))
            self.writer.write(f"{NODE_NAME}/layout", message, log_time, LATCHED_QOS)
