# SPDX-License-Identifier: Apache-2.0
"""The kind of data of `paul train`, decided once: a folder of motion capture, or files of 2D keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from paul_ros.layout import load_layout
from training.categories import load_files
from training.data import TrainingData
from training.options import TrainingOptions
from training.preflight import check_recipe
from training.recipe import Recipe


def load_data(options: TrainingOptions, recipe: Recipe, device: torch.device) -> tuple[TrainingData, Recipe]:
    """Load the data, and complete the recipe by what the kind of data needs.

    Only a folder of motion capture imports ``training.people``. The recipe fits the layout of the data
    (``check_recipe``) before any long work begins.

    Args:
        options: of the command.
        recipe: of the run.
        device: of this process.

    Returns:
        The data, and the recipe whose ``views`` are complete for motion capture and None for other data.

    Raises:
        DataError, BagError, MocapError, RecipeError: see the loaders.
        ModelError: see ``check_recipe``.
    """
    if is_motion_capture(options.data):
        from training.motion_capture import load_motion_capture

        return load_motion_capture(options, recipe, device)
    layout = load_layout(options.layout) if options.layout else None
    data = load_files(options.data, layout, options.topic, options.min_confidence)
    check_recipe(options, recipe, data.layout)
    return data, replace(recipe, views=None)


def is_motion_capture(paths: Sequence[Path]) -> bool:
    """Return whether the data is one folder that holds files of motion capture and is no bag."""
    path = Path(paths[0])
    if len(paths) > 1 or not path.is_dir() or (path / "metadata.yaml").exists():
        return False
    from training.people.clips import motion_files

    return bool(motion_files(path))
