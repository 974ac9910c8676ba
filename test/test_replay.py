# SPDX-License-Identifier: Apache-2.0
"""Replay: the same bytes every time, figures that are right, reports that are whole, damage that is told."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from paul_ros.bag import BagError, BagMessages, BagWriter, read_messages, read_records, topics_of
from paul_ros.replay import Topics, evaluate, map_points, open_stream, replay
from paul_ros.report import PictureError, table, write_json, write_picture
from paul_ros.skeleton import load_layout

BAGS = Path(__file__).resolve().parent.parent / "bags"
ONE, TWO = BAGS / "one_person.mcap", BAGS / "two_persons_crossing.mcap"
# Written out, not imported: what reads these reports relies on the names.
ERRORS = {
    "n_mpjpe_mm",
    "pa_mpjpe_mm",
    "ne_flip_frame_percent",
    "ne_flip_global_percent",
    "root_error_median_mm",
    "root_error_median_percent",
}
KEYS = ERRORS | {
    "frames",
    "persons",
    "dropped",
    "reprojection_median_px",
    "certified_share",
    "ambiguous_share",
    "lift_us_median",
    "lift_us_p99",
    "baseline",
    "model",
    "bag",
    "versions",
}


def part_of(bag, path, seconds, change=lambda record: record):
    """The first seconds of a bag, each record changed or, for None, left out."""
    first = None
    with BagWriter(path) as writer:
        for record in read_records(bag):
            first = record.log_time if first is None else first
            if record.log_time - first < seconds * 1e9 and (changed := change(record)) is not None:
                writer.write_record(changed)
    return path


def without(*topics):
    return lambda record: None if record.topic in topics else record


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Three seconds of the crossing, empty frames and hidden points among them."""
    return part_of(TWO, tmp_path_factory.mktemp("bags") / "short.mcap", 3)


def test_same_bytes_twice(short, model_file, tmp_path):
    for name in ("a.mcap", "b.mcap"):
        replay(short, open_stream(model_file), tmp_path / name)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_lifted_bag_holds_inputs_and_outputs(short, model_file, tmp_path):
    done = replay(short, open_stream(model_file), tmp_path / "out.mcap")
    topics = topics_of(tmp_path / "out.mcap")
    assert {topic: count for topic, (_, count) in topics.items()} == {
        "/camera_info": 90,
        "/keypoints": 90,
        "/ground_truth/poses": 90,
        "/lifter/layout": 1,
        "/lifter/poses": 90,
        "/lifter/keypoints3d": 90,
        "/lifter/markers": 90,
    }
    copied = [r for r in read_records(tmp_path / "out.mcap") if not r.topic.startswith("/lifter/")]
    assert copied == list(read_records(short))
    for (_, _, message, _), frame in zip(read_messages(tmp_path / "out.mcap", ["/lifter/poses"]), done.frames):
        published = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses]).reshape(-1, 17, 3)
        assert np.array_equal(published, frame.lifted.points[frame.lifted.ok])
    [(_, _, layout, _)] = read_messages(tmp_path / "out.mcap", ["/lifter/layout"])
    assert json.loads(layout.data)["units"] == "m"
    latched = next(r for r in read_records(tmp_path / "out.mcap", ["/lifter/layout"]))
    assert "transient_local" in latched.qos


def test_report_keys_and_counts(model_file):
    report = evaluate(replay(TWO, open_stream(model_file)))
    assert KEYS <= set(report) and ERRORS <= set(report["baseline"])
    persons = sum(len(m.poses) // 17 for _, _, m, _ in read_messages(TWO, ["/ground_truth/poses"]))
    assert report["frames"] == 390 and report["persons"] == persons
    assert report["lifted"] + report["dropped"]["person_too_few_points"] == persons
    assert report["persons_with_truth"] == report["lifted"]
    assert json.loads(json.dumps(report)) == report
    # The model of the tests is rigid, so it is its own baseline.
    assert all(report[key] == pytest.approx(report["baseline"][key]) for key in ERRORS)


def test_the_truth_itself_has_no_error(short, model_file):
    """Predictions replaced by the truth, then moved by a known step: every error must be what it was made."""
    done = replay(short, open_stream(model_file))
    for frame in done.frames:
        frame.lifted.points[frame.lifted.ok] = done.truth[frame.stamp][frame.lifted.ok] + (0.03, 0.0, 0.04)
    report = evaluate(done)
    assert report["root_error_median_mm"] == pytest.approx(50)
    for key in ("n_mpjpe_mm", "pa_mpjpe_mm", "ne_flip_frame_percent", "ne_flip_global_percent"):
        assert report[key] == pytest.approx(0, abs=1e-4)
    distances = np.concatenate(
        [np.linalg.norm(done.truth[f.stamp][f.lifted.ok][:, 11:13].mean(1), axis=1) for f in done.frames]
    )
    assert report["root_error_median_percent"] == pytest.approx(np.median(100 * 0.05 / distances))


def test_scaled_prediction_shows_in_ne_but_not_in_n_mpjpe(short, model_file):
    done = replay(short, open_stream(model_file))
    for frame in done.frames:
        frame.lifted.points[frame.lifted.ok] = 1.25 * done.truth[frame.stamp][frame.lifted.ok]
    report = evaluate(done)
    assert report["n_mpjpe_mm"] == pytest.approx(0, abs=1e-4)
    assert report["ne_flip_frame_percent"] == pytest.approx(25)


def test_truth_that_comes_before_its_keypoints(short, model_file, tmp_path):
    """Joined by stamp, not by arrival."""
    records = list(read_records(short))
    with BagWriter(tmp_path / "late.mcap") as writer:
        for record in [r for r in records if r.topic != "/keypoints"] + [r for r in records if r.topic == "/keypoints"]:
            writer.write_record(record)
    a, b = (evaluate(replay(bag, open_stream(model_file))) for bag in (short, tmp_path / "late.mcap"))
    assert {key: a[key] for key in ERRORS} == {key: b[key] for key in ERRORS}


def test_without_truth(short, model_file, tmp_path):
    bag = part_of(short, tmp_path / "x.mcap", 9, without("/ground_truth/poses"))
    report = evaluate(replay(bag, open_stream(model_file)))
    assert all(report[key] is None and report["baseline"][key] is None for key in ERRORS)
    assert report["lifted"] > 0 and "N-MPJPE" not in table(report)


def test_without_camera_info(short, model_file, tmp_path):
    """Model units: errors that need none are given, the others are not."""
    bag = part_of(short, tmp_path / "x.mcap", 9, without("/camera_info"))
    report = evaluate(replay(bag, open_stream(model_file)))
    assert report["units"] == "model"
    assert report["n_mpjpe_mm"] > 0 and report["pa_mpjpe_mm"] > 0
    assert report["root_error_median_mm"] is None and report["ne_flip_frame_percent"] is None


def test_no_person_at_all(model_file, tmp_path):
    bag = part_of(TWO, tmp_path / "x.mcap", 0.5)
    report = evaluate(replay(bag, open_stream(model_file)))
    assert report["frames"] == 15 and report["persons"] == 0 and report["reprojection_median_px"] is None
    assert "15 frames, 0 persons" in table(report)


def test_truth_in_another_layout():
    """COCO has no pelvis: it is the mean of the hips."""
    points = np.random.default_rng(0).normal(size=(2, 17, 3))
    h36m = load_layout("h36m17")
    mapped = map_points(load_layout("coco17").map_to(h36m), points)
    assert np.allclose(mapped[:, h36m.names.index("pelvis")], points[:, 11:13].mean(1))
    assert np.allclose(mapped[:, h36m.names.index("left_knee")], points[:, 13])
    assert np.isnan(mapped).any()


def test_half_a_bag_keeps_what_was_read(model_file, tmp_path):
    half = tmp_path / "half.mcap"
    half.write_bytes(ONE.read_bytes()[: ONE.stat().st_size // 2])
    done = replay(half, open_stream(model_file), tmp_path / "out.mcap")
    assert "damaged after" in str(done.damage) and "half.mcap" in str(done.damage)
    assert 200 < len(done.frames) < 359
    assert Counter(topic for topic, *_ in read_messages(tmp_path / "out.mcap"))["/lifter/poses"] == len(done.frames)
    assert evaluate(done)["damage"] == str(done.damage)


@pytest.mark.parametrize(
    "change, clue",
    [
        (without("/keypoints"), "no messages on /keypoints; the bag holds /camera_info"),
        (lambda record: None, "none at all"),
    ],
)
def test_nothing_to_lift(short, model_file, tmp_path, change, clue):
    bag = part_of(short, tmp_path / "x.mcap", 9, change)
    with pytest.raises(BagError, match=clue):
        replay(bag, open_stream(model_file), tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    "topics, clue",
    [
        (Topics(keypoints="/camera_info", camera_info="/x"), "--topic"),
        (Topics(camera_info="/ground_truth/poses", truth="/x"), "--camera-info-topic"),
        (Topics(truth="/camera_info", camera_info="/x"), "--ground-truth-topic"),
    ],
)
def test_topic_of_the_wrong_type(short, model_file, topics, clue):
    with pytest.raises(BagError, match=clue):
        replay(short, open_stream(model_file), topics=topics)


def test_output_over_the_input_is_refused(short, model_file):
    before = short.read_bytes()
    with pytest.raises(BagError, match="name another output"):
        replay(short, open_stream(model_file), short)
    assert short.read_bytes() == before


def test_bad_messages_are_counted_and_the_rest_is_lifted(short, model_file, tmp_path):
    """A cloud of another kind in the middle of good ones."""
    make = BagMessages()
    with BagWriter(tmp_path / "x.mcap", make) as writer:
        for number, (topic, kind, message, time) in enumerate(read_messages(short)):
            if topic == "/keypoints" and number % 30 == 1:
                message.fields[0].name = "u"
            writer.write(topic, message, time)
    report = evaluate(replay(tmp_path / "x.mcap", open_stream(model_file)))
    assert report["dropped"]["wrong_fields"] + report["frames"] == 90
    assert report["dropped"]["wrong_fields"] == 6  # every tenth frame but for the three first, which hold no person


def test_pictures(short, model_file, tmp_path):
    done = replay(short, open_stream(model_file))
    for name, start in {"a.png": b"\x89PNG", "a.svg": b"<?xml", "a.pdf": b"%PDF"}.items():
        write_picture(tmp_path / name, done)
        assert (tmp_path / name).read_bytes().startswith(start)
    with pytest.raises(PictureError, match="a.odd"):
        write_picture(tmp_path / "a.odd", done)
    assert not (tmp_path / "a.odd").exists()


@pytest.mark.parametrize("left_out", ["/ground_truth/poses", "/camera_info"])
def test_picture_without_truth_or_camera(short, model_file, tmp_path, left_out):
    bag = part_of(short, tmp_path / "x.mcap", 9, without(left_out))
    write_picture(tmp_path / "x.png", replay(bag, open_stream(model_file)))
    assert (tmp_path / "x.png").stat().st_size > 10_000


def test_picture_of_nobody(model_file, tmp_path):
    bag = part_of(TWO, tmp_path / "x.mcap", 0.5)
    with pytest.raises(PictureError, match="nothing to draw"):
        write_picture(tmp_path / "x.png", replay(bag, open_stream(model_file)))


def test_report_file(short, model_file, tmp_path):
    report = evaluate(replay(short, open_stream(model_file)))
    write_json(tmp_path / "deep" / "r.json", report)
    assert json.loads((tmp_path / "deep" / "r.json").read_text()) == report
    assert [file.name for file in (tmp_path / "deep").iterdir()] == ["r.json"]
