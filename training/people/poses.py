# SPDX-License-Identifier: Apache-2.0
"""Selection of poses to train on (no held-out trials, distinct frames), and their transfer to other people's bodies."""

from __future__ import annotations

import numpy as np

from training.people.clips import Clip
from training.people.mocap import CMU31, PARENTS
from training.people.view_settings import ViewSettings

HELD_OUT = ("02", "03", "27", "29", "01_12", "01_13", "01_14", "05_17", "05_18", "05_19", "05_20")
"""Subjects and trials that give no training frame; those of 01 and 05 are the unseen split of the literature."""

_LIMBS = {"femur": "hipjoint", "tibia": "femur", "humerus": "clavicle", "radius": "humerus"}

_SAME = 0.02
"""Poses count as equal, to rounding, if the cosines between their limbs differ by less."""

# Bones that are longer or shorter together, without the side letter.
_SEGMENTS = (
    ("femur",),
    ("tibia",),
    ("foot", "toes"),
    ("hipjoint",),
    ("lowerback", "upperback", "thorax"),
    ("lowerneck", "upperneck"),
    ("clavicle",),
    ("humerus",),
)


def training_clips(clips: list[Clip]) -> list[Clip]:
    """Return the clips that are neither held out nor copies of held-out ones under another name."""
    held_out = [joints for name, joints in clips if name.startswith(HELD_OUT)]
    others = [(name, joints) for name, joints in clips if not name.startswith(HELD_OUT)]
    if not held_out:
        return others
    known = np.concatenate([_limb_cosines(joints) for joints in held_out])
    key = int(known.std(0).argmax())
    known = known[known[:, key].argsort()]
    return [(name, joints) for name, joints in others if not _is_copy(joints, known, key)]


def _limbs(joints: np.ndarray) -> np.ndarray:
    """Return unit directions (F,8,3) of thighs, shanks, upper and lower arms."""
    index = CMU31.index
    bones = np.stack(
        [
            joints[:, index(side + bone)] - joints[:, index(side + parent)]
            for side in "lr"
            for bone, parent in _LIMBS.items()
        ],
        axis=1,
    )
    return bones / np.linalg.norm(bones, axis=2, keepdims=True)


def _limb_cosines(joints: np.ndarray) -> np.ndarray:
    """Return cosines (F,28) between the limbs' directions, which placement, rotation and scale of a pose leave."""
    limbs = _limbs(joints)
    upper = np.triu_indices(limbs.shape[1], 1)
    return (limbs @ limbs.transpose(0, 2, 1))[:, upper[0], upper[1]]


def _is_copy(joints: np.ndarray, known: np.ndarray, key: int) -> bool:
    """Return whether most of some sampled poses are among the known ones (N,28), sorted by the cosine ``key``."""
    found = []
    for pose in _limb_cosines(joints[:: max(1, len(joints) // 12)]):
        begin, end = np.searchsorted(known[:, key], [pose[key] - _SAME, pose[key] + _SAME])
        found.append((np.abs(known[begin:end] - pose).max(1) < _SAME).any())
    return float(np.mean(found)) > 0.5


def distinct_frames(joints: np.ndarray, motion: float) -> np.ndarray:
    """Select the frames in which a limb has turned by ``motion`` degrees since the last selected frame.

    A person who stands still for a minute gives one pose, a leap gives many.

    Args:
        joints: (F,31,3) of one clip.
        motion: threshold in degrees.

    Returns:
        Indices of the frames; the first frame is always among them.
    """
    limbs, least = _limbs(joints), np.cos(np.deg2rad(motion))
    selected = [0]
    for frame in range(1, len(limbs)):
        if (limbs[frame] * limbs[selected[-1]]).sum(1).min() < least:
            selected.append(frame)
    return np.array(selected)


def other_people(joints: np.ndarray, views: ViewSettings, rng: np.random.Generator) -> np.ndarray:
    """Transfer poses to people of other stature and proportions, another person for each frame.

    Args:
        joints: (F,31,3) captured poses.
        views: spread of stature and proportions.
        rng: source of randomness.

    Returns:
        (F,31,3) float64 with the roots where they were.
    """
    factors = np.ones((len(joints), len(CMU31)))
    for bones in _SEGMENTS:
        own = [index for index, name in enumerate(CMU31) if name in bones or name[1:] in bones]
        factors[:, own] = np.exp(views.proportions * rng.standard_normal((len(joints), 1)))
    forearms = [CMU31.index(side + "radius") for side in "lr"]
    factors[:, forearms] *= rng.uniform(*views.forearm, (len(joints), 1))
    factors *= np.exp(views.stature * rng.standard_normal((len(joints), 1)))
    grown = np.array(joints, dtype=float)
    for bone, parent in enumerate(PARENTS):
        if parent >= 0:
            grown[:, bone] = grown[:, parent] + factors[:, bone, None] * (joints[:, bone] - joints[:, parent])
    return grown
