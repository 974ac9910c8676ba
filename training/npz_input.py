# SPDX-License-Identifier: Apache-2.0
"""2D frames from npz arrays. Ground truth may lie in the same file; it is never opened here."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from msg_adapters.keypoints import CONFIDENCE_NAMES
from paul_ros.errors import LayoutError, NpzError
from paul_ros.files import read_npz
from paul_ros.layout import Layout, anonymous_layout, load_layout
from paul_ros.placeholders import look_normalised, placeholders
from training.data import DEFAULT_LAYOUT, RawFrames
from training.errors import DataError


def read_arrays(path: Path, layout: Layout | None) -> RawFrames:
    """Read W and the optional arrays of an npz file; see ``load_training_data``.

    Raises:
        DataError: arrays that cannot be read or do not fit together.
    """
    optional = ("visible", "calibrated", "detected", *CONFIDENCE_NAMES, *([] if layout else ["edges"]))
    try:
        arrays = read_npz(path, ("W",), optional)
    except NpzError as error:
        raise DataError(f"'{path}' {error} (training needs W (F,2,P))") from error
    layout = layout or _guessed_layout(arrays, path)
    W = _image_points(arrays, layout, path)
    flag = _flags(arrays, "calibrated", path)
    calibrated = flag is not None and flag.size == 1 and bool(flag.all())
    given = _visibility(arrays, W, path)
    missing = placeholders(W[:, 0], W[:, 1], given)
    visible = given & ~missing
    notes = [f"{missing.sum()} of {given.sum()} points at (0, 0) or (-1, -1) taken as missing"] if missing.any() else []
    if unused := [name for name in CONFIDENCE_NAMES if name in arrays]:
        notes.append(f"{', '.join(unused)} not used: save visible = confidence > 0.3, or unsure points count as seen")
    if not calibrated and look_normalised(W[:, 0], W[:, 1], visible):
        notes.append(
            "the coordinates look normalised to 0..1: multiply x by the image's width and y by its height, "
            "or all shapes are distorted"
        )
    return RawFrames(W, visible, layout, calibrated, _detections(arrays, W, path), tuple(notes))


def _image_points(arrays: dict[str, np.ndarray], layout: Layout, path: Path) -> np.ndarray:
    W = arrays["W"]
    if W.ndim != 3 or W.shape[1:] != (2, len(layout.names)) or W.dtype.kind not in "fiu":
        raise DataError(
            f"W in '{path}' must be numbers (F,2,{len(layout.names)}) for layout '{layout.name}', it is "
            f"{W.dtype} {W.shape}: name the right layout with --layout"
        )
    return W


def _visibility(arrays: dict[str, np.ndarray], W: np.ndarray, path: Path) -> np.ndarray:
    visible = _flags(arrays, "visible", path)
    if visible is None:
        visible = ~np.isnan(W).any(1)
    if visible.shape != (len(W), W.shape[2]):
        raise DataError(f"visible in '{path}' must be {(len(W), W.shape[2])} to go with W, it is {visible.shape}")
    if wrong := int((visible & ~np.isfinite(W).all(1)).sum()):
        raise DataError(
            f"W in '{path}' is NaN or infinite at {wrong} of {visible.sum()} visible points: hide missing points "
            f"in visible, or leave visible out and mark them by NaN"
        )
    return visible


def _detections(arrays: dict[str, np.ndarray], W: np.ndarray, path: Path) -> np.ndarray | None:
    detected = arrays.get("detected")
    if detected is not None and (detected.shape != W.shape or detected.dtype.kind not in "fiu"):
        raise DataError(
            f"detected in '{path}' must be numbers {W.shape} to go with W, it is {detected.dtype} {detected.shape}"
        )
    if detected is None:
        return None
    missing = placeholders(detected[:, 0], detected[:, 1], np.isfinite(detected).all(1))
    return np.where(missing[:, None], np.nan, detected) if missing.any() else detected


def _guessed_layout(arrays: dict[str, np.ndarray], path: Path) -> Layout:
    """Return the layout of a file without one, by its number of points."""
    W = arrays["W"]
    if W.ndim != 3 or W.shape[1] != 2 or W.dtype.kind not in "fiu":
        raise DataError(f"W in '{path}' must be numbers (F,2,P), it is {W.dtype} {W.shape}")
    default = load_layout(DEFAULT_LAYOUT)
    if W.shape[2] == len(default.names):
        return default
    edges = arrays.get("edges", np.zeros((0, 2), int))
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.dtype.kind not in "iu":
        raise DataError(f"edges in '{path}' must be whole numbers (E,2), they are {edges.dtype} {edges.shape}")
    try:
        return anonymous_layout(W.shape[2], tuple(map(tuple, edges.tolist())))
    except LayoutError as error:
        raise DataError(f"the points of '{path}' make no layout: {error}") from None


def _flags(arrays: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray | None:
    """Return an optional array as bool; other values than bool, 0 and 1 are refused, not guessed."""
    if name not in arrays:
        return None
    flags = arrays[name]
    if flags.dtype.kind not in "biuf" or not np.isin(flags, (0, 1)).all():
        raise DataError(f"{name} in '{path}' must be bool (or 0 and 1), it is {flags.dtype}")
    return flags.astype(bool)
