# SPDX-License-Identifier: Apache-2.0
"""Everything that can be refused before the first step, and before torch is imported, which takes seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from paul_ros.layout import Layout
from paul_ros.model_file import check_size
from paul_ros.output_files import check_outputs
from training.data import TrainingData
from training.errors import DataError, RecipeError, TrainingError
from training.options import TrainingOptions
from training.recipe import Recipe, architecture
from training.run_folder import RUN_FILES, restarts, run_folder
from training.sources import is_motion_capture, load_keypoints
from training.tensorboard import require_tensorboard


@dataclass(frozen=True)
class Job:
    """A checked task for a session of training.

    Attributes:
        options: of the command.
        recipe: with the options' overrides.
        folders: of the runs, one for each restart.
        data: of files; None for a folder of motion capture, whose views the session makes or continues with.
    """

    options: TrainingOptions
    recipe: Recipe
    folders: tuple[Path, ...]
    data: TrainingData | None


def prepare(options: TrainingOptions) -> Job:
    """Check all options, and load the data unless it has to be made.

    Nothing is written.

    Raises:
        PaulError: bad data, recipe, layout or file.
    """
    recipe = Recipe.load(options.recipe, options.overrides)
    folders = tuple(run_folder(options.run_folder, recipe, one.seed) for one in restarts(recipe))
    if is_motion_capture(options.data):
        from training.motion_capture import check_motion_capture

        layout = check_motion_capture(options, recipe)
        check_options(options, recipe, folders)
        check_recipe(options, recipe, layout)
        return Job(options, recipe, folders, None)
    check_options(options, recipe, folders)
    data = load_keypoints(options)
    check_recipe(options, recipe, data.layout)
    return Job(options, replace(recipe, views=None), folders, data)


def check_options(options: TrainingOptions, recipe: Recipe, run_folders: Sequence[Path]) -> None:
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
