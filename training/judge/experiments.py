# SPDX-License-Identifier: Apache-2.0
"""Many training runs in a row, for benchmark and studies: resumable, and judged by a truth that no run has seen.

A run is given its frames in an order of its seed's own, and only where points were seen: W and visible. Its folder
under the work folder is named by what it depends on (data, recipe, seed, version of this package), so that an
interrupted series goes on where it was and a changed setting begins anew. What is kept is the reconstruction; errors
are computed whenever it is read. Starts are kept beside the runs, for all that begin with the same one to share it: it
is found once, and the time that took counts for each of them.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from paul_ros import __version__
from paul_ros.files import write_atomically
from paul_ros.layout import anonymous_layout
from paul_ros.model import enough_visible
from training import reconstruction
from training.data import TrainingData
from training.errors import DataError, RecipeError
from training.judge.evaluation import LEAST_VISIBLE, errors_of_signs
from training.judge.truth import Sequence
from training.loading import load_training_data
from training.recipe import Recipe
from training.reconstruction import Reconstruction
from training.start.kept_start import START, start_identity

RECIPES = {"paul": "nrsfm"}
"""Recipes of methods whose name is not their recipe's."""

_STARTS = "starts"

BAD_BASIN = 3.0
"""A run is in a bad basin where its NE, one flip for all, is above so many times the median of its method's runs."""


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        sequence: what is reconstructed, and the truth that judges it.
        method: a name of RECIPES, or a recipe by name or file.
        seed: of training and of the frames' order.
        settings: overrides of the recipe, as ``--set`` takes them.
        detail: what sets the run apart from others of its series, for people; value: the same, to sort by.
    """

    sequence: Sequence
    method: str
    seed: int
    settings: tuple[str, ...] = ()
    detail: str = ""
    value: float | str = ""

    def recipe(self) -> Recipe:
        """Its recipe; raises RecipeError. A recipe that trains several runs itself has seeds of its own in each."""
        name = RECIPES.get(self.method, self.method)
        try:
            restarts = Recipe.load(name, list(self.settings)).restarts
            return Recipe.load(name, [*self.settings, f"seed={self.seed * restarts}"])
        except RecipeError as error:
            raise RecipeError(f"method {self.method}: {error}") from None

    def order(self) -> np.ndarray:
        """(F,) numbers of the frames in the order in which the trainer is given them."""
        return np.random.default_rng([self.seed, 0]).permutation(len(self.sequence.W))

    def folder(self, work: Path) -> Path:
        """Where it is kept."""
        digest = hashlib.sha256(repr([__version__, *sorted(self.recipe().to_dict().items())]).encode())
        for array in (self.sequence.W.astype(np.float32), self.sequence.visible, self.order()):
            digest.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        name = re.sub(r"[^\w.-]", "_", f"{self.sequence.name}_{Path(self.method).stem}_{self.seed}")
        return work / f"{name}_{digest.hexdigest()[:10]}"


@dataclass(frozen=True)
class Outcome:
    """What a run gave: errors in %, codes (F,K) in the order of the sequence's frames or None, loss and seconds."""

    run: Run
    ne_flip_frame_percent: float
    ne_flip_global_percent: float
    loss: float
    seconds: float
    codes: np.ndarray | None


@dataclass(frozen=True)
class Keeping:
    """How runs are done and kept: a folder for them, whether to train all anew, CPU threads, no progress bar."""

    work: Path
    fresh: bool = False
    threads: int = 1
    quiet: bool = False


def perform(runs: list[Run], keeping: Keeping) -> list[Outcome]:
    """Train what is not there yet, one run after the other, and judge all.

    Raises:
        RecipeError: a recipe or a setting is none; before any training.
        DataError: frames that cannot be trained on; before any training too.
        TrainingError: a run failed.
    """
    for run in runs:
        _check(run)
    folders = [run.folder(keeping.work) for run in runs]
    if keeping.fresh:
        shutil.rmtree(keeping.work / _STARTS, ignore_errors=True)
    torch.set_num_threads(keeping.threads)
    outcomes = []
    # Into a log file, a line twice a minute.
    interval = 0.1 if sys.stderr.isatty() else 30.0
    layout = "{percentage:3.0f}%|{bar:20}| {n:.2f} of {total} runs [{elapsed}, {remaining} left] {desc}"
    with tqdm(
        total=len(runs), disable=keeping.quiet, bar_format=layout, mininterval=interval, dynamic_ncols=True
    ) as bar:
        for number, (run, folder) in enumerate(zip(runs, folders)):
            detail = f" {run.detail}" if run.detail else ""
            bar.set_description_str(f"{run.sequence.name} {Path(run.method).stem}{detail} seed {run.seed}")
            outcomes.append(_perform(run, folder, keeping.fresh, lambda done: _move(bar, number + done)))
            _move(bar, number + 1)
    return outcomes


def _check(run: Run) -> None:
    """Refuse frames that the trainer would leave out: then shapes and truth were no longer of the same frames."""
    enough = enough_visible(run.sequence.visible, anonymous_layout(run.sequence.W.shape[2]))
    if not enough.all():
        raise DataError(
            f"{(~enough).sum()} of {len(enough)} frames of '{run.sequence.name}' show too few points to be "
            "reconstructed: hide fewer points, or take these frames out of the file"
        )


def _move(bar: tqdm, to: float) -> None:
    bar.update(max(0.0, to - bar.n))


def _perform(run: Run, folder: Path, fresh: bool, progress: Callable[[float], None]) -> Outcome:
    kept = folder / "shapes.npz"
    if fresh:
        shutil.rmtree(folder, ignore_errors=True)
    if not kept.exists():
        data, recipe = _given(run, folder), run.recipe()
        starts = _starts(data, recipe, folder)
        for shared, own in starts:
            _copied(shared, own)
        found = reconstruction.reconstruct(data, recipe, folder / "run", progress)
        for shared, own in starts:
            _copied(own, shared)
        found.save(kept)
    return _judged(run, reconstruction.load_reconstruction(kept))


def _starts(data: TrainingData, recipe: Recipe, folder: Path) -> list[tuple[Path, Path]]:
    """Where a run's starts are kept for all runs, and where for itself."""
    pairs = []
    for one in reconstruction.restarts(recipe) if recipe.start != "random" else ():
        identity = json.dumps([__version__, start_identity(data, one)], sort_keys=True)
        shared = folder.parent / _STARTS / f"{hashlib.sha256(identity.encode()).hexdigest()[:16]}.npz"
        pairs.append((shared, reconstruction.run_folder(folder / "run", recipe, one.seed) / START))
    return pairs


def _copied(source: Path, to: Path) -> None:
    if source.exists() and not to.exists():
        write_atomically(to, source.read_bytes())


def _given(run: Run, folder: Path) -> TrainingData:
    """The trainer's data: through a file that holds what the trainer may know and nothing else."""
    order, sequence = run.order(), run.sequence
    path = folder / "given.npz"
    buffer = io.BytesIO()
    np.savez(buffer, W=sequence.W[order].astype(np.float32), visible=sequence.visible[order])
    write_atomically(path, buffer.getvalue())
    data = load_training_data(path, anonymous_layout(sequence.W.shape[2]))
    if data.left_out:
        raise DataError(
            f"{data.left_out} of {len(order)} frames of '{sequence.name}' have all points in one place: "
            "take them out of the file"
        )
    return data


def _judged(run: Run, found: Reconstruction) -> Outcome:
    """Errors of a reconstruction whose frames are in the run's order."""
    order, sequence = run.order(), run.sequence
    if found.shapes.shape != sequence.S.shape:
        raise DataError(f"the kept run of '{sequence.name}' has shapes {found.shapes.shape}: start over with --fresh")
    back = order.argsort()
    known = np.flatnonzero(sequence.present.sum(1) >= LEAST_VISIBLE)
    signs = errors_of_signs(found.shapes[back], sequence, known)
    return Outcome(
        run,
        float(100 * signs.min(1).mean()),
        float(100 * signs.mean(0).min()),
        float(found.loss),
        float(found.seconds),
        None if found.codes is None else found.codes[back],
    )


def chosen(outcomes: list[Outcome]) -> Outcome:
    """The one with the lowest loss: what can be chosen without a truth. All of one method, sequence and setting."""
    return min(outcomes, key=lambda outcome: (outcome.loss, outcome.run.seed))


def groups(outcomes: list[Outcome], key: Callable[[Outcome], object]) -> dict:
    """Outcomes by key, in the order in which keys come."""
    found: dict = {}
    for outcome in outcomes:
        found.setdefault(key(outcome), []).append(outcome)
    return found


def summary(outcomes: list[Outcome]) -> dict:
    """What several seeds of one method, sequence and setting gave; deviation is the standard one over runs."""
    frame, whole = (
        np.array([getattr(outcome, f"ne_flip_{flip}_percent") for outcome in outcomes]) for flip in ("frame", "global")
    )
    pick = chosen(outcomes)
    return {
        "runs": len(outcomes),
        "chosen_seed": pick.run.seed,
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
