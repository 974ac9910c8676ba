# SPDX-License-Identifier: Apache-2.0
"""The objective against the paper's equations, written out frame by frame in numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import coco_model
from scipy.spatial.transform import Rotation
from tiny_data import sequence

from paul_ros.layout import load_layout
from training.networks import build_networks
from training.objective import bone_variation, fit, handedness_violation, paul_terms, regression_terms, undo_perspective
from training.recipe import Recipe
from training.solver import algebraic_camera, centre
from training.views import NormalisedViews

COCO = load_layout("coco17")
BARE = {"handedness_weight": 0, "bone_weight": 0, "hidden": [8, 16], "width": 16, "bottleneck": 4}
PAPER = Recipe.from_dict({**BARE, "scale": "unit", "codes": "free", "code_weight": 0.01, "decay_weight": 1e-4})
ROWS = torch.arange(8)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def batch(image, visible, calibrated=False, unit=None):
    return NormalisedViews.of(image, visible, torch.ones(len(image), 1, 1, dtype=image.dtype), calibrated, unit)


def case(hidden, recipe=PAPER, frames=8):
    """Networks in double precision and views with a share of points hidden."""
    data, _, _ = sequence(frames, hidden=hidden)
    unit = data.image_unit if recipe.scale == "unit" else None
    views = batch(torch.from_numpy(data.W).double(), torch.from_numpy(data.visible), unit=unit)
    networks = build_networks(data.layout, recipe, frames).double()
    with torch.no_grad():
        for weight in networks.decoder.parameters():
            weight.mul_(2)  # shapes that differ
    return networks, data.layout, views


def normalised(S, visible):
    """Equation 11 as derived: S - (1/v) S M 1 1^T."""
    ones, M = np.ones((S.shape[1], 1)), np.diag(visible.astype(float))
    return S - S @ M @ ones @ ones.T / visible.sum()


def lower_level(S_ae, S_ad, W, visible, R):
    """R^T S_cam for known R: equation 14 with a free depth everywhere, its free values by equation 10."""
    streams = [R @ normalised(S, visible) for S in (S_ae, S_ad)]
    S_cam = (streams[0] + streams[1]) / 2
    S_cam[:2, visible] = W[:, visible]
    return S_cam, [np.linalg.norm(S - S_cam) for S in streams]


@pytest.mark.parametrize("solver", ["exact", "algebraic"])
@pytest.mark.parametrize("hidden", [0.0, 0.3])
def test_the_loss_is_the_papers(solver, hidden):
    recipe = replace(PAPER, solver=solver)
    networks, layout, views = case(hidden, recipe)
    terms, found = paul_terms(networks, layout, recipe, views, ROWS), fit(networks, recipe, views, ROWS)
    S_ad = found.shape.detach()
    S_ae = networks.decoder(networks.shape_encoder(S_ad)).detach()
    losses = []
    for i in range(8):
        W, visible, R = views.W[i].numpy(), views.visible[i].numpy(), found.camera.R[i].detach().numpy()
        S_cam, (ae, ad) = lower_level(S_ae[i].numpy(), S_ad[i].numpy(), W, visible, R)
        np.testing.assert_allclose(found.points[i].detach(), S_cam, atol=1e-12)
        losses.append(ae + ad + 0.01 * (found.code[i] ** 2).sum().item())
    decay = sum((weight**2).sum().item() for weight in networks.decoder.parameters())
    assert terms.loss.item() == pytest.approx(np.mean(losses) + 1e-4 * decay, rel=1e-6)


def test_the_algebraic_camera_is_that_of_both_streams():
    recipe = replace(PAPER, solver="algebraic")
    networks, _, views = case(0.3, recipe)
    found = fit(networks, recipe, views, ROWS)
    S_ae = networks.decoder(networks.shape_encoder(found.shape))
    both = torch.cat([centre(S, views.visible) for S in (S_ae, found.shape)], dim=2)
    R = algebraic_camera(both, torch.cat([views.W] * 2, dim=2), torch.cat([views.visible] * 2, dim=1), "unit").R
    torch.testing.assert_close(found.camera.R, R)
    torch.testing.assert_close(found.points[:, 2], (R[:, 2:] @ centre(S_ae + found.shape, views.visible))[:, 0] / 2)


def test_no_camera_is_better_than_the_exact_one():
    networks, _, views = case(0.3)
    found = fit(networks, PAPER, views, ROWS)
    S_ad, S_ae = (S.detach().numpy() for S in (found.shape, networks.decoder(networks.shape_encoder(found.shape))))
    turns = Rotation.random(300, random_state=1).as_matrix()
    for i in range(8):
        given = S_ae[i], S_ad[i], views.W[i].numpy(), views.visible[i].numpy()
        cost, *others = (
            np.square(lower_level(*given, R)[1]).sum() for R in (found.camera.R[i].detach().numpy(), *turns)
        )
        assert cost < min(others)


def test_projections_of_normalised_shapes_are_centred_where_the_image_is():
    """The printed equation 11 lacks the 1/v; with it, a camera sees S~ where it sees the centred image."""
    data, camera, R = sequence(8, hidden=0.4)
    S, visible = (np.swapaxes(R, 1, 2) @ camera)[0].astype(float), data.visible[0]
    W = camera[0, :2] - camera[0, :2, visible].mean(0)[:, None]
    printed = S + S @ np.diag(~visible) @ np.ones((len(visible), 1)) @ np.ones((1, len(visible)))
    np.testing.assert_allclose((R[0] @ normalised(S, visible))[:2], W, atol=1e-3)
    assert np.abs((R[0] @ printed)[:2] - W).max() > 1


@pytest.mark.parametrize("scale", ["free", "unit"])
@pytest.mark.parametrize("solver", ["exact", "algebraic"])
@pytest.mark.parametrize("streams", ["both", "decoder"])
def test_gradients_are_those_of_the_loss(scale, solver, streams):
    """Gradients include those of cameras and depths; compared with differences, with points hidden."""
    recipe = replace(PAPER, scale=scale, solver=solver, streams=streams, nuclear_weight=0.01)
    networks, layout, views = case(0.3, recipe)
    weight = networks.decoder[0].weight
    (gradient,) = torch.autograd.grad(paul_terms(networks, layout, recipe, views, ROWS).loss, weight)
    losses = []
    for step in (1e-6, -1e-6):
        with torch.no_grad():
            weight[1, 2] += step
            losses.append(paul_terms(networks, layout, recipe, views, ROWS).loss.item())
            weight[1, 2] -= step
    assert gradient[1, 2].item() == pytest.approx((losses[0] - losses[1]) / 2e-6, rel=1e-4, abs=1e-7)


def test_the_auto_decoder_has_one_stream():
    recipe = replace(PAPER, streams="decoder")
    networks, layout, views = case(0.0, recipe)
    found, terms = fit(networks, recipe, views, ROWS), paul_terms(networks, layout, recipe, views, ROWS)
    (ad,) = found.streams
    assert terms.recon_ae == 0
    torch.testing.assert_close(found.points[:, 2], ad[:, 2])  # depth is its own
    torch.testing.assert_close(terms.recon_ad, (ad - found.points)[:, :2].norm(dim=(1, 2)).mean())


def test_the_nuclear_norm_is_that_of_the_batch_of_shapes():
    networks, layout, views = case(0.0)
    without, with_norm = (
        paul_terms(networks, layout, replace(PAPER, nuclear_weight=weight), views, ROWS).loss.item()
        for weight in (0.0, 0.01)
    )
    shapes = fit(networks, PAPER, views, ROWS).shape.detach().numpy().reshape(8, -1)
    assert with_norm - without == pytest.approx(0.01 * np.linalg.norm(shapes, "nuc") / 8, rel=1e-4)


def test_the_default_weights_are_the_earlier_ones_times_the_root_of_17():
    """Distances were once divided by the root of the number of points; training for 17 points is the same."""
    recipe = Recipe()
    networks = build_networks(COCO, recipe, 8)
    W = torch.from_numpy(100 * coco_model().mean_shape[None, :2] + np.random.default_rng(0).normal(0, 9, (8, 2, 17)))
    views = batch(W.float(), torch.ones(8, 17, dtype=torch.bool))
    terms, found = paul_terms(networks, COCO, recipe, views, ROWS), fit(networks, recipe, views, ROWS)
    per_point = [(S - found.points).square().sum((1, 2)).div(17).sqrt().mean() for S in found.streams]
    earlier = (
        sum(per_point)
        + 1e-3 * found.code.square().sum(1).mean()
        + handedness_violation(found.shape, COCO)
        + bone_variation(found.shape, COCO)
    )
    assert terms.loss.item() == pytest.approx(17**0.5 * earlier.item(), rel=1e-5)


def test_a_regression_to_ones_own_shapes_costs_the_auto_encoder_alone():
    networks, layout, views = case(0.0)
    S = networks.decoder(networks.codes(views.W, views.visible, ROWS)).detach()
    terms = regression_terms(networks, layout, PAPER, views, ROWS, S)
    assert terms.recon_ad < 1e-3 < terms.recon_ae
    S_ae = networks.decoder(networks.shape_encoder(S))
    torch.testing.assert_close(terms.recon_ae, (S_ae - S).norm(dim=(1, 2)).mean())


def test_objective_does_not_see_hidden_points():
    recipe = Recipe.from_dict({"bottleneck": 4, "hidden": [8, 16], "width": 16, "blocks": 1})
    networks = build_networks(COCO, recipe, 8)
    W = torch.from_numpy(np.random.default_rng(1).standard_normal((8, 2, 17))).float()
    visible = torch.from_numpy(np.random.default_rng(0).random((8, 17)) < 0.7)
    shifted = W.clone()
    shifted[:, :, 3] += 0.5
    terms, same, other = (
        paul_terms(networks, COCO, recipe, batch(image, visible), ROWS).recon_ad
        for image in (W, torch.where(visible[:, None], W, 77.0), shifted)
    )
    assert terms == same != other


def test_views_of_one_scale_keep_their_sizes():
    data, _, _ = sequence(8, hidden=0.2)
    image = torch.from_numpy(data.W) * torch.linspace(1, 2, 8)[:, None, None]
    views = batch(image, torch.from_numpy(data.visible), unit=50.0)
    back = torch.where(views.visible[:, None], views.size * views.W + views.centre, 0.0)
    torch.testing.assert_close(back, image)
    assert (views.size == 50).all() and not (batch(image, views.visible).size == 50).any()


@pytest.mark.parametrize("facing", [1.0, -1.0])
def test_undone_perspective_is_weak_perspective(facing):
    """With the true depths the points become those of a weak-perspective camera exactly; seen from behind as well."""
    rng = np.random.default_rng(0)
    S = torch.from_numpy(rng.standard_normal((5, 3, 17)) * 0.3)
    distance = torch.tensor([2.0, 3, 4, 5, 6], dtype=torch.double)[:, None, None]
    image = S[:, :2] / (distance + S[:, 2:])
    visible = torch.ones(5, 17, dtype=torch.bool)
    seen = NormalisedViews.of(image, visible, torch.full((5, 1, 1), facing, dtype=torch.double), True)
    depth = facing * S[:, 2:] / distance / seen.size
    weak = undo_perspective(seen, depth)
    torch.testing.assert_close(weak, centre(S[:, :2], visible) / distance / seen.size)


def test_handedness_tells_a_body_from_its_mirror_image():
    S = torch.from_numpy(coco_model().mean_shape)[None]
    mirrored = S * torch.tensor([1.0, 1.0, -1.0])[:, None]
    assert handedness_violation(S, COCO) == 0
    assert handedness_violation(mirrored, COCO) > 0.5


def test_bone_variation_is_zero_for_one_body_in_any_orientation():
    S = torch.from_numpy(coco_model().mean_shape).double()
    S = (S + S[:, COCO.mirror] * torch.tensor([-1.0, 1.0, 1.0])[:, None]) / 2
    turned = torch.from_numpy(Rotation.random(5, random_state=0).as_matrix()) @ S
    assert bone_variation(turned, COCO) < 1e-10
    assert bone_variation(turned * torch.linspace(1, 2, 5)[:, None, None], COCO) > 0.01


def test_lopsided_bodies_cost_more_than_symmetric_ones():
    S = torch.from_numpy(coco_model().mean_shape).double()[None]
    symmetric = (S + S[:, :, COCO.mirror] * torch.tensor([-1.0, 1.0, 1.0])[:, None]) / 2
    lopsided = symmetric.clone()
    lopsided[:, :, COCO.names.index("left_shoulder")] += 0.5
    assert bone_variation(symmetric, COCO) < 1e-12
    assert bone_variation(lopsided, COCO) > 0.01
