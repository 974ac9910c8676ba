# SPDX-License-Identifier: Apache-2.0
"""2D frames from a bag with one topic of 2D keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import msg_adapters
from paul_ros.errors import BagError
from paul_ros.extras import require
from paul_ros.layout import Layout
from paul_ros.placement import centred_view
from training.data import RawFrames
from training.errors import DataError

if TYPE_CHECKING:
    from paul_ros.offline.bag_reader import Recording


def read_bag(path: Path, layout: Layout, topic: str | None, min_confidence: float, guessed: bool) -> RawFrames:
    """Read the keypoints of a bag; see ``load_training_data``.

    Args:
        path: of the bag.
        layout: of the points.
        topic: that is read, with * for any part of a name; None reads all.
        min_confidence: points of a lower one are hidden.
        guessed: nobody named the layout, so a plain list of points is one person until a message shows that.

    Raises:
        MissingPackageError: the packages that read bags are missing.
        BagError: the bag cannot be read.
        DataError: it has no keypoints of the layout, or several topics or cameras.
    """
    require("train", "mcap", "rosbags")
    from paul_ros.offline.bag_reader import Recording

    camera, image_size, rejections = _bag_camera(path)
    recording = Recording(path)
    refused: dict[str, tuple[int, str]] = {}
    frames = _bag_keypoints(recording, layout, topic, image_size, rejections, refused, guessed)
    if not frames:
        _check_topic(path, topic)
        raise DataError(
            f"'{path}' holds no 2D keypoints of layout '{layout.name}'{f' on topic {topic}' if topic else ''}"
            f"{_reasons(rejections)}; name the right layout with --layout"
        )
    if len(frames) > 1:
        raise DataError(f"'{path}' has 2D keypoints on {', '.join(sorted(frames))}: choose one with --topic")
    (messages,) = frames.values()
    xy = np.concatenate([message.xy for message in messages])
    visible = np.concatenate([message.visible & (message.confidence >= min_confidence) for message in messages])
    notes = _losses(recording, refused)
    if camera is None:
        return RawFrames(xy.transpose(0, 2, 1), visible, layout, calibrated=False, notes=notes)
    some = visible.any(1)
    rays = centred_view(xy[some], visible[some], camera).W
    return RawFrames(rays, visible[some], layout, calibrated=True, notes=notes)


def _losses(recording: Recording, refused: dict[str, tuple[int, str]]) -> tuple[str, ...]:
    """Return notes of what could not be read: training goes on with the whole messages."""
    notes = [f"{count} messages left out, {reason}; of the last: {why}" for reason, (count, why) in refused.items()]
    if recording.damage:
        # The folders of one machine are no provenance.
        path = recording.path
        notes.append(f"its whole messages are used: {str(recording.damage).replace(str(path), path.name)}")
    return tuple(notes)


def _check_topic(path: Path, topic: str | None) -> None:
    """Raise DataError if a bag has no messages of 2D keypoints on a topic."""
    from paul_ros.offline.bag_reader import matches, topics_of

    topics = {name: kind for name, (kind, _) in topics_of(path).items()}
    if not topic or any(matches(name, topic) and kind in msg_adapters.SUPPORTED for name, kind in topics.items()):
        return
    held = ", ".join(f"{name} ({kind})" for name, kind in topics.items())
    raise DataError(f"'{path}' has no 2D keypoints on {topic}; the bag holds {held or 'none at all'}. Choose --topic")


def _bag_keypoints(
    recording: Recording,
    layout: Layout,
    topic: str | None,
    image_size: tuple[int, int] | None,
    rejections: dict[str, str],
    refused: dict[str, tuple[int, str]],
    guessed: bool,
) -> dict[str, list[msg_adapters.Keypoints2D]]:
    """Return keypoint messages by topic.

    Args:
        recording: the bag.
        layout: of the points.
        topic: that is read, with * for any part of a name; None reads all.
        image_size: width and height in pixels, if known.
        rejections: is given the last reason for which messages of a topic were rejected.
        refused: is given the number of rejected messages by reason, and the last text.
        guessed: see ``read_bag``.
    """
    from paul_ros.offline.bag_reader import matches

    frames: dict[str, list[msg_adapters.Keypoints2D]] = {}
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
            reason = error.reason if isinstance(error, msg_adapters.MessageError) else "undecodable"
            refused[reason] = refused.get(reason, (0, ""))[0] + 1, str(error)
        else:
            if keypoints.persons:
                frames.setdefault(topic or name, []).append(keypoints)
    return frames


def _bag_camera(path: Path) -> tuple[msg_adapters.Intrinsics | None, tuple[int, int] | None, dict[str, str]]:
    """Return the camera, the size of its image, and rejected CameraInfo messages as reasons by topic.

    Cameras are read before the keypoints: some keypoints are shares of the image size, and the first of them may come
    before any CameraInfo.
    """
    from paul_ros.offline.bag_reader import Recording

    rejections: dict[str, str] = {}
    cameras: set[msg_adapters.Intrinsics] = set()
    sizes: set[tuple[int, int]] = set()
    for record in Recording(path).whole_records():
        if record.type_name != "sensor_msgs/msg/CameraInfo":
            continue
        try:
            info = record.message()
        except BagError as error:
            rejections[record.topic] = str(error)
            continue
        # An uncalibrated camera has an image size too.
        sizes.add((int(info.width), int(info.height)))
        try:
            cameras.add(msg_adapters.read_camera_info(info))
        except msg_adapters.MessageError as error:
            rejections[record.topic] = str(error)
    count = max(len(cameras), len(sizes))
    if count > 1:
        raise DataError(f"'{path}' has CameraInfo of {count} cameras: keep that of the keypoints only")
    return cameras.pop() if cameras else None, sizes.pop() if sizes else None, rejections


def _reasons(rejections: dict[str, str]) -> str:
    topics = {why: [name for name in sorted(rejections) if rejections[name] == why] for why in rejections.values()}
    return "".join(f"; refused on {' and '.join(names)}: {why}" for why, names in topics.items())
