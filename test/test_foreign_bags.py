# SPDX-License-Identifier: Apache-2.0
"""The families of foreign packages from the bag to the lifted persons, and persons that come in a message each."""

from __future__ import annotations

import json

import foreign_messages as foreign
import numpy as np
import pytest
from conftest import camera_info, header_of, persons_at, seen

import msg_adapters
from msg_adapters import outputs
from paul_ros import cli
from paul_ros.errors import BagError
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.offline.bag_reader import matches, read_records
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_topics import Topics
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.replay import replay
from paul_ros.stream.stream import LiftStream, open_stream

COCO = load_layout("coco17").names
FRAMES = 3
BODIES = "/humans/bodies/*/skeleton2d"
#: (frames, 2 persons, 17, 2) whole pixels, which OpenDR's messages need.
PIXELS = np.array([seen(persons_at((0.3 + 0.1 * n, 0, 4), (-1, 0.1, 5))) for n in range(FRAMES)]).round()


class Factory(BagMessages):
    """Return the factory that bags are written with, foreign packages included."""

    def __init__(self) -> None:
        super().__init__(foreign.DEFINITIONS)

    @staticmethod
    def floats(values):
        return np.array(values, np.float32)


def poses_of(xy: np.ndarray) -> list[dict]:
    return [dict(zip(COCO, person.tolist())) for person in xy]


def cloud(make, header, xy):
    return outputs.keypoints_cloud(make, header, xy, np.ones(xy.shape[:2]), ["1", "2"])


def flat_poses(make, header, xy):
    return outputs.pose_array(make, header, np.concatenate([xy, np.full((*xy.shape[:2], 1), 0.9)], axis=-1))


def detections(make, header, xy):
    def keypoint(index, x, y):
        point = make("yolo_msgs/msg/Point2D", x=x, y=y)
        return make("yolo_msgs/msg/KeyPoint2D", id=index + 1, point=point, score=0.9)

    people = [
        make(
            "yolo_msgs/msg/Detection",
            class_id=0,
            class_name="person",
            score=0.9,
            id=str(number + 1),
            keypoints=make(
                "yolo_msgs/msg/KeyPoint2DArray",
                data=[keypoint(index, x, y) for index, (x, y) in enumerate(person.tolist())],
            ),
        )
        for number, person in enumerate(xy)
    ]
    return make(foreign.YOLO, header=header, detections=people)


def targets(make, header, xy):
    people = [foreign.ai_target(make, number + 1, body_kps=(p, [0.9] * 17)) for number, p in enumerate(xy)]
    return foreign.ai(make, header, people)


def openpose(build, order):
    return lambda make, header, xy: build(make, header, [foreign.openpose_rows(p, order) for p in poses_of(xy)])


def zed(body_format):
    return lambda make, header, xy: foreign.zed(make, header, poses_of(xy), body_format, ids=[1, 2])


#: Bag -> (type name, how a whole image is one message, the ids it has).
WHOLE = {
    "point_cloud2": (foreign.CLOUD, cloud, ("1", "2")),
    "pose_array": (foreign.POSES, flat_poses, ("", "")),
    "yolo": (foreign.YOLO, detections, ("1", "2")),
    "zed18": (foreign.ZED, zed(0), ("1", "2")),
    "zed34": (foreign.ZED, zed(1), ("1", "2")),
    "zed38": (foreign.ZED, zed(2), ("1", "2")),
    "ai": (foreign.AI, targets, ("1", "2")),
    "openpose_list": (foreign.OPENPOSE_LIST, openpose(foreign.openpose_list, foreign.OPENPOSE18), ("", "")),
    "openpose_frame": (foreign.OPENPOSE_FRAME, openpose(foreign.openpose_frame, foreign.BODY25), ("", "")),
}


def image_messages(make, name: str, number: int):
    """(topic, message) of one image; its stamp is number + 1 seconds."""
    header = header_of(make, seconds=number + 1)
    if name == "opendr":
        for ident, pose in enumerate(poses_of(PIXELS[number]), 1):
            yield "/keypoints", foreign.opendr(make, header, pose, ident)
    elif name == "hri":
        for ident, pose in zip(("anna", "ben"), poses_of(PIXELS[number])):
            yield BODIES.replace("*", ident), foreign.hri(make, header, pose)
    else:
        yield "/keypoints", WHOLE[name][1](make, header, PIXELS[number])


def write(path, name: str, with_camera: bool = True):
    """A small bag of one family: two persons in three images."""
    make = Factory()
    with BagWriter(path, make) as bag:
        if with_camera:
            bag.write("/camera_info", camera_info(make), 0)
        for number in range(FRAMES):
            for topic, message in image_messages(make, name, number):
                bag.write(topic, message, number + 1)
    return path


IDS = {**{name: ids for name, (_, _, ids) in WHOLE.items()}, "opendr": ("1", "2"), "hri": ("anna", "ben")}


def topics_for(name: str) -> Topics:
    return Topics(keypoints=BODIES if name == "hri" else "/keypoints")


# --- bags


#: Bag -> the layout that is published; " in": of the input, where the model has not all of its points.
FOUND = {
    **dict.fromkeys(IDS, "coco17"),
    **dict.fromkeys(("zed18", "openpose_list", "opendr"), "openpose18"),
    "hri": "hri18",
    "openpose_frame in": "body25",
    "zed34 in": "zed34",
    "zed38 in": "zed38",
}
#: Bag -> the layout to state: nothing shows that its lists of 34 points are two persons.
STATED = {"pose_array": "coco17"}


@pytest.mark.parametrize("name", IDS)
def test_a_bag_of_every_family_is_lifted_in_metres(tmp_path, model_file, name):
    """The layout is found if the messages tell it, and of the family's points those are given that the model has."""
    bag = write(tmp_path / "in.mcap", name)
    stream = open_stream(str(model_file), STATED.get(name))
    done = replay(bag, stream, tmp_path / "out.mcap", topics_for(name))
    assert not done.stream.ledger.drops and done.damage is None
    assert [frame.stamp for frame in done.frames] == [n * 10**9 + 5 for n in range(1, FRAMES + 1)]
    for frame, pixels in zip(done.frames, PIXELS):
        np.testing.assert_allclose(frame.given.xy, pixels, atol=1e-3)
        assert frame.given.visible.all() and frame.keypoints.ids == IDS[name]
        assert frame.lifted.ok.all() and frame.lifted.units == "m"
    written = read_records(tmp_path / "out.mcap", ["/lifter/poses"])
    assert [len(record.message().poses) for record in written] == [2 * len(load_layout(FOUND[name]).names)] * FRAMES
    assert (done.stream.route.given.name, done.layout.name) == (FOUND.get(name + " in", FOUND[name]), FOUND[name])


SAME_ID = {
    "point_cloud2": lambda make, header, xy: outputs.keypoints_cloud(make, header, xy, np.ones(xy.shape[:2]), "00"),
    "yolo": lambda make, header, xy: with_ids(detections(make, header, xy), "detections", "id", "abc"),
    "zed18": lambda make, header, xy: foreign.zed(make, header, poses_of(xy), 0, ids=[0, 0]),
    "ai": lambda make, header, xy: with_ids(targets(make, header, xy), "targets", "track_id", 0),
}


def with_ids(message, persons: str, field: str, value):
    for person in getattr(message, persons):
        setattr(person, field, value)
    return message


@pytest.mark.parametrize("name", SAME_ID)
def test_persons_with_one_id_in_a_bag_of_every_family_with_ids(tmp_path, model_file, name):
    """They are lifted as persons without ids, and smoothing does not mix them."""
    make = Factory()
    with BagWriter(tmp_path / "in.mcap", make) as bag:
        bag.write("/camera_info", camera_info(make), 0)
        for number, xy in enumerate(PIXELS):
            header = header_of(make, 1, 33_000_000 * number)
            bag.write("/keypoints", SAME_ID[name](make, header, xy), number + 1)
    raw, smooth = (
        replay(tmp_path / "in.mcap", open_stream(str(model_file), smoothing=cutoff), tmp_path / "out.mcap")
        for cutoff in (0.0, 0.5)
    )
    for one, other in zip(raw.frames, smooth.frames, strict=True):
        assert one.keypoints.ids == ("", "") and one.lifted.ok.all()
        np.testing.assert_array_equal(one.lifted.points, other.lifted.points)
    noted = {"duplicate_ids": 2 * FRAMES}
    assert raw.stream.ledger.notes == noted and not raw.stream.ledger.drops
    assert smooth.stream.ledger.notes == noted | {"smoothing_without_ids": 2 * FRAMES}
    for record in read_records(tmp_path / "out.mcap", ["/lifter/persons"]):
        assert record.message().joint_names == ["", ""]


def test_text_ids_keep_their_numbers_with_the_text_beside_them(tmp_path, model_file):
    """Bodies of ROS4HRI come and go, in any order."""
    make, images = Factory(), (("kjsdf", "anna1"), ("anna1",), ("zzzzz", "anna1"), ("anna1", "kjsdf"))
    with BagWriter(tmp_path / "in.mcap", make) as bag:
        bag.write("/camera_info", camera_info(make), 0)
        for number, names in enumerate(images):
            for name, pose in zip(names, poses_of(PIXELS[0])):
                bag.write(BODIES.replace("*", name), foreign.hri(make, header_of(make, number + 1), pose), number + 1)
    replay(tmp_path / "in.mcap", open_stream(str(model_file)), tmp_path / "out.mcap", Topics(keypoints=BODIES))
    persons, clouds = (
        [record.message() for record in read_records(tmp_path / "out.mcap", [f"/lifter/{name}"])]
        for name in ("persons", "keypoints3d")
    )
    assert [tuple(message.joint_names) for message in persons] == list(images)
    numbers = {}
    for message, points in zip(persons, clouds, strict=True):
        assert message.header.stamp.sec == points.header.stamp.sec
        found = np.frombuffer(points.data, "<f4").reshape(points.height, points.width, -1)[:, 0, 5].tolist()
        for name, number in zip(message.joint_names, found, strict=True):
            assert numbers.setdefault(name, number) == number
    assert sorted(numbers.values()) == [2**23, 2**23 + 1, 2**23 + 2]


@pytest.mark.parametrize(
    "name, with_camera", [("opendr", True), ("opendr", False), ("yolo", True), ("yolo", False), ("hri", True)]
)
def test_a_bag_without_stamps_and_frames(tmp_path, model_file, name, with_camera):
    """Persons of one burst are one image at the time of its first message, in the frame of CameraInfo."""
    make, began, count = Factory(), 1_700_000_000 * 10**9, 5
    with BagWriter(tmp_path / "in.mcap", make) as bag:
        if with_camera:
            bag.write("/camera_info", camera_info(make), began - 1)
        for number in range(count):
            time = began + number * 33_000_000
            for topic, message in image_messages(make, name, 0):
                message.header.stamp.sec = message.header.stamp.nanosec = 0
                message.header.frame_id = ""
                bag.write(topic, message, time)
                time += 3_000_000
    stream = open_stream(str(model_file), smoothing=1.0)
    done = replay(tmp_path / "in.mcap", stream, tmp_path / "out.mcap", topics_for(name))
    assert [frame.stamp for frame in done.frames] == [began + n * 33_000_000 for n in range(count)]
    assert all(frame.keypoints.ids == IDS[name] for frame in done.frames)
    messages = count if name == "yolo" else 2 * count
    assert stream.ledger.notes == {"no_stamp": messages, "no_frame": messages} and not stream.ledger.drops
    for record in read_records(tmp_path / "out.mcap", ["/lifter/bodies", "/lifter/persons", "/lifter/poses"]):
        assert record.message().header.frame_id == ("camera_color_optical_frame" if with_camera else "")
        assert record.message().header.stamp.sec == 1_700_000_000


def test_every_type_that_can_be_read_has_such_a_bag():
    bagged = {type_name for type_name, _, _ in WHOLE.values()} | {foreign.HRI, foreign.OPENDR}
    assert bagged == set(msg_adapters.SUPPORTED) - {foreign.FORMER_YOLO, foreign.FORMER_ZED}


@pytest.mark.parametrize("name", ["zed38", "opendr", "hri"])
def test_paul_replay_reads_it(tmp_path, model_file, name):
    bag, report = write(tmp_path / "in.mcap", name), tmp_path / "report.json"
    arguments = ["replay", bag, "--model", model_file, "--json", report, "--topic", topics_for(name).keypoints]
    assert cli.main([str(argument) for argument in arguments]) == 0
    found = json.loads(report.read_text())
    assert (found["frames"], found["persons"], found["dropped"], found["units"]) == (FRAMES, 2 * FRAMES, {}, "m")


def test_one_of_several_bodies(tmp_path, model_file):
    bag = write(tmp_path / "in.mcap", "hri")
    done = replay(bag, open_stream(str(model_file)), topics=Topics(keypoints=BODIES.replace("*", "ben")))
    assert [frame.keypoints.ids for frame in done.frames] == [("ben",)] * FRAMES


def test_hri_without_a_camera_is_dropped_and_explained(tmp_path, model_file):
    stream = open_stream(str(model_file))
    done = replay(write(tmp_path / "in.mcap", "hri", with_camera=False), stream, topics=Topics(keypoints=BODIES))
    assert not done.frames and stream.ledger.drops == {"no_image_size": 2 * FRAMES}
    assert "CameraInfo" in stream.ledger.advice["no_image_size"]


def test_persons_before_the_damage_of_a_bag_are_lifted(tmp_path, model_file):
    whole = write(tmp_path / "in.mcap", "opendr").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[:-20])
    done = replay(cut, open_stream(str(model_file)))
    assert isinstance(done.damage, BagError)
    assert [frame.keypoints.persons for frame in done.frames] == [2] * FRAMES


@pytest.mark.parametrize(
    "topic, name, is_one",
    [
        ("/humans/bodies/anna/skeleton2d", BODIES, True),
        ("/humans/bodies/anna/roi", BODIES, False),
        ("/humans/bodies/a/b/skeleton2d", BODIES, False),
        ("/humans/bodies", BODIES, False),
        ("/keypoints", "/keypoints", True),
        ("/keypoints2", "/keypoints", False),
    ],
)
def test_a_star_in_a_topics_name_is_one_part_of_it(topic, name, is_one):
    assert matches(topic, name) is is_one


# --- persons in a message each


@pytest.fixture(params=["live", "bag"])
def make(request, bag_make):
    return foreign.LiveMake() if request.param == "live" else bag_make


@pytest.fixture
def stream(model_file) -> LiftStream:
    model = load_model(model_file)
    return LiftStream(Lifter(model), model.layout, min_confidence=0.3, max_persons=64)


def send(stream, make, ident: int, seconds: int = 1, frame: str = "camera", nanoseconds: int = 5):
    """One OpenDR person, who stands where nobody else does."""
    header = header_of(make, seconds, nanoseconds, frame)
    (pose,) = poses_of(seen(persons_at((0.2 * ident, 0, 4))).round())
    return stream.keypoints(foreign.OPENDR, make.through_cdr(foreign.opendr(make, header, pose, ident))).frame


def test_persons_of_one_stamp_are_one_frame(stream, make):
    assert send(stream, make, 1) is None and send(stream, make, 2) is None
    frame = send(stream, make, 3, seconds=2)
    assert frame.keypoints.ids == ("1", "2") and frame.lifted.ok.all()
    assert (frame.header.stamp.sec, frame.keypoints.stamp) == (1, 1_000_000_005)
    np.testing.assert_allclose(np.diff(frame.keypoints.xy[..., 0], axis=0), 30, atol=6)  # 0.2 m, 4 m away
    last = stream.flush()
    assert last.keypoints.ids == ("3",) and last.header.stamp.sec == 2
    assert stream.counts == dict(frames=2, persons=3, lifted=3) and not stream.ledger.drops
    assert stream.flush() is None


def test_without_any_time_every_person_is_a_frame(stream, make):
    frames = [send(stream, make, ident, seconds=0, nanoseconds=0) for ident in (1, 2)]
    assert [frame.keypoints.ids for frame in frames] == [("1",), ("2",)]
    assert stream.flush() is None


def test_another_camera_begins_a_frame(stream, make):
    send(stream, make, 1)
    assert send(stream, make, 2, frame="other_camera").keypoints.ids == ("1",)


def test_a_person_that_is_sent_twice_is_one_person(stream, make):
    assert send(stream, make, 1) is None and send(stream, make, 2) is None and send(stream, make, 1) is None
    assert stream.flush().keypoints.ids == ("1", "2")
    assert stream.ledger.drops == {"repeated_person": 1} and "relay" in stream.ledger.advice["repeated_person"]


def one_of(make, place: int, ident: int, header):
    """One OpenDR person at one of several places."""
    (pose,) = poses_of(seen(persons_at((0.4 * place - 0.5, 0, 4))).round())
    return foreign.opendr(make, header, pose, ident)


@pytest.mark.parametrize("ident", [0, -1])
def test_persons_of_one_image_without_ids_of_their_own_are_one_frame(stream, make, ident):
    """Trackers exist that give every person id 0."""
    for place in range(3):
        answer = stream.keypoints(foreign.OPENDR, make.through_cdr(one_of(make, place, ident, header_of(make))))
        assert answer.frame is None
    frame = stream.flush()
    assert frame.keypoints.ids == ("", "", "") and frame.person_numbers.tolist() == [-1, -1, -1]
    assert stream.ledger.notes == ({"duplicate_ids": 3} if ident == 0 else {}) and not stream.ledger.drops


def test_one_stamp_for_ever_does_not_gather_for_ever(stream, make):
    stream.max_persons = 3
    for ident in range(10):
        assert send(stream, make, ident) is None
    assert stream.ledger.drops == {"too_many_persons": 7} and "max_persons" in stream.ledger.advice["too_many_persons"]
    assert stream.flush().keypoints.persons == 3


def test_a_person_that_cannot_be_read_leaves_the_others(stream, make):
    send(stream, make, 1)
    assert stream.keypoints(foreign.OPENDR, foreign.opendr_of(make, header_of(make, 1), [("door", 1, 1)])).frame is None
    assert stream.ledger.drops == {"no_common_names": 1}
    assert stream.flush().keypoints.ids == ("1",)


def test_a_fault_in_lifting_loses_only_the_frame_it_was_in(stream, make, monkeypatch):
    send(stream, make, 1)
    monkeypatch.setattr(stream.lifter, "lift_in_model_layout", lambda *_: 1 / 0)
    assert send(stream, make, 2, seconds=2) is None and stream.ledger.drops == {"internal_error": 1}
    monkeypatch.undo()
    assert stream.flush().keypoints.ids == ("2",)


def test_the_size_of_an_uncalibrated_camera_is_enough_for_shares(stream, bag_make):
    (pose,) = poses_of(PIXELS[0][:1])
    message = foreign.hri(bag_make, header_of(bag_make), pose)
    stream.keypoints(foreign.HRI, message)
    assert stream.ledger.drops == {"no_image_size": 1}
    stream.camera_info(camera_info(bag_make, fx=0.0))
    stream.keypoints(foreign.HRI, message, "/humans/bodies/anna/skeleton2d")
    frame = stream.flush()
    assert frame.lifted.units == "model" and frame.keypoints.ids == ("anna",)
    np.testing.assert_allclose(frame.keypoints.xy, PIXELS[0][:1], atol=1e-3)


def test_a_layout_of_its_own_order_swaps_nothing(stream, bag_make, model_file):
    """Eyes and ears of ROS4HRI under OpenPose's layout, the swap that is easily made."""
    model = load_model(model_file)
    swapped = LiftStream(Lifter(model), load_layout("openpose18"), 0.3, 64)
    (pose,) = poses_of(PIXELS[0][:1])
    seen_by = []
    for each in (stream, swapped):
        each.camera_info(camera_info(bag_make))
        each.keypoints(foreign.HRI, foreign.hri(bag_make, header_of(bag_make), pose))
        seen_by.append(each.flush().given.xy)
    np.testing.assert_array_equal(*seen_by)
