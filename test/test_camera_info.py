# SPDX-License-Identifier: Apache-2.0
"""CameraInfo as the camera that is meant: binning, region of interest, distortion, and which of its two images."""

from __future__ import annotations

import array
import json
import math
from typing import Any

import foreign_messages as foreign
import numpy as np
import pytest
from conftest import CENTRE, FOCAL, RosMake, camera_info, header_of, persons_at
from test_depth import depth_image
from test_distortion import forward

from msg_adapters import MessageError, image_size, in_pinhole, outputs, read, read_camera_info
from paul_ros import cli
from paul_ros.cli import options
from paul_ros.lifter import Lifter
from paul_ros.offline.bag_reader import read_messages
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.stream.depth import SURFACE
from paul_ros.stream.messages import image_pixels, project
from paul_ros.stream.parameters import IMAGES
from paul_ros.stream.stream import LiftStream, open_stream

CLOUD = "sensor_msgs/msg/PointCloud2"
MAKE = RosMake()
BARREL = [-0.25, 0.05, 0.001, -0.001, 0.0]
FISHEYE = [-0.02, 0.01, -0.004, 0.001]
#: fx, fy, cx, cy of the tests' camera.
PLAIN = (FOCAL, FOCAL, *CENTRE)


def info(
    k=PLAIN, p=(0, 0, 0, 0), d=(), model="plumb_bob", size=(640, 480), binning=(0, 0), roi=(0, 0, 0, 0), make=MAKE
) -> Any:
    """Return a CameraInfo with fx, fy, cx, cy of K and P, and the region x, y, width, height."""
    msg = camera_info(make)
    msg.k = np.array([k[0], 0, k[2], 0, k[1], k[3], 0, 0, 1.0])
    msg.p = np.array([p[0], 0, p[2], 0, 0, p[1], p[3], 0, 0, 0, 1.0, 0])
    msg.d, msg.distortion_model = array.array("d", d) if make is MAKE else np.array(d), model
    msg.width, msg.height = size
    msg.binning_x, msg.binning_y = binning
    msg.roi.x_offset, msg.roi.y_offset, msg.roi.width, msg.roi.height = roi
    return msg


def raw_pixels(points: np.ndarray, d, model="plumb_bob", k=PLAIN) -> np.ndarray:
    """Return the pixels (N,P,2) at which a lens shows points (N,P,3), by the independent forward model."""
    normalised = points[..., :2] / points[..., 2:]
    flat = [forward(model, list(d), *ray) for ray in normalised.reshape(-1, 2).tolist()]
    return np.reshape(flat, normalised.shape) * k[:2] + np.array(k[2:])


def cloud(xy: np.ndarray, confidence: np.ndarray | None = None, make=MAKE):
    sure = np.ones(xy.shape[:2]) if confidence is None else confidence
    return outputs.keypoints_cloud(make, header_of(make), xy, sure, [str(row) for row in range(len(xy))])


@pytest.fixture
def opened(model_file):
    """opened(image) -> a stream without a camera."""
    return lambda image="auto": open_stream(str(model_file), image=image)


def root(stream: LiftStream, xy: np.ndarray) -> np.ndarray:
    frame = stream.keypoints(CLOUD, cloud(xy)).frame
    assert frame is not None and frame.lifted.units == "m" and frame.lifted.ok.all()
    return frame.lifted.root


def hips(points: np.ndarray) -> np.ndarray:
    return points[:, [11, 12]].mean(1)


# --- persons before cameras of every kind: the right place

#: CameraInfo of a camera that delivers a part of its image, and the delivered pixels of full ones.
CAMERAS = {
    "binning": (info(binning=(2, 2)), lambda uv: uv / 2),
    "uneven binning": (info(binning=(4, 2)), lambda uv: uv / (4, 2)),
    "region": (info(roi=(200, 80, 320, 400)), lambda uv: uv - (200, 80)),
    "region and binning": (info(roi=(200, 80, 320, 400), binning=(2, 4)), lambda uv: (uv - (200, 80)) / (2, 4)),
    "full region": (info(roi=(0, 0, 640, 480), binning=(1, 1)), lambda uv: uv),
    "rectified": (info(p=PLAIN, k=(700, 700, 300, 200), d=BARREL, binning=(2, 2)), lambda uv: uv / 2),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_persons_before_a_camera_that_delivers_a_part_of_its_image(opened, name):
    message, delivered = CAMERAS[name]
    truth = persons_at((0.2, 0.0, 4.46))
    stream = opened()
    stream.camera_info(message)
    pixels = truth[..., :2] / truth[..., 2:] * PLAIN[:2] + PLAIN[2:]
    np.testing.assert_allclose(root(stream, delivered(pixels)), hips(truth), atol=0.02)
    assert stream.session.image_size == (stream.intrinsics.width, stream.intrinsics.height) == image_size(message)
    assert set(stream.ledger.notes) <= {"image_assumed"} and not stream.ledger.drops


@pytest.mark.parametrize(
    "model, d, place",
    [
        ("plumb_bob", BARREL, (2.4, 0.0, 3.0)),
        ("plumb_bob", BARREL[:4], (-1.4, 0.3, 2.4)),
        ("plumb_bob", [0.12, -0.2, 0.001, 0.0005, 0.05], (0.9, 0.0, 2.0)),
        ("rational_polynomial", [0.52, -2.63, 0.0007, 0.0001, 1.52, 0.40, -2.45, 1.45], (2.0, 0.0, 3.0)),
        ("equidistant", FISHEYE, (4.0, 0.0, 2.0)),
        ("equidistant", FISHEYE, (-1.0, -0.5, 1.5)),
    ],
)
def test_persons_in_the_raw_image_of_a_lens(opened, model, d, place):
    """P is not filled, so that 'auto' takes the image as raw; the region and the binning change nothing."""
    truth = persons_at(place)
    pixels = raw_pixels(truth, d, model)
    assert pixels.min() > -600
    for message, delivered in (
        (info(d=d, model=model), lambda uv: uv),
        (info(d=d, model=model, roi=(40, 20, 600, 460), binning=(2, 2)), lambda uv: (uv - (40, 20)) / 2),
    ):
        stream = opened()
        stream.camera_info(message)
        np.testing.assert_allclose(root(stream, delivered(pixels)), hips(truth), atol=0.03)
        assert stream.describe()["image"] == "raw" and stream.describe()["distortion"] == f"{model}, corrected"


def test_a_whole_room_is_undistorted_at_once(opened):
    rng = np.random.default_rng(0)
    truth = persons_at(*zip(rng.uniform(-1.5, 1.5, 20), rng.uniform(-0.3, 0.3, 20), rng.uniform(3, 6, 20)))
    stream = opened()
    stream.camera_info(info(d=FISHEYE, model="equidistant"))
    np.testing.assert_allclose(root(stream, raw_pixels(truth, FISHEYE, "equidistant")), hips(truth), atol=0.03)


# --- which image

FILLED, OTHER = PLAIN, (580.0, 581.0, 330.0, 250.0)
COPIED = (FOCAL + 0.004, FOCAL, CENTRE[0], CENTRE[1] - 0.004)


@pytest.mark.parametrize(
    "image, p, d, expected",
    [
        # No distortion: both images are equal, and P is preferred.
        ("auto", OTHER, [0.0] * 5, ("P", "rectified", "", [])),
        ("auto", OTHER, [], ("P", "rectified", "", [])),
        ("auto", (0, 0, 0, 0), [], ("K", "raw", "", [])),
        ("raw", OTHER, [0.0] * 5, ("K", "raw", "", [])),
        # Distortion: raw without P, or with a copy of K; otherwise rectified, which is an assumption.
        ("auto", (0, 0, 0, 0), BARREL, ("K", "raw", "plumb_bob", [])),
        ("auto", (np.nan, 580, 1, 1), BARREL, ("K", "raw", "plumb_bob", [])),
        ("auto", FILLED, BARREL, ("K", "raw", "plumb_bob", [])),
        ("auto", COPIED, BARREL, ("K", "raw", "plumb_bob", [])),
        ("auto", OTHER, BARREL, ("P", "rectified", "", ["image_assumed"])),
        ("auto", OTHER, [np.nan] * 5, ("P", "rectified", "", ["image_assumed"])),
        # Stated.
        ("rectified", OTHER, BARREL, ("P", "rectified", "", [])),
        ("rectified", FILLED, BARREL, ("P", "rectified", "", [])),
        ("rectified", (0, 0, 0, 0), BARREL, ("K", "rectified", "", ["rectified_without_p"])),
        ("rectified", (0, 0, 0, 0), [], ("K", "rectified", "", [])),
        ("raw", OTHER, BARREL, ("K", "raw", "plumb_bob", [])),
        # Distortion that cannot be used.
        ("raw", OTHER, [0.1, 0.2, 0.3], ("K", "raw", "", ["distortion_ignored"])),
        ("auto", FILLED, [np.nan] * 5, ("K", "raw", "", ["distortion_ignored"])),
        ("auto", (0, 0, 0, 0), [1e30, 0, 0, 0, 0], ("K", "raw", "", ["distortion_ignored"])),
    ],
)
def test_the_image_that_is_taken(image, p, d, expected):
    camera = read_camera_info(info(p=p, d=d), image)
    lens = camera.distortion.model if camera.distortion else ""
    assert (camera.matrix, camera.image, lens, [note.reason for note in camera.notes]) == expected
    assert (camera.fx, camera.cx) == (
        (OTHER[0], OTHER[2]) if expected[0] == "P" and p != FILLED else (FOCAL, CENTRE[0])
    )
    assert bool(camera.uncorrected) == ("distortion_ignored" in expected[3])


@pytest.mark.parametrize("d", [[0.0] * 4, []], ids=["zeros", "empty"])
@pytest.mark.parametrize(
    "image, p, expected",
    [
        ("auto", FILLED, ("raw", "equidistant", ["image_assumed"])),
        ("auto", (0, 0, 0, 0), ("raw", "equidistant", ["image_assumed"])),
        ("auto", OTHER, ("rectified", "", ["image_assumed"])),
        ("raw", OTHER, ("raw", "equidistant", [])),
        ("rectified", FILLED, ("rectified", "", [])),
    ],
)
def test_an_ideal_fisheye_has_zeros_for_coefficients(image, p, d, expected):
    camera = read_camera_info(info(p=p, d=d, model="equidistant"), image)
    lens = camera.distortion.model if camera.distortion else ""
    assert (camera.image, lens, [note.reason for note in camera.notes]) == expected


@pytest.mark.parametrize("image", ["auto", "raw"])
def test_persons_before_an_ideal_fisheye_stand_where_they_stand(opened, image):
    stream = opened(image=image)
    stream.camera_info(info(d=[0.0] * 4, model="equidistant"))
    truth = persons_at((4.0, 0.0, 2.0))
    x, y = (truth[..., :2] / truth[..., 2:]).transpose(2, 0, 1)
    angle = np.arctan(np.hypot(x, y)) / np.hypot(x, y)
    xy = np.stack([x * angle, y * angle], axis=-1) * FOCAL + CENTRE
    np.testing.assert_allclose(root(stream, xy), hips(truth), atol=0.03)


def test_a_model_that_is_not_known_is_noted_and_not_corrected(opened):
    stream = opened()
    stream.camera_info(info(d=[0.9], model="fov"))
    truth = persons_at((0.2, 0, 4))
    np.testing.assert_allclose(root(stream, truth[..., :2] / truth[..., 2:] * FOCAL + CENTRE), hips(truth), atol=0.02)
    assert stream.ledger.notes == {"distortion_ignored": 1} and "'fov'" in stream.ledger.advice["distortion_ignored"]
    described = stream.describe()
    assert described["distortion"] == "not corrected" and "distortion: not corrected" in described["scale_source"]


@pytest.mark.parametrize(
    "changes, clue",
    [
        ({"binning": (100, 1)}, "binning is 100 x 1"),
        ({"binning": (2, 4_000_000_000)}, "binning is 2 x 4000000000"),
        ({"roi": (0, 0, 1280, 480)}, r"roi is 1280 x 480 pixels at \(0, 0\), and the full image 640 x 480"),
        ({"roi": (400, 0, 400, 480)}, "roi is 400 x 480"),
        ({"roi": (0, 100, 640, 400)}, "roi is 640 x 400"),
        ({"roi": (10, 10, 0, 0)}, "roi is 0 x 0"),
        ({"roi": (4_000_000_000, 0, 4_000_000_000, 1)}, "roi"),
    ],
)
def test_a_part_that_no_camera_delivers_is_a_counted_drop(opened, changes, clue):
    stream = opened()
    stream.camera_info(info())
    good = stream.intrinsics, stream.session.image_size
    stream.camera_info(info(**changes))
    assert stream.ledger.drops == {"bad_intrinsics": 1} and (stream.intrinsics, stream.session.image_size) == good
    with pytest.raises(MessageError, match=clue):
        read_camera_info(info(**changes))


def test_a_region_without_a_full_size_is_taken_as_it_is():
    assert read_camera_info(info(size=(0, 0), roi=(100, 50, 320, 240))).width == 320
    assert image_size(info(size=(0, 0))) == (0, 0)


# --- in the stream


def test_notes_count_once_and_again_when_they_change(opened):
    """CameraInfo comes with every image, and its last digits may vary."""
    stream, rng = opened(), np.random.default_rng(0)
    for _ in range(50):
        jitter = 1e-5 * rng.standard_normal(4)
        stream.camera_info(info(k=PLAIN + jitter, p=OTHER + jitter, d=BARREL + 1e-9 * rng.standard_normal(5)))
    assert stream.ledger.notes == {"image_assumed": 1}
    assert "Set `image` to raw" in stream.ledger.advice["image_assumed"]
    stream.camera_info(info())
    stream.camera_info(info(p=OTHER, d=BARREL))
    assert stream.ledger.notes == {"image_assumed": 2}


def test_what_is_described_does_not_vary_with_the_last_digits(opened):
    stream, rng, described = opened(), np.random.default_rng(0), set()
    for _ in range(20):
        stream.camera_info(info(k=PLAIN + 1e-5 * rng.standard_normal(4), d=BARREL + 1e-9 * rng.standard_normal(5)))
        described.add(str(stream.describe()))
    assert len(described) == 1


def test_the_image_is_chosen_while_it_runs(opened, model_file):
    """The last usable CameraInfo is read again; a latched one does not come twice."""
    stream, truth = opened(), persons_at((1.4, 0.0, 3.0))
    stream.camera_info(info(p=FILLED, d=BARREL))
    raw = raw_pixels(truth, BARREL)
    np.testing.assert_allclose(root(stream, raw), hips(truth), atol=0.03)
    other = open_stream(str(model_file), session=stream.session, image="rectified")
    assert np.linalg.norm(root(other, raw) - hips(truth)) > 0.1
    np.testing.assert_allclose(root(other, truth[..., :2] / truth[..., 2:] * FOCAL + CENTRE), hips(truth), atol=0.03)
    again = open_stream(str(model_file), session=stream.session, image="raw")
    np.testing.assert_allclose(root(again, raw), hips(truth), atol=0.03)


def test_an_image_that_cannot_be_read_is_a_counted_drop(opened, model_file):
    stream = opened()
    stream.camera_info(info(k=(0, 0, 0, 0), p=OTHER))
    other = open_stream(str(model_file), session=stream.session, image="raw")
    assert other.ledger.drops == {"bad_intrinsics": 1} and other.intrinsics.matrix == "P"


def test_commands_and_node_know_the_same_images():
    assert options.IMAGES == IMAGES


def test_another_image_is_refused(model_file):
    with pytest.raises(ValueError, match="`image` is 'crooked'; it must be auto or rectified or raw"):
        open_stream(str(model_file), image="crooked")


def test_another_resolution_is_taken(opened):
    stream, truth = opened(), persons_at((0.2, 0.0, 4.0))
    normalised = truth[..., :2] / truth[..., 2:]
    for scale in (1, 2, 0.5):
        k = tuple(scale * value for value in PLAIN)
        stream.camera_info(info(k=k, size=(int(640 * scale), int(480 * scale))))
        np.testing.assert_allclose(root(stream, normalised * k[:2] + k[2:]), hips(truth), atol=0.02)
    assert not stream.ledger.notes


def test_frames_before_a_late_camera_are_in_model_units(opened):
    stream, truth = opened(), persons_at((1.4, 0.0, 3.0))
    raw = cloud(raw_pixels(truth, BARREL))
    assert stream.keypoints(CLOUD, raw).frame.lifted.units == "model"
    stream.camera_info(info(d=BARREL))
    np.testing.assert_allclose(stream.keypoints(CLOUD, raw).frame.lifted.root, hips(truth), atol=0.03)


def test_keypoints_that_no_ray_reaches_are_hidden_and_counted(opened):
    stream, truth = opened(), persons_at((0.3, 0.0, 4.0))
    stream.camera_info(info(d=[-0.3, 0, 0, 0]))
    xy = raw_pixels(truth, [-0.3, 0, 0, 0])
    xy[0, 9] = (CENTRE[0] + 0.8 * FOCAL, CENTRE[1])
    frame = stream.keypoints(CLOUD, cloud(xy)).frame
    assert (
        stream.ledger.notes == {"no_ray": 1} and not frame.given.visible[0, 9] and np.isnan(frame.given.xy[0, 9]).all()
    )
    assert frame.given.confidence[0, 9] == 0 and frame.given.visible.sum() == 16
    np.testing.assert_allclose(frame.lifted.root, hips(truth), atol=0.03)


def test_keypoints_of_a_pinhole_camera_stay_as_they_are():
    given = read(CLOUD, cloud(raw_pixels(persons_at((0, 0, 3)), BARREL)), 17)
    assert in_pinhole(given, read_camera_info(info(p=OTHER, d=BARREL))) is given and in_pinhole(given, None) is given


def test_depths_are_read_where_the_raw_image_shows_the_root(opened):
    """The depth image is aligned to the image of the keypoints: only about the distorted root it has a near value."""
    stream, truth, lens = opened(), 0.7 * persons_at((2.0, 0.0, 4.0)), [-0.4, 0.1, 0, 0]
    stream.camera_info(info(d=lens))
    u, v = raw_pixels(hips(truth)[:, None], lens)[0, 0]
    metres = np.full((480, 640), 30.0)
    metres[int(v) - 10 : int(v) + 10, int(u) - 10 : int(u) + 10] = truth[0, 11, 2] - SURFACE
    assert FOCAL * 0.5 + CENTRE[0] - u > 20, "the pixels of the two images must differ"
    stream.depth(depth_image(MAKE, metres))
    np.testing.assert_allclose(root(stream, raw_pixels(truth, lens)), hips(truth), atol=0.03)
    assert stream.ledger.notes == {"depth_used": 1}


def test_annotations_and_films_lie_on_the_raw_image(opened):
    truth, stream = persons_at((1.4, 0.0, 3.0)), opened()
    raw = raw_pixels(truth, BARREL)
    stream.camera_info(info(d=BARREL))
    frame = stream.keypoints(CLOUD, cloud(raw)).frame
    np.testing.assert_allclose(project(truth, frame.camera), raw, atol=1e-6)
    np.testing.assert_allclose(image_pixels(frame.keypoints, frame.camera), raw, atol=1e-4)


@pytest.mark.parametrize(
    "message", [info(binning=(2, 2)), info(roi=(100, 50, 400, 400)), info(roi=(100, 50, 400, 400), binning=(4, 4))]
)
def test_shares_of_the_image_are_those_of_the_delivered_image(opened, bag_make, message):
    stream, truth = opened(), persons_at((0.2, 0.0, 4.0))
    stream.camera_info(message)
    offset = np.array((message.roi.x_offset, message.roi.y_offset))
    size = np.array((message.roi.width or 640, message.roi.height or 480))
    shares = (truth[0, :, :2] / truth[0, :, 2:] * FOCAL + CENTRE - offset) / size
    pose = dict(zip(stream.route.given.names, shares * foreign.SIZE))
    stream.keypoints(foreign.HRI, foreign.hri(bag_make, header_of(bag_make), pose))
    np.testing.assert_allclose(stream.flush().lifted.root, hips(truth), atol=0.03)


# --- for arrays


def test_the_lifter_corrects_the_distortion_of_a_message(model_file):
    lifter, truth = Lifter(model_file), persons_at((1.4, 0.0, 3.0))
    raw = raw_pixels(truth, BARREL)
    for camera in (info(d=BARREL), read_camera_info(info(p=OTHER, d=BARREL), "raw")):
        np.testing.assert_allclose(lifter.lift(raw, camera=camera).root, hips(truth), atol=0.03)
        np.testing.assert_allclose(lifter.lift(raw, camera=camera, layout="coco17").root, hips(truth), atol=0.03)
    with pytest.warns(UserWarning, match="Set `image` to raw") as warned:
        lifter.lift(raw, camera=info(p=OTHER, d=BARREL))
    assert warned[0].filename == __file__
    raw[0, 9] = (CENTRE[0] + 0.8 * FOCAL, CENTRE[1])
    assert not lifter.lift(raw, camera=info(d=[-0.3, 0, 0, 0])).used[0, 9]


@pytest.mark.parametrize("size", [0.2, 0.5, 1, 2])
def test_the_numbers_of_the_image_do_not_depend_on_its_resolution(size):
    """A camera of any resolution sees the same rays."""
    camera = read_camera_info(info(k=tuple(size * value for value in PLAIN), size=(0, 0), d=BARREL))
    rays = np.array([[0.3, -0.2], [-0.5, 0.4]])
    pixels = camera.to_image(rays * (camera.fx, camera.fy) + (camera.cx, camera.cy))
    expected = [forward("plumb_bob", BARREL, *ray) for ray in rays.tolist()]
    np.testing.assert_allclose((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), expected)
    assert math.isclose(camera.fx, size * FOCAL)


# --- from the command line


def test_replay_and_film_take_the_image(model_file, tmp_path, capsys):
    truth, bag, make = persons_at((1.4, 0.0, 3.0)), tmp_path / "in.mcap", BagMessages()
    with BagWriter(bag, make) as writer:
        writer.write("/camera_info", info(p=OTHER, d=BARREL, make=make), 0)
        writer.write("/keypoints", cloud(raw_pixels(truth, BARREL), make=make), 1)
    for image, far in (("raw", False), ("auto", True)):
        arguments = ["replay", str(bag), "--model", str(model_file), "--image", image]
        assert cli.main([*arguments, "-o", str(tmp_path / "out.mcap"), "--json", "-"]) == 0
        assert json.loads(capsys.readouterr().out)["noted"] == ({"image_assumed": 1} if far else {})
        (body,) = (m.poses[0].position for t, _, m, _ in read_messages(tmp_path / "out.mcap") if t == "/lifter/bodies")
        off = np.linalg.norm(np.array((body.x, body.y, body.z)) - hips(truth)[0])
        assert (off > 0.1) == far and (off < 0.03) != far
    view = ["view", str(bag), "--model", str(model_file), "--image", "raw", "-o", str(tmp_path / "film.png")]
    assert cli.main(view) == 0 and (tmp_path / "film.png").stat().st_size > 1000
