# SPDX-License-Identifier: Apache-2.0
"""The file start.npz in a run's folder: a start is found once and kept beside the checkpoint."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from paul_ros.files import read_npz, write_atomically
from training.data import TrainingData
from training.distributed import from_first
from training.errors import StartError
from training.recipe import Recipe
from training.run_folder import START
from training.start.start import Start


def start_identity(data: TrainingData, recipe: Recipe) -> dict[str, str | int]:
    """Return everything that a start depends on; runs that agree in it share one start."""
    return {"data": data.sha256, **{name: getattr(recipe, name) for name in ("start", "scale", "seed")}}


def kept_start(
    folder: Path, identity: Mapping[str, str | int], find: Callable[[], Start], device: torch.device
) -> Start:
    """Return the start that a run's folder keeps; without one, call ``find`` and keep the result.

    Args:
        folder: of the run.
        identity: see ``start_identity``.
        find: the search.
        device: of this process, for the transfer of the start among processes.

    Raises:
        StartError: the file is damaged, or belongs to another run.
    """
    path = folder / START

    def read_or_find() -> bytes:
        if not path.exists():
            write_atomically(path, _packed(find(), identity))
        return path.read_bytes()

    return _unpacked(from_first(read_or_find, device) or b"", identity, path)


def _packed(start: Start, identity: Mapping[str, str | int]) -> bytes:
    arrays: dict[str, Any] = {"identity": np.array(json.dumps(identity, sort_keys=True)), **vars(start)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _unpacked(data: bytes, identity: Mapping[str, str | int], path: Path) -> Start:
    try:
        kept = read_npz(io.BytesIO(data), ("identity", "rows", "shapes", "rotations", "score", "seconds"))
        found = json.loads(str(kept["identity"]))
        start = Start(kept["rows"], kept["shapes"], kept["rotations"], float(kept["score"]), float(kept["seconds"]))
    except (TypeError, ValueError) as error:  # an NpzError is a ValueError
        raise StartError(f"'{path}' cannot be read ({type(error).__name__}): start over with --fresh") from error
    other = [name for name in identity if found.get(name) != identity[name]]
    if other:
        raise StartError(f"'{path}' belongs to a run with different {' and '.join(other)}: start over with --fresh")
    return start
