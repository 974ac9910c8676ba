# SPDX-License-Identifier: Apache-2.0
"""Data that may be trained on, and data that is refused in one clear line."""

import hashlib

import numpy as np
import pytest
from conftest import FOCAL, camera_info
from hypothesis import given, settings
from hypothesis import strategies as st
from test_foreign_bags import BODIES, FRAMES, IDS, PIXELS, STATED, Factory, image_messages, topics_for, write

from msg_adapters import read_camera_info
from paul_ros.layout import load_layout
from paul_ros.normalisation import enough_visible
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.placement import centred_view
from training import data as module
from training.data_checks import check_sizes
from training.errors import DataError
from training.loading import load_training_data


def views(frames=6, points=9, seed=0):
    return np.random.default_rng(seed).uniform(100, 500, (frames, 2, points))


def load(tmp_path, layout=None, **arrays):
    np.savez(tmp_path / "data.npz", **arrays)
    return load_training_data(tmp_path / "data.npz", layout)


def twin(W):
    W[:, :, 5] = W[:, :, 2]
    return W


def with_value(value):
    W = views()
    W[2, 1, 3] = value
    return W


BAD = {
    "3D": (dict(W=np.zeros((6, 3, 9))), r"must be numbers \(F,2,P\)"),
    "flat": (dict(W=np.zeros((6, 18))), r"must be numbers \(F,2,P\)"),
    "no frames": (dict(W=np.zeros((0, 2, 9))), "nothing to train on"),
    "two points": (dict(W=views(points=2)), "make no layout: names has 2 points"),
    "too many points": (dict(W=np.zeros((1, 2, 20_001))), "make no layout"),
    "all hidden": (dict(W=views(), visible=np.zeros((6, 9), bool)), "nothing to train on"),
    "one frame again and again": (dict(W=np.repeat(views(1), 6, axis=0)), "all the same"),
    "one frame": (dict(W=views(1)), "one frame only: depth shows only where something moves"),
    "all on one level": (dict(W=views() * [[1], [0]]), "on one line: nothing to train on"),
    "all on a slope": (dict(W=views()[:, :1] * [[1], [0.7]] + [[0], [0.3]]), "on one line: nothing to train on"),
    "a point twice": (dict(W=twin(views())), "p02 and p05.*one place in every frame"),
    "NaN called visible": (dict(W=with_value(np.nan), visible=np.ones((6, 9), bool)), "NaN or infinite at 1 of 54"),
    "infinite": (dict(W=with_value(np.inf)), "NaN or infinite at 1 of 54"),
    "huge": (dict(W=with_value(1e9)), "no pixels"),
    "far beyond float32": (dict(W=with_value(1e300)), "no pixels"),
    "rays of pixels": (dict(W=views(), calibrated=True), "no rays"),
    "edges beyond the points": (dict(W=views(), edges=[[0, 9]]), "edges must join points 0 to 8"),
    "an edge to itself": (dict(W=views(), edges=[[3, 3]]), "two different points"),
    "edges in threes": (dict(W=views(), edges=[[0, 1, 2]]), r"whole numbers \(E,2\)"),
    "edges of numbers": (dict(W=views(), edges=[[0.0, 1.0]]), r"whole numbers \(E,2\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_data_is_refused(tmp_path, case):
    arrays, message = BAD[case]
    with pytest.raises(DataError, match=message) as caught:
        load(tmp_path, **arrays)
    assert "\n" not in str(caught.value) and "data.npz" in str(caught.value)


def test_frames_that_differ_where_either_is_hidden_are_all_the_same(tmp_path):
    W, visible = np.repeat(views(1), 6, axis=0), np.ones((6, 9), bool)
    W[3, :, 4], visible[3, 4] = 0, False
    with pytest.raises(DataError, match="all the same"):
        load(tmp_path, W=W, visible=visible)
    W[3, :, 5] += 1
    assert len(load(tmp_path, W=W, visible=visible).W) == 6


def test_points_never_visible_are_noted_and_no_twins(tmp_path):
    visible = np.ones((6, 9), bool)
    visible[:, [2, 7]] = False
    (note,) = load(tmp_path, W=views(), visible=visible).notes
    assert note.startswith("p02, p07 of layout 'points9' never visible")
    assert load(tmp_path, W=views()).notes == ()


def test_frames_on_one_line_are_left_out(tmp_path):
    """In single precision points lie on a line only up to rounding."""
    W = views().astype(np.float32)
    W[2, 1] = 0.7 * W[2, 0] + 1000
    W[4, :, 1:] = W[4, :, :1] + np.float32(0.01) * views()[4, :, 1:]  # small, and no line
    data = load(tmp_path, W=W)
    assert data.left_out == 1 and len(data.W) == 5


def test_points_taken_for_a_persons_are_noted(tmp_path):
    (note,) = load(tmp_path, W=views(points=17)).notes
    assert note == "17 points taken as coco17; --layout points17 if they are not"
    assert load(tmp_path, load_layout("coco17"), W=views(points=17)).notes == ()


def test_detections_go_with_their_frames(tmp_path):
    """Points that are not marked are not detected; frames with too few detections are left out."""
    W = views()
    detected = W + 1
    detected[1, :, :6] = np.nan
    W[2, :, 3] = np.nan
    data = load(tmp_path, W=W, detected=detected)
    assert data.left_out == 1
    kept = np.delete(np.arange(6), 1)
    expected = np.where(np.isnan(W), np.nan, detected)[kept].astype(np.float32)
    np.testing.assert_array_equal(data.detected, expected)
    assert data.sha256 != load(tmp_path, W=W, detected=detected + 1).sha256


@pytest.mark.parametrize(
    "detected, message",
    [(views(points=8), "detected in .* must be numbers"), (views() * 1e5, "beyond 1e"), (np.array("x"), "be numbers")],
)
def test_bad_detections_are_refused(tmp_path, detected, message):
    with pytest.raises(DataError, match=message):
        load(tmp_path, W=views(), detected=detected)


@pytest.mark.parametrize("frames, points", [(2, 9), (6, 3)])
def test_too_little_for_any_shape_is_noted(tmp_path, frames, points):
    (note,) = load(tmp_path, W=views(frames, points)).notes
    assert note.startswith(f"{frames} frames of {points} points leave the depth open")


def test_an_outlier_is_refused_if_all_frames_have_one_scale(tmp_path):
    W = views() / 100
    W[3, 0, 4] = 1e5
    data = load(tmp_path, W=W)
    with pytest.raises(DataError, match="frame 3 of data.npz is .* times as large as the median one, by point p04"):
        check_sizes(data, "unit")
    (note,) = check_sizes(data, "free")
    assert note.startswith("frame 3 of data.npz")
    W[1, :, 1:] = np.nan
    with pytest.raises(DataError, match="frame 3 of data.npz is"):
        check_sizes(load(tmp_path, W=W), "unit")


def test_sizes_that_vary_are_noted_where_all_frames_have_one_scale(tmp_path):
    assert check_sizes(load(tmp_path, W=views()), "unit") == ()
    varied = load(tmp_path, W=views() * np.geomspace(0.1, 1, 6)[:, None, None])
    (note,) = check_sizes(varied, "unit")
    assert "their sizes vary" in note and check_sizes(varied, "free") == ()
    (note,) = check_sizes(load(tmp_path, W=views() / 500, calibrated=True), "unit")
    assert "these are rays" in note


def test_layouts_are_guessed_by_the_number_of_points(tmp_path):
    assert load(tmp_path, W=views(points=17)).layout == load_layout("coco17")
    layout = load(tmp_path, W=views(points=120), edges=[[0, 119]]).layout
    assert (layout.name, layout.names[119], layout.edges) == ("points120", "p119", ((0, 119),))
    assert load(tmp_path, load_layout("points9"), W=views()).layout.name == "points9"


@settings(deadline=None, max_examples=30)
@given(st.integers(2, 40), st.integers(3, 12), st.floats(0, 0.5), st.integers(0, 99))
def test_loaded_data_equals_given_data(tmp_path_factory, frames, points, hidden, seed):
    rng = np.random.default_rng(seed)
    W, visible = views(frames, points, seed), rng.random((frames, points)) >= hidden
    keeps = enough_visible(visible, load_layout(f"points{points}"))
    if not keeps.any() or keeps.sum() < 2:
        return
    folder = tmp_path_factory.mktemp("data")
    masked = load(folder, load_layout(f"points{points}"), W=W, visible=visible)
    marked = load(folder, load_layout(f"points{points}"), W=np.where(visible[:, None], W, np.nan))
    np.testing.assert_array_equal(masked.W, np.where(visible[:, None], W, 0)[keeps].astype(np.float32))
    np.testing.assert_array_equal(masked.W, marked.W)
    np.testing.assert_array_equal(masked.visible, marked.visible)
    assert masked.left_out == (~keeps).sum()


def test_the_digest_is_that_of_the_bytes(tmp_path):
    """Checkpoints of earlier versions still match their data."""
    data = load(tmp_path, W=views())
    digest = hashlib.sha256(data.W.tobytes())
    digest.update(np.packbits(data.visible).tobytes())
    assert data.sha256 == digest.hexdigest()


@pytest.mark.parametrize("block", [1, 4, 1024])
def test_the_image_unit_is_the_rms_coordinate(tmp_path, monkeypatch, block):
    monkeypatch.setattr(module, "_BLOCK", block)
    visible = np.random.default_rng(1).random((6, 9)) < 0.7
    data = load(tmp_path, W=views(), visible=visible)
    coordinates = []
    for w, seen in zip(data.W.astype(float), data.visible):
        coordinates.append((w[:, seen] - w[:, seen].mean(1, keepdims=True)).ravel())
    assert data.image_unit == pytest.approx(np.sqrt((np.concatenate(coordinates) ** 2).mean()), rel=1e-6)


# --- bags of every message family


def rays(fx: float = FOCAL) -> np.ndarray:
    """Rays (F,2,17) of all those bags, by the camera in them."""
    xy = PIXELS.reshape(-1, 17, 2)
    return centred_view(xy, np.ones(xy.shape[:2], bool), read_camera_info(camera_info(Factory(), fx=fx))).W


@pytest.mark.parametrize("name", IDS)
def test_a_bag_of_every_family_is_data(tmp_path, name):
    bag, stated = write(tmp_path / "in.mcap", name), STATED.get(name)
    data = load_training_data(bag, load_layout(stated) if stated else None, topics_for(name).keypoints)
    assert data.calibrated and data.visible.all() and data.left_out == 0 and data.layout == load_layout("coco17")
    np.testing.assert_allclose(data.W, rays(), atol=1e-5)


def test_a_bag_without_a_camera_gives_pixels_but_no_shares(tmp_path):
    data = load_training_data(write(tmp_path / "opendr.mcap", "opendr", with_camera=False))
    assert not data.calibrated
    np.testing.assert_array_equal(data.W, PIXELS.reshape(-1, 17, 2).transpose(0, 2, 1))
    with pytest.raises(DataError, match="no 2D keypoints .*CameraInfo") as caught:
        load_training_data(write(tmp_path / "hri.mcap", "hri", with_camera=False), topic=BODIES)
    assert "\n" not in str(caught.value)


def write_shares(path, *infos):
    """A ROS4HRI bag whose CameraInfo comes last."""
    with BagWriter(path, Factory()) as bag:
        for number in range(FRAMES):
            for topic, message in image_messages(Factory(), "hri", number):
                bag.write(topic, message, number)
        for info in infos:
            bag.write("/camera_info", info, FRAMES)
    return path


def test_shares_before_the_first_camera_info_are_no_loss(tmp_path):
    data = load_training_data(write_shares(tmp_path / "in.mcap", camera_info(Factory())), topic=BODIES)
    np.testing.assert_allclose(data.W, rays(), atol=1e-5)


def test_the_size_of_an_uncalibrated_camera_turns_shares_into_pixels(tmp_path):
    data = load_training_data(write_shares(tmp_path / "in.mcap", camera_info(Factory(), fx=0.0)), topic=BODIES)
    assert not data.calibrated
    np.testing.assert_allclose(data.W, PIXELS.reshape(-1, 17, 2).transpose(0, 2, 1), atol=1e-3)


def test_cameras_of_two_sizes_are_refused(tmp_path):
    other = camera_info(Factory(), fx=0.0)
    other.width = 1280
    with pytest.raises(DataError, match="several cameras on /camera_info"):
        load_training_data(write_shares(tmp_path / "in.mcap", camera_info(Factory()), other), topic=BODIES)


def test_another_camera_on_the_same_topic_is_refused(tmp_path):
    infos = camera_info(Factory()), camera_info(Factory(), fx=1.02 * FOCAL)
    with pytest.raises(DataError, match="several cameras on /camera_info"):
        load_training_data(write_shares(tmp_path / "in.mcap", *infos), topic=BODIES)


def test_a_camera_may_jitter_and_each_frame_has_the_latest(tmp_path):
    """As in replay; before the first CameraInfo, training takes that one, since it need not wait for it."""
    bag, make = tmp_path / "in.mcap", Factory()
    jittered = 1.009 * FOCAL
    with BagWriter(bag, make) as writer:
        for number in range(FRAMES):
            if number:
                info = camera_info(make, fx=FOCAL if number < FRAMES - 1 else jittered)
                writer.write("/cam/info", info, 10 * number - 1)
            for topic, message in image_messages(make, "hri", number):
                writer.write(topic, message, 10 * number)
    W = load_training_data(bag, topic=BODIES).W
    calm, last = rays(), rays(jittered)
    persons = len(W) // FRAMES
    np.testing.assert_allclose(W[:-persons], calm[:-persons], atol=1e-5)
    np.testing.assert_allclose(W[-persons:], last[-persons:], atol=1e-5)
    assert np.abs(calm - last)[-persons:].max() > 1e-4


def test_a_bag_with_several_bodies_needs_a_choice(tmp_path):
    bag = write(tmp_path / "in.mcap", "hri")
    with pytest.raises(DataError, match="/humans/bodies/anna/skeleton2d, /humans/bodies/ben/.*--topic"):
        load_training_data(bag)
    anna = load_training_data(bag, topic=BODIES.replace("*", "anna"))
    np.testing.assert_allclose(anna.W, rays()[::2], atol=1e-5)


# --- numbers that mean something else


def test_placeholders_in_arrays_are_missing_and_counted(tmp_path):
    W, hidden = views(40), np.random.default_rng(1).random((40, 9)) < 0.25
    zeros, minus = W.copy(), W.copy()
    zeros.transpose(0, 2, 1)[hidden], minus.transpose(0, 2, 1)[hidden] = 0, -1
    nan = np.where(hidden[:, None], np.nan, W)
    whole = load(tmp_path, W=nan)
    for marked in (dict(W=zeros), dict(W=minus), dict(W=zeros, visible=np.ones((40, 9), bool))):
        data = load(tmp_path, **marked)
        assert data.sha256 == whole.sha256
        assert data.notes[0] == f"{hidden.sum()} of 360 points at (0, 0) or (-1, -1) taken as missing"
    detected = load(tmp_path, W=W, detected=zeros).detected
    np.testing.assert_array_equal(np.isnan(detected).all(1), hidden)


def test_the_origin_of_relative_arrays_stays(tmp_path):
    W = views(40)
    data = load(tmp_path, W=W - W[:, :, [4]])
    assert data.visible.all() and not any("missing" in note for note in data.notes)


def test_normalised_arrays_are_noted(tmp_path):
    assert any("normalised" in note for note in load(tmp_path, W=views() / 640).notes)
    centred = views() - views().mean(2, keepdims=True)
    for arrays in (dict(W=views()), dict(W=centred / 640), dict(W=centred / 640, calibrated=True)):
        assert not any("normalised" in note for note in load(tmp_path, **arrays).notes)


def test_confidences_in_arrays_are_named_as_unused(tmp_path):
    for name in ("confidence", "score", "visibility"):
        data = load(tmp_path, W=views(), **{name: np.ones((len(views()), views().shape[2]))})
        assert any(note.startswith(f"{name} not used: save visible") for note in data.notes)
        assert data.sha256 == load(tmp_path, W=views()).sha256


def test_a_bag_of_lists_is_not_divided_by_guess(tmp_path):
    bag = write(tmp_path / "in.mcap", "pose_array", with_camera=False)
    with pytest.raises(DataError, match="34 keypoints in one list may be one body or several.*--layout"):
        load_training_data(bag)
    assert len(load_training_data(bag, load_layout("coco17")).W) == 2 * FRAMES
