# SPDX-License-Identifier: Apache-2.0
"""2D frames from a bag with one topic of 2D keypoints."""

from __future__ import annotations

import bisect
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import msg_adapters
from paul_ros.errors import BagError
from paul_ros.extras import require
from paul_ros.layout import Layout
from paul_ros.placement import centred_view
from paul_ros.stream.image_bounds import ImageBounds
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.option_advice import in_options
from paul_ros.wording import quantity
from training.data import RawFrames
from training.errors import DataError

if TYPE_CHECKING:
    from paul_ros.offline.bag_reader import Recording

_OPTIONS = ("image", "camera_info_topic")  # of `paul train`, which the notes may name
_JITTER = 0.01
"""Largest difference of the intrinsics of one camera, over its focal length."""


@dataclass(frozen=True)
class _Cameras:
    """The CameraInfo of a bag.

    Attributes:
        intrinsics: usable ones with the log times (nanoseconds) from which they hold; those of one camera may differ
            in the last digits.
        image_size: width and height in pixels; None = unknown.
        rejections: reasons of unusable messages by topic.
    """

    intrinsics: list[tuple[int, msg_adapters.Intrinsics]]
    image_size: tuple[int, int] | None
    rejections: dict[str, str]

    def at(self, log_time: int) -> msg_adapters.Intrinsics:
        """Return the latest intrinsics before a time, as replay does; before the first ones, the first."""
        index = bisect.bisect_right(self.intrinsics, log_time, key=lambda timed: timed[0])
        return self.intrinsics[max(index - 1, 0)][1]


def read_bag(
    path: Path,
    layout: Layout,
    topic: str | None,
    min_confidence: float,
    guessed: bool,
    camera_info_topic: str | None = None,
    image: str = "auto",
) -> RawFrames:
    """Read the keypoints of a bag; see ``load_training_data``.

    Args:
        path: of the bag.
        layout: of the points.
        topic: that is read, with * for any part of a name; None reads all.
        min_confidence: points of a lower one are hidden.
        guessed: nobody named the layout, so a plain list of points is one person until a message shows that.
        camera_info_topic: of the camera of the keypoints; None: the only one.
        image: of the keypoints, `auto`, `rectified` or `raw`.

    Raises:
        MissingPackageError: the packages that read bags are missing.
        BagError: the bag cannot be read, or the camera of the keypoints is not clear.
        DataError: it has no keypoints of the layout, several topics of them, or a topic with several cameras.
    """
    require("train", "mcap", "rosbags")
    from paul_ros.offline.bag_reader import Recording, matches

    cameras = _bag_cameras(path, topic, camera_info_topic, image)
    rejections = dict(cameras.rejections)
    refused: dict[tuple[str, str], tuple[int, str]] = {}
    recording = Recording(path)
    frames = _bag_keypoints(recording, layout, topic, cameras.image_size, rejections, refused, guessed)
    if not frames:
        _check_topic(path, topic)
        raise DataError(
            f"'{path}' holds no 2D keypoints of layout '{layout.name}'{f' on topic {topic}' if topic else ''}"
            f"{_reasons(rejections)}; name the right layout with --layout"
        )
    if len(frames) > 1:
        raise DataError(f"'{path}' has 2D keypoints on {', '.join(sorted(frames))}: choose one with --topic")
    ((name, messages),) = frames.items()
    notes = _losses(recording, {what: last for what, last in refused.items() if matches(what[0], name)})
    if cameras.image_size:
        notes += _bounds_notes([message for _, message in messages], min_confidence, cameras.image_size)
    if cameras.intrinsics:
        seen = sum(int(message.visible.sum()) for _, message in messages)
        messages = [(time, msg_adapters.in_pinhole(message, cameras.at(time))) for time, message in messages]
        without_ray = seen - sum(int(message.visible.sum()) for _, message in messages)
        notes += _camera_notes(cameras, without_ray)
    xy = np.concatenate([message.xy for _, message in messages])
    visible = np.concatenate([message.visible & (message.confidence >= min_confidence) for _, message in messages])
    if not cameras.intrinsics:
        return RawFrames(xy.transpose(0, 2, 1), visible, layout, calibrated=False, notes=notes)
    some = visible.any(1)
    owners = [cameras.at(time) for time, message in messages for _ in range(message.persons)]
    rays = _rays(xy[some], visible[some], [owners[row] for row in np.flatnonzero(some)])
    return RawFrames(rays, visible[some], layout, calibrated=True, notes=notes)


def _camera_notes(cameras: _Cameras, without_ray: int) -> tuple[str, ...]:
    """Return notes of what was assumed about the cameras, and of points that their distortion hides."""
    assumed = dict.fromkeys(note.text for _, camera in cameras.intrinsics for note in camera.notes)
    notes = [in_options(text, _OPTIONS) for text in assumed]
    if without_ray:
        notes.append(
            f"{quantity(without_ray, 'keypoint')} hidden: the distortion model has no ray there. If they are many, "
            "calibrate the camera with images that reach to its borders"
        )
    return tuple(notes)


def _bounds_notes(
    messages: list[msg_adapters.Keypoints2D], min_confidence: float, size: tuple[int, int]
) -> tuple[str, ...]:
    """Return notes of keypoints outside the image that CameraInfo states: their rays are wrong by a factor."""
    bounds, ledger = ImageBounds(), Ledger()
    for message in messages:
        bounds.check(message, min_confidence, size, ledger)
    return tuple(in_options(text, _OPTIONS) for text in ledger.advice.values())


def _rays(xy: np.ndarray, visible: np.ndarray, cameras: list[msg_adapters.Intrinsics]) -> np.ndarray:
    """Return pixels (F,P,2) as rays (F,2,P), each frame by its own camera."""
    runs = [len(list(run)) for _, run in itertools.groupby(cameras)]
    ends = np.cumsum(runs, dtype=int)
    parts = [slice(end - length, end) for end, length in zip(ends, runs)]
    views = [centred_view(xy[part], visible[part], cameras[part.start]).W for part in parts]
    return np.concatenate([np.empty((0, 2, xy.shape[1])), *views])


def _losses(recording: Recording, refused: dict[tuple[str, str], tuple[int, str]]) -> tuple[str, ...]:
    """Return notes of what could not be read: training goes on with the whole messages.

    Args:
        recording: as far as it was read.
        refused: topic and reason -> number of messages, and the text of the last.
    """
    path, notes = recording.path, []
    if recording.damage:
        # The folders of one machine are no provenance.
        notes.append(f"its whole messages are used: {str(recording.damage).replace(str(path), path.name)}")
    notes += [
        f"{quantity(count, 'message')} on {topic} left out, {reason}; of the last: {why}"
        for (topic, reason), (count, why) in refused.items()
    ]
    return tuple(notes)


def _check_topic(path: Path, topic: str | None) -> None:
    """Raise DataError if a bag has no messages of 2D keypoints, on a topic or at all."""
    from paul_ros.offline.bag_reader import matches, topics_of

    topics = {name: kind for name, (kind, _) in topics_of(path).items()}
    if any(matches(name, topic or name) and kind in msg_adapters.SUPPORTED for name, kind in topics.items()):
        return
    held = ", ".join(f"{name} ({kind})" for name, kind in topics.items()) or "no messages"
    if topic:
        raise DataError(f"'{path}' has no 2D keypoints on {topic}; the bag holds {held}. Choose --topic")
    raise DataError(
        f"'{path}' has no 2D keypoints; the bag holds {held}. Record a topic of {' or '.join(msg_adapters.SUPPORTED)}"
    )


def _bag_keypoints(
    recording: Recording,
    layout: Layout,
    topic: str | None,
    image_size: tuple[int, int] | None,
    rejections: dict[str, str],
    refused: dict[tuple[str, str], tuple[int, str]],
    guessed: bool,
) -> dict[str, list[tuple[int, msg_adapters.Keypoints2D]]]:
    """Return the log times (nanoseconds) and keypoints of messages by topic.

    Args:
        recording: the bag.
        layout: of the points.
        topic: that is read, with * for any part of a name; None reads all.
        image_size: width and height in pixels, if known.
        rejections: is given the last reason for which messages of a topic were rejected.
        refused: receives the number of rejected messages and the text of the last, by topic and reason.
        guessed: see ``read_bag``.
    """
    from paul_ros.offline.bag_reader import matches

    frames: dict[str, list[tuple[int, msg_adapters.Keypoints2D]]] = {}
    for record in recording.whole_records():
        name, type_name = record.topic, record.type_name
        if type_name not in msg_adapters.SUPPORTED or not matches(name, topic or name):
            continue
        candidates = (len(layout.names),) if guessed and not frames else ()
        source = msg_adapters.Source(layout.names, image_size, name, candidates=candidates)
        try:
            keypoints = msg_adapters.read(type_name, record.message(), len(layout.names), source)
        except (BagError, msg_adapters.MessageError) as error:
            rejections[name] = str(error)
            what = name, getattr(error, "reason", "undecodable")
            refused[what] = refused.get(what, (0, ""))[0] + 1, str(error)
        else:
            if keypoints.persons:
                frames.setdefault(topic or name, []).append((record.log_time, keypoints))
    return frames


def _bag_cameras(path: Path, keypoints: str | None, given: str | None, image: str) -> _Cameras:
    """Read the CameraInfo that replay would use.

    Cameras are read before the keypoints: some keypoints are shares of the image size, and the first of them may come
    before any CameraInfo.
    """
    from paul_ros.offline.bag_reader import Recording
    from paul_ros.offline.bag_topics import choose_camera, topics_in

    topic = choose_camera(path, topics_in(path), given, keypoints)
    found: list[tuple[int, msg_adapters.Intrinsics]] = []
    sizes: set[tuple[int, int]] = set()
    rejections: dict[str, str] = {}
    for record in Recording(path).whole_records([topic]) if topic else ():
        try:
            info = record.message()
        except BagError as error:
            rejections[record.topic] = str(error)
            continue
        try:
            # An uncalibrated camera has an image size too.
            sizes.add(msg_adapters.image_size(info))
            camera = msg_adapters.read_camera_info(info, image)
        except msg_adapters.MessageError as error:
            rejections[record.topic] = str(error)
            continue
        if not found or found[-1][1] != camera:
            found.append((record.log_time, camera))
    if len(sizes) > 1 or not all(_same_camera(found[0][1], camera) for _, camera in found):
        raise DataError(f"'{path}' has CameraInfo of several cameras on {topic}: keep that of the keypoints only")
    return _Cameras(found, sizes.pop() if sizes else None, rejections)


def _same_camera(one: msg_adapters.Intrinsics, other: msg_adapters.Intrinsics) -> bool:
    """Return whether two intrinsics are those of one camera, whose calibration may be sent with jitter."""
    difference = [abs(getattr(one, name) - getattr(other, name)) for name in ("fx", "fy", "cx", "cy")]
    return max(difference) <= _JITTER * one.fx


def _reasons(rejections: dict[str, str]) -> str:
    topics = {why: [name for name in sorted(rejections) if rejections[name] == why] for why in rejections.values()}
    return "".join(f"; refused on {' and '.join(names)}: {why}" for why, names in topics.items())
