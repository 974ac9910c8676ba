# SPDX-License-Identifier: Apache-2.0
"""Simulated views: cameras, occlusion, the detector's errors, and the points of its layout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from people_data import captured_joints

from msg_adapters.intrinsics import Intrinsics
from paul_ros.layout import load_layout
from paul_ros.placement import centred_view
from training.people.cameras import hidden_by_body, random_cameras
from training.people.detector import detect, redefined, reported
from training.people.human_points import human_layout, human_points
from training.people.poses import other_people
from training.people.simulated_views import image_heights, simulate_views
from training.people.view_settings import COMPLETE, ViewSettings

TRUE = ViewSettings(level=(0, 0), hidden=(0, 0), obstacle=0, border=False, layouts=((COMPLETE, 1),))
"""Settings of views with true projections of all points."""
place = human_layout().names.index


@pytest.fixture(scope="module")
def bodies():
    return human_points(captured_joints())


@pytest.fixture(scope="module")
def crowd():
    """Return bodies (N,43,3), enough of them to measure shares of one per cent."""
    joints = np.tile(captured_joints(), (8, 1, 1))
    return human_points(other_people(joints, ViewSettings(), np.random.default_rng(1)))


def test_a_view_is_what_a_camera_would_see(bodies):
    seen = simulate_views(bodies, TRUE, np.random.default_rng(0))
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
    seen = simulate_views(bodies[:50], TRUE, np.random.default_rng(0))
    for k in range(50):
        camera = Intrinsics(*[seen.cameras.focal[k]] * 2, *seen.cameras.centre[k], 0, 0)
        view = centred_view(seen.xy[k : k + 1], seen.visible[k : k + 1], camera)
        shown = seen.visible[k]
        np.testing.assert_allclose(seen.W[k][:, shown], view.W[0][:, shown], atol=1e-6)
        turned = (seen.points[k] @ view.turn[0]).T
        np.testing.assert_allclose(seen.W[k][:, shown], (turned[:2] / turned[2])[:, shown], atol=1e-6)
        np.testing.assert_allclose(seen.S[k], turned, atol=1e-5)


def test_cameras_stand_where_the_settings_say(bodies):
    views = ViewSettings(aloft=0.0, height=(0.3, 1.8), distance=(2.0, 6.0), tilted=0.0)
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
    views = ViewSettings(aloft=1.0, elevation=(20.0, 50.0), off_axis=0.0)
    cameras = random_cameras(bodies, views, np.random.default_rng(0))
    down = np.rad2deg(np.arcsin(cameras.R[:, 2] @ [0, -1, 0]))
    assert 19.5 < down.min() and down.max() < 50.5


def test_what_is_outside_the_image_is_not_seen(bodies):
    seen = simulate_views(bodies, replace(TRUE, border=True, distance=(1.5, 2.5)), np.random.default_rng(0))
    xy = seen.cameras.project(seen.points)
    outside = ((xy < 0) | (xy >= seen.cameras.size[:, None])).any(2)
    assert 0.05 < outside.mean() < 0.5 and not (seen.visible & outside).any()
    assert seen.visible[~outside].mean() > 0.99


def test_the_far_arm_and_a_face_turned_away_are_hidden_and_nothing_of_a_star():
    """A body spread in the image plane hides nothing; turned round or with an arm behind the trunk it hides these."""
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
    """Return a body (43,3) that faces a camera 4 m away, y down, limbs spread out."""
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
    """Return errors (N,43) of all points in per cent of the height, and the views."""
    seen = simulate_views(crowd, views, np.random.default_rng(2))
    off = np.linalg.norm(seen.xy - seen.cameras.project(seen.points), axis=2)
    return 100 * off / image_heights(seen.cameras, seen.points)[:, None], seen


LEVEL_1 = replace(TRUE, level=(1, 1), min_confidence=0.0, guessed=1.0)


def test_errors_are_those_that_were_measured(crowd):
    """Median, 90 and 99 % and the share above 15 % of the height, with swaps and definitions, are in measured bands."""
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


def test_left_and_right_are_swapped_as_often_as_measured():
    """Points lie much farther apart than errors reach, so that swaps show."""
    N, names = 40_000, human_layout().names
    xy = np.broadcast_to(np.arange(43)[:, None] * [1e4, 0], (N, 43, 2))
    found = detect(xy, np.ones(N), np.zeros((N, 43), bool), np.ones(N), ViewSettings(), np.random.default_rng(0))
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
    assert 0.3 < (seen.confidence[wild, face] < 0.3).mean() < 0.7  # detectors are confident of some gross errors
    doubtful = simulate_views(crowd, replace(LEVEL_1, min_confidence=0.3), np.random.default_rng(2))
    assert (doubtful.confidence[doubtful.visible] >= 0.3).all()
    assert np.isnan(doubtful.xy[~doubtful.visible]).all()


def test_hidden_points_are_worse_or_missing(crowd):
    errors, seen = _errors(crowd, LEVEL_1)
    behind = hidden_by_body(seen.points)
    assert 0.1 < behind.mean() < 0.35
    limbs = [place(f"{side}_{part}") for side in ("left", "right") for part in ("elbow", "wrist", "knee")]
    clear, guessed = (np.nanmedian(errors[:, limbs][mask[:, limbs]]) for mask in (~behind, behind))
    assert guessed > 1.4 * clear
    lost = simulate_views(crowd, replace(LEVEL_1, guessed=0.25), np.random.default_rng(2)).visible
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
    views = ViewSettings(level=(1, 1), layouts=(("coco17", 0.5), ("h36m17", 0.5), (COMPLETE, 0)))
    seen = simulate_views(bodies, views, np.random.default_rng(0))
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
    seen = simulate_views(crowd, replace(TRUE, hidden=(0.4, 0.4)), np.random.default_rng(0))
    assert seen.visible.mean() == pytest.approx(0.6, abs=0.01)
    cut = simulate_views(crowd, replace(TRUE, obstacle=1.0), np.random.default_rng(0))
    assert 0.6 < cut.visible.mean() < 0.95 and 0.02 < cut.visible.mean(1).min() < 0.5
