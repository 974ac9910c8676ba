# SPDX-License-Identifier: Apache-2.0
"""The training frames on the device of the networks."""

from __future__ import annotations

import torch
from torch import Tensor

from training.data import TrainingData
from training.recipe import Recipe
from training.views import NormalisedViews


class Frames:
    """Image points of all training frames as tensors, normalised as the recipe says.

    Attributes:
        W: (F,2,P) image points, as in ``TrainingData``.
        visible: (F,P) bool.
        detected: (F,2,P) points of a detector, or None.
        layout: of the points.
        device: of the tensors.
    """

    def __init__(self, data: TrainingData, recipe: Recipe, device: torch.device) -> None:
        self.W = torch.from_numpy(data.W).to(device)
        self.visible = torch.from_numpy(data.visible).to(device)
        self.detected = None if data.detected is None else torch.from_numpy(data.detected).to(device)
        self.layout, self.device = data.layout, device
        self._perspective = data.calibrated and recipe.perspective and recipe.scale == "free"
        self._unit = data.image_unit if recipe.scale == "unit" else None

    def __len__(self) -> int:
        return len(self.W)

    def views(self, rows: Tensor) -> NormalisedViews:
        """Return frames by their numbers (N,), without augmentation."""
        rows = rows.to(self.device)
        facing = torch.ones(len(rows), 1, 1, device=self.device)
        return self.normalised(self.W[rows], self.visible[rows], facing)

    def normalised(self, image: Tensor, visible: Tensor, facing: Tensor) -> NormalisedViews:
        """Normalise image points (N,2,P) that show these frames' object."""
        return NormalisedViews.of(image, visible, facing, self._perspective, self._unit)
