# SPDX-License-Identifier: Apache-2.0
"""Reconstruct the training frames themselves: 2D in, 3D shapes out (non-rigid structure from motion)."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from paul_ros.errors import NpzError
from paul_ros.files import read_npz, write_npz
from training.data import TrainingData
from training.data_checks import check_sizes
from training.distributed import processes
from training.errors import DataError, TrainingError
from training.objective import fit, paul_terms
from training.progress import Progress, ignore_progress
from training.recipe import Recipe
from training.run_folder import restarts, run_folder
from training.solver import centre
from training.start.search import START_UNIT
from training.start.start import Start
from training.trainer import Trainer
from training.views import NormalisedViews

_BATCH = 256
_START_SHARE = 0.3
"""Share of the work, for progress, of the search for a start."""


@dataclass(frozen=True)
class Reconstruction:
    """3D shapes of all training frames, in their cameras' frames.

    Attributes:
        used: (G,) bool over the given frames: True for the F that are reconstructed, in their order. The others showed
            too few points.
        shapes: (F,3,P) float32, image units, centred on the visible points. x and y of visible points are the observed
            ones. All other coordinates are the mean of the streams (S_cam of the paper; supplement, equation 14).
        rotations: (F,3,3) float32, from the canonical to the camera frame.
        codes: (F,K) float32; None if no networks were trained.
        loss: objective over all frames without augmentation, or the score of the start if no networks were trained.
            Seeds of one method are comparable. No ground truth enters.
        seconds: duration of all restarts, with their searches for a start.
    """

    used: np.ndarray
    shapes: np.ndarray
    rotations: np.ndarray
    codes: np.ndarray | None
    loss: float
    seconds: float

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` of these arrays, atomically."""
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in vars(self).items() if value is not None}
        write_npz(path, arrays)


def load_reconstruction(path: str | Path) -> Reconstruction:
    """Read a file of ``Reconstruction.save``.

    Raises:
        DataError: there is no such file, or it holds something else.
    """
    if not Path(path).exists():
        raise DataError(f"{path}: no such file")
    try:
        arrays = read_npz(path, ("shapes", "rotations", "used", "loss", "seconds"), ("codes",))
    except NpzError as error:
        raise DataError(f"'{path}' is not a saved reconstruction: it {error}") from error
    used, shapes, rotations = arrays["used"], arrays["shapes"], arrays["rotations"]
    if shapes.ndim != 3 or shapes.shape[1] != 3 or rotations.shape != (len(shapes), 3, 3):
        raise DataError(f"'{path}' is not a saved reconstruction: shapes are {shapes.shape}, not (F,3,P)")
    if used.dtype != bool or used.ndim != 1 or used.sum() != len(shapes):
        raise DataError(
            f"'{path}' is not a saved reconstruction: used does not show which frames its {len(shapes)} are"
        )
    try:
        loss, seconds = float(arrays["loss"]), float(arrays["seconds"])
    except (TypeError, ValueError) as error:
        raise DataError(f"'{path}' is not a saved reconstruction: loss and seconds are not numbers") from error
    return Reconstruction(used, shapes, rotations, arrays.get("codes"), loss, seconds)


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        trainer: of the run.
        loss: see ``Reconstruction``; infinite for a diverged run.
    """

    trainer: Trainer
    loss: float

    @property
    def seed(self) -> int:
        """The run's seed."""
        return self.trainer.recipe.seed


Watch = Callable[[Trainer], None]
"""Function that trains a run to its end and may show progress."""


def train_restarts(
    data: TrainingData, recipe: Recipe, folder: Path, device: torch.device | str, watch: Watch
) -> list[FinishedRun]:
    """Train or continue the recipe's restarts one after the other, each in a folder of its own.

    Args:
        data: to train on.
        recipe: with its number of restarts.
        folder: of the runs.
        device: of the networks.
        watch: trains each run.

    Returns:
        The runs, best first, diverged ones last.

    Raises:
        TrainingError: all of them diverged; or see ``Trainer``.
    """
    runs: list[FinishedRun] = []
    diverged = None
    for one in restarts(recipe):
        trainer = Trainer(data, one, run_folder(folder, recipe, one.seed), device)
        trainer.resume()
        try:
            watch(trainer)
        except TrainingError as error:
            unusable = recipe.start != "random" and trainer.start is None
            if unusable or processes() > 1:  # no start; or other processes would wait for this one
                raise
            diverged = error
            runs.append(FinishedRun(trainer, math.inf))
        else:
            runs.append(FinishedRun(trainer, final_loss(trainer)))
    if diverged and all(math.isinf(run.loss) for run in runs):
        raise diverged
    return sorted(runs, key=lambda run: run.loss)


def reconstruct(
    data: TrainingData, recipe: Recipe, folder: Path | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Train all restarts, and reconstruct the data's frames by the run of lowest loss.

    Args:
        data: to train on and to reconstruct.
        recipe: of the runs.
        folder: of the runs, which are continued if they were interrupted; None keeps nothing.
        progress: called with the share of the work that is done.

    Raises:
        DataError: all frames have one scale, and one frame would outweigh the others.
        TrainingError: see ``Trainer``.
    """
    check_sizes(data, recipe.scale)
    if folder is None:
        with tempfile.TemporaryDirectory() as temporary:
            return reconstruct(data, recipe, Path(temporary), progress)
    finished, show = 0, progress or ignore_progress
    start_share = 0.0 if recipe.start == "random" else _START_SHARE if recipe.steps else 1.0

    def watch(trainer: Trainer) -> None:
        nonlocal finished

        def advance(done: float) -> None:
            show((finished + done) / recipe.restarts)

        try:
            trainer.prepare(lambda done: advance(start_share * done))
            for row in trainer.run():
                advance(start_share + (1 - start_share) * row["step"] / trainer.steps)
        finally:
            finished += 1
        advance(0.0)

    runs = train_restarts(data, recipe, Path(folder), "cpu", watch)
    return reconstruction_of(runs)


@torch.no_grad()
def reconstruction_of(runs: list[FinishedRun]) -> Reconstruction:
    """Reconstruct the frames by the first run, the best.

    Raises:
        TrainingError: no networks were trained, and the start lacks shapes of some frames.
    """
    trainer = runs[0].trainer
    frames, points = len(trainer.data.W), trainer.data.W.shape[2]
    shapes, rotations = np.empty((frames, 3, points), np.float32), np.empty((frames, 3, 3), np.float32)
    codes = np.empty((frames, trainer.recipe.bottleneck), np.float32)
    lift = _by_networks(trainer) if trainer.recipe.steps else _by_start(trainer)
    for rows in _batches(frames):
        views = trainer.views(rows)
        inside, R, code = lift(rows, views)
        seen = views.visible[:, None] & torch.tensor([True, True, False], device=trainer.device)[:, None]
        inside = torch.where(seen, torch.cat([views.W, views.W[:, :1]], dim=1), centre(inside, views.visible))
        shapes[rows], rotations[rows] = (views.size * inside).cpu().numpy(), R.cpu().numpy()
        if code is not None:
            codes[rows] = code.cpu().numpy()
    seconds = sum(run.trainer.seconds for run in runs)
    return Reconstruction(
        trainer.data.used, shapes, rotations, codes if trainer.recipe.steps else None, runs[0].loss, seconds
    )


@torch.no_grad()
def final_loss(trainer: Trainer) -> float:
    """Return the objective's mean over all frames without augmentation, or the start's score without networks."""
    if not trainer.recipe.steps:
        return _start_of(trainer).score
    recipe, total = trainer.recipe, 0.0
    for rows in _batches(len(trainer.data.W)):
        views, numbers = trainer.views(rows), rows.to(trainer.device)
        terms = paul_terms(trainer.networks, trainer.data.layout, recipe, views, numbers)
        total += len(rows) * terms.loss.item()
    return total / len(trainer.data.W)


def _batches(frames: int) -> Iterator[torch.Tensor]:
    """Yield frame numbers in parts that fit into memory for any number of frames."""
    return iter(torch.arange(frames).split(_BATCH))


Lift = Callable[[Tensor, NormalisedViews], tuple[Tensor, Tensor, Tensor | None]]
"""Function from frame numbers (N,) and views to shapes, rotations and codes.

Shapes are (N,3,P) in camera frame and units of W, rotations (N,3,3), codes (N,K) or None.
"""


def _by_networks(trainer: Trainer) -> Lift:
    def lift(rows: Tensor, views: NormalisedViews) -> tuple[Tensor, Tensor, Tensor]:
        found = fit(trainer.networks, trainer.recipe, views, rows.to(trainer.device))
        return found.points, found.camera.R, found.code

    return lift


def _start_of(trainer: Trainer) -> Start:
    trainer.prepare()
    if trainer.start is None:
        raise TrainingError("the recipe starts from random weights and trains no networks: give it steps")
    return trainer.start


def _by_start(trainer: Trainer) -> Lift:
    start, frames = _start_of(trainer), len(trainer.data.W)
    place = np.full(frames, -1)
    place[start.rows] = np.arange(len(start.rows))
    if (place < 0).any():
        raise TrainingError(
            f"the start has shapes of {(place >= 0).sum()} of {frames} frames: give the recipe steps and "
            f"regression_steps, so that networks reconstruct them all"
        )

    def lift(rows: Tensor, views: NormalisedViews) -> tuple[Tensor, Tensor, None]:
        R, S = (torch.from_numpy(array[place[rows]]).to(views.W) for array in (start.rotations, start.shapes))
        return START_UNIT[trainer.recipe.scale] * R @ S, R, None

    return lift
