# SPDX-License-Identifier: Apache-2.0
"""A stream with another model or layout continues the session: each thing that it remembers is still there."""

from __future__ import annotations

import foreign_messages as foreign
import numpy as np
import pytest
from conftest import CENTRE, FOCAL, RosMake, camera_info, header_of, persons_at, seen
from test_depth import depth_image

from msg_adapters import outputs
from paul_ros.stream.session import Session
from paul_ros.stream.stream import LiftStream, Outcome, open_stream

CLOUD = "sensor_msgs/msg/PointCloud2"
MAKE = RosMake()
PERSONS = persons_at((0.3, 0, 4), (-1, 0.1, 5))


@pytest.fixture
def stream(model_file) -> LiftStream:
    return open_stream(str(model_file))


@pytest.fixture
def swap(model_file):
    """swap(stream) -> the stream that the node continues with after another layout was set."""
    return lambda stream: open_stream(str(model_file), "coco17", stream.session)


def cloud(seconds: int = 7, frame: str = "camera_color_optical_frame", points: int = 17):
    header, xy = header_of(MAKE, seconds, frame=frame), seen(PERSONS)[:, :points]
    return outputs.keypoints_cloud(MAKE, header, xy, np.ones(xy.shape[:2]), ["1", "2"])


def test_the_model_and_the_layout_are_swapped(stream, swap):
    other = swap(stream)
    assert other.session is stream.session and other.lifter is not stream.lifter
    assert (stream.describe()["input_layout"], other.describe()["input_layout"]) == (None, "coco17")


def test_the_intrinsics_stay(stream, swap):
    stream.camera_info(camera_info(MAKE))
    other = swap(stream)
    assert other.units == "m" and other.keypoints(CLOUD, cloud()).frame.lifted.units == "m"
    assert other.intrinsics.fx == FOCAL and other.intrinsics.cx == CENTRE[0]


def test_the_image_size_stays(stream, swap, bag_make):
    """An uncalibrated camera has no intrinsics, but its size is enough for shares of the image."""
    stream.camera_info(camera_info(MAKE, fx=0.0))
    pose = dict(zip(stream.route.given.names, seen(PERSONS)[0]))
    other = swap(stream)
    answer = other.keypoints(foreign.HRI, foreign.hri(bag_make, header_of(bag_make), pose))
    assert answer.outcome is Outcome.KEPT and "no_image_size" not in other.ledger.drops


def test_the_reach_of_keypoints_outside_the_image_stays(stream, swap):
    stream.camera_info(camera_info(MAKE))
    for factor, streams in ((3, stream), (2, None)):
        xy = factor * seen(PERSONS)
        message = outputs.keypoints_cloud(MAKE, header_of(MAKE), xy, np.ones(xy.shape[:2]), ["1", "2"])
        (streams or swap(stream)).keypoints(CLOUD, message)
    assert stream.ledger.notes["outside_image"] == 2
    assert f"{3 * seen(PERSONS)[..., 0].max():.0f}x" in stream.ledger.advice["outside_image"]


def test_the_camera_frame_stays(stream, swap):
    stream.camera_info(camera_info(MAKE))
    other = swap(stream)
    other.keypoints(CLOUD, cloud(frame="left_camera_frame"))
    assert other.ledger.notes == {"another_frame": 1}


def test_the_frame_of_the_last_image_stays(stream, swap):
    """Two cameras on one topic are noted without a CameraInfo too; an image without a frame is of neither."""
    stream.keypoints(CLOUD, cloud(frame="left"))
    other = swap(stream)
    for frame in ("left", "", "left"):
        other.keypoints(CLOUD, cloud(frame=frame))
    assert other.ledger.notes == {"no_frame": 1}
    for frame in ("right", "left"):
        other.keypoints(CLOUD, cloud(frame=frame))
    assert other.ledger.notes["frame_changed"] == 2
    assert other.ledger.advice["frame_changed"].startswith("The keypoints' frame_id changed from 'right' to 'left'. ")


def test_the_depth_images_stay(stream, swap):
    stream.camera_info(camera_info(MAKE))
    stream.depth(depth_image(MAKE, np.full((480, 640), 3.0)))
    other = swap(stream)
    other.keypoints(CLOUD, cloud())
    assert other.ledger.notes == {"depth_used": 2}


def test_shared_ids_and_numbers_of_persons_stay(stream, swap):
    stream.keypoints(CLOUD, cloud_of(("5", "5"), 0))
    (number,) = stream.session.person_ids.numbers(("anna",))
    other = swap(stream)
    assert other.keypoints(CLOUD, cloud_of(("5", "6"), 33_000_000)).frame.keypoints.ids == ("", "6")
    assert other.session.person_ids.numbers(("ben", "anna"))[1] == number


def cloud_of(ids: tuple[str, ...], nanoseconds: int):
    xy = seen(PERSONS)
    return outputs.keypoints_cloud(MAKE, header_of(MAKE, 7, nanoseconds), xy, np.ones(xy.shape[:2]), ids)


def test_the_last_stamp_stays(stream, swap):
    stream.keypoints(CLOUD, cloud(seconds=9))
    other = swap(stream)
    other.keypoints(CLOUD, cloud(seconds=8))
    assert other.ledger.notes == {"stamp_backwards": 1}


def test_counts_drops_notes_advice_and_times_stay(stream, swap):
    stream.keypoints(CLOUD, cloud(seconds=9))
    stream.keypoints(CLOUD, cloud(seconds=8))
    stream.keypoints(CLOUD, cloud(points=5))
    other = swap(stream)
    other.keypoints(CLOUD, cloud(seconds=10))
    assert other.counts == dict(frames=3, persons=6, lifted=6)
    assert other.ledger.drops == {"wrong_point_count": 1} and other.ledger.notes == {"stamp_backwards": 1}
    assert "layout" in other.ledger.advice["wrong_point_count"]
    assert len(other.lift_us) == 3


def test_a_stream_without_a_session_begins_one(stream, model_file):
    stream.camera_info(camera_info(MAKE))
    stream.keypoints(CLOUD, cloud())
    fresh = open_stream(str(model_file))
    assert fresh.units == "model" and fresh.counts["frames"] == 0 and not fresh.lift_us


def test_a_swap_that_is_refused_changes_nothing(stream):
    stream.camera_info(camera_info(MAKE))
    before = {name: repr(value) for name, value in vars(stream.session).items()}
    with pytest.raises(ValueError, match="no_such_model"):
        open_stream("no_such_model", session=stream.session)
    assert {name: repr(value) for name, value in vars(stream.session).items()} == before


def test_all_that_a_session_remembers_is_tested_here():
    """A new attribute needs a test that a swap keeps it."""
    assert set(vars(Session())) == {
        "intrinsics", "image_size", "image", "camera_frame", "depths", "ledger", "counts", "lift_us", "person_ids",
        "_last_stamp", "_last_frame", "_camera_info", "_bounds",
    }  # fmt: skip
