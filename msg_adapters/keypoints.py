# SPDX-License-Identifier: Apache-2.0
"""The one record every message family becomes, and the one error a bad message raises.

Shapes: N persons, P keypoints, point-major (N, P, 2). Pixels, x right, y down.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: A coordinate beyond this many pixels is no pixel: the point counts as missing.
ABSURD_PIXELS = 1e6


class MessageError(ValueError):
    """A message that cannot be used. ``reason`` is a short slug to count by; the text says what to do."""

    def __init__(self, reason: str, advice: str) -> None:
        super().__init__(advice)
        self.reason = reason


class WrongPointCount(MessageError):
    """The message has another number of keypoints than the layout. ``fits(points)`` tells which would do."""

    def __init__(self, advice: str, fits: Callable[[int], bool]) -> None:
        super().__init__("wrong_point_count", advice)
        self.fits = fits


def split_persons(total: int, points: int) -> int:
    """How many persons of `points` keypoints a flat list of `total` keypoints holds.

    Raises WrongPointCount where it holds no whole number of persons.
    """
    if total % points:
        raise WrongPointCount(
            f"{total} keypoints are no multiple of the {points} of the layout", lambda other: total % other == 0
        )
    return total // points


@dataclass(frozen=True)
class Source:
    """What a reader may need to know beside the message itself.

    names: of the layout's P keypoints, for families that tell which point is which; () = unknown.
    image_size: width and height in pixels, for families that normalise by them; None = unknown.
    topic: that the message came from, for families that put the person's id there; '' = unknown.
    optical_frame: CameraInfo's frame_id, for families whose header names another frame of the camera; '' = unknown.
    """

    names: tuple[str, ...] = ()
    image_size: tuple[int, int] | None = None
    topic: str = ""
    optical_frame: str = ""


@dataclass(frozen=True)
class Keypoints2D:
    """The 2D keypoints of all persons in one image.

    xy: (N, P, 2) float64 pixels, NaN where missing.
    confidence: (N, P) float64 in 0..1, 1 where the message has none, 0 where missing.
    visible: (N, P) bool.
    ids: N person ids as text, '' where unknown.
    stamp: nanoseconds, from the message's header.
    frame_id: the camera's optical frame: what the message's header names, in nearly all families.
    """

    xy: np.ndarray
    confidence: np.ndarray
    visible: np.ndarray
    ids: tuple[str, ...]
    stamp: int
    frame_id: str

    @property
    def persons(self) -> int:
        """How many persons the image shows (N)."""
        return self.xy.shape[0]


def join(parts: list[Keypoints2D]) -> Keypoints2D:
    """The persons of several records of one image, in order; stamp and frame are the first one's."""
    return Keypoints2D(
        np.concatenate([part.xy for part in parts]),
        np.concatenate([part.confidence for part in parts]),
        np.concatenate([part.visible for part in parts]),
        tuple(name for part in parts for name in part.ids),
        parts[0].stamp,
        parts[0].frame_id,
    )


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion: focal lengths, principal point and image size, all in pixels.

    matrix: 'P' or 'K', where in CameraInfo they stood: P is of the rectified image, K of the raw one.
    distorted: they are of a raw image whose distortion is known but not corrected.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    matrix: str = "P"
    distorted: bool = False


def stamp_ns(header) -> int:
    """The header's stamp in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def nobody(points: int, header) -> Keypoints2D:
    """The record of an image without persons, for a layout of `points` keypoints."""
    return record(np.empty((0, points, 2)), None, (), header)


def by_name(values: np.ndarray, own: tuple[str, ...], names: tuple[str, ...]) -> np.ndarray:
    """Q points (..., Q, C) in a family's own order as (..., P, C) of the layout; NaN for points the family lacks.

    own: Q names, '' for a point that is none of the body's usual ones; names: P of the layout.
    Raises MessageError no_common_names.
    """
    here, there = _common(own, names)
    placed = np.full((*values.shape[:-2], len(names), values.shape[-1]), np.nan)
    placed[..., there, :] = values[..., here, :]
    return placed


@functools.lru_cache(maxsize=64)
def _common(own: tuple[str, ...], names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the points that both have: in own, in names."""
    pairs = [(index, names.index(name)) for index, name in enumerate(own) if name in names]
    if not pairs:
        raise MessageError(
            "no_common_names",
            f"the layout has none of the points that this message names ({', '.join(filter(None, own))}); "
            "set the parameter `layout` to one of the same kind of object",
        )
    return tuple(np.array(pairs).T)


def as_float64(values: np.ndarray) -> np.ndarray:
    """A copy; of signalling NaN, which damaged bytes may be, without numpy's warning."""
    with np.errstate(invalid="ignore"):
        return np.array(values, dtype=np.float64)


def record(
    xy: np.ndarray, confidence: np.ndarray | None, ids: tuple[str, ...], header, present: np.ndarray | None = None
) -> Keypoints2D:
    """Makes the record from raw arrays: what no camera can have seen becomes missing.

    xy (N, P, 2) in any real type; confidence (N, P) or None where the message has none; present (N, P) bool
    or None where the family marks missing points only by their values. A point is missing where `present`
    says so, where x or y is not finite or beyond ABSURD_PIXELS, or where its confidence is not finite.
    Confidences are clipped to 0..1: some detectors' peaks reach a little above one.
    """
    xy = as_float64(xy)
    with np.errstate(invalid="ignore"):
        visible = (np.abs(xy) <= ABSURD_PIXELS).all(axis=-1)
    if present is not None:
        visible &= present
    if confidence is None:
        confidence = np.ones(visible.shape)
    else:
        confidence = as_float64(confidence)
        visible &= np.isfinite(confidence)
    xy[~visible] = np.nan
    confidence = np.where(visible, np.clip(confidence, 0.0, 1.0), 0.0)
    return Keypoints2D(xy, confidence, visible, ids, stamp_ns(header), str(header.frame_id))
