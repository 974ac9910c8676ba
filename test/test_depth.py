# SPDX-License-Identifier: Apache-2.0
"""Depth images place persons if they show the root's distance; otherwise they are ignored with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import CENTRE, FOCAL, camera_info, header_of, persons_at, seen

from msg_adapters import MessageError, outputs, read_depth
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.replay import replay
from paul_ros.stream.depth import SIGMA, SURFACE
from paul_ros.stream.stream import LiftStream, open_stream

CLOUD = "sensor_msgs/msg/PointCloud2"


#: A floor near the camera, and a plane at the far end of a simulator's view.
FAR_BEHIND = np.where(np.arange(480)[:, None] < 420, 1000.0, 2.0) * np.ones((480, 640))


def depth_image(make, metres: np.ndarray, encoding: str = "32FC1", big: bool = False, pad: int = 0, **changes):
    """Return (H,W) metres as a message with `pad` bytes after every row."""
    form, unit = ("f4", 1.0) if encoding == "32FC1" else ("u2", 0.001)
    rows = np.nan_to_num(metres / unit, nan=np.nan if form == "f4" else 0).astype((">" if big else "<") + form)
    height, width = metres.shape
    data = b"".join(row.tobytes() + bytes(pad) for row in rows)
    fields = dict(
        header=header_of(make),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=width * rows.itemsize + pad,
        data=make.octets(data),
    )
    return make("sensor_msgs/msg/Image", **{**fields, **changes})


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1", "mono16"])
@pytest.mark.parametrize("big, pad", [(False, 0), (True, 0), (False, 6)])
def test_every_form_gives_metres(make, encoding, big, pad):
    metres = np.linspace(0.5, 9, 12 * 16).reshape(12, 16)
    image = read_depth(depth_image(make, metres, encoding, big, pad))
    for x, y in ((0, 0), (15, 11), (7.9, 3.2)):
        assert image.at(x, y, 0) == pytest.approx(metres[int(y), int(x)], abs=0.0011)
    assert image.stamp == 7_000_000_005


def test_the_median_of_what_was_measured(make):
    metres = np.full((20, 20), 3.0)
    metres[8:11, 8:11] = [[np.nan, 2.0, 2.0], [2.1, 2.1, 2.1], [9.0, np.nan, 0.0]]
    image = read_depth(depth_image(make, metres))
    assert image.at(9, 9, 1) == pytest.approx(2.1)
    assert np.isnan(image.at(-1, 5, 3)) and np.isnan(image.at(5, 20, 3))
    metres[:10] = np.nan
    assert np.isnan(read_depth(depth_image(make, metres)).at(5, 5, 2))


@pytest.mark.parametrize(
    "changes, reason",
    [({"encoding": "rgb8"}, "depth_encoding"), ({"height": 99}, "truncated_data"), ({"step": 3}, "truncated_data")],
)
def test_images_that_cannot_be_used_are_refused(make, changes, reason):
    with pytest.raises(MessageError) as error:
        read_depth(depth_image(make, np.ones((4, 4)), **changes))
    assert error.value.reason == reason


# --- in the stream


@pytest.fixture
def stream(model_file, make) -> LiftStream:
    stream = LiftStream(Lifter(load_model(model_file)), None, 0.3, 64)
    stream.camera_info(camera_info(make))
    return stream


def two(scale: float = 1.0) -> np.ndarray:
    """Return two persons, `scale` times as large and as far away as the model assumes."""
    return scale * persons_at((0.3, 0, 4), (-1, 0.1, 5))


def background(points: np.ndarray, wall: float = 9.0) -> np.ndarray:
    """Return the depths (480,640) of a wall and of persons before it, flat and as broad as their hips."""
    metres = np.full((480, 640), wall)
    for x, y, z in points[:, [11, 12]].mean(1):
        u, v, r = FOCAL * x / z + CENTRE[0], FOCAL * y / z + CENTRE[1], 0.2 * FOCAL / z
        metres[int(v - r) : int(v + r), int(u - r) : int(u + r)] = z - SURFACE
    return metres


def cloud(make, xy, **stamp):
    return outputs.keypoints_cloud(make, header_of(make, **stamp), xy, np.ones(xy.shape[:2]), ["1", "2"])


@pytest.mark.parametrize("scale", [0.6, 1.0, 1.2])
def test_persons_of_any_size_stand_where_they_are_measured(stream, make, scale):
    truth = two(scale)
    stream.depth(depth_image(make, background(truth)))
    frame = stream.keypoints(CLOUD, cloud(make, seen(truth))).frame
    np.testing.assert_allclose(frame.lifted.points, truth, atol=0.03)
    np.testing.assert_allclose(frame.lifted.root, truth[:, [11, 12]].mean(1), atol=0.03)
    np.testing.assert_array_equal(frame.lifted.distance_sigma, SIGMA)
    assert stream.ledger.notes == {"depth_used": 2} and not stream.ledger.drops


@pytest.mark.parametrize(
    "metres, note",
    [
        (np.full((480, 640), 30.0), {"depth_disagrees": 2}),
        (np.full((480, 640), np.nan), {}),
        (np.full((240, 320), 4.0), {"depth_of_another_size": 1}),
        (np.full((480, 640), 4000.0), {"depth_in_millimetres": 2}),
        (np.full((480, 640), 400.0), {"depth_in_millimetres": 2}),
        (np.full((480, 640), 90.0), {"depth_disagrees": 2}),
        (FAR_BEHIND, {"depth_disagrees": 2}),
    ],
)
def test_what_is_no_measure_of_the_person_changes_nothing(stream, make, metres, note):
    plain = stream.keypoints(CLOUD, cloud(make, seen(two()))).frame
    stream.depth(depth_image(make, metres))
    frame = stream.keypoints(CLOUD, cloud(make, seen(two()))).frame
    np.testing.assert_array_equal(frame.lifted.points, plain.lifted.points)
    np.testing.assert_array_equal(frame.lifted.distance_sigma, plain.lifted.distance_sigma)
    assert stream.ledger.notes == note
    assert ("Remap `depth`" in str(stream.ledger.advice)) == ("depth_of_another_size" in note)


@pytest.mark.parametrize("size, used", [(0.39, False), (0.41, True), (1.39, True), (1.41, False)])
def test_a_depth_is_used_from_0_4_to_1_4_times_the_size(stream, make, size, used):
    """What is measured is the skin, 0.12 m before the root."""
    plain = stream.keypoints(CLOUD, cloud(make, seen(two()))).frame.lifted.root[0, 2]
    stream.depth(depth_image(make, np.full((480, 640), size * plain - 0.12)))
    measured = stream.keypoints(CLOUD, cloud(make, seen(two()))).frame.lifted.root[0, 2]
    assert measured == pytest.approx((size if used else 1) * plain, rel=1e-5)


def test_only_the_image_of_that_time_counts(stream, make):
    truth = two(0.7)
    stream.depth(depth_image(make, background(truth)))
    late = stream.keypoints(CLOUD, cloud(make, seen(truth), seconds=7, nanoseconds=40_000_000)).frame
    assert stream.ledger.notes == {"depth_of_another_time": 1} and late.lifted.root[0, 2] > 1.2 * truth[0, 11, 2]
    assert "same clock" in stream.ledger.advice["depth_of_another_time"]
    for seconds in range(8, 20):
        stream.depth(depth_image(make, background(truth), header=header_of(make, seconds=seconds)))
    stream.keypoints(CLOUD, cloud(make, seen(truth), nanoseconds=10_000_000))
    assert stream.ledger.notes["depth_used"] == 2


def test_persons_that_were_not_lifted_are_no_fault(stream, make):
    xy = seen(two())
    xy[0, 2:] = np.nan
    stream.depth(depth_image(make, background(two())))
    frame = stream.keypoints(CLOUD, cloud(make, xy)).frame
    assert frame.lifted.ok.tolist() == [False, True] and "internal_error" not in stream.ledger.drops
    assert stream.ledger.notes == {"depth_used": 1}


def test_an_unusable_image_is_a_counted_drop(stream, make):
    stream.depth(depth_image(make, np.ones((4, 4)), encoding="16UC1", step=1))
    assert stream.ledger.drops == {"truncated_data": 1}


def test_replay_takes_the_depths_of_a_bag(model_file, tmp_path):
    make, truth = BagMessages(), two(0.7)
    with BagWriter(tmp_path / "in.mcap", make) as bag:
        bag.write("/camera_info", camera_info(make), 0)
        bag.write("/depth", depth_image(make, background(truth), "16UC1"), 1)
        bag.write("/keypoints", cloud(make, seen(truth)), 2)
    done = replay(tmp_path / "in.mcap", open_stream(str(model_file)))
    np.testing.assert_allclose(done.frames[0].lifted.points, truth, atol=0.03)


def test_images_of_before_the_clock_was_set_back_are_forgotten(stream, make):
    """A bag loops: the image of the first pass has the right stamp, but may show something else."""
    stream.depth(depth_image(make, background(two()), header=header_of(make, seconds=9)))
    stream.depth(depth_image(make, background(two()), header=header_of(make, seconds=7)))
    stream.keypoints(CLOUD, cloud(make, seen(two()), seconds=9))
    assert stream.ledger.notes == {"depth_of_another_time": 1}


def test_images_may_come_out_of_order(stream, make):
    stream.depth(depth_image(make, background(two()), header=header_of(make, seconds=9)))
    stream.depth(depth_image(make, background(two()), header=header_of(make, seconds=8, nanoseconds=500_000_000)))
    stream.keypoints(CLOUD, cloud(make, seen(two()), seconds=9))
    assert stream.ledger.notes == {"depth_used": 2}


def test_the_root_of_a_thing_lies_on_its_visible_surface(model_file, make):
    """A model without stature is no person's: no depth of hips is added."""
    model = load_model(model_file)
    del model.header["stature"]
    stream = LiftStream(Lifter(model), None, 0.3, 64)
    stream.camera_info(camera_info(make))
    stream.depth(depth_image(make, np.full((480, 640), 4.0)))
    frame = stream.keypoints(CLOUD, cloud(make, seen(two()))).frame
    np.testing.assert_allclose(frame.lifted.root[:, 2], 4.0)
