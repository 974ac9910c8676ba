# SPDX-License-Identifier: Apache-2.0
"""Normalisation of image points and of shapes, and the visible points that lifting needs.

Layouts with several categories are normalised category by category.
"""

from __future__ import annotations

import functools
import math
import operator
from typing import Any

import numpy as np

from paul_ros.layout import Layout, Part

# --- visibility


def min_visible(layout: Layout, part: Part) -> int:
    """Return the fewest visible points of a part that are lifted: the layout's own number, else 30 %, at least 4."""
    points = len(part.points)
    return min(points, layout.min_visible or max(4, math.ceil(0.3 * points)))


def enough_visible(visible: Any, layout: Layout) -> Any:
    """Return whether frames show enough points to be lifted, in at least one category.

    Args:
        visible: (N,P) bool, an array or a tensor.
        layout: layout of the P points.

    Returns:
        (N,) bool of the same kind.
    """
    enough = [visible[:, part.columns].sum(1) >= min_visible(layout, part) for part in layout.parts]
    return functools.reduce(operator.or_, enough)


# --- image points


def centre(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Move image points (N,2,P) so that the mean of the visible ones is 0; hidden ones become 0."""
    return _centre(W, visible)[0]


def _centre(W: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centred points and the number of visible ones, at least 1: (N,1,1)."""
    seen = visible[:, None]
    count = np.maximum(seen.sum(2, keepdims=True), 1)
    W = np.where(seen, W, 0.0)
    W -= W.sum(2, keepdims=True) / count
    return np.where(seen, W, 0.0), count


def normalise(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Centre image points (N,2,P) and scale the visible ones to an rms distance of 1 from their mean; hidden are 0."""
    W, count = _centre(W, visible)
    size = np.sqrt((W * W).sum((1, 2), keepdims=True) / count)
    return W / np.where(size > 0, size, 1.0)


def upright(W: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Turn image points into one standard orientation, and mirror them to one side.

    To an orthographic camera a turned image is one of a camera that rolled, and a mirrored image is one from behind.
    The shape is the same, so the encoder need not learn them.

    Args:
        W: (N,2,P) image points.
        axes: (2,P) weights. The sum of points under the first comes to point along y; under the second its x is
            positive.
    """
    direction = W @ axes[0]
    x, y = (direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)).T
    turned = np.stack([np.stack([y, -x], 1), np.stack([x, y], 1)], 1) @ W
    turned[turned[:, 0] @ axes[1] < 0, 0] *= -1
    return turned


# --- shapes


def to_centre(S: np.ndarray, layout: Layout) -> np.ndarray:
    """Move shapes (N,3,P) so that the mean of their points is 0, in each category."""
    centred = np.empty_like(S)
    for part in layout.parts:
        centred[:, :, part.columns] = _about_mean(S[:, :, part.columns])
    return centred


def to_unit_size(S: np.ndarray, layout: Layout) -> np.ndarray:
    """Centre shapes (N,3,P) and scale them to model units, in each category.

    The size of a shape seen by weak perspective is free. If the layout has edges, their mean length is 1, because
    bones keep their lengths when a body moves. Otherwise the rms distance of the points to their mean is 1.
    """
    sized = np.empty_like(S)
    for part in layout.parts:
        points = _about_mean(S[:, :, part.columns])
        if part.edges:
            ends = S.take(part.ends, axis=2)
            bones = ends[:, :, 0] - ends[:, :, 1]
            size = np.sqrt((bones * bones).sum(1)).sum(1) / len(part.edges)
        else:
            size = np.sqrt((points * points).sum((1, 2)) / len(part.points))
        sized[:, :, part.columns] = points / np.maximum(size, 1e-6)[:, None, None]
    return sized


def _about_mean(points: np.ndarray) -> np.ndarray:
    return points - points.sum(2, keepdims=True) / points.shape[2]
