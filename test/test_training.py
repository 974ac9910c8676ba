# SPDX-License-Identifier: Apache-2.0
"""The trainer: solver and objective against their definitions, 2D only, resumable to the bit, clear refusals."""

import argparse
import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import coco_model
from scipy.spatial.transform import Rotation
from tiny_data import FROM_RANDOM_WEIGHTS, sequence

from msg_adapters.outputs import keypoints_cloud
from paul_ros.cli import main
from paul_ros.cli import train as cli
from paul_ros.errors import BagError, ModelError, OutputError
from paul_ros.layout import load_layout
from paul_ros.model_file import load_model
from paul_ros.offline.bag_reader import read_messages, read_records
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.replay import replay
from paul_ros.stream.stream import open_stream
from training.errors import DataError, RecipeError, TrainingError
from training.export import mean_shape, metres_per_unit
from training.loading import load_training_data
from training.recipe import Recipe, recipe_names
from training.trainer import Trainer

COCO = load_layout("coco17")
BAG = Path(__file__).parents[1] / "bags" / "one_person.mcap"
SMALL = [
    "--set",
    "steps=12",
    "--set",
    "width=16",
    "--set",
    "batch=8",
    "--set",
    "bottleneck=3",
    "--quiet",
    "--threads",
    "1",
]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


def views(count=40, seed=0):
    """2D views (F,2,17) in pixels and the 3D truth (F,3,17), of bodies that vary a little about the shipped mean."""
    rng = np.random.default_rng(seed)
    S = coco_model().mean_shape + 0.1 * rng.standard_normal((count, 3, 17))
    S = Rotation.random(count, random_state=seed).as_matrix() @ S
    return (100 * S[:, :2] + 300).astype(np.float32), S.astype(np.float32)


@pytest.fixture
def data_file(tmp_path):
    path = tmp_path / "views.npz"
    W, S = views()
    visible = np.random.default_rng(1).random((40, 17)) < 0.8
    np.savez(path, W=W, visible=visible, S=S)
    return path


def train(*arguments):
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return cli.run(parser.parse_args([str(argument) for argument in (*FROM_RANDOM_WEIGHTS, *arguments)]))


def test_only_2d_reaches_the_trainer(data_file, tmp_path, monkeypatch):
    """No other array of the file is opened, and the weights do not depend on the truth, to the bit."""
    opened = []
    original = np.lib.npyio.NpzFile.__getitem__
    monkeypatch.setattr(
        np.lib.npyio.NpzFile, "__getitem__", lambda self, key: opened.append(key) or original(self, key)
    )
    train(data_file, "-o", tmp_path / "with.npz", *SMALL)
    assert set(opened) == {"W", "visible"}
    with np.load(data_file) as archive:
        np.savez(tmp_path / "views2d.npz", W=archive["W"], visible=archive["visible"])
    train(tmp_path / "views2d.npz", "-o", tmp_path / "without.npz", *SMALL)
    with_truth, without = load_model(tmp_path / "with.npz"), load_model(tmp_path / "without.npz")
    for name, value in with_truth.weights.items():
        np.testing.assert_array_equal(value, without.weights[name])


def test_interrupted_and_continued_equals_uninterrupted(data_file, tmp_path):
    data = load_training_data(data_file, COCO)
    recipe = Recipe.from_dict({"steps": 10, "width": 16, "batch": 8, "mirror_object": True})
    whole = Trainer(data, recipe, tmp_path / "whole")
    for _ in whole.run():
        pass
    first = Trainer(data, recipe, tmp_path / "parts")
    for row in first.run():
        if row["step"] == 4:
            break
    second = Trainer(data, recipe, tmp_path / "parts")
    assert second.resume() and second.step == 4
    for _ in second.run():
        pass
    for a, b in zip(whole.networks.parameters(), second.networks.parameters()):
        assert torch.equal(a, b)


def test_another_seed_gives_other_weights(data_file, tmp_path):
    for seed in (0, 1):
        train(data_file, "-o", tmp_path / f"{seed}.npz", *SMALL, "--set", f"seed={seed}")
    a, b = (load_model(tmp_path / f"{seed}.npz").weights["decoder.0.weight"] for seed in (0, 1))
    assert not np.array_equal(a, b)


def test_log_model_and_json(data_file, tmp_path):
    train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--json", tmp_path / "m.json")
    with open(tmp_path / "m.run" / "log.csv") as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["step"]) == 12 and np.isfinite(float(rows[-1]["loss"]))
    header = json.loads((tmp_path / "m.json").read_text())
    assert header["training"]["steps"] == 12 and header["metres_per_unit"] is None
    (only,) = header.pop("restarts")
    assert only["seed"] == 0 and only["chosen"] and np.isfinite(only["loss"])
    assert header == {key: value for key, value in load_model(tmp_path / "m.npz").header.items() if key != "format"}


def test_training_lowers_the_loss_and_lifts(data_file, tmp_path):
    data = load_training_data(data_file, COCO)
    trainer = Trainer(data, Recipe.from_dict({"steps": 150, "width": 32, "batch": 32}), tmp_path)
    losses = [row["recon_ad"] for row in trainer.run()]
    assert np.mean(losses[-20:]) < 0.7 * np.mean(losses[:20])


def test_a_run_of_other_data_or_recipe_is_not_continued(data_file, tmp_path):
    train(data_file, "-o", tmp_path / "m.npz", *SMALL)
    with pytest.raises(TrainingError, match="recipe.*--fresh"):
        train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--set", "seed=5")
    train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--set", "seed=5", "--fresh")


def test_a_damaged_checkpoint_is_named(data_file, tmp_path):
    train(data_file, "-o", tmp_path / "m.npz", *SMALL)
    (tmp_path / "m.run" / "checkpoint.pt").write_bytes(b"junk")
    with pytest.raises(TrainingError, match="--fresh"):
        train(data_file, "-o", tmp_path / "m.npz", *SMALL)


BAD_ARRAYS = {
    "no W": (dict(X=np.zeros(3)), "no array W"),
    "wrong points": (dict(W=np.zeros((5, 2, 16))), "--layout"),
    "3D given as 2D": (dict(W=np.zeros((5, 3, 17))), "--layout"),
    "text": (dict(W=np.full((5, 2, 17), "a")), "numbers"),
    "mask of another size": (dict(W=np.ones((5, 2, 17)), visible=np.ones((4, 17), bool)), "visible"),
    "all hidden": (dict(W=np.random.rand(5, 2, 17), visible=np.zeros((5, 17), bool)), "nothing to train on"),
    "all NaN": (dict(W=np.full((5, 2, 17), np.nan)), "nothing to train on"),
    "all at one place": (dict(W=np.full((5, 2, 17), 3.0)), "nothing to train on"),
    "huge": (dict(W=np.full((5, 2, 17), 1e30)), "no pixels"),
    "flags in words": (dict(W=np.random.rand(5, 2, 17), visible=np.full((5, 17), "no")), "visible.*must be bool"),
    "flags of NaN": (dict(W=np.random.rand(5, 2, 17), visible=np.full((5, 17), np.nan)), "visible.*must be bool"),
    "calibrated in words": (dict(W=np.random.rand(5, 2, 17), calibrated=np.array("yes")), "calibrated.*must be bool"),
    "pixels called rays": (dict(W=300 * np.random.rand(5, 2, 17), calibrated=np.array(True)), "no rays"),
    "pickled": (dict(W=np.array([{}, {}], dtype=object)), "plain arrays with np.savez"),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_bad_data_is_refused_before_the_first_step(tmp_path, case):
    contents, message = BAD_ARRAYS[case]
    np.savez(tmp_path / "bad.npz", **contents)
    with pytest.raises(DataError, match=message) as caught:
        load_training_data(tmp_path / "bad.npz", COCO)
    assert "allow_pickle" not in str(caught.value)


@pytest.mark.parametrize("contents", [b"", b"PK\x03\x04junk", b"\x93NUMPY\x01\x00v\x00{'descr'"])
def test_files_that_are_no_npz_are_named(tmp_path, contents):
    (tmp_path / "junk.npz").write_bytes(contents)
    with pytest.raises(DataError, match="junk.npz"):
        load_training_data(tmp_path / "junk.npz", COCO)


def test_a_damaged_npz_is_named(data_file):
    data = bytearray(data_file.read_bytes())
    data[len(data) // 3] ^= 0xFF
    data_file.write_bytes(data)
    with pytest.raises(DataError, match="views.npz"):
        load_training_data(data_file, COCO)


def test_frames_with_too_few_points_are_left_out_and_counted(tmp_path):
    W, _ = views(10)
    W[3] = np.nan
    np.savez(tmp_path / "some.npz", W=W)
    data = load_training_data(tmp_path / "some.npz", COCO)
    assert len(data.W) == 9 and data.left_out == 1


@pytest.mark.parametrize(
    "override,message",
    [
        ("steps=[1", "YAML"),
        ("steps=1.5", "steps"),
        ("hidden=[a]", "hidden"),
        ("hidden=[-3]", "hidden"),
        ("hidden=[]", "hidden"),
        ("learning_rate=.nan", "learning_rate"),
        ("bone_weight=.inf", "bone_weight"),
        ("code_weight=-1", "code_weight"),
        ("steps=many", "steps"),
        ("nonsense=1", "unknown"),
        ("batch", "key=value"),
        ("width=-4", "positive"),
        ("hide=0.3", "unknown recipe setting hide.* known are bottleneck"),
        ("seed=-1", "seed must be at least 0"),
        ("seed=1e12", "seed must be at most 4294967295"),
        ("batch=1e9", "batch must be at most"),
        ("restarts=1e9", "restarts must be at most"),
        ("stature=1e7", "stature must be 0, or metres"),
        ("views=5", "views must be settings as key: value"),
        ("seed=2020-99-99", "the value in 'seed=2020-99-99' is not YAML"),
        ("seed=2020-01-01", "seed must be like 0"),
    ],
)
def test_bad_recipes_are_refused(override, message):
    with pytest.raises(RecipeError, match=message):
        Recipe.load("default", [override])


def test_settings_without_effect_are_noted(data_file, tmp_path, capsys):
    train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--set", "views.views=2")
    assert "note: settings of views are not used: they are for a folder of motion capture" in capsys.readouterr().err


def test_the_data_is_never_overwritten_by_the_model(data_file):
    before = data_file.read_bytes()
    with pytest.raises(OutputError, match="another output"):
        train(data_file, "-o", data_file, *SMALL)
    with pytest.raises(OutputError, match="another"):
        train(data_file, "-o", data_file.with_name("m.npz"), "--json", data_file.with_name("m.npz"), *SMALL)
    assert data_file.read_bytes() == before


@pytest.mark.parametrize("override", ["width=5000", "blocks=101", "bottleneck=20000"])
def test_models_that_could_not_be_loaded_are_refused_before_training(data_file, tmp_path, override):
    with pytest.raises(ModelError, match="could not be loaded"):
        train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--set", override)
    assert not list((tmp_path / "m.run").glob("*"))


def test_a_bag_of_two_cameras_needs_a_choice(tmp_path):
    with BagWriter(tmp_path / "two.mcap") as out:
        for topic, _, message, stamp in read_messages(BAG, {"/camera_info", "/keypoints"}):
            out.write(topic, message, stamp)
            if topic == "/camera_info":
                out.write("/depth/camera_info", replace(message, p=2 * message.p), stamp)
    with pytest.raises(BagError, match="2 cameras, on /camera_info, /depth/camera_info: .* --camera-info-topic"):
        load_training_data(tmp_path / "two.mcap", COCO)
    with pytest.raises(BagError, match="no messages on /camera/info, did you mean '/camera_info'"):
        load_training_data(tmp_path / "two.mcap", COCO, camera_info_topic="/camera/info")
    near, far = (
        load_training_data(tmp_path / "two.mcap", COCO, camera_info_topic=topic)
        for topic in ("/camera_info", "/depth/camera_info")
    )
    assert np.array_equal(near.W, load_training_data(BAG, COCO).W)
    assert np.ptp(far.W) < 0.6 * np.ptp(near.W)


BARREL = [-0.25, 0.05, 0.001, -0.001, 0.0]


@pytest.fixture
def barrel_bag(tmp_path):
    """The shipped bag with a distorted lens, whose P differs from K by a factor."""
    with BagWriter(tmp_path / "barrel.mcap") as out:
        for topic, _, message, stamp in read_messages(BAG, {"/camera_info", "/keypoints"}):
            if topic == "/camera_info":
                p = message.p * np.where(np.arange(12) % 5, 1, 1.25)
                message = replace(message, d=np.array(BARREL), distortion_model="plumb_bob", p=p)
            out.write(topic, message, stamp)
    return tmp_path / "barrel.mcap"


def test_the_image_of_a_bags_keypoints_is_chosen(barrel_bag, tmp_path):
    raw, rectified, likely = (load_training_data(barrel_bag, COCO, image=i) for i in ("raw", "rectified", "auto"))
    assert np.ptp(raw.W) > 1.2 * np.ptp(rectified.W) and not raw.notes and not rectified.notes
    np.testing.assert_array_equal(likely.W, rectified.W)
    (note,) = likely.notes
    assert note.startswith("CameraInfo has distortion") and "Set --image to raw" in note
    plain = load_training_data(BAG, COCO)
    assert not np.allclose(raw.W, plain.W, atol=0.01)  # the distortion is corrected
    train(barrel_bag, "-o", tmp_path / "m.npz", "--image", "raw", *SMALL)
    assert not load_model(tmp_path / "m.npz").header["training"]["notes"]


@pytest.mark.parametrize(
    "factor, note", [(1.0, ""), (2.0, "Keypoints reach to .* an image of 640x360: .* Set --camera-info-topic to that")]
)
def test_a_resized_image_is_noted(tmp_path, factor, note):
    """CameraInfo of an image of half the size: all distances would be wrong by the factor."""
    with BagWriter(tmp_path / "small.mcap") as out:
        for topic, _, message, stamp in read_messages(BAG, {"/camera_info", "/keypoints"}):
            if topic == "/camera_info":
                message = replace(message, width=round(message.width / factor), height=round(message.height / factor))
            out.write(topic, message, stamp)
    notes = load_training_data(tmp_path / "small.mcap", COCO).notes
    assert re.match(note, " ".join(notes)) and bool(notes) == bool(note)


def test_keypoints_without_a_ray_are_counted(tmp_path):
    """The barrel folds the image back at 40 degrees: a point beyond is hidden, and a note says so."""
    with BagWriter(tmp_path / "far.mcap") as out:
        for topic, _, message, stamp in read_messages(BAG, {"/camera_info", "/keypoints"}):
            if topic == "/camera_info":
                k = message.k * np.where(np.arange(9) % 4, 1, 0.3)
                message = replace(message, d=np.array([-0.4, 0, 0, 0, 0.0]), k=k)
            out.write(topic, message, stamp)
    data = load_training_data(tmp_path / "far.mcap", COCO, image="raw")
    assert any("hidden: the distortion model has no ray there" in note for note in data.notes)


@pytest.mark.parametrize("length", ["[left_hip, left_hoof, 0.4]", "[nose, nose, 1]", "[nose, left_eye, x]", "5"])
def test_lengths_that_are_none_are_refused_before_training(data_file, tmp_path, length):
    why = "; the layout has no 'left_hoof'$" if "hoof" in length else "$"
    with pytest.raises(RecipeError, match=f"known_lengths must be .*{why}"):
        train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--set", f"known_lengths=[{length}]")


def test_a_recipe_of_other_points_is_named(tmp_path):
    np.savez(tmp_path / "hand.npz", W=views()[0][:, :, :9])
    with pytest.raises(RecipeError, match="recipe human is for layouts with the points that it names: known_lengths"):
        train(tmp_path / "hand.npz", "-o", tmp_path / "m.npz", "--recipe", "human", *SMALL, "--set", "hold=0")


def test_no_threads_are_refused(data_file, tmp_path):
    with pytest.raises(TrainingError, match="--threads must be at least 1, it is 0"):
        train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--threads", "0")


def test_fresh_deletes_nothing_but_the_run(data_file, tmp_path):
    train(data_file, "-o", tmp_path / "m.npz", *SMALL)
    (tmp_path / "m.run" / "notes.txt").write_text("precious")
    train(data_file, "-o", tmp_path / "m.npz", *SMALL, "--set", "seed=5", "--fresh")
    assert (tmp_path / "m.run" / "notes.txt").read_text() == "precious"


def test_shipped_recipes_load():
    assert {"default", "human"} <= set(recipe_names())
    for name in recipe_names():
        assert Recipe.from_dict(Recipe.load(name).to_dict()) == Recipe.load(name)


def test_known_lengths_set_the_metres():
    shapes = np.zeros((4, 3, 17))
    shapes[:, 1, 13] = 2.0  # left knee two units from the left hip
    assert metres_per_unit(shapes, COCO, (("left_hip", "left_knee", 0.5),)) == 0.25
    assert metres_per_unit(shapes, COCO, ()) is None


def test_mean_shape_forgets_orientation():
    shape = np.random.default_rng(0).standard_normal((3, 17))
    shape -= shape.mean(1, keepdims=True)
    turned = Rotation.random(30, random_state=0).as_matrix() @ shape
    lengths = [np.linalg.norm(s[:, :, None] - s[:, None], axis=0) for s in (mean_shape(turned), shape)]
    np.testing.assert_allclose(*lengths, atol=1e-9)


# --- the journey: record, train, lift


def test_a_bag_is_learned_from_and_lifted_with(tmp_path):
    data = load_training_data(BAG, COCO)
    assert data.calibrated and len(data.W) == 585 and np.abs(data.W).max() < 1
    train(BAG, "-o", tmp_path / "mine.npz", *SMALL)
    stream = open_stream(str(tmp_path / "mine.npz"))
    done = replay(BAG, stream)
    assert stream.counts["lifted"] == 585 and stream.units == "model"
    assert np.isfinite(done.frames[0].lifted.points).all()


def test_a_bag_in_another_layout_says_which_would_fit(tmp_path):
    with pytest.raises(DataError, match="no 2D keypoints of layout 'body25'; refused on .*/keypoints: 17 keypoints"):
        load_training_data(BAG, load_layout("body25"))


def test_a_bag_with_several_topics_needs_a_choice(tmp_path):
    """The truth in our bags is a PoseArray as well, but in 3D; a second topic of 2D keypoints leaves a choice."""
    with BagWriter(tmp_path / "two.mcap") as out:
        for record in read_records(BAG, {"/keypoints"}):
            out.write_record(record)
            out.write_record(replace(record, topic="/other"))
    with pytest.raises(DataError, match=r"no 2D keypoints on /nope; the bag holds .*/other \(sensor.*--topic"):
        load_training_data(tmp_path / "two.mcap", COCO, "/nope")
    with pytest.raises(DataError, match="/keypoints, /other.*--topic"):
        load_training_data(tmp_path / "two.mcap", COCO)
    data = load_training_data(tmp_path / "two.mcap", COCO, "/other")
    assert not data.calibrated and np.abs(data.W).max() > 100


def test_keypoints_of_low_confidence_are_hidden_and_an_outlier_spoils_nothing(tmp_path):
    make = BagMessages()
    rng = np.random.default_rng(0)
    xy = rng.uniform(300, 600, (20, 1, 17, 2))
    xy[0, 0, 0] = [9e5, 9e5]
    confidence = np.where(np.arange(17) < 10, 0.9, 0.01)[None]
    info = next(message for _, _, message, _ in read_messages(BAG, {"/camera_info"}))
    with BagWriter(tmp_path / "detector.mcap", make) as bag:
        bag.write("/camera_info", info, 0)
        for stamp, points in enumerate(xy):
            bag.write("/keypoints", keypoints_cloud(make, info.header, points, confidence, ["1"]), stamp)
    data = load_training_data(tmp_path / "detector.mcap", COCO)
    assert data.calibrated and len(data.W) == 20
    assert data.visible[-19:, :10].all() and not data.visible[:, 10:].any()
    assert load_training_data(tmp_path / "detector.mcap", COCO, min_confidence=0.0).visible[-19:].all()


def test_an_output_that_cannot_be_written_stops_the_run_before_it_begins(data_file, tmp_path):
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(OutputError, match="folder"):
        train(data_file, "-o", tmp_path / "folder.npz", *SMALL)
    assert not (tmp_path / "folder.run").exists()


def test_the_report_goes_to_standard_output(tmp_path, capsys):
    np.savez(tmp_path / "views.npz", W=sequence()[0].W)
    words = [tmp_path / "views.npz", "-o", tmp_path / "model.npz", *FROM_RANDOM_WEIGHTS]
    words += ["--set", "steps=2", "--quiet", "--json", "-"]
    assert main(["train", *map(str, words)]) == 0
    assert json.loads(capsys.readouterr().out)["restarts"][0]["chosen"]


def test_a_damaged_bag_is_trained_on_as_far_as_replay_reads_it(tmp_path):
    """Its whole messages are used, and what is lost stands in the notes, without the folders of this machine."""
    half = tmp_path / "half.mcap"
    half.write_bytes(BAG.read_bytes()[: BAG.stat().st_size // 2])
    data = load_training_data(half, COCO)
    replayed = replay(half, open_stream("human"))
    assert len(data.used) == replayed.stream.counts["persons"] > 100
    [note] = data.notes
    assert "half.mcap: damaged: the file ends too early" in note and str(tmp_path) not in note


def test_messages_that_do_not_decode_are_left_out_and_noted(tmp_path):
    path = tmp_path / "odd.mcap"
    with BagWriter(path) as bag:
        for number, record in enumerate(read_records(BAG, ["/keypoints"])):
            bag.write_record(replace(record, data=record.data[:50]) if number % 10 == 0 else record)
    data = load_training_data(path, COCO)
    assert len(data.used) == 526 and "59 messages on /keypoints left out, undecodable; of the last: " in data.notes[0]
