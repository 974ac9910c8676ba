# SPDX-License-Identifier: Apache-2.0
"""The unit of a ground truth, judged by its size, and its frame, judged by the direction in which it lies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from paul_ros.lifted import MAX_DISTANCE, Lifted

_FACTOR = 8.0
"""Ratio of the sizes of truth and lifted persons beyond which their units differ. Children are not that small."""

_LEAST_POINTS = 4
"""Fewest points with a ground truth by which a person's size is judged."""

_SIDEWAYS = 20.0
"""Degrees between lifted and true direction from which on the frames differ: pixels fix it to a degree."""

_UNITS = ((1000.0, "millimetres"), (100.0, "centimetres or pixels"))


def problem(ratios: Sequence[float]) -> str:
    """Return why a ground truth is not in metres; '' if it may be.

    Args:
        ratios: sizes of its persons over those of the model, such as `size_ratios`.
    """
    ratio = float(np.median(ratios)) if len(ratios) else 1.0
    if not 0 < ratio or 1 / _FACTOR <= ratio <= _FACTOR:
        return ""
    guess = next((f" It looks like {name}." for size, name in _UNITS if size / 3 < ratio < 3 * size), "")
    return (
        f"The ground truth is {ratio:.3g} times as large as the persons of the model.{guess} Record it in metres, "
        "in the frame of the camera."
    )


def size_ratios(lifted: Lifted, truth: np.ndarray, metres_per_unit: float | None) -> list[float]:
    """Return the sizes of the ground truth (N,P,3) over those of the lifted persons in metres, as far as known."""
    if len(truth) != len(lifted.points):
        return []
    unit = 1.0 if lifted.units == "m" else metres_per_unit
    known = np.isfinite(truth).all(2)
    return [
        _size_ratio(true[seen], points[seen], unit)
        for points, true, seen, ok in zip(lifted.points, truth, known, lifted.ok)
        if ok and seen.sum() >= _LEAST_POINTS
    ]


def frame_problem(angles: Sequence[float]) -> str:
    """Return why the ground truth of a bag is not in the frame of its camera; '' if it may be.

    Args:
        angles: `angles_between` of all its persons.
    """
    angle = float(np.median(angles)) if len(angles) else 0.0
    if angle < _SIDEWAYS:
        return ""
    return (
        f"The ground truth lies {angle:.0f} degrees beside the persons that were lifted, so its frame is not that of "
        "the camera: only PA-MPJPE has a meaning. Record it in the camera's optical frame (x right, y down, z "
        "forward), or check that CameraInfo is that of the image."
    )


def angles_between(lifted: Lifted, truth: np.ndarray) -> list[float]:
    """Return the degrees between the directions to persons lifted in metres and to their ground truth (N,P,3).

    A ground truth about its own root has no direction, and so no angle.
    """
    if len(truth) != len(lifted.points) or lifted.units != "m":
        return []
    known = np.isfinite(truth).all(2)
    found = []
    for points, true, seen, ok in zip(lifted.points, truth, known, lifted.ok):
        if ok and seen.sum() >= _LEAST_POINTS and np.linalg.norm(true[seen].mean(0)) > _extent(true[seen]) > 0:
            one, other = points[seen].mean(0), true[seen].mean(0)
            cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
            found.append(float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    return found


def _size_ratio(true: np.ndarray, points: np.ndarray, unit: float | None) -> float:
    """Return the size of true points over that of lifted points (P,3), `unit` metres each."""
    size = unit * _extent(points) if unit else 0.0
    if size > 0:
        return _extent(true) / size
    # Without metres only an absurd size shows another unit.
    return max(1.0, _FACTOR * _extent(true) / MAX_DISTANCE)


def _extent(points: np.ndarray) -> float:
    """Return the largest extent of points (P,3) along an axis."""
    return float(np.ptp(points, axis=0).max())
