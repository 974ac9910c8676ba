# SPDX-License-Identifier: Apache-2.0
"""LiftStream: good messages are lifted, bad ones counted and explained, and none stops the stream."""

from __future__ import annotations

import array
import contextlib
import logging
from dataclasses import replace

import foreign_messages as foreign
import numpy as np
import pytest
from conftest import PERSON, camera_info, header_of, persons_at, seen

from msg_adapters import outputs
from paul_ros.errors import LayoutError, ModelError, ParameterError
from paul_ros.layout import Layout, load_layout
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.stream import advice
from paul_ros.stream.messages import MessageBuilder
from paul_ros.stream.stream import LiftStream, Outcome, open_stream

CLOUD, POSES = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseArray"
GOOD = persons_at((0.3, 0, 4), (-1, 0.1, 5))


@pytest.fixture
def stream(model_file) -> LiftStream:
    model = load_model(model_file)
    return LiftStream(Lifter(model), model.layout, min_confidence=0.3, max_persons=64)


def cloud(make, xy: np.ndarray, confidence=None, ids=None, **stamp):
    confidence = np.ones(xy.shape[:2]) if confidence is None else confidence
    ids = [str(person + 1) for person in range(len(xy))] if ids is None else ids
    return outputs.keypoints_cloud(make, header_of(make, **stamp), xy, confidence, ids)


def assert_drops(stream: LiftStream, type_name: str, msg) -> None:
    """Assert that the message is dropped."""
    answer = stream.keypoints(type_name, msg)
    assert (answer.outcome, answer.frame) == (Outcome.DROPPED, None)


def assert_lifts(stream: LiftStream, make) -> None:
    """Assert that the stream still answers a good message."""
    answer = stream.keypoints(CLOUD, cloud(make, seen(GOOD)))
    assert answer.outcome is Outcome.LIFTED and answer.frame.lifted.ok.all()


def test_persons_in_metres_where_they_stand(stream, make):
    stream.camera_info(camera_info(make))
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    assert frame.lifted.units == "m" and frame.lifted.ok.all()
    # At these distances weak perspective leaves a few per cent of the size unexplained.
    assert np.linalg.norm(frame.lifted.points - GOOD, axis=-1).max() < 0.15
    assert stream.counts == dict(frames=1, persons=2, lifted=2) and not stream.ledger.drops
    assert len(stream.lift_us) == 1 and stream.lift_us[0] > 0


def test_units_follow_the_intrinsics(stream, make):
    assert stream.describe()["units"] == "model"
    assert stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame.lifted.units == "model"
    assert "CameraInfo" in stream.describe()["scale_source"]
    stream.camera_info(camera_info(make))
    assert stream.describe()["units"] == "m"
    stream.camera_info(camera_info(make, fx=0.0))
    assert stream.ledger.drops == {"bad_intrinsics": 1} and stream.describe()["units"] == "m"
    assert_lifts(stream, make)


def test_the_description_says_which_matrix_and_which_image_was_taken(stream, make):
    assert (stream.describe()["image"], stream.describe()["distortion"]) == (None, None)
    info = camera_info(make)
    info.p = np.array([590, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1.0, 0])
    info.d = array.array("d", [-0.3, 0.1, 0, 0, 0])
    stream.camera_info(info)
    described = stream.describe()
    assert "CameraInfo's P" in described["scale_source"] and "the rectified image" in described["scale_source"]
    assert (described["image"], described["distortion"]) == ("rectified", "none")
    # It is used all the same, so it is a note and not a drop.
    assert stream.ledger.notes == {"image_assumed": 1} and not stream.ledger.drops and stream.units == "m"
    info.p = np.zeros(12)
    stream.camera_info(info)
    described = stream.describe()
    assert "CameraInfo's K" in described["scale_source"]
    assert "the raw image; its distortion: plumb_bob, corrected" in described["scale_source"]
    assert (described["image"], described["distortion"]) == ("raw", "plumb_bob, corrected")


@pytest.mark.parametrize("kind", ["live", "bag"])
def test_zed_bodies_are_in_the_optical_frame_of_camera_info(stream, bag_make, kind):
    """Their header names the camera's own frame, x forward; lifted persons would lie on their side in it."""
    foreign_make = foreign.LiveMake() if kind == "live" else bag_make
    header = header_of(foreign_make, frame="zed_left_camera_frame")
    pose = dict(zip(stream.route.given.names, seen(persons_at((0, 0, 4)))[0].tolist()))
    msg = foreign.zed(foreign_make, header, [pose], 0)
    frames = [stream.keypoints(foreign.ZED, msg).frame]
    stream.camera_info(camera_info(bag_make))
    frames.append(stream.keypoints(foreign.ZED, msg).frame)
    assert [frame.header.frame_id for frame in frames] == ["", "camera_color_optical_frame"]
    assert frames[1].header.stamp == header.stamp
    assert frames[1].lifted.ok.all() and header.frame_id == "zed_left_camera_frame"
    assert stream.ledger.notes == {"no_frame": 1}


def test_keypoints_of_another_frame_than_the_cameras_are_noted(stream, make):
    """In a frame that is not optical they would lie on their side. A CameraInfo without a frame decides nothing."""
    elsewhere = cloud(make, seen(persons_at((0, 0, 4))), frame="left_camera_frame")
    nameless = camera_info(make)
    nameless.header.frame_id = ""
    stream.camera_info(nameless)
    stream.keypoints(CLOUD, elsewhere)
    assert not stream.ledger.notes
    stream.camera_info(camera_info(make))
    stream.keypoints(CLOUD, cloud(make, seen(persons_at((0, 0, 4)))))
    assert not stream.ledger.notes
    assert stream.keypoints(CLOUD, elsewhere).frame.lifted.ok.all() and stream.ledger.notes["another_frame"] == 1
    assert "'left_camera_frame', CameraInfo's 'camera_color" in stream.ledger.advice["another_frame"]


def test_persons_that_hardly_fit_the_model_are_noted(stream, make, monkeypatch):
    lift = stream.lifter.lift_in_model_layout
    monkeypatch.setattr(
        stream.lifter, "lift_in_model_layout", lambda *given: replace(lift(*given), unexplained=np.array([0.49, 0.51]))
    )
    stream.keypoints(CLOUD, cloud(make, seen(GOOD)))
    assert stream.ledger.notes == {"unlike_the_model": 1}
    assert (
        "'stand'" in stream.ledger.advice["unlike_the_model"] and "`layout`" in stream.ledger.advice["unlike_the_model"]
    )


def test_persons_far_away_are_left_out_and_explained(stream, make):
    stream.camera_info(camera_info(make))
    stream.keypoints(CLOUD, cloud(make, seen(persons_at((0, 0, 4), (0, 0, 250), (0, 0, 2000)))))
    assert stream.ledger.drops == {"person_too_far": 1, "person_degenerate_points": 1}
    assert "200 m" in stream.ledger.advice["person_too_far"]
    assert "left out" in stream.ledger.advice["person_degenerate_points"]


def test_model_without_metres_stays_in_model_units(model_file, make):
    model = load_model(model_file)
    model.header["metres_per_unit"] = None
    stream = LiftStream(Lifter(model), model.layout, 0.3, 64)
    stream.camera_info(camera_info(make))
    assert stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame.lifted.units == "model"
    assert "size in metres" in stream.describe()["scale_source"]


def test_description_says_what_the_outputs_mean(stream, model_file):
    described = stream.describe()
    model = load_model(model_file)
    assert described["keypoints"] == list(load_layout("coco17").names)
    assert (described["layout"], described["model"]) == ("coco17", "stand")
    assert described["model_sha256"] == model.sha256
    assert described["metres_per_unit"] == model.metres_per_unit and described["chirality"]["known"] is True


def test_description_says_whose_axes_the_points_have(stream, make):
    assert "line of sight to each person" in stream.describe()["frame"]
    stream.camera_info(camera_info(make))
    assert "optical frame of the camera (REP-103)" in stream.describe()["frame"]


def test_low_confidence_hides_a_point_at_once_when_changed(stream, make):
    message = cloud(make, seen(GOOD), np.full((2, 17), 0.2))
    assert not stream.keypoints(CLOUD, message).frame.lifted.ok.any()
    stream.min_confidence = 0.1
    assert stream.keypoints(CLOUD, message).frame.lifted.ok.all()


def test_another_layout_is_mapped_by_name(model_file, make):
    model = load_model(model_file)
    names = model.layout.names[::-1]
    reversed_layout = Layout.from_dict({"name": "reversed", "names": list(names), "root": ["nose"]})
    stream = LiftStream(Lifter(model), reversed_layout, 0.3, 64)
    straight = LiftStream(Lifter(model), model.layout, 0.3, 64)
    xy = seen(GOOD)
    np.testing.assert_array_equal(
        stream.keypoints(CLOUD, cloud(make, xy[:, ::-1])).frame.lifted.points[:, ::-1],
        straight.keypoints(CLOUD, cloud(make, xy)).frame.lifted.points,
    )


def test_a_layout_that_does_not_fit_is_refused_at_the_start(model_file):
    model = load_model(model_file)
    other = Layout.from_dict({"name": "door", "names": ["a", "b", "c", "d"], "root": ["a"]})
    with pytest.raises(LayoutError):
        LiftStream(Lifter(model), other, 0.3, 64)


def test_persons_that_cannot_be_lifted_are_left_out_and_counted(stream, make):
    xy = seen(persons_at((0, 0, 4), (1, 0, 4), (-1, 0, 4)))
    xy[1, 2:] = np.nan
    frame = stream.keypoints(CLOUD, cloud(make, xy, ids=["1", "2", "3"])).frame
    messages = MessageBuilder(make).messages(frame)
    assert len(messages["poses"].poses) == 34 and messages["keypoints3d"].height == 2
    ids = np.frombuffer(messages["keypoints3d"].data, "<f4").reshape(2, 17, 8)[:, 0, 5]
    np.testing.assert_array_equal(ids, [1, 3])
    assert stream.ledger.drops == {"person_too_few_points": 1}
    assert stream.counts == dict(frames=1, persons=3, lifted=2)


def test_nan_everywhere_is_a_frame_of_nobody_lifted(stream, make):
    frame = stream.keypoints(CLOUD, cloud(make, np.full((2, 17, 2), np.nan))).frame
    assert len(MessageBuilder(make).messages(frame)["poses"].poses) == 0
    assert stream.ledger.drops == {"person_too_few_points": 2}
    assert_lifts(stream, make)


def test_zero_persons_are_a_frame(stream, make):
    messages = MessageBuilder(make).messages(stream.keypoints(CLOUD, cloud(make, np.empty((0, 17, 2)))).frame)
    assert len(messages["poses"].poses) == 0 and messages["keypoints3d"].height == 0
    assert stream.counts["frames"] == 1 and not stream.ledger.drops and not stream.lift_us


def test_too_many_persons_are_dropped(stream, make):
    assert_drops(stream, CLOUD, cloud(make, np.ones((10_000, 17, 2))))
    assert stream.ledger.drops == {"too_many_persons": 1}
    assert "max_persons" in stream.ledger.advice["too_many_persons"]
    assert_lifts(stream, make)


def test_a_wrong_number_of_points_names_the_layouts_that_fit(stream, make):
    assert_drops(stream, CLOUD, cloud(make, np.ones((2, 25, 2))))
    explanation = stream.ledger.advice["wrong_point_count"]
    assert "body25" in explanation and "h36m17" not in explanation and "`layout`" in explanation
    assert_drops(stream, CLOUD, cloud(make, np.ones((2, 29, 2))))
    explanation = stream.ledger.advice["wrong_point_count"]
    assert "29" in explanation and "path" in explanation
    assert stream.ledger.drops == {"wrong_point_count": 2}
    assert_lifts(stream, make)


@pytest.mark.parametrize("points", [34, 36, 51, 68, 136])
@pytest.mark.parametrize("type_name", [POSES, CLOUD])
def test_a_list_of_several_bodies_or_one_is_refused_until_the_layout_is_known(model_file, make, type_name, points):
    """Two persons of 17 points, or one of 34: nobody can tell, and a message of one person or `layout` says it."""

    def message(count: int):
        xy = np.resize(seen(GOOD), (1, count, 2)) + np.arange(count)[:, None]
        if type_name == CLOUD:
            return cloud(make, xy)
        return outputs.pose_array(make, header_of(make), np.dstack([xy, np.ones((1, count))]))

    for model in ("human", str(model_file)):
        stream = open_stream(model)
        assert_drops(stream, type_name, message(points))
        assert stream.ledger.drops == {"layout_unknown": 1} and stream.describe()["input_layout"] is None
        explanation = stream.ledger.advice["layout_unknown"]
        own = "openpose18" if points == 36 else "coco17"
        assert f"{points} keypoints" in explanation and own in explanation and "`layout`" in explanation
    assert open_stream("human", own).keypoints(type_name, message(points)).frame.keypoints.persons == points // (
        18 if points == 36 else 17
    )
    stream.keypoints(type_name, message(17))
    assert stream.describe()["input_layout"] == "coco17" and stream.counts["persons"] == 1
    if points % 17 == 0:
        assert stream.keypoints(type_name, message(points)).frame.keypoints.persons == points // 17


@pytest.mark.parametrize(
    "points, found",
    [(16, "mpii16"), (17, "coco17"), (18, "openpose18"), (19, "drobotics19"), (23, "wholebody23"), (25, "body25"),
     (26, "halpe26"), (31, "cmu31"), (32, "kinect32"), (33, "mediapipe33"), (34, "zed34"), (38, "zed38"),
     (43, "human"), (133, "wholebody133")],
)  # fmt: skip
def test_rows_of_persons_find_the_layout_by_their_number(make, points, found):
    stream = open_stream("human")
    xy = np.random.default_rng(0).uniform(50, 400, (2, points, 2))
    assert stream.keypoints(CLOUD, cloud(make, xy)).frame.keypoints.persons == 2
    assert stream.describe()["input_layout"] == found


def test_d_robotics_default_of_19_points_is_found(bag_make):
    stream, xy = open_stream("human"), seen(GOOD)[0].tolist()
    target = foreign.ai_target(bag_make, 3, body_kps=([*xy, (300, 100), (300, 60)], [0.9] * 19))
    frame = stream.keypoints(foreign.AI, foreign.ai(bag_make, header_of(bag_make), [target])).frame
    assert frame.lifted.ok.all() and stream.describe()["input_layout"] == "drobotics19"


def test_notes_of_a_message_are_counted(stream, make):
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD), np.full((2, 17), 87.0))).frame
    assert frame.lifted.ok.all() and stream.ledger.notes == {"confidence_range": 1}
    assert "divide percentages by 100" in stream.ledger.advice["confidence_range"]


def test_normalised_keypoints_are_dropped(stream, make):
    assert_drops(stream, CLOUD, cloud(make, seen(GOOD) / (640, 480)))
    assert stream.ledger.drops == {"normalised": 1} and "image's width" in stream.ledger.advice["normalised"]
    assert_lifts(stream, make)


@pytest.mark.parametrize("own, taken", [("h36m17", "coco17"), ("hri18", "openpose18"), ("coco17", "h36m17")])
def test_a_wrong_guess_among_layouts_of_one_size_is_noted(make, own, taken):
    """The numbers of points are equal; the poses then are none that the model has."""
    human = load_model("human")
    points = human.mean_shape.T * 0.4 + (0.1, 0, 4)
    pixels = points[:, :2] / points[:, 2:] * 600 + 320
    xy = human.layout.map_to(load_layout(own)).values(pixels[None])
    stream = open_stream("human", taken)
    stream.keypoints(CLOUD, cloud(make, xy))
    right = open_stream("human", own)
    right.keypoints(CLOUD, cloud(make, xy))
    assert not right.ledger.notes
    # Swapped eyes and ears alone are too little to tell.
    assert bool(stream.ledger.notes) == (own != "hri18") or stream.ledger.drops


def test_only_layouts_that_map_onto_the_model_are_proposed(model_file, make):
    """Shipped layouts of persons have 17 points, but no point in common with a walker."""
    model = load_model(model_file)
    walker = Layout.from_dict({"name": "walker", "names": [f"w{n}" for n in range(17)], "root": ["w0"]})
    half = Layout.from_dict({"name": "half", "names": [f"w{n}" for n in range(8)], "root": ["w0"]})
    stream = LiftStream(Lifter(replace(model, layout=walker)), half, 0.3, 64)
    assert_drops(stream, CLOUD, cloud(make, np.ones((1, 17, 2))))
    assert stream.ledger.advice["wrong_point_count"] == (
        "17 keypoints are not a multiple of the layout's 8. Set `layout` to the one your detector "
        "uses: walker (the model's own, by the path of its file), or the path of your own."
    )
    assert_drops(stream, CLOUD, cloud(make, np.ones((1, 25, 2))))
    assert stream.ledger.advice["wrong_point_count"].endswith(
        "the layout's 8. No shipped layout that the model can use has that many: set `layout` to the path of your own."
    )


@pytest.mark.parametrize(
    "text, expected",
    [
        ("a body has 3 keypoints", "A body has 3 keypoints."),
        ("row_step 1 is too low; set 2", "row_step 1 is too low; set 2."),
        ("CameraInfo is odd.", "CameraInfo is odd."),
        ("3 keypoints", "3 keypoints."),
        ("", "."),
    ],
)
def test_errors_become_sentences(text, expected):
    assert advice.sentence(text) == expected


def test_stamps_going_backwards_are_used_and_noted(stream, make):
    for seconds in (5, 6, 3, 4):
        assert stream.keypoints(CLOUD, cloud(make, seen(GOOD), seconds=seconds)).frame is not None
    assert stream.ledger.notes == {"stamp_backwards": 1} and not stream.ledger.drops


def test_answers_say_what_became_of_a_message(stream, bag_make):
    """One person per message: kept, then lifted with the first message of the next image."""
    pose = dict(zip(stream.route.given.names, seen(GOOD)[0].tolist()))

    def send(ident: int, seconds: int):
        return stream.keypoints(foreign.OPENDR, foreign.opendr(bag_make, header_of(bag_make, seconds), pose, ident))

    kept = [send(1, 1), send(2, 1)]
    assert [(answer.outcome, answer.frame) for answer in kept] == 2 * [(Outcome.KEPT, None)]
    completed = send(1, 2)
    assert completed.outcome is Outcome.COMPLETED and completed.frame.keypoints.ids == ("1", "2")
    stream.max_persons = 1
    assert send(2, 2).outcome is Outcome.DROPPED and stream.ledger.drops == {"too_many_persons": 1}
    assert stream.flush().keypoints.ids == ("1",) and stream.flush() is None


def test_a_fault_in_lifting_is_counted_and_its_traceback_logged_once(stream, make, monkeypatch, caplog):
    def fails(*_):
        raise ZeroDivisionError("on purpose")

    monkeypatch.setattr(stream.lifter, "lift_in_model_layout", fails)
    with caplog.at_level(logging.ERROR):
        for _ in range(3):
            assert_drops(stream, CLOUD, cloud(make, seen(GOOD)))
    assert stream.ledger.drops == {"internal_error": 3} and "on purpose" in stream.ledger.advice["internal_error"]
    assert len(caplog.records) == 1 and "on purpose" in caplog.text
    monkeypatch.undo()
    assert_lifts(stream, make)


def test_the_same_messages_give_the_same_bits(model_file, make):
    def run():
        model = load_model(model_file)
        stream = LiftStream(Lifter(model), model.layout, 0.3, 64)
        stream.camera_info(camera_info(make))
        return stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame.lifted.points

    np.testing.assert_array_equal(run(), run())


# --- layouts


def superset_model(model_file, tmp_path):
    """Return a model of all points of COCO-17, BODY_25 and one more; it always has the fixture's shape."""
    from paul_ros.model_file import save_model, weight_shapes
    from paul_ros.normalisation import to_unit_size

    coco, body = load_layout("coco17"), load_layout("body25")
    names = [*coco.names, *(name for name in body.names if name not in coco.names), "head_top"]
    place = {name: point for name, point in zip(coco.names, PERSON)}
    place |= {"neck": PERSON[5:7].mean(0), "pelvis": PERSON[11:13].mean(0), "head_top": PERSON[0] - (0, 0.2, -0.1)}
    for side in ("left", "right"):
        ankle = place[f"{side}_ankle"]
        place |= {f"{side}_{part}": ankle + (0, 0.05, -0.1) for part in ("heel", "big_toe", "small_toe")}
    data = {**coco.to_dict(), "name": "both", "names": names, "root": ["pelvis"], "derived": {}}
    layout = Layout.from_dict(data)
    model = load_model(model_file)
    points = np.array([place[name] for name in names])
    start, end = np.array(layout.edges).T
    metres = float(np.linalg.norm(points[start] - points[end], axis=1).mean())
    header = {**model.header, "layout": layout.to_dict(), "metres_per_unit": metres}
    arrays = {name: np.zeros(size) for name, size in weight_shapes(header, len(names)).items()}
    arrays["mean_shape"] = to_unit_size(points.T[None], layout)[0]
    arrays["decoder.1.bias"] = arrays["mean_shape"].ravel()
    save_model(tmp_path / "both.npz", header, arrays)
    return load_model(tmp_path / "both.npz"), place


@pytest.fixture
def both(model_file, tmp_path):
    return superset_model(model_file, tmp_path)


def finding(model, **given) -> LiftStream:
    """Return a stream that has to find the input's layout."""
    return LiftStream(Lifter(model), None, 0.3, 64, **given)


@pytest.mark.parametrize("name", ["coco17", "openpose18", "body25"])
@pytest.mark.parametrize("persons", [1, 3])
def test_one_model_serves_every_layout_by_the_number_of_its_points(both, make, name, persons):
    model, place = both
    points = np.array([place[part] for part in load_layout(name).names])
    truth = points + np.array([(0.6 * person - 0.5, 0, 5) for person in range(persons)])[:, None]
    stream = finding(model)
    stream.camera_info(camera_info(make))
    for message in (cloud(make, seen(truth)), flat(make, seen(truth))):
        frame = stream.keypoints(message_type(message), message).frame
        assert stream.route.given.name == stream.describe()["layout"] == frame.layout.name == name
        np.testing.assert_allclose(frame.lifted.points, truth, atol=0.12)
        messages = MessageBuilder(make).messages(frame)
        assert len(messages["poses"].poses) == persons * len(points)
        assert messages["keypoints3d"].width == len(points)
        assert len(messages["markers"].markers[1].points) == persons * len(points)


def flat(make, xy: np.ndarray):
    return outputs.pose_array(make, header_of(make), np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1))


def message_type(message) -> str:
    return "geometry_msgs/msg/PoseArray" if hasattr(message, "poses") else CLOUD


def test_the_models_own_layout_goes_before_a_shipped_one_of_as_many_points(model_file, make):
    """A model of another object with 17 points: they are not taken for a person's."""
    model = load_model(model_file)
    door = Layout.from_dict({"name": "door", "names": [f"d{n}" for n in range(17)], "root": ["d0"]})
    stream = finding(replace(model, layout=door))
    assert stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame.layout.name == "door"
    assert_drops(stream, CLOUD, cloud(make, np.ones((1, 25, 2))))
    assert stream.ledger.drops == {"wrong_point_count": 1}


def test_a_layout_once_found_is_kept(both, make):
    stream = finding(both[0])
    assert stream.describe()["input_layout"] is None
    assert stream.keypoints(CLOUD, cloud(make, np.empty((0, 25, 2)))).frame.lifted.ok.shape == (0,)
    assert stream.keypoints(CLOUD, cloud(make, np.full((1, 18, 2), np.nan))).frame.lifted.reason == ("too_few_points",)
    assert stream.describe()["input_layout"] is None
    assert_lifts(stream, make)
    assert stream.describe()["input_layout"] == "coco17"
    assert_drops(stream, CLOUD, cloud(make, np.ones((1, 25, 2))))
    assert "body25" in stream.ledger.advice["wrong_point_count"]


@pytest.mark.parametrize("output, points", [("model", 26), ("openpose18", 18), ("coco17", 17), (None, 17)])
def test_what_is_published_may_be_another_layout(both, make, output, points):
    model, place = both
    layout = model.layout if output == "model" else load_layout(output) if output else None
    stream = finding(model, output_layout=layout)
    stream.camera_info(camera_info(make))
    hidden = np.ones((2, 17))
    hidden[:, 9] = 0.1
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD), hidden)).frame
    names = stream.describe()["keypoints"]
    assert frame.lifted.points.shape == (2, points, 3) and len(names) == points
    expected = np.array([place[name] for name in names]) + (0.3, 0, 4)
    np.testing.assert_allclose(frame.lifted.points[0], expected, atol=0.12)
    seen_names = {name for name, visible in zip(names, frame.keypoints.visible[0]) if visible}
    assert seen_names == set(load_layout("coco17").names) & set(names) - {"left_wrist"} | {
        name for name in ("neck", "pelvis") if name in names
    }


def test_points_that_the_model_lacks_are_never_published(stream, model_file, make):
    """BODY_25 into a model of 17 points gives the model's points; asking for BODY_25 is refused."""
    own = LiftStream(stream.lifter, load_layout("body25"), 0.3, 64)
    assert own.route.output.name == "coco17"
    with pytest.raises(LayoutError, match="has no left_big_toe.*'model'"):
        LiftStream(stream.lifter, None, 0.3, 64, output_layout=load_layout("body25"))


def test_open_stream_takes_the_nodes_parameters(model_file):
    stream = open_stream(str(model_file), max_persons=3, output_layout="openpose18")
    assert (stream.max_persons, stream.min_confidence, stream.route.output.name) == (3, 0.3, "openpose18")
    assert open_stream(str(model_file), output_layout="model").route.output.name == "coco17"
    with pytest.raises(LayoutError, match="coco17"):
        open_stream(str(model_file), output_layout="coco71")


# --- metres


def test_the_height_of_people_scales_the_metres_at_once(stream, make):
    stream.camera_info(camera_info(make))
    adults = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    assert stream.describe()["person_height"] == 1.7 and stream.describe()["size_spread"] == 0.06
    stream.person_height = 0.85
    children = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    np.testing.assert_allclose(children.lifted.points, 0.5 * adults.lifted.points)
    assert stream.describe()["person_height"] == 0.85 and stream.describe()["size_spread"] == 0
    np.testing.assert_allclose(children.bone_width, 0.5 * adults.bone_width)


def test_a_height_that_the_model_cannot_have_is_refused(model_file):
    model = load_model(model_file)
    del model.header["stature"]
    with pytest.raises(ModelError, match="does not tell the stature"):
        Lifter(model, person_height=1.2)
    lifter = Lifter(model)
    assert lifter.size_spread == 0
    with pytest.raises(ModelError):
        lifter.person_height = 1.2
    assert lifter.person_height == 0 and lifter.metres_per_unit == model.metres_per_unit


@pytest.mark.parametrize(
    "name, advice", [("smothing", "did you mean 'smoothing'"), ("zzz", "known are .*person_height")]
)
def test_unknown_parameters_are_refused(model_file, name, advice):
    with pytest.raises(ParameterError, match=f"no parameter '{name}'; {advice}"):
        open_stream(str(model_file), **{name: 5})


def test_parameters_out_of_their_limits_are_refused(model_file):
    with pytest.raises(ParameterError, match="`person_height` is -1.0.*0 or 0.3 to 3.0"):
        open_stream(str(model_file), person_height=-1.0)
    with pytest.raises(ParameterError, match="`smoothing` is '5'; it must be 0.0 to 100.0"):
        open_stream(str(model_file), smoothing="5")


@pytest.mark.parametrize("height, taken", [(0.0, True), (0.3, True), (3.0, True), (1e-9, False), (0.29, False)])
def test_the_height_of_nobody_is_refused_at_any_time(stream, height, taken):
    with contextlib.nullcontext() if taken else pytest.raises(ParameterError, match="0 or 0.3 to 3.0"):
        stream.person_height = height
    assert stream.person_height == (height if taken else 0.0)


def test_smoothing_is_off_until_it_is_set(stream, make):
    def answers(cutoff):
        stream.smoothing = cutoff
        frames = []
        for nanoseconds in range(0, 10**9, 10**8):
            xy = seen(GOOD) + np.random.default_rng(nanoseconds).normal(0, 3, (2, 17, 2))
            frames.append(stream.keypoints(CLOUD, cloud(make, xy, nanoseconds=nanoseconds)).frame)
        return np.array([frame.lifted.points for frame in frames]), frames

    stream.camera_info(camera_info(make))
    assert stream.smoothing == stream.describe()["smoothing_hz"] == 0
    raw, _ = answers(0.0)
    smooth, frames = answers(0.5)
    assert np.diff(smooth, 2, axis=0).std() < 0.6 * np.diff(raw, 2, axis=0).std()
    assert stream.describe()["smoothing_hz"] == 0.5
    # Roots follow the filtered points.
    np.testing.assert_allclose(frames[-1].lifted.root, smooth[-1][:, [11, 12]].mean(1))
    np.testing.assert_array_equal(answers(0.0)[0], raw)
