# SPDX-License-Identifier: Apache-2.0
"""LiftStream: good messages are lifted, bad ones counted and explained, and none stops the stream."""

from __future__ import annotations

import array
import logging
from dataclasses import replace

import numpy as np
import pytest
from conftest import camera_info, header_of, persons_at, seen

from msg_adapters import outputs
from paul_ros.lifter import Lifter
from paul_ros.model import load_model
from paul_ros.skeleton import Layout, LayoutError, load_layout
from paul_ros.stream import OUTPUTS, LiftStream

CLOUD = "sensor_msgs/msg/PointCloud2"
GOOD = persons_at((0.3, 0, 4), (-1, 0.1, 5))


@pytest.fixture
def stream(model_file) -> LiftStream:
    model = load_model(model_file)
    return LiftStream(Lifter(model), model.layout, min_confidence=0.3, max_persons=64)


def cloud(make, xy: np.ndarray, confidence=None, ids=None, **stamp):
    confidence = np.ones(xy.shape[:2]) if confidence is None else confidence
    ids = [str(person + 1) for person in range(len(xy))] if ids is None else ids
    return outputs.keypoints_cloud(make, header_of(make, **stamp), xy, confidence, ids)


def assert_lifts(stream: LiftStream, make) -> None:
    """The stream still answers a good message."""
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD)))
    assert frame is not None and frame.lifted.ok.all()


def test_persons_in_metres_where_they_stand(stream, make):
    stream.camera_info(camera_info(make))
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD)))
    assert frame.lifted.units == "m" and frame.lifted.ok.all()
    # Weak perspective leaves some per cent of the size unexplained at these distances.
    assert np.linalg.norm(frame.lifted.points - GOOD, axis=-1).max() < 0.15
    assert stream.counts == dict(frames=1, persons=2, lifted=2) and not stream.drops
    assert len(stream.lift_us) == 1 and stream.lift_us[0] > 0


def test_units_follow_the_intrinsics(stream, make):
    assert stream.describe()["units"] == "model"
    assert stream.keypoints(CLOUD, cloud(make, seen(GOOD))).lifted.units == "model"
    assert "CameraInfo" in stream.describe()["scale_source"]
    stream.camera_info(camera_info(make))
    assert stream.describe()["units"] == "m"
    stream.camera_info(camera_info(make, fx=0.0))
    assert stream.drops == {"bad_intrinsics": 1} and stream.describe()["units"] == "m"
    assert_lifts(stream, make)


def test_the_description_says_which_matrix_of_camera_info_was_used(stream, make):
    info = camera_info(make)
    info.p = np.array([600, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1.0, 0])
    info.d = array.array("d", [-0.3, 0.1, 0, 0, 0])
    stream.camera_info(info)
    assert "CameraInfo's P" in stream.describe()["scale_source"] and not stream.notes
    info.p = np.zeros(12)
    stream.camera_info(info)
    assert "CameraInfo's K" in stream.describe()["scale_source"]
    assert "distortion is not corrected" in stream.describe()["scale_source"]
    # Used all the same: it is a note, not a drop.
    assert stream.notes == {"distorted_image": 1} and not stream.drops and stream.units == "m"
    assert "rectify" in stream.explanations["distorted_image"]


def test_persons_far_away_are_left_out_and_explained(stream, make):
    stream.camera_info(camera_info(make))
    stream.keypoints(CLOUD, cloud(make, seen(persons_at((0, 0, 4), (0, 0, 250), (0, 0, 2000)))))
    assert stream.drops == {"person_too_far": 1, "person_degenerate_points": 1}
    assert "200 m" in stream.explanations["person_too_far"]
    assert "left out" in stream.explanations["person_degenerate_points"]


def test_model_without_metres_stays_in_model_units(model_file, make):
    model = load_model(model_file)
    model.header["metres_per_unit"] = None
    stream = LiftStream(Lifter(model), model.layout, 0.3, 64)
    stream.camera_info(camera_info(make))
    assert stream.keypoints(CLOUD, cloud(make, seen(GOOD))).lifted.units == "model"
    assert "size in metres" in stream.describe()["scale_source"]


def test_description_says_what_the_outputs_mean(stream, model_file):
    described = stream.describe()
    model = load_model(model_file)
    assert described["keypoints"] == list(load_layout("coco17").names)
    assert (described["layout"], described["model"]) == ("coco17", "stand")
    assert described["model_sha256"] == model.sha256
    assert described["metres_per_unit"] == model.metres_per_unit and described["chirality"]["known"] is True


def test_messages_of_a_frame(stream, make, bag_make):
    stream.camera_info(camera_info(make))
    confidence = np.full((2, 17), 0.75)
    confidence[1, 9] = 0.1
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD), confidence, ["5", "anna"]))
    messages = frame.messages(make)
    assert set(messages) == set(OUTPUTS)
    if make is bag_make:
        messages = {name: make.through_cdr(message) for name, message in messages.items()}
    poses, points, markers = messages["poses"], messages["keypoints3d"], messages["markers"]
    for header in (poses.header, points.header, markers.markers[0].header, markers.markers[1].header):
        assert (header.stamp.sec, header.stamp.nanosec) == (7, 5)
        assert header.frame_id == "camera_color_optical_frame"
    xyz = np.array([(p.position.x, p.position.y, p.position.z) for p in poses.poses]).reshape(2, 17, 3)
    np.testing.assert_array_equal(xyz, frame.lifted.points)
    data = np.frombuffer(points.data, "<f4").reshape(2, 17, 6)
    np.testing.assert_allclose(data[..., :3], frame.lifted.points, rtol=1e-6)
    np.testing.assert_array_equal(data[..., 3], np.where(confidence > 0.3, 0.75, 0))
    np.testing.assert_array_equal(data[:, 0, 5], [5, 1])
    assert 0.005 < markers.markers[0].scale.x < 0.05


def test_low_confidence_hides_a_point_at_once_when_changed(stream, make):
    message = cloud(make, seen(GOOD), np.full((2, 17), 0.2))
    assert not stream.keypoints(CLOUD, message).lifted.ok.any()
    stream.min_confidence = 0.1
    assert stream.keypoints(CLOUD, message).lifted.ok.all()


def test_another_layout_is_mapped_by_name(model_file, make):
    model = load_model(model_file)
    names = model.layout.names[::-1]
    reversed_layout = Layout.from_dict({"name": "reversed", "names": list(names), "root": ["nose"]})
    stream = LiftStream(Lifter(model), reversed_layout, 0.3, 64)
    straight = LiftStream(Lifter(model), model.layout, 0.3, 64)
    xy = seen(GOOD)
    np.testing.assert_array_equal(
        stream.keypoints(CLOUD, cloud(make, xy[:, ::-1])).lifted.points,
        straight.keypoints(CLOUD, cloud(make, xy)).lifted.points,
    )


def test_a_layout_that_does_not_fit_is_refused_at_the_start(model_file):
    model = load_model(model_file)
    other = Layout.from_dict({"name": "door", "names": ["a", "b", "c", "d"], "root": ["a"]})
    with pytest.raises(LayoutError):
        LiftStream(Lifter(model), other, 0.3, 64)


def test_persons_that_cannot_be_lifted_are_left_out_and_counted(stream, make):
    xy = seen(persons_at((0, 0, 4), (1, 0, 4), (-1, 0, 4)))
    xy[1, 2:] = np.nan
    frame = stream.keypoints(CLOUD, cloud(make, xy, ids=["1", "2", "3"]))
    messages = frame.messages(make)
    assert len(messages["poses"].poses) == 34 and messages["keypoints3d"].height == 2
    ids = np.frombuffer(messages["keypoints3d"].data, "<f4").reshape(2, 17, 6)[:, 0, 5]
    np.testing.assert_array_equal(ids, [1, 3])
    assert stream.drops == {"person_too_few_points": 1}
    assert stream.counts == dict(frames=1, persons=3, lifted=2)


def test_an_id_of_thousands_of_digits_is_its_row(stream, make):
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD)))
    frame = replace(frame, keypoints=replace(frame.keypoints, ids=("7", "1" * 5000)))
    ids = np.frombuffer(frame.message("keypoints3d", make).data, "<f4").reshape(2, 17, 6)[:, 0, 5]
    np.testing.assert_array_equal(ids, [7, 1])


def test_nan_everywhere_is_a_frame_of_nobody_lifted(stream, make):
    frame = stream.keypoints(CLOUD, cloud(make, np.full((2, 17, 2), np.nan)))
    assert len(frame.messages(make)["poses"].poses) == 0
    assert stream.drops == {"person_too_few_points": 2}
    assert_lifts(stream, make)


def test_zero_persons_are_a_frame(stream, make):
    messages = stream.keypoints(CLOUD, cloud(make, np.empty((0, 17, 2)))).messages(make)
    assert len(messages["poses"].poses) == 0 and messages["keypoints3d"].height == 0
    assert stream.counts["frames"] == 1 and not stream.drops and not stream.lift_us


def test_too_many_persons_are_dropped(stream, make):
    assert stream.keypoints(CLOUD, cloud(make, np.ones((10_000, 17, 2)))) is None
    assert stream.drops == {"too_many_persons": 1}
    assert "max_persons" in stream.explanations["too_many_persons"]
    assert_lifts(stream, make)


def test_a_wrong_number_of_points_names_the_layouts_that_fit(stream, make):
    assert stream.keypoints(CLOUD, cloud(make, np.ones((2, 25, 2)))) is None
    explanation = stream.explanations["wrong_point_count"]
    assert "body25" in explanation and "h36m17" not in explanation and "`layout`" in explanation
    assert stream.keypoints(CLOUD, cloud(make, np.ones((2, 23, 2)))) is None
    explanation = stream.explanations["wrong_point_count"]
    assert "23" in explanation and "path" in explanation
    assert stream.drops == {"wrong_point_count": 2}
    assert_lifts(stream, make)


def test_stamps_going_backwards_are_used_and_noted(stream, make):
    for seconds in (5, 6, 3, 4):
        assert stream.keypoints(CLOUD, cloud(make, seen(GOOD), seconds=seconds)) is not None
    assert stream.notes == {"stamp_backwards": 1} and not stream.drops


def test_a_fault_in_lifting_is_counted_and_its_traceback_logged_once(stream, make, monkeypatch, caplog):
    def fails(*_):
        raise ZeroDivisionError("on purpose")

    monkeypatch.setattr(stream.lifter, "lift", fails)
    with caplog.at_level(logging.ERROR):
        for _ in range(3):
            assert stream.keypoints(CLOUD, cloud(make, seen(GOOD))) is None
    assert stream.drops == {"internal_error": 3} and "on purpose" in stream.explanations["internal_error"]
    assert len(caplog.records) == 1 and "on purpose" in caplog.text
    monkeypatch.undo()
    assert_lifts(stream, make)


def test_the_same_messages_give_the_same_bits(model_file, make):
    def run():
        model = load_model(model_file)
        stream = LiftStream(Lifter(model), model.layout, 0.3, 64)
        stream.camera_info(camera_info(make))
        return stream.keypoints(CLOUD, cloud(make, seen(GOOD))).lifted.points

    np.testing.assert_array_equal(run(), run())
