# SPDX-License-Identifier: Apache-2.0
"""Files of training views: their settings, the command that makes them, and `paul train` on a folder."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from people_data import captured_joints
from test_distributed import TORCHRUN

from paul_ros.cli import train as cli
from paul_ros.model_file import load_model
from training import motion_capture
from training.errors import DataError, MocapError, RecipeError, ViewsError
from training.loading import load_training_data
from training.people import human_data
from training.people.human_points import human_layout
from training.people.view_settings import ViewSettings

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def joints():
    return captured_joints()


# --- settings


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"levels": [0, 1]}, "unknown view setting levels; known are motion"),
        ({"level": [0, 2]}, "level must be at most 1"),
        ({"level": 1}, "level must be like"),
        ({"distance": [3, 2]}, "distance must be two growing numbers"),
        ({"distance": [0.1, 2]}, "distance must be at least 0.5"),
        ({"layouts": [["coco", 1]]}, "did you mean 'coco17'"),
        ({"layouts": [["cmu31", 1]]}, "points that human has not"),
        ({"layouts": [["coco17", 0]]}, "a list of"),
        ({"layouts": [["coco17"]]}, "a list of"),
        ({"layouts": ["coco17"]}, "a list of"),
        ({"border": 1}, "border must be like True"),
        ({"views": 2.5}, "views must be like 6"),
        ({"stature": float("nan")}, "stature must be like"),
        ({"hidden": ["a", "b"]}, "hidden must be two growing numbers"),
        (["level"], r"mapping of settings \(key: value\)"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ViewsError, match=message):
        ViewSettings.from_dict(settings)


def test_settings_survive_yaml():
    views = ViewSettings.from_dict({"level": [0, 0.5], "layouts": [["coco17", 1]], "views": 2.0, "border": False})
    assert views.level == (0, 0.5) and views.layouts == (("coco17", 1),) and views.views == 2 and not views.border
    assert ViewSettings.from_dict(views.to_dict()) == views
    assert ViewSettings.from_dict(ViewSettings().to_dict()) == ViewSettings()


# --- files and the command


@pytest.fixture
def archive(tmp_path, joints):
    folder = tmp_path / "archive"
    folder.mkdir()
    np.savez(
        folder / "subject_90.npz",
        S_world=joints.astype(np.float32),
        trial_names=np.array(["90_01", "90_02"]),
        trial_len=np.array([300, len(joints) - 300]),
    )
    return folder


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "training.people.human_data", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )


def test_the_command_makes_what_the_trainer_takes(archive, tmp_path):
    done = command(
        archive, "-o", tmp_path / "2d.npz", "--truth", tmp_path / "3d.npz", "--set", "views.views=2", "--quiet"
    )
    assert done.returncode == 0, done.stderr
    data = load_training_data(tmp_path / "2d.npz", human_layout())
    assert data.calibrated and data.left_out == 0 and len(data.W) > 100
    with np.load(tmp_path / "2d.npz", allow_pickle=False) as two, np.load(tmp_path / "3d.npz") as three:
        assert sorted(two.files) == ["W", "about", "calibrated", "detected"]
        np.testing.assert_array_equal(np.isfinite(two["detected"]).all(1), three["visible"])
        np.testing.assert_array_equal(np.nan_to_num(two["detected"]), three["W"])
        far = np.ptp(two["W"], axis=2).max(1) < 0.5  # nearer bodies differ too much from a parallel projection
        off = three["S"][far, :2] / three["S"][far, :2].std((1, 2))[:, None, None]
        assert np.corrcoef(off.ravel(), two["W"][far].ravel())[0, 1] > 0.9
        assert three["S"].shape == (len(data.W), 3, 43)
        assert b'"views": 2' in two["about"].tobytes() and b"90_02" in two["about"].tobytes()
    again = command(archive, "-o", tmp_path / "again.npz", "--set", "views.views=2", "--quiet")
    assert again.returncode == 0 and (tmp_path / "again.npz").read_bytes() == (tmp_path / "2d.npz").read_bytes()


def test_errors_of_the_command_are_one_line(archive, tmp_path):
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        ((archive, "--set", "views.levels=1"), "unknown view setting levels"),
        ((archive, "--set", "bottleneck.a=1"), "bottleneck has no settings of its own"),
        ((archive, "--recipe", "default"), "--recipe human"),
        ((tmp_path / "empty",), "holds no motion capture"),
        ((archive, "--set", "views.hidden=[1,1]"), "enough points to be lifted: lower views.hidden, which is [1"),
    ):
        wrong = command(*arguments, "-o", tmp_path / "2d.npz", "--quiet")
        assert wrong.returncode == 1 and wrong.stderr.count("\n") == 1 and message in wrong.stderr, wrong.stderr


def test_the_command_overwrites_nothing_that_it_reads_or_writes(archive, tmp_path):
    """Wrong outputs are refused before any reading, and leave no files."""
    capture, out = archive / "subject_90.npz", tmp_path / "2d.npz"
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "a.npz").symlink_to(capture)
    before = capture.read_bytes()
    for arguments, message in (
        ((archive, "-o", capture), "read as motion capture"),
        ((archive, "-o", archive / "new.npz"), "read as motion capture"),
        ((archive, "-o", out, "--truth", archive / "3d.npz"), "read as motion capture"),
        ((tmp_path / "linked", "-o", capture), "would overwrite an input"),
        ((archive, "-o", out, "--truth", tmp_path / "linked" / ".." / "2d.npz"), "named for two outputs"),
        ((archive, "-o", tmp_path / "views.txt"), "must end in .npz, not 'views.txt'"),
        ((archive, "-o", out, "--truth", tmp_path / "truth"), "must end in .npz, not 'truth'"),
        ((archive, "-o", tmp_path / "typo" / "2d.npz"), "there is no folder"),
    ):
        wrong = command(*arguments)
        assert wrong.returncode == 1 and wrong.stderr.count("\n") == 1 and message in wrong.stderr, wrong.stderr
    assert capture.read_bytes() == before and sorted(path.name for path in tmp_path.iterdir()) == ["archive", "linked"]


def test_views_are_made_anew_if_files_or_settings_change_and_only_then(archive, tmp_path, monkeypatch):
    """Contents count, because a corrected file may keep its size and time."""
    kept, capture = tmp_path / "views.npz", archive / "subject_90.npz"
    settings = replace(ViewSettings(), views=1)

    def made_anew(views=settings):
        before = kept.stat().st_ino if kept.exists() else None
        human_data.make_file(archive, views, kept, quiet=True)
        return kept.stat().st_ino != before

    assert made_anew() and not made_anew()
    content, written = bytearray(capture.read_bytes()), capture.stat()
    with np.load(capture, allow_pickle=False) as arrays:
        corrected = {**arrays, "S_world": arrays["S_world"] + np.float32(0.5)}
    np.savez(capture, **corrected)
    os.utime(capture, ns=(written.st_atime_ns, written.st_mtime_ns))
    assert capture.stat().st_size == len(content) and capture.stat().st_mtime_ns == written.st_mtime_ns
    assert made_anew() and not made_anew()
    capture.touch()
    assert not made_anew()
    skeleton = archive / "90.asf"
    skeleton.write_text("length 0.45")
    assert made_anew() and not made_anew()
    skeleton.write_text("length 0.54")
    assert made_anew() and not made_anew()
    capture.rename(archive / "subject_91.npz")
    assert made_anew() and made_anew(replace(settings, seed=1)) and made_anew()
    monkeypatch.setattr(human_data, "FORMAT", human_data.FORMAT + 1)
    assert made_anew() and not made_anew()


def test_views_of_a_format_are_known(joints):
    """If this fails, equal files and settings give other views: raise human_data.FORMAT and change these figures."""
    arrays, _ = human_data.make([("90_01", joints)], replace(ViewSettings(), views=1))
    detected = np.isfinite(arrays["detected"]).all(1)
    found = len(detected), detected.mean(), np.nanmean(np.abs(arrays["W"])), np.nanmean(np.abs(arrays["detected"]))
    assert human_data.FORMAT == 1 and found == pytest.approx((281, 0.40578, 0.089666, 0.069461), rel=1e-3)


SETTINGS = ("views.views=1", "steps=2", "batch=16", "start=random", "regression_steps=0", "hold=0", "width=16")
SMALL = ["--recipe", "human", *(word for setting in SETTINGS for word in ("--set", setting))]


def arguments_of_train(*words):
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return parser.parse_args([*map(str, words)])


@pytest.mark.parametrize("option", ["-o", "--shapes"])
def test_nothing_is_written_into_the_folder_that_is_read(archive, option):
    """The same command would read outputs in the folder as motion capture."""
    (archive / "below").mkdir()
    for output in (archive / "human.npz", archive / "below" / ".." / "below" / "human.npz"):
        with pytest.raises(MocapError, match="would be read as motion capture; write it elsewhere"):
            cli.run(arguments_of_train(archive, option, output, "--recipe", "human"))
    assert sorted(path.name for path in archive.rglob("*")) == ["below", "subject_90.npz"]


def test_a_folder_is_trained_on_by_one_command(archive, tmp_path, monkeypatch, capsys):
    """One command makes views and trains; repeated, it uses the views that it made."""
    small = [*SMALL, "--quiet"]
    monkeypatch.setattr(sys, "argv", ["paul", "train"])
    args = arguments_of_train(archive, "-o", tmp_path / "human.npz", *small)
    cli.run(args)
    model = load_model(tmp_path / "human.npz")
    assert model.layout.name == "human" and model.min_visible == 6
    assert model.header["training"]["recipe"]["views"] == replace(ViewSettings(), views=1).to_dict()
    views = tmp_path / "human.run" / "views.npz"
    made = views.stat().st_mtime_ns
    cli.run(args)
    assert views.stat().st_mtime_ns == made
    with pytest.raises(RecipeError, match="--recipe human"):
        cli.run(arguments_of_train(archive, "-o", tmp_path / "x.npz", "--quiet"))


@pytest.mark.parametrize(
    "words, error, message",
    [
        (("--layout", "coco17"), DataError, "43 points of layout human, not the 17 of coco17: leave out --layout"),
        (("--set", "known_lengths=[[left_hip, tail, 0.4]]"), RecipeError, "tail"),
        (("--set", "hold=0", "--set", "steps=0", "--set", "regression_steps=0"), RecipeError, "no networks"),
    ],
)
def test_errors_that_need_no_views_come_before_views_are_made(archive, tmp_path, monkeypatch, words, error, message):
    monkeypatch.setattr(motion_capture, "make_file", lambda *given, **named: pytest.fail("views were made"))
    with pytest.raises(error, match=message):
        cli.run(arguments_of_train(archive, "-o", tmp_path / "human.npz", "--recipe", "human", *words))


def train_together(*words):
    """``torchrun -m paul_ros.cli train`` with two processes."""
    command = [sys.executable, *TORCHRUN, "-m", "paul_ros.cli", "train", *map(str, words), *SMALL]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment, cwd=ROOT)


def test_one_of_two_processes_makes_the_views(archive, tmp_path):
    """One process shows its work; the other waits for the file."""
    done = train_together(archive, "-o", tmp_path / "human.npz", "--fresh")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("motion capture: 100%") == 1 and done.stdout.count("human.npz") == 1


def test_an_unreadable_file_stops_both_processes_with_one_error(archive, tmp_path):
    (archive / "91_01.bvh").write_text("HIERARCHY")
    wrong = train_together(archive, "-o", tmp_path / "human.npz")
    lines = [line for line in wrong.stderr.splitlines() if "91_01.bvh" in line]
    assert wrong.returncode == 1 and len(set(lines)) == 1 and "broadcast" not in wrong.stderr, wrong.stderr
