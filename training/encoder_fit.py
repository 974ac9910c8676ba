# SPDX-License-Identifier: Apache-2.0
"""Fit a 2D encoder h to trained free codes, so that the model also lifts unseen frames."""

from __future__ import annotations

import math

import torch

from training.progress import Progress, ignore_progress
from training.trainer import Trainer
from training.views import turned_views

STEPS = 3000
_BATCH = 128
_LEARNING_RATE = 1e-3


def fit_encoder(trainer: Trainer, steps: int = STEPS, progress: Progress = ignore_progress) -> float:
    """Train h by regression to the run's free codes.

    Codes have no scale of their own, so distances are between shapes: |f_d(h(W)) - f_d(phi)| over |f_d(phi)|. Views are
    turned in their plane by any angle, and half of them mirrored: the code of an orthographic view stays the same.

    Args:
        trainer: a finished run.
        steps: of Adam.
        progress: called with the share of the work that is done.

    Returns:
        The mean distance that is left.
    """
    networks, device = trainer.networks, trainer.device
    generator = torch.Generator().manual_seed(trainer.recipe.seed)
    weights = [weight.requires_grad_(True) for weight in networks.encoder.parameters()]
    adam = torch.optim.Adam(weights, _LEARNING_RATE, fused=True)
    left = []
    for step in range(steps):
        adam.param_groups[0]["lr"] = _LEARNING_RATE * 0.5 * (1 + math.cos(math.pi * step / steps))
        rows = torch.randint(len(trainer.data.W), (_BATCH,), generator=generator).to(device)
        angle, chance = torch.rand(2, _BATCH, generator=generator).to(device)
        turn, _ = turned_views(2 * math.pi * angle, chance < 0.5)
        views = trainer.views(rows)
        with torch.no_grad():
            goal = networks.decoder(networks.codes(views.W, views.visible, rows))
        found = networks.decoder(networks.encoder(turn @ views.W, views.visible))
        distance = (found - goal).square().sum((1, 2)).add(1e-8).sqrt().mean()
        gradients = torch.autograd.grad(distance, weights)
        for weight, gradient in zip(weights, gradients):
            weight.grad = gradient
        adam.step()
        left.append(distance.detach() / goal.square().sum((1, 2)).sqrt().mean())
        progress((step + 1) / steps)
    return torch.stack(left[-100:]).mean().item()
