# SPDX-License-Identifier: Apache-2.0
"""The one-euro filter over time, for every person by its id; outside of PAUL, which lifts each frame for itself.

G. Casiez, N. Roussel and D. Vogel, 1 Euro Filter: A Simple Speed-based Low-pass Filter for Noisy Input in Interactive
Systems, CHI 2012. A low-pass filter whose cut-off rises with speed: at rest it takes the jitter away, in motion it does
not lag behind. Here the speed is that of a point in space, in sizes of its person per second, so that one setting does
for metres and model units, children and adults.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from paul_ros.lifted import Lifted

SPEED_COEFFICIENT = 2.0
"""Hz that the cut-off rises by at a speed of one size per second; a person's size is the rms distance of its points
from their mean. With 1 Hz at rest the accelerations in the bags fall from 58 to 23 mm a frame squared with noise, 13 to
9 without (truth: 3 and 5), and N-MPJPE changes by less than a millimetre; half the coefficient lags behind."""

SPEED_CUTOFF = 1.0
"""Hz, of the speed's own filter; the paper's."""

FORGET_SECONDS = 0.5
"""A person that was not lifted for longer starts anew."""


class _Track(NamedTuple):
    """stamp in ns; points (P,3) and their speeds (P,3) per second, both filtered."""

    stamp: int
    points: np.ndarray
    speed: np.ndarray


class OneEuro:
    """cutoff: Hz, of a person at rest; 0 = the filter is off."""

    def __init__(self, cutoff: float = 0.0) -> None:
        self.cutoff = cutoff
        self._tracks: dict[str, _Track] = {}
        self._stamp, self._units, self._swept = 0, "", 0

    def __call__(self, ids: tuple[str, ...], stamp: int, lifted: Lifted, root: tuple[int, ...]) -> Lifted:
        """Persons with their points filtered, and their roots, means of the points `root`; without an id as they are.

        All start anew where time runs backwards, as when a bag loops, or is not told (0), or the units are others.
        """
        if stamp < self._stamp or not stamp or lifted.units != self._units or not self.cutoff:
            self._tracks.clear()
        self._stamp, self._units = stamp, lifted.units
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
        """Forgets the persons who left, from time to time: detectors count ids upwards for as long as they run."""
        longest = int(FORGET_SECONDS * 1e9)
        if not 0 <= self._stamp - self._swept <= longest:
            self._swept = self._stamp
            self._tracks = {name: track for name, track in self._tracks.items() if self._stamp - track.stamp <= longest}

    def _step(self, track: _Track | None, stamp: int, points: np.ndarray) -> _Track:
        seconds = (stamp - track.stamp) / 1e9 if track else 0.0
        if not 0 < seconds <= FORGET_SECONDS:
            return _Track(stamp, points.copy(), np.zeros_like(points))
        speed = track.speed + _share(SPEED_CUTOFF, seconds) * ((points - track.points) / seconds - track.speed)
        size = np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())
        cutoff = self.cutoff + SPEED_COEFFICIENT * np.linalg.norm(speed, axis=1, keepdims=True) / max(size, 1e-12)
        return _Track(stamp, track.points + _share(cutoff, seconds) * (points - track.points), speed)


def _share(cutoff, seconds: float):
    """Of a new value in a low-pass filter of first order."""
    return 1.0 / (1.0 + 1.0 / (2 * np.pi * cutoff * seconds))
