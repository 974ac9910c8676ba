# SPDX-License-Identifier: Apache-2.0
"""The shipped recordings: remade bit for bit, small, and as their README describes them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import msg_adapters
from msg_adapters.keypoints import stamp_ns
from paul_ros.layout import load_layout
from paul_ros.offline.bag_reader import read_messages, topics_of
from training.people.human_points import layout_points
from training.people.mocap import CMU31

BAGS = Path(__file__).resolve().parent.parent / "bags"
NAMES = {"one_person.mcap": 585, "two_persons_crossing.mcap": 390}
CLOUD = "sensor_msgs/msg/PointCloud2"


@pytest.fixture(scope="module", params=NAMES)
def recording(request):
    """(name, [(Keypoints2D, truth (N,17,3))], Intrinsics) of a bag."""
    frames, truths, camera = {}, {}, None
    for topic, kind, message, time in read_messages(BAGS / request.param):
        assert time == stamp_ns(message.header) and message.header.frame_id == "camera_color_optical_frame"
        if topic == "/keypoints":
            frames[time] = msg_adapters.read(kind, message, 17)
        elif topic == "/camera_info":
            camera = msg_adapters.read_camera_info(message)
        else:
            flat = [(p.position.x, p.position.y, p.position.z) for p in message.poses]
            truths[time] = np.array(flat).reshape(-1, 17, 3)
    assert list(frames) == list(truths)
    return request.param, [(frames[time], truths[time]) for time in frames], camera


def test_made_anew_bit_for_bit(tmp_path):
    subprocess.run([sys.executable, BAGS / "make_bags.py", tmp_path], check=True, capture_output=True, cwd=tmp_path)
    for name in NAMES:
        assert (tmp_path / name).read_bytes() == (BAGS / name).read_bytes()


def test_sizes():
    assert all((BAGS / name).stat().st_size <= 2_000_000 for name in NAMES)
    assert sum(clip.stat().st_size for clip in (BAGS / "source").iterdir()) < 1_500_000


@pytest.mark.parametrize("name, frames", NAMES.items())
def test_topics(name, frames):
    assert topics_of(BAGS / name) == {
        "/camera_info": ("sensor_msgs/msg/CameraInfo", frames),
        "/keypoints": (CLOUD, frames),
        "/ground_truth/poses": ("geometry_msgs/msg/PoseArray", frames),
    }


def test_thirty_hertz(recording):
    _, frames, _ = recording
    stamps = np.array([keypoints.stamp for keypoints, _ in frames])
    assert set(np.diff(stamps)) <= {33_333_333, 33_333_334}
    assert 10 <= (stamps[-1] - stamps[0]) / 1e9 <= 20


def test_truth_belongs_to_its_row(recording):
    """Each visible point lies where its truth projects to, within the noise that the README states."""
    name, frames, camera = recording
    offsets = []
    for keypoints, truth in frames:
        assert len(truth) == keypoints.persons
        xy = truth[..., :2] / truth[..., 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        offsets.append((keypoints.xy - xy)[keypoints.visible])
    offsets = np.concatenate(offsets)
    if name == "one_person.mcap":
        assert np.abs(offsets).max() < 1e-4
    else:
        assert 2 < offsets.std() < 3 and np.abs(offsets).max() < 16


def test_persons_stand_upright_before_the_camera(recording):
    """y points down, so heads are above ankles; nobody is nearer than 2 m or farther than 6 m; hips near 1 m up."""
    _, frames, _ = recording
    truth = np.concatenate([truth for _, truth in frames])
    assert (truth[:, 0, 1] < truth[:, 15:, 1].max(axis=1)).all()
    assert 2 < truth[..., 2].min() and truth[..., 2].max() < 6
    assert 1.2 < np.median(np.ptp(truth[..., 1], axis=1)) < 2


def test_left_is_left(recording):
    """Right-handed bodies: left minus right, crossed with up, points where the nose is."""
    _, frames, _ = recording
    truth = np.concatenate([truth for _, truth in frames])
    across = truth[:, 3] - truth[:, 4]
    up = truth[:, 1:3].mean(1) - truth[:, 0]
    nose = truth[:, 0] - truth[:, 3:5].mean(1)
    assert (np.einsum("ni,ni->n", np.cross(across, up), nose) > 0).all()


def test_one_person_is_always_seen_whole(recording):
    name, frames, camera = recording
    if name != "one_person.mcap":
        return
    assert all(keypoints.ids == ("1",) and keypoints.visible.all() for keypoints, _ in frames)
    xy = np.concatenate([keypoints.xy for keypoints, _ in frames])
    assert (xy > 0).all() and (xy < [camera.width, camera.height]).all()


def test_two_persons_cross_hide_and_leave():
    frames = [
        msg_adapters.read(kind, message, 17)
        for _, kind, message, _ in read_messages(BAGS / "two_persons_crossing.mcap", ["/keypoints"])
    ]
    ids = [frame.ids for frame in frames]
    assert set(ids) == {(), ("3",), ("7",), ("7", "3"), ("3", "7")}
    assert ids[0] == ids[-1] == () and ids.count(()) > 30
    both = [dict(zip(frame.ids, np.nanmean(frame.xy[..., 0], axis=1))) for frame in frames if len(frame.ids) == 2]
    side = np.sign([place["3"] - place["7"] for place in both])
    assert (side[:20] == -1).all() and (side == 1).sum() > 30 and (side[-20:] == -1).all()
    visible = np.concatenate([frame.visible for frame in frames])
    assert 0.05 < 1 - visible.mean() < 0.3
    confidence = np.concatenate([frame.confidence[frame.visible] for frame in frames])
    assert 0.3 <= confidence.min() and confidence.max() <= 1 and confidence.std() > 0.03


def test_coco_points_of_a_plain_pose():
    """A T-pose made by hand: y up, facing +z, so left is +x."""
    joints = np.random.default_rng(0).standard_normal((1, len(CMU31), 3))
    places = {
        "upperneck": (0, 1.5, 0),
        "head": (0, 1.7, 0),
        "lclavicle": (0.2, 1.4, 0),
        "rclavicle": (-0.2, 1.4, 0),
        "lradius": (0.8, 1.4, 0),
        "rtibia": (-0.1, 0.1, 0),
    }
    for name, place in places.items():
        joints[0, CMU31.index(name)] = place
    points = layout_points(joints, load_layout("coco17"))[0]
    assert np.allclose(points[0], (0, 1.6, 0.11)) and np.allclose(points[1], (0.032, 1.64, 0.085))
    assert np.allclose(points[4], (-0.075, 1.62, 0))
    assert np.allclose(points[9], (0.8, 1.4, 0)) and np.allclose(points[16], (-0.1, 0.1, 0))
    with pytest.raises(ValueError, match="31"):
        layout_points(joints[:, :17], load_layout("coco17"))
