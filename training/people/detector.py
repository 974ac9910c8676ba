# SPDX-License-Identifier: Apache-2.0
"""An imperfect detector of keypoints: errors with heavy tails, exchanged sides, confidences, one layout's points.

At level 1 errors are as those of a stacked-hourglass detector, measured on 58,000 images of people, in per cent of the
person's height in the image: hips, thorax and shoulders have a median of 2.3-3.6, 90 % are below 6-9 and 99 % below
22-26; elbows and knees 2.4-3.3, 9-13, 29-35; wrists and ankles 2.2-5.4, 13-14, 43-47.  Left and right are exchanged in
0.5-0.7 % of limb pairs, of ankles in 1.25 %.  Annotation sets differ in where a point is: hips by 2 %, shoulders by
1 %, heads by 7 % of the height.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from training.people.mocap import human_layout, human_mapping
from training.people.view_settings import COMPLETE, Views

# Mixtures of three Gaussians: shares, and standard deviations in per cent of the height.  Fitted so that, with what the
# body hides, exchanged sides and definitions, errors are those above.
_TRUNK = ((0.795, 0.170, 0.035), (1.85, 5.0, 14.0))
_MIDDLE = ((0.732, 0.215, 0.053), (1.84, 6.6, 17.0))
_END = ((0.700, 0.220, 0.080), (2.25, 6.8, 21.7))
# Annotators agree on faces three times as well as on shoulders and hips (the constants of COCO's keypoint evaluation).
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
_CLEAR, _GUESSED = 0.9, 1.5  # factors on small errors of points that are in sight, and of those that are not
# What is exchanged together, and how often.
_SWAPS = (
    (("eye", "eye_inner", "eye_outer", "ear", "mouth_corner"), 0.006),
    (("shoulder",), 0.006),
    (("elbow",), 0.006),
    (("wrist", "index_knuckle", "pinky_knuckle", "thumb_knuckle"), 0.006),
    (("hip",), 0.006),
    (("knee",), 0.006),
    (("ankle", "heel", "big_toe", "small_toe", "foot_index"), 0.0125),
)
# Definitions: root mean square of the offset in per cent of stature, in how many directions, the points that share it.
# Points of the middle stay there.
_DEFINITIONS = (
    (2.0, 3, ("hip", "pelvis")),
    (1.0, 3, ("shoulder", "neck")),
    (7.0, 2, ("head", "head_top")),
)
# Log odds of a confidence: of a perfect point, less for each per cent of error up to so many, less for a guess, and
# their scatter.  So nearly all good points and half of the wild ones are above 0.3: some errors look sound.
_SURE, _PER_ERROR, _MOST, _PER_GUESS, _SCATTER = 2.6, 0.16, 20.0, 0.8, 0.9


@dataclass(frozen=True)
class Detections:
    """What a detector says of N bodies, in the layout ``human``.

    Attributes:
        xy: (N,P,2) pixels; something also where it is not visible.
        confidence: (N,P), whether or not it is visible.
        visible: (N,P) reported with at least the confidence asked for.
    """

    xy: np.ndarray
    confidence: np.ndarray
    visible: np.ndarray


def redefined(points: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Bodies (N,P,3) in metres as another annotation set marks them: systematic, so the same on both sides.

    The offsets are fixed to the body and drawn for each of the N with its level (N,): nobody knows those of a detector
    that is yet to come.
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
    """Axes (N,3,3) of the trunk in rows, to the left, up, forward; and stature (N,1) taken as 3.3 trunks."""
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
    views: Views,
    rng: np.random.Generator,
) -> Detections:
    """Detect all points of ``human``.

    Args:
        xy: (N,P,2) where they are, pixels. height: (N,) of the body in the image, pixels. occluded: (N,P) hidden by
            the body itself. level: (N,) of the errors.
    """
    error = _errors(occluded, level, rng)
    size = np.hypot(error[..., 0], error[..., 1])
    odds = (
        _SURE
        - _PER_ERROR * np.minimum(size, _MOST)
        + level[:, None] * (_SCATTER * rng.standard_normal(size.shape) - _PER_GUESS * occluded)
    )
    found = xy + height[:, None, None] / 100 * error
    confidence = 1 / (1 + np.exp(-odds))
    lost = occluded & (rng.random(size.shape) < (1 - views.guessed) * level[:, None])
    visible = (confidence >= views.min_confidence) & ~lost
    return Detections(*_exchanged((found, confidence, visible), level, rng))


def _errors(occluded: np.ndarray, level: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(N,P,2) per cent of the height.  The level scales small errors, and the share of the large ones."""
    shares, sizes = _mixture()
    u = rng.random(occluded.shape)
    worst = u < shares[:, 2] * level[:, None]
    worse = u < (shares[:, 2] + shares[:, 1]) * level[:, None]
    size = np.where(worse, sizes[:, 1], sizes[:, 0] * level[:, None]) * np.where(occluded, _GUESSED, _CLEAR)
    size = np.where(worst, sizes[:, 2], size)
    return size[..., None] * rng.standard_normal((*size.shape, 2))


def _exchanged(arrays: tuple[np.ndarray, ...], level: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Left and right of a few limbs exchanged, in each of the arrays (N,P,...); the detector knows nothing of it."""
    swapped = np.zeros(arrays[1].shape, bool)
    for parts, share in _SWAPS:
        swapped[:, _points(parts)] = (rng.random(len(level)) < share * level)[:, None]
    mirror = human_layout().mirror
    return [
        np.where(swapped.reshape(*swapped.shape, *(1,) * (array.ndim - 2)), array[:, mirror], array) for array in arrays
    ]


@cache
def _mixture() -> tuple[np.ndarray, np.ndarray]:
    """Shares and sizes (P,3) of each point's mixture."""
    groups = np.zeros((2, len(human_layout().names), 3))
    for (shares, sizes), parts in _GROUPS.items():
        groups[0, _points(parts)], groups[1, _points(parts)] = shares, sizes
    return groups[0], groups[1]


@cache
def _points(parts: tuple[str, ...]) -> list[int]:
    """Indices of the named parts, of both sides."""
    return [
        index
        for index, (name, side) in enumerate(zip(human_layout().names, human_layout().sides))
        if name.removeprefix(f"{side}_") in parts
    ]


def reported(found: Detections, layouts: np.ndarray, views: Views) -> Detections:
    """What remains where each of N detectors reports one layout: its points, and those that are means of some.

    Mapped by ``Layout.map_to``, as the node does.  layouts: (N,) indices of ``views.layouts``.
    """
    xy, confidence, visible = found.xy.copy(), found.confidence.copy(), found.visible.copy()
    for index, (name, _) in enumerate(views.layouts):
        rows = np.flatnonzero(layouts == index)
        if name == COMPLETE or not len(rows):
            continue
        mapping = human_mapping(name)
        own = [human_layout().names.index(point) for point in mapping.source.names]
        mapped = mapping(*(array[np.ix_(rows, own)] for array in (found.xy, found.confidence, found.visible)))
        xy[rows] = np.where(np.isfinite(mapped[0]), mapped[0], xy[rows])
        confidence[rows], visible[rows] = mapped[1], mapped[2]
    return Detections(xy, confidence, visible)
