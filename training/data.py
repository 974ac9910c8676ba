# SPDX-License-Identifier: Apache-2.0
"""The trainer's data: 2D keypoints with visibility, and nothing else."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from paul_ros.layout import Layout
from paul_ros.normalisation import centre

DEFAULT_LAYOUT = "coco17"
"""Layout of 17 points and of bags, if none is named."""

_BLOCK = 1024
"""Frames that are processed together: dense data is large, and a copy of it larger still."""


@dataclass(frozen=True)
class RawFrames:
    """2D frames as a file holds them, before any check of their values.

    Attributes:
        W: (G,2,P) image points, anything where hidden.
        visible: (G,P) bool.
        layout: of the points.
        calibrated: W are rays, see ``TrainingData``.
        detected: (G,2,P) or None, see ``TrainingData``.
        notes: oddities of the file, a sentence each.
    """

    W: np.ndarray
    visible: np.ndarray
    layout: Layout
    calibrated: bool
    detected: np.ndarray | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainingData:
    """2D frames of one layout, checked.

    Attributes:
        W: (F,2,P) float32 image points, any unit, y down; 0 where hidden.
        visible: (F,P) bool.
        layout: of the points.
        calibrated: W are rays, (x/z, y/z) of a pinhole camera turned to the object; else pixels or any unit.
        source: file name, for provenance.
        used: (G,) bool over the given frames: True for the F that show enough points to be lifted.
        notes: oddities of the data that do not forbid training, a sentence each.
        detected: (F,2,P) float32 or None: the same points as a detector reports them, NaN where it reports none. With
            held solutions h learns to read such views; the objective always explains W.
    """

    W: np.ndarray
    visible: np.ndarray
    layout: Layout
    calibrated: bool
    source: str
    used: np.ndarray
    notes: tuple[str, ...] = ()
    detected: np.ndarray | None = None

    @property
    def left_out(self) -> int:
        """Number of frames with too few visible points, or with all of them on one line."""
        return int((~self.used).sum())

    @cached_property
    def image_unit(self) -> float:
        """Root mean square of the visible coordinates about their frame's mean: the unit of data of one fixed scale."""
        squares = sum(
            float((centre(self.W[rows], self.visible[rows]).astype(float) ** 2).sum()) for rows in blocks(len(self.W))
        )
        return math.sqrt(squares / (2 * int(self.visible.sum())))

    @property
    def sha256(self) -> str:
        """Digest of the arrays; checkpoints and starts belong to it."""
        digest = hashlib.sha256(np.ascontiguousarray(self.W).data)
        digest.update(np.packbits(self.visible).tobytes())
        if self.detected is not None:
            digest.update(np.ascontiguousarray(self.detected).data)
        return digest.hexdigest()


def blocks(frames: int) -> Iterator[slice]:
    """Yield slices that cover so many frames, a limited number each."""
    return (slice(begin, begin + _BLOCK) for begin in range(0, frames, _BLOCK))
