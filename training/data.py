# SPDX-License-Identifier: Apache-2.0
"""What the trainer is given: 2D keypoints with visibility, from npz arrays or a bag - and nothing else.

Ground truth may lie in the same file; it is never opened here.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

import msg_adapters
from paul_ros.errors import LayoutError, NpzError
from paul_ros.files import read_npz
from paul_ros.layout import Layout, anonymous_layout, load_layout
from paul_ros.normalisation import centre, enough_visible, min_visible
from paul_ros.placement import centred_view
from paul_ros.stream.parameters import DEFAULTS
from training.errors import DataError

ABSURD = 1e6
"""Coordinates beyond this are no pixels: they would only drown the rest in rounding error."""

RAY_LIMIT = 20.0
"""No camera sees rays of x/z beyond this."""

_USUAL = "coco17"
"""Layout of 17 points, where none is named."""

_LEAST_FRAMES, _LEAST_POINTS = 3, 4
"""Orthographic views of so many points fix a rigid shape up to its mirror image (Ullman, Proc. R. Soc. B, 1979)."""

_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Of coordinates, as a share of the largest."""

_WILD = 30.0
"""A frame so many times as large as the median one holds a point that is out of place."""

_VARIED = 4.0
"""95th over 5th percentile of frame sizes.  Of views of one fixed scale that were measured it was 2.1 at most."""

_BLOCK = 1024
"""Frames that are looked at together: dense data is large, and a copy of it larger still."""


@dataclass(frozen=True)
class TrainingData:
    """2D frames of one layout.

    Attributes:
        W: (F,2,P) float32 image points, any unit, y down; 0 where hidden.
        visible: (F,P) bool.
        layout: the keypoints.
        calibrated: W are rays, (x/z, y/z) of a pinhole camera turned to the object; else pixels or any unit.
        source: file name, for provenance.
        used: (G,) bool, of the frames as given those that are these F: which show enough points to be lifted.
        notes: what is odd about the data and does not forbid training, a sentence each.
        detected: (F,2,P) float32, or None: the same points as a detector would give them, NaN where it would not. Where
            solutions are held, h is taught to read such views; everything is explained from W.
    """

    W: np.ndarray
    visible: np.ndarray
    layout: Layout
    calibrated: bool
    source: str
    used: np.ndarray
    notes: tuple[str, ...] = ()
    detected: np.ndarray | None = None

    @property
    def left_out(self) -> int:
        """Frames that showed too few points to be lifted, or had them all on one line."""
        return int((~self.used).sum())

    @cached_property
    def image_unit(self) -> float:
        """Root mean square of the visible coordinates about their frame's mean: the unit of data of one fixed scale."""
        squares = sum(
            float((centre(self.W[rows], self.visible[rows]).astype(float) ** 2).sum()) for rows in _blocks(len(self.W))
        )
        return math.sqrt(squares / (2 * int(self.visible.sum())))

    @property
    def sha256(self) -> str:
        """Digest of the arrays: a checkpoint belongs to the data it began with."""
        digest = hashlib.sha256(np.ascontiguousarray(self.W))
        digest.update(np.packbits(self.visible).tobytes())
        if self.detected is not None:
            digest.update(np.ascontiguousarray(self.detected))
        return digest.hexdigest()


def check_sizes(data: TrainingData, scale: str) -> tuple[str, ...]:
    """What the sizes of the frames say against the recipe's scale: notes, a sentence each.

    Raises:
        DataError: with one scale for all, a frame would outweigh the others.
    """
    size = np.concatenate([_rms(data.W[rows], data.visible[rows]) for rows in _blocks(len(data.W))])
    largest, middle = int(size.argmax()), float(np.median(size))
    notes = []
    if size[largest] > _WILD * middle:
        wild = _wild(data, largest, size[largest] / middle)
        if scale == "unit":
            raise DataError(f"{wild}: with scale: unit it outweighs all others, so hide that point in visible")
        notes.append(wild)
    if scale == "unit":
        low, high = np.percentile(size, [5, 95])
        if data.calibrated:
            notes.append("scale: unit takes all views to be of one scale, but these are rays: what is near is larger")
        elif high > _VARIED * low:
            notes.append(f"scale: unit takes all views to be of one scale, but their sizes vary {high / low:.0f} fold")
    return tuple(notes)


def _wild(data: TrainingData, frame: int, ratio: float) -> str:
    seen = data.visible[frame]
    offset = data.W[frame] - np.median(data.W[frame][:, seen], axis=1, keepdims=True)
    point = data.layout.names[int(np.where(seen, np.linalg.norm(offset, axis=0), -1.0).argmax())]
    number = np.flatnonzero(data.used)[frame]
    return f"frame {number} of {data.source} is {ratio:.0f} times as large as the median one, by point {point}"


def load_training_data(
    path: str | Path,
    layout: Layout | None = None,
    topic: str | None = None,
    min_confidence: float = DEFAULTS["min_confidence"],
) -> TrainingData:
    """Read 2D keypoints to train on.

    Args:
        path: an ``.npz`` with ``W`` (F,2,P) and optionally ``visible`` (F,P) (or NaN where hidden), ``calibrated``
            (one bool: W are rays) and ``detected`` (F,2,P); or a bag (an ``.mcap`` or a rosbag2 folder) with one topic
            of 2D keypoints of any message type that has an adapter, calibrated where it holds a CameraInfo.
        layout: what the points are; None: coco17 for 17 points and for bags, else an anonymous one, with ``edges``
            (E,2) of the npz where it has them.
        topic: which topic of a bag; needed only where it has several. It may have * for a part of its name, for
            families with a topic a person: /humans/bodies/*/skeleton2d.
        min_confidence: keypoints of a bag with a lower one count as hidden, as in the node.

    Raises:
        DataError: nothing to train on, arrays that do not fit the layout, or values that are no image points.
        BagError: the bag cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise DataError(f"no data at '{path}'")
    guessed = layout is None and path.suffix == ".npz"
    detected = None
    if path.suffix == ".npz":
        W, visible, calibrated, layout, detected = _read_npz(path, layout)
    else:
        layout = layout or load_layout(_USUAL)
        W, visible, calibrated = _read_bag(path, layout, topic, min_confidence)
    return _checked(W, visible, layout, calibrated, path, guessed, detected)


def _read_npz(path: Path, layout: Layout | None) -> tuple[np.ndarray, np.ndarray, bool, Layout, np.ndarray | None]:
    try:
        arrays = read_npz(path, ("W",), ("visible", "calibrated", "detected", *([] if layout else ["edges"])))
    except NpzError as error:
        raise DataError(f"'{path}' {error} (training needs W (F,2,P))") from error
    W, layout = arrays["W"], layout or _guessed_layout(arrays, path)
    visible, calibrated = _flags(arrays, "visible", path), _flags(arrays, "calibrated", path)
    if W.ndim != 3 or W.shape[1:] != (2, len(layout.names)) or W.dtype.kind not in "fiu":
        raise DataError(
            f"W in '{path}' must be numbers (F,2,{len(layout.names)}) for layout '{layout.name}', it is "
            f"{W.dtype} {W.shape}: name the right layout with --layout"
        )
    if visible is None:
        visible = ~np.isnan(W).any(1)
    if visible.shape != (len(W), W.shape[2]):
        raise DataError(f"visible in '{path}' must be {(len(W), W.shape[2])} to go with W, it is {visible.shape}")
    if wrong := int((visible & ~np.isfinite(W).all(1)).sum()):
        raise DataError(
            f"W in '{path}' is NaN or infinite at {wrong} of {visible.sum()} visible points: hide missing points "
            f"in visible, or leave visible out and mark them by NaN"
        )
    detected = arrays.get("detected")
    if detected is not None and (detected.shape != W.shape or detected.dtype.kind not in "fiu"):
        raise DataError(
            f"detected in '{path}' must be numbers {W.shape} to go with W, it is {detected.dtype} {detected.shape}"
        )
    calibrated = calibrated is not None and calibrated.size == 1 and bool(calibrated.all())
    return W, visible, calibrated, layout, detected


def _guessed_layout(arrays: dict[str, np.ndarray], path: Path) -> Layout:
    """The layout of a file that comes without one, by its number of points."""
    W = arrays["W"]
    if W.ndim != 3 or W.shape[1] != 2 or W.dtype.kind not in "fiu":
        raise DataError(f"W in '{path}' must be numbers (F,2,P), it is {W.dtype} {W.shape}")
    usual = load_layout(_USUAL)
    if W.shape[2] == len(usual.names):
        return usual
    edges = arrays.get("edges", np.zeros((0, 2), int))
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.dtype.kind not in "iu":
        raise DataError(f"edges in '{path}' must be whole numbers (E,2), they are {edges.dtype} {edges.shape}")
    try:
        return anonymous_layout(W.shape[2], tuple(map(tuple, edges.tolist())))
    except LayoutError as error:
        raise DataError(f"the points of '{path}' make no layout: {error}") from None


def _flags(arrays: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray | None:
    """An optional array of the file as bool; anything but bool, 0 and 1 is refused, not guessed."""
    if name not in arrays:
        return None
    flags = arrays[name]
    if flags.dtype.kind not in "biuf" or not np.isin(flags, (0, 1)).all():
        raise DataError(f"{name} in '{path}' must be bool (or 0 and 1), it is {flags.dtype}")
    return flags.astype(bool)


def _read_bag(
    path: Path, layout: Layout, topic: str | None, min_confidence: float
) -> tuple[np.ndarray, np.ndarray, bool]:
    frames, camera, refused = _bag_keypoints(path, layout, topic)
    if not frames:
        raise DataError(
            f"'{path}' holds no 2D keypoints of layout '{layout.name}'{f' on topic {topic}' if topic else ''}"
            f"{refused}; name the right layout with --layout"
        )
    if len(frames) > 1:
        raise DataError(f"'{path}' has 2D keypoints on {', '.join(sorted(frames))}: choose one with --topic")
    (seen,) = frames.values()
    xy = np.concatenate([frame.xy for frame in seen])
    visible = np.concatenate([frame.visible & (frame.confidence >= min_confidence) for frame in seen])
    if camera is None:
        return xy.transpose(0, 2, 1), visible, False
    some = visible.any(1)
    return centred_view(xy[some], visible[some], camera).W, visible[some], True


def _bag_keypoints(
    path: Path, layout: Layout, topic: str | None
) -> tuple[dict[str, list[msg_adapters.Keypoints2D]], msg_adapters.Intrinsics | None, str]:
    """Keypoint messages by topic, the camera, and why messages were refused, the last of every topic."""
    from paul_ros.offline.bag_reader import matches, read_records

    camera, size, refused = _bag_camera(path)
    frames: dict[str, list[msg_adapters.Keypoints2D]] = {}
    for record in read_records(path):
        name, type_name = record.topic, record.type_name
        if type_name not in msg_adapters.SUPPORTED or not matches(name, topic or name):
            continue
        source = msg_adapters.Source(layout.names, size, name)
        try:
            seen = msg_adapters.read(type_name, record.message(), len(layout.names), source)
        except msg_adapters.MessageError as error:
            refused[name] = str(error)
        else:
            if seen.persons:
                frames.setdefault(topic or name, []).append(seen)
    return frames, camera, _told(refused)


def _bag_camera(path: Path) -> tuple[msg_adapters.Intrinsics | None, tuple[int, int] | None, dict[str, str]]:
    """The camera, the size of its image and, by topic, why a CameraInfo was refused.

    Read before the keypoints: some are shares of the image, and the first of them may come before any CameraInfo.
    """
    from paul_ros.offline.bag_reader import read_records

    refused: dict[str, str] = {}
    cameras: set[msg_adapters.Intrinsics] = set()
    sizes: set[tuple[int, int]] = set()
    for record in read_records(path):
        if record.type_name != "sensor_msgs/msg/CameraInfo":
            continue
        info = record.message()
        # A camera that is not calibrated has a size too.
        sizes.add((int(info.width), int(info.height)))
        try:
            cameras.add(msg_adapters.read_camera_info(info))
        except msg_adapters.MessageError as error:
            refused[record.topic] = str(error)
    count = max(len(cameras), len(sizes))
    if count > 1:
        raise DataError(f"'{path}' has CameraInfo of {count} cameras: keep that of the keypoints only")
    return cameras.pop() if cameras else None, sizes.pop() if sizes else None, refused


def _told(refused: dict[str, str]) -> str:
    topics = {why: [name for name in sorted(refused) if refused[name] == why] for why in refused.values()}
    return "".join(f"; refused on {' and '.join(names)}: {why}" for why, names in topics.items())


def _checked(
    W: np.ndarray,
    visible: np.ndarray,
    layout: Layout,
    calibrated: bool,
    path: Path,
    guessed: bool,
    detected: np.ndarray | None,
) -> TrainingData:
    limit = RAY_LIMIT if calibrated else ABSURD
    visible = visible & np.isfinite(W).all(1)
    beyond = any((np.abs(W[rows]).max(1) > limit)[visible[rows]].any() for rows in _blocks(len(W)))
    if beyond or (detected is not None and (np.abs(detected) > limit).any()):
        raise DataError(
            f"'{path}' has image points beyond {limit:g}: no {'rays' if calibrated else 'pixels'}; "
            f"mark missing points as hidden or NaN"
        )
    with np.errstate(over="ignore", invalid="ignore"):  # of hidden points
        W = np.where(visible[:, None], W.astype(np.float32, copy=False), np.float32(0))
    enough = enough_visible(visible, layout) & ~_on_one_line(W, visible)
    if not enough.any():
        least = min(min_visible(layout, part) for part in layout.parts)
        raise DataError(
            f"none of the {len(W)} frames in '{path}' has {least} visible points "
            f"that are not all on one line: nothing to train on"
        )
    if detected is not None:
        detected = np.where(visible[:, None], detected, np.nan).astype(np.float32)
        enough &= enough_visible(np.isfinite(detected).all(1), layout)
    if not enough.all():
        W, visible = W[enough], visible[enough]
        detected = detected if detected is None else detected[enough]
    _check_motion(W, visible, path)
    _check_twins(W, visible, layout, path)
    return TrainingData(W, visible, layout, calibrated, path.name, enough, _notes(visible, layout, guessed), detected)


def _check_motion(W: np.ndarray, visible: np.ndarray, path: Path) -> None:
    """Refuse frames that are all the same: what does not turn shows no depth."""
    if len(W) == 1:
        raise DataError(f"'{path}' has one frame only: depth shows only where something moves")
    first = W[0]
    for rows in _blocks(len(W)):
        both = (visible[rows] & visible[0])[:, None]
        if (np.where(both, np.abs(W[rows] - first), 0) > 1e-6 * np.abs(first).max()).any():
            return
    raise DataError(f"the {len(W)} frames in '{path}' are all the same: depth shows only where something moves")


def _check_twins(W: np.ndarray, visible: np.ndarray, layout: Layout, path: Path) -> None:
    """Refuse points that are one and the same: columns copied by mistake, as a rule."""
    seen: dict[bytes, int] = {}
    for point, name in enumerate(layout.names):
        column = hashlib.sha256(np.ascontiguousarray(W[:, :, point]))
        column.update(np.ascontiguousarray(visible[:, point]))
        twin = seen.setdefault(column.digest(), point)
        if twin != point and visible[:, point].any():
            raise DataError(
                f"points {layout.names[twin]} and {name} of '{path}' are at one place in every frame: leave one out"
            )


def _notes(visible: np.ndarray, layout: Layout, guessed: bool) -> tuple[str, ...]:
    notes, (frames, points) = [], visible.shape
    if guessed and layout.name == _USUAL:
        notes.append(f"{points} points taken as {_USUAL}; --layout points{points} if they are not")
    if frames < _LEAST_FRAMES or points < _LEAST_POINTS:
        notes.append(
            f"{frames} frames of {points} points leave the depth open: even of a rigid object it takes "
            f"{_LEAST_FRAMES} frames of {_LEAST_POINTS} points"
        )
    never = [name for name, seen in zip(layout.names, visible.any(0)) if not seen]
    if never:
        more = f" and {len(never) - 5} more" if len(never) > 5 else ""
        notes.append(f"{', '.join(never[:5])}{more} of layout '{layout.name}' never visible: where they are is a guess")
    return tuple(notes)


def _blocks(frames: int) -> Iterator[slice]:
    return (slice(begin, begin + _BLOCK) for begin in range(0, frames, _BLOCK))


def _rms(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Root mean square distance (F,) of the visible points to their mean."""
    return np.sqrt((centre(W.astype(float), visible) ** 2).sum((1, 2)) / np.maximum(visible.sum(1), 1))


def _on_one_line(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Whether the visible points of frames are on one line, or in one place, but for rounding (F,)."""
    flat = np.zeros(len(W), bool)
    for rows in _blocks(len(W)):
        X = centre(W[rows].astype(float), visible[rows])
        across = np.linalg.eigvalsh(X @ X.transpose(0, 2, 1))[:, 0] / np.maximum(visible[rows].sum(1), 1)
        flat[rows] = across <= (_ROUNDING * np.abs(W[rows]).max((1, 2))) ** 2
    return flat
