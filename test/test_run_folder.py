# SPDX-License-Identifier: Apache-2.0
"""One training at a time works in the folder of a run, and a stopped one says how to go on."""

from __future__ import annotations

import errno
import fcntl
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from tiny_data import FROM_RANDOM_WEIGHTS, sequence

from paul_ros.cli import main
from training.errors import TrainingError
from training.judge import experiments
from training.judge.experiments import Experiment, SeriesOptions, perform
from training.judge.truth import load_sequence
from training.run_folder import locked
from training.trainer import Trainer

HOLD = """
import sys
from pathlib import Path
from training.run_folder import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""
SMALL = [word for setting in ("width=8", "batch=8", "bottleneck=3", "steps=6") for word in ("--set", setting)]


@pytest.fixture
def data(tmp_path):
    path = tmp_path / "views.npz"
    given, camera, _ = sequence()
    np.savez(path, W=given.W, S=camera)
    return path


@pytest.fixture
def hold():
    """Start a process that holds a folder, as another training does."""
    held: list[subprocess.Popen] = []

    def start(folder: Path) -> subprocess.Popen:
        words = [sys.executable, "-c", HOLD, str(folder)]
        held.append(subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        assert held[-1].stdout.readline() == "held\n"
        return held[-1]

    yield start
    for process in held:
        process.kill()
        process.communicate()


def train(data: Path, out: Path, *words: str) -> int:
    return main(["train", str(data), "-o", str(out), "--quiet", *FROM_RANDOM_WEIGHTS, *SMALL, *words])


def test_a_second_training_is_refused_until_the_first_is_gone(tmp_path, data, hold, capfd):
    """Also if the first was killed, and even if the second would start over."""
    out = tmp_path / "new" / "m.npz"
    other = hold(out.with_suffix(".run"))
    for words in ((), ("--fresh",), ("--shapes", str(tmp_path / "s.npz"))):
        assert train(data, out, *words) == 1
        folder, line = out.with_suffix(".run"), capfd.readouterr().err
        assert line.startswith(f"paul: {folder}: another training is running in this folder: wait for its end, stop it")
        assert line.count("\n") == 1
    assert not out.exists()
    other.kill()
    other.wait()
    assert train(data, out) == 0 and out.exists()


def test_a_folder_that_stays_empty_is_removed(tmp_path, hold):
    hold(tmp_path / "a" / "b")
    with pytest.raises(TrainingError, match="another training"):
        with locked(tmp_path / "a" / "b"):
            pass
    assert (tmp_path / "a" / "b").is_dir()
    with pytest.raises(KeyError), locked(tmp_path / "c" / "d"):
        raise KeyError
    assert not (tmp_path / "c").exists()


def test_half_written_files_of_a_killed_training_are_deleted(tmp_path):
    kept, half = tmp_path / "checkpoint.pt", tmp_path / "seed_1" / "checkpoint.pt.1a2b3c4d.part"
    half.parent.mkdir()
    for path in (kept, half):
        path.touch()
    with locked(tmp_path):
        assert kept.exists() and not half.exists()


def test_a_file_system_without_locks_is_noted(tmp_path, monkeypatch, capsys):
    def flock(*given):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with locked(tmp_path):
        pass
    assert capsys.readouterr().err == (
        f"note: {tmp_path} cannot be locked (No locks available): start no second one here\n"
    )


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stopped_training_says_how_to_go_on(tmp_path, data, monkeypatch, capfd, kind):
    out, descend = tmp_path / "m.npz", Trainer._descend
    before = signal.signal(kind, signal.default_int_handler if kind == signal.SIGINT else signal.SIG_DFL)

    def interrupted(trainer, terms):
        if trainer.step == 3:
            signal.raise_signal(kind)
        return descend(trainer, terms)

    try:
        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "_descend", interrupted)
            assert train(data, out) == 128 + kind
        assert capfd.readouterr().err.endswith("paul: stopped at step 4 of 6: the same command continues\n")
        assert signal.getsignal(kind) == (signal.default_int_handler if kind == signal.SIGINT else signal.SIG_DFL)
    finally:
        signal.signal(kind, before)
    assert train(data, out) == 0
    assert "seed 0: continuing at step 4" in capfd.readouterr().err


def test_one_experiment_is_trained_by_one_process(tmp_path, data, hold, monkeypatch):
    """The others of the work folder are free, so that two benchmarks may share it."""
    settings = ("start=random", "regression_steps=0", "width=8", "batch=8", "bottleneck=3", "steps=2")
    one, two = (Experiment(load_sequence(data), "paul", seed, settings) for seed in (0, 1))
    options = SeriesOptions(tmp_path / "work", quiet=True)
    other = hold(one.folder(options.work))
    assert len(perform([two], options)) == 1
    with pytest.raises(TrainingError, match="another training"):
        perform([one], options)
    other.kill()
    other.wait()
    assert len(perform([one], options)) == 1
    monkeypatch.setattr(experiments.reconstruction, "reconstruct", stop)
    with pytest.raises(KeyboardInterrupt, match="stopped after 0 of 2 runs: the same command, without --fresh"):
        perform([one, two], SeriesOptions(options.work, fresh=True, quiet=True))


def stop(*given):
    raise KeyboardInterrupt
