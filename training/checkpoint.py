# SPDX-License-Identifier: Apache-2.0
"""Files of a run: checkpoint.pt, which continues it to the bit, and log.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from paul_ros.files import write_atomically
from training.data import TrainingData
from training.distributed import from_first
from training.errors import TrainingError
from training.recipe import Recipe
from training.run_folder import CHECKPOINT, LOG

LOSSES = ("loss", "recon_ae", "recon_ad", "code", "handedness", "bones", "nuclear")
"""Columns of the log that are fields of ``objective.Terms``."""

LOG_COLUMNS = ("step", "seconds", *LOSSES, "learning_rate", "phase")


def run_identity(data: TrainingData, recipe: Recipe) -> dict[str, str]:
    """Return everything that a checkpoint belongs to."""
    return {
        "data": data.sha256,
        "recipe": repr(sorted(recipe.to_dict().items())),
        "layout": repr(sorted(data.layout.to_dict().items(), key=lambda item: item[0])),
    }


def write_checkpoint(folder: Path, state: dict[str, Any], rows: Sequence[Sequence[object]]) -> None:
    """Write checkpoint and log, each atomically.

    Args:
        folder: of the run.
        state: tensors and plain values.
        rows: of the log.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(folder / CHECKPOINT, buffer.getvalue())
    log = io.StringIO()
    csv.writer(log).writerows([LOG_COLUMNS, *rows])
    write_atomically(folder / LOG, log.getvalue().encode())


def restore_checkpoint(
    folder: Path, identity: dict[str, str], device: torch.device, restore: Callable[[dict[str, Any]], None]
) -> bool:
    """Read the folder's checkpoint without unpickling objects, and hand its state to ``restore``.

    Args:
        folder: of the run; the first process alone reads it.
        identity: see ``run_identity``.
        device: of the tensors.
        restore: takes the state over.

    Returns:
        False if there is no checkpoint.

    Raises:
        TrainingError: the checkpoint is damaged, or belongs to other data or another recipe.
    """
    path = folder / CHECKPOINT
    data = from_first(lambda: path.read_bytes() if path.exists() else None, device)
    if data is None:
        return False
    try:
        state = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
        _check_identity(folder, identity, state["identity"])
        restore(state)
    except TrainingError:
        raise
    except Exception as error:  # torch reports damage in many ways
        raise TrainingError(
            f"checkpoint '{path}' cannot be read ({type(error).__name__}): start over with --fresh"
        ) from error
    return True


def _check_identity(folder: Path, identity: dict[str, str], kept: dict[str, str]) -> None:
    other = [name for name, value in identity.items() if kept.get(name) != value]
    if other:
        raise TrainingError(
            f"'{folder}' holds a run with different {' and '.join(other)}: "
            f"start over with --fresh, or choose another output"
        )
