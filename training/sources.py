# SPDX-License-Identifier: Apache-2.0
"""The kinds of data that `paul train` takes, and the loader of each. Only this module decides by the kind of data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path

import torch

from paul_ros.layout import load_layout
from training.categories import load_files
from training.data import TrainingData
from training.options import TrainingOptions
from training.preflight import check_recipe
from training.recipe import Recipe


class DataKind(Enum):
    """Kind of data, by the number and type of its files."""

    ARRAYS = "npz arrays"
    BAG = "a bag of 2D keypoints"
    SEVERAL_FILES = "recordings of one layout, or categories of objects"
    MOTION_CAPTURE = "a folder of motion capture"


def kind_of(paths: Sequence[Path]) -> DataKind:
    """Return the kind of data at the paths."""
    if len(paths) > 1:
        return DataKind.SEVERAL_FILES
    (path,) = paths
    if path.is_dir() and not (path / "metadata.yaml").exists():
        from training.motion_capture import is_motion_capture

        if is_motion_capture(path):
            return DataKind.MOTION_CAPTURE
    return DataKind.ARRAYS if path.suffix == ".npz" else DataKind.BAG


def check_data(options: TrainingOptions) -> None:
    """Check before anything is read that no output harms the data.

    Raises:
        MocapError: an output would be taken for motion capture.
    """
    if kind_of(options.data) is DataKind.MOTION_CAPTURE:
        from training.motion_capture import check_motion_capture

        check_motion_capture(options)


def load_data(options: TrainingOptions, recipe: Recipe, device: torch.device) -> tuple[TrainingData, Recipe]:
    """Load the data, and complete the recipe by what the kind of data needs.

    The recipe fits the layout of the data (``check_recipe``) before any long work begins.

    Args:
        options: of the command.
        recipe: of the run.
        device: of this process.

    Returns:
        The data, and the recipe whose ``views`` are complete for motion capture and None for other data.

    Raises:
        DataError, BagError, MocapError, RecipeError: see the loaders.
    """
    return LOADERS[kind_of(options.data)](options, recipe, device)


def _load_files(options: TrainingOptions, recipe: Recipe, device: torch.device) -> tuple[TrainingData, Recipe]:
    layout = load_layout(options.layout) if options.layout else None
    data = load_files(options.data, layout, options.topic, options.min_confidence)
    check_recipe(options, recipe, data.layout)
    return data, replace(recipe, views=None)


def _load_motion_capture(options: TrainingOptions, recipe: Recipe, device: torch.device) -> tuple[TrainingData, Recipe]:
    from training.motion_capture import load_motion_capture

    return load_motion_capture(options, recipe, device)


LOADERS: dict[DataKind, Callable[[TrainingOptions, Recipe, torch.device], tuple[TrainingData, Recipe]]] = {
    DataKind.ARRAYS: _load_files,
    DataKind.BAG: _load_files,
    DataKind.SEVERAL_FILES: _load_files,
    DataKind.MOTION_CAPTURE: _load_motion_capture,
}
"""Loader by the kind of data. Only the last one imports ``training.people``."""
