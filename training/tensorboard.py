# SPDX-License-Identifier: Apache-2.0
"""Logs for TensorBoard, which need the extra "tensorboard"; ``log.csv`` holds the same without it."""

from __future__ import annotations

from pathlib import Path

FOLDER = "tensorboard"
_EVERY = 20


def need_tensorboard() -> None:
    """Raises ImportError, with a text for the user, where the package is missing; before the first step."""
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "--tensorboard needs the Python package 'tensorboard': pip install 'paul_ros[tensorboard]'"
        ) from error


class Board:
    """Writes a run's losses beside its checkpoint: ``tensorboard --logdir RUN`` shows them."""

    def __init__(self, folder: Path, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # What an interrupted run wrote after its last checkpoint is written anew.
        self._writer = SummaryWriter(str(folder / FOLDER), purge_step=step + 1)

    def write(self, row: dict[str, float | str]) -> None:
        """Every twentieth row of the trainer, each loss as a curve over the steps."""
        if row["step"] % _EVERY:
            return
        for name, value in row.items():
            if name not in ("step", "phase"):
                self._writer.add_scalar(name, value, row["step"])

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()
