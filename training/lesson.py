# SPDX-License-Identifier: Apache-2.0
"""The lesson: canonical shapes that the networks learn to give, a start's or their own held solutions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from paul_ros.layout import Layout
from paul_ros.metrics import procrustes
from training.frames import Frames
from training.networks import Paul, to_centre, to_unit_size
from training.objective import fit
from training.recipe import Recipe
from training.start.search import START_UNIT
from training.start.start import Start
from training.views import NormalisedViews

_NEAREST = 0.2
"""Least distance of a point from the camera, as a share of the object's distance. Early shapes may come nearer."""

_FRAMES_AT_ONCE = 1000
"""Frames whose lower level is solved together."""


class Lesson:
    """Canonical shapes with the cameras that saw them.

    Attributes:
        rows: (n,) numbers of the frames.

    Args:
        shapes: (n,3,P) float32 in one canonical frame, of any scale.
        rotations: (n,3,3) float32, from the canonical to the camera frame.
        rows: (n,) numbers of the frames.
        sizes: (n,1,1) image units per unit of the shapes.
        perspective: the images are rays of pinhole cameras; sizes are then inverse distances.
        layout: of the points.
        scale: the recipe's.
    """

    def __init__(
        self,
        shapes: Tensor,
        rotations: Tensor,
        rows: Tensor,
        sizes: Tensor,
        perspective: bool,
        layout: Layout,
        scale: str,
    ) -> None:
        self._shapes = to_unit_size(shapes, layout) if scale == "free" else to_centre(shapes, layout)
        self._cameras = rotations
        before, after = (S.flatten(1).norm(dim=1)[:, None, None] for S in (to_centre(shapes, layout), self._shapes))
        self._sizes = sizes * before / after
        self._nearness = self._sizes if perspective else torch.zeros_like(self._sizes)
        self._symmetry = torch.from_numpy(symmetry(shapes.cpu().numpy(), layout)).to(shapes)
        self._mirror = list(layout.mirror)
        self.rows = rows

    @classmethod
    def of(cls, start: Start, views: NormalisedViews, layout: Layout, scale: str) -> Lesson:
        """Return the lesson of a start; ``views`` are those of its frames."""
        shapes, rotations = (torch.from_numpy(array).to(views.W) for array in (start.shapes, start.rotations))
        sizes = START_UNIT[scale] * views.size
        return cls(shapes, rotations, torch.from_numpy(start.rows), sizes, views.calibrated, layout, scale)

    def __len__(self) -> int:
        return len(self.rows)

    def shapes_of(self, chosen: Tensor, exchanged: Tensor | None) -> Tensor:
        """Return shapes (N,3,P).

        Args:
            chosen: (N,) indices into the lesson.
            exchanged: (N,1,1) bool, shapes whose left and right are exchanged; None: no shape's are.
        """
        S = self._shapes[chosen.to(self._shapes.device)]
        return S if exchanged is None else torch.where(exchanged, self._symmetry @ S[:, :, self._mirror], S)

    def seen_by(self, cameras: Tensor, S: Tensor) -> Tensor:
        """Project shapes S (N,3,P) into the cameras of other frames.

        A shape is the same from every side, and these cameras and distances occur in the data.

        Args:
            cameras: (N,) indices into the lesson.
            S: (N,3,P) canonical shapes.

        Returns:
            Image points (N,2,P), image units.
        """
        cameras = cameras.to(S.device)
        X, sizes, nearness = self._cameras[cameras] @ S, self._sizes[cameras], self._nearness[cameras]
        return sizes * X[:, :2] / (1 + nearness * X[:, 2:]).clamp_min(_NEAREST)


@torch.no_grad()
def held_solutions(networks: Paul, recipe: Recipe, frames: Frames, worst_share: float = 0.0) -> Lesson:
    """Solve the lower level for all frames: R^T [W; z] of equations 8-10 and 14, to be learned for a while.

    Args:
        networks: whose shapes are fitted.
        recipe: of the run.
        frames: all training frames.
        worst_share: share of the frames, those of largest error, that is left out.
    """
    parts = []
    for rows in torch.arange(len(frames)).split(_FRAMES_AT_ONCE):
        views = frames.views(rows)
        found = fit(networks, recipe, views, rows.to(frames.device))
        error = (found.streams.mean(0) - found.points).flatten(1).norm(dim=1)
        parts.append((found.camera.R.mT @ found.points, found.camera.R, views.size, error))
    shapes, cameras, sizes, errors = map(torch.cat, zip(*parts))
    rows = errors.argsort()[: len(frames) - int(worst_share * len(frames))].sort().values
    return Lesson(shapes[rows], cameras[rows], rows.cpu(), sizes[rows], views.calibrated, frames.layout, recipe.scale)


def symmetry(shapes: np.ndarray, layout: Layout) -> np.ndarray:
    """Return the reflection (3,3) of the mean of shapes (n,3,P).

    It takes the mean shape with left and right exchanged onto the mean shape as well as any reflection does.
    """
    mean = shapes.mean(0, dtype=np.float64)
    exchanged = np.diag([-1.0, 1.0, 1.0]) @ mean[:, layout.mirror]
    R, _ = procrustes(exchanged.T[None], mean.T[None])
    return (R[0] @ np.diag([-1.0, 1.0, 1.0])).astype(np.float32)
