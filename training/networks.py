# SPDX-License-Identifier: Apache-2.0
"""The three networks of the paper: 2D encoder h, shape decoder f_d, shape encoder f_e.

Parameter names are those of the model file, so that the trained encoder and decoder are exported as they are.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from paul_ros.skeleton import Layout


class ResidualBlock(nn.Module):
    """Two linear layers with a skip (Martinez et al., ICCV 2017), without batch normalisation or dropout."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + F.relu(self.second(F.relu(self.first(x))))


class PointEncoder(nn.Module):
    """h: normalised image points (N,2,P) and visibility (N,P) to codes (N,K)."""

    def __init__(self, points: int, bottleneck: int, width: int, blocks: int) -> None:
        super().__init__()
        self.input = nn.Linear(3 * points, width)
        self.blocks = nn.ModuleList(ResidualBlock(width) for _ in range(blocks))
        self.output = nn.Linear(width, bottleneck)

    def forward(self, W: Tensor, visible: Tensor) -> Tensor:
        x = F.relu(self.input(torch.cat([W.flatten(1), visible.to(W.dtype)], dim=1)))
        for block in self.blocks:
            x = block(x)
        return self.output(x)


class ShapeDecoder(nn.ModuleList):
    """f_d: codes (N,K) to canonical shapes (N,3,P) in model units."""

    def __init__(self, layout: Layout, bottleneck: int, hidden: list[int]) -> None:
        sizes = [bottleneck, *hidden, 3 * len(layout.names)]
        super().__init__(nn.Linear(inputs, outputs) for inputs, outputs in zip(sizes, sizes[1:]))
        self.layout = layout

    def forward(self, code: Tensor) -> Tensor:
        *inner, last = self
        for layer in inner:
            code = F.elu(layer(code))
        return to_unit_size(last(code).unflatten(1, (3, -1)), self.layout)


class ShapeEncoder(nn.ModuleList):
    """f_e: canonical shapes (N,3,P) to codes (N,K); the decoder's layers in reverse."""

    def __init__(self, points: int, bottleneck: int, hidden: list[int]) -> None:
        sizes = [3 * points, *reversed(hidden), bottleneck]
        super().__init__(nn.Linear(inputs, outputs) for inputs, outputs in zip(sizes, sizes[1:]))

    def forward(self, S: Tensor) -> Tensor:
        x = S.flatten(1)
        *inner, last = self
        for layer in inner:
            x = F.elu(layer(x))
        return last(x)


class Paul(nn.Module):
    """h, f_d and f_e together."""

    def __init__(self, layout: Layout, bottleneck: int, hidden: list[int], width: int, blocks: int) -> None:
        super().__init__()
        points = len(layout.names)
        self.encoder = PointEncoder(points, bottleneck, width, blocks)
        self.decoder = ShapeDecoder(layout, bottleneck, hidden)
        self.shape_encoder = ShapeEncoder(points, bottleneck, hidden)


def to_unit_size(S: Tensor, layout: Layout) -> Tensor:
    """The torch twin of ``paul_ros.model.to_unit_size``."""
    S = S - S.mean(2, keepdim=True)
    if layout.edges:
        size = edge_lengths(S, layout).mean(1)
    else:
        size = S.square().sum((1, 2)).div(S.shape[2]).clamp_min(1e-12).sqrt()
    return S / size.clamp_min(1e-6)[:, None, None]


def edge_lengths(S: Tensor, layout: Layout) -> Tensor:
    """Lengths (N,E) of the layout's edges in shapes (N,3,P)."""
    start, end = map(list, zip(*layout.edges))
    # The small constant keeps the square root's gradient finite where two points coincide.
    return (S[:, :, start] - S[:, :, end]).square().sum(1).add(1e-12).sqrt()
