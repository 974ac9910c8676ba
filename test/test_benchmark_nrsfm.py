# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark nrsfm`: the trainer's input, shuffling, resuming, the choice without truth, table and keys.

The trainer is a fake that finds each frame's true shape by its image, so that errors are known by construction.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from paul_ros import cli
from training import reconstruction
from training.errors import DataError, TrainingError
from training.judge import experiments
from training.judge.experiments import Experiment, Outcome, SeriesOptions, chosen, perform, summary
from training.judge.nrsfm import METHODS, find_sequences
from training.judge.published import NORMALISED_ERROR_PERCENT, published
from training.judge.truth import Sequence
from training.recipe import Recipe
from training.reconstruction import Reconstruction
from training.start import search as starting
from training.start.start import Start

FRAMES, POINTS = 9, 14


def truth(seed):
    S = np.random.default_rng(seed).standard_normal((FRAMES, 3, POINTS))
    return S - S.mean(2, keepdims=True)


class FakeTrainer:
    """A trainer that returns the true shapes, deeper by 1 + ``excess(seed)``; the loss falls with the seed."""

    def __init__(self, shapes):
        self.shapes = {S[:2].astype(np.float32).tobytes(): S for some in shapes for S in some}
        self.calls = []
        self.excess = lambda seed: 0.0
        self.stop_at = None

    def reconstruct(self, data, recipe, folder, progress):
        if len(self.calls) == self.stop_at:
            raise KeyboardInterrupt
        self.calls.append((data, recipe, folder))
        progress(0.5)
        S = np.array([self.shapes.get(W.tobytes(), np.ones((3, POINTS))) for W in data.W])
        S = S * [[1.0], [1.0], [1 + self.excess(recipe.seed)]]
        codes = data.W[:, 0, :4].copy()
        return Reconstruction(
            np.ones(len(S), bool), S, np.tile(np.eye(3), (len(S), 1, 1)), codes, 10.0 - recipe.seed, 2.0
        )


@pytest.fixture
def folder(tmp_path):
    """Write two sequences, and a file without truth."""
    path = tmp_path / "data"
    path.mkdir()
    for seed, name in enumerate(("drink", "made")):
        S = truth(seed)
        np.savez(path / f"{name}.npz", W=S[:, :2], S=S, secret=np.ones(3))
    np.savez(path / "unlabelled.npz", W=truth(2)[:, :2])
    return path


@pytest.fixture
def fake(monkeypatch):
    trainer = FakeTrainer([truth(0), truth(1)])
    monkeypatch.setattr(reconstruction, "reconstruct", trainer.reconstruct)
    return trainer


def paul(folder, tmp_path, *options, code=0):
    words = ["benchmark", "nrsfm", "--data", str(folder), "--work", str(tmp_path / "work"), "--quiet"]
    assert cli.main([*words, "--json", str(tmp_path / "b.json"), *options]) == code
    return json.loads((tmp_path / "b.json").read_text()) if code == 0 else None


def test_rows_have_exactly_their_keys_and_every_run_has_one(folder, tmp_path, fake):
    report = paul(folder, tmp_path, "--seeds", "2")
    keys = "sequence method seed ne_flip_frame_percent ne_flip_global_percent loss seconds chosen".split()
    assert all(list(row) == keys for row in report["rows"])
    found = [(row["sequence"], row["method"], row["seed"]) for row in report["rows"]]
    assert found == [(name, method, seed) for name in ("drink", "made") for method in METHODS for seed in (0, 1)]


def test_each_method_trains_its_recipe(folder, tmp_path, fake):
    paul(folder, tmp_path, "--seeds", "1", "--sequences", "made")
    recipes = {method: recipe for method, (_, recipe, _) in zip(METHODS, fake.calls)}
    assert (recipes["paul"].streams, recipes["adl"].streams) == ("both", "decoder")
    assert recipes["adl_low_rank"].nuclear_weight > 0 == recipes["adl"].nuclear_weight
    assert recipes["linear"].steps == 0 and recipes["linear"].start == "linear"
    assert recipes["rigid"].steps == 0 and recipes["rigid"].start == "rigid"


def test_frames_are_shuffled_by_the_seed_and_put_back_for_errors(folder, tmp_path, fake):
    report = paul(folder, tmp_path, "--seeds", "2", "--sequences", "made", "--methods", "paul")
    given = [data.W for data, _, _ in fake.calls]
    W = truth(1)[:, :2].astype(np.float32)
    for one in given:
        assert not np.array_equal(one, W)
        np.testing.assert_array_equal(np.sort(one, axis=0), np.sort(W, axis=0))
    assert not np.array_equal(*given)
    assert [row["ne_flip_global_percent"] for row in report["rows"]] == [pytest.approx(0, abs=1e-5)] * 2


def test_errors_and_the_chosen_seed(folder, tmp_path, fake):
    """The last seed has the lowest loss and the first the lowest error; the choice must ignore errors."""
    fake.excess = lambda seed: 0.1 * (1 + seed)
    report = paul(folder, tmp_path, "--seeds", "3", "--sequences", "drink", "--methods", "paul")
    S = truth(0)
    share = np.linalg.norm(S[:, 2], axis=1) / np.linalg.norm(S, axis=(1, 2))
    expected = [100 * 0.1 * (1 + seed) * share.mean() for seed in range(3)]
    assert [row["ne_flip_frame_percent"] for row in report["rows"]] == pytest.approx(expected, rel=1e-5)
    assert [row["chosen"] for row in report["rows"]] == [False, False, True]
    (line,) = report["summary"]
    assert line["chosen_ne_flip_frame_percent"] == pytest.approx(expected[2])
    assert line["median_ne_flip_frame_percent"] == pytest.approx(expected[1])
    assert line["best_ne_flip_frame_percent"] == pytest.approx(expected[0])
    assert line["worst_ne_flip_frame_percent"] == pytest.approx(expected[2])


def test_no_ground_truth_reaches_the_trainer(folder, tmp_path, fake):
    """The trainer's arguments and files hold no truth, and do not change with it."""
    paul(folder, tmp_path, "--seeds", "1", "--sequences", "made", "--methods", "paul")
    data, _, run = fake.calls[0]
    assert {name for name, value in vars(data).items() if isinstance(value, np.ndarray)} == {"W", "visible", "used"}
    assert not data.layout.edges
    with np.load(run.parent / "given.npz") as archive:
        assert set(archive.files) == {"W", "visible"}
    with np.load(folder / "made.npz") as archive:
        np.savez(folder / "made.npz", W=archive["W"], S=archive["S"] * [[1], [1], [3]])
    again = paul(folder, tmp_path, "--seeds", "1", "--sequences", "made", "--methods", "paul", "--fresh")
    np.testing.assert_array_equal(fake.calls[1][0].W, data.W)
    assert again["rows"][0]["ne_flip_frame_percent"] > 10


def test_an_interrupted_benchmark_continues(folder, tmp_path, fake, capsys):
    options = "--seeds", "2", "--methods", "paul,adl"
    fake.stop_at = 3
    paul(folder, tmp_path, *options, code=130)
    assert len(fake.calls) == 3
    fake.stop_at = None
    report = paul(folder, tmp_path, *options)
    assert len(fake.calls) == 8 == len(report["rows"])
    assert paul(folder, tmp_path, *options) == report and len(fake.calls) == 8
    paul(folder, tmp_path, *options, "--fresh")
    assert len(fake.calls) == 16


def test_another_setting_is_another_run(folder, tmp_path, fake):
    options = "--seeds", "1", "--methods", "paul", "--sequences", "made"
    paul(folder, tmp_path, *options)
    paul(folder, tmp_path, *options, "--set", "bottleneck=3")
    paul(folder, tmp_path, *options, "--hide", "0.3")
    usual = Recipe.load("nrsfm").bottleneck
    assert [recipe.bottleneck for _, recipe, _ in fake.calls] == [usual, 3, usual]
    paul(folder, tmp_path, *options, "--set", "bottleneck=3")
    assert len(fake.calls) == 3


def test_settings_of_training_do_not_apply_to_start_methods(folder, tmp_path, fake, capsys):
    settings = ("start=random", "regression_steps=0", "steps=100", "bottleneck=3")
    options = [word for setting in settings for word in ("--set", setting)]
    paul(folder, tmp_path, "--seeds", "1", "--methods", "paul,linear,rigid", "--sequences", "made", *options)
    found = [(recipe.start, recipe.steps, recipe.bottleneck) for _, recipe, _ in fake.calls]
    assert found == [("random", 100, 3), ("linear", 0, 3), ("rigid", 0, 3)]
    ignored = [line for line in capsys.readouterr().err.splitlines() if "ignored" in line]
    assert [line.split(":")[0] for line in ignored] == ["linear", "rigid"]
    assert all("start=random, regression_steps=0, steps=100 ignored" in line for line in ignored)


def test_points_are_hidden_and_the_truth_of_all_judges(folder, tmp_path, fake):
    report = paul(folder, tmp_path, "--seeds", "2", "--methods", "paul", "--sequences", "made", "--hide", "0.3")
    first, second = (data for data, _, _ in fake.calls)
    assert (first.visible.sum(1) == POINTS - round(0.3 * POINTS)).all()
    assert (first.W.transpose(0, 2, 1)[~first.visible] == 0).all()
    assert first.visible.tobytes() != second.visible.tobytes()
    assert report["hidden_share"] == 0.3 and report["rows"][0]["ne_flip_frame_percent"] > 10


def test_runs_of_a_recipe_that_restarts_share_no_seed(folder, tmp_path, fake):
    paul(folder, tmp_path, "--seeds", "3", "--methods", "paul", "--sequences", "made", "--set", "restarts=4")
    assert [recipe.seed for _, recipe, _ in fake.calls] == [0, 4, 8]


def test_table_has_the_papers_figures_beside_ours(folder, tmp_path, fake, capsys):
    paul(folder, tmp_path, "--seeds", "1", "--plot", str(tmp_path / "b.png"))
    printed = capsys.readouterr()
    head, row = (line.split() for line in printed.out.split("\npublished\n")[1].splitlines()[:2])
    assert row[0] == "drink" and (head[-1], row[-1]) == ("PAUL", "0.47") and "CVPR 2021" in printed.out
    assert "skipped" in printed.err and "unlabelled" in printed.err
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")


def test_published_figures():
    """Some figures of each row equal the paper's."""
    assert published("drink") == published("drink_train") == NORMALISED_ERROR_PERCENT["drink"]
    assert published("shark")["PAUL"] == 0.37 and published("S5_train")["Deep NRSfM"] == 13.40
    assert published("pickup")["BMM-v2"] == 1.98 and published("s123")["CNS"] == 26.46
    assert "PND" not in published("S1") and published("made") == {}


def outcome(seed, error, loss=0.0):
    return Outcome(Experiment(None, "paul", seed), error, error, loss, 1.0, None)


def test_rate_of_bad_basins():
    found = summary([outcome(seed, error) for seed, error in enumerate((1.0, 1.2, 1.1, 3.2, 50.0))])
    assert found["bad_basin_share"] == pytest.approx(1 / 5)
    assert found["deviation_ne_flip_frame_percent"] == pytest.approx(np.std([1.0, 1.2, 1.1, 3.2, 50.0]))


def test_equal_losses_choose_the_first_seed():
    assert chosen([outcome(1, 5.0), outcome(0, 9.0)]).experiment.seed == 0


@pytest.mark.parametrize(
    "options, message",
    [
        (["--sequences", "dance"], "no sequence dance"),
        (["--methods", "paull"], "no recipe 'paull'"),
        (["--set", "bottelneck=3"], "method paul: unknown recipe setting bottelneck"),
        (["--methods", "linear,adl", "--set", "regression_steps=0"], "method adl: start: linear needs"),
        (["--sequences", "unlabelled"], "no array S"),
        (["--hide", "0.9"], "too few points"),
    ],
)
def test_errors_are_one_line_before_any_training(folder, tmp_path, fake, capsys, options, message):
    paul(folder, tmp_path, *options, code=1)
    printed = capsys.readouterr().err
    assert message in printed.splitlines()[-1] and "Traceback" not in printed
    assert not fake.calls


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(DataError, match="no npz files"):
        find_sequences(tmp_path)


@pytest.mark.parametrize("option", [["--hide", "1"], ["--seeds", "0"], ["--methods", "paul,paul"], ["--methods", ","]])
def test_wrong_usage(folder, option):
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "nrsfm", "--data", str(folder), *option])
    assert end.value.code == 2


def test_the_real_trainer_runs_and_resumes(tmp_path):
    S = truth(0)
    made = Sequence("made", S[:, :2], np.ones((FRAMES, POINTS), bool), S, np.zeros((0, 2), int), False)
    settings = ("start=random", "regression_steps=0", "steps=20", "batch=4", "bottleneck=2", "code_weight=0.01")
    runs = [Experiment(made, "paul", 0, settings)]
    (first,) = perform(runs, SeriesOptions(tmp_path, quiet=True))
    assert np.isfinite(first.loss) and first.codes.shape == (FRAMES, 2)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("shapes.npz")}
    (again,) = perform(runs, SeriesOptions(tmp_path, quiet=True))
    assert again.ne_flip_global_percent == first.ne_flip_global_percent and len(before) == 1
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("shapes.npz")} == before


@pytest.fixture
def searches(monkeypatch):
    """Record the searches for starts; each gives random shapes of its seed and takes 100 s."""
    found = []

    def search(kind, W, visible, seed, progress):
        found.append((kind, len(W), seed))
        rng = np.random.default_rng(seed)
        R = np.tile(np.eye(3, dtype=np.float32), (len(W), 1, 1))
        return Start(np.arange(len(W)), rng.standard_normal((len(W), 3, W.shape[2])).astype(np.float32), R, 1.0, 100.0)

    monkeypatch.setattr(starting, "search", search)
    return found


def made_runs(*methods, seeds=(0,), settings=()):
    S = truth(0)
    made = Sequence("made", S[:, :2], np.ones((FRAMES, POINTS), bool), S, np.zeros((0, 2), int), False)
    few = ("regression_steps=2", "steps=2", "batch=4", "bottleneck=2")
    own = {"linear": (), "rigid": ()}
    return [Experiment(made, method, seed, own.get(method, (*few, *settings))) for seed in seeds for method in methods]


def test_experiments_with_equal_starts_share_one_and_its_seconds(tmp_path, searches):
    runs = made_runs("paul", "adl", "linear", "rigid", seeds=(0, 1))
    outcomes = perform(runs, SeriesOptions(tmp_path, quiet=True))
    assert searches == [("linear", FRAMES, 0), ("rigid", FRAMES, 0), ("linear", FRAMES, 1), ("rigid", FRAMES, 1)]
    assert all(100 <= outcome.seconds < 110 for outcome in outcomes)
    starts = [path.read_bytes() for path in sorted(tmp_path.glob("starts/*"))]
    assert len(starts) == 4 and {path.read_bytes() for path in tmp_path.glob("made*/run/start.npz")} == set(starts)


def test_a_shared_start_gives_the_same_as_an_own_one(tmp_path, searches):
    perform(made_runs("paul"), SeriesOptions(tmp_path / "shared", quiet=True))
    (shared,) = perform(made_runs("adl"), SeriesOptions(tmp_path / "shared", quiet=True))
    (own,) = perform(made_runs("adl"), SeriesOptions(tmp_path / "own", quiet=True))
    assert len(searches) == 2 and shared.loss == own.loss
    np.testing.assert_array_equal(shared.codes, own.codes)


def test_restarts_share_starts_by_their_seeds(tmp_path, searches):
    perform(made_runs("paul", settings=("restarts=2",)), SeriesOptions(tmp_path, quiet=True))
    perform(made_runs("adl", seeds=(0, 1, 2)), SeriesOptions(tmp_path, quiet=True))
    # Seed 1 of one run has another order of frames, and so other data, than restart 1 of another run.
    assert [seed for _, _, seed in searches] == [0, 1, 1, 2]


def test_other_scales_data_or_versions_have_other_starts(tmp_path, searches, monkeypatch):
    perform(made_runs("paul"), SeriesOptions(tmp_path, quiet=True))
    perform(made_runs("paul", settings=("scale=free",)), SeriesOptions(tmp_path, quiet=True))
    assert len(searches) == 2
    hidden = made_runs("adl")
    hidden[0].sequence.visible[0, 0] = False
    perform(hidden, SeriesOptions(tmp_path, quiet=True))
    assert len(searches) == 3
    monkeypatch.setattr(experiments, "__version__", "another")
    perform(made_runs("adl"), SeriesOptions(tmp_path, quiet=True))
    assert len(searches) == 4


def test_fresh_searches_anew_and_a_damaged_start_says_so(tmp_path, searches):
    perform(made_runs("paul"), SeriesOptions(tmp_path, quiet=True))
    (shared,) = tmp_path.glob("starts/*")
    shared.write_bytes(shared.read_bytes()[:100])
    with pytest.raises(TrainingError, match="cannot be read.*--fresh"):
        perform(made_runs("adl"), SeriesOptions(tmp_path, quiet=True))
    perform(made_runs("paul", "adl"), SeriesOptions(tmp_path, fresh=True, quiet=True))
    assert len(searches) == 2


def test_a_run_from_random_weights_has_no_start(tmp_path, searches):
    perform(made_runs("paper"), SeriesOptions(tmp_path, quiet=True))
    assert not searches and not (tmp_path / "starts").exists()


def test_codes_come_back_in_the_order_of_the_frames(fake, tmp_path):
    S = truth(0)
    made = Sequence("made", S[:, :2], np.ones((FRAMES, POINTS), bool), S, np.zeros((0, 2), int), False)
    (found,) = experiments.perform([Experiment(made, "paul", 5)], SeriesOptions(tmp_path, quiet=True))
    np.testing.assert_array_equal(found.codes, S[:, 0, :4].astype(np.float32))
