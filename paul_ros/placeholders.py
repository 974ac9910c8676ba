# SPDX-License-Identifier: Apache-2.0
"""Placeholders in files of 2D keypoints: coordinates such as (0, 0) and (-1, -1) that stand for missing points.

In the coordinates of an image nothing else is there. In coordinates about an origin, as of centred or root-relative
data, (0, 0) may be a point: the origin itself.
"""

from __future__ import annotations

import numpy as np

from msg_adapters.keypoints import is_placeholder

_MOST_NEGATIVE = 0.1
"""Share of negative coordinates in images: a detector guesses few points outside. About an origin it is a quarter or
more."""

_LEAST_AT_ORIGIN = 0.5
"""A point at a placeholder in a larger share of its frames is the origin of coordinates that have one."""

_NORMALISED = 3.0
"""Coordinates normalised to 0..1 reach as far at most: detectors guess points outside the image too."""

_LEAST_POINTS = 3
"""Fewest visible points that show it."""


def placeholders(x: np.ndarray, y: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return which visible points are missing, (F,P) bool.

    Args:
        x, y: (F,P) coordinates of F frames of one kind of data.
        visible: (F,P) bool.
    """
    with np.errstate(invalid="ignore"):  # of hidden points
        marked = visible & is_placeholder(x, y)
        if not marked.any() or not _about_an_origin(x, y, visible & ~marked):
            return marked
    is_origin = marked.sum(0) > _LEAST_AT_ORIGIN * visible.sum(0)
    return marked & ~is_origin


def look_normalised(x: np.ndarray, y: np.ndarray, visible: np.ndarray) -> bool:
    """Return whether the visible points of F frames (F,P) lie within 0..1, as shares of the image's size."""
    if visible.sum() < _LEAST_POINTS or _about_an_origin(x, y, visible):
        return False
    return all(bool((np.abs(values[visible]) <= _NORMALISED).all()) for values in (x, y))


def _about_an_origin(x: np.ndarray, y: np.ndarray, seen: np.ndarray) -> bool:
    negative = sum(int((seen & (values < 0)).sum()) for values in (x, y))
    return negative > _MOST_NEGATIVE * 2 * int(seen.sum())
