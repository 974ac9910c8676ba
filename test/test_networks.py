# SPDX-License-Identifier: Apache-2.0
"""The networks: both encoders against their definitions and their numpy twins, free codes, both kinds of scale."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from paul_ros.errors import ModelError
from paul_ros.layout import Layout, anonymous_layout, load_layout
from paul_ros.model_file import check_size, dictionary_sizes, load_model, save_model, weight_shapes
from paul_ros.normalisation import normalise, to_centre, to_unit_size, upright
from training import networks as networks_module
from training.networks import build_networks, main_axes
from training.recipe import Recipe, architecture

COCO = load_layout("coco17")


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def networks(layout=COCO, frames=6, **changes):
    recipe = Recipe.from_dict({"bottleneck": 3, "hidden": [5, 7], "width": 12, "blocks": 2, **changes})
    axes = torch.randn(2, len(layout.names)) if recipe.upright else None
    return build_networks(layout, recipe, frames, axes), recipe


def views(points=17, frames=6, seed=0):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((frames, 2, points)), rng.random((frames, points)) < 0.7


def header(recipe, layout=COCO, **changes):
    return {
        "layout": layout.to_dict(),
        **architecture(recipe),
        "normalisation": {},
        "chirality": {"known": False, "source": "none"},
        "metres_per_unit": None,
        "training": {},
        **changes,
    }


def saved(path, paul, recipe, layout=COCO, **changes):
    """The model file of untrained networks, loaded again."""
    weights = {k: v.numpy() for k, v in paul.state_dict().items() if k.startswith(("encoder.", "decoder."))}
    mean = np.ones((3, len(layout.names)), np.float32)
    save_model(path, header(recipe, layout, **changes), {**weights, "mean_shape": mean})
    return load_model(path)


def shaken(paul):
    """Thresholds and biases that differ from zero, so that a missing one shows."""
    with torch.no_grad():
        for weight in paul.parameters():
            weight.add_(0.1 * torch.randn_like(weight))
    return paul


@pytest.mark.parametrize("encoder", ["residual", "convolutional"])
@pytest.mark.parametrize("scale", ["free", "unit"])
@pytest.mark.parametrize("blocks, upright", [(1, False), (3, False), (1, True)])
def test_numpy_runs_what_torch_trained(tmp_path, encoder, scale, blocks, upright):
    paul, recipe = networks(encoder=encoder, scale=scale, blocks=blocks, upright=upright)
    model = saved(tmp_path / "m.npz", shaken(paul), recipe, scale=scale, image_unit=40.0)
    W, visible = views()
    x = torch.from_numpy(model.normalise(100 * W + 7, visible).astype(np.float32))
    with torch.no_grad():
        expected = paul.decoder(paul.encoder(x, torch.from_numpy(visible))).numpy()
    np.testing.assert_allclose(model.shape(100 * W + 7, visible), expected, atol=1e-4)


def test_a_convolutional_layer_is_the_transposed_dictionary_on_each_block():
    """Written out as sums, for one frame: every 3 x 2 block, then the code."""
    paul, _ = networks(encoder="convolutional", blocks=1)
    encoder = shaken(paul).encoder
    W, visible = views(frames=1)
    W = np.where(visible[:, None], W, 0)
    D, E = (dictionary.detach().double().numpy() for dictionary in encoder.dictionaries)
    thresholds = [threshold.detach().double().numpy() for threshold in encoder.thresholds]
    D = D.reshape(3, -1, 17)
    blocks = np.zeros((D.shape[1], 3, 2))
    for k in range(len(blocks)):
        for i in range(3):
            for j in range(2):
                blocks[k, i, j] = max(0, (D[i, k] * W[0, j]).sum() - thresholds[0][k])
    deeper = np.zeros((len(E), 3, 2))
    for k in range(len(E)):
        deeper[k] = np.maximum(0, np.tensordot(E[k], blocks, 1) - thresholds[1][k])
    x = np.concatenate([deeper.transpose(2, 1, 0).ravel(), visible[0]])
    code = encoder.output.weight.detach().double().numpy() @ x + encoder.output.bias.detach().double().numpy()
    with torch.no_grad():
        found = encoder(torch.from_numpy(W).float(), torch.from_numpy(visible)).numpy()
    np.testing.assert_allclose(found[0], code, atol=1e-5)


def test_masked_dictionaries_are_those_of_deep_nrsfm_plus_plus():
    """Centred on the visible points and without the hidden columns, the first dictionary gives the same products."""
    rng = np.random.default_rng(0)
    W, visible = views()
    W = np.where(visible[:, None], W, 0)
    W = np.where(visible[:, None], W - W.sum(2, keepdims=True) / visible.sum(1)[:, None, None], 0)
    D = rng.standard_normal((36, 17))
    for w, seen in zip(W, visible):
        centred = D[:, seen] - D[:, seen].mean(1, keepdims=True)
        np.testing.assert_allclose(D @ w.T, centred @ w[:, seen].T, atol=1e-12)


@pytest.mark.parametrize("encoder", ["residual", "convolutional"])
def test_codes_depend_on_the_mask_alone_too(encoder):
    paul, _ = networks(encoder=encoder)
    W = torch.zeros(2, 2, 17)
    visible = torch.ones(2, 17, dtype=torch.bool)
    visible[1, 3] = False
    codes = paul.codes(W, visible, torch.arange(2))
    assert not torch.equal(codes[0], codes[1])


def test_free_codes_are_looked_up_by_frame():
    paul, _ = networks(codes="free", frames=9)
    rows = torch.tensor([7, 2, 7])
    codes = paul.codes(torch.randn(3, 2, 17), torch.ones(3, 17, dtype=torch.bool), rows)
    assert torch.equal(codes, paul.free_codes.weight[rows])
    codes.sum().backward()
    assert paul.free_codes.weight.grad[[2, 7]].abs().min() > 0 and not paul.free_codes.weight.grad[[0, 8]].any()
    assert paul.encoder.output.weight.grad is None


def test_an_encoder_starts_with_the_same_weights_whether_codes_are_free_or_not():
    first, _ = networks(codes="encoder")
    torch.manual_seed(0)
    second, _ = networks(codes="free")
    for name, weight in first.state_dict().items():
        assert torch.equal(weight, second.state_dict()[name])


def test_shapes_of_unit_scale_keep_their_size_and_all_are_centred():
    codes = torch.randn(5, 3)
    own, _ = networks(scale="unit")
    with torch.no_grad():
        own.decoder[-1].weight.mul_(10)
        S = own.decoder(codes)
        own.decoder.unit_size = True
        unit = own.decoder(codes)
    assert (S.mean(2).abs() < 1e-5).all() and (unit.mean(2).abs() < 1e-5).all()
    sizes = S.norm(dim=(1, 2)) / unit.norm(dim=(1, 2))
    assert sizes.max() / sizes.min() > 1.05
    torch.testing.assert_close(S / sizes[:, None, None], unit)


@settings(deadline=None, max_examples=50)
@given(st.integers(1, 300), st.integers(1, 12), st.integers(1, 300))
def test_dictionaries_go_from_the_width_to_the_bottleneck(width, blocks, bottleneck):
    sizes = dictionary_sizes(width, blocks, bottleneck)
    assert len(sizes) == blocks + 1 and sizes[0] == width and sizes[-1] == bottleneck
    assert sizes == sorted(sizes, reverse=width > bottleneck)


@settings(deadline=None, max_examples=20)
@given(
    st.sampled_from(["residual", "convolutional"]),
    *(st.integers(3, 40), st.integers(1, 4), st.integers(1, 9), st.booleans()),
)
def test_the_header_foretells_every_weight(encoder, points, blocks, bottleneck, upright):
    layout = anonymous_layout(points)
    paul, recipe = networks(layout, encoder=encoder, blocks=blocks, bottleneck=bottleneck, upright=upright)
    expected = weight_shapes(header(recipe, layout), points)
    found = {name: tuple(value.shape) for name, value in paul.state_dict().items()}
    assert {**found, "mean_shape": (3, points)}.items() >= expected.items()
    assert all(name in expected for name in found if name.startswith(("encoder.", "decoder.")))


def test_the_depth_of_c3dpo_fits_a_model_file():
    recipe = Recipe.from_dict({"width": 1024, "blocks": 6})
    check_size(architecture(recipe), 91)
    with pytest.raises(ModelError, match="MiB of weights"):
        check_size(architecture(Recipe.from_dict({"width": 4096, "blocks": 6})), 91)


def test_dense_models_fit_a_model_file():
    check_size(architecture(Recipe()), 6890)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 99), st.booleans())
def test_categories_are_centred_and_measured_each_by_itself(seed, edges):
    """In any order of their points; numpy and torch alike."""
    order = np.random.default_rng(seed).permutation(11)
    names = [f"p{i}" for i in range(11)]
    parts = {"a": [names[i] for i in order[:4]], "b": [names[i] for i in order[4:]]}
    bones = [parts["a"][:2], parts["b"][1:3], parts["b"][2:4]] if edges else []
    layout = Layout.from_dict({"name": "two", "names": names, "root": names, "edges": bones, "categories": parts})
    S = np.random.default_rng(seed).standard_normal((5, 3, 11))
    found = to_unit_size(S, layout)
    np.testing.assert_allclose(networks_module.to_unit_size(torch.from_numpy(S), layout).numpy(), found, atol=1e-9)
    np.testing.assert_allclose(networks_module.to_centre(torch.from_numpy(S), layout).numpy(), to_centre(S, layout))
    for points in (order[:4], order[4:]):
        own = found[:, :, points]
        np.testing.assert_allclose(own.mean(2), 0, atol=1e-9)
        if edges:
            pairs = [(names.index(a), names.index(b)) for a, b in bones if names.index(a) in points]
            sizes = [np.linalg.norm(found[:, :, a] - found[:, :, b], axis=1) for a, b in pairs]
            np.testing.assert_allclose(np.mean(sizes, axis=0), 1, rtol=1e-6)
        else:
            np.testing.assert_allclose((own**2).sum((1, 2)) / len(points), 1)


# --- upright views


def turned(W, angle=1.0, mirrored=False):
    """Views (N,2,P) turned in their plane by angles (N,), then mirrored in x where asked."""
    cos, sin = np.cos(angle) * np.ones(len(W)), np.sin(angle) * np.ones(len(W))
    side = np.where(mirrored, -1.0, 1.0) * np.ones(len(W))
    return np.array([[side * cos, -side * sin], [sin, cos]]).transpose(2, 0, 1) @ W


def normal_views(frames=40, points=17, seed=0):
    W, visible = views(points, frames, seed)
    return normalise(W, visible), visible


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 99), st.booleans())
def test_upright_views_are_the_same_however_they_were_turned_or_mirrored(seed, hide):
    rng = np.random.default_rng(seed)
    W, visible = normal_views(seed=seed)
    if not hide:
        W = rng.standard_normal(W.shape)
    axes = rng.standard_normal((2, 17))
    other = turned(W, rng.uniform(-4, 4, len(W)), rng.random(len(W)) < 0.5)
    found = upright(W, axes)
    np.testing.assert_allclose(upright(other, axes), found, atol=1e-9)
    # Turned rigidly, to the stated place.
    np.testing.assert_allclose(found.swapaxes(1, 2) @ found, W.swapaxes(1, 2) @ W, atol=1e-9)
    first, second = (found @ axes.T).transpose(2, 0, 1)
    np.testing.assert_allclose(first[:, 0], 0, atol=1e-9)
    assert (first[:, 1] > 0).all() and (second[:, 0] > 0).all()
    if hide:
        assert not found[~np.repeat(visible[:, None], 2, 1)].any()
    twin = networks_module.upright(torch.from_numpy(W), torch.from_numpy(axes)).numpy()
    np.testing.assert_allclose(twin, found, atol=1e-12)


def test_views_that_have_no_direction_are_numbers_still():
    W = np.zeros((1, 2, 17))
    axes = np.ones((2, 17))
    assert not upright(W, axes).any()
    assert not networks_module.upright(torch.from_numpy(W), torch.from_numpy(axes)).any()


@pytest.mark.parametrize("encoder", ["residual", "convolutional"])
def test_codes_of_upright_views_do_not_turn_with_them(tmp_path, encoder):
    paul, recipe = networks(encoder=encoder, upright=True)
    model = saved(tmp_path / "m.npz", shaken(paul), recipe)
    W, visible = views()
    other = turned(W, 2.0, np.arange(len(W)) % 2 == 0)
    assert model.header["architecture"]["encoder"]["upright"] is True
    np.testing.assert_array_equal(model.weights["encoder.axes"], paul.encoder.axes.numpy())
    np.testing.assert_allclose(model.encode(other, visible), model.encode(W, visible), atol=1e-5)
    plain, recipe = networks(encoder=encoder)
    model = saved(tmp_path / "p.npz", shaken(plain), recipe)
    assert "encoder.axes" not in model.weights
    assert np.abs(model.encode(other, visible) - model.encode(W, visible)).max() > 1e-3


def test_axes_are_no_weights_to_be_trained():
    paul, _ = networks(upright=True)
    assert not any("axes" in name for name, _ in paul.named_parameters())
    assert "encoder.axes" in paul.state_dict()


def test_main_axes_are_the_longest_sums_of_points():
    W = torch.from_numpy(normal_views()[0])
    axes = main_axes(W, anonymous_layout(17))
    torch.testing.assert_close(axes @ axes.T, torch.eye(2, dtype=torch.float64))
    longest = [(W @ axis).square().sum() for axis in axes]
    assert longest[0] > longest[1]
    for other in torch.nn.functional.normalize(torch.randn(50, 17, dtype=torch.float64), dim=1):
        assert (W @ other).square().sum() < longest[0]
        rest = torch.nn.functional.normalize(other - (other @ axes[0]) * axes[0], dim=0)
        assert (W @ rest).square().sum() < longest[1]


def test_every_category_has_main_axes_of_its_own():
    """With axes of all points a view of the smaller object would have no direction."""
    names = [f"p{i}" for i in range(11)]
    parts = {"a": names[::2], "b": names[1::2]}
    layout = Layout.from_dict({"name": "two", "names": names, "root": names, "categories": parts})
    W = torch.randn(20, 2, 11)
    W[:15, :, 1::2], W[15:, :, ::2] = 0, 0
    W[:15] *= 10
    axes = main_axes(W, layout)
    for part in layout.parts:
        own = axes[:, list(part.points)]
        torch.testing.assert_close(own @ own.T, torch.eye(2))
    assert (networks_module.upright(W, axes).norm(dim=(1, 2)) / W.norm(dim=(1, 2)) > 0.999).all()


# --- decoder and shape encoder as one function of autograd's


def plain(layers, x):
    *inner, last = layers
    for layer in inner:
        x = torch.nn.functional.elu(layer(x))
    return last(x)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_layers_and_their_gradients_are_those_of_linear_and_elu(dtype, tolerance):
    encoder = networks()[0].shape_encoder.to(dtype)
    S = (5 * torch.randn(6, 3, 17, dtype=dtype)).requires_grad_()
    ours, other = encoder(S), plain(encoder, S.flatten(1))
    torch.testing.assert_close(ours, other, rtol=tolerance, atol=tolerance)
    slope, inputs = torch.randn_like(ours), (S, *encoder.parameters())
    for a, b in zip(*(torch.autograd.grad(codes, inputs, slope) for codes in (ours, other))):
        torch.testing.assert_close(a, b, rtol=10 * tolerance, atol=10 * tolerance)


def test_gradients_of_the_layers_against_finite_differences():
    encoder = networks(hidden=[5])[0].shape_encoder.double()
    S = torch.randn(2, 3, 17, dtype=torch.double, requires_grad=True)
    assert torch.autograd.gradcheck(encoder, S)


def test_nan_stays_nan():
    decoder = networks()[0].decoder
    assert decoder(torch.full((1, 3), torch.nan)).isnan().all()
