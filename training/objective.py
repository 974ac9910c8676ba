# SPDX-License-Identifier: Apache-2.0
"""The training objective, term by term as in the paper (Wang and Lucey, CVPR 2021; equation numbers are its).

A code phi is decoded twice, by f_d(phi) and by f_d(f_e(f_d(phi))).  Equation 7, as the bilevel problem of equation 8:

    min over networks: sum over frames of  min over R, z:  L_AE + L_AD + L_reg
    L_AE = |f_d f_e f_d(phi) - R^T [W; z]|_F,   L_AD = |f_d(phi) - R^T [W; z]|_F                      (6, 7)
    L_reg = 0.01 |phi|^2 + 1e-4 |theta_d|^2                                                           (12)

The norms are unsquared and not divided by the number of points; sums over frames are means here.  The lower level, R
and z, is solved by ``solver.py``: exactly, with its implicit gradients, or as the paper does (9, 10).

**Hidden points** (section 4.3 and the supplement).  W is centred on its v visible points, so shapes have to be as well:

    S~ = S - (1/v) S M 1 1^T        M = diag(visible)                                                 (11, 13)

The printed equation 11, S + S (I - M) 1 1^T, lacks the 1/v: for a shape of zero mean S (I - M) 1 = -S M 1, so that
with 1/v it is the line above, the shape less the mean of its visible points, and without it projections of S~ are not
centred where W is.  The unknown part of the camera-frame shape is free (14): z of every point, x and y of hidden ones;
the printed equation 14 writes 0 for the depth of visible points, where equation 4 has it free.  The best free
values are the mean of both streams (10), so a hidden point costs what its two streams differ by (15).

Beyond the paper, by weights of the recipe: a free scale of every frame, handedness, bones and perspective; and the
nuclear norm of its baseline "ADL + low rank".
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
    """The loss of a batch and its parts before they are weighted, each a scalar; 0 where a part has no weight."""

    loss: Tensor
    recon_ae: Tensor
    recon_ad: Tensor
    code: Tensor
    handedness: Tensor
    bones: Tensor
    nuclear: Tensor


@dataclass(frozen=True)
class Fit:
    """The lower level solved: what a batch's networks and best cameras make of its views.

    Attributes:
        code: (N,K) phi.
        shape: (N,3,P) f_d(phi), canonical frame.
        camera: R and scale.
        streams: (2,N,3,P) f_d f_e f_d(phi) and f_d(phi) in the camera frame, in units of W, centred on the visible
            points; (1,N,3,P) where the decoder's stream is trained alone.
        points: (N,3,P) S_cam of equations 4 and 14: observed where it is, else the mean of the streams.
    """

    code: Tensor
    shape: Tensor
    camera: Camera
    streams: Tensor
    points: Tensor


def fit(networks: Paul, recipe: Recipe, views: NormalisedViews, rows: Tensor) -> Fit:
    """Decode a batch and solve its cameras (equations 8-10); rows (N,) are the frames' numbers, for free codes."""
    W, visible = views.W, views.visible
    code = networks.codes(W, visible, rows)
    shape, streams = _decoded(networks, recipe, code)
    camera = _camera(streams, W, visible, recipe)
    if views.calibrated:
        mean = centre(streams.mean(0), visible)
        W = undo_perspective(views, camera.scale * camera.R[:, 2:] @ mean)
        camera = _camera(streams, W, visible, recipe)
    streams = camera.scale * camera.R @ centre(streams, visible)
    free = streams.mean(0)  # z*, and the whole of every hidden point
    known = visible[:, None] & torch.tensor([True, True, False], device=W.device)[:, None]
    points = torch.where(known, torch.cat([W, W[:, :1]], dim=1), free)
    return Fit(code, shape, camera, streams, points)


def _decoded(networks: Paul, recipe: Recipe, code: Tensor) -> tuple[Tensor, Tensor]:
    """f_d(phi) of codes (N,K), and the streams that the recipe trains (2,N,3,P) or (1,N,3,P), the former last."""
    shape = networks.decoder(code)
    if recipe.streams == "decoder":
        return shape, shape[None]
    return shape, torch.stack([networks.decoder(networks.shape_encoder(shape)), shape])


def _camera(streams: Tensor, W: Tensor, visible: Tensor, recipe: Recipe) -> Camera:
    """The lower level's cameras.  Exactly: OnP of the streams' mean; algebraically: least squares of them all (9)."""
    if recipe.solver == "exact":
        return solve_camera(streams.mean(0), W, visible, recipe.scale)
    times = len(streams)
    shapes = torch.cat([*centre(streams, visible)], dim=2)
    return algebraic_camera(shapes, W.repeat(1, 1, times), visible.repeat(1, times), recipe.scale)


def paul_terms(
    networks: Paul, layout: Layout, recipe: Recipe, views: NormalisedViews, rows: Tensor, share: Share = WHOLE
) -> Terms:
    """Evaluate the objective on a batch, or on this process's share of it: terms are always those of the batch."""
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
    """The same objective with known canonical shapes S (N,3,P) in place of R^T [W; z]: equation 3, supervised."""
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
    """Weigh the distances of the streams (2,N) or (1,N), and the regularisers of codes (N,K) and shapes (N,3,P)."""
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
        # Frobenius norms grow with the square root of the number of points; these two do not.
        + shape.shape[2] ** 0.5 * (recipe.handedness_weight * handedness + recipe.bone_weight * bones)
    )
    return Terms(loss, recon_ae, recon_ad, size, handedness, bones, nuclear)


@torch.no_grad()
def undo_perspective(views: NormalisedViews, depth: Tensor) -> Tensor:
    """The points (N,2,P) that a weak-perspective camera would have seen, given relative depths (N,1,P) in units of W.

    A pinhole camera sees u = X / (d + Z); hence u (1 + Z/d) = X/d is what weak perspective of distance d sees.  Beyond
    the paper, which names perspective as its next step; without it near bodies are bent to fit.
    """
    ray = views.size * views.W + views.centre
    stretch = (1 + views.facing * views.size * depth).clamp(0.5, 2.0)  # while shapes are still wild
    return centre(ray * stretch, views.visible) * views.visible[:, None] / views.size


def own_points(visible: Tensor, layout: Layout) -> Tensor | None:
    """The points (N,P) of each frame's category, that of most of its visible points; None where there is but one.

    A frame's object has no other points, so that what the networks make of them costs nothing.
    """
    if not layout.categories:
        return None
    member = torch.zeros(len(layout.categories), visible.shape[1], device=visible.device)
    for category, points in zip(member, layout.categories.values()):
        category[list(points)] = 1
    return member[(visible.float() @ member.T).argmax(1)]


def _distances(streams: Tensor, target: Tensor, own: Tensor | None) -> Tensor:
    """Frobenius distances (2,N) of streams (2,N,3,P) from target (N,3,P), unsquared, of own points (N,P) alone."""
    difference = streams - target if own is None else (streams - target) * own[:, None]
    # The small constant keeps the gradient finite at distance 0.
    return difference.square().sum((2, 3)).add(1e-8 * target.shape[2]).sqrt()


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
