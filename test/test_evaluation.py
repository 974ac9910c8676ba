# SPDX-License-Identifier: Apache-2.0
"""`paul evaluate`: errors of known size, hidden points, scales, and bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from paul_ros import cli, metrics
from paul_ros.layout import load_layout
from paul_ros.model_file import load_model, save_model
from training.errors import DataError
from training.judge import evaluation, prediction
from training.judge.truth import Sequence, load_sequence, random_rotations
from training.reconstruction import Reconstruction

ROOT = Path(__file__).resolve().parent.parent


def turned(model_file, count=12, size=50.0, seed=0):
    """Return the model's only shape in random poses (F,3,P), image units."""
    return size * random_rotations(count, seed) @ load_model(model_file).mean_shape.astype(float)


def write(path, S, **more):
    np.savez(path, **{"W": S[:, :2], "S": S, **more})
    return path


def evaluate(model, data, tmp_path, *options):
    assert cli.main(["evaluate", str(model), str(data), "--json", str(tmp_path / "e.json"), *options]) == 0
    return json.loads((tmp_path / "e.json").read_text())


# --- the measures


def test_deep_nrsfms_error_ignores_similarity_and_reflection_only():
    truth = np.random.default_rng(0).standard_normal((6, 9, 3))
    similar = 3 * metrics.flip_depth(truth) @ random_rotations(6, 1).transpose(0, 2, 1) + 5
    np.testing.assert_allclose(metrics.normalised_error_o3(similar, truth), 0, atol=1e-12)
    stretched = truth * [1, 1, 2]
    assert (metrics.normalised_error_o3(stretched, truth) > 0.05).all()
    assert (metrics.normalised_error_o3(stretched, truth) < metrics.normalised_error(stretched, truth)).all()


def test_mpjpe_takes_the_better_of_original_and_flipped():
    truth = np.zeros((2, 4, 3))
    truth[:, :, 2] = [3, -3, 3, -3]
    mirrored = truth * [1, 1, -1]
    np.testing.assert_allclose(metrics.mpjpe(mirrored, truth), 6)
    np.testing.assert_allclose(metrics.mpjpe_flip_frame(mirrored + [0, 0, 9], truth), 0, atol=1e-12)
    np.testing.assert_allclose(metrics.mpjpe_flip_frame(2 * truth, truth), 3)


def test_flipped_share_counts_the_rarer_sign():
    truth = np.random.default_rng(0).standard_normal((10, 5, 3))
    mixed = truth.copy()
    mixed[:7] = metrics.flip_depth(truth[:7])
    for signs in (
        metrics.normalised_error_of_signs(mixed, truth),
        metrics.normalised_error_of_signs(metrics.flip_depth(mixed), truth),
    ):
        assert metrics.flipped_share(signs) == pytest.approx(0.3)


def test_absent_points_count_for_nothing():
    truth = np.random.default_rng(0).standard_normal((3, 6, 3))
    present = np.ones((3, 6), bool)
    present[:, 5] = False
    wild = truth.copy()
    wild[:, 5] = 1e6
    filled = (metrics.fill_absent(points, present) for points in (1.1 * wild, wild))
    expected = metrics.normalised_error(1.1 * truth[:, :5], truth[:, :5])
    np.testing.assert_allclose(metrics.normalised_error(*filled), expected)


# --- single-frame prediction


def test_a_perfect_model_has_no_error_and_the_observed_scale(model_file, tmp_path):
    report = evaluate(model_file, write(tmp_path / "d.npz", turned(model_file) + 7), tmp_path)
    assert report["ne_flip_frame_percent"] == pytest.approx(0, abs=1e-3)
    assert report["mpjpe_flip_frame_units"] == pytest.approx(0, abs=1e-3)
    assert report["reprojection_median_percent"] == pytest.approx(0, abs=1e-3)
    assert report["certified_share"] == 1 and report["judged"] == report["frames"] == 12


def test_errors_have_their_closed_form(model_file, tmp_path):
    """The truth is 10 % deeper than the model can be, so NE follows from the depths."""
    S = turned(model_file)
    truth = S.copy()
    truth[:, 2] *= 1.1
    report = evaluate(model_file, write(tmp_path / "d.npz", truth, W=S[:, :2]), tmp_path)
    depth = np.linalg.norm(0.1 * S[:, 2], axis=1) / np.linalg.norm(truth, axis=(1, 2))
    assert report["ne_flip_frame_percent"] == pytest.approx(100 * depth.mean(), rel=1e-3)
    distance = np.abs(0.1 * S[:, 2]).mean()
    assert report["mpjpe_flip_frame_units"] == pytest.approx(distance, rel=1e-3)
    assert report["ne_o3_percent"] < report["ne_flip_frame_percent"]


def test_distances_of_metric_truth_are_in_millimetres(model_file, tmp_path):
    S = turned(model_file, size=0.33)
    truth = S.copy()
    truth[:, 2] *= 1.1
    units = evaluate(model_file, write(tmp_path / "d.npz", truth, W=S[:, :2]), tmp_path)
    metric = evaluate(model_file, write(tmp_path / "m.npz", truth, W=S[:, :2], metres=True), tmp_path)
    assert units["n_mpjpe_mm"] is None and "n_mpjpe_units" not in metric
    for name in ("mpjpe_flip_frame", "n_mpjpe", "pa_mpjpe"):
        assert metric[f"{name}_mm"] == pytest.approx(1000 * units[f"{name}_units"])


def test_hidden_points_count_and_have_an_error_of_their_own(model_file, tmp_path):
    S = turned(model_file)
    visible = np.ones((12, 17), bool)
    visible[:, 9] = False
    truth = S.copy()
    truth[:, 2, 9] += 20.0
    report = evaluate(model_file, write(tmp_path / "d.npz", truth, visible=visible), tmp_path)
    assert report["hidden_share"] == pytest.approx(1 / 17)
    assert report["ne_hidden_percent"] > 3 * report["ne_visible_percent"] > 0
    assert report["ne_visible_percent"] < report["ne_flip_frame_percent"] < report["ne_hidden_percent"]


def test_errors_are_also_those_of_s_cam(model_file, tmp_path):
    """S_cam leaves the depth errors of visible points and all errors of hidden ones."""
    S = turned(model_file)
    truth = S + np.random.default_rng(0).normal(0, 2.0, S.shape)
    visible = np.ones((12, 17), bool)
    visible[:, 9] = False
    data = write(tmp_path / "d.npz", truth, W=truth[:, :2], visible=visible)
    report = evaluate(model_file, data, tmp_path)
    found = prediction.predict(load_model(model_file), truth[:, :2], visible).S.astype(float)
    off = found - prediction.centred(truth, visible)
    off[:, :2] *= ~visible[:, None]
    off -= off.mean(2, keepdims=True)
    size = np.linalg.norm(truth - truth.mean(2, keepdims=True), axis=(1, 2))
    assert report["observed"]["ne_flip_frame_percent"] == pytest.approx(
        100 * (np.linalg.norm(off, axis=(1, 2)) / size).mean(), rel=1e-3
    )
    assert report["observed"]["ne_flip_frame_percent"] < report["ne_flip_frame_percent"]
    assert report["observed"]["reprojection_median_percent"] == pytest.approx(0, abs=1e-3)


def test_values_of_hidden_points_are_ignored(model_file, tmp_path):
    S = turned(model_file)
    visible = np.random.default_rng(0).random((12, 17)) < 0.7
    W = np.where(visible[:, None], S[:, :2], np.nan)
    nan = evaluate(model_file, write(tmp_path / "n.npz", S, W=W), tmp_path)
    wild = np.where(visible[:, None], S[:, :2], 1e5)
    flagged = evaluate(model_file, write(tmp_path / "f.npz", S, W=wild, visible=visible), tmp_path)
    assert nan["ne_flip_global_percent"] == flagged["ne_flip_global_percent"]


def test_points_without_truth_count_for_nothing(model_file, tmp_path):
    S = turned(model_file)
    truth = S.copy()
    truth[:, 2, :] *= 1.1
    truth[:, :, 4] = np.nan
    report = evaluate(model_file, write(tmp_path / "d.npz", truth, W=S[:, :2]), tmp_path)
    part = np.delete(S, 4, axis=2)
    part = part - part.mean(2, keepdims=True)
    expected = np.linalg.norm(0.1 * part[:, 2], axis=1) / np.linalg.norm(part * [[1], [1], [1.1]], axis=(1, 2))
    assert report["ne_flip_frame_percent"] == pytest.approx(100 * expected.mean(), rel=1e-3)
    assert report["mpjpe_flip_frame_units"] == pytest.approx(np.abs(0.1 * part[:, 2]).mean(), rel=1e-3)


def test_mirror_image_of_unknown_chirality_is_forgiven_as_a_whole(model_file, tmp_path):
    """Mirror images have equal views; they are errors only if the model's chirality is known."""
    S = turned(model_file)
    data = write(tmp_path / "d.npz", S * [[1], [1], [-1]])
    known = evaluate(model_file, data, tmp_path)
    assert not known["whole_set_mirrored"] and known["pa_mpjpe_units"] > 1
    model = load_model(model_file)
    header = {**model.header, "chirality": {"known": False, "source": "made by hand"}}
    save_model(tmp_path / "open.npz", header, {**model.weights, "mean_shape": model.mean_shape})
    unknown = evaluate(tmp_path / "open.npz", data, tmp_path)
    assert unknown["whole_set_mirrored"] and unknown["pa_mpjpe_units"] < 1e-3
    assert unknown["flipped_share"] == 0 and unknown["ne_flip_global_percent"] < 1e-3


def test_a_model_of_unit_scale_keeps_its_size(model_file, tmp_path):
    """A model of unit scale cannot fit a view twice as large; one of free scale can."""
    free = load_model(model_file)
    header = {**free.header, "scale": "unit", "image_unit": 50.0, "metres_per_unit": None}
    save_model(tmp_path / "unit.npz", header, {**free.weights, "mean_shape": free.mean_shape})
    data, twice = (write(tmp_path / f"{size}.npz", turned(model_file, size=size)) for size in (50.0, 100.0))
    assert evaluate(tmp_path / "unit.npz", data, tmp_path)["ne_flip_frame_percent"] < 1e-3
    assert evaluate(tmp_path / "unit.npz", twice, tmp_path)["ne_flip_frame_percent"] > 50
    assert evaluate(model_file, twice, tmp_path)["ne_flip_frame_percent"] < 1e-3


def test_the_baseline_is_the_rigid_mean_shape(model_file, tmp_path):
    """A model of a single shape equals its baseline."""
    report = evaluate(model_file, write(tmp_path / "d.npz", turned(model_file) * [[1], [1], [1.2]]), tmp_path)
    for key, value in report["baseline"].items():
        assert report[key] == pytest.approx(value, rel=1e-6, abs=1e-5)  # % and units: the reprojection is next to 0
    assert report["baseline"]["ne_flip_frame_percent"] > 1


def test_frames_that_show_too_little_are_dropped_and_counted(model_file, tmp_path):
    visible = np.ones((12, 17), bool)
    visible[0, 3:] = False
    report = evaluate(model_file, write(tmp_path / "d.npz", turned(model_file), visible=visible), tmp_path)
    assert report["dropped"] == {"too_few_points": 1} and report["judged"] == 11


FIXED = """frames persons dropped n_mpjpe_mm pa_mpjpe_mm ne_flip_frame_percent ne_flip_global_percent
root_error_median_mm root_error_median_percent reprojection_median_px certified_share ambiguous_share
lift_us_median lift_us_p99 baseline model bag versions""".split()


def test_keys_of_the_json(model_file, tmp_path):
    report = evaluate(model_file, write(tmp_path / "d.npz", turned(model_file)), tmp_path)
    assert not set(FIXED) - set(report)
    assert report["model"] == "stand" and report["lift_us_median"] > 0


def test_table_and_picture(model_file, tmp_path, capsys):
    edges = np.array(load_layout("coco17").edges)
    data = write(tmp_path / "d.npz", turned(model_file), edges=edges)
    evaluate(model_file, data, tmp_path, "--plot", str(tmp_path / "e.png"))
    assert "one flip for all" in capsys.readouterr().out
    assert (tmp_path / "e.png").read_bytes().startswith(b"\x89PNG")


def test_a_model_is_judged_without_torch(model_file, tmp_path):
    data = write(tmp_path / "d.npz", turned(model_file))
    code = "import sys\nfrom paul_ros import cli\nassert cli.main(sys.argv[1:]) == 0\nassert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code, "evaluate", model_file, data], cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr


# --- bad input

S = np.random.default_rng(0).standard_normal((4, 3, 17))
BAD = {
    "no truth": (dict(W=S[:, :2]), "no array S"),
    "no W": (dict(S=S), "no array W"),
    "other frames": (dict(W=S[:3, :2], S=S), "same frames"),
    "other points": (dict(W=S[:, :2, :9], S=S[:, :, :9]), "9 points"),
    "text": (dict(W=np.full((4, 2, 17), "a"), S=S), "numbers"),
    "odd flags": (dict(W=S[:, :2], S=S, visible=np.full((4, 17), 7)), "visible"),
    "edges of points that are not there": (dict(W=S[:, :2], S=S, edges=np.array([[0, 17]])), "edges"),
    "truth of nothing": (dict(W=S[:, :2], S=S * np.nan), "holds no number"),
    "nothing seen": (dict(W=S[:, :2], S=S, visible=np.zeros((4, 17))), "no frame"),
    "pickled": (dict(W=np.array([{}]), S=S), "plain arrays with np.savez"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_data_is_one_clear_line(model_file, tmp_path, capsys, case):
    contents, message = BAD[case]
    np.savez(tmp_path / "bad.npz", **contents)
    assert cli.main(["evaluate", str(model_file), str(tmp_path / "bad.npz"), "--json", str(tmp_path / "e.json")]) == 1
    printed = capsys.readouterr().err
    assert message in printed and printed.count("\n") == 1 and "allow_pickle" not in printed
    assert not (tmp_path / "e.json").exists()


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"PK junk")
    with pytest.raises(DataError, match="bad.npz"):
        load_sequence(tmp_path / "bad.npz")


def test_help_has_examples(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["evaluate", "--help"])
    assert end.value.code == 0 and "paul evaluate person.npz unseen.npz" in capsys.readouterr().out


def test_data_or_truth_must_be_named(model_file, capsys):
    for words in ([], ["a.npz", "--truth", "b.npz"]):
        with pytest.raises(SystemExit) as end:
            cli.main(["evaluate", str(model_file), *words])
        assert end.value.code == 2 and "--truth" in capsys.readouterr().err


def test_a_picture_of_unknown_format_is_refused_before_any_work(model_file, monkeypatch, capsys):
    monkeypatch.setattr(evaluation, "evaluate_model", lambda *_: pytest.fail("evaluated in vain"))
    with pytest.raises(SystemExit) as end:
        cli.main(["evaluate", str(model_file), "data.npz", "--plot", "e.xyz"])
    assert end.value.code == 2 and "'e.xyz' ends neither in .png" in capsys.readouterr().err


# --- variants of a sequence


def sequence(frames=30, points=20, seed=0):
    S = np.random.default_rng(seed).standard_normal((frames, 3, points))
    return Sequence("made", S[:, :2].copy(), np.ones((frames, points), bool), S, np.zeros((0, 2), int), False)


def test_hiding_hides_that_share_of_every_frame_and_its_coordinates():
    hidden = sequence().hiding(0.3, seed=1)
    assert (hidden.visible.sum(1) == 14).all() and (hidden.W.transpose(0, 2, 1)[~hidden.visible] == 0).all()
    assert (hidden.visible.any(0)).all() and not np.array_equal(hidden.visible, sequence().hiding(0.3, 2).visible)
    twice = hidden.hiding(0.5, seed=3)
    assert (twice.visible.sum(1) == 7).all() and not (twice.visible & ~hidden.visible).any()


def test_noise_is_a_share_of_the_rms_coordinate_and_leaves_the_truth():
    made = sequence(400)
    noisy = made.noisy(0.1, seed=0)
    rms = np.sqrt(((made.W - made.W.mean(2, keepdims=True)) ** 2).mean())
    assert (noisy.W - made.W).std() == pytest.approx(0.1 * rms, rel=0.02)
    np.testing.assert_array_equal(noisy.S, made.S)


def test_random_cameras_see_the_same_shapes():
    made = sequence()
    other = made.from_random_cameras(seed=0)
    assert np.abs(other.W - made.W).max() > 0.1
    np.testing.assert_array_equal(other.W, other.S[:, :2])
    points, true = other.S.transpose(0, 2, 1), made.S.transpose(0, 2, 1)
    np.testing.assert_allclose(metrics.pa_mpjpe(points, true), 0, atol=1e-12)
    unknown = sequence()
    unknown.S[0, 0, 0] = np.nan
    with pytest.raises(DataError, match="unknown"):
        unknown.from_random_cameras(0)


def test_mean_shape_of_one_shape_in_many_poses_is_that_shape():
    shape = np.random.default_rng(0).standard_normal((3, 9))
    R = random_rotations(20, 0)
    mean = prediction.rigid_mean(R @ shape * np.linspace(1, 3, 20)[:, None, None], R)
    assert metrics.pa_mpjpe(mean.T[None], shape.T[None])[0] == pytest.approx(0, abs=1e-12)
    assert np.sqrt((mean**2).sum(0).mean()) == pytest.approx(1)


# --- saved reconstructions


def saved(path, S):
    turn = random_rotations(len(S), 7)
    Reconstruction(np.ones(len(S), bool), S.astype(np.float32), turn.astype(np.float32), None, 0.5, 12.0).save(path)
    return str(path)


def evaluate_saved(path, data, tmp_path):
    words = ["evaluate", str(path), "--truth", str(data), "--json", str(tmp_path / "e.json")]
    assert cli.main(words) == 0
    return json.loads((tmp_path / "e.json").read_text())


def test_a_saved_reconstruction_is_judged_frame_by_frame(tmp_path):
    made = sequence()
    truth = made.S - made.S.mean(2, keepdims=True)
    data = write(tmp_path / "d.npz", made.S)
    exact = evaluate_saved(saved(tmp_path / "a.npz", truth), data, tmp_path)
    assert exact["ne_flip_global_percent"] < 1e-4 and exact["loss"] == 0.5 and exact["seconds"] == 12.0
    deeper = evaluate_saved(saved(tmp_path / "b.npz", truth * [[1], [1], [1.1]]), data, tmp_path)
    share = np.linalg.norm(0.1 * truth[:, 2], axis=1) / np.linalg.norm(truth, axis=(1, 2))
    assert deeper["ne_flip_frame_percent"] == pytest.approx(100 * share.mean(), rel=1e-4)
    some_mirrored = truth.copy()
    some_mirrored[:10, 2] *= -1
    mixed = evaluate_saved(saved(tmp_path / "c.npz", some_mirrored), data, tmp_path)
    assert mixed["flipped_share"] == pytest.approx(1 / 3) and mixed["ne_flip_frame_percent"] < 1e-4
    assert mixed["ne_flip_global_percent"] > 10


def test_frames_that_were_left_out_of_a_reconstruction_are_counted(tmp_path):
    made = sequence()
    truth, used = made.S - made.S.mean(2, keepdims=True), np.arange(len(made.S)) % 3 > 0
    path = tmp_path / "s.npz"
    turn = random_rotations(used.sum(), 7).astype(np.float32)
    Reconstruction(used, truth[used].astype(np.float32), turn, None, 0.5, 12.0).save(path)
    report = evaluate_saved(path, write(tmp_path / "d.npz", made.S), tmp_path)
    assert report["ne_flip_global_percent"] < 1e-4 and report["frames"] == len(used)
    assert report["dropped"] == {"too_few_points": int((~used).sum())}


def test_the_baseline_of_a_reconstruction_is_its_rigid_mean(tmp_path):
    """The baseline of one shape in many poses is that shape; it is far from many different shapes."""
    shape = np.random.default_rng(0).standard_normal((3, 20))
    shape -= shape.mean(1, keepdims=True)
    R = random_rotations(30, 7)
    rigid = evaluate_saved(saved(tmp_path / "a.npz", R @ shape), write(tmp_path / "d.npz", R @ shape), tmp_path)
    assert rigid["baseline"]["ne_flip_frame_percent"] < 1e-3
    varied = R @ (shape + 0.3 * np.random.default_rng(1).standard_normal((30, 3, 20)))
    other = evaluate_saved(saved(tmp_path / "b.npz", varied), write(tmp_path / "v.npz", varied), tmp_path)
    assert other["baseline"]["ne_flip_frame_percent"] > 10 > other["ne_flip_frame_percent"]


def test_a_reconstruction_of_other_frames_is_refused(tmp_path, capsys):
    made = sequence()
    data = write(tmp_path / "d.npz", made.S)
    assert cli.main(["evaluate", saved(tmp_path / "a.npz", made.S[:-1]), "--truth", str(data)]) == 1
    assert "that was reconstructed" in capsys.readouterr().err
    assert cli.main(["evaluate", str(data), "--truth", str(data)]) == 1
    assert "is not a saved reconstruction" in capsys.readouterr().err


def test_either_form_names_the_other(model_file, tmp_path, capsys):
    data = write(tmp_path / "d.npz", sequence().S)
    assert cli.main(["evaluate", saved(tmp_path / "s.npz", sequence().S), str(data)]) == 1
    assert "holds saved shapes, no model: name their data with --truth" in capsys.readouterr().err
    assert cli.main(["evaluate", str(model_file), "--truth", str(data)]) == 1
    assert "a model is judged without --truth: MODEL DATA" in capsys.readouterr().err
    assert cli.main(["evaluate", "humen", str(data)]) == 1
    assert "--truth" not in capsys.readouterr().err


# --- units


def pinhole(S, aside=(1500.0, -500.0), focal=600.0, centre=(320.0, 240.0), depth=4000.0):
    """Return the pixels (F,2,P) of shapes moved in front of a camera, its matrix, and the moved shapes."""
    S = S + np.array([*aside, depth])[:, None]
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    return focal * S[:, :2] / S[:, 2:] + np.array(centre)[:, None], K, S


@pytest.mark.parametrize("unit", [1.0, 0.001])
def test_pixels_against_metres_are_judged_with_the_camera_or_refused(model_file, tmp_path, capsys, unit):
    W, K, S = pinhole(turned(model_file))
    best = evaluate(model_file, write(tmp_path / "d.npz", turned(model_file)), tmp_path)
    report = evaluate(model_file, write(tmp_path / "p.npz", unit * S, W=W, K=K), tmp_path)
    assert best["ne_flip_frame_percent"] < report["ne_flip_frame_percent"] < 3
    central, _, ahead = pinhole(turned(model_file), aside=(0.0, 0.0))
    rays = (central - K[:2, 2, None]) / 600
    report = evaluate(model_file, write(tmp_path / "r.npz", unit * ahead, W=rays, calibrated=True), tmp_path)
    assert report["ne_flip_frame_percent"] < 3
    for name, coordinates in (("pixels", W), ("rays", rays)):
        if unit == 1.0 and name == "pixels":
            coordinates = 100 * coordinates
        data = write(tmp_path / f"{name}.npz", unit * S, W=coordinates)
        assert cli.main(["evaluate", str(model_file), str(data)]) == 1
        assert "times as large as x and y of S" in capsys.readouterr().err


def test_rays_are_judged_as_pixels_with_their_camera_are(model_file, tmp_path):
    """Beside the axis, too: both are seen by cameras that are turned to the object."""
    W, K, S = pinhole(turned(model_file))
    pixels = evaluate(model_file, write(tmp_path / "p.npz", S, W=W, K=K), tmp_path)
    rays = evaluate(model_file, write(tmp_path / "r.npz", S, W=S[:, :2] / S[:, 2:], calibrated=True), tmp_path)
    for key in ("ne_flip_frame_percent", "n_mpjpe", "pa_mpjpe"):
        key = key if key in rays and rays[key] is not None else f"{key}_units"
        assert rays[key] == pytest.approx(pixels[key], rel=1e-4), key


def test_the_camera_of_another_image_is_refused_as_such(model_file, tmp_path):
    W, K, S = pinhole(turned(model_file))
    with pytest.raises(DataError, match="with K, W .* is 0.4.* save the K of the image that W belongs to"):
        load_sequence(write(tmp_path / "d.npz", S, W=W, K=K * [[2], [2], [1]]), turned=True)


def test_true_points_in_the_centre_of_the_camera_are_unknown(model_file, tmp_path):
    W, K, S = pinhole(turned(model_file))
    marked = S.copy()
    marked[1, :, 5] = 0
    truth = load_sequence(write(tmp_path / "d.npz", marked, W=W, K=K), turned=True)
    assert truth.present.sum() == S.shape[0] * S.shape[2] - 1 and not truth.present[1, 5]


def test_metres_that_are_millimetres_are_refused(tmp_path, capsys):
    human = load_model("human")
    S = human.metres_per_unit * random_rotations(12, 0) @ human.mean_shape.astype(float)
    assert evaluate("human", write(tmp_path / "m.npz", S, metres=True), tmp_path)["n_mpjpe_mm"] < 100
    assert cli.main(["evaluate", "human", str(write(tmp_path / "mm.npz", 1000 * S, metres=True))]) == 1
    assert "looks like millimetres" in capsys.readouterr().err
    evaluate("human", write(tmp_path / "units.npz", 1000 * S), tmp_path)


def test_other_frames_than_the_cameras_are_refused(model_file, tmp_path):
    S = turned(model_file)
    with pytest.raises(DataError, match="point in opposite directions"):
        load_sequence(write(tmp_path / "up.npz", S, W=S[:, :2] * [[1], [-1]]))
    with pytest.raises(DataError, match="no view of S"):
        load_sequence(write(tmp_path / "side.npz", S, W=S[:, [2, 0]]))
    with pytest.raises(DataError, match="S is not in front"):
        load_sequence(write(tmp_path / "behind.npz", S, K=np.eye(3)))
    with pytest.raises(DataError, match="K in .* must be a camera matrix"):
        load_sequence(write(tmp_path / "k.npz", S, K=np.eye(2)))
    noisy = S[:, :2] + 0.2 * S.std() * np.random.default_rng(0).standard_normal(S[:, :2].shape)
    assert load_sequence(write(tmp_path / "noisy.npz", S, W=noisy)).visible.all()


def test_placeholders_are_hidden(model_file, tmp_path):
    S = turned(model_file) + np.array([300.0, 300, 0])[:, None]
    W = S[:, :2].copy()
    W[3, :, 5] = 0
    assert load_sequence(write(tmp_path / "d.npz", S, W=W)).visible.sum() == S.shape[0] * 17 - 1


def reconstructed(path, S, focal=600.0):
    """Save shapes (F,3,P) of metres, seen at 5 m, as a reconstruction of their pixels."""
    pixels = (focal / 5 * (S - S.mean(2, keepdims=True))).astype(np.float32)
    frames = len(S)
    Reconstruction(np.ones(frames, bool), pixels, random_rotations(frames, 0), None, 0.0, 0.0).save(path)
    return path


def test_shapes_of_pixels_are_judged_in_the_metres_of_the_camera(model_file, tmp_path):
    S = turned(model_file, size=0.3) + [[0], [0], [5]]
    K = np.array([[600, 0, 320], [0, 600, 240], [0, 0, 1.0]])
    seen = 600 * S[:, :2] / S[:, 2:] + [[320], [240]]
    truth = write(tmp_path / "truth.npz", S, W=seen, K=K)
    report, _ = evaluation.evaluate_shapes(reconstructed(tmp_path / "shapes.npz", S), truth)
    assert report["ne_flip_frame_percent"] < 12, "the perspective, which the shapes do not have"
    with pytest.raises(DataError, match=r"120 times as large as W of the truth.*K \(3,3\)"):
        evaluation.evaluate_shapes(tmp_path / "shapes.npz", write(tmp_path / "metres.npz", S))
