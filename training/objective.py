# SPDX-License-Identifier: Apache-2.0
"""The training objective: reconstruction losses of both streams plus regularisers (the paper's equations 6-8).

Two streams decode a code phi = h(W, M): S_AD = f_d(phi) and S_AE = f_d(f_e(f_d(phi))).  Both have to match the
observed points once the camera (the lower-level problem) is solved, and the unknown depth z - and all three
coordinates of hidden points - is a free variable, whose optimum is the mean of the two streams.
"""
from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from paul_ros.skeleton import Layout
from training.networks import Paul, edge_lengths
from training.solver import centre, solve_camera


@dataclass(frozen=True)
class Terms:
    """Loss terms of one batch, each a scalar mean over its frames."""

    recon_ae: Tensor
    recon_ad: Tensor
    code: Tensor
    handedness: Tensor
    bones: Tensor


def paul_terms(networks: Paul, layout: Layout, W: Tensor, visible: Tensor) -> Terms:
    """Evaluate the objective on normalised image points W (N,2,P), visible (N,P)."""
    code = networks.encoder(W, visible)
    S_ad = networks.decoder(code)
    S_ae = networks.decoder(networks.shape_encoder(S_ad))
    R, scale = solve_camera((S_ad + S_ae) / 2, W, visible)
    ae, ad = (scale * R @ centre(S, visible) for S in (S_ae, S_ad))
    free = (ae + ad) / 2  # z*, and the whole of every hidden point
    seen = visible[:, None] & torch.tensor([True, True, False], device=W.device)[:, None]
    target = torch.where(seen, torch.cat([W, W[:, :1]], dim=1), free)
    return Terms(
        recon_ae=_distance(ae, target),
        recon_ad=_distance(ad, target),
        code=code.square().sum(1).mean(),
        handedness=handedness_violation(S_ad, layout),
        bones=bone_variation(S_ad, layout),
    )


def _distance(X: Tensor, target: Tensor) -> Tensor:
    """Mean over frames of the unsquared Frobenius distance, per point."""
    return (X - target).square().sum((1, 2)).div(X.shape[2]).add(1e-8).sqrt().mean()


def handedness_violation(S: Tensor, layout: Layout, margin: float = 0.5) -> Tensor:
    """How far shapes (N,3,P) are from the layout's handedness rules: 0 where left x up points forward everywhere.

    Two mirror images of a shape have the same orthographic views, and without a hint frames settle on either: the
    model is then a mixture of both.  An anatomical rule, one bit of knowledge about the object, settles it.
    """
    if not layout.handedness:
        return S.new_zeros(())
    turns = []
    for rule in layout.handedness:
        middle = {part: S[:, :, list(points)].mean(2) for part, points in vars(rule).items()}
        left = middle["left"] - middle["right"]
        up = middle["above"] - middle["below"]
        forward = middle["front"] - middle["behind"]
        volume = (torch.linalg.cross(left, up) * forward).sum(1)
        turns.append(volume / (left.norm(dim=1) * up.norm(dim=1) * forward.norm(dim=1)).clamp_min(1e-6))
    return torch.relu(margin - torch.stack(turns)).mean()


def bone_variation(S: Tensor, layout: Layout) -> Tensor:
    """Relative variance of the edge lengths over the batch's shapes (N,3,P): bones keep their lengths."""
    if not layout.edges:
        return S.new_zeros(())
    lengths = edge_lengths(S, layout)
    return (lengths / lengths.mean(0).detach() - 1).square().mean()
