# SPDX-License-Identifier: Apache-2.0
"""Points of the layout human on captured bodies: they move with the body, and have human proportions."""

from __future__ import annotations

import numpy as np
import pytest
from people_data import captured_clip, captured_joints

from paul_ros.errors import LayoutError
from paul_ros.layout import load_layout
from training.people.human_points import human_layout, human_mapping, human_points, layout_points
from training.people.mocap import CMU31, PARENTS

place = human_layout().names.index


@pytest.fixture
def joints():
    return captured_joints()


@pytest.fixture(scope="module")
def bodies():
    return human_points(captured_joints())


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
    """Edges of one person vary by 2 % on average over all poses, the worst by 10 %."""
    one = bodies[: len(captured_clip("01_14"))]
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
    """A wrong parent would show, because bones keep their lengths within a clip."""
    clip = joints[:140]
    bones = np.linalg.norm(clip[:, 1:] - clip[:, list(PARENTS[1:])], axis=2)
    assert (bones.std(0) < 1e-3 * bones.mean(0)).all()
