# SPDX-License-Identifier: Apache-2.0
"""Training views of people: points on the body, cameras, a detector's errors, layouts, and the command."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_distributed import TORCHRUN

from msg_adapters.keypoints import Intrinsics
from paul_ros.cli import train as cli
from paul_ros.errors import LayoutError
from paul_ros.layout import load_layout
from paul_ros.model import load_model
from paul_ros.placement import centred_view
from training import motion_capture
from training.errors import DataError, MocapError, RecipeError, ViewsError
from training.loading import load_training_data
from training.people import human_data
from training.people.cameras import hidden_by_body, random_cameras
from training.people.detector import detect, redefined, reported
from training.people.human_data import other_people, see
from training.people.mocap import CMU31, PARENTS, human_layout, human_mapping, human_points, layout_points
from training.people.view_settings import COMPLETE, Views

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "bags" / "source"
TRUE = Views(level=(0, 0), hidden=(0, 0), obstacle=0, border=False, layouts=((COMPLETE, 1),))
"""True projections of all points."""
place = human_layout().names.index


@pytest.fixture(scope="module")
def joints():
    """(F,31,3) of three people in motion."""
    clips = [np.load(SOURCE / f"{name}.npz", allow_pickle=False)["joints"][::4] for name in ("01_14", "03_04", "29_01")]
    return np.concatenate(clips).astype(float)


@pytest.fixture(scope="module")
def bodies(joints):
    return human_points(joints)


@pytest.fixture(scope="module")
def crowd(joints):
    """(N,43,3), enough for shares of a per cent."""
    return human_points(other_people(np.tile(joints, (8, 1, 1)), Views(), np.random.default_rng(1)))


# --- points on the body


def test_points_turn_and_move_with_the_body(joints, bodies):
    sin, cos = np.sin(0.7), np.cos(0.7)
    R = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    np.testing.assert_allclose(human_points(joints @ R.T + [3, 1, 2]), bodies @ R.T + [3, 1, 2], atol=1e-9)


def test_a_mirrored_body_has_mirrored_points(joints, bodies):
    twin = [CMU31.index(_other_side(name)) for name in CMU31]
    mirrored = human_points(joints[:, twin] * [-1, 1, 1])
    np.testing.assert_allclose(mirrored, bodies[:, human_layout().mirror] * [-1, 1, 1], atol=1e-6)


def _other_side(name: str) -> str:
    other = {"l": "r", "r": "l"}.get(name[0], "") + name[1:]
    return other if other in CMU31 else name


def test_edges_keep_their_lengths(joints, bodies):
    """Within one person, over all poses: on average to 2 %, the worst to 10 %."""
    one = bodies[: len(np.load(SOURCE / "01_14.npz")["joints"][::4])]
    ends = np.array(human_layout().edges)
    length = np.linalg.norm(one[:, ends[:, 0]] - one[:, ends[:, 1]], axis=2)
    spread = length.std(0) / length.mean(0)
    assert spread.mean() < 0.02 and spread.max() < 0.1
    assert length.mean(0).min() > 0.04


def test_handedness_holds(bodies):
    for rule in human_layout().handedness:
        middle = {part: bodies[:, list(points)].mean(1) for part, points in vars(rule).items()}
        across = np.cross(middle["left"] - middle["right"], middle["above"] - middle["below"])
        assert (np.einsum("ni,ni->n", across, middle["front"] - middle["behind"]) > 0).mean() > 0.98


def test_offsets_are_those_of_people(bodies):
    def apart(a, b):
        return np.median(np.linalg.norm(bodies[:, place(a)] - bodies[:, place(b)], axis=1))

    leg = apart("left_hip", "left_knee") + apart("left_knee", "left_ankle")
    stature = leg / 0.491
    assert 1.5 < stature < 1.9
    assert apart("left_heel", "left_foot_index") == pytest.approx(0.152 * stature, rel=0.1)  # Drillis and Contini
    assert apart("left_wrist", "left_index_knuckle") == pytest.approx(0.054 * stature, rel=0.1)
    assert apart("left_big_toe", "left_small_toe") < 0.1
    assert apart("left_ear", "right_ear") == pytest.approx(0.15)
    assert apart("nose", "head_top") == pytest.approx(0.186, abs=0.005)
    np.testing.assert_allclose(bodies[:, place("pelvis")], bodies[:, [place("left_hip"), place("right_hip")]].mean(1))


def test_toes_are_before_the_heel_and_the_little_one_is_outside(bodies):
    forward = bodies[:, place("left_foot_index")] - bodies[:, place("left_heel")]
    outwards = bodies[:, place("left_small_toe")] - bodies[:, place("left_big_toe")]
    up = bodies[:, place("left_knee")] - bodies[:, place("left_ankle")]
    assert (np.einsum("ni,ni->n", np.cross(up, forward), outwards) > 0).all()
    sole = [place(name) for name in ("left_heel", "left_foot_index", "left_small_toe")]
    standing = bodies[np.abs(np.ptp(bodies[:, sole, 1], axis=1)) < 0.03]
    assert len(standing) > 50 and (standing[:, place("left_ankle"), 1] > standing[:, sole, 1].max(1)).all()


def test_a_layouts_points_are_those_of_human_by_name(joints, bodies):
    body25 = layout_points(joints, load_layout("body25"))
    np.testing.assert_array_equal(body25[:, 1], bodies[:, place("neck")])
    np.testing.assert_array_equal(body25[:, 24], bodies[:, place("right_heel")])


def test_foreign_layouts_and_joints_are_refused(joints):
    with pytest.raises(LayoutError, match="cmu31.*points that human has not: root"):
        human_mapping("cmu31")
    with pytest.raises(ValueError, match="31"):
        human_points(joints[:, :17])


def test_parents_are_those_of_the_skeleton(joints):
    """Bones keep their lengths within a clip, so a wrong parent shows."""
    clip = joints[:140]
    bones = np.linalg.norm(clip[:, 1:] - clip[:, list(PARENTS[1:])], axis=2)
    assert (bones.std(0) < 1e-3 * bones.mean(0)).all()


def test_other_people_keep_their_poses(joints):
    grown = other_people(joints, Views(), np.random.default_rng(0))
    for bone, parent in enumerate(PARENTS):
        if parent >= 0:
            was, now = joints[:, bone] - joints[:, parent], grown[:, bone] - grown[:, parent]
            cosine = (was * now).sum(1) / np.linalg.norm(was, axis=1) / np.linalg.norm(now, axis=1)
            np.testing.assert_allclose(cosine, 1, atol=1e-9)
    ratio = [
        np.linalg.norm(grown[:, CMU31.index(f"{side}radius")] - grown[:, CMU31.index(f"{side}humerus")], axis=1)
        / np.linalg.norm(joints[:, CMU31.index(f"{side}radius")] - joints[:, CMU31.index(f"{side}humerus")], axis=1)
        for side in "lr"
    ]
    np.testing.assert_allclose(*ratio)  # both sides alike
    assert 1.1 < np.median(ratio) < 1.4 and np.std(np.log(ratio)) > 0.1
    same = replace(Views(), stature=0.0, proportions=0.0, forearm=(1.0, 1.0))
    np.testing.assert_allclose(other_people(joints, same, np.random.default_rng(0)), joints, atol=1e-9)


# --- cameras


def test_a_view_is_what_a_camera_would_see(bodies):
    seen = see(bodies, TRUE, np.random.default_rng(0))
    cameras = seen.cameras
    np.testing.assert_allclose(np.linalg.det(cameras.R), 1)
    lengths = np.linalg.norm(seen.points[:, 1:] - seen.points[:, :-1], axis=2)
    np.testing.assert_allclose(lengths, np.linalg.norm(bodies[:, 1:] - bodies[:, :-1], axis=2), atol=1e-9)
    x, y, z = np.moveaxis(seen.points, 2, 0)
    clear = seen.visible & (z > 0.3)
    assert clear.mean() > 0.99
    fx, (cx, cy) = cameras.focal[:, None], cameras.centre.T[:, :, None]
    np.testing.assert_allclose(seen.xy[clear], np.stack([fx * x / z + cx, fx * y / z + cy], axis=2)[clear], rtol=1e-6)


def test_rays_are_those_of_the_lifter_and_the_truth_lies_on_them(bodies):
    seen = see(bodies[:50], TRUE, np.random.default_rng(0))
    for k in range(50):
        camera = Intrinsics(*[seen.cameras.focal[k]] * 2, *seen.cameras.centre[k], 0, 0)
        view = centred_view(seen.xy[k : k + 1], seen.visible[k : k + 1], camera)
        shown = seen.visible[k]
        np.testing.assert_allclose(seen.W[k][:, shown], view.W[0][:, shown], atol=1e-6)
        turned = (seen.points[k] @ view.turn[0]).T
        np.testing.assert_allclose(seen.W[k][:, shown], (turned[:2] / turned[2])[:, shown], atol=1e-6)
        np.testing.assert_allclose(seen.S[k], turned - turned.mean(1, keepdims=True), atol=1e-5)


def test_cameras_stand_where_the_settings_say(bodies):
    views = Views(aloft=0.0, height=(0.3, 1.8), distance=(2.0, 6.0), tilted=0.0)
    cameras = random_cameras(bodies, views, np.random.default_rng(0))
    station = cameras.anchor - np.einsum("nji,nj->ni", cameras.R, cameras.place)  # in the world
    distance = np.linalg.norm(cameras.place, axis=1)
    assert 2.0 <= distance.min() and distance.max() <= 6.0
    assert np.median(distance) == pytest.approx(np.sqrt(2.0 * 6.0), rel=0.1)
    above = station[:, 1] - bodies[..., 1].min(1)
    reached = np.abs(cameras.R[:, 2, 1]) < 0.9
    assert reached.mean() > 0.95 and (0.29 < above[reached]).mean() > 0.97 and (above[reached] < 1.81).mean() > 0.97
    np.testing.assert_allclose(np.linalg.norm(station - cameras.anchor, axis=1), distance)
    field = 2 * np.rad2deg(np.arctan(cameras.size[:, 0] / 2 / cameras.focal))
    assert views.field[0] - 1e-6 <= field.min() and field.max() <= views.field[1] + 1e-6
    assert (cameras.R[:, 1, 1] < 0).all()  # up is up in the image


def test_cameras_aloft_look_down(bodies):
    views = Views(aloft=1.0, elevation=(20.0, 50.0), off_axis=0.0)
    cameras = random_cameras(bodies, views, np.random.default_rng(0))
    down = np.rad2deg(np.arcsin(cameras.R[:, 2] @ [0, -1, 0]))
    assert 19.5 < down.min() and down.max() < 50.5


def test_what_is_outside_the_image_is_not_seen(bodies):
    seen = see(bodies, replace(TRUE, border=True, distance=(1.5, 2.5)), np.random.default_rng(0))
    xy = seen.cameras.project(seen.points)
    outside = ((xy < 0) | (xy >= seen.cameras.size[:, None])).any(2)
    assert 0.05 < outside.mean() < 0.5 and not (seen.visible & outside).any()
    assert seen.visible[~outside].mean() > 0.99


def test_the_far_arm_and_a_face_turned_away_are_hidden_and_nothing_of_a_star():
    """A body made by hand, spread in the image plane; then its far arm behind the trunk."""
    star = _star()
    np.testing.assert_array_equal(np.flatnonzero(hidden_by_body(star[None])[0]), [])
    away = star * [-1, 1, -1] + [0, 0, 8.0]  # turned by 180 degrees
    hidden = {human_layout().names[k] for k in np.flatnonzero(hidden_by_body(away[None])[0])}
    assert {"nose", "left_eye", "right_eye", "left_mouth_corner"} <= hidden and "left_wrist" not in hidden
    behind = star.copy()
    behind[[place("left_wrist"), place("left_elbow")]] = [0.05, 0.1, 4.3], [0.1, -0.1, 4.3]
    hidden = {human_layout().names[k] for k in np.flatnonzero(hidden_by_body(behind[None])[0])}
    assert hidden == {"left_wrist", "left_elbow"}


def _star() -> np.ndarray:
    """(43,3) facing a camera 4 m away, y down: limbs spread out, face and toes towards the camera."""
    rough = {
        "nose": (0, -0.62, -0.11),
        "eye": (0.03, -0.66, -0.09),
        "ear": (0.075, -0.64, 0),
        "mouth_corner": (0.025, -0.58, -0.09),
        "head_top": (0, -0.77, 0),
        "head": (0, -0.58, 0),
        "neck": (0, -0.45, 0),
        "thorax": (0, -0.45, 0),
        "spine": (0, -0.2, 0),
        "pelvis": (0, 0, 0),
        "shoulder": (0.2, -0.45, 0),
        "elbow": (0.45, -0.5, 0),
        "wrist": (0.7, -0.55, 0),
        "knuckle": (0.8, -0.57, 0),
        "hip": (0.1, 0, 0),
        "knee": (0.25, 0.38, -0.01),
        "ankle": (0.4, 0.78, 0),
        "heel": (0.42, 0.85, 0.02),
        "toe": (0.45, 0.87, -0.15),
        "foot_index": (0.45, 0.87, -0.15),
    }
    points = []
    for name, side in zip(human_layout().names, human_layout().sides):
        part = next(part for part in sorted(rough, key=len, reverse=True) if part in name)
        points.append(np.array(rough[part]) * [-1 if side == "right" else 1, 1, 1] + [0, 0, 4.0])
    return np.array(points)


# --- the detector


def _errors(crowd, views):
    """Errors (N,43) in per cent of the height, of all points."""
    seen = see(crowd, views, np.random.default_rng(2))
    off = np.linalg.norm(seen.xy - seen.cameras.project(seen.points), axis=2)
    return 100 * off / human_data._height(seen.cameras, seen.points)[:, None], seen


LEVEL_1 = replace(TRUE, level=(1, 1), min_confidence=0.0, guessed=1.0)


def test_errors_are_those_that_were_measured(crowd):
    """Median, 90 and 99 %, share above 15, in per cent of the height; exchanged sides and definitions included."""
    errors, _ = _errors(crowd, LEVEL_1)
    known = {
        ("hip", "shoulder", "thorax"): ((2.3, 3.6), (6, 9), (22, 26), (2, 3.5)),
        ("elbow", "knee"): ((2.4, 3.3), (9, 13), (29, 35), (4, 8)),
        ("wrist", "ankle"): ((2.2, 5.4), (13, 14), (43, 47), (8, 9)),
    }
    for parts, bands in known.items():
        own = [k for k, name in enumerate(human_layout().names) if name.split("_")[-1] in parts]
        group = errors[:, own]
        group = group[np.isfinite(group)]
        figures = (*np.percentile(group, [50, 90, 99]), 100 * (group > 15).mean())
        for figure, (low, high) in zip(figures, bands):
            assert 0.95 * low <= figure <= 1.05 * high, (parts, figures)


def test_left_and_right_are_exchanged_as_often_as_measured():
    """Points far apart and errors small beside that, so that an exchange shows."""
    N, names = 40_000, human_layout().names
    xy = np.broadcast_to(np.arange(43)[:, None] * [1e4, 0], (N, 43, 2))
    found = detect(xy, np.ones(N), np.zeros((N, 43), bool), np.ones(N), Views(), np.random.default_rng(0))
    for name, share in (("left_shoulder", 0.006), ("left_wrist", 0.006), ("left_ankle", 0.0125), ("neck", 0)):
        moved = np.abs(found.xy[:, names.index(name)] - xy[:, names.index(name)]).max(1) > 5e3
        assert moved.mean() == pytest.approx(share, abs=0.0015)
        twin = human_layout().mirror[names.index(name)]
        assert (np.abs(found.xy[moved, twin] - xy[moved, names.index(name)]).max(1) < 5e3).all()


def test_confidence_goes_with_the_error(crowd):
    errors, seen = _errors(crowd, LEVEL_1)
    face = place("nose")
    known = np.isfinite(errors[:, face])
    good, wild = known & (errors[:, face] < 3), known & (errors[:, face] > 15)
    assert (seen.confidence[good, face] > 0.3).mean() > 0.98
    assert 0.3 < (seen.confidence[wild, face] < 0.3).mean() < 0.7  # some errors look sound
    doubtful = see(crowd, replace(LEVEL_1, min_confidence=0.3), np.random.default_rng(2))
    assert (doubtful.confidence[doubtful.visible] >= 0.3).all()
    assert np.isnan(doubtful.xy[~doubtful.visible]).all()


def test_hidden_points_are_worse_or_missing(crowd):
    errors, seen = _errors(crowd, LEVEL_1)
    behind = hidden_by_body(seen.points)
    assert 0.1 < behind.mean() < 0.35
    limbs = [place(f"{side}_{part}") for side in ("left", "right") for part in ("elbow", "wrist", "knee")]
    clear, guessed = (np.nanmedian(errors[:, limbs][mask[:, limbs]]) for mask in (~behind, behind))
    assert guessed > 1.4 * clear
    lost = see(crowd, replace(LEVEL_1, guessed=0.25), np.random.default_rng(2)).visible
    assert lost[behind].mean() == pytest.approx(0.25, abs=0.03) and lost[~behind].mean() > 0.97


def test_definitions_move_with_the_body_alike_on_both_sides(bodies):
    moved = redefined(bodies, np.ones(len(bodies)), np.random.default_rng(0)) - bodies
    stature = 3.3 * np.linalg.norm(bodies[:, place("neck")] - bodies[:, place("pelvis")], axis=1)
    for name, share in (("left_hip", 0.02), ("right_shoulder", 0.01), ("head_top", 0.07), ("left_knee", 0)):
        size = np.linalg.norm(moved[:, place(name)], axis=1) / stature
        assert np.sqrt((size**2).mean()) == pytest.approx(share, rel=0.1)
    across = bodies[:, place("left_shoulder")] - bodies[:, place("right_shoulder")]
    left, right = moved[:, place("left_shoulder")], moved[:, place("right_shoulder")]
    np.testing.assert_allclose(np.linalg.norm(left, axis=1), np.linalg.norm(right, axis=1))
    assert np.abs(np.cross(left - right, across)).max() < 0.2 * np.abs(left - right).max()
    assert (redefined(bodies, np.zeros(len(bodies)), np.random.default_rng(0)) == bodies).all()


def test_level_0_is_the_truth_and_between_is_between(crowd):
    errors = [_errors(crowd[:500], replace(LEVEL_1, level=(level, level)))[0] for level in (0.0, 0.5, 1.0)]
    assert np.nanmax(errors[0]) < 1e-6
    medians = [np.nanmedian(error) for error in errors]
    assert medians[1] == pytest.approx(0.5 * medians[2], rel=0.2)


# --- layouts


def test_a_detector_reports_the_points_of_its_layout_as_the_node_maps_them(bodies):
    views = Views(level=(1, 1), layouts=(("coco17", 0.5), ("h36m17", 0.5), (COMPLETE, 0)))
    seen = see(bodies, views, np.random.default_rng(0))
    assert set(seen.layout) == {0, 1}
    coco, h36m = seen.visible[seen.layout == 0].any(0), seen.visible[seen.layout == 1].any(0)
    names = np.array(human_layout().names)
    assert set(names[coco]) == {*load_layout("coco17").names, "neck", "pelvis"}
    assert set(names[h36m]) == {*load_layout("h36m17").names, "neck"}
    rows = np.flatnonzero((seen.layout == 0) & seen.visible[:, place("neck")])
    middle = seen.xy[np.ix_(rows, [place("left_shoulder"), place("right_shoulder")])].mean(1)
    np.testing.assert_allclose(seen.xy[rows, place("neck")], middle)
    found = detect(seen.xy, np.ones(len(bodies)), ~seen.visible, seen.level, views, np.random.default_rng(0))
    whole = reported(found, np.full(len(bodies), 2), views)
    np.testing.assert_array_equal(whole.visible, found.visible)


def test_a_share_of_points_is_missing_as_asked_for(crowd):
    seen = see(crowd, replace(TRUE, hidden=(0.4, 0.4)), np.random.default_rng(0))
    assert seen.visible.mean() == pytest.approx(0.6, abs=0.01)
    cut = see(crowd, replace(TRUE, obstacle=1.0), np.random.default_rng(0))
    assert 0.6 < cut.visible.mean() < 0.95 and 0.02 < cut.visible.mean(1).min() < 0.5


# --- settings and the command


@pytest.mark.parametrize(
    "settings, told",
    [
        ({"levels": [0, 1]}, "unknown view setting levels; known are motion"),
        ({"level": [0, 2]}, "level must be at most 1"),
        ({"level": 1}, "level must be like"),
        ({"distance": [3, 2]}, "distance must be two growing numbers"),
        ({"distance": [0.1, 2]}, "distance must be at least 0.5"),
        ({"layouts": [["coco", 1]]}, "did you mean 'coco17'"),
        ({"layouts": [["cmu31", 1]]}, "points that human has not"),
        ({"layouts": [["coco17", 0]]}, "a list of"),
        ({"layouts": [["coco17"]]}, "a list of"),
        ({"layouts": ["coco17"]}, "a list of"),
        ({"border": 1}, "border must be like True"),
        ({"views": 2.5}, "views must be like 6"),
        ({"stature": float("nan")}, "stature must be like"),
        ({"hidden": ["a", "b"]}, "hidden must be two growing numbers"),
        (["level"], "settings as key: value"),
    ],
)
def test_wrong_settings_are_refused(settings, told):
    with pytest.raises(ViewsError, match=told):
        Views.from_dict(settings)


def test_settings_survive_yaml():
    views = Views.from_dict({"level": [0, 0.5], "layouts": [["coco17", 1]], "views": 2.0, "border": False})
    assert views.level == (0, 0.5) and views.layouts == (("coco17", 1),) and views.views == 2 and not views.border
    assert Views.from_dict(views.to_dict()) == views
    assert Views.from_dict(Views().to_dict()) == Views()


def clip(seed, frames=60):
    """A made-up moving CMU-31 skeleton (F,31,3)."""
    rng = np.random.default_rng(seed)
    base, sway = rng.standard_normal((31, 3)), rng.standard_normal((31, 3))
    return base + 0.3 * np.sin(np.linspace(0, 6, frames))[:, None, None] * sway


def test_no_held_out_frame_trains_under_any_name():
    R, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    turned = 2 * clip(1) @ R.T + 5
    clips = [("02_01", clip(1)), ("05_18", clip(2)), ("05_01", clip(3)), ("walking_1", turned), ("walking_2", clip(4))]
    assert [name for name, _ in human_data.training_clips(clips)] == ["05_01", "walking_2"]


@pytest.fixture
def archive(tmp_path, joints):
    folder = tmp_path / "archive"
    folder.mkdir()
    np.savez(
        folder / "subject_90.npz",
        S_world=joints.astype(np.float32),
        trial_names=np.array(["90_01", "90_02"]),
        trial_len=np.array([300, len(joints) - 300]),
    )
    return folder


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "training.people.human_data", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )


def test_the_command_makes_what_the_trainer_takes(archive, tmp_path):
    done = command(
        archive, "-o", tmp_path / "2d.npz", "--truth", tmp_path / "3d.npz", "--set", "views.views=2", "--quiet"
    )
    assert done.returncode == 0, done.stderr
    data = load_training_data(tmp_path / "2d.npz", human_layout())
    assert data.calibrated and data.left_out == 0 and len(data.W) > 100
    with np.load(tmp_path / "2d.npz", allow_pickle=False) as two, np.load(tmp_path / "3d.npz") as three:
        assert sorted(two.files) == ["W", "about", "calibrated", "detected"]
        np.testing.assert_array_equal(np.isfinite(two["detected"]).all(1), three["visible"])
        np.testing.assert_array_equal(np.nan_to_num(two["detected"]), three["W"])
        far = np.ptp(two["W"], axis=2).max(1) < 0.5  # else what is near a camera is too far from a parallel projection
        off = three["S"][far, :2] / three["S"][far, :2].std((1, 2))[:, None, None]
        assert np.corrcoef(off.ravel(), two["W"][far].ravel())[0, 1] > 0.9
        assert three["S"].shape == (len(data.W), 3, 43)
        assert b'"views": 2' in two["about"].tobytes() and b"90_02" in two["about"].tobytes()
    again = command(archive, "-o", tmp_path / "again.npz", "--set", "views.views=2", "--quiet")
    assert again.returncode == 0 and (tmp_path / "again.npz").read_bytes() == (tmp_path / "2d.npz").read_bytes()


def test_the_command_says_what_is_wrong(archive, tmp_path):
    (tmp_path / "empty").mkdir()
    for arguments, told in (
        ((archive, "--set", "views.levels=1"), "unknown view setting levels"),
        ((archive, "--set", "bottleneck.a=1"), "bottleneck has no settings of its own"),
        ((archive, "--recipe", "default"), "--recipe human"),
        ((tmp_path / "empty",), "holds no motion capture"),
        ((archive, "--set", "views.hidden=[1,1]"), "enough points to be lifted: lower views.hidden, which is [1"),
    ):
        wrong = command(*arguments, "-o", tmp_path / "2d.npz", "--quiet")
        assert wrong.returncode == 1 and wrong.stderr.count("\n") == 1 and told in wrong.stderr, wrong.stderr


def test_the_command_overwrites_nothing_that_it_reads_or_writes(archive, tmp_path):
    """Refused before anything is read, and nothing is left behind."""
    capture, out = archive / "subject_90.npz", tmp_path / "2d.npz"
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "a.npz").symlink_to(capture)
    before = capture.read_bytes()
    for arguments, told in (
        ((archive, "-o", capture), "read as motion capture"),
        ((archive, "-o", archive / "new.npz"), "read as motion capture"),
        ((archive, "-o", out, "--truth", archive / "3d.npz"), "read as motion capture"),
        ((tmp_path / "linked", "-o", capture), "is what is read"),
        ((archive, "-o", out, "--truth", tmp_path / "linked" / ".." / "2d.npz"), "named for two outputs"),
        ((archive, "-o", tmp_path / "views.txt"), "must end in .npz, not 'views.txt'"),
        ((archive, "-o", out, "--truth", tmp_path / "truth"), "must end in .npz, not 'truth'"),
        ((archive, "-o", tmp_path / "typo" / "2d.npz"), "there is no folder"),
    ):
        wrong = command(*arguments)
        assert wrong.returncode == 1 and wrong.stderr.count("\n") == 1 and told in wrong.stderr, wrong.stderr
    assert capture.read_bytes() == before and sorted(path.name for path in tmp_path.iterdir()) == ["archive", "linked"]


def test_views_are_made_anew_for_whatever_changes_them_and_only_then(archive, tmp_path, monkeypatch):
    """Corrections keep the size of a file and may keep its time."""
    kept, capture = tmp_path / "views.npz", archive / "subject_90.npz"
    settings = replace(Views(), views=1)

    def made_anew(views=settings):
        before = kept.stat().st_ino if kept.exists() else None
        human_data.make_file(archive, views, kept, quiet=True)
        return kept.stat().st_ino != before

    assert made_anew() and not made_anew()
    content, written = bytearray(capture.read_bytes()), capture.stat()
    with np.load(capture, allow_pickle=False) as arrays:
        corrected = {**arrays, "S_world": arrays["S_world"] + np.float32(0.5)}
    np.savez(capture, **corrected)
    os.utime(capture, ns=(written.st_atime_ns, written.st_mtime_ns))
    assert capture.stat().st_size == len(content) and capture.stat().st_mtime_ns == written.st_mtime_ns
    assert made_anew() and not made_anew()
    capture.touch()
    assert not made_anew()
    skeleton = archive / "90.asf"
    skeleton.write_text("length 0.45")
    assert made_anew() and not made_anew()
    skeleton.write_text("length 0.54")
    assert made_anew() and not made_anew()
    capture.rename(archive / "subject_91.npz")
    assert made_anew() and made_anew(replace(settings, seed=1)) and made_anew()
    monkeypatch.setattr(human_data, "FORMAT", human_data.FORMAT + 1)
    assert made_anew() and not made_anew()


def test_views_of_a_format_are_known(joints):
    """Where this fails, the same files and settings give other views: raise human_data.FORMAT, then these figures."""
    arrays, _ = human_data.make([("90_01", joints)], replace(Views(), views=1))
    detected = np.isfinite(arrays["detected"]).all(1)
    told = len(detected), detected.mean(), np.nanmean(np.abs(arrays["W"])), np.nanmean(np.abs(arrays["detected"]))
    assert human_data.FORMAT == 1 and told == pytest.approx((281, 0.40578, 0.089666, 0.069461), rel=1e-3)


SETTINGS = ("views.views=1", "steps=2", "batch=16", "start=random", "regression_steps=0", "hold=0", "width=16")
SMALL = ["--recipe", "human", *(word for setting in SETTINGS for word in ("--set", setting))]


def arguments_of_train(*words):
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return parser.parse_args([*map(str, words)])


@pytest.mark.parametrize("option", ["-o", "--shapes"])
def test_nothing_is_written_into_the_folder_that_is_read(archive, option):
    """Once written, model and views would be read as motion capture by the same command."""
    (archive / "below").mkdir()
    for output in (archive / "human.npz", archive / "below" / ".." / "below" / "human.npz"):
        with pytest.raises(MocapError, match="would be read as motion capture; write it elsewhere"):
            cli.run(arguments_of_train(archive, option, output, "--recipe", "human"))
    assert sorted(path.name for path in archive.rglob("*")) == ["below", "subject_90.npz"]


def test_a_folder_is_trained_on_by_one_command(archive, tmp_path, monkeypatch, capsys):
    """And the same command goes on with the views that it made."""
    small = [*SMALL, "--quiet"]
    monkeypatch.setattr(sys, "argv", ["paul", "train"])
    args = arguments_of_train(archive, "-o", tmp_path / "human.npz", *small)
    assert cli.run(args) == 0
    model = load_model(tmp_path / "human.npz")
    assert model.layout.name == "human" and model.min_visible == 6
    assert model.header["training"]["recipe"]["views"] == replace(Views(), views=1).to_dict()
    views = tmp_path / "human.run" / "views.npz"
    made = views.stat().st_mtime_ns
    assert cli.run(args) == 0 and views.stat().st_mtime_ns == made
    with pytest.raises(RecipeError, match="--recipe human"):
        cli.run(arguments_of_train(archive, "-o", tmp_path / "x.npz", "--quiet"))


@pytest.mark.parametrize(
    "words, error, told",
    [
        (("--layout", "coco17"), DataError, "43 points of layout human, not the 17 of coco17: leave out --layout"),
        (("--set", "known_lengths=[[left_hip, tail, 0.4]]"), RecipeError, "tail"),
        (("--set", "hold=0", "--set", "steps=0", "--set", "regression_steps=0"), RecipeError, "no networks"),
    ],
)
def test_what_can_be_told_is_told_before_views_are_made(archive, tmp_path, monkeypatch, words, error, told):
    monkeypatch.setattr(motion_capture, "make_file", lambda *given, **named: pytest.fail("views were made"))
    with pytest.raises(error, match=told):
        cli.run(arguments_of_train(archive, "-o", tmp_path / "human.npz", "--recipe", "human", *words))


def train_together(*words):
    """``torchrun -m paul_ros.cli train`` with two processes."""
    command = [sys.executable, *TORCHRUN, "-m", "paul_ros.cli", "train", *map(str, words), *SMALL]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment, cwd=ROOT)


def test_one_of_two_processes_makes_the_views(archive, tmp_path):
    """It shows its work; the other waits for the file."""
    done = train_together(archive, "-o", tmp_path / "human.npz", "--fresh")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("motion capture: 100%") == 1 and done.stdout.count("human.npz") == 1


def test_what_one_process_cannot_read_stops_both_with_the_same_words(archive, tmp_path):
    (archive / "91_01.bvh").write_text("HIERARCHY")
    wrong = train_together(archive, "-o", tmp_path / "human.npz")
    told = [line for line in wrong.stderr.splitlines() if "91_01.bvh" in line]
    assert wrong.returncode == 1 and len(set(told)) == 1 and "broadcast" not in wrong.stderr, wrong.stderr
