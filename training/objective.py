# SPDX-License-Identifier: Apache-2.0
"""The training objective, term by term as in the paper (Wang and Lucey, CVPR 2021), with its equation numbers.

A code phi is decoded twice, by f_d(phi) and by f_d(f_e(f_d(phi))). Equation 7, as the bilevel problem of equation 8:

    min over networks: sum over frames of  min over R, z:  L_AE + L_AD + L_reg
    L_AE = |f_d f_e f_d(phi) - R^T [W; z]|_F,   L_AD = |f_d(phi) - R^T [W; z]|_F                      (6, 7)
    L_reg = 0.01 |phi|^2 + 1e-4 |theta_d|^2                                                           (12)

The norms are unsquared and not divided by the number of points; sums over frames are means here. ``solver.py`` solves
the lower level, R and z: exactly, with its implicit gradients, or as the paper does (9, 10).

**Hidden points** (section 4.3 and the supplement). W is centred on its v visible points, so shapes are centred as well:

    S~ = S - (1/v) S M 1 1^T        M = diag(visible)                                                 (11, 13)

The printed equation 11, S + S (I - M) 1 1^T, lacks the 1/v. For a shape of zero mean S (I - M) 1 = -S M 1. With 1/v
it is thus the line above, the shape minus the mean of its visible points. Without 1/v projections of S~ and W have
different centres. The unknown part of the camera-frame shape is free (14): z of every point, x and y of hidden ones.
The printed equation 14 has 0 for the depth of visible points, which equation 4 leaves free. The best free values are
the mean of both streams (10), so a hidden point costs the difference of its two streams (15).

Terms beyond the paper have weights in the recipe: handedness and bones; and the nuclear norm of the paper's baseline
"ADL + low rank". A free scale of every frame and perspective are settings as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from paul_ros.layout import Layout
from training.distributed import WHOLE, Share
from training.networks import Paul, edge_lengths
from training.recipe import Recipe
from training.solver import Camera, algebraic_camera, centre, solve_camera
from training.views import NormalisedViews


@dataclass(frozen=True)
class Terms:
    """The loss of a batch and its unweighted parts, each a scalar; a part without weight is 0."""

    loss: Tensor
    recon_ae: Tensor
    recon_ad: Tensor
    code: Tensor
    handedness: Tensor
    bones: Tensor
    nuclear: Tensor


@dataclass(frozen=True)
class Fit:
    """Solution of the lower level for a batch of views.

    Attributes:
        code: (N,K) phi.
        shape: (N,3,P) f_d(phi), canonical frame.
        camera: R and scale.
        streams: (2,N,3,P) f_d f_e f_d(phi) and f_d(phi), camera frame, units of W, centred on the visible points. If
            the decoder's stream is trained alone, it is the only one, (1,N,3,P).
        points: (N,3,P) S_cam of equations 4 and 14: observed coordinates, else the mean of the streams.
    """

    code: Tensor
    shape: Tensor
    camera: Camera
    streams: Tensor
    points: Tensor


def fit(networks: Paul, recipe: Recipe, views: NormalisedViews, rows: Tensor) -> Fit:
    """Decode a batch and solve its cameras (equations 8-10).

    Args:
        networks: of the run.
        recipe: of the run.
        views: the batch.
        rows: (N,) frame numbers, for free codes.
    """
    W, visible = views.W, views.visible
    code = networks.codes(W, visible, rows)
    shape, streams = _decoded(networks, recipe, code)
    camera = _camera(streams, W, visible, recipe)
    if views.calibrated:
        mean = centre(streams.mean(0), visible)
        W = undo_perspective(views, camera.scale * camera.R[:, 2:] @ mean)
        camera = _camera(streams, W, visible, recipe)
    streams = camera.scale * camera.R @ centre(streams, visible)
    free = streams.mean(0)  # z*, and all coordinates of hidden points
    known = visible[:, None] & torch.tensor([True, True, False], device=W.device)[:, None]
    points = torch.where(known, torch.cat([W, W[:, :1]], dim=1), free)
    return Fit(code, shape, camera, streams, points)


def _decoded(networks: Paul, recipe: Recipe, code: Tensor) -> tuple[Tensor, Tensor]:
    """Return f_d(phi) of codes (N,K), and the recipe's streams (2,N,3,P) or (1,N,3,P), of which it is the last."""
    shape = networks.decoder(code)
    if recipe.streams == "decoder":
        return shape, shape[None]
    return shape, torch.stack([networks.decoder(networks.shape_encoder(shape)), shape])


def _camera(streams: Tensor, W: Tensor, visible: Tensor, recipe: Recipe) -> Camera:
    """Return the lower level's cameras: by OnP of the streams' mean, or by least squares of all streams (9)."""
    if recipe.solver == "exact":
        return solve_camera(streams.mean(0), W, visible, recipe.scale)
    times = len(streams)
    shapes = torch.cat([*centre(streams, visible)], dim=2)
    return algebraic_camera(shapes, W.repeat(1, 1, times), visible.repeat(1, times), recipe.scale)


def paul_terms(
    networks: Paul, layout: Layout, recipe: Recipe, views: NormalisedViews, rows: Tensor, share: Share = WHOLE
) -> Terms:
    """Evaluate the objective on this process's share of a batch; the terms are those of the whole batch."""
    found = fit(networks, recipe, views, rows)
    distances = _distances(found.streams, found.points, own_points(views.visible, layout))
    return _terms(networks, layout, recipe, found.code, found.shape, distances, share)


def regression_terms(
    networks: Paul,
    layout: Layout,
    recipe: Recipe,
    views: NormalisedViews,
    rows: Tensor,
    S: Tensor,
    share: Share = WHOLE,
) -> Terms:
    """Evaluate the objective with known canonical shapes S (N,3,P) in place of R^T [W; z]: equation 3, supervised."""
    code = networks.codes(views.W, views.visible, rows)
    shape, streams = _decoded(networks, recipe, code)
    distances = _distances(streams, S, own_points(views.visible, layout))
    return _terms(networks, layout, recipe, code, shape, distances, share)


def _terms(
    networks: Paul,
    layout: Layout,
    recipe: Recipe,
    code: Tensor,
    shape: Tensor,
    distances: Tensor,
    share: Share,
) -> Terms:
    """Weigh the streams' distances (2,N) or (1,N) and the regularisers of codes (N,K) and shapes (N,3,P)."""
    handedness = bones = nuclear = none = shape.new_zeros(())
    *recon, size = share.whole(torch.cat([distances, code.square().sum(1)[None]]).T).mean(0).unbind()
    recon_ae, recon_ad = recon if len(recon) == 2 else (none, *recon)
    if recipe.handedness_weight or recipe.bone_weight or recipe.nuclear_weight:
        shape = share.whole(shape)
    if recipe.handedness_weight:
        handedness = handedness_violation(shape, layout)
    if recipe.bone_weight:
        bones = bone_variation(shape, layout)
    if recipe.nuclear_weight:
        nuclear = torch.linalg.matrix_norm(shape.flatten(1), "nuc") / len(shape)  # the others are means of the batch
    theta = parameters_to_vector(networks.decoder.parameters())
    loss = (
        recon_ae
        + recon_ad
        + recipe.code_weight * size
        + recipe.decay_weight * theta.dot(theta)
        + recipe.nuclear_weight * nuclear
        # Unlike these two, Frobenius norms grow with the square root of the number of points.
        + shape.shape[2] ** 0.5 * (recipe.handedness_weight * handedness + recipe.bone_weight * bones)
    )
    return Terms(loss, recon_ae, recon_ad, size, handedness, bones, nuclear)


@torch.no_grad()
def undo_perspective(views: NormalisedViews, depth: Tensor) -> Tensor:
    """Return the points (N,2,P) that a weak-perspective camera would see.

    A pinhole camera sees u = X / (d + Z); hence weak perspective of distance d sees u (1 + Z/d) = X/d. The paper names
    perspective as its next step. Without it near bodies are bent to fit.

    Args:
        views: calibrated views.
        depth: (N,1,P) relative depths, units of W.
    """
    ray = views.size * views.W + views.centre
    stretch = (1 + views.facing * views.size * depth).clamp(0.5, 2.0)  # early shapes are far off
    return centre(ray * stretch, views.visible) * views.visible[:, None] / views.size


def own_points(visible: Tensor, layout: Layout) -> Tensor | None:
    """Return a mask (N,P) of the points of each frame's category, that of most visible points.

    Points of other categories do not exist in a frame, so the networks' guesses of them cost nothing.

    Returns:
        None for a layout without categories.
    """
    if not layout.categories:
        return None
    member = torch.zeros(len(layout.categories), visible.shape[1], device=visible.device)
    for category, points in zip(member, layout.categories.values()):
        category[list(points)] = 1
    return member[(visible.float() @ member.T).argmax(1)]


def _distances(streams: Tensor, target: Tensor, own: Tensor | None) -> Tensor:
    """Return unsquared Frobenius distances (2,N) of streams (2,N,3,P) from a target (N,3,P), over own points (N,P)."""
    difference = streams - target if own is None else (streams - target) * own[:, None]
    # The small constant keeps the gradient finite at distance 0.
    return difference.square().sum((2, 3)).add(1e-8 * target.shape[2]).sqrt()


def handedness_violation(S: Tensor, layout: Layout, margin: float = 0.5) -> Tensor:
    """Return how far shapes (N,3,P) violate the layout's handedness rules; 0 if left x up always points forward.

    Two mirror images of a shape have the same orthographic views. Without a hint some frames settle on each, and the
    model mixes both. An anatomical rule, one bit of knowledge about the object, decides it.
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
    """Return the relative variance of edge lengths over shapes (N,3,P) and over both sides.

    Constant lengths keep depths right. Equal sides exclude lopsided solutions that explain the views as well.
    """
    if not layout.edges:
        return S.new_zeros(())
    lengths = edge_lengths(S, layout)
    usual = lengths.detach().mean(0)
    usual = (usual + usual[layout.mirrored_edges]) / 2
    return (lengths / usual - 1).square().mean()
