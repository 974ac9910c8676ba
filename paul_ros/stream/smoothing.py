# SPDX-License-Identifier: Apache-2.0
"""The one-euro filter over time, for each person with an id. It is not part of PAUL, which lifts each frame on its own.

G. Casiez, N. Roussel and D. Vogel, 1 Euro Filter: A Simple Speed-based Low-pass Filter for Noisy Input in Interactive
Systems, CHI 2012. The cut-off of this low-pass filter rises with speed: it removes jitter at rest and does not lag in
motion. Here the speed is that of a point in space, in sizes of its person per second. So one setting serves metres and
model units, children and adults.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from paul_ros.lifted import Lifted

SPEED_COEFFICIENT = 2.0
"""Rise of the cut-off in Hz at a speed of one size per second; a person's size is the rms distance of its points from
their mean. With 1 Hz at rest the accelerations in the bags fall from 58 to 23 mm per frame squared with noise, and from
13 to 9 without (truth: 3 and 5). N-MPJPE changes by less than a millimetre. Half the coefficient lags behind."""

SPEED_CUTOFF = 1.0
"""Cut-off of the speed's own filter in Hz, as in the paper."""

FORGET_SECONDS = 0.5
"""Time after which the track of a person that was not lifted starts anew."""


class _Track(NamedTuple):
    """A filtered person: stamp in ns, points (P,3), and their speeds (P,3) per second."""

    stamp: int
    points: np.ndarray
    speed: np.ndarray


class OneEuro:
    """The filters of all persons.

    Attributes:
        cutoff: Hz, for a person at rest; 0 = the filter is off.
    """

    def __init__(self, cutoff: float = 0.0) -> None:
        self.cutoff = cutoff
        self._tracks: dict[str, _Track] = {}
        self._stamp, self._scene, self._swept = 0, ("", ""), 0

    def __call__(
        self, ids: tuple[str, ...], stamp: int, lifted: Lifted, root: tuple[int, ...], frame_id: str = ""
    ) -> Lifted:
        """Filter the points of persons with an id; their roots become the mean of the points `root`.

        All tracks start anew if time runs backwards, as when a bag loops, if the stamp is missing (0), or if the units
        or the frame changed.
        """
        scene = lifted.units, frame_id
        if stamp < self._stamp or not stamp or scene != self._scene or not self.cutoff:
            self._tracks.clear()
        self._stamp, self._scene = stamp, scene
        self._sweep()
        if not self.cutoff:
            return lifted
        points, roots = lifted.points.copy(), lifted.root.copy()
        for row in np.flatnonzero(lifted.ok):
            if ids[row]:
                self._tracks[ids[row]] = track = self._step(self._tracks.get(ids[row]), stamp, points[row])
                points[row] = track.points
                roots[row] = track.points[list(root)].mean(0)
        return replace(lifted, points=points, root=roots)

    def _sweep(self) -> None:
        """Forget persons who left, from time to time: detectors count ids upwards for as long as they run."""
        longest = int(FORGET_SECONDS * 1e9)
        if not 0 <= self._stamp - self._swept <= longest:
            self._swept = self._stamp
            self._tracks = {name: track for name, track in self._tracks.items() if self._stamp - track.stamp <= longest}

    def _step(self, track: _Track | None, stamp: int, points: np.ndarray) -> _Track:
        seconds = (stamp - track.stamp) / 1e9 if track else 0.0
        if track is None or not 0 < seconds <= FORGET_SECONDS:
            return _Track(stamp, points.copy(), np.zeros_like(points))
        speed = track.speed + _blend_factor(SPEED_CUTOFF, seconds) * ((points - track.points) / seconds - track.speed)
        size = np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())
        cutoff = self.cutoff + SPEED_COEFFICIENT * np.linalg.norm(speed, axis=1, keepdims=True) / max(size, 1e-12)
        return _Track(stamp, track.points + _blend_factor(cutoff, seconds) * (points - track.points), speed)


def _blend_factor(cutoff: np.ndarray | float, seconds: float) -> np.ndarray | float:
    """Return the blend factor (alpha) of a first-order low-pass filter: its cut-off in Hz, its step in seconds."""
    return 1.0 / (1.0 + 1.0 / (2 * np.pi * cutoff * seconds))
