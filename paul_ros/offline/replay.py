# SPDX-License-Identifier: Apache-2.0
"""Deterministic replay: a bag lifted message by message through the same code as the node.

Equal input gives an equal lifted bag, byte for byte. No message is dropped for lack of time.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import msg_adapters
from msg_adapters import Intrinsics, Keypoints2D
from msg_adapters.keypoints import stamp_ns
from paul_ros.errors import BagError, WrongTopicError
from paul_ros.layout import Layout
from paul_ros.lifted import Lifted
from paul_ros.offline import truth_units
from paul_ros.offline.bag_reader import matches, read_records, topics_of
from paul_ros.offline.bag_records import BagMessages, Record
from paul_ros.offline.bag_writer import LATCHED_QOS, BagWriter
from paul_ros.output_files import check_outputs
from paul_ros.stream.frame import Frame
from paul_ros.stream.messages import MessageBuilder
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.stream import LiftStream

#: Name of the replayed node; output topics lie below it, as those of the live node do.
NODE_NAME = "/lifter"

CAMERA_INFO, POSE_ARRAY = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/PoseArray"
DEPTH_IMAGE = "sensor_msgs/msg/Image"

#: Role of a topic -> the option of `paul replay` that chooses it.
_OPTIONS = {
    "keypoints": "--topic",
    "camera info": "--camera-info-topic",
    "ground truth": "--ground-truth-topic",
    "depth": "--depth-topic",
}
_MAX_COORDINATE = 1e9  # metres; a ground truth beyond this, or not a number, is missing


@dataclass(frozen=True)
class Topics:
    """Names of the topics to read; the defaults are those of the bags in bags/.

    Attributes:
        keypoints: 2D keypoints. * stands for one part of the name, for message families with a topic per person:
            /humans/bodies/*/skeleton2d.
        camera_info: CameraInfo.
        truth: ground truth, PoseArray in metres in the camera frame, person by person in the input's layout.
        depth: depth images aligned to the image of the keypoints.
    """

    keypoints: str = "/keypoints"
    camera_info: str = "/camera_info"
    truth: str = "/ground_truth/poses"
    depth: str = "/depth"

    @property
    def all(self) -> tuple[str, ...]:
        """All four names."""
        return self.keypoints, self.camera_info, self.truth, self.depth


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


@dataclass
class Replay:
    """A replayed bag.

    Attributes:
        bag: path of the bag.
        stream: the stream that lifted it, with its counts and drops.
        frames: lifted messages in the order of the bag.
        truth: stamp -> (N,P,3) metres, camera frame, in the output's layout. Row i is the person of row i of the
            keypoints of that stamp. Points without a ground truth are NaN.
        damage: error of a damaged bag, whose messages before the damage are here; None = the bag is whole.
    """

    bag: Path
    stream: LiftStream
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
) -> Replay:
    """Lift every keypoint message of a bag.

    A bag that is damaged in the middle is lifted up to the damage, and `out` is then a whole file.

    Args:
        bag: an .mcap file or a rosbag2 folder.
        stream: a new stream, from `open_stream`.
        out: bag to write, with the input topics and the outputs below NODE_NAME; None = write none.
        topics: names of the topics to read.
        on_frame: called after each keypoint message.

    Returns:
        The lifted frames, the ground truth, and the error of a damaged bag.

    Raises:
        BagError: no message can be read, or none is on the keypoint topic.
        WrongTopicError: a topic has a type that cannot be read in its role.
        OutputError: `out` cannot be written, or would overwrite the bag.
    """
    check_outputs([out], [bag])
    done = Replay(bag, stream)
    with BagWriter(out) if out else contextlib.nullcontext() as writer:
        node = _OfflineNode(done, topics, writer)
        try:
            for record in read_records(bag, topics.all):
                if node.take(record):
                    on_frame()
            node.finish()
        except WrongTopicError:
            raise
        except BagError as error:
            node.finish()
            if not done.frames:
                raise
            done.damage = error
        if not node.keypoint_messages:
            raise BagError(no_keypoints(bag, topics))
    return done


class _OfflineNode:
    """The node's counterpart: hands records to the stream and its outputs to the writer."""

    def __init__(self, done: Replay, topics: Topics, writer: BagWriter | None) -> None:
        self.done, self.topics, self.writer = done, topics, writer
        self.keypoint_messages = 0
        self._make = BagMessages()
        self._builder = MessageBuilder(self._make)
        self._described: dict = {}
        self._flat_truth: dict[int, np.ndarray] = {}  # stamp -> (N*P,3) in the input's layout
        self._last_time = 0

    def take(self, record: Record) -> bool:
        """Process one record; return whether it was a keypoint message."""
        if self.writer:
            self.writer.write_record(record)
        if matches(record.topic, self.topics.keypoints):
            self._take_keypoints(record)
            return True
        if record.topic == self.topics.camera_info:
            self._decode(record, "camera info", self.done.stream.camera_info, CAMERA_INFO)
        elif record.topic == self.topics.depth:
            self._decode(record, "depth", self.done.stream.depth, DEPTH_IMAGE)
        else:
            self._decode(record, "ground truth", self._take_truth, POSE_ARRAY)
        return False

    def finish(self) -> None:
        """Lift the persons that still wait for others of their image, and map the ground truth to the output's layout.

        The layout of the input, and so that of the truth, is certain only now.
        """
        self._take_frame(self.done.stream.flush())
        for stamp, flat in self._flat_truth.items():
            self._map_truth(stamp, flat)
        if problem := truth_units.problem(self.done):
            self.done.stream.ledger.drop("truth_not_metres", problem, len(self.done.truth))
            self.done.truth.clear()

    def _decode(self, record: Record, role: str, take: Callable[[Any], None], *readable: str) -> None:
        """Decode a record for `take`; count undecodable bytes as a drop.

        Raises:
            WrongTopicError: the topic's type is not one of `readable`.
        """
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
        self._decode(record, "keypoints", lambda message: self._lift(record, message), *msg_adapters.SUPPORTED)

    def _lift(self, record: Record, message: Any) -> None:
        answer = self.done.stream.keypoints(record.type_name, message, record.topic, record.log_time)
        self._write_layout(record.log_time)
        self._take_frame(answer.frame)

    def _take_frame(self, frame: Frame | None) -> None:
        if frame is None:
            return
        camera = self.done.stream.intrinsics
        stamp = frame.keypoints.stamp
        self.done.frames.append(LiftedFrame(stamp, frame.keypoints, frame.lifted, frame.given, camera))
        if self.writer:
            for name, message in self._builder.messages(frame).items():
                self.writer.write(f"{NODE_NAME}/{name}", message, self._last_time)

    def _take_truth(self, message: Any) -> None:
        flat = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses], float).reshape(-1, 3)
        flat[~(np.abs(flat) < _MAX_COORDINATE).all(axis=1)] = np.nan
        self._flat_truth[stamp_ns(message.header)] = flat

    def _map_truth(self, stamp: int, flat: np.ndarray) -> None:
        route = self.done.stream.route
        points = len(route.given.names)
        if len(flat) % points:
            self.done.stream.ledger.drop("truth_wrong_point_count", REASONS["truth_wrong_point_count"].advice)
            return
        self.done.truth[stamp] = route.points_out(flat.reshape(-1, points, 3))

    def _write_layout(self, log_time: int) -> None:
        """Write ~/layout whenever it changes, as the node does."""
        described = self.done.stream.describe()
        if self.writer and described != self._described:
            self._described = described
            message = self._make("std_msgs/msg/String", data=json.dumps(described))
            self.writer.write(f"{NODE_NAME}/layout", message, log_time, LATCHED_QOS)


def no_keypoints(bag: Path, topics: Topics) -> str:
    """Return the error for a bag without messages on the topic of the keypoints: what it holds, and what to do."""
    held = [f"{topic} ({kind})" for topic, (kind, _) in topics_of(bag).items()]
    return (
        f"{bag}: no messages on {topics.keypoints}; the bag holds {', '.join(held) or 'none at all'}. "
        "Choose one with --topic"
    )
