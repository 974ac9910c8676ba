# SPDX-License-Identifier: Apache-2.0
"""Checks before the first step: everything that can be refused early is refused here."""

from __future__ import annotations

from pathlib import Path

from paul_ros.layout import Layout
from paul_ros.model_file import check_size
from paul_ros.output_files import check_outputs
from training.checkpoint import CHECKPOINT, LOG
from training.errors import DataError, RecipeError, TrainingError
from training.export import architecture
from training.options import TrainingOptions
from training.recipe import Recipe
from training.start.kept_start import START
from training.tensorboard import require_tensorboard

RUN_FILES = (CHECKPOINT, LOG, START)
"""Files that a run keeps in its folder."""


def check_options(options: TrainingOptions, recipe: Recipe, run_folders: list[Path]) -> None:
    """Check the number of threads, the packages, and all files to be written.

    Raises:
        TrainingError: no threads.
        MissingPackageError: TensorBoard is asked for and not installed.
        DataError: nothing to write, or a file that is no .npz.
        BagError: an output would overwrite an input or another output, or cannot be written.
        RecipeError: a model is asked for, but the recipe trains no networks.
    """
    if options.threads < 1:
        raise TrainingError(f"--threads must be at least 1, it is {options.threads}")
    for path in filter(None, (options.model, options.shapes)):
        if path.suffix != ".npz":
            raise DataError(f"the file must end in .npz, not '{path.name}'")
    kept = [folder / name for folder in run_folders for name in RUN_FILES]
    check_outputs([*options.outputs, *kept], [*options.data, options.recipe, options.layout])
    if options.model and not recipe.steps and not recipe.regression_steps:
        raise RecipeError("no networks are trained with steps: 0, so there is no model: ask for --shapes instead of -o")
    if options.tensorboard:
        require_tensorboard()


def check_recipe(options: TrainingOptions, recipe: Recipe, layout: Layout) -> None:
    """Check that the recipe fits the layout of the points.

    Raises:
        RecipeError: its known lengths name other points.
        ModelError: a model is asked for, and its file would be too large to load.
    """
    try:
        recipe.check_points(layout)
    except RecipeError as error:
        if recipe.known_lengths != Recipe.load(options.recipe).known_lengths:
            raise
        raise RecipeError(f"recipe {options.recipe} is for layouts with the points that it names: {error}") from error
    if options.model:
        check_size(architecture(recipe), len(layout.names))
