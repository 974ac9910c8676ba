# SPDX-License-Identifier: Apache-2.0
"""Checks of 2D frames before training: frames that nothing can be learned from are refused or left out."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from paul_ros.layout import Layout
from paul_ros.normalisation import centre, enough_visible, min_visible
from training.data import DEFAULT_LAYOUT, RawFrames, TrainingData, blocks
from training.errors import DataError

MAX_PIXEL = 1e6
"""Larger coordinates are no pixels; all other points would vanish in their rounding error."""

RAY_LIMIT = 20.0
"""No camera sees rays of larger x/z."""

_LEAST_FRAMES, _LEAST_POINTS = 3, 4
"""Orthographic views of so many points fix a rigid shape up to its mirror image (Ullman, Proc. R. Soc. B, 1979)."""

_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Rounding error of coordinates, as a share of the largest."""

_OUTLIER_RATIO = 30.0
"""A frame so many times as large as the median one holds a misplaced point."""

_SIZE_RANGE = 4.0
"""Largest plausible ratio of the 95th to the 5th percentile of frame sizes at one scale; measured: at most 2.1."""

_NAMED_POINTS = 5
"""Points that a note names."""


def checked(raw: RawFrames, source: Path, guessed: bool) -> TrainingData:
    """Check frames and leave out those that cannot be lifted.

    Args:
        raw: frames of a file.
        source: the file, for messages and provenance.
        guessed: the layout was guessed from the number of points.

    Raises:
        DataError: nothing to train on, or values that are no image points.
    """
    W, visible, layout, detected = raw.W, raw.visible & np.isfinite(raw.W).all(1), raw.layout, raw.detected
    _check_range(W, visible, detected, raw.calibrated, source)
    with np.errstate(over="ignore", invalid="ignore"):  # of hidden points
        W = np.where(visible[:, None], W.astype(np.float32, copy=False), np.float32(0))
    enough = enough_visible(visible, layout) & ~_on_one_line(W, visible)
    if not enough.any():
        least = min(min_visible(layout, part) for part in layout.parts)
        raise DataError(
            f"none of the {len(W)} frames in '{source}' has {least} visible points "
            f"that are not all on one line: nothing to train on"
        )
    if detected is not None:
        detected = np.where(visible[:, None], detected, np.nan).astype(np.float32)
        enough &= enough_visible(np.isfinite(detected).all(1), layout)
    if not enough.all():
        W, visible = W[enough], visible[enough]
        detected = detected if detected is None else detected[enough]
    _check_motion(W, visible, source)
    _check_twins(W, visible, layout, source)
    notes = (*raw.notes, *_notes(visible, layout, guessed))
    return TrainingData(W, visible, layout, raw.calibrated, source.name, enough, notes, detected)


def check_sizes(data: TrainingData, scale: str) -> tuple[str, ...]:
    """Compare the sizes of the frames with the recipe's scale.

    Args:
        data: to be trained on.
        scale: the recipe's.

    Returns:
        Notes, a sentence each.

    Raises:
        DataError: all frames have one scale, and one frame would outweigh the others.
    """
    size = np.concatenate([_rms(data.W[rows], data.visible[rows]) for rows in blocks(len(data.W))])
    largest, middle = int(size.argmax()), float(np.median(size))
    notes = []
    if size[largest] > _OUTLIER_RATIO * middle:
        outlier = _outlier(data, largest, size[largest] / middle)
        if scale == "unit":
            raise DataError(f"{outlier}: with scale: unit it outweighs all others, so hide that point in visible")
        notes.append(outlier)
    if scale == "unit":
        low, high = np.percentile(size, [5, 95])
        if data.calibrated:
            notes.append("scale: unit assumes one scale for all views, but these are rays: near objects are larger")
        elif high > _SIZE_RANGE * low:
            notes.append(f"scale: unit assumes one scale for all views, but their sizes vary {high / low:.0f} fold")
    return tuple(notes)


def _check_range(
    W: np.ndarray, visible: np.ndarray, detected: np.ndarray | None, calibrated: bool, source: Path
) -> None:
    limit = RAY_LIMIT if calibrated else MAX_PIXEL
    beyond = any((np.abs(W[rows]).max(1) > limit)[visible[rows]].any() for rows in blocks(len(W)))
    if beyond or (detected is not None and (np.abs(detected) > limit).any()):
        raise DataError(
            f"'{source}' has image points beyond {limit:g}: no {'rays' if calibrated else 'pixels'}; "
            f"mark missing points as hidden or NaN"
        )


def _check_motion(W: np.ndarray, visible: np.ndarray, source: Path) -> None:
    """Refuse frames that are all the same: an object that does not turn shows no depth."""
    if len(W) == 1:
        raise DataError(f"'{source}' has one frame only: depth shows only where something moves")
    first = W[0]
    for rows in blocks(len(W)):
        both = (visible[rows] & visible[0])[:, None]
        if (np.where(both, np.abs(W[rows] - first), 0) > 1e-6 * np.abs(first).max()).any():
            return
    raise DataError(f"the {len(W)} frames in '{source}' are all the same: depth shows only where something moves")


def _check_twins(W: np.ndarray, visible: np.ndarray, layout: Layout, source: Path) -> None:
    """Refuse points that are equal in every frame; mostly, a column was copied by mistake."""
    seen: dict[bytes, int] = {}
    for point, name in enumerate(layout.names):
        column = hashlib.sha256(np.ascontiguousarray(W[:, :, point]).data)
        column.update(np.ascontiguousarray(visible[:, point]).data)
        twin = seen.setdefault(column.digest(), point)
        if twin != point and visible[:, point].any():
            raise DataError(
                f"points {layout.names[twin]} and {name} of '{source}' are at one place in every frame: leave one out"
            )


def _notes(visible: np.ndarray, layout: Layout, guessed: bool) -> tuple[str, ...]:
    notes, (frames, points) = [], visible.shape
    if guessed and layout.name == DEFAULT_LAYOUT:
        notes.append(f"{points} points taken as {layout.name}; --layout points{points} if they are not")
    if frames < _LEAST_FRAMES or points < _LEAST_POINTS:
        notes.append(
            f"{frames} frames of {points} points leave the depth open: even a rigid object needs "
            f"{_LEAST_FRAMES} frames of {_LEAST_POINTS} points"
        )
    never = [name for point, name in enumerate(layout.names) if not visible[:, point].any()]
    if never:
        more = f" and {len(never) - _NAMED_POINTS} more" if len(never) > _NAMED_POINTS else ""
        named = ", ".join(never[:_NAMED_POINTS])
        notes.append(f"{named}{more} of layout '{layout.name}' never visible: their places are guesses")
    return tuple(notes)


def _outlier(data: TrainingData, frame: int, ratio: float) -> str:
    seen = data.visible[frame]
    offset = data.W[frame] - np.median(data.W[frame][:, seen], axis=1, keepdims=True)
    point = data.layout.names[int(np.where(seen, np.linalg.norm(offset, axis=0), -1.0).argmax())]
    number = np.flatnonzero(data.used)[frame]
    return f"frame {number} of {data.source} is {ratio:.0f} times as large as the median one, by point {point}"


def _rms(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return root mean square distances (F,) of the visible points to their mean."""
    return np.sqrt((centre(W.astype(float), visible) ** 2).sum((1, 2)) / np.maximum(visible.sum(1), 1))


def _on_one_line(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return for each frame (F,) whether its visible points lie on one line, or in one place, up to rounding."""
    flat = np.zeros(len(W), bool)
    for rows in blocks(len(W)):
        X = centre(W[rows].astype(float), visible[rows])
        across = np.linalg.eigvalsh(X @ X.transpose(0, 2, 1))[:, 0] / np.maximum(visible[rows].sum(1), 1)
        flat[rows] = across <= (_ROUNDING * np.abs(W[rows]).max((1, 2))) ** 2
    return flat
