# SPDX-License-Identifier: Apache-2.0
"""`paul train` decides once by the kind of data, and loads only what that kind and the command need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_data import sequence

from paul_ros.errors import BagError
from paul_ros.model_file import load_model, save_model
from paul_ros.offline.bag_writer import BagWriter
from training.errors import DataError
from training.options import TrainingOptions
from training.preflight import prepare
from training.recipe import Recipe
from training.sources import is_motion_capture

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / "bags" / "one_person.mcap"


def run(code: str, *words: object) -> str:
    """Run code in a process of its own, with words as its arguments; return what it prints."""
    done = subprocess.run([sys.executable, "-c", code, *map(str, words)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_motion_capture_is_a_folder_of_its_files_that_is_no_bag(tmp_path):
    capture, bag = tmp_path / "capture", tmp_path / "bag"
    for folder in (capture, bag, tmp_path / "empty"):
        folder.mkdir()
    (capture / "01_01.bvh").touch()
    (bag / "metadata.yaml").touch()
    (bag / "01_01.bvh").touch()
    for paths in ([tmp_path / "a.npz"], [BAG], [bag], [tmp_path / "empty"], [capture, capture]):
        assert not is_motion_capture(paths), paths
    assert is_motion_capture([capture])


def test_a_folder_without_data_is_explained(tmp_path):
    options = TrainingOptions(data=(tmp_path,), model=tmp_path / "m.npz", recipe="default")
    with pytest.raises(DataError, match=r"no recording in this folder \(.mcap, .db3\), and no motion capture"):
        prepare(options)


@pytest.mark.parametrize("name, clue", [("old.bag", "rosbags-convert"), ("take/rec_0.mcap", "give that, `.*/take`")])
def test_a_folder_gets_the_advice_that_replay_gives(tmp_path, name, clue):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n")
    options = TrainingOptions(data=(tmp_path,), model=tmp_path / "m.npz", recipe="default")
    with pytest.raises(BagError, match=clue):
        prepare(options)


def test_a_bag_without_keypoints_is_not_a_question_of_the_layout(tmp_path):
    with BagWriter(tmp_path / "empty.mcap"):
        pass
    options = TrainingOptions(data=(tmp_path / "empty.mcap",), model=tmp_path / "m.npz", recipe="default")
    with pytest.raises(DataError, match="has no 2D keypoints; the bag holds no messages. Record a topic of"):
        prepare(options)


TRAIN = """
import sys
for name in sys.argv.pop(1).split(","):
    sys.modules[name] = None
from paul_ros.cli import main
code = main(sys.argv[1:])
assert code == 0, code
print(*(name for name in sys.modules if name.startswith("training.people")))
"""
SMALL = "start=random regression_steps=0 steps=2 width=8 batch=8 bottleneck=3".split()


@pytest.mark.parametrize("data, missing", [("views.npz", "mcap,rosbags"), (BAG, "matplotlib")])
def test_other_data_than_motion_capture_needs_none_of_its_modules(tmp_path, data, missing):
    """And arrays need none of the packages that read bags."""
    np.savez(tmp_path / "views.npz", W=sequence()[0].W)
    settings = [word for item in SMALL for word in ("--set", item)]
    out = run(TRAIN, missing, "train", tmp_path / data, "-o", tmp_path / "m.npz", *settings, "--quiet")
    assert out.splitlines()[-1] == ""


def test_help_needs_neither_torch_nor_numpy():
    code = """
import sys
sys.modules["torch"] = sys.modules["numpy"] = sys.modules["tqdm"] = None
from paul_ros.cli.train import add_arguments
import argparse
parser = argparse.ArgumentParser()
add_arguments(parser)
print(parser.format_help())
"""
    assert "one of adl, adl_low_rank, default, human" in " ".join(run(code).split())


def test_training_without_torch_says_what_to_install(tmp_path):
    code = """
import sys
sys.modules["torch"] = None
from paul_ros.cli import main
sys.exit(main(["train", *sys.argv[1:]]) != 1)
"""
    words = [sys.executable, "-c", code, str(BAG), "-o", str(tmp_path / "m.npz")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and "'torch' is missing: pip install '.[train]' in a clone of paul_ros" in done.stderr


def test_models_of_recipes_with_removed_settings_are_loaded(tmp_path):
    """The recipe in a header is provenance only."""
    model = load_model()
    removed = {"hide": 0.3, "fade": [1.0, 1.0], "patience": 0}
    header = {**model.header, "training": {"recipe": {**Recipe().to_dict(), **removed}}}
    save_model(tmp_path / "m.npz", header, {**model.weights, "mean_shape": model.mean_shape})
    assert load_model(tmp_path / "m.npz").header["training"]["recipe"]["hide"] == 0.3
