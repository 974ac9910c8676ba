# SPDX-License-Identifier: Apache-2.0
"""Poses to train on: no held-out trials, and other people's proportions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from people_data import captured_joints, made_up_clip

from training.people.mocap import CMU31, PARENTS
from training.people.poses import other_people, training_clips
from training.people.view_settings import ViewSettings


def test_other_people_keep_their_poses():
    joints = captured_joints()
    grown = other_people(joints, ViewSettings(), np.random.default_rng(0))
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
    same = replace(ViewSettings(), stature=0.0, proportions=0.0, forearm=(1.0, 1.0))
    np.testing.assert_allclose(other_people(joints, same, np.random.default_rng(0)), joints, atol=1e-9)


def test_no_held_out_frame_trains_under_any_name():
    R, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    turned = 2 * made_up_clip(1) @ R.T + 5
    clips = [
        ("02_01", made_up_clip(1)),
        ("05_18", made_up_clip(2)),
        ("05_01", made_up_clip(3)),
        ("walking_1", turned),
        ("walking_2", made_up_clip(4)),
    ]
    assert [name for name, _ in training_clips(clips)] == ["05_01", "walking_2"]
