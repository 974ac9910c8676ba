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


@dataclass(frozen=True)
class Views:
    """Image points of a batch as the networks see them, and how they lay in the image.

    Attributes:
        W: (N,2,P) centred on the mean of the visible points, root mean square distance 1; 0 where hidden.
        visible: (N,P) bool.
        centre, size: (N,2,1) and (N,1,1), ``size * W + centre`` are the image points before that.
        facing: (N,1,1), 1, or -1 where a view was mirrored: it shows the object from behind, so near and far change.
        calibrated: the image points are rays, (x/z, y/z) of a pinhole camera looking at the object.
    """

    W: Tensor
    visible: Tensor
    centre: Tensor
    size: Tensor
    facing: Tensor
    calibrated: bool

    @classmethod
    def of(cls, image: Tensor, visible: Tensor, facing: Tensor, calibrated: bool) -> Views:
        """Normalise image points (N,2,P); the torch twin of ``paul_ros.model.normalise``."""
        seen = visible[:, None].to(image.dtype)
        count = seen.sum(2, keepdim=True)
        middle = (image * seen).sum(2, keepdim=True) / count
        offset = (image - middle) * seen
        size = (offset.square().sum((1, 2), keepdim=True) / count).sqrt().clamp_min(1e-9)
        return cls(offset / size, visible, middle, size, facing, calibrated)


def paul_terms(networks: Paul, layout: Layout, views: Views) -> Terms:
    """Evaluate the objective on a batch."""
    W, visible = views.W, views.visible
    code = networks.encoder(W, visible)
    S_ad = networks.decoder(code)
    S_ae = networks.decoder(networks.shape_encoder(S_ad))
    S = (S_ad + S_ae) / 2
    R, scale = solve_camera(S, W, visible)
    if views.calibrated:
        W = undo_perspective(views, scale * R[:, 2:] @ centre(S, visible))
        R, scale = solve_camera(S, W, visible)
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


@torch.no_grad()
def undo_perspective(views: Views, depth: Tensor) -> Tensor:
    """The points (N,2,P) that a weak-perspective camera would have seen, given relative depths (N,1,P) in units of W.

    A pinhole camera sees u = X / (d + Z); hence u (1 + Z/d) = X/d is what weak perspective of distance d sees.  Beyond
    the paper, which names perspective as its next step; without it near bodies are bent to fit.
    """
    ray = views.size * views.W + views.centre
    stretch = (1 + views.facing * views.size * depth).clamp(0.5, 2.0)  # while shapes are still wild
    return centre(ray * stretch, views.visible) * views.visible[:, None] / views.size


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
    """Relative variance of edge lengths over shapes (N,3,P): bones keep their lengths, and both sides have the same.

    The first keeps depth honest, the second keeps the search out of lopsided solutions that explain the views as well.
    """
    if not layout.edges:
        return S.new_zeros(())
    lengths = edge_lengths(S, layout)
    usual = lengths.detach().mean(0)
    usual = (usual + usual[layout.mirrored_edges]) / 2
    return (lengths / usual - 1).square().mean()
