# SPDX-License-Identifier: Apache-2.0
"""A folder of motion capture as training data: people seen by random cameras and imperfect detectors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from paul_ros.layout import Layout, load_layout
from training.data import TrainingData
from training.errors import DataError, MocapError
from training.loading import load_training_data
from training.options import TrainingOptions
from training.people.human_data import check_outside, make_file, views_of
from training.people.human_points import human_layout
from training.recipe import Recipe

if TYPE_CHECKING:
    import torch

VIEWS_FILE = "views.npz"
"""File of the views in the run's folder."""


def check_motion_capture(options: TrainingOptions, recipe: Recipe) -> Layout:
    """Check all but the files of motion capture, since views take minutes; return the layout of the points.

    Raises:
        RecipeError: the recipe has no settings of views.
        DataError: the layout has other points than motion capture gives.
        MocapError: an output lies in the folder that is read, and the next run would take it for motion capture.
    """
    check_outside(options.data[0], options.outputs)
    views_of(recipe)
    own = human_layout()
    layout = load_layout(options.layout) if options.layout else own
    if len(own.names) != len(layout.names):
        raise DataError(
            f"motion capture gives the {len(own.names)} points of layout {own.name}, not the {len(layout.names)} of "
            f"{layout.name}: leave out --layout {options.layout}"
        )
    return layout


def load_motion_capture(options: TrainingOptions, recipe: Recipe, device: torch.device) -> tuple[TrainingData, Recipe]:
    """Make views of a folder of motion capture, or load those that the run's folder keeps.

    Only the first process makes them.

    Args:
        options: of the command.
        recipe: with settings of the views.
        device: of this process.

    Returns:
        The data, and the recipe with all settings of the views.

    Raises:
        MocapError: the files cannot be used.
    """
    from training.distributed import from_first  # with torch, which takes seconds

    settings, path = views_of(recipe), options.run_folder / VIEWS_FILE

    def make() -> bytes | None:
        # An error that only one process raised would leave the others waiting: all get its text.
        try:
            if options.fresh:
                path.unlink(missing_ok=True)
            make_file(options.data[0], settings, path, quiet=options.quiet)
        except (MocapError, OSError) as error:
            return str(error).encode()
        return None

    if failure := from_first(make, device):
        raise MocapError(failure.decode())
    return load_training_data(path, check_motion_capture(options, recipe)), replace(recipe, views=settings.to_dict())
