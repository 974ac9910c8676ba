# SPDX-License-Identifier: Apache-2.0
"""Series of experiments for the benchmark and the studies: resumable, and judged by a truth that no trainer sees.

An experiment is one training run.  The trainer gets W and visible only, in an order of frames that depends on the seed.
The name of the experiment's folder is a digest of data, recipe, seed and package version.  An interrupted series
therefore continues, and a changed setting trains anew.  The folder keeps the reconstruction; errors are computed
whenever it is read.

Starts are kept beside the experiments.  Experiments with equal starts share one, and its search time counts for each.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from paul_ros import __version__
from paul_ros.files import write_atomically, write_npz
from paul_ros.layout import anonymous_layout
from paul_ros.normalisation import enough_visible
from training import reconstruction
from training.data import TrainingData
from training.errors import DataError, RecipeError
from training.judge.comparison import errors_of_signs
from training.judge.prediction import MIN_POINTS
from training.judge.truth import Sequence
from training.loading import load_training_data
from training.progress import Progress, progress_bar
from training.recipe import Recipe
from training.reconstruction import Reconstruction
from training.run_folder import START, locked, restarts, run_folder
from training.start.kept_start import start_identity

Item = TypeVar("Item")

RECIPES = {"paul": "nrsfm"}
"""Method -> recipe, for methods that are not named like their recipe."""

_STARTS, _RUN, _KEPT = "starts", "run", "shapes.npz"

BAD_BASIN = 3.0
"""Threshold of a bad basin: its NE with one flip for all, over the median of its method's experiments."""


@dataclass(frozen=True)
class Experiment:
    """One training run, and the truth that judges it.

    Attributes:
        sequence: frames to reconstruct, with their truth.
        method: a name of ``RECIPES``, or a recipe by name or file.
        seed: of training and of the frames' order.
        settings: overrides of the recipe, as for ``--set``.
        detail: the varied setting, for the progress bar.
        value: the varied setting, as a key of groups.
    """

    sequence: Sequence
    method: str
    seed: int
    settings: tuple[str, ...] = ()
    detail: str = ""
    value: float | str = ""

    def recipe(self) -> Recipe:
        """Return the recipe; experiments share no seed, even if the recipe restarts with several.

        Raises:
            RecipeError: there is no such recipe, or a setting is wrong.
        """
        name = RECIPES.get(self.method, self.method)
        try:
            runs = Recipe.load(name, list(self.settings)).restarts
            return Recipe.load(name, [*self.settings, f"seed={self.seed * runs}"])
        except RecipeError as error:
            raise RecipeError(f"method {self.method}: {error}") from None

    def order(self) -> np.ndarray:
        """Return the frame numbers (F,) in the order in which the trainer gets them."""
        return np.random.default_rng([self.seed, 0]).permutation(len(self.sequence.W))

    def folder(self, work: Path) -> Path:
        """Return the experiment's folder in a work folder."""
        digest = hashlib.sha256(repr([__version__, *sorted(self.recipe().to_dict().items())]).encode())
        for array in (self.sequence.W.astype(np.float32), self.sequence.visible, self.order()):
            digest.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        name = re.sub(r"[^\w.-]", "_", f"{self.sequence.name}_{Path(self.method).stem}_{self.seed}")
        return work / f"{name}_{digest.hexdigest()[:10]}"


@dataclass(frozen=True)
class Outcome:
    """The result of an experiment.

    Attributes:
        experiment: that gave it.
        ne_flip_frame_percent: normalised error, depth flipped per frame.
        ne_flip_global_percent: normalised error, one flip for all frames.
        loss: of the training objective.
        seconds: of training.
        codes: (F,K) in the order of the sequence's frames; None if no networks were trained.
    """

    experiment: Experiment
    ne_flip_frame_percent: float
    ne_flip_global_percent: float
    loss: float
    seconds: float
    codes: np.ndarray | None


@dataclass(frozen=True)
class SeriesOptions:
    """Options of a series of experiments.

    Attributes:
        work: folder that keeps the experiments.
        fresh: whether to train all anew.
        threads: CPU threads.
        quiet: whether to hide the progress bar.
    """

    work: Path
    fresh: bool = False
    threads: int = 1
    quiet: bool = False


def perform(experiments: list[Experiment], options: SeriesOptions) -> list[Outcome]:
    """Train the experiments that are not kept yet, one after the other, and judge all.

    Raises:
        RecipeError: a recipe or a setting is wrong; raised before any training.
        DataError: a sequence cannot be trained on; raised before any training.
        TrainingError: an experiment failed, or another process trains it now.
        KeyboardInterrupt: its text says how to go on.
    """
    for experiment in experiments:
        _check(experiment)
    folders = [experiment.folder(options.work) for experiment in experiments]
    if options.fresh:
        shutil.rmtree(options.work / _STARTS, ignore_errors=True)
    torch.set_num_threads(options.threads)
    outcomes = []
    layout = "{percentage:3.0f}%|{bar:20}| {n:.2f} of {total} runs [{elapsed}, {remaining} left] {desc}"
    with progress_bar(options.quiet, total=len(experiments), bar_format=layout) as bar:
        for number, (experiment, folder) in enumerate(zip(experiments, folders)):
            detail = f" {experiment.detail}" if experiment.detail else ""
            name = f"{experiment.sequence.name} {Path(experiment.method).stem}{detail}"
            bar.set_description_str(f"{name} seed {experiment.seed}")
            try:
                outcomes.append(_perform(experiment, folder, options.fresh, lambda done: _move(bar, number + done)))
            except KeyboardInterrupt:
                done = f"stopped after {number} of {len(experiments)} runs"
                raise KeyboardInterrupt(f"{done}: the same command, without --fresh, continues") from None
            _move(bar, number + 1)
    return outcomes


def _check(experiment: Experiment) -> None:
    """Refuse frames that the trainer would leave out, since shapes and truth must be of the same frames."""
    sequence = experiment.sequence
    enough = enough_visible(sequence.visible, anonymous_layout(sequence.W.shape[2]))
    if not enough.all():
        raise DataError(
            f"{(~enough).sum()} of {len(enough)} frames of '{sequence.name}' show too few points to be "
            "reconstructed: hide fewer points, or remove these frames from the file"
        )


def _move(bar: tqdm, to: float) -> None:
    """Advance a bar to a count; it never goes back."""
    bar.update(max(0.0, to - bar.n))


def _perform(experiment: Experiment, folder: Path, fresh: bool, progress: Progress) -> Outcome:
    """Train an experiment unless its reconstruction is kept, and judge it."""
    kept = folder / _KEPT
    if fresh or not kept.exists():
        with locked(folder):
            if fresh:  # the folder itself stays, since it is locked
                kept.unlink(missing_ok=True)
                shutil.rmtree(folder / _RUN, ignore_errors=True)
            _train(experiment, folder, progress)
    return _judge(experiment, reconstruction.load_reconstruction(kept))


def _train(experiment: Experiment, folder: Path, progress: Progress) -> None:
    """Train an experiment, or continue it, and keep its reconstruction."""
    data, recipe = _training_data(experiment, folder), experiment.recipe()
    starts = _start_files(data, recipe, folder)
    for shared, own in starts:
        _copy_if_missing(shared, own)
    found = reconstruction.reconstruct(data, recipe, folder / _RUN, progress)
    for shared, own in starts:
        _copy_if_missing(own, shared)
    found.save(folder / _KEPT)


def _start_files(data: TrainingData, recipe: Recipe, folder: Path) -> list[tuple[Path, Path]]:
    """Return the shared and the own file of each of an experiment's starts."""
    pairs = []
    for one in restarts(recipe) if recipe.start != "random" else ():
        identity = json.dumps([__version__, start_identity(data, one)], sort_keys=True)
        shared = folder.parent / _STARTS / f"{hashlib.sha256(identity.encode()).hexdigest()[:16]}.npz"
        pairs.append((shared, run_folder(folder / _RUN, recipe, one.seed) / START))
    return pairs


def _copy_if_missing(source: Path, to: Path) -> None:
    if source.exists() and not to.exists():
        write_atomically(to, source.read_bytes())


def _training_data(experiment: Experiment, folder: Path) -> TrainingData:
    """Return the trainer's data, read from a file that holds W and visible only."""
    order, sequence = experiment.order(), experiment.sequence
    path = folder / "given.npz"
    write_npz(path, {"W": sequence.W[order].astype(np.float32), "visible": sequence.visible[order]})
    data = load_training_data(path, anonymous_layout(sequence.W.shape[2]))
    if data.left_out:
        raise DataError(
            f"{data.left_out} of {len(order)} frames of '{sequence.name}' have all points in one place: "
            "remove them from the file"
        )
    return data


def _judge(experiment: Experiment, found: Reconstruction) -> Outcome:
    """Judge a reconstruction whose frames are in the experiment's order."""
    order, sequence = experiment.order(), experiment.sequence
    if found.shapes.shape != sequence.S.shape:
        raise DataError(
            f"the kept run of '{sequence.name}' has shapes {found.shapes.shape}: train it anew with --fresh"
        )
    back = order.argsort()
    known = np.flatnonzero(sequence.present.sum(1) >= MIN_POINTS)
    signs = errors_of_signs(found.shapes[back], sequence, known)
    return Outcome(
        experiment,
        float(100 * signs.min(1).mean()),
        float(100 * signs.mean(0).min()),
        float(found.loss),
        float(found.seconds),
        None if found.codes is None else found.codes[back],
    )


def chosen(outcomes: list[Outcome]) -> Outcome:
    """Return the outcome with the lowest loss, a choice that needs no truth.

    Args:
        outcomes: of one method, sequence and setting.
    """
    return min(outcomes, key=lambda outcome: (outcome.loss, outcome.experiment.seed))


def groups(items: Iterable[Item], key: Callable[[Item], Hashable]) -> dict[Any, list[Item]]:
    """Group items by key, in the order in which keys first occur."""
    found: dict[Any, list[Item]] = {}
    for item in items:
        found.setdefault(key(item), []).append(item)
    return found


def outcome_row(outcome: Outcome, is_chosen: bool) -> dict[str, Any]:
    """Return the keys that every report has for an outcome."""
    return {
        "seed": outcome.experiment.seed,
        "ne_flip_frame_percent": outcome.ne_flip_frame_percent,
        "ne_flip_global_percent": outcome.ne_flip_global_percent,
        "loss": outcome.loss,
        "seconds": outcome.seconds,
        "chosen": is_chosen,
    }


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Summarise the seeds of one method, sequence and setting; ``deviation`` is the standard deviation over them."""
    frame, whole = (
        np.array([getattr(outcome, f"ne_flip_{flip}_percent") for outcome in outcomes]) for flip in ("frame", "global")
    )
    pick = chosen(outcomes)
    return {
        "runs": len(outcomes),
        "chosen_seed": pick.experiment.seed,
        **{
            f"{name}_ne_flip_{flip}_percent": float(value)
            for name, *values in (
                ("chosen", pick.ne_flip_frame_percent, pick.ne_flip_global_percent),
                ("median", np.median(frame), np.median(whole)),
                ("best", frame.min(), whole.min()),
                ("worst", frame.max(), whole.max()),
                ("mean", frame.mean(), whole.mean()),
                ("deviation", frame.std(), whole.std()),
            )
            for flip, value in zip(("frame", "global"), values)
        },
        "bad_basin_share": float((whole > BAD_BASIN * np.median(whole)).mean()),
        "seconds_median": float(np.median([outcome.seconds for outcome in outcomes])),
    }
