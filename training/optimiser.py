# SPDX-License-Identifier: Apache-2.0
"""Adam on the networks' weights, which lie in one buffer for each learning rate."""

from __future__ import annotations

import torch
from torch import nn

from training.networks import Paul
from training.recipe import Recipe


def adam(networks: Paul, recipe: Recipe) -> torch.optim.Optimizer:
    """Return Adam on the weights that the recipe trains; free codes have a rate of their own.

    Each group keeps its full rate under ``peak``. Weights that are not trained are frozen.
    """
    codes = [] if networks.free_codes is None else list(networks.free_codes.parameters())
    idle: list[nn.Module] = [networks.encoder] if codes else []
    idle += [networks.shape_encoder] if recipe.streams == "decoder" else []
    for part in idle:
        part.requires_grad_(False)
    weights = [w for w in networks.parameters() if w.requires_grad and not any(w is code for code in codes)]
    groups = [{"params": [one_buffer(weights)], "peak": recipe.learning_rate}]
    if codes:
        groups.append({"params": [one_buffer(codes)], "peak": recipe.code_learning_rate})
    return torch.optim.Adam(groups, lr=recipe.learning_rate, fused=True)


def one_buffer(parameters: list[nn.Parameter]) -> nn.Parameter:
    """Move parameters and gradients into one vector, of which they become views; return that vector.

    An optimiser's step then costs the calls of one tensor. For dozens of small tensors these calls dominate.
    """
    buffer = nn.Parameter(nn.utils.parameters_to_vector(parameters).detach().clone())
    buffer.grad = torch.zeros_like(buffer)
    begin = 0
    for parameter in parameters:
        part = slice(begin, begin + parameter.numel())
        begin = part.stop
        parameter.data, parameter.grad = (x[part].view_as(parameter) for x in (buffer.data, buffer.grad))
    return buffer
