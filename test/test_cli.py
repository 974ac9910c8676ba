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
from paul_ros.cli.launcher import COMMANDS, build_parser
from paul_ros.cli.progress import progress
from paul_ros.cli.study import STUDIES
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
    "words",
    [
        [],
        *([name] for name in COMMANDS),
        *(["benchmark", subject] for subject in ("onp", "nrsfm", "node")),
        *(["study", name] for name in (*STUDIES, "interpolation")),
    ],
)
def test_help(words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as end:
        cli.main([*words, "--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: paul")
    assert [line for line in text.splitlines() if len(line) > 80] == []


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    text = capsys.readouterr().out
    assert [name for name in COMMANDS if f"\n    {name}" not in text] == []
    assert [line for line in COMMANDS.values() if line not in " ".join(text.split())] == []


def test_every_module_of_a_command_is_a_command():
    own = {"advice", "launcher", "options", "output", "parser", "progress"}
    files = {file.stem for file in (ROOT / "paul_ros" / "cli").glob("[a-z]*.py")} - own
    assert {name for name in files if not name.startswith("benchmark_")} == set(COMMANDS)


def test_one_parser_has_the_arguments_of_every_command():
    """For the documentation, which prints them."""
    (commands,) = [action.choices for action in build_parser()._actions if action.choices]
    assert list(commands) == list(COMMANDS)
    assert all(parser.description and len(parser._actions) > 1 for parser in commands.values())


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


@pytest.mark.parametrize("word, near", [("reply", "replay"), ("Lift", "lift"), ("benchmarks", "benchmark")])
def test_a_mistyped_command_is_answered_by_the_nearest(word, near, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main([word])
    assert end.value.code == 2 and f"no command '{word}', did you mean '{near}'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, usage, clue",
    [
        (["lift", "a.npz", "-o", "b.npz", "--layuot", "x"], "paul lift", "--layuot x, did you mean '--layout'?"),
        (["lift", "a.npz", "-o", "b.npz", "--layuot=x"], "paul lift", "--layuot=x, did you mean '--layout'?"),
        (["lift", "a.npz", "b.npz", "-o", "c.npz"], "paul lift", "unrecognized arguments: b.npz\n"),
        (["replay", ""], "paul replay", "an argument is empty, as from a variable that is not set"),
        (["replay", "x.mcap", "--json", ""], "paul replay", "an argument is empty"),
        (["benchmark", "onp", "--bacth", "3"], "paul benchmark onp", "did you mean '--batch'?"),
        (["study", "botleneck"], "paul study", "no study 'botleneck', did you mean 'bottleneck'?"),
        (["benchmark", "onpp"], "paul benchmark", "no subject 'onpp', did you mean 'onp'?"),
        (["study", "zzz"], "paul study", "no study 'zzz'. There are bottleneck"),
    ],
)
def test_a_mistyped_argument_is_answered_by_the_nearest(words, usage, clue, capsys):
    """With the usage of the command that was meant, not that of `paul`."""
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.startswith(f"usage: {usage} [") and clue in error


def test_a_refused_file_is_named_once_and_without_a_number(monkeypatch, capsys):
    def refuse(args):
        raise PermissionError(13, "Permission denied", "x.npz")

    monkeypatch.setattr("paul_ros.cli.inspect.run", refuse)
    assert cli.main(["inspect", "coco17"]) == 1 and capsys.readouterr().err == "paul: x.npz: Permission denied\n"


def test_replay(model_file, tmp_path):
    files = tmp_path / "out.mcap", tmp_path / "r.json", tmp_path / "p.png"
    done = paul("replay", ONE, "--model", model_file, "-o", files[0], "--json", files[1], "--plot", files[2])
    assert done.returncode == 0 and done.stderr == ""
    assert "585 frames, 585 persons, 585 lifted; dropped: nothing" in done.stdout
    assert all(file.stat().st_size for file in files)
    assert done.stdout.splitlines()[-1] == "written: {}, {}, {}".format(*files)
    assert json.loads(files[1].read_text())["frames"] == 585


@pytest.mark.parametrize(
    "layout, shown, clue",
    [
        ("human", 17, "Set --layout to the one your detector uses: coco17, h36m17, or the path of your own."),
        ("coco17", 3, "too few of its keypoints are visible"),
        ("coco17", 17, ""),
    ],
)
def test_nobody_lifted_is_no_success(layout, shown, clue, model_file, tmp_path, capsys, bag_make):
    """A bag of frames without persons, of unusable messages or of persons with too few keypoints is an error."""
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
    assert done.stderr.startswith(f"paul: {half}: damaged: ") and done.stderr.count("\n") == 1
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["frames"] > 150 and report["damage"] in done.stderr
    assert (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    "arguments, clue",
    [
        (["replay", "nowhere.mcap"], "nowhere.mcap: no such file or folder"),
        (["replay", ONE, "--model", "nobody"], "no model 'nobody'"),
        (["replay", ONE, "--person-height", "9"], "--person-height is 9.0; it must be 0 or 0.3 to 3.0"),
        (["replay", ONE, "--person-height", "1e-9"], "--person-height is 1e-09; it must be 0 or 0.3 to 3.0"),
        (["replay", ONE, "--smoothing", "nan"], "smoothing is nan"),
        (["replay", ONE, "--output-layout", "body25"], "--output-layout 'body25': the model's layout"),
        (["replay", ONE, "--layout", "coco71"], "did you mean 'coco17'?"),
        (["replay", ONE, "--topic", "/skeletons"], "no messages on /skeletons"),
        (
            ["replay", ONE, "--topic", "/camera_info"],
            "/camera_info has the type sensor_msgs/msg/CameraInfo, which is not readable",
        ),
        (["replay", ONE, "-o", "/proc/nothing/out.mcap"], "cannot write"),
        (["inspect", "zzz"], "no model or layout 'zzz'. Shipped models: human; shipped layouts: ap10k17"),
        (["inspect", "coc17"], "no model or layout 'coc17', did you mean layout 'coco17'?"),
        (["inspect", "hunam"], "did you mean model 'human'?"),
        (["inspect", "nowhere.npz"], "no model 'nowhere.npz'"),
        (["inspect", "nowhere.mcap"], "no such file or folder"),
        (
            ["replay", ONE, "-o", "x.bag"],
            "x.bag: the suffix is no format of this output; name a file that ends in .mcap",
        ),
        (["replay", "OUT/array.npz"], "`paul lift` reads arrays of keypoints"),
        (["replay", ONE, "-o", "-"], "this cannot go to standard output; name a file that ends in .mcap"),
        (["replay", ONE, "--plot", "x.txt"], "name a file that ends in .png or .svg or .pdf"),
        (["replay", ONE, "--plot", "-"], "this cannot go to standard output; name a file that ends in .png"),
        (["view", ONE, "-o", "-"], "-: a film is a file that ends in .gif"),
        (["demo", "--out", "/proc/nothing"], "cannot write /proc/nothing/report.json"),
        (["train", "nowhere", "-o", "OUT/m.npz", "--recipe", "defalt"], "no recipe 'defalt', did you mean 'default'?"),
        (["inspect", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_error_is_one_line(arguments, clue, model_file, tmp_path, capsys):
    arguments = [str(a).replace("OUT", str(tmp_path)) for a in arguments]
    (tmp_path / "array.npz").write_bytes(b"PK")
    if arguments[0] == "replay" and "--model" not in arguments:
        arguments += ["--model", str(model_file)]
    assert cli.main(arguments) == 1
    printed = capsys.readouterr()
    assert printed.err.startswith("paul: ") and printed.err.count("\n") == 1 and clue in printed.err


def test_fault_of_the_program_is_not_hidden(monkeypatch):
    monkeypatch.setattr("paul_ros.cli.inspect.run", lambda args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli.main(["inspect", "coco17"])


def test_an_import_of_the_program_that_fails_is_a_fault(monkeypatch):
    """Only MissingPackageError tells the user what to install."""
    monkeypatch.setitem(sys.modules, "paul_ros.offline.inspection", None)
    with pytest.raises(ImportError):
        cli.main(["inspect", "coco17"])


@pytest.mark.parametrize(
    "words, module, extra",
    [
        (["study", "noise", "--data", "x.npz", "-o", "OUT"], "torch", "train"),
        (["study", "noise", "--data", "x.npz", "-o", "OUT"], "matplotlib", "benchmark"),
        (["evaluate", "x.npz", "--truth", "y.npz"], "torch", "train"),
        (["evaluate", "human", "y.npz", "--plot", "OUT/p.png"], "matplotlib", "benchmark"),
        (["benchmark", "nrsfm", "--data", "OUT", "--work", "OUT"], "torch", "train"),
        (["benchmark", "node"], "rich", "benchmark"),
        (["evaluate", "human", "y.npz"], "rich", "train"),
        (["replay", "x.mcap"], "rich", "bags"),
        (["benchmark", "node", "--plot", "OUT/p.png"], "matplotlib", "benchmark"),
    ],
)
def test_a_missing_package_is_one_line(words, module, extra, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, module, None)
    assert cli.main([word.replace("OUT", str(tmp_path)) for word in words]) == 1
    error = capsys.readouterr().err
    assert f"'{module}' is missing: pip install '.[{extra}]' in a clone of paul_ros" in error and error.count("\n") == 1


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
    assert "/keypoints" in printed.out and "damaged:" not in printed.out
    assert "damaged:" in printed.err and printed.err.count("\n") == 1


@pytest.mark.parametrize("layout", ["coco17", "cmu31"])
def test_inspect_prints_no_python(layout, capsys):
    assert cli.main(["inspect", layout]) == 0
    printed = capsys.readouterr().out
    assert "handedness\n  1\n" in printed and not set("{}[]") & set(printed)


def test_json_on_standard_output_is_all_that_is_there(model_file):
    """So that `paul replay BAG --json - | python -m json.tool` works."""
    done = paul("replay", ONE, "--model", model_file, "--json", "-")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["lifted"] == 585


@pytest.mark.parametrize("thing", ["coco17", "human", ONE])
def test_json_on_standard_output_is_that_of_the_file(thing, tmp_path, capsys):
    assert cli.main(["inspect", str(thing), "--json", str(tmp_path / "s.json")]) == 0
    table = capsys.readouterr().out
    assert cli.main(["inspect", str(thing), "--json", "-"]) == 0
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "s.json").read_text() and printed != table


def test_json_on_standard_output_of_a_benchmark(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("paul_ros.benchmarks.onp.run", lambda *settings: {"rows": list(settings)})
    monkeypatch.setattr("paul_ros.benchmarks.onp_report.table", lambda report: pytest.fail("a table beside the JSON"))
    monkeypatch.chdir(tmp_path)
    assert cli.main(["benchmark", "onp", "--cases", "3", "--batch", "4", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == {"rows": [3, 4, 0]}
    assert list(tmp_path.iterdir()) == []  # no file named "-"


@pytest.mark.parametrize("watched", [False, True])
def test_a_bar_is_shown_only_where_a_terminal_watches(watched, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: watched, raising=False)
    with progress("replay", total=2) as count:
        count(2)
    assert ("replay" in capsys.readouterr().err) == watched


def test_without_tqdm_there_is_no_bar(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("paul_ros.cli.progress.find_spec", lambda name: None)
    with progress("replay") as count:
        count(1)
    assert capsys.readouterr().err == ""


def test_the_command_is_imported_without_numpy():
    """The launcher sets the threads before NumPy starts; and `paul --help` is fast."""
    code = (
        'import sys, paul_ros.cli.launcher as launcher\ntry: launcher.main(["--help"])\nexcept SystemExit: pass\n'
        'assert not {"numpy", "yaml", "tqdm", "rich"} & set(sys.modules)'
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)


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


def test_inspect_says_what_is_unknown_in_words():
    from paul_ros.offline.inspection import as_text

    shown = as_text({"topics": {"/a": {"rate_hz": None}}, "metres_per_unit": None, "derived": {}, "stature": None})
    assert [line.split(None, 1) for line in shown.splitlines()[2:]] == [
        ["rate_hz", "unknown: it needs messages of two times"],
        ["metres_per_unit", "unknown: points are in model units"],
        ["derived", "none"],
        ["stature", "none"],
    ]
