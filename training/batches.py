# SPDX-License-Identifier: Apache-2.0
"""Random batches of training views, augmented as the recipe says."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from training.distributed import Share, share_of
from training.frames import Frames
from training.lesson import Lesson
from training.recipe import Recipe
from training.views import NormalisedViews, turned_views

_AS_MARKED = 0.3
"""Share of a batch of held solutions that is seen without the detector's errors, as the lower level sees all frames."""


@dataclass(frozen=True)
class Batch:
    """This process's share of a batch.

    Attributes:
        views: (N) views.
        rows: (N,) numbers of the frames.
        goal: (N,3,P) canonical shapes to be learned; None in the unsupervised phase.
        share: which part of the whole batch these N are.
    """

    views: NormalisedViews
    rows: Tensor
    goal: Tensor | None
    share: Share


class BatchSampler:
    """Draws batches; equal states of the generator give equal batches on all devices and numbers of processes.

    Views are turned and mirrored anew in every batch. Canonical shapes stay as they are, except those of mirrored
    objects, which are mirrored as well.

    Args:
        frames: the training frames.
        recipe: of the run.
        generator: on the CPU.
    """

    def __init__(self, frames: Frames, recipe: Recipe, generator: torch.Generator) -> None:
        self._frames, self._recipe, self._generator = frames, recipe, generator
        self._mirror = torch.tensor(frames.layout.mirror, device=frames.device)

    def draw(self, lesson: Lesson | None) -> Batch:
        """Draw a batch.

        Held solutions are seen by the cameras of other frames, with the points visible there. A frame of wrong depth
        thus does not teach that depth to itself, and a shape gets one code whatever is hidden.

        Args:
            lesson: the shapes to be learned; None in the unsupervised phase.
        """
        recipe, frames = self._recipe, self._frames
        pool = len(frames) if lesson is None else len(lesson)
        size = recipe.batch or pool
        chosen = torch.randint(pool, (size,), generator=self._generator) if recipe.batch else torch.arange(pool)
        rows = (chosen if lesson is None else lesson.rows[chosen]).to(frames.device)
        # index_select is faster than [rows].
        W, visible = frames.W.index_select(0, rows), frames.visible.index_select(0, rows)
        exchanged = None
        if recipe.mirror_object:
            exchanged = (self._uniform(size) < 0.5)[:, None, None]
            W, visible = self._exchanged(W, visible, exchanged)
        goal = None if lesson is None else lesson.shapes_of(chosen, exchanged)
        if lesson is not None and goal is not None and recipe.hold:
            others = torch.randint(pool, (size,), generator=self._generator)
            W, visible = self.detected_as(lesson.rows[others].to(frames.device), lesson.seen_by(others, goal))
        facing = torch.ones(size, 1, 1, device=frames.device)
        if recipe.roll or recipe.mirror_view:
            turn, facing = self._turns(size)
            W = turn @ W
        share = share_of(size)
        goal = None if goal is None else goal[share.part]
        return Batch(frames.normalised(W, visible, facing)[share.part], rows[share.part], goal, share)

    def detected_as(self, rows: Tensor, W: Tensor) -> tuple[Tensor, Tensor]:
        """Give views the hidden points and the detector's errors of other frames.

        Args:
            rows: (N,) numbers of the other frames.
            W: (N,2,P) image points.

        Returns:
            Image points (N,2,P) and visibility (N,P).
        """
        frames = self._frames
        visible = frames.visible.index_select(0, rows)
        if frames.detected is None:
            return W, visible
        error = frames.detected.index_select(0, rows) - frames.W.index_select(0, rows)
        marked = self._uniform(len(rows), 1) < _AS_MARKED
        visible = torch.where(marked, visible, error.isfinite().all(1))
        return W + torch.where(marked[..., None], 0.0, error.nan_to_num(0.0)), visible

    def _exchanged(self, W: Tensor, visible: Tensor, exchanged: Tensor) -> tuple[Tensor, Tensor]:
        """Mirror views (N,2,P) of a symmetric object: left and right points change places where asked (N,1,1)."""
        flip = torch.tensor([[-1.0], [1.0]], device=W.device)
        W = torch.where(exchanged, W[:, :, self._mirror] * flip, W)
        return W, torch.where(exchanged[:, 0], visible[:, self._mirror], visible)

    def _turns(self, size: int) -> tuple[Tensor, Tensor]:
        """Draw in-plane turns (N,2,2), half of them mirrored if the recipe says so, and their facing (N,1,1)."""
        angle = (2 * self._uniform(size) - 1) * self._recipe.roll
        mirrored = self._uniform(size) < (0.5 if self._recipe.mirror_view else 0.0)
        return turned_views(angle, mirrored)

    def _uniform(self, *shape: int) -> Tensor:
        # Drawn on the CPU, so that all devices and numbers of processes get the same.
        return torch.rand(shape, generator=self._generator).to(self._frames.device)
