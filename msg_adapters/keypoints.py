# SPDX-License-Identifier: Apache-2.0
"""The record that every message family becomes, and the error that a bad message raises.

Shapes: N persons, P keypoints, coordinates last: (N, P, 2). Pixels: x right, y down.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

#: Largest plausible coordinate in pixels; points beyond it are missing.
MAX_PIXELS = 1e6
#: Keypoints all within this of the origin are normalised, and no pixels: detectors guess far outside 0..1 too.
_NORMALISED = 3.0
#: Fewest visible points that show it.
_LEAST_POINTS = 3
#: A confidence farther outside 0..1 is noted: peaks of RTMPose reach 1.12, of RSN 1.28 (MMPose, issues 3122 and 884).
CONFIDENCE_SLACK = 0.3
#: Names of a field, a column or an array with confidences: the contract's, then what detectors call it.
CONFIDENCE_NAMES = (
    "confidence", "score", "visibility", "conf", "likelihood", "probability", "presence", "prob", "certainty",
    "confidences", "scores", "keypoint_scores", "c",
)  # fmt: skip


class MessageError(ValueError):
    """A message that cannot be used; the text says what to do.

    Attributes:
        reason: short name to count by.
    """

    def __init__(self, reason: str, advice: str) -> None:
        super().__init__(advice)
        self.reason = reason


class PointCountError(MessageError):
    """A message whose number of keypoints does not tell how to read it.

    Attributes:
        fits: tells if a layout with the given number of keypoints would fit.
    """

    def __init__(self, reason: str, advice: str, fits: Callable[[int], bool]) -> None:
        super().__init__(reason, advice)
        self.fits = fits


class WrongPointCount(PointCountError):
    """The number of keypoints in a message differs from the layout's."""

    def __init__(self, advice: str, fits: Callable[[int], bool]) -> None:
        super().__init__("wrong_point_count", advice, fits)


class UnknownLayout(PointCountError):
    """A list of keypoints that may be one person or several, while the layout is unknown."""

    def __init__(self, advice: str, fits: Callable[[int], bool]) -> None:
        super().__init__("layout_unknown", advice, fits)


class Note(NamedTuple):
    """Something irregular about a message that was used all the same.

    Attributes:
        reason: short name to count by.
        text: what happened and what to do, without a full stop.
    """

    reason: str
    text: str


@dataclass(frozen=True)
class Source:
    """Facts beside the message that some families need.

    Attributes:
        names: names of the layout's P keypoints, for families that name points; () = unknown.
        image_size: width and height in pixels, for families with normalised coordinates; None = unknown.
        topic: topic of the message, for families that put the person's id there; '' = unknown.
        optical_frame: frame_id of CameraInfo, for families with another frame in the header; '' = unknown.
        candidates: numbers of points of all layouts that the message may have; () = its layout is known.
    """

    names: tuple[str, ...] = ()
    image_size: tuple[int, int] | None = None
    topic: str = ""
    optical_frame: str = ""
    candidates: tuple[int, ...] = ()


def split_persons(total: int, points: int, source: Source) -> int:
    """Return the number of persons in a flat list of `total` keypoints, `points` for each.

    While the layout is unknown, a list may only be one person: 34 keypoints are one body of 34 points or two of 17.

    Raises:
        UnknownLayout: the layout is unknown, and the list may be several persons.
        WrongPointCount: `total` is not a multiple of `points`.
    """
    if any(0 < other < total and total % other == 0 for other in source.candidates):
        raise UnknownLayout(
            f"{total} keypoints in one list may be one body or several", lambda other: total % other == 0
        )
    if total % points:
        raise WrongPointCount(
            f"{total} keypoints are not a multiple of the layout's {points}", lambda other: total % other == 0
        )
    return total // points


@dataclass(frozen=True)
class Keypoints2D:
    """The 2D keypoints of all persons in one image.

    Attributes:
        xy: (N, P, 2) float64 pixels, NaN for missing points.
        confidence: (N, P) float64, 0 to 1; 0 for missing points, 1 if the message has no confidence.
        visible: (N, P) bool.
        ids: N person ids as text, '' if unknown.
        stamp: nanoseconds, from the message's header.
        frame_id: the camera's optical frame, in nearly all families the header's frame.
        notes: what was irregular about the message.
    """

    xy: np.ndarray
    confidence: np.ndarray
    visible: np.ndarray
    ids: tuple[str, ...]
    stamp: int
    frame_id: str
    notes: tuple[Note, ...] = ()

    @property
    def persons(self) -> int:
        """Number of persons (N)."""
        return self.xy.shape[0]


def join(parts: list[Keypoints2D]) -> Keypoints2D:
    """Concatenate the persons of several records of one image; stamp, frame and notes are those of the first."""
    return Keypoints2D(
        np.concatenate([part.xy for part in parts]),
        np.concatenate([part.confidence for part in parts]),
        np.concatenate([part.visible for part in parts]),
        tuple(name for part in parts for name in part.ids),
        parts[0].stamp,
        parts[0].frame_id,
        parts[0].notes,
    )


def stamp_ns(header: Any) -> int:
    """Return the header's stamp in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def no_persons(points: int, header: Any) -> Keypoints2D:
    """Return the record of an image without persons, for a layout of `points` keypoints."""
    return record(np.empty((0, points, 2)), None, (), header)


def by_name(values: np.ndarray, own: tuple[str, ...], names: tuple[str, ...]) -> np.ndarray:
    """Reorder points by name from a family's order to the layout's.

    Args:
        values: (..., Q, C) in the family's order.
        own: Q names of the family's points, '' for a point that no layout has.
        names: P names of the layout's points.

    Returns:
        (..., P, C), NaN for points that the family lacks.

    Raises:
        MessageError: no_common_names.
    """
    here, there = _common(own, names)
    placed = np.full((*values.shape[:-2], len(names), values.shape[-1]), np.nan)
    placed[..., there, :] = values[..., here, :]
    return placed


@functools.lru_cache(maxsize=64)
def _common(own: tuple[str, ...], names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the common points: in `own` and in `names`."""
    pairs = [(index, names.index(name)) for index, name in enumerate(own) if name in names]
    if not pairs:
        raise MessageError(
            "no_common_names",
            f"the layout has none of the message's points ({', '.join(filter(None, own))}); "
            "set `layout` to one of the same kind of object",
        )
    here, there = np.array(pairs).T
    return here, there


def as_float64(values: np.ndarray) -> np.ndarray:
    """Return a float64 copy, without numpy's warning about signalling NaN: damaged bytes may hold that."""
    with np.errstate(invalid="ignore"):
        return np.array(values, dtype=np.float64)


def is_placeholder(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return whether coordinates, arrays of one shape, stand for a missing point: (0, 0), (-1, -1) and the like."""
    return (x == y) & (x <= 0)


def refuse_normalised(keypoints: Keypoints2D) -> None:
    """Raise MessageError if keypoints lie within 0..1: they are shares of the image's size.

    Raises:
        MessageError: normalised.
    """
    # The first coordinate alone answers nearly always.
    if keypoints.xy.size and keypoints.xy.item(0) > _NORMALISED:
        return
    if keypoints.visible.sum() < _LEAST_POINTS or (np.abs(keypoints.xy) > _NORMALISED).any():
        return
    xy = keypoints.xy[keypoints.visible]
    # Points all in one place are no person in either unit.
    if (np.ptp(xy, axis=0) > 0).all():
        raise MessageError(
            "normalised",
            f"all {keypoints.visible.sum()} keypoints lie within {_NORMALISED:g} pixels of the image's corner, so they "
            "look normalised to 0..1; multiply x by the image's width and y by its height",
        )


def record(
    xy: np.ndarray,
    confidence: np.ndarray | None,
    ids: tuple[str, ...],
    header: Any,
    present: np.ndarray | None = None,
    placeholders: bool = True,
) -> Keypoints2D:
    """Make the record from raw arrays and mark implausible points as missing.

    A point is missing if `present` is False, or if it is a placeholder such as (0, 0) or (-1, -1). It is missing too if
    x, y or its confidence is not finite, or if x or y is beyond MAX_PIXELS. Confidences are clipped to 0..1: peaks of
    some detectors exceed one slightly. Confidences far outside are noted.

    Args:
        xy: (N, P, 2) pixels, any real type.
        confidence: (N, P), or None if the message has none.
        ids: N person ids as text, '' if unknown.
        header: std_msgs/Header.
        present: (N, P) bool, or None if the family marks missing points by their values only.
        placeholders: whether (0, 0), (-1, -1) and the like are missing; False if the family has a mark of its own.
    """
    # Damaged bytes may hold signalling NaN, of which numpy warns.
    with np.errstate(invalid="ignore"):
        xy = np.array(xy, dtype=np.float64)
        given = None if confidence is None else np.array(confidence, dtype=np.float64)
        near = np.abs(xy) <= MAX_PIXELS
        x, y, visible = xy[..., 0], xy[..., 1], near[..., 0] & near[..., 1]
        # Two numbers are seldom equal; most images need one comparison only.
        if placeholders and np.count_nonzero(x == y):
            visible &= ~is_placeholder(x, y)
    if present is not None:
        visible &= present
    notes: tuple[Note, ...] = ()
    if given is None:
        confidence = visible.astype(np.float64)
    else:
        visible &= np.isfinite(given)
        confidence = np.where(visible, given, 0.0)
        if np.count_nonzero((confidence < 0) | (confidence > 1)):
            confidence, notes = _clipped(confidence)
    xy[~visible] = np.nan
    return Keypoints2D(xy, confidence, visible, ids, stamp_ns(header), str(header.frame_id), notes)


def _clipped(confidence: np.ndarray) -> tuple[np.ndarray, tuple[Note, ...]]:
    """Return confidences clipped to 0..1, and a note if some are far outside.

    -1 marks a point without confidence. 0, 1 and 2 alone are COCO's flags, where 2 is a visible point.
    """
    clipped = np.clip(confidence, 0.0, 1.0)
    outside = (np.abs(confidence - clipped) > CONFIDENCE_SLACK) & (confidence != -1)
    if not outside.any() or np.isin(confidence, (0, 1, 2)).all():
        return clipped, ()
    return clipped, (_confidence_note(confidence),)


def _confidence_note(confidence: np.ndarray) -> Note:
    return Note(
        "confidence_range",
        f"confidences from {confidence.min():.4g} to {confidence.max():.4g} were clipped to 0..1, so `min_confidence` "
        "hides other points than it says; send 0..1: divide percentages by 100, or send the sigmoid of logits",
    )
