# SPDX-License-Identifier: Apache-2.0
"""The training loop: batches of 2D frames in, trained networks out; resumable to the bit.

A run has up to three parts. A start is found (``training.start``), and the networks learn its shapes by regression.
They then minimise the paper's objective (equation 8, Wang and Lucey, CVPR 2021) over both levels at once. With
``Recipe.hold`` they minimise it over the upper level, while the solutions of the lower one are held for some steps.
In that case fresh networks may do it all again, starting from the solutions of the first.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from paul_ros.layout import Layout
from paul_ros.signals import delayed_signals, raise_signals
from training.batches import Batch, BatchSampler
from training.checkpoint import (
    LOG_COLUMNS,
    LOSSES,
    restore_checkpoint,
    run_identity,
    write_checkpoint,
)
from training.chirality import rule_share
from training.data import TrainingData
from training.distributed import is_first, processes
from training.errors import StartError, TrainingError
from training.frames import Frames
from training.lesson import Lesson, held_solutions
from training.networks import Paul, build_networks, main_axes
from training.objective import Terms, paul_terms, regression_terms
from training.optimiser import adam
from training.progress import Progress
from training.recipe import Recipe
from training.run_folder import CHECKPOINT
from training.schedule import REGRESSION, UNSUPERVISED, Schedule
from training.start import search
from training.start.kept_start import kept_start, start_identity
from training.start.start import Start
from training.views import NormalisedViews

_WORST_SHARE = 0.1
"""Share of the frames, the least explained ones, that is left out of the next generation's lesson."""

_AXES_VIEWS = 1000
"""Evenly chosen frames from which main axes are found."""

_LOG_EVERY = 100
_CHECKPOINT_SECONDS = 30.0

_GRADIENT_LIMIT = 1.0
"""Largest norm of a gradient, per square root of the number of points: the objective grows with it."""


class Trainer:
    """One run: data, recipe, and a folder for its files.

    The folder holds ``checkpoint.pt`` (tensors and plain values), ``log.csv`` and, unless the recipe starts from random
    weights, ``start.npz``. An interrupted and continued run gives the same weights to the bit as an uninterrupted one
    on the same machine (on a GPU as far as torch's deterministic algorithms reach).

    Under ``torchrun`` every process has its Trainer; only the first one touches the folder.

    Attributes:
        frames: the training frames, on ``device``.
        networks: on ``device``.
        start: the start after ``prepare``, of the chirality that the layout asks for; None for random weights.
        step: number of steps done.
        seconds: duration of these steps and of the search for the start.
        rows: of the log.
    """

    def __init__(self, data: TrainingData, recipe: Recipe, folder: Path, device: torch.device | str = "cpu") -> None:
        self.data, self.recipe, self.folder, self.device = data, recipe, folder, torch.device(device)
        if processes() > len(data.W) or 0 < recipe.batch < processes():
            raise TrainingError(f"{processes()} processes cannot share a batch of fewer frames: start fewer")
        self.frames, self.schedule = Frames(data, recipe, self.device), Schedule(recipe)
        self.generator = torch.Generator().manual_seed(recipe.seed)
        self._sampler = BatchSampler(self.frames, recipe, self.generator)
        self.step, self.seconds = 0, 0.0
        self.rows: list[tuple] = []
        self.networks = self._fresh_networks()
        self.optimizer = adam(self.networks, recipe)
        self._objective: nn.Module = _Objective(self.networks, data.layout, recipe)
        if processes() > 1:
            self._objective = nn.parallel.DistributedDataParallel(self._objective)
        self.start: Start | None = None
        self._lesson: Lesson | None = None
        self._teacher: dict[str, Tensor] | None = None  # weights of the networks that gave the held solutions

    @property
    def checkpoint(self) -> Path:
        """The checkpoint's file."""
        return self.folder / CHECKPOINT

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.schedule.steps

    @property
    def finished(self) -> bool:
        """True if all steps are done."""
        return self.step >= self.steps

    def views(self, rows: Tensor) -> NormalisedViews:
        """Return frames by their numbers (N,), without augmentation."""
        return self.frames.views(rows)

    def prepare(self, progress: Progress | None = None) -> None:
        """Find the recipe's start, or read the one that the folder keeps.

        Raises:
            TrainingError: there is no start, the folder's one is damaged, or it belongs to another run.
        """
        if self.recipe.start == "random" or self.start is not None:
            return
        identity = start_identity(self.data, self.recipe)
        try:
            start = kept_start(
                self.folder, identity, lambda: search.find_start(self.frames, self.recipe, progress), self.device
            )
        except StartError as error:
            raise TrainingError(str(error)) from error
        share = rule_share(start.shapes, self.data.layout)
        self.start = start.mirrored() if share is not None and share < 0.5 else start
        if self.step == 0:
            self.seconds = start.seconds
        if self.schedule.regression_steps:
            views = self.views(torch.from_numpy(self.start.rows))
            self._lesson = Lesson.of(self.start, views, self.data.layout, self.recipe.scale)

    def run(self) -> Generator[dict[str, Any], None, None]:
        """Train to the recipe's last step, yielding a row of the log after each step.

        A checkpoint is written at intervals, at the end, and when the caller stops iterating.

        Raises:
            TrainingError: the loss became infinite or NaN.
        """
        self.prepare()
        if self._teacher is not None:
            self._lesson = self._lesson_of(self._teacher)
        saved, begun = time.monotonic(), time.monotonic() - self.seconds
        try:
            while not self.finished:
                # A checkpoint of half a step would not continue to the bit.
                with delayed_signals() as received:
                    row = self._advance(begun)
                raise_signals(received)
                if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                    self.save()
                    saved = time.monotonic()
                yield row
        finally:
            self.save()

    def _advance(self, begun: float) -> dict[str, Any]:
        """Take one step of the paper's bilevel optimisation (equation 8)."""
        phase = self.schedule.phase(self.step)
        # Lower level for all frames, to be held: R and z of equations 9 and 10.
        if self.schedule.renews_solutions(self.step):
            self._renew_solutions()
        batch = self._sampler.draw(None if phase == UNSUPERVISED else self._lesson)
        # Lower level of the batch, unless it is held, and the losses of equations 6, 7 and 12.
        terms: Terms = self._objective(batch)
        # Upper level: a step in the weights of h, f_d and f_e.
        rate = self._descend(terms)
        self.step += 1
        self.seconds = time.monotonic() - begun
        row = self._row(terms, rate, phase)
        if self.step % _LOG_EVERY == 0 or self.schedule.ends_part(self.step):
            self.rows.append(row)
        return dict(zip(LOG_COLUMNS, row))

    def _descend(self, terms: Terms) -> float:
        """Take a step of Adam, with clipped gradients; return the learning rate."""
        factor = self.schedule.rate_factor(self.step)
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * factor
        loss = terms.loss.item()
        if not math.isfinite(loss):
            raise TrainingError(
                f"the loss is {loss} at step {self.step}: lower learning_rate in the recipe, "
                f"and look for frames with wrong points in '{self.data.source}'"
            )
        trained = [weights for group in self.optimizer.param_groups for weights in group["params"]]
        for weights in trained:
            weights.grad.zero_()
        terms.loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, _GRADIENT_LIMIT * self.data.W.shape[2] ** 0.5)
        self.optimizer.step()
        return self.recipe.learning_rate * factor

    def _row(self, terms: Terms, rate: float, phase: str) -> tuple:
        losses = (round(getattr(terms, name).item(), 6) for name in LOSSES)
        return (self.step, round(self.seconds, 2), *losses, round(rate, 8), phase)

    def _renew_solutions(self) -> None:
        """Make the networks' own solutions the lesson; at the beginning of a generation fresh networks learn it."""
        self._teacher = {name: weights.clone() for name, weights in self.networks.state_dict().items()}
        self._lesson = self._solutions()
        if self.schedule.begins_generation(self.step):
            self.networks.load_state_dict(self._fresh_networks().state_dict())
            self.optimizer.state.clear()

    def _solutions(self) -> Lesson:
        """Return the networks' solutions of the lower level; a new generation's lack the worst frames."""
        first_lesson = self.schedule.phase(self.step) == REGRESSION
        return held_solutions(self.networks, self.recipe, self.frames, _WORST_SHARE if first_lesson else 0.0)

    def _lesson_of(self, teacher: dict[str, Tensor]) -> Lesson:
        """Return the lesson of an interrupted run, from the weights that gave it."""
        weights = {name: values.clone() for name, values in self.networks.state_dict().items()}
        self.networks.load_state_dict(teacher)
        lesson = self._solutions()
        self.networks.load_state_dict(weights)
        return lesson

    def _fresh_networks(self) -> Paul:
        """Return networks with the random weights of the generation that begins."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.recipe.seed + self.step)
            networks = build_networks(self.data.layout, self.recipe, len(self.frames), self._axes())
        return networks.to(self.device)

    def _axes(self) -> Tensor | None:
        """Return the axes by which h brings views upright, if the recipe asks for it."""
        if not self.recipe.upright:
            return None
        rows = torch.linspace(0, len(self.frames) - 1, min(len(self.frames), _AXES_VIEWS)).long()
        return main_axes(self.views(rows).W, self.data.layout)

    def save(self) -> None:
        """Write checkpoint and log, each atomically."""
        if not is_first():
            return
        state = {
            "identity": run_identity(self.data, self.recipe),
            "networks": self.networks.state_dict(),
            "step": self.step,
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "seconds": self.seconds,
            "rows": [list(row) for row in self.rows],
            "teacher": self._teacher,
        }
        write_checkpoint(self.folder, state, self.rows)

    def resume(self) -> bool:
        """Continue from the folder's checkpoint; False if there is none.

        Raises:
            TrainingError: the checkpoint is damaged, or belongs to other data or another recipe.
        """
        return restore_checkpoint(self.folder, run_identity(self.data, self.recipe), self.device, self._restore)

    def _restore(self, state: dict[str, Any]) -> None:
        self.networks.load_state_dict(state["networks"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"].cpu())
        self.step, self.seconds, self.rows = state["step"], state["seconds"], [tuple(row) for row in state["rows"]]
        self._teacher = state["teacher"]


class _Objective(nn.Module):
    """The objective as a module, which DistributedDataParallel can wrap."""

    def __init__(self, networks: Paul, layout: Layout, recipe: Recipe) -> None:
        super().__init__()
        self.networks, self.layout, self.recipe = networks, layout, recipe

    def forward(self, batch: Batch) -> Terms:
        views, rows, share = batch.views, batch.rows, batch.share
        if batch.goal is None:
            return paul_terms(self.networks, self.layout, self.recipe, views, rows, share)
        return regression_terms(self.networks, self.layout, self.recipe, views, rows, batch.goal, share)
