# SPDX-License-Identifier: Apache-2.0
"""Outputs of commands: a failed command leaves nothing behind, and standard output may be anything."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from paul_ros import cli
from paul_ros.files import is_stream
from paul_ros.offline.bag_reader import read_records
from paul_ros.offline.bag_writer import BagWriter

ONE = ROOT / "bags/one_person.mcap"


def shell(line: str, **environment: str) -> subprocess.CompletedProcess:
    """Run a shell line, in which $PAUL is the command."""
    start = f'PAUL="{sys.executable} -m paul_ros.cli"; {line}'
    return subprocess.run(
        ["bash", "-c", start], cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, timeout=120
    )


@pytest.fixture(autouse=True)
def same_environment(monkeypatch):
    """The command sets thread counts for its own process."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(variable, os.environ.get(variable, "1"))


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> Path:
    """The first second of a bag."""
    path = tmp_path_factory.mktemp("bag") / "short.mcap"
    with BagWriter(path) as bag:
        for record in itertools.islice(read_records(ONE), 100):
            bag.write_record(record)
    return path


TYPO = "bags/x.mcap"
FAILING = [
    f"train {TYPO} -o NEW/m.npz",
    "train x.npz --shapes NEW/s.npz --json NEW/j.json",
    "train NOTHING -o NEW/m.npz",
    "train bags -o NEW/m.npz --layout nothing",
    "train bags/one_person.mcap -o NEW/m.npz --layout hand21x",
    "train bags/one_person.mcap -o NEW/m.npz --topic /nothing",
    "train bags/one_person.mcap -o NEW/m.npz --recipe nothing",
    "train bags/one_person.mcap -o NEW/m.npz --json NEW/m.npz/j.json",
    f"replay {TYPO} -o NEW/o.mcap --json NEW/j.json --plot NEW/p.png",
    "replay bags/one_person.mcap -o NEW/o.mcap --topic /nothing",
    "replay bags/one_person.mcap -o NEW/o.mcap --layout nothing",
    "replay bags/one_person.mcap -o NEW/o.txt",
    f"view {TYPO} -o NEW/f.gif",
    "view bags/one_person.mcap -o NEW/f.gif --start 1000",
    "view nothing.npz -o NEW/f.gif",
    "view human -o NEW/f.txt",
    "lift x.csv -o NEW/l.csv",
    "lift README.md -o NEW/l.csv --format csv",
    f"inspect {TYPO} --json NEW/j.json",
    "inspect nothing --json NEW/j.json",
    "evaluate human x.npz --json NEW/j.json --plot NEW/p.png",
    "evaluate x.npz --truth x.npz --json NEW/j.json",
    "study noise --data x.npz -o NEW",
    "study interpolation --model human --data x.npz -o NEW",
    "benchmark nrsfm --data NOTHING --work NEW --json NEW/j.json",
]


@pytest.mark.parametrize("line", FAILING)
def test_a_failed_command_leaves_nothing(line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    words = [word.replace("NEW", f"{tmp_path}/new/deep").replace("NOTHING", f"{tmp_path}/no") for word in line.split()]
    assert cli.main(words) == 1
    assert capsys.readouterr().err.startswith("paul: ") and list(tmp_path.iterdir()) == []


def test_arguments_of_training_are_refused_before_torch_is_imported(tmp_path):
    """The import takes seconds."""
    lines = [line for line in FAILING if line.startswith("train")]
    words = [line.replace("NEW", f"{tmp_path}/new").replace("NOTHING", f"{tmp_path}/no").split() for line in lines]
    code = "import sys; from paul_ros.cli import main; print([main(words) for words in {}], 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code.format(words)], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == f"{[1] * len(lines)} False", done.stderr


def test_a_device_stays_one(tmp_path, short):
    """As root, too."""
    assert is_stream(os.devnull)  # a fault must not cost root its device
    bag, report, plot = links = [tmp_path / name for name in ("o.mcap", "o.json", "o.png")]
    for link in links:
        link.symlink_to(os.devnull)
    assert cli.main([*("replay", str(short), "-o", str(bag)), *("--json", str(report), "--plot", str(plot))]) == 0
    assert {os.readlink(file) for file in tmp_path.iterdir()} == {os.devnull}
    assert len(list(tmp_path.iterdir())) == 3 and Path(os.devnull).is_char_device()


def test_a_bag_and_an_archive_through_a_pipe(tmp_path, short):
    np.savez(tmp_path / "in.npz", keypoints=np.random.default_rng(0).random((3, 17, 2)) * 100)
    for words, name in ((["replay", str(short)], "out.mcap"), (["lift", str(tmp_path / "in.npz")], "out.npz")):
        pipe, got = tmp_path / f"pipe_{name}", []
        os.mkfifo(pipe)
        reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()), daemon=True)
        reader.start()
        assert cli.main([*words, "-o", str(pipe)]) == 0
        reader.join(60)
        assert pipe.is_fifo() and got
        (tmp_path / name).write_bytes(got[0])
    assert cli.main(["replay", str(short), "-o", str(tmp_path / "file.mcap")]) == 0
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "file.mcap").read_bytes()
    assert np.load(tmp_path / "out.npz")["points"].shape == (3, 17, 3)


def test_dev_stdout_is_standard_output():
    done = shell("$PAUL inspect coco17 --json /dev/stdout")
    assert json.loads(done.stdout) == json.loads(shell("$PAUL inspect coco17 --json -").stdout)


@pytest.mark.parametrize(
    "line, code, said",
    [
        ("$PAUL inspect coco17 > /dev/full", 1, "paul: standard output: No space left on device"),
        ("$PAUL --help > /dev/full", 1, "paul: standard output: No space left on device"),
        ("$PAUL inspect coco17 --json /dev/full", 1, "paul: /dev/full: No space left on device"),
        ("$PAUL inspect coco17 --json - >&-", 1, "paul: standard output is closed: name a file"),
        ("$PAUL inspect coco17 >&-", 0, ""),
        ("$PAUL inspect x 2>&-", 1, ""),
    ],
)
def test_standard_output_that_takes_nothing(line, code, said):
    assert is_stream("/dev/full")
    done = shell(line)
    assert (done.returncode, done.stderr.strip()) == (code, said)


def test_a_pipe_whose_reader_leaves_is_named(tmp_path, short):
    done = shell(f"mkfifo {tmp_path}/p; (exec 3<{tmp_path}/p; exec 3<&-) & $PAUL replay {short} -o {tmp_path}/p")
    assert done.returncode == 1 and done.stderr.strip() == f"paul: cannot write {tmp_path}/p: Broken pipe"
    assert [file.name for file in tmp_path.iterdir()] == ["p"]


@pytest.mark.parametrize(
    "environment", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}]
)
def test_a_terminal_without_the_micro_sign(environment, short):
    done = shell(f"$PAUL replay {short}; $PAUL benchmark node --help", **environment)
    assert done.returncode == 0 and done.stderr == ""
    assert "\\xb5s per frame" in done.stdout and "times in \\xb5s" in done.stdout


def test_a_read_only_folder_is_refused_first(tmp_path, short):
    """/proc takes no files, not even from root."""
    done = shell(f"$PAUL replay {short} --json /proc/x.json -o {tmp_path}/o.mcap")
    assert done.returncode == 1 and done.stderr.startswith("paul: cannot write /proc/x.json: ")
    assert done.stderr.count("\n") == 1 and list(tmp_path.iterdir()) == []
