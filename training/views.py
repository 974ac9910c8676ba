# SPDX-License-Identifier: Apache-2.0
"""2D views as the networks see them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class NormalisedViews:
    """Normalised image points of a batch, with the place and size that they had in the image.

    ``size * W + centre`` are the image points before normalisation.

    Attributes:
        W: (N,2,P) centred on the mean of the visible points, 0 where hidden. Its root mean square distance is 1. If all
            views have one scale, W is divided by one common number instead.
        visible: (N,P) bool.
        centre: (N,2,1) mean of the visible points, image units.
        size: (N,1,1) image units per unit of W.
        facing: (N,1,1) 1, or -1 for mirrored views: these show the object from behind, so near and far change places.
        calibrated: image points are rays, (x/z, y/z) of a pinhole camera turned to the object.
    """

    W: Tensor
    visible: Tensor
    centre: Tensor
    size: Tensor
    facing: Tensor
    calibrated: bool

    @classmethod
    def of(
        cls, image: Tensor, visible: Tensor, facing: Tensor, calibrated: bool, unit: float | None = None
    ) -> NormalisedViews:
        """Normalise image points (N,2,P); the torch twin of ``paul_ros.model.normalise``.

        Args:
            image: (N,2,P) image points.
            visible: (N,P) bool.
            facing: see the class.
            calibrated: see the class.
            unit: divisor of all views, image units; None divides each view by its own size.
        """
        seen = visible[:, None].to(image.dtype)
        count = seen.sum(2, keepdim=True)
        middle = (image * seen).sum(2, keepdim=True) / count
        offset = (image - middle) * seen
        if unit is None:
            size = (offset.square().sum((1, 2), keepdim=True) / count).sqrt().clamp_min(1e-9)
        else:
            size = torch.full_like(count, unit)
        return cls(offset / size, visible, middle, size, facing, calibrated)

    def __getitem__(self, part: slice) -> NormalisedViews:
        """Return some of the views."""
        return NormalisedViews(
            self.W[part],
            self.visible[part],
            self.centre[part],
            self.size[part],
            self.facing[part],
            self.calibrated,
        )


def turned_views(angle: Tensor, mirrored: Tensor) -> tuple[Tensor, Tensor]:
    """Return in-plane turns by angles (N,), with a mirrored x axis where asked.

    Args:
        angle: (N,) radians.
        mirrored: (N,) bool.

    Returns:
        Matrices (N,2,2), and ``facing`` (N,1,1) of ``NormalisedViews``.
    """
    cos, sin = angle.cos(), angle.sin()
    turn = torch.stack([torch.stack([cos, -sin], 1), torch.stack([sin, cos], 1)], 1)
    facing = torch.where(mirrored, -1.0, 1.0)[:, None]
    turn[:, 0] *= facing
    return turn, facing[:, None]
