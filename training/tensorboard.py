# SPDX-License-Identifier: Apache-2.0
"""Logs for TensorBoard, from the extra "tensorboard"; ``log.csv`` holds the same losses without it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from paul_ros.extras import require

FOLDER = "tensorboard"
_EVERY = 20


def require_tensorboard() -> None:
    """Check that the package is installed.

    Raises:
        MissingPackageError: it is not.
    """
    require("tensorboard", "tensorboard")


class Board:
    """Writes a run's losses beside its checkpoint; ``tensorboard --logdir RUN`` shows them.

    Args:
        folder: of the run.
        step: steps done so far. Later entries, which an interrupted run wrote after its last checkpoint, are purged.
    """

    def __init__(self, folder: Path, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder / FOLDER), purge_step=step + 1)

    def write(self, row: dict[str, Any]) -> None:
        """Write every twentieth row of the trainer's log, each loss as a curve over the steps."""
        if row["step"] % _EVERY:
            return
        for name, value in row.items():
            if name not in ("step", "phase"):
                self._writer.add_scalar(name, value, row["step"])

    def close(self) -> None:
        """Write the remaining entries."""
        self._writer.close()
