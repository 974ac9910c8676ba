# SPDX-License-Identifier: Apache-2.0
"""2D frames as the linear model sees them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

Array = TypeVar("Array", np.ndarray, Tensor)


@dataclass(frozen=True)
class Observations:
    """Centred image points of frames, and the moments that depend on them alone.

    Attributes:
        W: (F,2,P) float64, each frame centred on its visible points, 0 where hidden; all frames have one scale.
        visible: (F,P) bool.
    """

    W: Tensor
    visible: Tensor

    @classmethod
    def of(cls, W: np.ndarray, visible: np.ndarray) -> Observations:
        """Centre image points (F,2,P); hidden ones may have any value."""
        mask = torch.as_tensor(visible)
        seen = mask[:, None]
        points = torch.where(seen, torch.as_tensor(W).double(), 0.0)
        centre = points.sum(2, keepdim=True) / seen.sum(2, keepdim=True)
        return cls(torch.where(seen, points - centre, 0.0), mask)

    def __len__(self) -> int:
        return len(self.W)

    def __getitem__(self, rows: np.ndarray) -> Observations:
        return Observations(self.W[rows], self.visible[rows])

    @property
    def points(self) -> int:
        """P."""
        return self.W.shape[2]

    def completed(self, S: Tensor) -> Tensor:
        """Return shapes (F,3,P) in camera frame with x and y of visible points replaced by the observed ones."""
        return torch.cat([torch.where(self.visible[:, None], self.W, S[:, :2]), S[:, 2:]], 1)

    @cached_property
    def complete(self) -> bool:
        """True if no point is hidden: all frames then share the second moments of the bases."""
        return bool(self.visible.all())

    @cached_property
    def count(self) -> Tensor:
        """(F,) number of visible points, float64."""
        return self.visible.sum(1).double()

    @cached_property
    def products(self) -> Tensor:
        """(F,2,2) second moments of the image points."""
        return self.W @ self.W.transpose(1, 2)

    @cached_property
    def power(self) -> Tensor:
        """(F,) squared norms of the frames."""
        return self.W.square().sum((1, 2))


def centred_on_visible(S: Array, visible: Array) -> Array:
    """Return shapes (F,3,P), tensor or array, minus the mean of their visible (F,P) points."""
    points: Any = S  # NumPy and torch spell this arithmetic alike, which no type expresses
    shown: Any = visible[:, None]
    return points - (points * shown).sum(2, keepdims=True) / shown.sum(2, keepdims=True)
