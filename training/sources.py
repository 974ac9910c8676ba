# SPDX-License-Identifier: Apache-2.0
"""The kind of data of `paul train`, decided once: a folder of motion capture, or files of 2D keypoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from paul_ros.layout import load_layout
from training.categories import load_files
from training.data import TrainingData
from training.errors import DataError
from training.options import TrainingOptions
from training.preflight import check_recipe
from training.recipe import Recipe

Loader = Callable[[TrainingOptions, Recipe, torch.device], tuple[TrainingData, Recipe]]
"""Loads the data, and completes the recipe by what the kind of data needs.

The recipe's ``views`` are then complete for motion capture and None for other data. The recipe fits the layout of the
data (``check_recipe``) before any long work begins.
"""


def loader_of(options: TrainingOptions) -> Loader:
    """Return the loader for the kind of data. Only a folder of motion capture imports ``training.people``.

    Raises:
        MocapError: an output lies in the folder of motion capture.
    """
    if not is_motion_capture(options.data):
        return load_keypoints
    from training.motion_capture import check_outputs_outside, load_motion_capture

    check_outputs_outside(options)
    return load_motion_capture


def is_motion_capture(paths: Sequence[Path]) -> bool:
    """Return whether the data is one folder that holds files of motion capture and is no bag."""
    path = Path(paths[0])
    if len(paths) > 1 or not path.is_dir() or (path / "metadata.yaml").exists():
        return False
    from training.people.clips import motion_files

    return bool(motion_files(path))


def load_keypoints(options: TrainingOptions, recipe: Recipe, device: torch.device) -> tuple[TrainingData, Recipe]:
    """Load npz files and bags in every process; see ``Loader``.

    Raises:
        DataError, BagError, LayoutError: see ``load_files``; or a folder holds no data.
        RecipeError, ModelError: see ``check_recipe``.
    """
    for path in options.data:
        _check_folder(Path(path))
    layout = load_layout(options.layout) if options.layout else None
    data = load_files(options.data, layout, options.topic, options.min_confidence, options.camera_info_topic)
    check_recipe(options, recipe, data.layout)
    return data, replace(recipe, views=None)


def _check_folder(path: Path) -> None:
    """Raise DataError if the path is a folder without recordings."""
    from paul_ros.offline.bag_folder import METADATA, bag_files

    if path.is_dir() and not (path / METADATA).exists() and not bag_files(path):
        raise DataError(
            f"{path}: no recording in this folder (.mcap, .db3), and no motion capture (.asf with .amc, .bvh, .npz)"
        )
