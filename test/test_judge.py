# SPDX-License-Identifier: Apache-2.0
"""Judging while a bag is read: frames without metres, figures that are missing, memory that does not grow."""

from __future__ import annotations

import gc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_replay import ERRORS, ONE, TWO, part_of, without

from paul_ros.offline import judge as module
from paul_ros.offline.bag_reader import read_messages, read_records
from paul_ros.offline.bag_topics import Topics
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.judge import Judge, evaluate
from paul_ros.offline.replay import LiftedFrame, replay
from paul_ros.offline.report import table
from paul_ros.stream.stream import open_stream


def first(bag: Path, path: Path, messages: int, late: int = 0) -> Path:
    """The first messages of each topic; CameraInfo begins so many messages later, and has another name."""
    seen: dict[str, int] = {}
    with BagWriter(path) as writer:
        for record in read_records(bag):
            seen[record.topic] = seen.get(record.topic, 0) + 1
            if seen[record.topic] <= messages and (record.topic != "/camera_info" or seen[record.topic] > late):
                writer.write_record(record)
    return path


def judged(bag: Path, model_file: Path, keep: int | None = 0, topics: Topics = Topics()):
    """A replay and its report as the command makes them, without keeping frames."""
    stream = open_stream(str(model_file))
    found = topics.found_in(bag)
    judge = Judge(stream, found.truth is not None)
    done = replay(bag, stream, topics=found, listener=judge, keep=keep)
    return done, judge.report(done)


def timeless(report: dict) -> dict:
    return {key: value for key, value in report.items() if not key.startswith("lift_us")}


@pytest.mark.parametrize("batch", [1, 7, 256])
def test_judging_while_reading_gives_the_same_figures(tmp_path, model_file, monkeypatch, batch):
    """To the bit; only a batch of one person may be summed in another order."""
    bag = part_of(TWO, tmp_path / "x.mcap", 4)
    whole = evaluate(replay(bag, open_stream(str(model_file))))
    monkeypatch.setattr(module, "_BATCH", batch)
    done, report = judged(bag, model_file)
    assert not done.frames and not done.truth and report["persons_with_truth"] > 100
    if batch == 256:
        assert timeless(report) == timeless(whole)
    for one, other in ((report, whole), (report["baseline"], whole["baseline"])):
        assert {key: one[key] for key in ERRORS} == pytest.approx({key: other[key] for key in ERRORS}, rel=1e-12)


@pytest.mark.parametrize("late", [1, 20, 39])
def test_frames_without_metres_are_left_out_of_metric_figures(tmp_path, model_file, late):
    """The rest is as if the bag began with its first CameraInfo; errors without units are of all frames."""
    bag = first(ONE, tmp_path / "late.mcap", 40, late)
    _, report = judged(bag, model_file)
    assert (report["units"], report["frames_without_metres"], report["frames"]) == ("mixed", late, 40)
    assert (report["persons_with_truth"], report["persons_with_truth_in_metres"]) == (40, 40 - late)
    _, whole = judged(first(ONE, tmp_path / "whole.mcap", 40), model_file)
    assert (whole["units"], whole["frames_without_metres"]) == ("m", 0)
    assert report["pa_mpjpe_mm"] == pytest.approx(whole["pa_mpjpe_mm"], rel=0.1)
    times = [log_time for _, _, _, log_time in read_messages(bag, ["/camera_info"])]
    with BagWriter(tmp_path / "rest.mcap") as writer:
        for record in read_records(bag):
            if record.log_time >= times[0]:
                writer.write_record(record)
    _, rest = judged(tmp_path / "rest.mcap", model_file)
    for key in ERRORS - {"n_mpjpe_mm", "pa_mpjpe_mm"} | {"distance_sigma_median_m", "distance_within_1_sigma_share"}:
        assert report[key] == rest[key] is not None
    assert "left out of NE, root and distance errors" in table(report)
    assert f"{late} frame{'s' * (late > 1)} without metres" in table(report)


def test_units_are_those_of_frames_that_show_somebody(tmp_path, model_file):
    """The bag begins with empty frames; a CameraInfo that comes among them is not late."""
    _, report = judged(first(TWO, tmp_path / "x.mcap", 60, late=10), model_file)
    assert (report["units"], report["frames_without_metres"]) == ("m", 0) and report["lifted"] > 20


def test_a_flip_is_not_counted_across_units(tmp_path, model_file):
    _, mixed = judged(first(ONE, tmp_path / "late.mcap", 40, 20), model_file)
    _, whole = judged(first(ONE, tmp_path / "whole.mcap", 40), model_file)
    assert (mixed["pairs_of_frames"], whole["pairs_of_frames"]) == (38, 39)


METRIC = ERRORS - {"n_mpjpe_mm", "pa_mpjpe_mm"} | {"distance_sigma_median_m"}


@pytest.mark.parametrize(
    "left_out, keys, why",
    [
        ("/camera_info", METRIC, "no metres: the bag has no CameraInfo"),
        ("/ground_truth/poses", ERRORS, "the bag has no ground truth"),
    ],
)
def test_a_missing_figure_says_why(tmp_path, model_file, left_out, keys, why):
    _, report = judged(part_of(ONE, tmp_path / "x.mcap", 1, without(left_out)), model_file)
    assert {key for key, reason in report["unavailable"].items() if reason == why} >= keys
    assert all(report[key] is None for key in report["unavailable"])
    shown = table(report)
    assert why in shown or (" - " not in shown and not report["persons_with_truth"])


def test_every_missing_figure_says_why(tmp_path, model_file):
    """Whatever is None has a reason, but for what is no figure."""
    _, nobody = judged(part_of(TWO, tmp_path / "x.mcap", 0.5), model_file)
    nameless = replay(part_of(ONE, tmp_path / "y.mcap", 1), open_stream(str(model_file)))
    for frame in nameless.frames:
        object.__setattr__(frame.keypoints, "ids", ("",))
    rootless = replay(part_of(ONE, tmp_path / "z.mcap", 1), open_stream(str(model_file)))
    for truth in rootless.truth.values():
        truth[:, 11] = np.nan
    reports = nobody, evaluate(nameless), evaluate(rootless)
    for report in reports:
        assert {key for key, value in report.items() if value is None} - {"damage"} == set(report["unavailable"])
    whys = [
        report["unavailable"].get(key)
        for report, key in zip(reports, ("n_mpjpe_mm", "flips_per_1000_frames", "root_error_median_mm"))
    ]
    assert whys == ["nobody was lifted", "no person has an id", "the ground truth lacks the root"]


@pytest.mark.parametrize("order", ["first", "last", "backwards"])
def test_truth_is_joined_by_stamp_whenever_it_comes(tmp_path, model_file, order):
    bag = part_of(TWO, tmp_path / "x.mcap", 3)
    expected = evaluate(replay(bag, open_stream(str(model_file))))
    records = list(read_records(bag))
    truth = [record for record in records if record.topic == "/ground_truth/poses"]
    rest = [record for record in records if record.topic != "/ground_truth/poses"]
    ordered = {"first": truth + rest, "last": rest + truth, "backwards": rest + truth[::-1]}[order]
    with BagWriter(tmp_path / "y.mcap") as writer:
        for time, record in enumerate(ordered):
            writer.write_record(replace(record, log_time=time))
    _, report = judged(tmp_path / "y.mcap", model_file)
    for key in ERRORS:
        assert report[key] == pytest.approx(expected[key], rel=1e-12)


def long_bag(path: Path, rounds: int, truth_every: int) -> Path:
    """Fifteen frames of the shipped bag, repeated with stamps moved on by more than a frame waits for its truth."""
    messages = list(read_messages(first(ONE, path.with_suffix(".part.mcap"), 15)))
    with BagWriter(path) as writer:
        for number in range(rounds):
            for index, (topic, _, message, time) in enumerate(messages):
                time += number * 70 * 10**9
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(time, 10**9)
                if topic != "/ground_truth/poses" or index % truth_every == 0:
                    writer.write(topic, message, time)
    return path


@pytest.mark.parametrize(
    "keep, truth_every", [(0, 1), (0, 2), (5, 1)], ids=["all have a truth", "half have one", "for a picture"]
)
def test_memory_does_not_grow_with_the_bag(tmp_path, model_file, monkeypatch, keep, truth_every):
    """Frames are let go, and so is a truth without a frame; a kept frame takes 10,000 bytes."""
    monkeypatch.setattr(module, "_BATCH", 8)
    bag = long_bag(tmp_path / "long.mcap", 8, truth_every)
    stream, found = open_stream(str(model_file)), Topics().found_in(bag)
    judge = Judge(stream, expects_truth=True)
    done = replay(bag, stream, topics=found, listener=judge, keep=keep)
    gc.collect()
    alive = [thing for thing in gc.get_objects() if isinstance(thing, LiftedFrame)]
    assert len(alive) <= 2 * keep + 8 + 15 and len(judge._truth) <= 15
    assert len(done.frames) <= 2 * keep and set(done.truth) <= {frame.stamp for frame in done.frames}
    assert judge.report(done)["persons_with_truth"] == 8 * len(range(0, 15, truth_every))


def test_kept_frames_are_even_and_have_their_truth(tmp_path, model_file):
    bag = part_of(ONE, tmp_path / "x.mcap", 3)
    everything = replay(bag, open_stream(str(model_file)))
    some, _ = judged(bag, model_file, keep=10)
    assert 10 <= len(some.frames) <= 20
    assert [frame.stamp for frame in some.frames] == [frame.stamp for frame in everything.frames[::8]]
    for frame in some.frames:
        np.testing.assert_array_equal(some.truth[frame.stamp], everything.truth[frame.stamp])
