# SPDX-License-Identifier: Apache-2.0
"""Model of an imperfect keypoint detector: heavy-tailed errors, left-right swaps, confidences, layouts. NumPy only.

Errors of level 1 are those of a stacked-hourglass detector, measured on 58,000 images of people.  They are in per cent
of the person's height in the image:

| points | median | 90 % below | 99 % below |
|---|---|---|---|
| hips, thorax, shoulders | 2.3-3.6 | 6-9 | 22-26 |
| elbows, knees | 2.4-3.3 | 9-13 | 29-35 |
| wrists, ankles | 2.2-5.4 | 13-14 | 43-47 |

Left and right are swapped in 0.5-0.7 % of limb pairs, for ankles in 1.25 %.  Annotation sets differ in the definition
of points: hips by 2 %, shoulders by 1 %, heads by 7 % of the height.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from training.people.human_points import human_layout, human_mapping
from training.people.view_settings import COMPLETE, ViewSettings

# Mixtures of three Gaussians: shares, and standard deviations in per cent of the height.  They are fitted so that
# errors, with occlusion, swaps and definitions, are those above.
_TRUNK = ((0.795, 0.170, 0.035), (1.85, 5.0, 14.0))
_MIDDLE = ((0.732, 0.215, 0.053), (1.84, 6.6, 17.0))
_END = ((0.700, 0.220, 0.080), (2.25, 6.8, 21.7))
# Annotators agree on faces three times as well as on shoulders and hips (constants of COCO's keypoint evaluation).
_FACE = ((0.795, 0.170, 0.035), (0.62, 1.7, 14.0))
_GROUPS = {
    _TRUNK: ("head", "head_top", "neck", "thorax", "spine", "pelvis", "shoulder", "hip"),
    _MIDDLE: ("elbow", "knee"),
    _END: (
        *("wrist", "index_knuckle", "pinky_knuckle", "thumb_knuckle"),
        *("ankle", "heel", "big_toe", "small_toe", "foot_index"),
    ),
    _FACE: ("nose", "eye", "eye_inner", "eye_outer", "ear", "mouth_corner"),
}
_CLEAR, _GUESSED = 0.9, 1.5  # factors on small errors of visible and of occluded points
# Points that are swapped together, and the probability.
_SWAPS = (
    (("eye", "eye_inner", "eye_outer", "ear", "mouth_corner"), 0.006),
    (("shoulder",), 0.006),
    (("elbow",), 0.006),
    (("wrist", "index_knuckle", "pinky_knuckle", "thumb_knuckle"), 0.006),
    (("hip",), 0.006),
    (("knee",), 0.006),
    (("ankle", "heel", "big_toe", "small_toe", "foot_index"), 0.0125),
)
# Definitions: root mean square of the offset in per cent of stature, its number of directions, the points that share
# it.  Points of the middle stay in the middle.
_DEFINITIONS = (
    (2.0, 3, ("hip", "pelvis")),
    (1.0, 3, ("shoulder", "neck")),
    (7.0, 2, ("head", "head_top")),
)
# Log odds of a confidence.  With these figures nearly all good points and half of the gross errors are above 0.3, as
# real detectors are confident of some of their errors.
_PERFECT_ODDS = 2.6  # log odds of a point without error
_ODDS_PER_ERROR = 0.16  # less for each per cent of error ...
_MAX_ERROR = 20.0  # ... up to this error
_ODDS_PER_GUESS = 0.8  # less for an occluded point
_ODDS_SCATTER = 0.9  # standard deviation


@dataclass(frozen=True)
class Detections:
    """The output of a detector for N bodies, in the layout ``human``.

    Attributes:
        xy: (N,P,2) pixels; also defined for points that are not visible.
        confidence: (N,P) from 0 to 1; also defined for points that are not visible.
        visible: (N,P) whether the point is reported with at least the minimum confidence.
    """

    xy: np.ndarray
    confidence: np.ndarray
    visible: np.ndarray


def redefined(points: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Move points to where another annotation set would mark them.

    Offsets are systematic: fixed to the body and equal on both sides.  They are drawn anew for each body, because the
    definitions of future detectors are unknown.

    Args:
        points: (N,P,3) bodies, metres.
        level: (N,) scale of the offsets.
        rng: source of randomness.
    """
    axes, stature = _body_axes(points)
    points = points.copy()
    for share, directions, parts in _DEFINITIONS:
        rms = level[:, None] * stature * share / 100 / np.sqrt(directions)
        offset = rms * rng.standard_normal((len(points), 3))
        for point in _points(parts):
            own = offset * [_LATERAL[human_layout().sides[point]], 1, 1]
            points[:, point] += (own[:, None] @ axes)[:, 0]
    return points


_LATERAL = {"left": 1.0, "right": -1.0, "": 0.0}


def _body_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the trunk's axes (N,3,3) in rows (left, up, forward), and stature (N,1), taken as 3.3 trunk lengths."""
    place = human_layout().names.index
    up = points[:, place("neck")] - points[:, place("pelvis")]
    trunk = np.linalg.norm(up, axis=1, keepdims=True)
    up = up / trunk
    left = points[:, place("left_shoulder")] - points[:, place("right_shoulder")]
    left = left - (left * up).sum(1, keepdims=True) * up
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
    return np.stack([left, up, np.cross(left, up)], axis=1), 3.3 * trunk


def detect(
    xy: np.ndarray,
    height: np.ndarray,
    occluded: np.ndarray,
    level: np.ndarray,
    views: ViewSettings,
    rng: np.random.Generator,
) -> Detections:
    """Simulate the detection of all points of ``human``.

    Args:
        xy: (N,P,2) true positions, pixels.
        height: (N,) of the bodies in the image, pixels.
        occluded: (N,P) whether the body itself hides the point.
        level: (N,) of the errors.
        views: minimum confidence, and the share of occluded points that are reported.
        rng: source of randomness.
    """
    error = _errors(occluded, level, rng)
    size = np.hypot(error[..., 0], error[..., 1])
    odds = (
        _PERFECT_ODDS
        - _ODDS_PER_ERROR * np.minimum(size, _MAX_ERROR)
        + level[:, None] * (_ODDS_SCATTER * rng.standard_normal(size.shape) - _ODDS_PER_GUESS * occluded)
    )
    found = xy + height[:, None, None] / 100 * error
    confidence = 1 / (1 + np.exp(-odds))
    lost = occluded & (rng.random(size.shape) < (1 - views.guessed) * level[:, None])
    visible = (confidence >= views.min_confidence) & ~lost
    return Detections(*_swap_sides((found, confidence, visible), level, rng))


def _errors(occluded: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw errors (N,P,2) in per cent of the height; the level scales small errors and the share of large ones."""
    shares, sizes = _mixture()
    u = rng.random(occluded.shape)
    worst = u < shares[:, 2] * level[:, None]
    worse = u < (shares[:, 2] + shares[:, 1]) * level[:, None]
    size = np.where(worse, sizes[:, 1], sizes[:, 0] * level[:, None]) * np.where(occluded, _GUESSED, _CLEAR)
    size = np.where(worst, sizes[:, 2], size)
    return size[..., None] * rng.standard_normal((*size.shape, 2))


def _swap_sides(arrays: tuple[np.ndarray, ...], level: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Swap left and right of a few limbs in each of the arrays (N,P,...); confidences do not show it."""
    swapped = np.zeros(arrays[1].shape, bool)
    for parts, share in _SWAPS:
        swapped[:, _points(parts)] = (rng.random(len(level)) < share * level)[:, None]
    mirror = human_layout().mirror
    return [
        np.where(swapped.reshape(*swapped.shape, *(1,) * (array.ndim - 2)), array[:, mirror], array) for array in arrays
    ]


@cache
def _mixture() -> tuple[np.ndarray, np.ndarray]:
    """Return shares and standard deviations (P,3) of each point's mixture."""
    groups = np.zeros((2, len(human_layout().names), 3))
    for (shares, sizes), parts in _GROUPS.items():
        groups[0, _points(parts)], groups[1, _points(parts)] = shares, sizes
    return groups[0], groups[1]


@cache
def _points(parts: tuple[str, ...]) -> list[int]:
    """Return the indices of the named parts on both sides."""
    return [
        index
        for index, (name, side) in enumerate(zip(human_layout().names, human_layout().sides))
        if name.removeprefix(f"{side}_") in parts
    ]


def reported(found: Detections, layouts: np.ndarray, views: ViewSettings) -> Detections:
    """Keep the points of each detector's layout, and those that are derived from them as means.

    Points are mapped by ``Layout.map_to``, as in the node.

    Args:
        found: detections of all points of ``human``.
        layouts: (N,) indices of ``views.layouts``, one a detector.
        views: names of the layouts.
    """
    xy, confidence, visible = found.xy.copy(), found.confidence.copy(), found.visible.copy()
    for index, (name, _) in enumerate(views.layouts):
        rows = np.flatnonzero(layouts == index)
        if name == COMPLETE or not len(rows):
            continue
        mapping = human_mapping(name)
        own = np.array([human_layout().names.index(point) for point in mapping.source.names])
        mapped = mapping(*(array[np.ix_(rows, own)] for array in (found.xy, found.confidence, found.visible)))
        xy[rows] = np.where(np.isfinite(mapped[0]), mapped[0], xy[rows])
        confidence[rows], visible[rows] = mapped[1], mapped[2]
    return Detections(xy, confidence, visible)
