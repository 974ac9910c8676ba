# SPDX-License-Identifier: Apache-2.0
"""Export a finished run to the model file that the robot loads."""

from __future__ import annotations

import math
import platform
from pathlib import Path

import numpy as np
import torch

import paul_ros
from paul_ros.layout import Layout
from paul_ros.metrics import procrustes
from paul_ros.model_file import save_model
from training.chirality import CLEAR_SHARE, rule_share, same_side_share
from training.data import TrainingData
from training.networks import Paul
from training.objective import fit
from training.recipe import Recipe
from training.trainer import Trainer
from training.views import NormalisedViews

_SHAPES, _COORDINATES = 4096, 2**24
"""Largest number of training shapes whose mean is taken, and of their coordinates."""

_BATCH = 1024
_MEAN_ROUNDS = 10


def export_model(trainer: Trainer, loss: float, path: Path, command: str) -> dict:
    """Write encoder, decoder and mean shape; return the header.

    Args:
        trainer: the finished run.
        loss: its final loss, see ``Reconstruction``.
        path: of the model file.
        command: as typed, for provenance.

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
            "notes": list(trainer.data.notes),
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
    """Return the part of the header that describes the networks."""
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
    """Return the part of the header that defines the units of image points and shapes."""
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
    """Return the weights that the robot needs, of h and f_d, under the names of ``paul_ros.model``."""
    return {
        name: value.cpu().numpy()
        for name, value in trainer.networks.state_dict().items()
        if name.startswith(("encoder.", "decoder."))
    }


def _chirality(shapes: np.ndarray, mean: np.ndarray, layout: Layout, weight: float) -> dict:
    """Return the part of the header about the mirror image: whether it is known, and from where.

    Without a handedness rule any number of orthographic views leaves one sign for the whole model open. The mean shape
    then measures how far the shapes agree among themselves. A rule holds for its own category only.
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
        "known": share >= CLEAR_SHARE and not open_,
        "source": f"{source}; no rule for {', '.join(open_)}" if open_ else source,
        "training_share": round(share, 4),
    }


def mean_shape(shapes: np.ndarray) -> np.ndarray:
    """Return the generalised Procrustes mean (3,P) of canonical shapes (F,3,P), with rotations and without scales."""
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
    """Return the standard deviation, in model units, of visible training points from the networks' points, per axis.

    It is computed from the median distance, because some points are misdetected. For Gaussian errors the median is
    1.177 standard deviations.
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
    """Return metres per model unit: the sum of known lengths over the sum of their median lengths in the model.

    Args:
        shapes: (F,3,P) canonical shapes, model units.
        layout: of the points.
        known_lengths: (point, point, metres) each; without any the result is None.

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
