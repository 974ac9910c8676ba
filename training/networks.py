# SPDX-License-Identifier: Apache-2.0
"""The networks of the paper: 2D encoder h (or free codes), shape decoder f_d, shape encoder f_e.

Parameter names are those of the model file, so that the trained encoder and decoder are exported as they are.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from paul_ros.skeleton import Layout
from training.recipe import Recipe

_FREE_CODE_SIZE = 0.1
"""Standard deviation of free codes at the start: a tenth or ten times of it trained worse."""


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
    """f_d: codes (N,K) to canonical shapes (N,3,P) in model units, centred on their mean.

    ``unit_size``: shapes are of unit size (``to_unit_size``), as their scale is a camera's; else they keep their own.
    """

    def __init__(self, layout: Layout, bottleneck: int, hidden: tuple[int, ...], unit_size: bool) -> None:
        sizes = [bottleneck, *hidden, 3 * len(layout.names)]
        super().__init__(nn.Linear(inputs, outputs) for inputs, outputs in zip(sizes, sizes[1:]))
        self.layout, self.unit_size = layout, unit_size

    def forward(self, code: Tensor) -> Tensor:
        *inner, last = self
        for layer in inner:
            code = F.elu(layer(code))
        S = last(code).unflatten(1, (3, -1))
        return to_unit_size(S, self.layout) if self.unit_size else S - S.mean(2, keepdim=True)


class ShapeEncoder(nn.ModuleList):
    """f_e: canonical shapes (N,3,P) to codes (N,K); the decoder's layers in reverse."""

    def __init__(self, points: int, bottleneck: int, hidden: tuple[int, ...]) -> None:
        sizes = [3 * points, *reversed(hidden), bottleneck]
        super().__init__(nn.Linear(inputs, outputs) for inputs, outputs in zip(sizes, sizes[1:]))

    def forward(self, S: Tensor) -> Tensor:
        x = S.flatten(1)
        *inner, last = self
        for layer in inner:
            x = F.elu(layer(x))
        return last(x)


class Paul(nn.Module):
    """The networks together.

    Codes come from h, or are free variables of the training frames (``free_codes``, None where h gives them).  h is
    there in either case: the model file needs one.
    """

    def __init__(
        self,
        encoder: nn.Module,
        decoder: ShapeDecoder,
        shape_encoder: ShapeEncoder,
        free_codes: nn.Embedding | None = None,
    ) -> None:
        super().__init__()
        self.encoder, self.decoder, self.shape_encoder = encoder, decoder, shape_encoder
        self.free_codes = free_codes

    def codes(self, W: Tensor, visible: Tensor, rows: Tensor) -> Tensor:
        """Codes (N,K) of normalised image points W (N,2,P) with visibility (N,P); rows (N,) are their frame numbers.

        Free codes are looked up by frame number; else they are h(W, visible) and the numbers are not looked at.
        """
        return self.encoder(W, visible) if self.free_codes is None else self.free_codes(rows)


def build_networks(layout: Layout, recipe: Recipe, frames: int) -> Paul:
    """The recipe's networks for a layout, with fresh weights from torch's default generator.

    Args:
        frames: number of training frames, for free codes.
    """
    points, K = len(layout.names), recipe.bottleneck
    encoder = PointEncoder(points, K, recipe.width, recipe.blocks)
    decoder = ShapeDecoder(layout, K, recipe.hidden, unit_size=recipe.scale == "free")
    shape_encoder = ShapeEncoder(points, K, recipe.hidden)
    free_codes = None
    if recipe.codes == "free":
        free_codes = nn.Embedding(frames, K)
        nn.init.normal_(free_codes.weight, std=_FREE_CODE_SIZE)
    return Paul(encoder, decoder, shape_encoder, free_codes)


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
