# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag: the camera that is meant, and names that do not exist."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from test_foreign_bags import BODIES, Factory, image_messages

from paul_ros import cli
from paul_ros.errors import BagError, WrongTopicError
from paul_ros.offline.bag_reader import read_records
from paul_ros.offline.bag_topics import Topics, topics_in
from paul_ros.offline.bag_writer import BagWriter

ONE = Path(__file__).resolve().parent.parent / "bags" / "one_person.mcap"


def renamed(path: Path, *names: tuple[str, str], later: int = 0) -> Path:
    """The first records of the shipped bag, each once under every new name of its topic."""
    with BagWriter(path) as writer:
        for _, record in zip(range(90), read_records(ONE)):
            for name in [new for old, new in names if old == record.topic] or [record.topic]:
                writer.write_record(replace(record, topic=name, log_time=record.log_time + later))
    return path


def test_the_only_camera_is_found_whatever_its_name(tmp_path, model_file, capsys):
    bag = renamed(tmp_path / "a.mcap", ("/camera_info", "/rig/left/my_info"))
    assert cli.main(["replay", str(bag), "--model", str(model_file), "--json", str(tmp_path / "r.json")]) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["camera_info_topic"], report["units"]) == ("/rig/left/my_info", "m")
    assert report["root_error_median_mm"] > 0
    assert (
        "keypoints /keypoints, camera /rig/left/my_info (rectified image; its distortion: none)\n"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    "keypoints, hint",
    [("/cam1/keypoints", "; /cam1/camera_info has the namespace of /cam1/keypoints"), ("/yolo/tracking", "")],
)
@pytest.mark.parametrize("command", ["replay", "view"])
def test_several_cameras_need_a_choice(tmp_path, model_file, capsys, command, keypoints, hint):
    names = ("/camera_info", "/cam1/camera_info"), ("/camera_info", "/cam2/camera_info"), ("/keypoints", keypoints)
    bag = renamed(tmp_path / "a.mcap", *names)
    arguments = [command, str(bag), "--model", str(model_file), "--topic", keypoints]
    output = ["-o", str(tmp_path / "film.png")] if command == "view" else []
    assert cli.main([*arguments, *output]) == 1
    assert capsys.readouterr().err == (
        f"paul: {bag}: CameraInfo of 2 cameras, on /cam1/camera_info, /cam2/camera_info: choose the camera of the "
        f"keypoints with --camera-info-topic{hint}\n"
    )
    assert cli.main([*arguments, *output, "--camera-info-topic", "/cam2/camera_info"]) == 0


def test_the_usual_name_is_no_choice_among_several(tmp_path):
    bag = renamed(tmp_path / "a.mcap", ("/camera_info", "/camera_info"), ("/camera_info", "/other/camera_info"))
    with pytest.raises(BagError, match="2 cameras"):
        Topics().found_in(bag)


def test_a_camera_without_messages_is_none(tmp_path):
    """A recorder lists every topic that it subscribed to."""
    bag = tmp_path / "a.mcap"
    records = list(zip(range(30), read_records(ONE)))
    with BagWriter(bag) as writer:
        silent = next(record for _, record in records if record.topic == "/camera_info")
        writer._add_channel(replace(silent, topic="/silent/camera_info"))
        for _, record in records:
            writer.write_record(record)
    assert "/silent/camera_info" not in topics_in(bag)
    assert Topics().found_in(bag).camera_info == "/camera_info"
    with pytest.raises(BagError, match="no messages on /silent/camera_info"):
        Topics(camera_info="/silent/camera_info").found_in(bag)


@pytest.mark.parametrize(
    "topics, clue",
    [
        (Topics(keypoints="/keypoint"), "/keypoint, did you mean '/keypoints'\\? .*--topic"),
        (Topics(keypoints="/humans/*/skeleton2d"), "no messages on /humans/.*/skeleton2d; .*--topic"),
        (Topics(camera_info="/camera/camera_info"), "did you mean '/camera_info'\\? .*--camera-info-topic"),
        (Topics(truth="/truth"), "no messages on /truth.*/ground_truth/poses .*--ground-truth-topic"),
        (Topics(depth="/depth"), "no messages on /depth; the bag holds .*, and depth must be a sensor_msgs/msg/Image"),
    ],
)
def test_given_topics_must_exist(topics, clue):
    with pytest.raises(BagError, match=clue):
        topics.found_in(ONE)


@pytest.mark.parametrize(
    "topics", [Topics(keypoints="/camera_info"), Topics(truth="/keypoints"), Topics(depth="/keypoints")]
)
def test_given_topics_must_have_the_right_type(topics):
    with pytest.raises(WrongTopicError, match="not readable as"):
        topics.found_in(ONE)


def test_without_a_camera_there_is_none(tmp_path):
    bag = tmp_path / "a.mcap"
    with BagWriter(bag) as writer:
        for _, record in zip(range(30), read_records(ONE, ["/keypoints"])):
            writer.write_record(record)
    found = Topics().found_in(bag)
    assert (found.camera_info, found.truth, found.depth, found.all) == (None, None, None, ("/keypoints",))


def foreign(path: Path, name: str, *topics: str) -> Path:
    make = Factory()
    with BagWriter(path, make) as writer:
        for topic, message in image_messages(make, name, 0):
            for each in topics or [topic]:
                writer.write(each, message, 0)
    return path


def test_the_only_topic_of_a_type_for_keypoints_is_found(tmp_path):
    assert Topics().found_in(foreign(tmp_path / "a.mcap", "yolo", "/yolo/tracking")).keypoints == "/yolo/tracking"
    two = foreign(tmp_path / "b.mcap", "yolo", "/yolo/tracking", "/yolo/detections")
    with pytest.raises(BagError, match="no messages on /keypoints.*/yolo/tracking .*/yolo/detections .*--topic"):
        Topics().found_in(two)
    with pytest.raises(BagError, match="no messages on /keypoints.*/humans/bodies/anna/skeleton2d"):
        Topics().found_in(foreign(tmp_path / "c.mcap", "hri"))
    assert Topics(BODIES).found_in(tmp_path / "c.mcap").keypoints == BODIES


def test_types_that_hold_other_things_are_not_guessed(tmp_path):
    bag = renamed(tmp_path / "a.mcap", ("/keypoints", "/lidar/points"))
    with pytest.raises(BagError, match="no messages on /keypoints.*/lidar/points"):
        Topics().found_in(bag)


def test_a_bag_without_a_summary_is_read_whole(tmp_path):
    """As a killed recorder leaves it; and a folder has the topics of all its files."""
    cut = tmp_path / "bag" / "bag_0.mcap"
    cut.parent.mkdir()
    cut.write_bytes(ONE.read_bytes()[:300_000])
    assert topics_in(cut) == topics_in(ONE)
    renamed(tmp_path / "bag" / "bag_1.mcap", ("/camera_info", "/second/camera_info"), later=20 * 10**9)
    assert set(topics_in(cut.parent)) == {*topics_in(ONE), "/second/camera_info"}


def test_a_bag_that_cannot_be_read_is_an_error(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"no bag")
    for bag in (tmp_path / "x.mcap", tmp_path / "nowhere.mcap"):
        with pytest.raises(BagError, match=bag.name):
            topics_in(bag)
