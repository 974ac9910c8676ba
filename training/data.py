# SPDX-License-Identifier: Apache-2.0
"""What the trainer is given: 2D keypoints with visibility, from npz arrays or a bag - and nothing else.

Ground truth may lie in the same file; it is never opened here.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import msg_adapters
from paul_ros.model import min_visible
from paul_ros.parameters import DEFAULTS
from paul_ros.placement import centred_view
from paul_ros.skeleton import Layout

ABSURD = 1e6
"""Coordinates beyond this are no pixels: they would only drown the rest in rounding error."""

RAY_LIMIT = 20.0
"""No camera sees rays of x/z beyond this."""


class DataError(ValueError):
    """Data that cannot be trained on; the text says what to do."""


@dataclass(frozen=True)
class TrainingData:
    """2D frames of one layout.

    Attributes:
        W: (F,2,P) float32 image points, any unit, y down; 0 where hidden.
        visible: (F,P) bool.
        layout: the keypoints.
        calibrated: W are rays, (x/z, y/z) of a pinhole camera turned to the object; else pixels or any unit.
        source: file name, for provenance.
        left_out: frames that held fewer visible points than can be lifted.
    """

    W: np.ndarray
    visible: np.ndarray
    layout: Layout
    calibrated: bool
    source: str
    left_out: int

    @property
    def sha256(self) -> str:
        """Digest of the arrays: a checkpoint belongs to the data it began with."""
        digest = hashlib.sha256(np.ascontiguousarray(self.W).tobytes())
        digest.update(np.packbits(self.visible).tobytes())
        return digest.hexdigest()


def load_training_data(
    path: str | Path,
    layout: Layout,
    topic: str | None = None,
    min_confidence: float = DEFAULTS["min_confidence"],
) -> TrainingData:
    """Read 2D keypoints to train on.

    Args:
        path: an ``.npz`` with ``W`` (F,2,P) and optionally ``visible`` (F,P) (or NaN where hidden) and ``calibrated``
            (one bool: W are rays); or a bag (an ``.mcap`` or a rosbag2 folder) with one topic of 2D keypoints of any
            message type that has an adapter, calibrated where it holds a CameraInfo.
        layout: what the points are.
        topic: which topic of a bag; needed only where it has several.
        min_confidence: keypoints of a bag with a lower one count as hidden, as in the node.

    Raises:
        DataError: nothing to train on, arrays that do not fit the layout, or values that are no image points.
        BagError: the bag cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise DataError(f"no data at '{path}'")
    if path.suffix == ".npz":
        W, visible, calibrated = _read_npz(path, layout)
    else:
        W, visible, calibrated = _read_bag(path, layout, topic, min_confidence)
    return _checked(W, visible, layout, calibrated, path)


def _read_npz(path: Path, layout: Layout) -> tuple[np.ndarray, np.ndarray, bool]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if "W" not in archive.files:
                raise DataError(f"'{path}' has no array W (F,2,P); it has {', '.join(archive.files) or 'none'}")
            W = archive["W"]
            visible = _flags(archive, "visible", path)
            calibrated = _flags(archive, "calibrated", path)
    except DataError:
        raise
    except Exception as error:  # numpy and zipfile report damage in a dozen ways
        raise DataError(f"'{path}' is no npz file of plain arrays ({type(error).__name__}: {error})") from error
    if W.ndim != 3 or W.shape[1:] != (2, len(layout.names)) or W.dtype.kind not in "fiu":
        raise DataError(
            f"W in '{path}' must be numbers (F,2,{len(layout.names)}) for layout '{layout.name}', it is "
            f"{W.dtype} {W.shape}: name the right layout with --layout"
        )
    if visible is None:
        visible = np.ones((len(W), W.shape[2]), bool)
    if visible.shape != (len(W), W.shape[2]):
        raise DataError(f"visible in '{path}' must be {(len(W), W.shape[2])} to go with W, it is {visible.shape}")
    return W, visible, calibrated is not None and calibrated.size == 1 and bool(calibrated.all())


def _flags(archive: np.lib.npyio.NpzFile, name: str, path: Path) -> np.ndarray | None:
    """An optional array of the file as bool; anything but bool, 0 and 1 is refused, not guessed."""
    if name not in archive.files:
        return None
    flags = archive[name]
    if flags.dtype.kind not in "biuf" or not np.isin(flags, (0, 1)).all():
        raise DataError(f"{name} in '{path}' must be bool (or 0 and 1), it is {flags.dtype}")
    return flags.astype(bool)


def _read_bag(
    path: Path, layout: Layout, topic: str | None, min_confidence: float
) -> tuple[np.ndarray, np.ndarray, bool]:
    frames, camera, refused = _bag_keypoints(path, layout, topic)
    if not frames:
        raise DataError(
            f"'{path}' holds no 2D keypoints of layout '{layout.name}'{f' on topic {topic}' if topic else ''}{refused}"
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
    """Keypoint messages by topic, the camera, and why the last refused message was."""
    from paul_ros.bag import read_messages  # needs the extra "bags"

    frames: dict[str, list[msg_adapters.Keypoints2D]] = {}
    refused = ""
    cameras: set[msg_adapters.Intrinsics] = set()
    for name, type_name, message, _ in read_messages(path):
        try:
            if type_name == "sensor_msgs/msg/CameraInfo":
                cameras.add(msg_adapters.read_camera_info(message))
            elif type_name in msg_adapters.SUPPORTED and topic in (None, name):
                seen = msg_adapters.read(type_name, message, len(layout.names))
                if seen.persons:
                    frames.setdefault(name, []).append(seen)
        except msg_adapters.MessageError as error:
            refused = f"; the last message refused on {name}: {error}"
    if len(cameras) > 1:
        raise DataError(f"'{path}' has CameraInfo of {len(cameras)} cameras: keep that of the keypoints only")
    return frames, cameras.pop() if cameras else None, refused


def _checked(W: np.ndarray, visible: np.ndarray, layout: Layout, calibrated: bool, path: Path) -> TrainingData:
    visible = visible & np.isfinite(W).all(1)
    if np.abs(W.transpose(0, 2, 1)[visible]).max(initial=0) > (RAY_LIMIT if calibrated else ABSURD):
        raise DataError(
            f"'{path}' has image points beyond {RAY_LIMIT if calibrated else ABSURD:g}: no "
            f"{'rays' if calibrated else 'pixels'}; mark missing points as hidden or NaN"
        )
    enough = (visible.sum(1) >= min_visible(len(layout.names))) & (_spread(W, visible) > 0)
    if not enough.any():
        raise DataError(
            f"none of the {len(W)} frames in '{path}' has {min_visible(len(layout.names))} visible points "
            f"at different places: nothing to train on"
        )
    W = np.where(visible[:, None], W, 0).astype(np.float32)[enough]
    return TrainingData(W, visible[enough], layout, calibrated, path.name, int((~enough).sum()))


def _spread(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Extent (F,) of the visible points."""
    seen = visible[:, None]
    with np.errstate(invalid="ignore"):
        extent = np.where(seen, W, -np.inf).max(2) - np.where(seen, W, np.inf).min(2)
    return np.nan_to_num(extent, neginf=0.0).max(1)
