# SPDX-License-Identifier: Apache-2.0
"""The model file of a finished run: sizes, mirror images and memory."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import coco_model
from scipy.spatial.transform import Rotation

from paul_ros.layout import anonymous_layout, load_layout
from paul_ros.model_file import load_model
from paul_ros.orthographic_n_point import onp
from training import export
from training.categories import joint_layout
from training.chirality import chirality_text, same_side_share
from training.export import export_model
from training.loading import load_training_data
from training.recipe import Recipe
from training.trainer import Trainer


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def data(tmp_path):
    rng = np.random.default_rng(0)
    S = rng.standard_normal((3, 11)) + 0.2 * rng.standard_normal((30, 3, 11))
    S = rng.uniform(0.5, 2, (30, 1, 1)) * (Rotation.random(30, random_state=0).as_matrix() @ S)
    np.savez(tmp_path / "views.npz", W=40 * S[:, :2] + 100)
    return load_training_data(tmp_path / "views.npz")


def trained(data, folder, **settings):
    recipe = {"steps": 5, "width": 8, "batch": 8, "bottleneck": 3, "hidden": [8, 16], **settings}
    trainer = Trainer(data, Recipe.from_dict(recipe), folder)
    for _ in trainer.run():
        pass
    return trainer


@pytest.mark.parametrize("scale", ["free", "unit"])
@pytest.mark.parametrize("encoder, upright", [("residual", False), ("residual", True), ("convolutional", False)])
def test_the_file_gives_the_shapes_that_were_trained(data, tmp_path, scale, encoder, upright):
    trainer = trained(data, tmp_path, scale=scale, encoder=encoder, upright=upright)
    header = export_model(trainer, 0.5, tmp_path / "m.npz", "paul train")
    model = load_model(tmp_path / "m.npz")
    assert model.scale == scale and ("image_unit" in header) == (scale == "unit")
    assert header["chirality"]["known"] is False and 0 <= header["chirality"]["same_side_share"] <= 1
    views = trainer.views(torch.arange(30))
    np.testing.assert_allclose(model.normalise(data.W, data.visible), views.W.numpy(), atol=1e-5)
    with torch.no_grad():
        S = trainer.networks.decoder(trainer.networks.encoder(views.W, views.visible)).numpy()
    np.testing.assert_allclose(model.shape(data.W, data.visible), S, atol=1e-4)
    turned = np.array([[0, -1], [1, 0]]) @ data.W
    assert np.allclose(model.shape(turned, data.visible), S, atol=1e-4) == upright
    sizes = np.linalg.norm(model.shape(data.W, data.visible), axis=(1, 2))
    assert (np.ptp(sizes) > 1e-3) == (scale == "unit")


def test_the_misfit_is_in_model_units(data, tmp_path):
    """It follows from the median distance of points from the model's points, at any scale of the frames."""
    header = export_model(trained(data, tmp_path), 0.5, tmp_path / "m.npz", "paul train")
    model = load_model(tmp_path / "m.npz")
    assert model.misfit == header["misfit"]
    S = model.shape(data.W, data.visible).astype(float)
    pose = onp(S, data.W, data.visible)
    off = (data.W - pose.translation[..., None]) / pose.scale[:, None, None] - pose.R[:, :2] @ S
    expected = np.median(np.linalg.norm(off, axis=1)) / np.sqrt(2 * np.log(2))
    assert model.misfit == pytest.approx(expected, rel=0.3)  # the networks' two streams have one pose together
    scaled = export_model(trained(data, tmp_path / "unit", scale="unit"), 0.5, tmp_path / "u.npz", "paul train")
    assert "misfit" not in scaled


def test_weights_come_from_whatever_device_they_are_on():
    class OnGpu:
        def numpy(self):
            raise TypeError("can't convert cuda:0 device type tensor to numpy")

        def cpu(self):
            return torch.ones(2)

    networks = SimpleNamespace(state_dict=lambda: {"encoder.0.weight": OnGpu(), "shape_encoder.0.weight": OnGpu()})
    (weights,) = export._weights(SimpleNamespace(networks=networks)).items()
    assert weights[0] == "encoder.0.weight" and isinstance(weights[1], np.ndarray)


def test_the_final_loss_is_the_one_that_ranked_the_run(data, tmp_path):
    header = export_model(trained(data, tmp_path), 0.123456, tmp_path / "m.npz", "paul train")
    assert header["training"]["final"] == {"loss": 0.12346}


def test_chirality_is_known_only_if_every_category_has_a_rule():
    coco = load_layout("coco17")
    shapes = np.repeat(coco_model().mean_shape[None].astype(float), 3, axis=0)
    assert export._chirality(shapes, shapes[0], coco, 1.0)["known"]
    both = np.concatenate([shapes, shapes], axis=2)
    assert export._chirality(both, both[0], joint_layout(["a", "b"], [coco, coco]), 1.0)["known"]
    box = np.concatenate([shapes, shapes[:, :, :4]], axis=2)
    found = export._chirality(box, box[0], joint_layout(["person", "box"], [coco, anonymous_layout(4)]), 1.0)
    assert not found["known"] and found["source"].endswith("no rule for box")


def test_free_codes_and_the_shape_encoder_stay_behind(data, tmp_path):
    trainer = trained(data, tmp_path, codes="free")
    export_model(trainer, 0.5, tmp_path / "m.npz", "paul train")
    names = load_model(tmp_path / "m.npz").weights
    assert not [name for name in names if not name.startswith(("encoder.", "decoder."))]


def test_the_mean_of_dense_shapes_is_taken_of_fewer(data, tmp_path, monkeypatch):
    trainer = trained(data, tmp_path)
    asked = []
    monkeypatch.setattr(export, "predict_shapes", lambda *args: asked.append(args[2]) or np.ones((4, 3, 11)))
    export_model(trainer, 0.5, tmp_path / "m.npz", "paul train")
    monkeypatch.setattr(export, "_COORDINATES", 330)
    export_model(trainer, 0.5, tmp_path / "m.npz", "paul train")
    assert asked == [4096, 10]


@pytest.mark.parametrize("mirrored", [0, 7, 20])
def test_shapes_are_distinguished_from_mirror_images_of_their_mean(mirrored):
    rng = np.random.default_rng(0)
    mean = rng.standard_normal((3, 9))
    mean -= mean.mean(1, keepdims=True)
    shapes = Rotation.random(20, random_state=0).as_matrix() @ (mean + 0.05 * rng.standard_normal((20, 3, 9)))
    shapes[:mirrored, 2] *= -1
    assert same_side_share(shapes, mean) == 1 - mirrored / 20


def test_an_unknown_chirality_says_why():
    known = {"known": True, "source": "handedness rule of layout 'x'", "training_share": 0.97}
    assert chirality_text(known) == "known, handedness rule of layout 'x'"
    unsure = {**known, "known": False, "training_share": 0.61}
    assert (
        chirality_text(unsure)
        == "UNKNOWN, only 61 % of the frames obey the handedness rule of layout 'x': train longer"
    )
    open_ = {**known, "known": False, "source": "handedness rule of layout 'x'; no rule for box"}
    assert chirality_text(open_).endswith("no rule for box")
    assert chirality_text({"known": False, "source": "views", "same_side_share": 1.0}) == "UNKNOWN, views"
