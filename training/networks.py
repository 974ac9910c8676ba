# SPDX-License-Identifier: Apache-2.0
"""The networks of the paper: 2D encoder h (or free codes), shape decoder f_d, shape encoder f_e.

Parameters have the names of the model file, so that export copies encoder and decoder unchanged.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from paul_ros.layout import Layout, Part
from paul_ros.model import CONVOLUTIONAL, RESIDUAL
from paul_ros.model_file import dictionary_sizes
from training.recipe import Recipe

_FREE_CODE_SIZE = 0.1
"""Standard deviation of the initial free codes; values ten times smaller or larger trained worse."""


class _Layers(torch.autograd.Function):
    """Linear layers with an ELU between them: x (N,inputs), weights and biases to (N,outputs).

    All layers are one function of autograd: in small batches its bookkeeping would cost as much as the layers. The ELU
    uses exp, which is several times faster than expm1 and as accurate, as the slope comes from the result.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, *parameters: Tensor) -> Tensor:
        weights, biases = parameters[::2], parameters[1::2]
        inputs = [x]
        for weight, bias in zip(weights[:-1], biases[:-1]):
            y = torch.addmm(bias, inputs[-1], weight.T)
            below = y.clamp_max(0).exp_().sub_(1)
            inputs.append(torch.maximum(y, below, out=below))
        ctx.save_for_backward(*inputs, *weights)
        return torch.addmm(biases[-1], inputs[-1], weights[-1].T)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        count = len(ctx.saved_tensors) // 2
        inputs, weights = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        found = []
        for layer in reversed(range(count)):
            found += [gradient.sum(0), gradient.T @ inputs[layer]]
            gradient = gradient @ weights[layer]
            if layer:
                gradient = torch.ops.aten.elu_backward(gradient, 1, 1, 1, True, inputs[layer])
        return gradient, *reversed(found)


def _through(layers: nn.ModuleList, x: Tensor) -> Tensor:
    return _Layers.apply(x, *(parameter for layer in layers for parameter in (layer.weight, layer.bias)))


class ResidualBlock(nn.Module):
    """Two linear layers with a skip (Martinez et al., ICCV 2017), without batch normalisation or dropout."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.first(x).relu_()).relu_()


class Encoder(nn.Module, ABC):
    """h: normalised image points (N,2,P) and visibility (N,P) to codes (N,K).

    Args:
        axes: (2,P) by which views are turned upright (``paul_ros.model.upright``); None leaves them as they are.
    """

    axes: Tensor | None

    def __init__(self, axes: Tensor | None) -> None:
        super().__init__()
        self.register_buffer("axes", axes)

    def forward(self, W: Tensor, visible: Tensor) -> Tensor:
        return self.code(W if self.axes is None else upright(W, self.axes), visible)

    @abstractmethod
    def code(self, W: Tensor, visible: Tensor) -> Tensor:
        """Return codes (N,K) of views that are upright already."""


class ResidualEncoder(Encoder):
    """h: normalised image points (N,2,P) and visibility (N,P) to codes (N,K), by residual blocks.

    Martinez et al. use 2 blocks; C3DPO (Novotny et al., ICCV 2019) is as deep as 6 blocks of width 1024.
    """

    def __init__(self, points: int, bottleneck: int, width: int, blocks: int, axes: Tensor | None = None) -> None:
        super().__init__(axes)
        self.input = nn.Linear(3 * points, width)
        self.blocks = nn.ModuleList(ResidualBlock(width) for _ in range(blocks))
        self.output = nn.Linear(width, bottleneck)

    def code(self, W: Tensor, visible: Tensor) -> Tensor:
        x = self.input(torch.cat([W.flatten(1), visible.to(W.dtype)], dim=1)).relu_()
        for block in self.blocks:
            x = block(x)
        return self.output(x)


class ConvolutionalEncoder(Encoder):
    """h: normalised image points (N,2,P) and visibility (N,P) to codes (N,K), by block-sparse coding.

    This is the encoder of Deep NRSfM (Kong and Lucey, ICCV 2019). An orthographic view of S = sum_k c_k D_k by a camera
    R is W = sum_k (c_k R) D_k. A dictionary thus finds blocks of 3 x 2 numbers in a frame, and a dictionary of
    dictionaries acts on all six numbers of a block alike. Each layer is one iteration of ISTA from zero. It multiplies
    by the transposed dictionary, a convolution of kernel 3 x 1 in the first layer and 1 x 1 in later ones. Then it
    applies a threshold for each atom, a block soft threshold relaxed to a ReLU. The number of atoms falls to the
    bottleneck in equal steps. The code is linear in the last blocks.

    Hidden points are masked as in Deep NRSfM++ (Wang et al., 3DV 2020), which centres D on the visible points and
    leaves out its hidden columns. Here W is centred on the visible points and 0 where hidden: the products are equal.

    Three things differ from Deep NRSfM. The decoder does not share the dictionaries, as f_d is PAUL's. The camera is
    solved for, not read off the blocks. The last layer also gets the visibility mask.
    """

    def __init__(self, points: int, bottleneck: int, width: int, blocks: int, axes: Tensor | None = None) -> None:
        super().__init__(axes)
        atoms = dictionary_sizes(width, blocks, bottleneck)
        sizes = [(3 * atoms[0], points), *zip(atoms[1:], atoms)]
        self.dictionaries = nn.ParameterList(torch.empty(size) for size in sizes)
        self.thresholds = nn.ParameterList(torch.zeros(size) for size in atoms)
        for dictionary in self.dictionaries:
            nn.init.kaiming_normal_(dictionary)
        self.output = nn.Linear(6 * atoms[-1] + points, bottleneck)

    def code(self, W: Tensor, visible: Tensor) -> Tensor:
        first, *others = self.dictionaries
        x = (W @ first.T).reshape(len(W), 6, -1)
        x = F.relu(x - self.thresholds[0])
        for dictionary, threshold in zip(others, self.thresholds[1:]):
            x = F.relu(x @ dictionary.T - threshold)
        return self.output(torch.cat([x.flatten(1), visible.to(W.dtype)], dim=1))


ENCODERS = {RESIDUAL: ResidualEncoder, CONVOLUTIONAL: ConvolutionalEncoder}


class ShapeDecoder(nn.ModuleList):
    """f_d: codes (N,K) to canonical shapes (N,3,P) in model units, centred on their mean.

    Attributes:
        unit_size: shapes have unit size (``to_unit_size``), as the camera has a scale; else they keep their own size.
    """

    def __init__(self, layout: Layout, bottleneck: int, hidden: tuple[int, ...], unit_size: bool) -> None:
        sizes = [bottleneck, *hidden, 3 * len(layout.names)]
        super().__init__(nn.Linear(inputs, outputs) for inputs, outputs in zip(sizes, sizes[1:]))
        self.layout, self.unit_size = layout, unit_size

    def forward(self, code: Tensor) -> Tensor:
        S = _through(self, code).unflatten(1, (3, -1))
        return to_unit_size(S, self.layout) if self.unit_size else to_centre(S, self.layout)


class ShapeEncoder(nn.ModuleList):
    """f_e: canonical shapes (N,3,P) to codes (N,K); the decoder's layers in reverse."""

    def __init__(self, points: int, bottleneck: int, hidden: tuple[int, ...]) -> None:
        sizes = [3 * points, *reversed(hidden), bottleneck]
        super().__init__(nn.Linear(inputs, outputs) for inputs, outputs in zip(sizes, sizes[1:]))

    def forward(self, S: Tensor) -> Tensor:
        return _through(self, S.flatten(1))


class Paul(nn.Module):
    """All networks of a run.

    Codes come from h, or are free variables of the training frames. h exists in both cases: the model file needs it.

    Attributes:
        free_codes: of the frames; None if h gives the codes.
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
        """Return codes (N,K): h(W, visible), or free codes by frame number.

        Args:
            W: (N,2,P) normalised image points.
            visible: (N,P) bool.
            rows: (N,) frame numbers.
        """
        return self.encoder(W, visible) if self.free_codes is None else self.free_codes(rows)


def build_networks(layout: Layout, recipe: Recipe, frames: int, axes: Tensor | None = None) -> Paul:
    """Return the recipe's networks for a layout, with fresh weights from torch's default generator.

    Args:
        layout: of the points.
        recipe: of the run.
        frames: number of training frames, for free codes.
        axes: (2,P) of ``Encoder``.
    """
    points, K = len(layout.names), recipe.bottleneck
    encoder = ENCODERS[recipe.encoder](points, K, recipe.width, recipe.blocks, axes)
    decoder = ShapeDecoder(layout, K, recipe.hidden, unit_size=recipe.scale == "free")
    shape_encoder = ShapeEncoder(points, K, recipe.hidden)
    free_codes = None
    if recipe.codes == "free":
        free_codes = nn.Embedding(frames, K)
        nn.init.normal_(free_codes.weight, std=_FREE_CODE_SIZE)
    return Paul(encoder, decoder, shape_encoder, free_codes)


def main_axes(W: Tensor, layout: Layout) -> Tensor:
    """Return (2,P) weights of points, the first two principal directions of views (F,2,P): their sums are longest.

    Each category has directions of its own. Joint ones could nearly vanish in the views of one category.
    """
    axes = W.new_zeros(2, W.shape[2])
    for part in layout.parts:
        own = W[:, :, list(part.points)].flatten(0, 1).double()
        axes[:, list(part.points)] = torch.linalg.svd(own, full_matrices=False).Vh[:2].to(W)
    return axes


def upright(W: Tensor, axes: Tensor) -> Tensor:
    """The torch twin of ``paul_ros.model.upright``."""
    x, y = F.normalize(W @ axes[0], dim=1).unbind(1)
    turned = torch.stack([torch.stack([y, -x], 1), torch.stack([x, y], 1)], 1) @ W
    side = torch.where(turned[:, 0] @ axes[1] < 0, -1.0, 1.0)
    return turned * torch.stack([side, torch.ones_like(side)], 1)[..., None]


def to_centre(S: Tensor, layout: Layout) -> Tensor:
    """The torch twin of ``paul_ros.model.to_centre``."""
    if len(layout.parts) == 1:
        return S - S.mean(2, keepdim=True)
    return _joined([part - part.mean(2, keepdim=True) for part in _split(S, layout)], layout)


def to_unit_size(S: Tensor, layout: Layout) -> Tensor:
    """The torch twin of ``paul_ros.model.to_unit_size``."""
    S = to_centre(S, layout)
    if len(layout.parts) == 1:
        return S / _size(S, S, layout.parts[0])
    return _joined([own / _size(S, own, part) for own, part in zip(_split(S, layout), layout.parts)], layout)


def _size(S: Tensor, own: Tensor, part: Part) -> Tensor:
    """Return sizes (N,1,1) of one part of shapes (N,3,P), from its edges or else from its own points (N,3,p)."""
    if part.edges:
        size = _lengths(S, part.edges).mean(1)
    else:
        size = own.square().sum((1, 2)).div(own.shape[2]).clamp_min(1e-12).sqrt()
    return size.clamp_min(1e-6)[:, None, None]


def _split(S: Tensor, layout: Layout) -> list[Tensor]:
    return [S[:, :, list(part.points)] for part in layout.parts]


def _joined(parts: list[Tensor], layout: Layout) -> Tensor:
    """Join parts of shapes; the inverse of ``_split``."""
    order = torch.tensor([point for part in layout.parts for point in part.points], device=parts[0].device)
    return torch.cat(parts, dim=2)[:, :, order.argsort()]


def edge_lengths(S: Tensor, layout: Layout) -> Tensor:
    """Return lengths (N,E) of the layout's edges in shapes (N,3,P)."""
    return _lengths(S, layout.edges)


def _lengths(S: Tensor, edges: tuple[tuple[int, int], ...]) -> Tensor:
    start, end = map(list, zip(*edges))
    # The small constant keeps the square root's gradient finite where two points coincide.
    return (S[:, :, start] - S[:, :, end]).square().sum(1).add(1e-12).sqrt()
