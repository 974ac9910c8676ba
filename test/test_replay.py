# SPDX-License-Identifier: Apache-2.0
"""Replay: the same bytes every time, right figures, whole reports, damage that is reported."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from paul_ros import metrics
from paul_ros.errors import BagError, OutputError, PictureError
from paul_ros.files import write_json
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.offline.bag_reader import read_messages, read_records, topics_of
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_topics import Topics
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.depth_flips import count_flips
from paul_ros.offline.judge import evaluate
from paul_ros.offline.picture import write_picture
from paul_ros.offline.replay import replay
from paul_ros.offline.report import table
from paul_ros.stream.stream import LiftStream, open_stream

ROOT = Path(__file__).resolve().parent.parent
BAGS = ROOT / "bags"
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
        "/lifter/layout": 2,
        "/lifter/poses": 90,
        "/lifter/bodies": 90,
        "/lifter/persons": 90,
        "/lifter/keypoints3d": 90,
        "/lifter/markers": 90,
    }
    copied = [r for r in read_records(tmp_path / "out.mcap") if not r.topic.startswith("/lifter/")]
    assert copied == list(read_records(short))
    for (_, _, message, _), frame in zip(read_messages(tmp_path / "out.mcap", ["/lifter/poses"]), done.frames):
        published = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses]).reshape(-1, 17, 3)
        assert np.array_equal(published, frame.lifted.points[frame.lifted.ok])
    # The first frames show nobody, so the input's layout is known only later.
    described = [
        json.loads(message.data) for _, _, message, _ in read_messages(tmp_path / "out.mcap", ["/lifter/layout"])
    ]
    assert [layout["input_layout"] for layout in described] == [None, "coco17"]
    assert all(layout["units"] == "m" and layout["layout"] == "coco17" for layout in described)
    latched = next(r for r in read_records(tmp_path / "out.mcap", ["/lifter/layout"]))
    assert "transient_local" in latched.qos


def test_report_keys_and_counts(model_file):
    stream = open_stream(model_file)
    stream.lifter = Lifter(stream.lifter.model.rigid())
    report = evaluate(replay(TWO, stream))
    assert KEYS <= set(report) and ERRORS <= set(report["baseline"])
    persons = sum(len(m.poses) // 17 for _, _, m, _ in read_messages(TWO, ["/ground_truth/poses"]))
    assert report["frames"] == 390 and report["persons"] == persons
    assert report["lifted"] + report["dropped"]["person_too_few_points"] == persons
    assert report["persons_with_truth"] == report["lifted"]
    assert json.loads(json.dumps(report)) == report
    # A rigid model is its own baseline.
    assert all(report[key] == report["baseline"][key] for key in ERRORS)


def test_the_truth_itself_has_no_error(short, model_file):
    """Predictions are replaced by the truth and moved by a known step, which fixes every error."""
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


@pytest.mark.parametrize("bag, most_mm", [(ONE, 58), (TWO, 45)], ids=["one", "two"])
def test_the_shipped_model_is_as_good_as_documented(bag, most_mm):
    """The main figures: shape at least halves the error of a rigid model, and left is never taken for right."""
    report = evaluate(replay(bag, open_stream()))
    assert report["persons_with_truth"] == report["lifted"] > 0.9 * report["persons"]
    assert report["pa_mpjpe_mm"] <= min(most_mm, 0.5 * report["baseline"]["pa_mpjpe_mm"])
    assert report["ne_flip_global_percent"] <= 1.1 * report["ne_flip_frame_percent"]


def test_the_shipped_models_are_small():
    files = list((ROOT / "paul_ros" / "models").glob("*.npz"))
    assert files and all(file.stat().st_size <= 8_000_000 for file in files)


@pytest.fixture
def partial(short, model_file):
    """A replay whose truth lacks points, others in every second frame; and which points (P,) each frame has."""
    done = replay(short, open_stream(model_file))
    has = {}
    for number, frame in enumerate(done.frames):
        has[frame.stamp] = np.ones(17, bool)
        has[frame.stamp][[3, 4] if number % 2 else [5, 7, 9]] = False
        done.truth[frame.stamp][:, ~has[frame.stamp]] = np.nan
    return done, has


def test_truth_of_some_points(partial):
    """The errors are those of the measures over the points that have a truth."""
    done, has = partial
    report = evaluate(done)
    parts = {"n_mpjpe": [], "pa_mpjpe": [], "normalised_error": [], "mirrored": []}
    for frame in done.frames:
        points = frame.lifted.points[frame.lifted.ok][:, has[frame.stamp]]
        truth = done.truth[frame.stamp][frame.lifted.ok][:, has[frame.stamp]]
        for name in list(parts)[:3]:
            parts[name] += getattr(metrics, name)(points, truth).tolist()
        parts["mirrored"] += metrics.normalised_error(metrics.flip_depth(points), truth).tolist()
    mean = {name: np.mean(values) for name, values in parts.items()}
    assert report["persons_with_truth"] == report["lifted"] == len(parts["n_mpjpe"])
    assert report["points_with_truth_share"] == pytest.approx(
        np.average([has[f.stamp].mean() for f in done.frames], weights=[f.lifted.ok.sum() for f in done.frames])
    )
    assert report["n_mpjpe_mm"] == pytest.approx(1000 * mean["n_mpjpe"])
    assert report["pa_mpjpe_mm"] == pytest.approx(1000 * mean["pa_mpjpe"])
    each = np.minimum(parts["normalised_error"], parts["mirrored"]).mean()
    assert report["ne_flip_frame_percent"] == pytest.approx(100 * each)
    assert report["ne_flip_global_percent"] == pytest.approx(100 * min(mean["normalised_error"], mean["mirrored"]))
    assert report["root_error_median_mm"] == pytest.approx(
        1000 * np.median(np.concatenate([root_errors(done, frame) for frame in done.frames]))
    )


def root_errors(done, frame):
    ok = frame.lifted.ok
    hips = frame.lifted.points[ok][:, 11:13].mean(1), done.truth[frame.stamp][ok][:, 11:13].mean(1)
    return np.linalg.norm(hips[0] - hips[1], axis=1)


def test_table_names_the_judged_persons(short, model_file, partial):
    whole, some = (table(evaluate(done)) for done in (replay(short, open_stream(model_file)), partial[0]))
    report = evaluate(partial[0])
    left_out = 100 * (1 - report["lifted"] / report["persons"])
    assert left_out > 0
    line = f"errors of {report['lifted']} of {report['persons']} persons, {left_out:.1f} % left out"
    assert f"{line}\n" in whole
    assert f"{line}, over {100 * report['points_with_truth_share']:.0f} % of their points\n" in some


def test_truth_without_a_point_of_the_root(short, model_file):
    done = replay(short, open_stream(model_file))
    for truth in done.truth.values():
        truth[:, 11] = np.nan
    report = evaluate(done)
    assert report["n_mpjpe_mm"] > 0 and report["ne_flip_frame_percent"] > 0
    assert report["root_error_median_mm"] is None and report["root_error_median_percent"] is None


@pytest.mark.parametrize(
    "value, points", [(0.0, 17), (2.5, 17), (np.nan, 17), (np.nan, 14)], ids=["zero", "one place", "none", "three"]
)
def test_degenerate_truth_is_ignored(short, model_file, value, points):
    """Points in one place fit any shape scaled to nothing, and three points nearly any."""
    done = replay(short, open_stream(model_file))
    for truth in done.truth.values():
        truth[:, :points] = value
    report = evaluate(done)
    assert report["persons_with_truth"] == 0 and all(report[key] is None for key in ERRORS)
    assert report["points_with_truth_share"] is None and "MPJPE" not in table(report)


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


@pytest.mark.parametrize("bag", [ONE, TWO])
def test_another_layout_of_as_many_points_is_reported(bag, tmp_path):
    """COCO's points in the order of Human3.6M have the right number, so only their shapes reveal them."""
    part = part_of(bag, tmp_path / "x.mcap", 4)
    right, wrong = (evaluate(replay(part, open_stream(None, layout))) for layout in ("coco17", "h36m17"))
    assert not right["noted"] and "noted" not in table(right)
    assert wrong["noted"]["unlike_the_model"] > 0.9 * wrong["lifted"] > 50
    noted = next(line for line in table(wrong).splitlines() if "noted" in line)
    assert "layout 'h36m17'" in noted and "set `layout` to" in noted


def assert_dashes_are_explained(shown: str, *reasons: str) -> None:
    """Every row with a "-" is named by a line below the table, and these lines are there."""
    lines = shown.splitlines()
    names = {line[:22].strip() for line in lines if " - " in f"{line[22:]} " and not line.startswith(" - ")}
    explained = {name for line in lines if line.startswith(" - ") for name in line[3:].partition(":")[0].split("; ")}
    assert names == explained and all(reason in shown for reason in reasons), shown


def test_every_missing_figure_has_its_reason(tmp_path):
    """Without CameraInfo there are no metres, and without ids there are no flips."""
    with BagWriter(tmp_path / "x.mcap") as writer:
        for record in read_records(ONE, ["/keypoints", "/ground_truth/poses"]):
            writer.write_record(record)
    report = evaluate(replay(tmp_path / "x.mcap", open_stream()))
    why = "no metres: the bag has no CameraInfo"
    assert_dashes_are_explained(
        table(report), f" - NE, flip per frame; NE, one flip for all; root error, median: {why}"
    )
    report = evaluate(replay(ONE, open_stream()))
    assert_dashes_are_explained(table(report))


def test_no_person_at_all(model_file, tmp_path):
    bag = part_of(TWO, tmp_path / "x.mcap", 0.5)
    report = evaluate(replay(bag, open_stream(model_file)))
    assert report["frames"] == 15 and report["persons"] == 0 and report["reprojection_median_px"] is None
    assert "15 frames, 0 persons" in table(report)
    assert_dashes_are_explained(table(report), "flips in depth; lift, median: nobody was lifted")


def test_truth_in_another_layout():
    """COCO has no pelvis: it is the mean of the hips."""
    points = np.random.default_rng(0).normal(size=(2, 17, 3))
    h36m = load_layout("h36m17")
    mapped = load_layout("coco17").map_to(h36m).values(points)
    assert np.allclose(mapped[:, h36m.names.index("pelvis")], points[:, 11:13].mean(1))
    assert np.allclose(mapped[:, h36m.names.index("left_knee")], points[:, 13])
    assert np.isnan(mapped).any()


def test_half_a_bag_keeps_what_was_read(model_file, tmp_path):
    half = tmp_path / "half.mcap"
    half.write_bytes(ONE.read_bytes()[: ONE.stat().st_size // 2])
    done = replay(half, open_stream(model_file), tmp_path / "out.mcap")
    assert "damaged:" in str(done.damage) and "half.mcap" in str(done.damage)
    assert 200 < len(done.frames) < 359
    assert Counter(topic for topic, *_ in read_messages(tmp_path / "out.mcap"))["/lifter/poses"] == len(done.frames)
    assert evaluate(done)["damage"] == str(done.damage)


@pytest.mark.parametrize(
    "change, clue",
    [
        (
            without("/keypoints"),
            "no messages on /keypoints; the topics with a type for keypoints are /ground_truth/poses .*--topic",
        ),
        (lambda record: None, "none at all"),
    ],
    ids=["other topics", "empty"],
)
def test_nothing_to_lift(short, model_file, tmp_path, change, clue):
    bag = part_of(short, tmp_path / "x.mcap", 9, change)
    with pytest.raises(BagError, match=clue):
        replay(bag, open_stream(model_file), tmp_path / "out.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["x.mcap"]


@pytest.mark.parametrize(
    "topics, clue",
    [
        (Topics(keypoints="/camera_info"), "sensor_msgs/msg/CameraInfo, which is not readable as keypoints.*--topic"),
        (Topics(camera_info="/ground_truth/poses"), "--camera-info-topic"),
        (Topics(truth="/keypoints"), "--ground-truth-topic"),
    ],
)
def test_topic_of_the_wrong_type(short, model_file, tmp_path, topics, clue):
    with pytest.raises(BagError, match=clue):
        replay(short, open_stream(model_file), tmp_path / "out.mcap", topics)
    assert not list(tmp_path.iterdir())


def test_output_that_cannot_be_written_is_refused_before_the_work(short, model_file, tmp_path):
    for output, clue in (tmp_path, "it is a folder"), (Path("/proc/x.mcap"), "cannot write /proc/x.mcap"):
        lifted = []
        with pytest.raises(OutputError, match=clue):
            replay(short, open_stream(model_file), output, on_frame=lambda: lifted.append(1))
        assert not lifted
    assert not list(tmp_path.parent.glob(f"{tmp_path.name}*.part"))


def test_output_over_the_input_is_refused(short, model_file):
    before = short.read_bytes()
    with pytest.raises(OutputError, match="name another output"):
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
    assert f"\n  dropped: 6 wrong_fields: {report['advice']['wrong_fields']}\n" in table(report)
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


@pytest.mark.parametrize("left_out", ["/nothing", "/camera_info"])
@pytest.mark.parametrize(
    "bag, value, points",
    [
        (TWO, np.nan, [11]),
        (TWO, np.inf, [0, 12, 16]),
        (ONE, np.nan, range(16)),
        (ONE, -1e308, range(17)),
        (ONE, 0.0, range(17)),
    ],
    ids=["no hip", "infinite", "one point", "far off", "zero"],
)
def test_picture_over_an_odd_truth(model_file, tmp_path, left_out, bag, value, points):
    """The truth of the first person in every message is changed; points that cannot be drawn are left out."""
    with BagWriter(tmp_path / "x.mcap") as writer:
        for topic, _, message, time in list(read_messages(bag))[380:410]:
            if topic == "/ground_truth/poses":
                for point in points:
                    where = message.poses[point].position
                    where.x = where.y = where.z = value
            if topic != left_out:
                writer.write(topic, message, time)
    done = replay(tmp_path / "x.mcap", open_stream(model_file))
    assert all(np.isnan(truth[0, list(points)]).all() for truth in done.truth.values())
    write_picture(tmp_path / "x.png", done)
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


def test_the_distance_is_as_wrong_as_it_says(short, model_file):
    """Distances wrong by one and a half sigma lie within two, not within one."""
    done = replay(short, open_stream(model_file))
    report = evaluate(done)
    assert 0.1 < report["distance_sigma_median_m"] < 1
    for frame in done.frames:
        far = np.linalg.norm(done.truth[frame.stamp][:, 11:13].mean(1), axis=1, keepdims=True)
        direction = done.truth[frame.stamp][:, 11:13].mean(1) / far
        frame.lifted.root[:] = direction * (far + 1.5 * frame.lifted.distance_sigma[:, None])
    report = evaluate(done)
    assert (report["distance_within_1_sigma_share"], report["distance_within_2_sigma_share"]) == (0, 1)


def test_without_metres_no_distance_is_stated(short, model_file, tmp_path):
    bag = part_of(short, tmp_path / "x.mcap", 9, without("/camera_info"))
    report = evaluate(replay(bag, open_stream(model_file)))
    assert report["distance_sigma_median_m"] is None
    assert report["unavailable"]["distance_sigma_median_m"] == "no metres: the bag has no CameraInfo"


def test_flips_are_counted(model_file):
    """Persons are mirrored in depth in single frames while their images stay."""
    done = replay(TWO, open_stream(model_file))
    clean = count_flips(done.frames)
    for frame in done.frames[100:200:10]:
        frame.lifted.points[:] = mirrored_in_depth(frame.lifted)
    lifted = sum(frame.lifted.ok.sum() for frame in done.frames[100:200:10])
    counted = count_flips(done.frames)
    assert counted["pairs_of_frames"] == clean["pairs_of_frames"] > 500
    new = (counted["flips_per_1000_frames"] - clean["flips_per_1000_frames"]) * counted["pairs_of_frames"] / 1000
    # There and back, but for persons that are about flat to the camera: their mirror image is hardly another.
    assert lifted < new <= 2 * lifted


def mirrored_in_depth(lifted):
    """Points across the plane through the root that faces the camera."""
    ray = lifted.root / np.linalg.norm(lifted.root, axis=1, keepdims=True)
    depth = ((lifted.points - lifted.root[:, None]) * ray[:, None]).sum(2, keepdims=True)
    return lifted.points - 2 * depth * ray[:, None]


@pytest.fixture(scope="module")
def deepest(tmp_path_factory):
    """The frame whose person differs most from its mirror image."""
    bag = part_of(ONE, tmp_path_factory.mktemp("bags") / "one.mcap", 4)
    return max(
        replay(bag, open_stream()).frames,
        key=lambda frame: np.abs(mirrored_in_depth(frame.lifted) - frame.lifted.points).max(),
    )


@pytest.mark.parametrize(
    "growth, shift, flips",
    [(0.0, 0.0, 1), (0.29, 0.0, 1), (0.31, 0.0, 0), (-0.31, 0.0, 0), (0.0, 500.0, 1)],
    ids=["still", "moves a little", "grows", "shrinks", "walks by"],
)
def test_a_flip_needs_an_image_that_stays(deepest, growth, shift, flips):
    """A person that moves in the image by 30 % of its size may have turned; a shift does not count."""
    lifted = replace(deepest.lifted, points=mirrored_in_depth(deepest.lifted))
    middle = deepest.given.xy[deepest.given.visible].mean(0)
    given = replace(deepest.given, xy=deepest.given.xy + growth * (deepest.given.xy - middle) + shift)
    counted = count_flips([deepest, replace(deepest, lifted=lifted, given=given)])
    assert counted == {"pairs_of_frames": 1, "flips_per_1000_frames": 1000 * flips}


def test_a_model_without_metres_has_the_attitudes_and_the_flips_of_one_with_them(short):
    model = load_model("human")
    unscaled = replace(model, header={**model.header, "metres_per_unit": None, "stature": None})
    metric, plain = (evaluate(replay(short, LiftStream(Lifter(each), None, 0.3, 64))) for each in (model, unscaled))
    assert (metric["units"], plain["units"]) == ("m", "model")
    for key in ("n_mpjpe_mm", "pa_mpjpe_mm", "flips_per_1000_frames"):
        assert plain[key] == pytest.approx(metric[key], rel=1e-6), key


def test_persons_without_id_have_no_flips(short, model_file):
    done = replay(short, open_stream(model_file))
    for frame in done.frames:
        object.__setattr__(frame.keypoints, "ids", ("",) * len(frame.keypoints.ids))
    assert count_flips(done.frames) == {"pairs_of_frames": 0, "flips_per_1000_frames": None}


def test_the_filter_works_in_replay_as_in_the_stream(short, model_file, tmp_path):
    """The bag holds the filtered points."""
    raw, calm = (replay(short, open_stream(model_file, smoothing=hz), tmp_path / f"{hz}.mcap") for hz in (0.0, 0.5))
    moved = [np.abs(a.lifted.points - b.lifted.points)[a.lifted.ok] for a, b in zip(raw.frames, calm.frames)]
    assert np.concatenate(moved).max() > 0.05
    for (_, _, message, _), frame in zip(read_messages(tmp_path / "0.5.mcap", ["/lifter/bodies"]), calm.frames):
        roots = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses]).reshape(-1, 3)
        np.testing.assert_allclose(roots, frame.lifted.points[frame.lifted.ok][:, [11, 12]].mean(1))


def test_bytes_that_are_no_message_are_a_counted_drop(model_file, tmp_path):
    """They are lost; the messages after them are not."""

    def cut(record):
        return replace(record, data=record.data[:30]) if 0.2e9 < record.log_time % 1e9 < 0.3e9 else record

    broken, whole = (
        part_of(ONE, tmp_path / f"{name}.mcap", 3, how) for name, how in (("cut", cut), ("all", lambda r: r))
    )
    done, all_of_it = replay(broken, open_stream(model_file)), replay(whole, open_stream(model_file))
    drops = done.stream.ledger.drops["undecodable"]
    assert drops > 5 and done.damage is None and "does not decode" in done.stream.ledger.advice["undecodable"]
    lost = len(all_of_it.frames) - len(done.frames)
    assert 3 < lost <= drops and done.frames[-1].stamp == all_of_it.frames[-1].stamp


@pytest.mark.parametrize("left_out", ["/nothing", "/camera_info"])
@pytest.mark.parametrize(
    "factor, unit", [(1000, "millimetres"), (100, "centimetres"), (0.01, ""), (1, None), (0.6, None)]
)
def test_a_truth_that_is_not_in_metres_is_refused(model_file, tmp_path, left_out, factor, unit):
    with BagWriter(tmp_path / "x.mcap") as writer:
        for topic, _, message, time in list(read_messages(ONE))[:30]:
            if topic == "/ground_truth/poses":
                for pose in message.poses:
                    where = pose.position
                    where.x, where.y, where.z = factor * where.x, factor * where.y, factor * where.z
            if topic != left_out:
                writer.write(topic, message, time)
    report = evaluate(replay(tmp_path / "x.mcap", open_stream(model_file)))
    refused = report["dropped"].get("truth_not_metres", 0)
    assert bool(refused) == (unit is not None) == (report["n_mpjpe_mm"] is None)
    if refused:
        assert unit in report["advice"]["truth_not_metres"] and "metres" in report["advice"]["truth_not_metres"]


@pytest.mark.parametrize(
    "turned, noted",
    [
        (lambda points: points[:, [2, 0, 1]] * [1, -1, -1], True),  # the frame of a robot: x forward, z up
        (lambda points: points * [1, -1, -1], True),  # that of OpenGL
        (lambda points: points + [0.2, 0, 0], False),  # of the camera beside it
        (lambda points: points - points.mean(0), False),  # about its centre
    ],
)
def test_a_truth_of_another_frame_is_noted(model_file, tmp_path, turned, noted):
    with BagWriter(tmp_path / "x.mcap") as writer:
        for topic, _, message, time in list(read_messages(ONE))[:60]:
            if topic == "/ground_truth/poses":
                points = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses])
                for pose, point in zip(message.poses, turned(points).tolist()):
                    where = pose.position
                    where.x, where.y, where.z = point
            writer.write(topic, message, time)
    report = evaluate(replay(tmp_path / "x.mcap", open_stream(model_file)))
    assert bool(report["noted"].get("truth_of_another_frame")) == noted
    assert ("optical frame" in report["advice"].get("truth_of_another_frame", "")) == noted
    assert report["pa_mpjpe_mm"] is not None
