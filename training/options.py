# SPDX-License-Identifier: Apache-2.0
"""The options of `paul train`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from training.errors import DataError


@dataclass(frozen=True)
class TrainingOptions:
    """Data, settings and outputs of a session.

    Attributes:
        data: npz files or bags, or one folder of motion capture.
        model: model file to write, or None.
        shapes: file of the frames' 3D shapes to write, or None.
        json: report that the caller writes, or None; here it is only checked.
        layout: of the points, name or YAML file; None: guessed.
        topic: of a bag's keypoints; None: the only one.
        camera_info_topic: of a bag's camera; None: the only one.
        image: of a bag's keypoints, ``auto``, ``rectified`` or ``raw``; see ``msg_adapters.read_camera_info``.
        min_confidence: keypoints of a bag below it count as hidden.
        recipe: name or YAML file.
        overrides: ``key=value`` settings of the recipe.
        fresh: start over instead of continuing.
        device: ``auto``, ``cpu`` or ``cuda``.
        threads: on the CPU.
        tensorboard: write logs for TensorBoard.
        quiet: show no progress.
        command: as typed, for the model's provenance.
    """

    data: tuple[Path, ...]
    model: Path | None = None
    shapes: Path | None = None
    json: Path | None = None
    layout: str | None = None
    topic: str | None = None
    camera_info_topic: str | None = None
    image: str = "auto"
    min_confidence: float = 0.3
    recipe: str = "default"
    overrides: tuple[str, ...] = ()
    fresh: bool = False
    device: str = "auto"
    threads: int = 1
    tensorboard: bool = False
    quiet: bool = False
    command: str = ""

    @property
    def outputs(self) -> tuple[Path | None, ...]:
        """All files that are asked for."""
        return self.model, self.shapes, self.json

    @property
    def run_folder(self) -> Path:
        """The folder of checkpoints: the model's or the shapes' name with the ending .run.

        Raises:
            DataError: neither is asked for.
        """
        output = self.model or self.shapes
        if output is None:
            raise DataError("nothing to write: name a model file with -o, or a file of 3D shapes with --shapes")
        return output.with_suffix(".run")
