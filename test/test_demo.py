# SPDX-License-Identifier: Apache-2.0
"""The demo's parts on two seconds of a bag: the live node and the replay give the same, stamp by stamp."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from msg_adapters.keypoints import stamp_ns
from paul_ros.errors import BagError, DemoError
from paul_ros.offline.bag_reader import read_messages, read_records, topics_of
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.demo import BAGS, _verdict, compare
from paul_ros.offline.demo_live import run_live
from paul_ros.offline.replay import replay
from paul_ros.offline.shipped_bags import find_bag
from paul_ros.stream.stream import open_stream


@pytest.fixture(scope="module")
def two_seconds(tmp_path_factory):
    """Two seconds of the crossing, from empty frames until both persons are seen; without the ground truth."""
    path = tmp_path_factory.mktemp("demo") / "short.mcap"
    with BagWriter(path) as writer:
        for record in list(read_records(find_bag("two_persons_crossing"), ["/camera_info", "/keypoints"]))[40:160]:
            writer.write_record(record)
    return path


@pytest.fixture(scope="module")
def lived(two_seconds, model_file, tmp_path_factory):
    recording = tmp_path_factory.mktemp("demo") / "lifted.mcap"
    return run_live(two_seconds, recording, str(model_file))


def test_live_equals_replay(lived, two_seconds, model_file):
    done, agreement = compare(replay(two_seconds, open_stream(model_file)), lived.recording)
    assert agreement.pop("max_difference_relative") <= 1e-6
    assert agreement == {"frames_lost": 0, "frames_unknown": 0, "frames_with_other_persons": 0, "order_kept": True}
    assert lived.sent == lived.received == len(done.frames) == 60
    assert sum(frame.lifted.ok.sum() for frame in done.frames) > 20


def test_everything_is_recorded(lived):
    counts = {topic: count for topic, (_, count) in topics_of(lived.recording).items()}
    assert {"/keypoints", "/camera_info", "/lifter/layout", "/diagnostics"} <= set(counts)
    assert counts["/lifter/poses"] == counts["/lifter/keypoints3d"] == counts["/lifter/markers"] == 60


def test_ids_and_poses_of_persons_are_those_of_the_replay(lived, two_seconds, model_file, tmp_path):
    replay(two_seconds, open_stream(model_file), tmp_path / "out.mcap")
    live, replayed = (
        {stamp_ns(message.header): message for *_, message, _ in read_messages(bag, ["/lifter/persons"])}
        for bag in (lived.recording, tmp_path / "out.mcap")
    )
    assert live.keys() == replayed.keys() and {name for m in live.values() for name in m.joint_names} == {"3", "7"}
    for stamp, message in replayed.items():
        assert live[stamp].joint_names == message.joint_names
        for one, other in zip(live[stamp].transforms, message.transforms, strict=True):
            assert str(one) == str(other)


def test_figures_of_the_node(lived):
    assert 0 < lived.start_to_ready_s < 30
    assert 10 < lived.rss_mb < 500
    assert 0 < lived.lift_us_median <= lived.lift_us_p99


@pytest.mark.parametrize(
    "change, finding",
    [
        (lambda messages: messages[:5] + messages[6:], ("frames_lost", 1)),
        (lambda messages: messages[1:] + messages[:1], ("order_kept", False)),
        (lambda messages: messages + messages[-1:], ("order_kept", False)),
    ],
)
def test_what_compare_must_find(two_seconds, model_file, tmp_path, change, finding):
    done = replay(two_seconds, open_stream(model_file), tmp_path / "out.mcap")
    records = change(list(read_records(tmp_path / "out.mcap", ["/lifter/poses"])))
    with BagWriter(tmp_path / "changed.mcap") as writer:
        # Readers follow the log times, not the order in the file.
        for record, time in zip(records, sorted(record.log_time for record in records)):
            writer.write_record(replace(record, log_time=time))
    key, value = finding
    assert compare(done, tmp_path / "changed.mcap")[1][key] == value


def test_compare_measures_the_difference(two_seconds, model_file, tmp_path):
    """One coordinate of one person moved by a hundredth of the skeleton's extent; one person left out of a frame."""
    done = replay(two_seconds, open_stream(model_file), tmp_path / "out.mcap")
    messages = [message for *_, message, _ in read_messages(tmp_path / "out.mcap", ["/lifter/poses"])]
    full = [number for number, message in enumerate(messages) if message.poses]
    points = done.frames[full[0]].lifted.points[done.frames[full[0]].lifted.ok][0]
    messages[full[0]].poses[3].position.x += 0.01 * np.ptp(points, axis=0).max()
    messages[full[-1]].poses = messages[full[-1]].poses[17:]
    with BagWriter(tmp_path / "changed.mcap", BagMessages()) as writer:
        for number, message in enumerate(messages):
            writer.write("/lifter/poses", message, number)
    agreement = compare(done, tmp_path / "changed.mcap")[1]
    assert agreement["max_difference_relative"] == pytest.approx(0.01)
    assert agreement["frames_with_other_persons"] == 1


def test_node_that_cannot_start_is_reported(two_seconds, tmp_path):
    with pytest.raises(DemoError, match="no model 'nobody'"):
        run_live(two_seconds, tmp_path / "x.mcap", "nobody")
    assert not list(tmp_path.iterdir())


def test_bags_are_found():
    assert [find_bag(name).parent for name in BAGS] == [Path(__file__).resolve().parent.parent / "bags"] * 2
    with pytest.raises(BagError, match="make_bags.py"):
        find_bag("opera")


def test_the_verdict_says_how_near_live_and_replay_are():
    lives = [{"frames_sent": 585, "max_difference_relative": 0.0}, {"frames_sent": 390, "max_difference_relative": 0.0}]
    assert _verdict(lives) == "demo passed: live output equals replay, 0 of 975 messages lost"
    lives[1]["max_difference_relative"] = 3e-8
    assert "differs from replay by less than 1e-06 of a person's size" in _verdict(lives)
