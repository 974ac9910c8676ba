# SPDX-License-Identifier: Apache-2.0
"""`paul study`: varied quantities, reports, resuming, pictures."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from paul_ros import cli
from paul_ros.cli.study import STUDIES
from paul_ros.layout import anonymous_layout
from paul_ros.model_file import load_model, save_model, weight_shapes
from training import reconstruction
from training.categories import joint_layout
from training.errors import DataError
from training.judge.studies import interpolation, registry
from training.judge.studies.latent import roughness
from training.judge.truth import random_rotations
from training.reconstruction import Reconstruction

ROOT = Path(__file__).resolve().parent.parent
FRAMES, POINTS = 12, 14


class FakeTrainer:
    """A trainer that returns flat shapes, so that the missing depth is the error; it records its calls."""

    def __init__(self):
        self.calls = []

    def reconstruct(self, data, recipe, folder, progress):
        self.calls.append((data, recipe))
        S = np.concatenate([data.W, np.zeros_like(data.W[:, :1])], axis=1)
        codes = data.W[:, 0, : recipe.bottleneck].copy()
        return Reconstruction(
            np.ones(len(S), bool), S, np.tile(np.eye(3), (len(S), 1, 1)), codes, float(recipe.seed), 1.0
        )


@pytest.fixture
def fake(monkeypatch):
    trainer = FakeTrainer()
    monkeypatch.setattr(reconstruction, "reconstruct", trainer.reconstruct)
    return trainer


@pytest.fixture
def files(tmp_path):
    made = []
    for seed, name in enumerate(("one", "two")):
        S = np.random.default_rng(seed).standard_normal((FRAMES, 3, POINTS))
        S -= S.mean(2, keepdims=True)
        made.append(tmp_path / f"{name}.npz")
        np.savez(made[-1], W=S[:, :2], S=S)
    return [str(path) for path in made]


def study(name, files, tmp_path, *options, code=0):
    words = ["study", name, "--data", *files, "-o", str(tmp_path / "out"), *options]
    if name != "interpolation":
        words += ["--quiet"]
    assert cli.main(words) == code
    if code:
        return None
    assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    return json.loads((tmp_path / "out" / f"{name}.json").read_text())


def test_bottleneck_sweeps_k_from_2_to_12_with_mean_and_deviation(files, tmp_path, fake, capsys):
    report = study("bottleneck", files, tmp_path, "--seeds", "2")
    assert [recipe.bottleneck for _, recipe in fake.calls] == [K for _ in files for K in range(2, 13) for _ in (0, 1)]
    assert len(report["summary"]) == 22 and len(report["rows"]) == 44
    line = report["summary"][0]
    errors = [row["ne_flip_frame_percent"] for row in report["rows"][:2]]
    assert line["mean_ne_flip_frame_percent"] == pytest.approx(np.mean(errors)) and line["ratio"] >= 1
    assert "deviation" in capsys.readouterr().out


def test_noise_grows_and_the_truth_stays_clean(files, tmp_path, fake):
    report = study("noise", files[:1], tmp_path, "--seeds", "1", "--values", "0,0.5")
    (clean, _), (noisy, _) = fake.calls
    assert np.abs(clean.W - noisy.W).max() > 0.1
    errors = [row["ne_flip_frame_percent"] for row in report["rows"]]
    with np.load(files[0]) as archive:
        S = archive["S"]
    assert errors[0] == pytest.approx(100 * (np.linalg.norm(S[:, 2], axis=1) / np.linalg.norm(S, axis=(1, 2))).mean())
    assert errors[1] > errors[0]
    assert [line["ratio"] for line in report["summary"]] == pytest.approx([1.0, errors[1] / errors[0]])


def test_hidden_hides_points(files, tmp_path, fake):
    study("hidden", files[:1], tmp_path, "--seeds", "1")
    assert [data.visible.sum(1).tolist() for data, _ in fake.calls] == [[14] * FRAMES, [10] * FRAMES, [6] * FRAMES]


def test_auto_decoder_compares_the_papers_three(files, tmp_path, fake):
    report = study("auto_decoder", files[:1], tmp_path, "--seeds", "2")
    assert [row["method"] for row in report["rows"]] == ["paul"] * 2 + ["adl"] * 2 + ["adl_low_rank"] * 2
    assert [recipe.streams for _, recipe in fake.calls] == ["both"] * 2 + ["decoder"] * 4


def test_latent_spaces_have_two_dimensions_and_both_kinds_of_cameras(files, tmp_path, fake, capsys):
    report = study("latent", files[:1], tmp_path, "--seeds", "1")
    assert [recipe.bottleneck for _, recipe in fake.calls] == [2] * 4
    found = [(line["cameras"], line["method"]) for line in report["summary"]]
    assert found == [(camera, method) for camera in ("own cameras", "random cameras") for method in ("paul", "adl")]
    own, random = fake.calls[0][0].W, fake.calls[2][0].W
    assert np.abs(np.sort(own, axis=None) - np.sort(random, axis=None)).max() > 0.1
    assert "roughness" in capsys.readouterr().out


def test_roughness_tells_a_curve_from_noise():
    curve = np.stack([np.linspace(0, 1, 500), np.linspace(0, 2, 500)], axis=1)
    rng = np.random.default_rng(0)
    assert roughness(curve) == pytest.approx(3 / 499, rel=0.05)
    assert roughness(rng.permutation(curve)) == pytest.approx(1, abs=0.1)


def test_codes_of_untrained_networks_are_refused_before_any_training(files, tmp_path, fake, capsys):
    options = ["--seeds", "1", "--set", "steps=0"]
    study("latent", files, tmp_path, *options, code=1)
    printed = capsys.readouterr().err
    assert "study latent needs the codes of trained networks, and method paul trains none" in printed
    assert printed.count("\n") == 1 and not fake.calls
    study("bottleneck", files[:1], tmp_path, *options, "--values", "2")
    assert len(fake.calls) == 1


def test_an_interrupted_study_continues(files, tmp_path, fake):
    study("bottleneck", files[:1], tmp_path, "--seeds", "1", "--values", "2,3")
    report = study("bottleneck", files[:1], tmp_path, "--seeds", "2", "--values", "2,3,4")
    assert len(fake.calls) == 6 == len(report["rows"])
    study("bottleneck", files[:1], tmp_path, "--seeds", "1", "--values", "2", "--fresh")
    assert len(fake.calls) == 7


def test_the_benchmark_and_every_study_share_runs(files, tmp_path, fake):
    """A run is identified by its data and recipe, whichever command asks for it."""
    study("auto_decoder", files[:1], tmp_path, "--seeds", "1")
    words = ["--data", str(tmp_path), "--sequences", "one", "--methods", "paul", "--seeds", "1", "--quiet"]
    assert cli.main(["benchmark", "nrsfm", *words, "--work", str(tmp_path / "out" / "work")]) == 0
    assert len(fake.calls) == 3


def test_interpolation_draws_the_line_between_two_codes(model_file, tmp_path, capsys):
    model = load_model()
    rng = np.random.default_rng(0)
    shapes = model.decode(0.3 * rng.standard_normal((10, model.header["bottleneck"])))
    S = random_rotations(10, 0) @ shapes
    np.savez(tmp_path / "seen.npz", W=S[:, :2], S=S)
    file = [str(tmp_path / "seen.npz")]
    report = study("interpolation", file, tmp_path, "--model", "human", "--frames", "2,5")
    (line,) = report["rows"]
    assert line["frames"] == [2, 5] and len(line["changes_percent"]) == 8
    ends = model.shape(S[[2, 5], :2], np.ones((2, 43), bool))
    size = line["ends_apart_percent"] / 100
    assert sum(line["changes_percent"]) / 100 >= size > 0
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(size * np.linalg.norm(ends, axis=(1, 2)).mean(), rel=0.1)
    with pytest.raises(
        DataError, match="43 points, but model '.*' has 17: give the model of these points with --model"
    ):
        interpolation.run(str(model_file), [Path(file[0])], tmp_path, None)
    (other,) = study("interpolation", file, tmp_path, "--model", "human")["rows"]
    codes = model.encode(S[:, :2], np.ones((10, 43), bool))
    apart = np.linalg.norm(codes[:, None] - codes, axis=2)
    assert apart[tuple(other["frames"])] == apart.max()


def random_model(path, layout):
    """Write a model of random weights."""
    header = {
        "layout": layout.to_dict(),
        "bottleneck": 2,
        "metres_per_unit": None,
        "chirality": {"known": False, "source": "made by hand"},
        "architecture": {
            "encoder": {"kind": "residual", "width": 4, "blocks": 1},
            "decoder": {"kind": "mlp", "hidden": [4]},
        },
    }
    rng = np.random.default_rng(0)
    sizes = weight_shapes(header, len(layout.names))
    arrays = {name: rng.standard_normal(size) for name, size in sizes.items()}
    save_model(path, header, {**arrays, "mean_shape": rng.standard_normal((3, len(layout.names)))})
    return path


@pytest.mark.parametrize("far_off", [0.0, 9.0])
def test_interpolation_of_a_category_shows_its_own_points(tmp_path, files, far_off, monkeypatch):
    """The model's points of the other category count for nothing and are not drawn."""
    drawn = []
    monkeypatch.setattr(interpolation, "save_figure", lambda figure, path: drawn.append(figure))
    layout = joint_layout(["one", "other"], [anonymous_layout(POINTS, ((0, 1),)), anonymous_layout(5)])
    path = random_model(tmp_path / "m.npz", layout)
    model = load_model(path)
    model.weights["decoder.1.bias"].reshape(3, -1)[:, POINTS:] += far_off
    monkeypatch.setattr(interpolation, "load_model", lambda _: model)
    interpolation.run(path, [Path(files[0])], tmp_path, (2, 5))
    (line,) = json.loads((tmp_path / "interpolation.json").read_text())["rows"]
    with np.load(files[0]) as archive:
        W = np.pad(archive["W"], ((0, 0), (0, 0), (0, 5)))
    shapes = model.shape(W[[2, 5]], np.arange(POINTS + 5)[None].repeat(2, 0) < POINTS)[:, :, :POINTS].astype(float)
    shapes -= shapes.mean(2, keepdims=True)
    size = np.linalg.norm(shapes, axis=(1, 2)).mean()
    assert line["ends_apart_percent"] == pytest.approx(100 * np.linalg.norm(shapes[1] - shapes[0]) / size, rel=0.1)
    axes = drawn[0].axes
    assert [ax.get_title() for ax in axes] == [
        *("one\nframe 2 as seen", "0", "0.125", "0.25", "0.375", "0.5", "0.625", "0.75", "0.875", "1"),
        "one\nframe 5 as seen",
    ]
    for ax in axes:
        points = np.ma.filled(ax.collections[-1].get_offsets(), np.nan)
        bones = ax.collections[0].get_segments()
        assert np.isfinite(points).all(1).sum() == POINTS and len(bones) == 1 and np.isfinite(bones[0]).all()


def test_interpolation_needs_no_truth_and_names_frames_that_are_not_counted(tmp_path, model_file, capsys):
    S = np.random.default_rng(0).standard_normal((4, 3, 17))
    visible = np.ones((4, 17), bool)
    visible[1, 2:] = False
    np.savez(tmp_path / "seen.npz", W=S[:, :2], visible=visible)
    study("interpolation", [str(tmp_path / "seen.npz")], tmp_path, "--model", str(model_file), "--frames", "1,2")
    assert "seen.npz: 1 of the frames show too few points" in capsys.readouterr().err


def test_interpolation_needs_no_torch(tmp_path):
    S = np.random.default_rng(0).standard_normal((3, 3, 43))
    np.savez(tmp_path / "seen.npz", W=S[:, :2], S=S)
    code = "import sys\nfrom paul_ros import cli\nassert cli.main(sys.argv[1:]) == 0\nassert 'torch' not in sys.modules"
    words = ["study", "interpolation", "--model", "human", "--data", tmp_path / "seen.npz", "-o", tmp_path]
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr


def test_missing_frames_are_named(files, tmp_path, model_file, capsys):
    S = np.random.default_rng(0).standard_normal((3, 3, 17))
    np.savez(tmp_path / "seen.npz", W=S[:, :2], S=S)
    options = "--model", str(model_file), "--frames", "1,3"
    study("interpolation", [str(tmp_path / "seen.npz")], tmp_path, *options, code=1)
    assert "frames 0 to 2" in capsys.readouterr().err
    study("interpolation", files[:1], tmp_path, *options, code=1)
    assert "14 points" in capsys.readouterr().err


def test_two_files_of_one_name_are_refused(files, tmp_path, fake, capsys):
    study("noise", [files[0], files[0]], tmp_path, code=1)
    assert "one name" in capsys.readouterr().err and not fake.calls


def test_every_study_of_the_command_line_is_there(capsys):
    assert set(STUDIES) == set(registry.STUDIES)
    for name in (*STUDIES, "interpolation"):
        with pytest.raises(SystemExit) as end:
            cli.main(["study", name, "--help"])
        assert end.value.code == 0 and "examples:" in capsys.readouterr().out


@pytest.mark.parametrize("option", [["--values", "a"], ["--values", "2,2"], ["--values", "-1"], ["--seeds", "0"]])
def test_wrong_usage(files, option):
    with pytest.raises(SystemExit) as end:
        cli.main(["study", "bottleneck", "--data", *files, "-o", "out", *option])
    assert end.value.code == 2
