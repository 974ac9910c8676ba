# SPDX-License-Identifier: Apache-2.0
"""A session of `paul train`: load the data, train or continue all restarts, write model and shapes."""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from training.chirality import chirality_text
from training.data import TrainingData
from training.data_checks import check_sizes
from training.distributed import from_first, is_first, joined
from training.encoder_fit import fit_encoder
from training.errors import TrainingError
from training.export import export_model
from training.options import TrainingOptions
from training.preflight import Job
from training.progress import progress_bar, share_bar
from training.recipe import Recipe
from training.reconstruction import FinishedRun, reconstruction_of, train_restarts
from training.run_folder import RUN_FILES, locked
from training.tensorboard import FOLDER as BOARD_FOLDER
from training.tensorboard import Board
from training.trainer import Trainer

_BAR_EVERY = 20
"""Steps between updates of the losses in the progress bar."""


class Results(NamedTuple):
    """The results of a session.

    Attributes:
        report: the model's header and the ranking of the restarts, for JSON.
        text: the same for people.
    """

    report: dict[str, Any]
    text: str


def train(job: Job) -> Results | None:
    """Train, or continue, and write model and shapes.

    Returns:
        The results; None in all processes but the first.

    Raises:
        PaulError: bad data or file, or another training runs in the folder of the run.
        KeyboardInterrupt: its text says what was stopped and how to go on.
    """
    options = job.options
    torch.set_num_threads(options.threads)
    device = training_device(options.device)
    with joined(device), _locked(options.run_folder, device):
        data, recipe = _loaded(job, device)
        data = replace(data, notes=(*data.notes, *check_sizes(data, recipe.scale), *_unused(data, recipe, options)))
        if options.fresh and is_first():
            _delete_runs(job.folders)
        _introduce(data)
        try:
            runs = train_restarts(data, recipe, options.run_folder, device, lambda trainer: _watch(trainer, options))
            return _write_results(runs, options) if is_first() else None
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(str(stop) or "stopped: the same command continues") from None


def _loaded(job: Job, device: torch.device) -> tuple[TrainingData, Recipe]:
    """Return data and recipe; only motion capture imports ``training.people``."""
    if job.data is not None:
        return job.data, job.recipe
    from training.motion_capture import load_motion_capture

    return load_motion_capture(job.options, job.recipe, device)


@contextmanager
def _locked(folder: Path, device: torch.device) -> Iterator[None]:
    """Lock the folder in the first process. All processes raise its refusal, so that none waits for the others.

    Raises:
        TrainingError: another training runs there, or the folder cannot be made.
    """
    with ExitStack() as held:

        def lock() -> bytes | None:
            try:
                held.enter_context(locked(folder))
            except (TrainingError, OSError) as error:
                return str(error).encode(errors="backslashreplace")
            return None

        if refusal := from_first(lock, device):
            raise TrainingError(refusal.decode())
        yield


def training_device(name: str) -> torch.device:
    """Return the device of the networks.

    On a GPU, torch is set to algorithms that are deterministic as far as it has them.

    Args:
        name: ``auto``, ``cpu`` or ``cuda``.

    Raises:
        TrainingError: no GPU is found, and one is asked for.
    """
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise TrainingError("torch finds no GPU here: use --device cpu, or install a torch that is built for yours")
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(device)
    return device


def _unused(data: TrainingData, recipe: Recipe, options: TrainingOptions) -> tuple[str, ...]:
    """Return a note for each input that has no effect."""
    notes = []
    if data.detected is not None and not recipe.hold:
        notes.append("its detected points are not used: h learns to read them only with held solutions (setting hold)")
    names = [override.partition("=")[0].partition(".")[0].strip() for override in options.overrides]
    if recipe.views is None and "views" in names:
        notes.append("settings of views are not used: they are for a folder of motion capture")
    return tuple(notes)


def _delete_runs(folders: Iterable[Path]) -> None:
    """Delete the files of runs; other files in the folders stay."""
    for folder in folders:
        for name in RUN_FILES:
            (folder / name).unlink(missing_ok=True)
        shutil.rmtree(folder / BOARD_FOLDER, ignore_errors=True)


def _introduce(data: TrainingData) -> None:
    if not is_first():
        return
    left_out = f", {data.left_out} left out (too few points, or all on one line)" if data.left_out else ""
    print(f"{len(data.W)} frames of layout {data.layout.name} from {data.source}{left_out}", file=sys.stderr)
    for note in data.notes:
        print(f"note: {note}", file=sys.stderr)


def _watch(trainer: Trainer, options: TrainingOptions) -> None:
    """Train to the end with progress bars and logs."""
    begun, quiet = trainer.step, options.quiet or not is_first()
    if begun and is_first():
        print(f"seed {trainer.recipe.seed}: continuing at step {begun}", file=sys.stderr)
    board = Board(trainer.folder, begun) if options.tensorboard and is_first() else None
    try:
        if trainer.recipe.start != "random":
            with share_bar(quiet, f"{trainer.recipe.start} start") as progress:
                trainer.prepare(progress)
        with progress_bar(quiet or not trainer.steps, total=trainer.steps, initial=begun, unit="step") as bar:
            with closing(trainer.run()) as rows:  # closing writes the checkpoint
                for row in rows:
                    bar.update()
                    if board:
                        board.write(row)
                    if row["step"] % _BAR_EVERY == 0:
                        losses = {"loss": row["loss"], "ae": row["recon_ae"], "ad": row["recon_ad"]}
                        bar.set_postfix({name: f"{value:.4f}" for name, value in losses.items()}, refresh=False)
    except KeyboardInterrupt:
        if trainer.recipe.start != "random" and trainer.start is None:
            raise KeyboardInterrupt("stopped while searching for a start: the same command begins again") from None
        progress_text = f"stopped at step {trainer.step} of {trainer.steps}"
        raise KeyboardInterrupt(f"{progress_text}: the same command continues") from None
    finally:
        if board:
            board.close()


def _write_results(runs: list[FinishedRun], options: TrainingOptions) -> Results:
    """Write model and shapes of the best run, and report all runs."""
    best = runs[0].trainer
    header: dict[str, Any] = {}
    if options.shapes:
        reconstruction_of(runs).save(options.shapes)
    if options.model:
        if best.recipe.codes == "free":
            _fit_encoder(best, options.quiet)
        header = export_model(best, runs[0].loss, options.model, options.command)
    return Results({**header, "restarts": _ranking(runs)}, "\n".join(_result_lines(runs, header, options)))


def _fit_encoder(trainer: Trainer, quiet: bool) -> None:
    try:
        with share_bar(quiet, "2D encoder") as progress:
            left = fit_encoder(trainer, progress=progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            "stopped while fitting the 2D encoder to the codes: the same command fits it anew, the rest is done"
        ) from None
    print(
        f"2D encoder fitted to the codes; its shapes are {100 * left:.1f} % of their size off theirs", file=sys.stderr
    )


def _result_lines(runs: list[FinishedRun], header: dict[str, Any], options: TrainingOptions) -> Iterator[str]:
    if len(runs) > 1:
        yield "restarts by final loss, the first is kept:"
        for run in runs:
            yield f"  seed {run.seed}  {_loss_text(run)}  {run.trainer.seconds:.0f} s"
    if options.shapes:
        yield f"{options.shapes}: 3D shapes of {len(runs[0].trainer.data.W)} frames, {_loss_text(runs[0])}"
    if options.model:
        training, metres, chirality = header["training"], header["metres_per_unit"], header["chirality"]
        yield (
            f"{options.model}: {training['frames']} frames, {training['steps']} steps, {training['seconds']:.0f} s, "
            f"{_loss_text(runs[0])}"
        )
        yield f"  scale: {f'{metres:.4f} m per model unit' if metres else 'unknown (no known_lengths in the recipe)'}"
        yield f"  chirality: {chirality_text(chirality)}"


def _loss_text(run: FinishedRun) -> str:
    if math.isinf(run.loss):
        return "diverged"
    if run.trainer.recipe.steps:
        return f"final loss {run.loss:.5f}"
    return f"score of the start {run.loss:.5g} (negative log likelihood a frame, lower is better)"


def _ranking(runs: list[FinishedRun]) -> list[dict[str, Any]]:
    return [
        {
            "seed": run.seed,
            "loss": run.loss if math.isfinite(run.loss) else None,
            "seconds": round(run.trainer.seconds, 1),
            "chosen": run is runs[0],
        }
        for run in runs
    ]
