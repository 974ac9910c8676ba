# SPDX-License-Identifier: Apache-2.0
"""The model file: round trip, damage, versions, layouts."""

import hashlib
import io
import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from conftest import needs

from paul_ros.errors import ModelError
from paul_ros.layout import load_layout
from paul_ros.model import Model
from paul_ros.model_file import load_model, model_names, save_model, weight_shapes
from paul_ros.normalisation import centre, enough_visible, normalise, to_unit_size

LAYOUT = load_layout("coco17")


def header(**changes):
    base = {
        "layout": LAYOUT.to_dict(),
        "bottleneck": 3,
        "architecture": {
            "encoder": {"kind": "residual", "width": 8, "blocks": 1},
            "decoder": {"kind": "mlp", "hidden": [4, 6]},
        },
        "normalisation": {},
        "chirality": {"known": False, "source": "none"},
        "metres_per_unit": 0.25,
        "training": {},
    }
    return {**base, **changes}


def arrays(seed=0):
    rng = np.random.default_rng(seed)
    return {
        name: rng.standard_normal(shape).astype(np.float32)
        for name, shape in weight_shapes(header(), len(LAYOUT.names)).items()
    }


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "model.npz"
    save_model(path, header(), arrays())
    return path


def test_round_trip(saved):
    model = load_model(saved)
    assert model.layout == LAYOUT and model.metres_per_unit == 0.25 and model.name == "model"
    for name, value in arrays().items():
        np.testing.assert_array_equal(value, model.mean_shape if name == "mean_shape" else model.weights[name])


def test_any_single_changed_byte_is_noticed(saved):
    data = saved.read_bytes()
    for place in np.random.default_rng(0).choice(len(data), 200, replace=False):
        saved.write_bytes(data[:place] + bytes([data[place] ^ 0x40]) + data[place + 1 :])
        with pytest.raises(ModelError):
            load_model(saved)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_truncated_file_is_refused(saved, share):
    data = saved.read_bytes()
    saved.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ModelError, match="model.npz"):
        load_model(saved)


@pytest.mark.parametrize("text", ["[]", "3", "null", "[" * 100_000])
def test_a_header_that_is_no_object_is_refused(saved, text):
    """The checksum is correct: the file is complete, but it is no model."""
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(text.encode(), np.uint8), **arrays())
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = b"0" * 64
    body = buffer.getvalue()[:-64]
    saved.write_bytes(body + hashlib.sha256(body).hexdigest().encode())
    with pytest.raises(ModelError, match="not a model file"):
        load_model(saved)


def test_another_format_version_is_refused(tmp_path):
    save_model(tmp_path / "old.npz", header(format=99), arrays())
    with pytest.raises(ModelError, match="format version 99"):
        load_model(tmp_path / "old.npz")


@pytest.mark.parametrize("name", ["metres_per_unit", "stature"])
@pytest.mark.parametrize("metres", [1e300, True, 0.0, -1.0, float("nan"), "0.3"])
def test_absurd_metres_are_not_saved(tmp_path, name, metres):
    with pytest.raises(ModelError, match=name):
        save_model(tmp_path / "bad.npz", header(**{name: metres}), arrays())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "part,change",
    [
        ("encoder", {"kind": "transformer"}),
        ("encoder", {"blocks": 300_000}),
        ("encoder", {"width": -1}),
        ("encoder", {"width": 8.0}),
        ("decoder", {"hidden": [1] * 5000}),
        ("decoder", {"hidden": ["a"]}),
    ],
)
def test_absurd_architectures_are_refused_in_one_short_line(tmp_path, part, change):
    base = header()
    base["architecture"][part].update(change)
    with pytest.raises(ModelError) as caught:
        save_model(tmp_path / "bad.npz", base, arrays())
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("changes", [{"scale": "big"}, {"scale": None}, {"scale": ["free"]}, {"scale": "unit"}])
def test_unknown_scales_are_not_saved(tmp_path, changes):
    with pytest.raises(ModelError, match="scale"):
        save_model(tmp_path / "bad.npz", header(**changes), arrays())


@pytest.mark.parametrize("unit", [0.0, -1.0, float("nan"), float("inf"), "1", True, None])
def test_absurd_image_units_are_not_saved(tmp_path, unit):
    with pytest.raises(ModelError, match="image_unit"):
        save_model(tmp_path / "bad.npz", header(scale="unit", image_unit=unit), arrays())


def test_models_of_unit_scale_see_the_size_of_a_view_and_give_shapes_of_any(tmp_path, saved):
    save_model(tmp_path / "unit.npz", header(scale="unit", image_unit=50.0), arrays())
    unit, free = load_model(tmp_path / "unit.npz"), load_model(saved)
    rng = np.random.default_rng(1)
    W, visible = 50 * rng.standard_normal((4, 2, 17)), rng.random((4, 17)) < 0.7
    np.testing.assert_allclose(50 * unit.normalise(W, visible), centre(W, visible))
    np.testing.assert_allclose(unit.shape(W + 9, visible), unit.shape(W, visible), atol=1e-3)
    np.testing.assert_allclose(unit.shape(W, visible).mean(2), 0, atol=1e-4)
    assert np.abs(unit.encode(2 * W, visible) - unit.encode(W, visible)).max() > 0.1
    code = rng.standard_normal((4, 3))
    sizes = [np.linalg.norm(model.decode(code), axis=(1, 2)) for model in (unit, free)]
    assert np.ptp(sizes[0] / sizes[1]) > 0.1


def test_models_without_a_scale_key_are_free(saved):
    assert load_model(saved).scale == "free" == load_model().scale


def upright_header(value=True):
    base = header()
    base["architecture"]["encoder"]["upright"] = value
    return base


def upright_arrays(axes):
    return {**arrays(), "encoder.axes": axes}


def test_models_of_upright_views_round_trip(tmp_path):
    axes = np.random.default_rng(5).standard_normal((2, 17)).astype(np.float32)
    save_model(tmp_path / "m.npz", upright_header(), upright_arrays(axes))
    model = load_model(tmp_path / "m.npz")
    np.testing.assert_array_equal(model.weights["encoder.axes"], axes)
    W, visible = np.random.default_rng(1).standard_normal((4, 2, 17)), np.ones((4, 17), bool)
    turned = np.array([[0.0, 1.0], [1.0, 0.0]]) @ W  # x and y exchanged: a turn and a mirror
    np.testing.assert_allclose(model.encode(turned, visible), model.encode(W, visible), atol=1e-5)


def test_models_without_an_upright_key_see_views_as_they_are(tmp_path, saved):
    assert "upright" not in load_model(saved).header["architecture"]["encoder"]
    save_model(tmp_path / "new.npz", upright_header(False), arrays())
    W, visible = np.random.default_rng(1).standard_normal((4, 2, 17)), np.ones((4, 17), bool)
    old, new = load_model(saved), load_model(tmp_path / "new.npz")
    np.testing.assert_array_equal(old.encode(W, visible), new.encode(W, visible))
    assert np.abs(old.encode(W[:, ::-1], visible) - old.encode(W, visible)).max() > 0.1


@pytest.mark.parametrize(
    "head, axes, message",
    [
        (True, None, "encoder.axes"),
        (False, np.ones((2, 17)), "encoder.axes"),
        (True, np.ones((2, 16)), "encoder.axes"),
        (True, np.full((2, 17), np.nan), "encoder.axes"),
        ("no", np.ones((2, 17)), "neither true nor false"),
        (None, np.ones((2, 17)), "neither true nor false"),
    ],
)
def test_axes_that_do_not_fit_are_refused(tmp_path, head, axes, message):
    held = arrays() if axes is None else upright_arrays(axes)
    with pytest.raises(ModelError, match=message):
        save_model(tmp_path / "bad.npz", upright_header(head), held)
    assert not list(tmp_path.iterdir())


def test_enough_is_counted_within_a_category():
    layout = LAYOUT.from_dict(
        {
            "name": "two",
            "names": [f"a{i}" for i in range(5)] + [f"b{i}" for i in range(60)],
            "root": ["a0"],
            "categories": {"a": [f"a{i}" for i in range(5)], "b": [f"b{i}" for i in range(60)]},
        }
    )
    visible = np.zeros((5, 65), bool)
    visible[0, :4] = visible[1, :3] = visible[2, 5:23] = visible[3, 5:22] = True
    visible[4, 3:7] = True  # two of each
    assert enough_visible(visible, layout).tolist() == [True, False, True, False, False]


def test_other_npz_files_are_distinguished_from_damaged_models(tmp_path):
    np.savez(tmp_path / "data.npz", W=np.zeros((2, 2, 17)))
    with pytest.raises(ModelError, match="not a model file"):
        load_model(tmp_path / "data.npz")


def test_weights_that_would_overflow_are_refused(tmp_path):
    huge = arrays()
    huge["encoder.input.weight"][:] = 1e38
    with pytest.raises(ModelError, match="encoder.input.weight"):
        save_model(tmp_path / "bad.npz", header(), huge)


def test_weights_that_are_not_finite_are_not_saved(tmp_path):
    broken = arrays()
    broken["decoder.0.bias"][0] = np.nan
    with pytest.raises(ModelError, match="decoder.0.bias"):
        save_model(tmp_path / "bad.npz", header(), broken)


def test_unknown_models_are_named_with_the_known_ones():
    with pytest.raises(ModelError, match="did you mean 'human'"):
        load_model("human_coco")
    with pytest.raises(ModelError, match="shipped models"):
        load_model("/nowhere/x.npz")


def test_weights_are_stored_in_columns_which_is_fastest_for_few_persons(saved):
    assert all(weight.T.flags.c_contiguous for weight in load_model(saved).weights.values())


def test_shape_ignores_place_size_and_hidden_points(saved):
    model = load_model(saved)
    rng = np.random.default_rng(1)
    W, visible = rng.standard_normal((4, 2, 17)), rng.random((4, 17)) < 0.7
    moved = np.where(visible[:, None], 300 * W + 50, np.nan)
    np.testing.assert_allclose(model.shape(W, visible), model.shape(moved, visible), atol=1e-3)


def test_normalise():
    rng = np.random.default_rng(2)
    W, visible = rng.standard_normal((4, 2, 17)), rng.random((4, 17)) < 0.7
    out = normalise(W, visible)
    np.testing.assert_allclose(out.sum(2), 0, atol=1e-9)
    np.testing.assert_allclose((out**2).sum((1, 2)) / visible.sum(1), 1)
    assert (out[~np.broadcast_to(visible[:, None], out.shape)] == 0).all()


def test_unit_size_is_the_mean_edge():
    S = to_unit_size(np.random.default_rng(3).standard_normal((2, 3, 17)) * 9, LAYOUT)
    start, end = np.array(LAYOUT.edges).T
    np.testing.assert_allclose(np.linalg.norm(S[:, :, start] - S[:, :, end], axis=1).mean(1), 1)


def test_rigid_model_always_answers_the_mean(saved):
    model = load_model(saved)
    np.testing.assert_array_equal(
        model.rigid().shape(np.zeros((2, 2, 17)), np.ones((2, 17), bool))[1], model.mean_shape
    )


def test_shipped_human_model():
    assert "human" in model_names()
    model: Model = load_model()
    assert model.layout.names == load_layout("human").names and model.header["chirality"]["known"]
    head, foot = (model.mean_shape[:, model.layout.names.index(name)] for name in ("head_top", "left_heel"))
    assert 1.5 < model.metres_per_unit * np.linalg.norm(head - foot) < 1.9
    assert model.stature == 1.7 and 0.01 < model.misfit * model.metres_per_unit < 0.05
    assert model.header["training"]["command"].startswith("paul train")
    json.dumps(model.header)


@needs("torch")
def test_forward_pass_equals_torch(saved):
    """In a process of its own: torch must not enter the process of the runtime's tests."""
    code = f"""
import numpy as np, torch
from paul_ros.model_file import load_model
from paul_ros.normalisation import normalise
from training.networks import build_networks
from training.recipe import Recipe
model = load_model({str(saved)!r})
a = model.header["architecture"]
settings = dict(bottleneck=3, hidden=a["decoder"]["hidden"], width=a["encoder"]["width"], blocks=a["encoder"]["blocks"])
paul = build_networks(model.layout, Recipe.from_dict(settings), 5)
paul.load_state_dict({{k: torch.from_numpy(v) for k, v in model.weights.items()}}, strict=False)
rng = np.random.default_rng(0)
W, visible = rng.standard_normal((5, 2, 17)), rng.random((5, 17)) < 0.8
x = torch.from_numpy(normalise(W, visible).astype(np.float32))
with torch.no_grad():
    S = paul.decoder(paul.encoder(x, torch.from_numpy(visible))).numpy()
np.testing.assert_allclose(model.shape(W, visible), S, atol=1e-4)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
