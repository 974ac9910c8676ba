# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark onp`: its rivals and its naive search are sound, and no solver can talk its way past the judge."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from paul_ros import cli
from paul_ros.benchmarks import naive, onp, rivals
from paul_ros.benchmarks.onp import judge_scenario
from paul_ros.benchmarks.onp_problems import Scenario, problems
from paul_ros.benchmarks.onp_report import table

SCALES = ("free", "unit")
KEYS = {
    "scenario",
    "method",
    "certified_share",
    "certified_wrong",
    "angle_median_deg",
    "angle_p95_deg",
    "us_single",
    "us_batch",
    "ne_percent",
}


def given(scale, count=30, seed=0, **kind):
    return problems(Scenario("test", scale, **kind), count, np.random.default_rng(seed))


def residual_of(pose, given):
    """Weighted root mean square distance, written out."""
    weights = np.ones(given.S[:, 0].shape) if given.weights is None else given.weights
    rows = zip(pose.scale, pose.R, pose.translation, given.S, given.W, weights)
    return np.array([np.sqrt((w * (s * R[:2] @ S + t[:, None] - W) ** 2).sum() / w.sum()) for s, R, t, S, W, w in rows])


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("method", sorted(onp.METHODS))
def test_all_methods_agree_on_exact_images(method, scale):
    data = given(scale, noise=0.0, hidden=0.4, weighted=True)
    found = onp.METHODS[method](*data[:3], scale)
    posed = found.scale[:, None, None] * (found.R @ data.S)
    posed[:, :2] += found.translation[..., None]
    posed[:, 2] += (data.truth - posed)[:, 2].mean(1, keepdims=True)
    size = np.abs(data.truth - data.truth.mean(2, keepdims=True)).max((1, 2), keepdims=True)
    np.testing.assert_allclose((posed - data.truth) / size, 0, atol=1e-6)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("method", sorted(set(onp.METHODS) - {"ours"}))
@pytest.mark.parametrize("kind", [{}, {"hidden": 0.5, "weighted": True}, {"thickness": 0.0}, {"points": 4}])
def test_rivals_give_rotations_and_their_true_residual(method, scale, kind):
    data = given(scale, 10, **kind)
    found = onp.METHODS[method](*data[:3], scale)
    np.testing.assert_allclose(found.R @ found.R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (10, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found.R), 1)
    np.testing.assert_allclose(found.residual, residual_of(found, data), rtol=1e-9)
    assert scale == "free" or (found.scale == 1).all()


@pytest.mark.parametrize("scale", SCALES)
def test_the_affine_fit_is_that_of_the_pseudo_inverse(scale):
    data = given(scale, 5)
    found = rivals.lsq_svd(*data[:3], scale)
    for S, W, R, zoom in zip(data.S, data.W, found.R, found.scale):
        S, W = S - S.mean(1, keepdims=True), W - W.mean(1, keepdims=True)
        U, singular, Vt = np.linalg.svd(W @ np.linalg.pinv(S), full_matrices=False)
        np.testing.assert_allclose(R[:2], U @ Vt, atol=1e-9)
        assert zoom == pytest.approx(singular.mean() if scale == "free" else 1)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("thickness", [1.0, 0.05, 0.0])
def test_majorisation_only_descends(scale, thickness):
    data = given(scale, 200, points=6, thickness=thickness)
    before, first = None, rivals.lsq_svd(*data[:3], scale).residual
    for steps in (0, 1, 2, 5, 20, 200):
        residual = rivals.majorise(*data[:3], scale, steps=steps).residual
        assert before is None or (residual <= before * (1 + 1e-9)).all()
        before = residual
    assert before.mean() < 0.95 * first.mean()


def test_polar_beats_the_least_squares_it_starts_from():
    for scale in SCALES:
        data = given(scale, 500)
        polar, lsq = rivals.polar(*data[:3], scale), rivals.lsq_svd(*data[:3], scale)
        assert np.median(polar.residual / lsq.residual) < 1


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("kind", [{"points": 4}, {"thickness": 0.05}, {"thickness": 0.0}, {"hidden": 0.5}])
def test_the_naive_search_finds_the_optimum(scale, kind):
    """BFGS from 20 random rotations and a scale finds the same."""
    data = given(scale, 4, **kind)
    found = naive.naive_optimum(*data[:3], scale)
    weights = np.ones(data.S[:, 0].shape) if data.weights is None else data.weights
    for S, W, w, residual in zip(data.S, data.W, weights, found.residual):
        S, W = (part - np.average(part, axis=1, weights=w)[:, None] for part in (S, W))
        size = np.sqrt((w * W**2).sum() / w.sum())
        guess = size / np.sqrt((w * S**2).sum() / w.sum()) if scale == "free" else 1.0

        def cost(x):
            zoom = guess * np.exp(x[3]) if scale == "free" else 1.0
            return (w * ((zoom * Rotation.from_rotvec(x[:3]).as_matrix()[:2] @ S - W) / size) ** 2).sum() / w.sum()

        starts = Rotation.random(20, random_state=0).as_rotvec()
        best = min(minimize(cost, [*start, 0.0], method="BFGS").fun for start in starts)
        assert (residual / size) ** 2 == pytest.approx(best, abs=1e-8)


def test_the_naive_search_shares_nothing_with_the_solver():
    """The rivals do not either: a common fault would stay hidden."""
    for module in (naive, rivals):
        assert not [name for name, value in vars(module).items() if "onp" in str(getattr(value, "__module__", ""))]
        assert "viewing_sphere" not in vars(module) and "paul_ros.onp import" not in Path(module.__file__).read_text()


def test_noise_is_of_the_size_that_is_named():
    data = given("free", 2000, noise=0.3, thickness=0.05)
    size = np.sqrt(data.S.var(axis=2).sum(1) / 3)
    zoom = np.sqrt(data.truth.var(axis=2).sum(1) / 3) / size
    error = (data.W - data.truth[:, :2]) / (size * zoom)[:, None, None]
    assert error.std() == pytest.approx(0.3, rel=0.01)
    assert zoom.max() / zoom.min() > 1e5


def test_hidden_points_are_far_off():
    data = given("unit", 500, hidden=0.6)
    assert (data.weights == 0).sum(1).tolist() == [10] * 500
    off = np.abs(data.W - data.truth[:, :2]).mean(1)
    assert off[data.weights == 0].mean() > 10 * off[data.weights > 0].mean()


def test_a_solver_that_calls_everything_certified_is_caught():
    def liar(S, W, weights, scale):
        """The least-squares pose, claimed to be exact and proven."""
        plain, honest = rivals.lsq_svd(S, W, weights, scale), onp.METHODS["ours"](S, W, weights, scale)
        return honest._replace(**plain._asdict() | {"residual": 0 * plain.residual}, certified=honest.certified | True)

    scenario = Scenario("test", "unit", points=6)
    lies = judge_scenario(scenario, 250, np.random.default_rng(0), liar)
    truth = judge_scenario(scenario, 250, np.random.default_rng(0))
    assert lies["ours"]["certified_wrong"].sum() > 240 and truth["ours"]["certified_wrong"].sum() == 0
    assert lies["lm_search"]["better"].sum() > 190 and truth["lm_search"]["better"].sum() == 0
    assert np.median(lies["ours"]["angle"]) > 1 and lies["ours"]["ratio"].max() > 1.1
    assert lies["ours"]["naive_missed"].sum() == 0
    np.testing.assert_array_equal(lies["lsq_svd"]["missed"], lies["ours"]["missed"])


def test_either_optimum_of_a_planar_shape_will_do():
    judged = judge_scenario(Scenario("test", "free", thickness=0.0), 200, np.random.default_rng(0))
    assert judged["ours"]["angle"].max() < 0.01 and np.median(judged["lm_search"]["angle"]) < 0.01
    assert np.median(judged["lsq_svd"]["angle"]) > 10


@pytest.fixture
def short(monkeypatch):
    """Two scenarios, few cases and repeats."""
    monkeypatch.setattr(onp, "SCENARIOS", onp.SCENARIOS[2:3])
    monkeypatch.setattr(onp, "SHAPE_SCENARIOS", onp.SHAPE_SCENARIOS[2:3])
    monkeypatch.setattr(onp, "LM_CASES", 5)
    monkeypatch.setattr(onp, "_SINGLES", 2)


def test_the_command(short, tmp_path, capsys):
    files = tmp_path / "r.json", tmp_path / "p.png"
    words = ["--cases", "60", "--batch", "100", "--json", str(files[0]), "--plot", str(files[1])]
    assert cli.main(["benchmark", "onp", *words]) == 0
    printed = capsys.readouterr()
    report = json.loads(files[0].read_text())
    assert printed.err == "" and files[1].read_bytes().startswith(b"\x89PNG")
    assert [row["method"] for row in report["rows"]] == 2 * list(onp.METHODS)
    for row in report["rows"]:
        assert KEYS <= set(row)
        assert row["cases"] == (5 if row["method"] == "lm_search" else 60)
        assert (row["certified_share"] is None) == (row["method"] != "ours")
        assert (row["ne_percent"] is None) == ("shape noise" not in row["scenario"]) != (row["us_single"] is None)
    ours, lsq = report["rows"][:2]
    assert ours["certified_share"] > 0.99 and ours["certified_wrong"] == 0
    assert 0.3 < lsq["angle_median_deg"] < 5 and lsq["missed"] == 60
    assert report["settings"]["cases"] == 60 and report["settings"]["seed"] == 0
    for text in ("17 points, 30 % noise, unit scale", "20 % shape noise, 60 % hidden", "certified and wrong 0"):
        assert text in printed.out
    ratio = ours["us_single"] / lsq["us_single"]
    line = next(line.split() for line in printed.out.splitlines() if line.startswith("   ours "))
    assert line[10:12] == [f"{ours['us_single']:.1f}", f"{ratio:.2f}"]


def test_the_same_seed_gives_the_same_problems(short):
    def untimed(seed):
        report = onp.run(20, 20, seed)
        return [{key: value for key, value in row.items() if not key.startswith("us_")} for row in report["rows"]]

    assert untimed(1) == untimed(1) != untimed(2)


def test_the_table_shows_what_was_wrong(short):
    report = onp.run(20, 20, 0)
    report["summary"]["certified_wrong"] = 7
    assert "certified and wrong 7" in table(report)


@pytest.mark.parametrize("module", ["scipy", "tqdm", "rich", "matplotlib"])
def test_a_missing_package_is_one_line(module, monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, module, None)
    assert cli.main(["benchmark", "onp", "--cases", "5", "--plot", str(tmp_path / "p.png")]) == 1
    printed = capsys.readouterr()
    assert printed.err == (
        f"paul: the Python package '{module}' is missing: pip install '.[benchmark]' in a clone of paul_ros\n"
    )


@pytest.mark.parametrize("words", [["--cases", "0"], ["--batch", "-3"], ["--cases", "many"]])
def test_odd_counts_are_refused(words, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "onp", *words])
    assert end.value.code == 2 and words[0] in capsys.readouterr().err


def test_help_explains_every_column(capsys):
    with pytest.raises(SystemExit):
        cli.main(["benchmark", "onp", "--help"])
    text = capsys.readouterr().out
    for column in ("cert. %", "wrong", "missed", "better", "angle", "ratio", "µs batch", "x lsq", *onp.METHODS):
        assert f"\n  {column}" in text


def test_an_output_that_cannot_be_written_is_refused_first(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(onp, "run", lambda *_: pytest.fail("measured in vain"))
    assert cli.main(["benchmark", "onp", "--json", str(tmp_path)]) == 1
    assert "it is a folder" in capsys.readouterr().err
