# SPDX-License-Identifier: Apache-2.0
"""The unit of a ground truth, judged by its size: truth in millimetres or pixels must not pass for metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from paul_ros.lifted import MAX_DISTANCE, Lifted

_FACTOR = 8.0
"""Ratio of the sizes of truth and lifted persons beyond which their units differ. Children are not that small."""

_LEAST_POINTS = 4
"""Fewest points with a ground truth by which a person's size is judged."""

_UNITS = ((1000.0, "millimetres"), (100.0, "centimetres or pixels"))


def problem(ratios: Sequence[float]) -> str:
    """Return why the ground truth of a bag is not in metres; '' if it may be.

    Args:
        ratios: `size_ratios` of all its persons.
    """
    ratio = float(np.median(ratios)) if len(ratios) else 1.0
    if not 0 < ratio or 1 / _FACTOR <= ratio <= _FACTOR:
        return ""
    guess = next((f" It looks like {name}." for size, name in _UNITS if size / 3 < ratio < 3 * size), "")
    return (
        f"The ground truth is {ratio:.3g} times as large as the persons that were lifted.{guess} Record it in metres, "
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
