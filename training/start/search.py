# SPDX-License-Identifier: Apache-2.0
"""The search for the start that a recipe asks for."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import torch

from training.frames import Frames
from training.progress import Progress
from training.recipe import Recipe
from training.start import warm_start
from training.start.start import Start

START_UNIT = {"free": 0.5**0.5, "unit": 1.0}
"""Root mean square coordinate of ``NormalisedViews.W`` by the recipe's scale. Searches need the value 1."""

_FAR_SHARE = 1 / 3
"""Share of calibrated frames, those of the smallest images, that are searched."""


def find_start(frames: Frames, recipe: Recipe, progress: Progress | None) -> Start:
    """Search for the recipe's start.

    Raises:
        StartError: the frames give none.
    """
    views = frames.views(torch.arange(len(frames)))
    W, visible = views.W.cpu().numpy() / START_UNIT[recipe.scale], views.visible.cpu().numpy()
    if not views.calibrated:
        return search(recipe.start, W, visible, recipe.seed, progress)
    # Searches assume parallel projection. Perspective is weakest in the smallest images.
    far = views.size.flatten().argsort().cpu().numpy()[: max(1, round(_FAR_SHARE * len(W)))]
    found = search(recipe.start, W[far], visible[far], recipe.seed, progress)
    return replace(found, rows=far[found.rows])


def search(kind: str, W: np.ndarray, visible: np.ndarray, seed: int, progress: Progress | None) -> Start:
    """Search from 2D alone.

    Args:
        kind: ``linear`` or ``rigid``.
        W: (F,2,P) centred on the visible points, root mean square coordinate 1.
        visible: (F,P) bool.
        seed: of the random starts.
        progress: called with the share of the work that is done.
    """
    begun = time.monotonic()
    find = {"linear": warm_start.linear_start, "rigid": warm_start.rigid_start}[kind]
    found = find(W, visible, seed, progress)
    return Start(
        np.asarray(found.rows, np.int64),
        np.asarray(found.shapes, np.float32),
        np.asarray(found.rotations, np.float32),
        float(found.score),
        time.monotonic() - begun,
    )
