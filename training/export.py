# SPDX-License-Identifier: Apache-2.0
"""From a finished run to the model file that the robot loads."""

from __future__ import annotations

import math
import platform
from pathlib import Path

import numpy as np
import torch

import paul_ros
from paul_ros.layout import Layout
from paul_ros.metrics import procrustes
from paul_ros.model import save_model
from training.chirality import rule_share, same_side_share
from training.data import TrainingData
from training.networks import Paul
from training.objective import fit
from training.recipe import Recipe
from training.trainer import Trainer
from training.views import NormalisedViews

_SHAPES, _COORDINATES = 4096, 2**24
"""Shapes of training frames that the mean is taken of: so many, or as many as have so many coordinates."""

_BATCH = 1024
_MEAN_ROUNDS = 10
_CLEAR = 0.95  # share of shapes on one side of the handedness rules that settles the chirality


def export_model(trainer: Trainer, loss: float, path: Path, command: str) -> dict:
    """Write encoder, decoder and mean shape; returns the header.

    Args:
        loss: the run's final one, see ``Reconstruction``.

    Raises:
        ModelError: the weights do not make a model (NaN, say).
    """
    layout, recipe = trainer.data.layout, trainer.recipe
    shapes = predict_shapes(trainer.networks, trainer.data, min(_SHAPES, _COORDINATES // (3 * len(layout.names))))
    mean = mean_shape(shapes)
    header = {
        "layout": layout.to_dict(),
        **architecture(recipe),
        **_scale(trainer),
        "chirality": _chirality(shapes, mean, layout, recipe.handedness_weight),
        "metres_per_unit": metres_per_unit(shapes, layout, recipe.known_lengths),
        **({"stature": recipe.stature} if recipe.stature else {}),
        **({"misfit": misfit(trainer)} if recipe.scale == "free" else {}),
        "training": {
            "data": trainer.data.source,
            "data_sha256": trainer.data.sha256,
            "frames": len(trainer.data.W),
            "command": command,
            "recipe": recipe.to_dict(),
            "steps": trainer.step,
            "seconds": round(trainer.seconds, 1),
            "final": {"loss": round(loss, 5)},
            "versions": {
                "paul_ros": paul_ros.__version__,
                "torch": torch.__version__.split("+")[0],
                "python": platform.python_version(),
            },
        },
    }
    save_model(path, header, {**_weights(trainer), "mean_shape": mean})
    return header


def architecture(recipe: Recipe) -> dict:
    """The part of the header that says how the networks are built."""
    return {
        "bottleneck": recipe.bottleneck,
        "architecture": {
            "encoder": {
                "kind": recipe.encoder,
                "width": recipe.width,
                "blocks": recipe.blocks,
                "upright": recipe.upright,
            },
            "decoder": {"kind": "mlp", "hidden": list(recipe.hidden)},
        },
    }


def _scale(trainer: Trainer) -> dict:
    """The part of the header that says what sizes mean: of the image points, and of the shapes."""
    if trainer.recipe.scale == "unit":
        return {
            "scale": "unit",
            "image_unit": trainer.data.image_unit,
            "normalisation": {
                "input": "centred on the mean of the visible points, divided by image_unit",
                "unit": "image_unit, as the image's",
            },
        }
    return {
        "scale": "free",
        "normalisation": {
            "input": "centred on the mean of the visible points, root mean square distance 1",
            "unit": "mean edge length" if trainer.data.layout.edges else "root mean square distance to the centre",
        },
    }


def _weights(trainer: Trainer) -> dict[str, np.ndarray]:
    """What runs on the robot: h and f_d, under the names that ``paul_ros.model`` gives them."""
    return {
        name: value.cpu().numpy()
        for name, value in trainer.networks.state_dict().items()
        if name.startswith(("encoder.", "decoder."))
    }


def _chirality(shapes: np.ndarray, mean: np.ndarray, layout: Layout, weight: float) -> dict:
    """Which of the two mirror images the model's shapes are, and how that is known.

    Without a rule to tell them apart, one sign for the whole model is left open by any number of orthographic views;
    how far the shapes agree on it among themselves is measured by their mean shape.  A rule speaks for its own category
    only.
    """
    share = rule_share(shapes, layout)
    if share is None:
        return {
            "known": False,
            "source": "orthographic views alone leave the mirror image open; "
            "give the layout a handedness rule to settle it",
            "same_side_share": round(same_side_share(shapes, mean), 4),
        }
    ruled = {point for rule in layout.handedness for point in rule.left}
    open_ = [name for name, points in layout.categories.items() if ruled.isdisjoint(points)]
    source = f"handedness rule of layout '{layout.name}', training weight {weight:g}"
    return {
        "known": share >= _CLEAR and not open_,
        "source": f"{source}; no rule for {', '.join(open_)}" if open_ else source,
        "training_share": round(share, 4),
    }


def mean_shape(shapes: np.ndarray) -> np.ndarray:
    """Generalised Procrustes mean (3,P) of canonical shapes (F,3,P): rotations only, sizes as they are."""
    points = shapes.transpose(0, 2, 1)
    mean = points[0]
    for _ in range(_MEAN_ROUNDS):
        R, _ = procrustes(points, np.broadcast_to(mean, points.shape))
        mean = np.einsum("nij,npj->pi", R, points) / len(points)
    return mean.T


@torch.no_grad()
def predict_shapes(networks: Paul, data: TrainingData, limit: int) -> np.ndarray:
    """Return canonical shapes (F,3,P) of up to ``limit`` evenly chosen training frames, from their 2D points by h."""
    rows = np.linspace(0, len(data.W) - 1, min(limit, len(data.W))).astype(int)
    device = next(networks.parameters()).device
    W, visible = torch.from_numpy(data.W[rows]).to(device), torch.from_numpy(data.visible[rows]).to(device)
    unit = None if networks.decoder.unit_size else data.image_unit
    views = NormalisedViews.of(W, visible, torch.ones(len(rows), 1, 1, device=device), False, unit)
    return networks.decoder(networks.encoder(views.W, visible)).double().cpu().numpy()


@torch.no_grad()
def misfit(trainer: Trainer) -> float:
    """Standard deviation of x and of y of visible training points about where the networks put them, in model units.

    From the median distance, for some points are misdetected: with Gaussian errors it is 1.177 standard deviations.
    """
    distances = []
    frames = len(trainer.data.W)
    for rows in torch.linspace(0, frames - 1, min(_SHAPES, frames)).long().split(_BATCH):
        views = trainer.views(rows)
        found = fit(trainer.networks, trainer.recipe, views, rows.to(trainer.device))
        off = (found.points - found.streams[-1])[:, :2] / found.camera.scale
        distances.append(off.norm(dim=1)[views.visible])
    return float(torch.cat(distances).median()) / math.sqrt(2 * math.log(2))


def metres_per_unit(shapes: np.ndarray, layout: Layout, known_lengths: tuple) -> float | None:
    """Metres per model unit from lengths known in advance: their sum over the sum of their median model lengths.

    Raises:
        KeyError: a name that is no point of the layout.
    """
    if not known_lengths:
        return None
    index = {name: i for i, name in enumerate(layout.names)}
    model = [
        np.median(np.linalg.norm(shapes[:, :, index[a]] - shapes[:, :, index[b]], axis=1)) for a, b, _ in known_lengths
    ]
    return float(sum(metres for _, _, metres in known_lengths) / sum(model))
