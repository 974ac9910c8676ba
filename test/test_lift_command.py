# SPDX-License-Identifier: Apache-2.0
"""`paul lift`: arrays from files to files, as the node lifts messages; bad files are one clear line."""

from __future__ import annotations

import csv
import io
import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import CENTRE, FOCAL, persons_at, seen
from test_camera_info import info

import msg_adapters
from msg_adapters import Source, read_camera_info
from paul_ros import cli
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifter
from paul_ros.offline import keypoint_files
from paul_ros.offline.bag_reader import read_messages
from paul_ros.offline.camera_file import read_camera
from paul_ros.offline.replay import replay
from paul_ros.stream.stream import open_stream

ROOT = Path(__file__).resolve().parent.parent
ONE = ROOT / "bags" / "one_person.mcap"
COCO = load_layout("coco17").names
CAMERA = [str(value) for value in (FOCAL, FOCAL, *CENTRE)]
CALIBRATION = f"""\
image_width: 640
image_height: 480
camera_name: tests
camera_matrix: {{rows: 3, cols: 3, data: [1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0.1, 0.0, 0.0, 0.0, 0.0]}}
projection_matrix:
  rows: 3
  cols: 4
  data: [{FOCAL}, 0.0, {CENTRE[0]}, 0.0, 0.0, {FOCAL}, {CENTRE[1]}, 0.0, 0.0, 0.0, 1.0, 0.0]
"""


@pytest.fixture(autouse=True)
def same_environment(monkeypatch):
    """The command sets thread counts for its own process."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(variable, "1")


@pytest.fixture(scope="module")
def persons() -> np.ndarray:
    """(5,17,2) pixels; three keypoints of the second person are hidden."""
    xy = seen(persons_at((0, 0, 4), (1, 0, 5), (-1, 0.2, 6), (0, 0, 3), (0.5, 0, 7)))
    xy[1, :3] = np.nan
    return xy


def lift(source, out, model_file, *options) -> int:
    return cli.main(["lift", *map(str, (source, "-o", out, "--model", model_file, *options))])


def npz(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **arrays)
    return path


def table(xy: np.ndarray, keypoints=COCO, confidence: float = 1.0) -> str:
    """CSV of persons, one a frame; hidden keypoints have no row."""
    lines = ["frame,person,keypoint,x,y,confidence"]
    for frame, person in enumerate(xy.tolist()):
        lines += [f"{frame},7,{name},{x},{y},{confidence}" for name, (x, y) in zip(keypoints, person) if x == x]
    return "\n".join(lines) + "\n"


def frames(xy: np.ndarray) -> str:
    """JSON of persons, one a frame; hidden keypoints are null."""
    return json.dumps([[[None if point[0] != point[0] else point for point in person]] for person in xy.tolist()])


def read(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an output of any format."""
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    if path.suffix == ".json":
        whole = json.loads(path.read_text())
        persons = whole.pop("persons")
        return {**whole, **{name: _column([person[name] for person in persons]) for name in persons[0]}}
    rows = list(csv.DictReader(io.StringIO(path.read_text())))
    names = list(dict.fromkeys(row["keypoint"] for row in rows))
    first = rows[:: len(names)]
    points = np.array([[float(row[axis] or "nan") for axis in "xyz"] for row in rows])
    return {
        "keypoints": names,
        "points": points.reshape(len(first), len(names), 3),
        "root": np.array([[float(row[f"root_{axis}"] or "nan") for axis in "xyz"] for row in first]),
        "frame": np.array([int(row["frame"]) for row in first]),
        "reason": np.array([row["reason"] for row in first]),
        "units": {row["units"] for row in rows}.pop(),
    }


def _column(values: list) -> np.ndarray:
    """An array of the values; of objects where one is null."""
    if None not in values:
        return np.array(values)
    column = np.empty(len(values), object)
    column[:] = values
    return column


# --- what is lifted


@pytest.mark.parametrize("kind", ["npz", "csv", "json"])
def test_arrays_are_lifted_as_messages_are(kind, tmp_path, capsys):
    """To float32, in which the model's networks compute batches of other sizes."""
    done = replay(ONE, open_stream())
    points = np.concatenate([frame.lifted.points for frame in done.frames])
    root = np.concatenate([frame.lifted.root for frame in done.frames])
    given = [
        msg_adapters.read(type_name, message, 17, Source(COCO))
        for _, type_name, message, _ in read_messages(ONE, ["/keypoints"])
    ]
    xy = np.concatenate([one.xy for one in given])
    confidence = np.concatenate([one.confidence for one in given])
    source = tmp_path / f"in.{kind}"
    if kind == "npz":
        npz(source, keypoints=xy, confidence=confidence)
    else:  # the adapter has hidden what the threshold does not
        xy = np.where((confidence >= 0.3)[..., None], xy, np.nan)
        source.write_text({"csv": table, "json": frames}[kind](xy))
    camera = done.frames[0].camera
    numbers = [str(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
    out = tmp_path / f"out.{kind}"
    assert cli.main(["lift", str(source), "-o", str(out), "--intrinsics", *numbers]) == 0
    lifted = read(out)
    np.testing.assert_allclose(lifted["points"], points, rtol=0, atol=2e-5)
    np.testing.assert_allclose(lifted["root"], root, rtol=0, atol=2e-5)
    assert list(lifted["keypoints"]) == list(COCO) and str(lifted["units"]) == "m"
    assert f"{out}: 585 of 585 persons lifted, layout coco17, units m" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["npz", "csv", "json"])
def test_every_format_says_the_same(kind, persons, model_file, tmp_path):
    """The hidden keypoints, the person that is not lifted, and its frame."""
    xy = persons.copy()
    xy[3, 3:] = np.nan
    source = npz(tmp_path / "in.npz", keypoints=xy)
    assert lift(source, tmp_path / "ref.npz", model_file, "--intrinsics", *CAMERA) == 0
    text = tmp_path / ("in.csv" if kind == "csv" else "in.json")
    text.write_text(table(xy) if kind == "csv" else frames(xy))
    assert lift(text, tmp_path / f"out.{kind}", model_file, "--intrinsics", *CAMERA) == 0
    reference, lifted = read(tmp_path / "ref.npz"), read(tmp_path / f"out.{kind}")
    assert lifted["reason"].tolist() == ["", "", "", "too_few_points", ""]
    if kind == "json":  # nobody is null there
        rows = [0, 1, 2, 4]
        np.testing.assert_array_equal(np.array(lifted["points"][rows].tolist()), reference["points"][rows])
        assert lifted["points"][3] is None and lifted["root"][3] is None
    else:
        np.testing.assert_array_equal(lifted["points"], reference["points"])
        np.testing.assert_array_equal(lifted["root"], reference["root"])
    assert lifted["frame"].tolist() == [0, 1, 2, 3, 4]


def test_the_output_states_what_it_is(persons, model_file, tmp_path, capsys):
    source = npz(tmp_path / "in.npz", keypoints=persons, frame=np.arange(5) * 3, person=np.array([4, 4, 9, 4, 4]))
    assert lift(source, tmp_path / "m.npz", model_file, "--intrinsics", *CAMERA) == 0
    assert lift(source, tmp_path / "units.npz", model_file) == 0
    assert "model units; give --camera or --intrinsics for metres" in capsys.readouterr().out
    metres, units = read(tmp_path / "m.npz"), read(tmp_path / "units.npz")
    assert (str(metres["units"]), str(units["units"])) == ("m", "model")
    assert str(metres["coordinate_frame"]).endswith("z forward; origin at the camera")
    assert str(units["coordinate_frame"]).endswith("line of sight to each person; origin at each person's root")
    np.testing.assert_allclose(metres["root"][:, 2], [4, 5, 6, 3, 7], rtol=0.05)
    np.testing.assert_allclose(units["root"], 0, atol=1e-9)
    assert np.isfinite(metres["distance_sigma"]).all() and np.isnan(units["distance_sigma"]).all()
    assert metres["frame"].tolist() == [0, 3, 6, 9, 12] and metres["person"].tolist() == ["4", "4", "9", "4", "4"]
    assert metres["certified"].dtype == bool and metres["ambiguity"].shape == (5,)
    assert (str(metres["layout"]), str(metres["model"])) == ("coco17", "stand")


@pytest.mark.parametrize(
    "arrays",
    [
        lambda xy: {"W": xy.transpose(0, 2, 1)},
        lambda xy: {"keypoints": np.nan_to_num(xy), "visible": np.isfinite(xy).all(2)},
        lambda xy: {"keypoints": np.nan_to_num(xy), "confidence": np.isfinite(xy).all(2) * 0.5},
        lambda xy: {"keypoints": np.dstack([np.nan_to_num(xy), np.isfinite(xy).all(2)])},
        lambda xy: {"keypoints": np.where(np.isnan(xy), 1e9, xy)},
        lambda xy: {"keypoints": np.where(np.isnan(xy), np.inf, xy).astype(">f8")},
    ],
    ids=["W", "visible", "confidence", "triples", "far out", "big endian"],
)
def test_hidden_keypoints_in_every_way(arrays, persons, model_file, tmp_path):
    npz(tmp_path / "a.npz", keypoints=persons)
    npz(tmp_path / "b.npz", **arrays(persons))
    for name in "ab":
        assert lift(tmp_path / f"{name}.npz", tmp_path / f"{name}.out.npz", model_file, "--intrinsics", *CAMERA) == 0
    a, b = (read(tmp_path / f"{name}.out.npz") for name in "ab")
    np.testing.assert_array_equal(a["points"], b["points"])


def test_the_confidence_threshold_is_the_nodes(persons, model_file, tmp_path):
    confidence = np.ones(persons.shape[:2])
    confidence[0, 4:] = 0.29
    source = npz(tmp_path / "in.npz", keypoints=persons, confidence=confidence)
    assert lift(source, tmp_path / "a.npz", model_file) == 0
    assert lift(source, tmp_path / "b.npz", model_file, "--min-confidence", "0.2") == 0
    assert read(tmp_path / "a.npz")["reason"][0] == "too_few_points"
    assert read(tmp_path / "b.npz")["reason"][0] == ""


@pytest.mark.parametrize("written", ["ids", "triples"])
def test_persons_in_json_as_objects_or_flat(written, persons, model_file, tmp_path):
    one = persons[0].tolist()
    flat = [number for x, y in one for number in (x, y, 0.9)]
    people = [{"id": "ada", "keypoints": one}, {"keypoints": persons[2].tolist()}] if written == "ids" else [flat, flat]
    (tmp_path / "in.json").write_text(json.dumps([[], people]))
    assert lift(tmp_path / "in.json", tmp_path / "out.npz", model_file) == 0
    lifted = read(tmp_path / "out.npz")
    assert lifted["frame"].tolist() == [1, 1]
    assert lifted["person"].tolist() == (["ada", "1"] if written == "ids" else ["0", "1"])


def test_an_id_that_utf8_cannot_hold(persons, model_file, tmp_path):
    """JSON allows half a surrogate pair."""
    source = tmp_path / "in.json"
    source.write_text(json.dumps([[{"id": "\ud800", "keypoints": persons[0].tolist()}]]))
    for kind in ("npz", "csv", "json"):
        assert lift(source, tmp_path / f"out.{kind}", model_file) == 0
    assert "0,\\ud800,nose," in (tmp_path / "out.csv").read_text()


def test_persons_of_one_frame_in_csv(persons, model_file, tmp_path):
    """Rows of a frame may come in any order."""
    rows = [f"5,{name},{k},{x},{y}" for name in "ab" for k, (x, y) in zip(COCO, persons["ab".index(name) * 2])]
    (tmp_path / "in.csv").write_text("\n".join(["Frame, person, keypoint, x, y", *rows[::2], *rows[1::2]]))
    assert lift(tmp_path / "in.csv", tmp_path / "out.npz", model_file, "--intrinsics", *CAMERA) == 0
    lifted = read(tmp_path / "out.npz")
    assert lifted["person"].tolist() == ["a", "b"] and lifted["frame"].tolist() == [5, 5]
    np.testing.assert_allclose(lifted["root"][:, 2], [4, 6], rtol=0.05)


def test_numbered_keypoints_in_csv(persons, model_file, tmp_path, capsys):
    (tmp_path / "in.csv").write_text(table(persons, range(17)))
    assert lift(tmp_path / "in.csv", tmp_path / "a.npz", model_file) == 1
    assert "its keypoints are numbered: name their layout with --layout" in capsys.readouterr().err
    assert lift(tmp_path / "in.csv", tmp_path / "a.npz", model_file, "--layout", "coco17") == 0
    npz(tmp_path / "in.npz", keypoints=persons)
    assert lift(tmp_path / "in.npz", tmp_path / "b.npz", model_file) == 0
    np.testing.assert_array_equal(read(tmp_path / "a.npz")["points"], read(tmp_path / "b.npz")["points"])


def test_output_layout_and_person_height(persons, tmp_path):
    source, options = npz(tmp_path / "in.npz", keypoints=persons), ("--intrinsics", *CAMERA)
    assert lift(source, tmp_path / "a.npz", "human", *options) == 0
    assert lift(source, tmp_path / "b.npz", "human", *options, "--output-layout", "model") == 0
    assert lift(source, tmp_path / "c.npz", "human", *options, "--person-height", "0.9") == 0
    a, b, c = (read(tmp_path / f"{name}.npz") for name in "abc")
    names = b["keypoints"].tolist()
    assert str(b["layout"]) == "human" and len(names) == 43
    np.testing.assert_array_equal(b["points"][:, [names.index(name) for name in COCO]], a["points"])
    assert (c["root"][:, 2] < 0.6 * a["root"][:, 2]).all()


def test_batches_make_no_difference(persons, model_file, tmp_path, monkeypatch):
    (tmp_path / "in.csv").write_text(table(persons))
    (tmp_path / "in.json").write_text(frames(persons))
    npz(tmp_path / "in.npz", keypoints=persons)
    results = []
    for size in (4096, 2):
        monkeypatch.setattr(keypoint_files, "BATCH", size)
        for source in ("in.csv", "in.json", "in.npz"):
            for kind in ("npz", "csv"):
                out = tmp_path / f"{source}.{size}.{kind}"
                assert lift(tmp_path / source, out, model_file, "--intrinsics", *CAMERA) == 0
                results.append(read(out)["points"])
    for other in results[1:]:
        np.testing.assert_allclose(other, results[0], rtol=0, atol=1e-6)


def test_a_csv_is_read_while_it_is_lifted(persons, monkeypatch):
    """So that a long one needs little memory."""
    monkeypatch.setattr(keypoint_files, "BATCH", 2)
    file = io.BytesIO(table(np.tile(persons, (400, 1, 1))).encode())
    coco = load_layout("coco17")
    batches = keypoint_files.open_keypoints(file, "x", "csv", coco, coco).batches
    assert len(next(batches).xy) == 2 and file.tell() < len(file.getvalue()) / 4


def test_another_order_of_the_keypoints_is_noted(persons, tmp_path, capsys):
    order = np.random.default_rng(0).permutation(17)
    swapped = npz(tmp_path / "in.npz", keypoints=persons[:, order])
    assert lift(swapped, tmp_path / "out.npz", "human", "--intrinsics", *CAMERA) == 0
    assert "no shape of the model fits" in capsys.readouterr().out


# --- cameras


@pytest.mark.parametrize(
    "name, text",
    [
        ("camera.yaml", CALIBRATION),
        ("camera.json", json.dumps({"K": [[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]]})),
        ("camera.json", json.dumps({"k": [FOCAL, 0, CENTRE[0], 0, FOCAL, CENTRE[1], 0, 0, 1], "width": 640})),
    ],
    ids=["camera_calibration", "K", "CameraInfo"],
)
def test_a_camera_file_is_the_four_numbers(name, text, persons, model_file, tmp_path):
    (tmp_path / name).write_text(text)
    source = npz(tmp_path / "in.npz", keypoints=persons)
    assert lift(source, tmp_path / "a.npz", model_file, "--camera", tmp_path / name) == 0
    assert lift(source, tmp_path / "b.npz", model_file, "--intrinsics", *CAMERA) == 0
    np.testing.assert_array_equal(read(tmp_path / "a.npz")["points"], read(tmp_path / "b.npz")["points"])


def test_the_image_of_the_keypoints_is_stated(persons, model_file, tmp_path, capsys):
    """A calibration has two images; the distortion is corrected in the raw one only."""
    source, results = npz(tmp_path / "in.npz", keypoints=persons), {}
    calibration = tmp_path / "c.yaml"
    K = f"[{FOCAL}, 0.0, {CENTRE[0]}, 0.0, {FOCAL}, {CENTRE[1]}, 0.0, 0.0, 1.0]"
    text = CALIBRATION.replace("[1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0]", K).replace("[0.1,", "[-0.2,")
    old_p, new_p = f"data: [{FOCAL}, 0.0, {CENTRE[0]}, 0.0, 0.0", "data: [500, 0.0, 320, 0.0, 0.0"
    calibration.write_text(text.replace(old_p, new_p))
    for image in ("auto", "rectified", "raw"):
        output = tmp_path / f"{image}.npz"
        assert lift(source, output, model_file, "--camera", calibration, "--image", image) == 0
        assert ("Set --image to raw" in capsys.readouterr().out) == (image == "auto")
        results[image] = read(output)["points"]
    np.testing.assert_array_equal(results["auto"], results["rectified"])
    camera = read_camera_info(info(d=[-0.2, 0, 0, 0, 0]))
    truth = Lifter(model_file).lift(persons[..., :2], camera=camera, layout="coco17")
    np.testing.assert_allclose(results["raw"], truth.points, atol=1e-5)
    assert np.abs(results["raw"] - results["rectified"]).max() > 0.02


@pytest.mark.parametrize("camera", [[], ["--intrinsics", "500", "500", "320", "240"]])
def test_a_raw_image_without_a_distortion_is_wrong_usage(persons, model_file, tmp_path, capsys, camera):
    source = npz(tmp_path / "in.npz", keypoints=persons)
    with pytest.raises(SystemExit, match="2"):
        lift(source, tmp_path / "out.npz", model_file, *camera, "--image", "raw")
    assert "--image raw needs --camera" in capsys.readouterr().err


def test_keypoints_outside_the_image_of_the_camera_file_are_noted(persons, model_file, tmp_path, capsys):
    camera = {"K": [FOCAL, 0, CENTRE[0], 0, FOCAL, CENTRE[1], 0, 0, 1], "width": 640, "height": 480}
    (tmp_path / "c.json").write_text(json.dumps(camera))
    for factor in (1, 3):
        source = npz(tmp_path / "in.npz", keypoints=factor * persons[..., :2])
        assert lift(source, tmp_path / f"{factor}.npz", model_file, "--camera", tmp_path / "c.json") == 0
        assert ("CameraInfo states an image of 640x480" in capsys.readouterr().out) == (factor == 3)


@pytest.mark.parametrize(
    "text, size",
    [
        ('"width": 640, "height": 480, "binning_x": 2, "binning_y": 2', (320, 240)),
        (
            '"width": 640, "height": 480, "roi": {"x_offset": 40, "width": 300, "height": 200}',
            (300, 200),
        ),
    ],
)
def test_a_camera_file_has_the_part_of_the_image(text, size, tmp_path):
    (tmp_path / "c.json").write_text(f'{{"K": [600, 0, 320, 0, 600, 240, 0, 0, 1], {text}}}')
    camera = read_camera(tmp_path / "c.json")
    assert (camera.width, camera.height) == size and (camera.fx, camera.cx) in ((300, 160), (600, 280))


@pytest.mark.parametrize(
    "text, clue",
    [
        (None, "no such file"),
        ("", "has no keys"),
        ("- 1", "has no keys"),
        ("a: [", "neither YAML nor JSON"),
        ("name: x", "has neither K (camera_matrix) nor P"),
        ("K: [1, 2, 3]", "camera_matrix has 3 numbers, it must have 9"),
        ("K: 900", "not a list of numbers"),
        (f"K: [{10**400}]", "not a list of numbers"),
        ("date: 2020-99-99", "neither YAML nor JSON"),
        ("K: {rows: 3}", "not a list of numbers"),
        ("K: [.nan, 0, 1, 0, 1, 1, 0, 0, 1]", "not finite"),
        ("K: [1, 0, 0.5, 0, 1, 0.5, 0, 0, 1]", "calibrate the camera"),
        ("K: [900, 0, 640, 0, 900, 360, 0, 0, 1]\nwidth: wide", "not a number of pixels"),
        ("K: [900, 0, 640, 0, 900, 360, 0, 0, 1]\nroi: all", "roi has no keys"),
        ("K: [900, 0, 640, 0, 900, 360, 0, 0, 1]\nbinning_x: 100", "binning is 100 x 1"),
    ],
)
def test_a_camera_that_is_none(text, clue, persons, model_file, tmp_path, capsys):
    if text is not None:
        (tmp_path / "c.yaml").write_text(text)
    source = npz(tmp_path / "in.npz", keypoints=persons)
    assert lift(source, tmp_path / "out.npz", model_file, "--camera", tmp_path / "c.yaml") == 1
    error = capsys.readouterr().err
    assert clue in error and "c.yaml" in error and error.count("\n") == 1 and not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize("numbers", [("0", "0", "0", "0"), ("nan", "900", "0", "0"), ("1", "1", "0.5", "0.5")])
def test_intrinsics_of_no_camera(numbers, persons, model_file, tmp_path, capsys):
    source = npz(tmp_path / "in.npz", keypoints=persons)
    assert lift(source, tmp_path / "out.npz", model_file, "--intrinsics", *numbers) == 1
    error = capsys.readouterr().err
    assert error.startswith("paul: --intrinsics: ") and "CameraInfo" not in error and "; give a " in error


# --- files


@pytest.mark.parametrize("kind", ["npz", "csv", "json"])
def test_standard_input_to_standard_output(kind, persons, model_file, tmp_path):
    """Nothing but the data on standard output; the line for the user is on standard error."""
    source = tmp_path / f"in.{kind}"
    if kind == "npz":
        npz(source, keypoints=persons)
    else:
        source.write_text(table(persons) if kind == "csv" else frames(persons))
    words = ["lift", "-", "-o", "-", "--format", kind, "--model", str(model_file), "--intrinsics", *CAMERA]
    command = [sys.executable, "-m", "paul_ros.cli", *words]
    done = subprocess.run(command, cwd=ROOT, input=source.read_bytes(), capture_output=True)
    assert done.returncode == 0 and b"standard output: 5 of 5 persons lifted" in done.stderr
    assert lift(source, tmp_path / f"out.{kind}", model_file, "--intrinsics", *CAMERA) == 0
    (tmp_path / f"printed.{kind}").write_bytes(done.stdout)
    printed, written = read(tmp_path / f"printed.{kind}"), read(tmp_path / f"out.{kind}")
    assert printed.keys() == written.keys()
    for name in written:
        np.testing.assert_array_equal(printed[name], written[name])


CSV = "frame,keypoint,x,y\n"
BAD = [
    ("csv", "", "lacks frame, keypoint, x, y in its columns (none): they must be frame,keypoint,x,y"),
    ("csv", CSV, "holds no keypoints: write rows of frame,keypoint,x,y"),
    ("csv", "frame,joint,x,y\n", "lacks keypoint in its columns (frame,joint,x,y)"),
    ("csv", "frame,keypoint,x,y,X\n", "has the column x twice: keep one of them"),
    ("csv", CSV + "0,nose,1\n", "line 2 has 3 cells; it must have 4"),
    ("csv", CSV + "0,nose,1,2\n1,nose,left,2\n", "line 3: x is 'left'; it must be a number, or empty"),
    ("csv", CSV + "0.5,nose,1,2\n", "line 2: frame is '0.5'; it must be a whole number"),
    ("csv", CSV + f"{10**30},nose,1,2\n", "it must be a whole number"),
    ("csv", CSV + "1,nose,1,2\n0,nose,1,2\n", "line 3: frame 0 follows frame 1; sort the rows by frame"),
    ("csv", CSV + "0,nose,1,2\n0,nose,1,2\n", "line 3: frame 0 has keypoint 'nose' of person '0' twice"),
    ("csv", CSV + "0,elbow,1,2\n", "no shipped layout has all of elbow: name one with --layout"),
    ("csv", CSV + "0,nose,1,2\n1,left_big_toe,1,2\n", "layout 'coco17' has no keypoint 'left_big_toe'"),
    ("csv", b"\xff\xfe\x00\x01", "is not CSV in UTF-8"),
    ("csv", CSV + '0,"nose,1,2\n', "is not CSV in UTF-8"),
    ("json", "", "is not JSON"),
    ("json", "[" * 100_000, "is not JSON"),
    ("json", "{}", "must be a list of frames, each a list of persons, each a list of keypoints"),
    ("json", "[1]", "must be a list of frames"),
    ("json", "[]", "holds no persons"),
    ("json", "[[], []]", "holds no persons"),
    ("json", "[[[[1, 2], [1]]]]", "frame 0, person 0: keypoints must be [x, y], [x, y, confidence], or null if hidden"),
    ("json", '[[{"points": []}]]', "frame 0, person 0: keypoints must be"),
    ("json", '[[[["1", "2"]]]]', "frame 0, person 0: keypoints must be"),
    ("json", f"[[[[{10**400}, 1]]]]", "frame 0, person 0: keypoints must be"),
    ("json", "[[[[1, 2], [1, 2]]]]", "no shipped layout of 2 keypoints fits"),
    (
        "json",
        json.dumps([[[[1, 2]] * 17], [[[1, 2]] * 16]]),
        "frame 1, person 0: 16 keypoints, but layout 'coco17' has",
    ),
    ("npz", "", "pickled objects or is no npz"),
    ("npz", {"points": np.ones((1, 17, 2))}, "has neither keypoints (N,P,2) nor W (F,2,P)"),
    ("npz", {"keypoints": np.ones((17, 2))}, "keypoints is (17, 2); it must be (N,P,2)"),
    ("npz", {"keypoints": np.ones((1, 17, 4))}, "keypoints is (1, 17, 4)"),
    ("npz", {"W": np.ones((1, 17, 2))}, "W is (1, 17, 2); it must be (F,2,P)"),
    ("npz", {"keypoints": np.ones((0, 17, 2))}, "holds no persons"),
    ("npz", {"keypoints": np.ones((1, 29, 2))}, "no shipped layout of 29 keypoints fits"),
    ("npz", {"keypoints": np.ones((1, 17, 2), complex)}, "keypoints has type complex128; it must be number"),
    ("npz", {"keypoints": np.full((1, 17, 2), "a")}, "keypoints has type <U1; it must be number"),
    ("npz", {"keypoints": np.full((1, 17, 2), None)}, "pickled objects"),
    ("npz", {"keypoints": np.ones((2, 17, 2)), "visible": np.ones(17)}, "visible is (17,); it must be (2, 17)"),
    (
        "npz",
        {"keypoints": np.ones((1, 17, 2)), "visible": np.full((1, 17), np.nan)},
        "visible has values other than 0 and 1; save confidences as confidence",
    ),
    ("npz", {"keypoints": np.ones((2, 17, 2)), "frame": np.ones(2)}, "frame has type float64; it must be integer"),
]


@pytest.mark.parametrize("kind, content, clue", BAD)
def test_a_bad_file_is_one_line(kind, content, clue, model_file, tmp_path, capsys):
    """And it leaves an older output as it was."""
    source, out = tmp_path / f"in.{kind}", tmp_path / "out.csv"
    if isinstance(content, dict):
        np.savez(source, **content)
    else:
        source.write_bytes(content if isinstance(content, bytes) else content.encode())
    out.write_text("older")
    assert lift(source, out, model_file) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"paul: {source}: ") and clue in error and error.count("\n") == 1
    assert out.read_text() == "older" and sorted(tmp_path.iterdir()) == [source, out]


@pytest.mark.parametrize(
    "options, clue",
    [
        (["--layout", "h36m17"], ""),
        (["--layout", "body25"], "17 keypoints, but layout 'body25' has 25; name the right one with --layout"),
        (["--layout", "coco71"], "did you mean 'coco17'?"),
        (["--output-layout", "body25"], "has no left_big_toe"),
        (["--person-height", "9"], "--person-height is 9.0"),
        (["--model", "nobody"], "no model 'nobody'"),
    ],
)
def test_options_that_cannot_be_used(options, clue, persons, model_file, tmp_path, capsys):
    source = npz(tmp_path / "in.npz", keypoints=persons)
    words = ["lift", str(source), "-o", str(tmp_path / "out.npz")]
    words += options if "--model" in options else [*options, "--model", str(model_file)]
    assert cli.main(words) == (1 if clue else 0)
    assert clue in capsys.readouterr().err and (tmp_path / "out.npz").exists() != bool(clue)


def test_nobody_lifted_is_no_success(model_file, tmp_path, capsys):
    source = npz(tmp_path / "in.npz", keypoints=np.full((3, 17, 2), np.nan))
    assert lift(source, tmp_path / "out.json", model_file) == 1
    assert f"{source}: nobody could be lifted (3 too_few_points): check --layout" in capsys.readouterr().err
    assert [person["points"] for person in json.loads((tmp_path / "out.json").read_text())["persons"]] == [None] * 3


def test_a_full_disk_is_one_line(persons, model_file, tmp_path):
    """Here the largest file that the process may write."""
    source = npz(tmp_path / "in.npz", keypoints=np.tile(persons, (200, 1, 1)))
    words = ["lift", source, "-o", tmp_path / "out.csv", "--model", model_file]
    done = subprocess.run(
        [sys.executable, "-m", "paul_ros.cli", *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000)),
    )
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "File too large" in done.stderr and str(tmp_path / "out.csv") in done.stderr
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize("source", ["nowhere.npz", "nowhere.csv"])
def test_a_missing_file_is_one_line(source, model_file, tmp_path, capsys):
    assert lift(tmp_path / source, tmp_path / "out.npz", model_file) == 1
    error = capsys.readouterr().err
    assert source in error and f"{source}: no such file" in error and error.count("\n") == 1


def test_the_input_is_never_overwritten(persons, model_file, tmp_path, capsys):
    source = npz(tmp_path / "in.npz", keypoints=persons)
    before = source.read_bytes()
    assert lift(source, source, model_file) == 1
    assert "name another output" in capsys.readouterr().err and source.read_bytes() == before


@pytest.mark.parametrize(
    "words, clue",
    [
        (["in.txt", "-o", "out.npz"], "IN is 'in.txt': it must end in .npz, .csv or .json"),
        (["in.npz", "-o", "out.mcap"], "OUT is 'out.mcap'"),
        (["-", "-o", "out.npz"], "IN is -: choose its format with --format"),
        (["in.npz", "-o", "-"], "OUT is -: choose its format"),
        (["in.npz"], "-o/--output"),
        (["in.npz", "-o", "o.npz", "--camera", "c.yaml", "--intrinsics", "1", "1", "1", "1"], "not allowed with"),
        (["in.npz", "-o", "o.npz", "--intrinsics", "1", "2"], "expected 4 arguments"),
        (["in.npz", "-o", "o.npz", "--min-confidence", "2"], "'2' is not a confidence from 0 to 1"),
    ],
)
def test_wrong_usage(words, clue, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["lift", *words])
    assert end.value.code == 2 and clue in capsys.readouterr().err


def test_numpy_is_all_that_it_needs(persons, model_file, tmp_path):
    """On a robot without the extras: no torch, no bag reader, no ROS."""
    source = npz(tmp_path / "in.npz", keypoints=persons)
    code = (
        "import sys\nfrom paul_ros import cli\nassert cli.main(sys.argv[1:]) == 0\n"
        "assert not {'torch', 'training', 'mcap', 'rosbags', 'rclpy', 'tqdm', 'matplotlib'} & set(sys.modules)"
    )
    words = ["lift", str(source), "-o", str(tmp_path / "out.npz"), "--model", str(model_file)]
    subprocess.run([sys.executable, "-c", code, *words], cwd=ROOT, check=True, capture_output=True)


# --- numbers that mean something else


def test_placeholders_in_files_are_missing(tmp_path, capsys):
    xy = np.random.default_rng(0).uniform(100, 400, (5, 17, 2))
    marked, hidden = xy.copy(), xy.copy()
    marked[1, 3], hidden[1, 3] = 0, np.nan
    marked[2, 4], hidden[2, 4] = -1, np.nan
    for kind, write in (("npz", None), ("csv", table), ("json", frames)):
        results = []
        for name, points in (("marked", marked), ("hidden", hidden)):
            source, out = tmp_path / f"{name}.{kind}", tmp_path / f"{name}.out.npz"
            source.write_text(write(points)) if write else npz(source, keypoints=points)
            assert lift(source, out, "human") == 0
            results.append(read(out)["points"])
            printed = capsys.readouterr().out
            assert ("taken as missing (2 points)" in printed) == (name == "marked")
        np.testing.assert_array_equal(*results)


def test_normalised_keypoints_and_odd_confidences_are_said(tmp_path, capsys):
    xy = np.random.default_rng(0).uniform(0, 1, (5, 17, 2))
    source = npz(tmp_path / "n.npz", keypoints=xy, confidence=np.full((5, 17), 87.0))
    assert lift(source, tmp_path / "o.npz", "human") == 0
    printed = capsys.readouterr().out
    assert "normalised to 0..1" in printed and "divide percentages by 100" in printed
    assert lift(source, tmp_path / "o.npz", "human", "--intrinsics", 600, 600, 320, 240) == 1
    assert "degenerate_points" in (refusal := capsys.readouterr().err) and "image's width" in refusal


@pytest.mark.parametrize("name", ["score", "visibility", "conf", "keypoint_scores"])
@pytest.mark.parametrize("kind", ["npz", "csv", "json"])
def test_confidences_by_another_name_are_used(kind, name, persons, tmp_path, capsys):
    """Half of each person is below the threshold."""
    scores = np.where(np.arange(17) < 8, 0.05, 0.9) * np.ones((len(persons), 1))
    points = np.nan_to_num(persons, nan=300.0)
    results = []
    for key in ("confidence", name):
        source, out = tmp_path / f"{key}.{kind}", tmp_path / f"{key}.out.npz"
        if kind == "npz":
            npz(source, keypoints=points, **{key: scores})
        elif kind == "csv":
            rows = zip(np.ndindex(scores.shape), points.reshape(-1, 2), scores.ravel())
            lines = [f"{frame},{COCO[point]},{x},{y},{score}" for (frame, point), (x, y), score in rows]
            source.write_text("\n".join([f"frame,keypoint,x,y,{key}", *lines]))
        else:
            source.write_text(
                json.dumps([[{"keypoints": p.tolist(), key: s.tolist()}] for p, s in zip(points, scores)])
            )
        assert lift(source, out, "human") == 0
        results.append(read(out)["points"])
        assert "not used" not in capsys.readouterr().out
    np.testing.assert_array_equal(*results)
    npz(tmp_path / "without.npz", keypoints=points)
    assert lift(tmp_path / "without.npz", tmp_path / "without.out.npz", "human") == 0
    assert not np.array_equal(read(tmp_path / "without.out.npz")["points"], results[0])


def test_confidences_that_are_not_used_are_named(persons, tmp_path, capsys):
    points, scores = np.nan_to_num(persons, nan=300.0), np.ones((len(persons), 17))
    person = {"keypoints": np.column_stack([points[0], scores[0]]).tolist(), "scores": scores[0].tolist(), "score": 0.9}
    npz(tmp_path / "two.npz", keypoints=points, confidence=scores, score=scores)
    npz(tmp_path / "beside.npz", keypoints=np.dstack([points, scores]), scores=scores)
    npz(tmp_path / "person.npz", keypoints=points, score=scores[:, 0])
    (tmp_path / "beside.json").write_text(json.dumps([[person]]))
    unused = {"two.npz": "score", "beside.npz": "scores", "person.npz": "score", "beside.json": "scores"}
    for name, left_out in unused.items():
        assert lift(tmp_path / name, tmp_path / "out.npz", "human") == 0
        assert f"note: {left_out} not used; keep one" in capsys.readouterr().out, name


def test_confidences_of_another_number_are_refused(persons, tmp_path, capsys):
    person = {"keypoints": np.nan_to_num(persons[0]).tolist(), "keypoint_scores": [0.5, 0.6]}
    (tmp_path / "in.json").write_text(json.dumps([[person]]))
    assert lift(tmp_path / "in.json", tmp_path / "out.npz", "human") == 1
    assert "frame 0, person 0: keypoint_scores has 2 numbers for 17 keypoints" in capsys.readouterr().err


def test_an_error_names_the_column_of_the_confidences(tmp_path, capsys):
    (tmp_path / "in.csv").write_text("frame,keypoint,x,y,score\n0,nose,320,100,high\n")
    assert lift(tmp_path / "in.csv", tmp_path / "out.npz", "human") == 1
    assert "line 2: score is 'high'" in capsys.readouterr().err
