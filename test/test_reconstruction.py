# SPDX-License-Identifier: Apache-2.0
"""Shapes of the training frames: observed points stay, restarts are ranked, files are checked."""

import json
import sys
import types

import numpy as np
import pytest
import torch
from test_training import train
from tiny_data import centred, sequence, true_start

from paul_ros import cli as paul
from paul_ros.errors import MissingPackageError, OutputError
from paul_ros.metrics import normalised_error
from paul_ros.model_file import load_model
from training import reconstruction, session
from training.encoder_fit import fit_encoder
from training.errors import DataError, RecipeError, TrainingError
from training.recipe import Recipe
from training.reconstruction import load_reconstruction, reconstruct, train_restarts
from training.start import search as starting
from training.start.start import Start
from training.trainer import Trainer

TINY = {
    "bottleneck": 3,
    "hidden": [8, 16],
    "width": 16,
    "blocks": 1,
    "batch": 16,
    "handedness_weight": 0,
    "bone_weight": 0,
}
FREE = {**TINY, "codes": "free", "scale": "unit"}
STARTED = {**FREE, "start": "linear", "regression_steps": 4, "steps": 4}
AS_OPTIONS = [word for key, value in FREE.items() for word in ("--set", f"{key}={value}")]


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def search_for(data, camera, R, score=None, rows=slice(None)):
    """A search that finds the truth."""
    start = true_start(data, camera, R)

    def search(kind, W, visible, seed, progress):
        if progress:
            progress(0.5)
        found = Start(start.rows[rows], start.shapes[rows], start.rotations[rows], float(seed), 2.5)
        return found if score is None else Start(*list(vars(found).values())[:3], score(seed), 2.5)

    return search


@pytest.mark.parametrize("scale", ["unit", "free"])
@pytest.mark.parametrize("codes", ["free", "encoder"])
def test_observed_points_stay_and_the_rest_is_in_their_unit(codes, scale):
    data, camera, _ = sequence(hidden=0.2)
    found = reconstruct(data, Recipe.from_dict({**TINY, "codes": codes, "scale": scale, "steps": 5}))
    assert found.shapes.shape == camera.shape and found.codes.shape == (40, 3) and found.seconds > 0
    seen = np.broadcast_to(data.visible[:, None], (40, 2, camera.shape[2]))
    np.testing.assert_allclose(found.shapes[:, :2][seen], centred(camera, data.visible)[:, :2][seen], atol=1e-3)
    np.testing.assert_allclose((found.shapes * data.visible[:, None]).sum(2), 0, atol=1e-2)
    np.testing.assert_allclose(np.linalg.det(found.rotations), 1, rtol=1e-4)
    assert np.isfinite(found.shapes).all() and (np.abs(found.shapes[:, 2]).max(1) > 1).all()


@pytest.mark.parametrize("scale", ["unit", "free"])
@pytest.mark.parametrize("codes", ["free", "encoder"])
def test_a_rigid_body_is_reconstructed_from_a_good_start(monkeypatch, codes, scale):
    """Regression and objective keep a correct start: no sign or axis is lost."""
    given = sequence(bend=0.0)
    monkeypatch.setattr(starting, "search", search_for(*given))
    settings = {"regression_steps": 300, "steps": 50, "codes": codes, "scale": scale, "learning_rate": 6e-3}
    found = reconstruct(given[0], Recipe.from_dict({**STARTED, **settings}))
    error = normalised_error(found.shapes.swapaxes(1, 2), given[1].swapaxes(1, 2))
    assert np.median(error) < 0.02


def test_without_steps_the_starts_shapes_are_the_result(monkeypatch):
    given = data, camera, _ = sequence(hidden=0.2)
    monkeypatch.setattr(starting, "search", search_for(*given))
    for scale in ("unit", "free"):
        if scale == "free":  # where the search sees every frame in a size of its own
            seen = data.visible[:, None]
            size = np.sqrt((centred(camera, data.visible)[:, :2] ** 2 * seen).sum((1, 2)) / data.visible.sum(1) / 2)
            start = true_start(*given)
            shapes = start.shapes * (data.image_unit / size)[:, None, None].astype(np.float32)
            changed = Start(start.rows, shapes, start.rotations, 0.0, 2.5)
            monkeypatch.setattr(starting, "search", lambda *given: changed)
        found = reconstruct(data, Recipe.from_dict({**STARTED, "regression_steps": 0, "steps": 0, "scale": scale}))
        np.testing.assert_allclose(found.shapes, centred(camera, data.visible), atol=0.02)
        assert found.codes is None and found.loss == 0 and found.seconds == 2.5


def test_a_start_of_some_frames_is_no_reconstruction(monkeypatch):
    given = sequence()
    monkeypatch.setattr(starting, "search", search_for(*given, rows=slice(0, 30)))
    with pytest.raises(TrainingError, match="30 of 40 frames"):
        reconstruct(given[0], Recipe.from_dict({**STARTED, "regression_steps": 0, "steps": 0}))
    assert reconstruct(given[0], Recipe.from_dict(STARTED)).shapes.shape == given[1].shape


def test_an_outlier_is_refused_before_the_first_step(tmp_path, file):
    data = sequence()[0]
    data.W[7, 0, 2] = 1e5
    with pytest.raises(DataError, match="frame 7 of made up .* by point p02"):
        reconstruct(data, Recipe.from_dict({**FREE, "steps": 5}))
    np.savez(file, W=data.W)
    with pytest.raises(DataError, match="frame 7 of seq.npz .* by point p02"):
        train(file, "--shapes", tmp_path / "s.npz", *AS_OPTIONS)
    assert not list((tmp_path / "s.run").glob("*"))


def test_restarts_are_ranked_by_their_loss(tmp_path):
    data = sequence()[0]
    recipe = Recipe.from_dict({**FREE, "steps": 5, "restarts": 3, "seed": 4})
    runs = train_restarts(data, recipe, tmp_path, "cpu", lambda trainer: [None for _ in trainer.run()])
    assert sorted(run.seed for run in runs) == [4, 5, 6]
    assert [run.loss for run in runs] == sorted(run.loss for run in runs) and len({run.loss for run in runs}) == 3
    alone = reconstruct(data, Recipe.from_dict({**FREE, "steps": 5, "seed": runs[0].seed}))
    best = reconstruct(data, recipe, tmp_path)  # which finds all runs finished
    assert np.array_equal(alone.shapes, best.shapes) and alone.loss == best.loss == runs[0].loss
    assert best.seconds == sum(run.trainer.seconds for run in runs)


def test_starts_are_ranked_by_their_score(monkeypatch):
    given = sequence()
    scores = {0: -1.0, 1: -3.0, 2: -2.0}
    monkeypatch.setattr(starting, "search", search_for(*given, score=scores.get))
    recipe = Recipe.from_dict({**STARTED, "regression_steps": 0, "steps": 0, "restarts": 3})
    assert reconstruct(given[0], recipe).loss == -3.0


def test_frames_in_parts_are_those_at_once(tmp_path, monkeypatch):
    data = sequence(hidden=0.2)[0]
    recipe = Recipe.from_dict({**FREE, "steps": 3})
    once = reconstruct(data, recipe, tmp_path)
    monkeypatch.setattr(reconstruction, "_BATCH", 7)
    parts = reconstruct(data, recipe, tmp_path)
    np.testing.assert_allclose(once.shapes, parts.shapes, rtol=1e-4, atol=1e-3)
    assert once.loss == pytest.approx(parts.loss, rel=1e-5)


def test_progress_rises_to_one(monkeypatch):
    given = sequence()
    monkeypatch.setattr(starting, "search", search_for(*given))
    shares = []
    reconstruct(given[0], Recipe.from_dict({**STARTED, "restarts": 2}), progress=shares.append)
    assert shares == sorted(shares) and shares[0] > 0 and shares[-1] == 1 and 0.5 in shares


def test_a_saved_reconstruction_is_read_again(tmp_path):
    found = reconstruct(sequence()[0], Recipe.from_dict({**FREE, "steps": 2}))
    found.save(tmp_path / "s.npz")
    again = load_reconstruction(tmp_path / "s.npz")
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(again, name), value)


NO_RECONSTRUCTION = {
    "nothing": (None, "x.npz: no such file"),
    "data": (dict(W=np.zeros((4, 2, 5))), "has no array shapes; it has .*W"),
    "much else": ({f"a{i}": 0 for i in range(9)}, "it has rotations, used, loss, seconds, a0 and 8 more"),
    "2D": (dict(shapes=np.zeros((4, 2, 5))), r"not \(F,3,P\)"),
    "pickled": (dict(shapes=np.array([{}])), "plain arrays with np.savez"),
    "frames of others": (dict(shapes=np.zeros((4, 3, 5)), used=np.arange(6) < 3), "which frames its 4 are"),
    "frames by number": (dict(shapes=np.zeros((4, 3, 5)), used=np.arange(4)), "which frames its 4 are"),
    "a loss in words": (dict(shapes=np.zeros((4, 3, 5)), loss="low"), "not a saved reconstruction: .*not numbers"),
}


@pytest.mark.parametrize("case", NO_RECONSTRUCTION)
def test_files_without_a_reconstruction_are_refused(tmp_path, case):
    contents, message = NO_RECONSTRUCTION[case]
    path = tmp_path / "x.npz"
    if contents:
        np.savez(
            path,
            **{"rotations": np.zeros((4, 3, 3)), "used": np.ones(4, bool), "loss": 0.0, "seconds": 0.0, **contents},
        )
    with pytest.raises(DataError, match=message) as caught:
        load_reconstruction(path)
    assert "allow_pickle" not in str(caught.value)


# --- paul train


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setattr(session, "fit_encoder", lambda run, progress: fit_encoder(run, 20, progress))  # it is long
    data, camera, _ = sequence()
    np.savez(tmp_path / "seq.npz", W=data.W, S=camera)
    return tmp_path / "seq.npz"


def test_shapes_model_and_ranking_are_written(file, tmp_path, capsys):
    shapes, model = tmp_path / "s.npz", tmp_path / "m.npz"
    words = [*AS_OPTIONS, "--set", "steps=5", "--set", "restarts=2", "--json", tmp_path / "r.json", "--quiet"]
    train(file, "--shapes", shapes, "-o", model, *words)
    said = capsys.readouterr().out
    ranking = json.loads((tmp_path / "r.json").read_text())["restarts"]
    assert [run["chosen"] for run in ranking] == [True, False] and ranking[0]["loss"] < ranking[1]["loss"]
    assert said.index(f"seed {ranking[0]['seed']}") < said.index(f"seed {ranking[1]['seed']}")
    found = load_reconstruction(shapes)
    assert found.loss == ranking[0]["loss"] and found.shapes.shape == (40, 3, 9)
    assert load_model(model).header["training"]["recipe"]["seed"] == ranking[0]["seed"]
    assert {path.name for path in (tmp_path / "m.run").iterdir()} == {"seed_0", "seed_1"}


def test_shapes_alone_need_no_model(file, tmp_path, monkeypatch):
    monkeypatch.setattr(starting, "search", search_for(*sequence()))
    nothing = ["--set", "start=linear", "--set", "steps=0", "--quiet"]
    train(file, "--shapes", tmp_path / "s.npz", *AS_OPTIONS, *nothing)
    assert load_reconstruction(tmp_path / "s.npz").codes is None
    with pytest.raises(RecipeError, match="--shapes"):
        train(file, "-o", tmp_path / "m.npz", *AS_OPTIONS, *nothing)
    with pytest.raises(DataError, match="nothing to write"):
        train(file, *AS_OPTIONS, *nothing)


def test_fresh_forgets_the_start(file, tmp_path, monkeypatch):
    words = ["--shapes", tmp_path / "s.npz", *AS_OPTIONS, "--set", "start=linear", "--set", "steps=0", "--quiet"]
    for camera in (1, 2):
        data, truth, R = sequence()
        monkeypatch.setattr(starting, "search", search_for(data, camera * truth, R))
        train(file, *words, *(["--fresh"] if camera == 2 else []))
        depth = load_reconstruction(tmp_path / "s.npz").shapes[:, 2]
        np.testing.assert_allclose(depth, camera * truth[:, 2], atol=0.05)


def test_no_output_overwrites_the_kept_start(file, tmp_path):
    (tmp_path / "m.run").mkdir()
    with pytest.raises(OutputError, match="two outputs"):
        train(file, "-o", tmp_path / "m.npz", "--json", tmp_path / "m.run" / "start.npz", *AS_OPTIONS)


def test_a_gpu_that_is_not_there_is_named(file, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(TrainingError, match="--device cpu"):
        train(file, "-o", tmp_path / "m.npz", *AS_OPTIONS, "--device", "cuda")
    assert session.training_device("auto") == torch.device("cpu")


def test_tensorboard_is_asked_for_before_the_first_step(file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(MissingPackageError, match=r"\.\[tensorboard\]"):
        train(file, "-o", tmp_path / "m.npz", *AS_OPTIONS, "--tensorboard")
    assert not list((tmp_path / "m.run").glob("*"))


def test_tensorboard_gets_the_losses(file, tmp_path, monkeypatch):
    written, begun = [], []

    class Writer:
        def __init__(self, folder, purge_step):
            begun.append((folder, purge_step))

        def add_scalar(self, *scalar):
            written.append(scalar)

        def close(self):
            written.append("closed")

    monkeypatch.setitem(sys.modules, "tensorboard", types.SimpleNamespace())
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", types.SimpleNamespace(SummaryWriter=Writer))
    train(file, "-o", tmp_path / "m.npz", *AS_OPTIONS, "--set", "steps=40", "--tensorboard", "--quiet")
    assert begun == [(str(tmp_path / "m.run" / "tensorboard"), 1)] and written[-1] == "closed"
    curve = [(value, step) for name, value, step in written[:-1] if name == "recon_ad"]
    assert [step for _, step in curve] == [20, 40] and curve[1][0] < curve[0][0]


def test_ctrl_c_says_how_to_go_on(file, tmp_path, monkeypatch, capsys):
    advance = Trainer._advance

    def interrupted(self, begun):
        if self.step == 3:
            raise KeyboardInterrupt
        return advance(self, begun)

    monkeypatch.setattr(Trainer, "_advance", interrupted)
    assert stopped(
        capsys, file, "-o", tmp_path / "m.npz", *AS_OPTIONS, "--set", "start=random", "--set", "steps=5"
    ) == ("paul: stopped at step 3 of 5: the same command continues")
    assert (tmp_path / "m.run" / "checkpoint.pt").exists()


def stopped(capsys, *words):
    """The last line of `paul train` that Ctrl-C ended, its exit code checked."""
    assert paul.main(["train", *map(str, words), "--set", "regression_steps=0", "--quiet"]) == 130
    return capsys.readouterr().err.splitlines()[-1]


def interrupt(*words, **names):
    raise KeyboardInterrupt


def test_ctrl_c_during_the_search_or_the_last_fit_says_so(file, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(starting, "search", interrupt)
    words = [file, "--shapes", tmp_path / "s.npz", *AS_OPTIONS]
    said = stopped(capsys, *words, "--set", "start=linear", "--set", "steps=0")
    assert said == "paul: stopped while searching for a start: the same command begins again"
    monkeypatch.setattr(session, "fit_encoder", interrupt)
    said = stopped(capsys, *words, "--fresh", "-o", tmp_path / "m.npz", "--set", "start=random", "--set", "steps=2")
    assert "stopped while fitting the 2D encoder to the codes" in said
    assert load_reconstruction(tmp_path / "s.npz").shapes.shape == (40, 3, 9)


def test_a_restart_that_diverges_is_ranked_last(file, tmp_path, monkeypatch, capsys):
    advance, bad = Trainer._advance, {0}

    def diverging(self, begun):
        if self.recipe.seed in bad and self.step == 2:
            raise TrainingError("the loss is nan")
        return advance(self, begun)

    monkeypatch.setattr(Trainer, "_advance", diverging)
    words = [*AS_OPTIONS, "--set", "steps=3", "--set", "restarts=2", "--quiet"]
    train(file, "--shapes", tmp_path / "s.npz", *words, "--json", tmp_path / "r.json")
    assert "seed 0  diverged" in capsys.readouterr().out
    good, lost = json.loads((tmp_path / "r.json").read_text())["restarts"]
    assert (good["seed"], good["chosen"], lost["seed"], lost["loss"]) == (1, True, 0, None)
    bad.add(1)
    with pytest.raises(TrainingError, match="the loss is nan"):
        train(file, "--shapes", tmp_path / "t.npz", *words)


def test_a_start_that_cannot_be_read_is_no_divergence(tmp_path, monkeypatch):
    (tmp_path / "seed_0").mkdir()
    (tmp_path / "seed_0" / "start.npz").write_bytes(b"junk")
    given = sequence()
    monkeypatch.setattr(starting, "search", search_for(*given))
    with pytest.raises(TrainingError, match="start over"):
        reconstruct(given[0], Recipe.from_dict({**STARTED, "restarts": 2}), tmp_path)


def test_printed_losses_and_fits_have_a_name_and_a_unit(file, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(starting, "search", search_for(*sequence()))
    words = [file, "--shapes", tmp_path / "s.npz", *AS_OPTIONS]
    train(*words, "--set", "start=linear", "--set", "steps=0")
    said = capsys.readouterr()
    assert "score of the start 0 (negative log likelihood a frame" in said.out and "0step" not in said.err
    train(*words, "-o", tmp_path / "m.npz", "--set", "steps=4", "--json", tmp_path / "m.json")
    said, header = capsys.readouterr(), json.loads((tmp_path / "m.json").read_text())
    assert "2D encoder: 100%" in said.err and "% of their size off theirs" in said.err
    assert header["training"]["final"]["loss"] == pytest.approx(header["restarts"][0]["loss"], abs=1e-5)
    assert said.out.count(f"final loss {header['restarts'][0]['loss']:.5f}") == 2
