# SPDX-License-Identifier: Apache-2.0
"""Flips of tracked persons in depth from one frame to the next."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from paul_ros.offline.replay import LiftedFrame

_FLIP_SHARE = 0.3  # least movement of a flip, and least movement in the image that excuses it, over the person's size


class FlipCounter:
    """Counts how often the depth of a tracked person turns over from one frame to the next.

    Only persons with an id that are lifted in two successive frames, in the same units, are counted. The points are
    taken about their mean, and the previous pose is mirrored across the plane that faces the camera. It is a flip if

    - the person is nearer to its previous mirror image than to its previous pose,
    - it has moved by more than 30 % of its size, and
    - it has moved by less than 30 % of its size in the image.

    So a flip is a body that turns front to back, or one that takes its mirror image: the 2D shows neither.

    Attributes:
        pairs: number of persons in two successive frames.
        flips: number of flips among them.
        named: whether any lifted person had an id.
    """

    def __init__(self) -> None:
        self.pairs = self.flips = 0
        self.named = False
        self._before: dict[str, tuple[LiftedFrame, int]] = {}

    def add(self, frame: LiftedFrame) -> None:
        """Take the next frame."""
        now = {name: (frame, row) for row, name in enumerate(frame.keypoints.ids) if name and frame.lifted.ok[row]}
        self.named |= bool(now)
        for name in now:
            before = self._before.get(name)
            if before and before[0].lifted.units == frame.lifted.units:
                self.pairs += 1
                self.flips += _flipped(before, now[name])
        self._before = now

    def report(self) -> dict:
        """Return the figures, with the keys that `judge.evaluate` explains."""
        return {
            "pairs_of_frames": self.pairs,
            "flips_per_1000_frames": 1000 * self.flips / self.pairs if self.pairs else None,
        }


def count_flips(frames: Iterable[LiftedFrame]) -> dict:
    """Return the report of a `FlipCounter` on frames."""
    counter = FlipCounter()
    for frame in frames:
        counter.add(frame)
    return counter.report()


def _flipped(before: tuple[LiftedFrame, int], now: tuple[LiftedFrame, int]) -> bool:
    """Return whether a person, given as frame and row, flipped between two frames."""
    old, new = (_about_mean(frame.lifted.points[row]) for frame, row in (before, now))
    frame, row = before
    ray = _viewing_direction(*before)
    mirrored = old - 2 * (old @ ray)[:, None] * ray
    seen_twice = before[0].given.visible[before[1]] & now[0].given.visible[now[1]]
    images = [_about_mean(frame.given.xy[row][seen_twice]) for frame, row in (before, now)]
    still = np.linalg.norm(images[1] - images[0]) < _FLIP_SHARE * np.linalg.norm(images[0])
    moved = np.linalg.norm(new - old)
    return bool(still and np.linalg.norm(new - mirrored) < moved and moved > _FLIP_SHARE * np.linalg.norm(old))


def _viewing_direction(frame: LiftedFrame, row: int) -> np.ndarray:
    """Return the unit direction (3,) in which a person is seen; along z without a camera."""
    ray = np.array([0.0, 0.0, 1.0])
    if frame.lifted.units == "m":
        ray = frame.lifted.root[row]
    elif camera := frame.camera:
        # In model units the root is the origin.
        x, y = frame.given.xy[row][frame.given.visible[row]].mean(0)
        ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
    return ray / np.linalg.norm(ray, axis=-1)


def _about_mean(points: np.ndarray) -> np.ndarray:
    return points - points.mean(0)
