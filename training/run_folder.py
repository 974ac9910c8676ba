# SPDX-License-Identifier: Apache-2.0
"""The folder of a run: the names of its files, and the lock that leaves it to one training at a time."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from paul_ros.files import PART, make_folders, remove_if_empty
from training.errors import TrainingError
from training.recipe import Recipe

CHECKPOINT, LOG, START = "checkpoint.pt", "log.csv", "start.npz"

RUN_FILES = (CHECKPOINT, LOG, START)
"""Files that a run keeps in its folder."""


def restarts(recipe: Recipe) -> list[Recipe]:
    """Return a recipe for each restart; seeds count up from the recipe's."""
    return [replace(recipe, seed=recipe.seed + number, restarts=1) for number in range(recipe.restarts)]


def run_folder(folder: Path, recipe: Recipe, seed: int) -> Path:
    """Return the folder of a restart: the given folder itself if there is only one."""
    return folder if recipe.restarts == 1 else folder / f"seed_{seed}"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other trainings out of a folder while the block runs.

    The folder is made if it is missing, and removed if the block leaves it empty. Half-written files of a killed
    training are deleted. The system's lock of the folder itself is used (flock): there is no lock file, and the lock of
    a killed process is gone.

    Raises:
        TrainingError: another process has the lock.
        OSError: the folder cannot be made.
    """
    made = make_folders(folder)
    try:
        descriptor = _locked_descriptor(folder)
        try:
            for part in folder.rglob(f"*{PART}"):
                part.unlink(missing_ok=True)
            yield
        finally:
            os.close(descriptor)
    finally:
        remove_if_empty(made)


def _locked_descriptor(folder: Path) -> int:
    while True:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise TrainingError(
                f"{folder}: another training is running in this folder: wait for its end, stop it, or write elsewhere"
            ) from None
        except OSError as error:  # some network file systems have no locks
            print(f"note: {folder} cannot be locked ({error.strerror}): start no second one here", file=sys.stderr)
            return descriptor
        # Another training may have removed its empty folder and made it anew meanwhile.
        if folder.exists() and os.path.samestat(os.fstat(descriptor), os.stat(folder)):
            return descriptor
        os.close(descriptor)
        folder.mkdir(parents=True, exist_ok=True)
