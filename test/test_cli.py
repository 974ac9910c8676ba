# SPDX-License-Identifier: Apache-2.0
"""`paul`: exit codes, one clear line for an error, help everywhere."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import header_of, persons_at, seen

from msg_adapters.outputs import keypoints_cloud
from paul_ros import __version__, cli
from paul_ros.offline.bag_writer import BagWriter

ROOT = Path(__file__).resolve().parent.parent
ONE = ROOT / "bags" / "one_person.mcap"


@pytest.fixture(autouse=True)
def same_environment(monkeypatch):
    """The command sets thread counts for its own process."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(variable, os.environ.get(variable, "1"))


def paul(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "paul_ros.cli", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["replay", "--help"],
        ["inspect", "--help"],
        ["demo", "--help"],
        ["train", "--help"],
        ["benchmark", "--help"],
    ],
)
def test_help(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith("usage: paul")


def test_version(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["--version"])
    assert end.value.code == 0 and capsys.readouterr().out == f"paul_ros {__version__}\n"


@pytest.mark.parametrize("option, name", [("-o", "one.mcap"), ("--json", "one.mcap"), ("--plot", "metadata.yaml")])
@pytest.mark.parametrize("folder", [False, True])
def test_the_bag_that_is_read_is_never_overwritten(tmp_path, capsys, option, name, folder):
    bag = tmp_path / "bag"
    bag.mkdir()
    for file in ("one.mcap", "metadata.yaml"):
        (bag / file).write_bytes(b"recorded")
    assert cli.main(["replay", str(bag if folder else bag / name), option, str(bag / name)]) == 1
    assert "name another output" in capsys.readouterr().err
    assert (bag / name).read_bytes() == b"recorded"


@pytest.mark.parametrize("option", ["-o", "--json", "--plot"])
@pytest.mark.parametrize("output, clue", [("", "it is a folder"), ("file/x", "cannot write")])
def test_an_output_that_cannot_be_written_is_told_first(tmp_path, capsys, monkeypatch, option, output, clue):
    (tmp_path / "file").touch()
    monkeypatch.setattr("paul_ros.offline.replay.replay", lambda *_: pytest.fail("lifted in vain"))
    assert cli.main(["replay", str(ONE), option, str(tmp_path / output)]) == 1
    printed = capsys.readouterr()
    assert clue in printed.err and printed.err.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def paul_to_nobody(*arguments, unbuffered=""):
    """As in `paul ... | head -0`."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as stdout:
        return subprocess.run(
            [sys.executable, "-m", "paul_ros.cli", *map(str, arguments)],
            cwd=ROOT,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
            stdout=stdout,
            stderr=subprocess.PIPE,
        )


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_files_are_written_where_nobody_reads_stdout(model_file, tmp_path, unbuffered):
    """Quietly; 141 is what a shell gives for a process that SIGPIPE ended."""
    files = tmp_path / "out.mcap", tmp_path / "p.png", tmp_path / "r.json"
    options = "-o", files[0], "--plot", files[1], "--json", files[2]
    done = paul_to_nobody("replay", ONE, "--model", model_file, *options, unbuffered=unbuffered)
    assert (done.returncode, done.stderr) == (141, b"")
    assert sorted(tmp_path.iterdir()) == list(files)
    done = paul_to_nobody("inspect", "coco17", "--json", tmp_path / "s.json", unbuffered=unbuffered)
    assert (done.returncode, done.stderr) == (141, b"") and (tmp_path / "s.json").exists()


def test_help_that_nobody_reads():
    done = paul_to_nobody("replay", "--help")
    assert (done.returncode, done.stderr) == (141, b"")


def test_no_stdout_at_all(tmp_path):
    """As in `paul inspect coco17 >&-`."""
    command = f"'{sys.executable}' -m paul_ros.cli inspect coco17 --json '{tmp_path / 'r.json'}' >&-"
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"") and (tmp_path / "r.json").exists()


@pytest.mark.parametrize("arguments", [[], ["dance"], ["replay"], ["replay", "a", "--speed", "2"]])
def test_wrong_usage(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 2 and "usage: paul" in capsys.readouterr().err


def test_replay(model_file, tmp_path):
    files = tmp_path / "out.mcap", tmp_path / "r.json", tmp_path / "p.png"
    done = paul("replay", ONE, "--model", model_file, "-o", files[0], "--json", files[1], "--plot", files[2])
    assert done.returncode == 0 and done.stderr == ""
    assert "585 frames, 585 persons, 585 lifted; dropped: nothing" in done.stdout
    assert all(file.stat().st_size for file in files)
    assert json.loads(files[1].read_text())["frames"] == 585


@pytest.mark.parametrize(
    "layout, shown, clue",
    [
        ("human", 17, "set the parameter `layout` to the one your detector uses: coco17, h36m17"),
        ("coco17", 3, "too few of its keypoints are visible"),
        ("coco17", 17, ""),
    ],
)
def test_nobody_lifted_is_no_success(layout, shown, clue, model_file, tmp_path, capsys, bag_make):
    """Whether messages could not be used or persons could not be lifted, and although there are frames of nobody."""
    with BagWriter(tmp_path / "x.mcap") as writer:
        for second, persons in enumerate((0, 1)):
            xy = seen(persons_at(*[(0, 0, 4)] * persons))
            xy[:, shown:] = np.nan
            message = keypoints_cloud(bag_make, header_of(bag_make, second), xy, np.ones(xy.shape[:2]), ["1"] * persons)
            writer.write("/keypoints", message, second * 10**9)
    words = ["replay", tmp_path / "x.mcap", "--layout", layout, "--json", tmp_path / "r.json"]
    assert cli.main([str(word) for word in words]) == (1 if clue else 0)
    error = capsys.readouterr().err
    assert clue in error and error.count("\n") == (1 if clue else 0)
    assert json.loads((tmp_path / "r.json").read_text())["lifted"] == (0 if clue else 1)


def test_half_a_bag(model_file, tmp_path):
    """All that could be read is lifted and reported, and yet it is no success."""
    half = tmp_path / "half.mcap"
    half.write_bytes(ONE.read_bytes()[:500_000])
    done = paul("replay", half, "--model", model_file, "-o", tmp_path / "out.mcap", "--json", tmp_path / "r.json")
    assert done.returncode == 1
    assert done.stderr.startswith(f"paul: {half}: damaged after ") and done.stderr.count("\n") == 1
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["frames"] > 150 and report["damage"] in done.stderr
    assert (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    "arguments, clue",
    [
        (["replay", "nowhere.mcap"], "nowhere.mcap: no such bag"),
        (["replay", ONE, "--model", "nobody"], "no model 'nobody'"),
        (["replay", ONE, "--person-height", "9"], "person_height is 9.0; it must be 0 or 0.3 to 3.0"),
        (["replay", ONE, "--person-height", "1e-9"], "person_height is 1e-09; it must be 0 or 0.3 to 3.0"),
        (["replay", ONE, "--smoothing", "nan"], "smoothing is nan"),
        (["replay", ONE, "--output-layout", "body25"], "has no left_big_toe"),
        (["replay", ONE, "--layout", "coco71"], "did you mean 'coco17'?"),
        (["replay", ONE, "--topic", "/skeletons"], "no messages on /skeletons; the bag holds /camera_info"),
        (["replay", ONE, "--topic", "/camera_info"], "/camera_info is a sensor_msgs/msg/CameraInfo, not readable"),
        (["replay", ONE, "-o", "/proc/nothing/out.mcap"], "cannot write"),
        (["inspect", "nobody"], "no model 'nobody'"),
        (["inspect", "nowhere.mcap"], "no such bag"),
        (["inspect", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_error_is_one_line(arguments, clue, model_file, capsys):
    arguments = [str(a) for a in arguments]
    if arguments[0] == "replay" and "--model" not in arguments:
        arguments += ["--model", str(model_file)]
    assert cli.main(arguments) == 1
    printed = capsys.readouterr()
    assert printed.err.startswith("paul: ") and printed.err.count("\n") == 1 and clue in printed.err


def test_fault_of_the_program_is_not_hidden(monkeypatch):
    monkeypatch.setattr(cli, "_inspect", lambda args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli.main(["inspect", "coco17"])


@pytest.mark.parametrize(
    "thing, expected",
    [
        ("coco17", {"kind": "layout", "points": 17}),
        (ONE, {"kind": "bag", "messages": 1755, "damage": None}),
        ("MODEL", {"kind": "model", "name": "stand", "layout": "coco17", "bottleneck": 2}),
    ],
)
def test_inspect(thing, expected, model_file, tmp_path, capsys):
    thing = str(model_file if thing == "MODEL" else thing)
    assert cli.main(["inspect", thing, "--json", str(tmp_path / "r.json")]) == 0
    summary = json.loads((tmp_path / "r.json").read_text())
    assert expected.items() <= summary.items()
    assert expected["kind"] in capsys.readouterr().out
    if expected["kind"] == "bag":
        assert summary["topics"]["/keypoints"] == {
            "type": "sensor_msgs/msg/PointCloud2",
            "messages": 585,
            "rate_hz": pytest.approx(30, abs=0.06),
        }


def test_inspect_what_is_a_model_and_a_layout(tmp_path, capsys):
    """The model is what is meant; the layout is told too."""
    assert cli.main(["inspect", "human", "--json", str(tmp_path / "r.json")]) == 0
    summary = json.loads((tmp_path / "r.json").read_text())
    assert summary["kind"] == "model" and summary["sha256"] and summary["layout"] == "human"
    assert summary["layout_of_this_name"]["kind"] == "layout" and summary["layout_of_this_name"]["points"] == 43
    printed = capsys.readouterr().out
    assert printed.startswith("kind ") and "model" in printed.splitlines()[0] and "nose, left_eye" in printed


def test_inspect_a_damaged_bag(tmp_path, capsys):
    half = tmp_path / "half.mcap"
    half.write_bytes(ONE.read_bytes()[:500_000])
    assert cli.main(["inspect", str(half)]) == 1
    printed = capsys.readouterr()
    assert "/keypoints" in printed.out and "damaged after" in printed.err


def test_training_is_imported_only_to_train():
    """torch takes seconds and 200 MB."""
    code = (
        'import sys, runpy; sys.argv = ["paul", "inspect", "coco17"]\n'
        'try: runpy.run_module("paul_ros.cli", run_name="__main__")\n'
        "except SystemExit as end: assert not end.code\n"
        'loaded = {"torch", "training", "matplotlib", "rclpy"} & set(sys.modules)\n'
        "assert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)


@pytest.mark.parametrize(
    "words",
    [
        ["inspect", "{bag}", "--json", "{bag}"],
        ["inspect", "{model}", "--json", "{model}"],
        ["replay", "{bag}", "--model", "{model}", "--json", "{model}"],
        ["replay", "{bag}", "-o", "{out}", "--json", "{out}"],
    ],
)
def test_no_output_overwrites_an_input_or_another_output(words, model_file, tmp_path, capsys):
    places = {"bag": tmp_path / "a.mcap", "model": tmp_path / "m.npz", "out": tmp_path / "o"}
    places["bag"].write_bytes(ONE.read_bytes())
    places["model"].write_bytes(model_file.read_bytes())
    assert cli.main([word.format(**places) for word in words]) == 1
    assert "another" in capsys.readouterr().err
    assert places["bag"].read_bytes() == ONE.read_bytes() and places["model"].read_bytes() == model_file.read_bytes()
    assert not places["out"].exists()
