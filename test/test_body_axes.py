# SPDX-License-Identifier: Apache-2.0
"""Body axes of known poses, and quaternions that are right-handed, of length one, and do not jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import PERSON
from scipy.spatial.transform import Rotation

from paul_ros.body_axes import ContinuousSigns, body_rotations, left_and_up, quaternions
from paul_ros.layout import Layout, load_layout

COCO = load_layout("coco17")
#: PERSON looks at the camera: out of the chest is towards it, the left is at the right of the image, the head is up.
FACING = np.array([(0, 0, -1), (1, 0, 0), (0, -1, 0)], float).T


@pytest.mark.parametrize(
    "turn", [(0, 0, 0), (0, np.pi / 2, 0), (0, 3.0, 0), (0.4, -1.0, 0), (np.pi / 2, 0, 0), (0.1, 2, -3)]
)
def test_axes_turn_with_the_person(turn):
    R = Rotation.from_euler("xyz", turn).as_matrix()
    points = (PERSON @ R.T + (0.5, 0, 3))[None]
    axes = body_rotations(points, np.full((1, 3, 3), np.nan), left_and_up(COCO))
    np.testing.assert_allclose(axes[0], R @ FACING, atol=0.05)  # PERSON leans 2 degrees back
    np.testing.assert_allclose(axes[0].T @ axes[0], np.eye(3), atol=1e-12)
    assert np.linalg.det(axes[0]) == pytest.approx(1)


def test_a_bend_of_one_shoulder_moves_the_axes_little():
    """x stays across left and up, z to the middle of the shoulders."""
    points = PERSON.copy()
    points[5] += (0, -0.1, 0.1)
    axes = body_rotations(points[None], np.eye(3)[None], left_and_up(COCO))[0]
    up = points[5:7].mean(0) - points[11:13].mean(0)
    np.testing.assert_allclose(axes[:, 2], up / np.linalg.norm(up))
    assert Rotation.from_matrix(axes.T @ FACING).magnitude() < np.radians(25)


def test_a_layout_without_hips_uses_its_rule_of_handedness():
    names = [f"p{name}" for name in COCO.names]
    data = COCO.to_dict()
    rename = dict(zip(COCO.names, names))
    data["handedness"] = [{part: [rename[n] for n in points] for part, points in data["handedness"][0].items()}]
    data |= {"names": names, "edges": [], "left_right": [], "derived": {}, "root": names[:1]}
    axes = body_rotations(PERSON[None], np.full((1, 3, 3), np.nan), left_and_up(Layout.from_dict(data)))[0]
    # These are the axes of the head, which is upright and looks at the camera.
    np.testing.assert_allclose(axes, FACING, atol=0.1)


def test_an_object_without_a_chest_has_the_models_rotation():
    door = replace(COCO, names=tuple(f"d{n}" for n in range(17)), handedness=())
    R = Rotation.random(3, random_state=0).as_matrix()
    np.testing.assert_array_equal(body_rotations(np.zeros((3, 17, 3)), R, left_and_up(door)), R)


def test_points_that_fix_no_axes_give_the_models_own_rotation():
    R = Rotation.random(2, random_state=0).as_matrix()
    flat = np.stack([np.zeros((17, 3)), PERSON * (0, 1, 0)])
    np.testing.assert_array_equal(body_rotations(flat, R, left_and_up(COCO)), R)


def test_quaternions_are_those_of_scipy():
    R = np.concatenate(
        [
            Rotation.random(200, random_state=1).as_matrix(),
            [np.eye(3)],
            [np.diag(d) for d in ((1, -1, -1), (-1, 1, -1))],
        ]
    )
    q = quaternions(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1)
    np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), R, atol=1e-12)
    assert (q[:, 3] >= 0).all()


def turning(count: int = 100) -> np.ndarray:
    """Return quaternions of a person who turns round twice."""
    turns = np.linspace(0, 4 * np.pi, count)
    return quaternions(Rotation.from_euler("y", turns[:, None]).as_matrix() @ FACING)


def test_signs_do_not_jump_while_a_person_turns():
    raw, steady = turning(), ContinuousSigns()
    kept = np.array([steady(("7",), q[None])[0] for q in raw])
    assert (np.abs(np.diff(raw, axis=0)).max(axis=1) > 1).any()
    assert np.abs(np.diff(kept, axis=0)).max() < 0.1
    np.testing.assert_allclose(np.abs((kept * raw).sum(1)), 1)


def test_signs_of_persons_without_ids_or_unseen_start_anew():
    raw, steady = turning(), ContinuousSigns()
    np.testing.assert_array_equal([steady(("",), q[None])[0] for q in raw], raw)
    for q in raw:
        steady(("7",), q[None])
        steady((), np.empty((0, 4)))
        np.testing.assert_array_equal(steady(("7",), q[None])[0], q)


def test_a_person_that_was_not_lifted_keeps_nan_and_is_forgotten():
    steady = ContinuousSigns()
    assert np.isnan(steady(("7",), np.full((1, 4), np.nan))).all()
    assert steady(("7",), np.array([[0, 0, 0, 1.0]]))[0, 3] == 1
