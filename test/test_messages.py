# SPDX-License-Identifier: Apache-2.0
"""The output messages of a frame, as objects and as bytes; quaternion signs from frame to frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from conftest import PERSON, camera_info, header_of, persons_at, seen
from scipy.spatial.transform import Rotation
from test_stream import CLOUD, GOOD, cloud, stream  # noqa: F401, a fixture

from msg_adapters import outputs
from paul_ros.stream import frame as module
from paul_ros.stream.messages import OUTPUTS, STANDARD, MessageBuilder
from paul_ros.stream.stream import open_stream


def build(frame, make, name: str):
    return MessageBuilder(make).messages(frame, [name])[name]


def test_messages_of_a_frame(stream, make, bag_make):  # noqa: F811
    stream.camera_info(camera_info(make))
    confidence = np.full((2, 17), 0.75)
    confidence[1, 9] = 0.1
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD), confidence, ["5", ""])).frame
    messages = MessageBuilder(make).messages(frame)
    assert tuple(messages) == STANDARD
    if make is bag_make:
        messages = {name: make.through_cdr(message) for name, message in messages.items()}
    poses, points, markers = messages["poses"], messages["keypoints3d"], messages["markers"]
    for header in (poses.header, points.header, markers.markers[0].header, markers.markers[1].header):
        assert (header.stamp.sec, header.stamp.nanosec) == (7, 5)
        assert header.frame_id == "camera_color_optical_frame"
    xyz = np.array([(p.position.x, p.position.y, p.position.z) for p in poses.poses]).reshape(2, 17, 3)
    np.testing.assert_array_equal(xyz, frame.lifted.points)
    data = np.frombuffer(points.data, "<f4").reshape(2, 17, 8)
    np.testing.assert_allclose(data[..., :3], frame.lifted.points, rtol=1e-6)
    np.testing.assert_array_equal(data[..., 3], np.where(confidence > 0.3, 0.75, 0))
    np.testing.assert_array_equal(data[:, 0, 5], [5, -1])
    assert 0.005 < markers.markers[0].scale.x < 0.05


def test_persons_have_the_ids_and_poses_of_the_rows_of_all_other_outputs(stream, make):  # noqa: F811
    """A person who is not lifted has no row anywhere."""
    stream.camera_info(camera_info(make))
    xy = seen(persons_at((0.3, 0, 4), (1, 0, 4), (-1, 0.1, 5)))
    xy[1, 2:] = np.nan
    frame = stream.keypoints(CLOUD, cloud(make, xy, ids=["7", "8", ""])).frame
    messages = MessageBuilder(make).messages(frame)
    persons, bodies, points = messages["persons"], messages["bodies"], messages["keypoints3d"]
    assert persons.header == bodies.header and list(persons.joint_names) == ["7", ""]
    assert len(persons.twist) == len(persons.wrench) == 0
    for transform, pose in zip(persons.transforms, bodies.poses, strict=True):
        p, t = pose.position, transform.translation
        assert (t.x, t.y, t.z) == (p.x, p.y, p.z) and transform.rotation == pose.orientation
    assert np.frombuffer(points.data, "<f4").reshape(2, 17, 8)[:, 0, 5].tolist() == [7, -1]


def test_ambiguity_and_distance_sigma_stand_beside_every_point(stream, make):  # noqa: F811
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    data = np.frombuffer(build(frame, make, "keypoints3d").data, "<f4")
    assert np.isnan(data.reshape(2, 17, 8)[..., 7]).all()
    stream.camera_info(camera_info(make))
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    message = build(frame, make, "keypoints3d")
    data = np.frombuffer(message.data, "<f4").reshape(2, 17, 8)
    for column, value in ((6, frame.lifted.ambiguity), (7, frame.lifted.distance_sigma)):
        np.testing.assert_array_equal(data[..., column], np.repeat(np.float32(value)[:, None], 17, axis=1))
    # The shape is exact, so only the spread of people's heights is left.
    np.testing.assert_allclose(frame.lifted.distance_sigma, 0.06 * np.linalg.norm(frame.lifted.root, axis=1), rtol=0.05)
    assert message.is_dense


def test_one_pose_a_person_in_bodies(stream, make):  # noqa: F811
    """PERSON looks at the camera: x points to the camera, y to the right of the image, z up."""
    stream.camera_info(camera_info(make))
    xy = seen(persons_at((0.3, 0, 4), (1, 0, 4), (-1, 0.1, 5)))
    xy[1, 2:] = np.nan
    bodies = build(stream.keypoints(CLOUD, cloud(make, xy)).frame, make, "bodies").poses
    assert len(bodies) == 2
    for pose, where in zip(bodies, ((0.3, 0.1, 4), (-1, 0.2, 5))):
        p, q = pose.position, pose.orientation
        np.testing.assert_allclose((p.x, p.y, p.z), where, atol=0.03)
        axes = Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix().T
        np.testing.assert_allclose(axes, [(0, 0, -1), (1, 0, 0), (0, -1, 0)], atol=0.06)


def test_body_axes_are_worked_out_once_and_only_where_asked_for(stream, make, monkeypatch):  # noqa: F811
    asked, quaternions = [], module.quaternions
    monkeypatch.setattr(module, "quaternions", lambda R: asked.append(len(R)) or quaternions(R))
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    build(frame, make, "poses")
    assert asked == []
    np.testing.assert_array_equal(frame.attitudes, frame.attitudes)
    assert asked == [len(GOOD)]


def test_bytes_in_and_out_say_the_same_as_messages(model_file, bag_make):
    """PointCloud2 in, PoseArray and PointCloud2 out: bytes and objects are the same messages."""
    store = bag_make.store
    msg = outputs.keypoints_cloud(
        bag_make, header_of(bag_make), seen(persons_at((0, 0, 4), (1, 0, 5))), np.ones((2, 17)), ["7", "9"]
    )
    data = bytes(store.serialize_cdr(msg, CLOUD))
    frames = [open_stream(str(model_file)).keypoints(CLOUD, given).frame for given in (msg, data)]
    packed = [name for name, output in OUTPUTS.items() if output.packed]
    assert packed == ["poses", "keypoints3d"]
    as_bytes = MessageBuilder(bag_make, packed=True).messages(frames[1], packed)
    for name, message in MessageBuilder(bag_make).messages(frames[0], packed).items():
        kind = OUTPUTS[name].message_type
        unpacked = store.deserialize_cdr(as_bytes[name], kind)
        assert store.serialize_cdr(bag_make.through_cdr(message), kind) == store.serialize_cdr(unpacked, kind)


def turned(degrees: float) -> np.ndarray:
    """(1,17,3) metres: PERSON turned about the vertical, 4 m away."""
    return PERSON[None] @ Rotation.from_euler("y", degrees, degrees=True).as_matrix().T + (0, 0, 4)


def test_quaternion_signs_are_continuous_over_the_frames_of_one_builder(stream, make):  # noqa: F811
    """A person turns once around: the quaternion of each frame is near that of the frame before."""
    stream.camera_info(camera_info(make))
    builder, found = MessageBuilder(make), []
    for degrees in range(0, 360, 20):
        frame = stream.keypoints(CLOUD, cloud(make, seen(turned(degrees)))).frame
        (pose,) = builder.messages(frame, ["bodies"])["bodies"].poses
        found.append([getattr(pose.orientation, axis) for axis in "xyzw"])
        assert frame.attitudes[0, 3] >= 0
    assert (np.sum(np.array(found[1:]) * found[:-1], axis=1) > 0).all()
    assert min(row[3] for row in found) < 0, "a rule for one frame alone would do"


def test_two_outputs_of_a_frame_settle_its_signs_once(stream, make, monkeypatch):  # noqa: F811
    builder, asked = MessageBuilder(make), []
    monkeypatch.setattr(builder, "_continuous_signs", lambda ids, q: asked.append(ids) or q)
    monkeypatch.setitem(OUTPUTS, "again", replace(OUTPUTS["bodies"], name="again"))
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    assert builder.messages(frame, ["bodies", "again"])["again"] and asked == [("1", "2")]


def test_only_what_is_asked_for_is_built_in_the_order_asked(stream, make):  # noqa: F811
    frame = stream.keypoints(CLOUD, cloud(make, seen(GOOD))).frame
    assert list(MessageBuilder(make).messages(frame, ["markers", "poses"])) == ["markers", "poses"]
    assert MessageBuilder(make).messages(frame, []) == {}


def test_persons_in_model_units_have_no_transforms(stream):  # noqa: F811
    """Frames of tf2 are in metres."""
    from types import SimpleNamespace

    def make(type_name, **fields):
        return SimpleNamespace(**fields)

    from conftest import RosMake

    message = cloud(RosMake(), seen(GOOD))
    assert not build(stream.keypoints(CLOUD, message).frame, make, "transforms").transforms
    stream.camera_info(camera_info(RosMake()))
    found = build(stream.keypoints(CLOUD, message).frame, make, "transforms").transforms
    assert [transform.child_frame_id for transform in found] == ["body_1", "body_2"]


def test_transforms_need_an_id_of_ones_own_a_stamp_and_a_frame(stream, bag_make):  # noqa: F811
    def names(received=0, ids=("1", "2"), **header):
        frame = stream.keypoints(CLOUD, cloud(bag_make, seen(GOOD), ids=ids, **header), "", received).frame
        (message,) = MessageBuilder(bag_make).messages(frame, ["transforms"]).values()
        return [transform.child_frame_id for transform in message.transforms]

    nameless = camera_info(bag_make)
    nameless.header.frame_id = ""
    stream.camera_info(nameless)
    assert names() == ["body_1", "body_2"]
    assert names(ids=("9", "9")) == names(frame="") == names(seconds=0, nanoseconds=0) == []
    assert names(seconds=0, nanoseconds=0, received=10**9) == ["body_1", "body_2"]
    stream.camera_info(camera_info(bag_make))
    assert names(frame="", seconds=9) == ["body_1", "body_2"]
