# SPDX-License-Identifier: Apache-2.0
"""The 43 points of the layout ``human`` from the 31 joints of CMU motion capture. NumPy only.

Joints of the limbs are ends of bones, which differ from the places that people mark in images.  H is stature.  D&C are
the segment lengths of Drillis and Contini 1966, as printed in Winter, Biomechanics and Motor Control of Human
Movement, 4th edition, figure 4.1.

- Hips lie 0.15-0.18 m apart, nearer than D&C's joints (0.191 H), and 0.1 m below the capture's root.
- Shoulders are ends of clavicles.  They lie at the height of the acromion, 0.08 m above the capture's thorax.
- Wrists are ends of the bone ``radius``, at two thirds of the forearm.  The capture's bone ``wrist``, half as long,
  continues in line, and the hand bends at its end.
- Radius over humerus is 0.6-0.7; D&C have 0.785, Human3.6M 0.9.

Training views therefore vary these proportions (``view_settings.py``).  Points that the capture lacks are placed in
frames built from the bones.  Their offsets stand below with their sources.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from paul_ros.errors import LayoutError
from paul_ros.layout import Layout, Mapping, load_layout
from training.people.mocap import CMU31, joint

# All heads are equal: averages of adults, metres in the head frame (lateral to the left, up, forward) from the ear
# level.  Eyes and mouth: Farkas, Anthropometry of the Head and Face, 1994.  The eyes' inner corners are 0.033
# apart, the outer ones 0.09; the mouth is 0.05 wide.  head_top: tragion to top of head 0.13, ANSUR II 2012.
_EAR_LEVEL = 0.6  # share of the way from upperneck to head
_HEAD = {
    "nose": (0.0, -0.02, 0.11),
    "eye": (0.032, 0.02, 0.085),
    "eye_inner": (0.017, 0.02, 0.088),
    "eye_outer": (0.045, 0.02, 0.075),
    "ear": (0.075, 0.0, 0.0),
    "mouth_corner": (0.025, -0.055, 0.09),
    "head_top": (0.0, 0.13, 0.0),
}
# Shares of stature in the foot's frame (lateral outwards, up from the sole, forward).  D&C: foot 0.152 long and 0.055
# wide, ankle 0.039 above the sole.  The heel is a quarter of the foot's length behind the ankle.  The tip of the fifth
# toe is a fifth of it behind the tip of the longest toe, where the capture's toes end: heel to toes is 0.152 in all.
_HEEL = (0.0, -0.030, -0.036)  # from the ankle
_TOES = {"big_toe": (-0.010, 0.0, 0.0), "small_toe": (0.030, 0.0, -0.030), "foot_index": (0.0, 0.0, 0.0)}
_SOLE = np.deg2rad(16.0)  # between ankle -> ball and the sole: the ankle's height over its distance from the ball
# Shares of stature in the hand's frame (towards the thumb, towards the fingers).  D&C: hand 0.108 long; the knuckles
# are half-way.  Knuckles of index and little finger are 0.039 apart (ANSUR II: hand breadth less half a finger a side).
_KNUCKLES = {"index_knuckle": (0.017, 0.054), "pinky_knuckle": (-0.022, 0.048), "thumb_knuckle": (0.032, 0.040)}
_LEG_SHARE = 0.245 + 0.246  # thigh and shank as shares of stature, D&C
_LIMBS = {
    "shoulder": "clavicle",
    "elbow": "humerus",
    "wrist": "radius",
    "hip": "hipjoint",
    "knee": "femur",
    "ankle": "tibia",
}
_SIDES = {"left": "l", "right": "r"}


@cache
def human_layout() -> Layout:
    """Return the layout ``human``; cached."""
    return load_layout("human")


def human_points(joints: np.ndarray) -> np.ndarray:
    """Return the points of the layout ``human`` from CMU-31 joints.

    Args:
        joints: (F,31,3) metres in any right-handed frame, order CMU31.

    Returns:
        (F,43,3) float64 in the same frame, in the order of the layout.

    Raises:
        ValueError: the joints have another shape.
    """
    joints = np.asarray(joints, dtype=np.float64)
    if joints.ndim != 3 or joints.shape[1:] != (len(CMU31), 3):
        raise ValueError(f"CMU joints must be (frames, {len(CMU31)}, 3), got {joints.shape}")
    places = {
        f"{side}_{part}": joint(joints, letter + bone)
        for side, letter in _SIDES.items()
        for part, bone in _LIMBS.items()
    }
    places |= _trunk(joints, places) | _head(joints)
    for side, letter in _SIDES.items():
        places |= _foot(joints, places, side, letter) | _hand(joints, places, side, letter)
    return np.stack([places[name] for name in human_layout().names], axis=1)


@cache
def human_mapping(name: str) -> Mapping:
    """Return the mapping from a layout to ``human``; cached.

    Raises:
        LayoutError: there is no such layout, or it has points that ``human`` lacks.
    """
    layout = load_layout(name)
    if foreign := [point for point in layout.names if point not in human_layout().names]:
        raise LayoutError(f"layout '{name}' has points that human has not: {', '.join(foreign[:5])}")
    return layout.map_to(human_layout())


def layout_points(joints: np.ndarray, layout: Layout) -> np.ndarray:
    """Return the points (F,P,3) of a layout, all of whose names ``human`` has; see ``human_points``."""
    return human_points(joints)[:, [human_layout().names.index(name) for name in layout.names]]


def _trunk(joints: np.ndarray, places: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Place the points of the trunk as Human3.6M defines them.

    Its spine is at 0.48 of the way from pelvis to thorax, where the capture's lowerback ends.  Its thorax is the base
    of the neck: level with the shoulders, amid the capture's lower neck.  Its head is the joint of neck and skull.
    """
    return {
        "pelvis": (places["left_hip"] + places["right_hip"]) / 2,
        "neck": (places["left_shoulder"] + places["right_shoulder"]) / 2,
        "spine": joint(joints, "lowerback"),
        "thorax": (joint(joints, "thorax") + joint(joints, "lowerneck")) / 2,
        "head": joint(joints, "upperneck"),
    }


def _head(joints: np.ndarray) -> dict[str, np.ndarray]:
    """Place the points of the face and the top of the head.

    The head's axes: up = upperneck -> head; lateral = right to left clavicle, made orthogonal to up; forward =
    lateral x up.
    """
    neck, head = joint(joints, "upperneck"), joint(joints, "head")
    up = _unit(head - neck)
    lateral = joint(joints, "lclavicle") - joint(joints, "rclavicle")
    lateral = _unit(lateral - (lateral * up).sum(-1, keepdims=True) * up)
    axes = np.stack([lateral, up, np.cross(lateral, up)], axis=1)
    names = [name if name in _HEAD else name.partition("_")[2] for name in human_layout().names]
    known = [
        (name, part, side)
        for name, part, side in zip(human_layout().names, names, human_layout().sides)
        if part in _HEAD
    ]
    offsets = np.array([_HEAD[part] for _, part, _ in known])
    offsets[[side == "right" for _, _, side in known], 0] *= -1
    points = (neck + _EAR_LEVEL * (head - neck))[:, None] + offsets @ axes
    return {name: points[:, index] for index, (name, _, _) in enumerate(known)}


def _foot(joints: np.ndarray, places: dict[str, np.ndarray], side: str, letter: str) -> dict[str, np.ndarray]:
    """Place heel and toes; the foot bends in the plane of shank and foot, and its tilt to the sides is ignored."""
    ankle, stature = places[f"{side}_ankle"], _stature(places)
    instep = _unit(joint(joints, letter + "foot") - ankle)
    # If an error of the capture puts shank and foot in line, the hips define the lateral direction.
    hips = places["left_hip"] - places["right_hip"]
    to_left = _unit(np.cross(places[f"{side}_knee"] - ankle, instep) + 0.05 * hips)
    upwards = np.cross(instep, to_left)
    forward = _unit(np.cos(_SOLE) * instep + np.sin(_SOLE) * upwards)
    axes = np.stack([to_left if side == "left" else -to_left, _unit(np.cross(forward, to_left)), forward], axis=1)
    tip = joint(joints, letter + "toes")
    toes = {f"{side}_{name}": tip + stature * (np.array(offset) @ axes) for name, offset in _TOES.items()}
    return {f"{side}_heel": ankle + stature * (np.array(_HEEL) @ axes), **toes}


def _hand(joints: np.ndarray, places: dict[str, np.ndarray], side: str, letter: str) -> dict[str, np.ndarray]:
    """Place the knuckles: the hand's frame is that at the end of the capture's bone ``wrist``, moved to the wrist."""
    bend = joint(joints, letter + "wrist")
    fingers = _unit(joint(joints, letter + "fingers") - bend)
    # A thumb in line with the fingers defines no palm; the knuckles then lie along the line to the other shoulder.
    spare = places["right_shoulder"] - places["left_shoulder"]
    thumb = joint(joints, letter + "thumb") - bend + 1e-4 * (spare if side == "left" else -spare)
    thumb = _unit(thumb - (thumb * fingers).sum(-1, keepdims=True) * fingers)
    axes = np.stack([thumb, fingers], axis=1)
    return {
        f"{side}_{name}": places[f"{side}_wrist"] + _stature(places) * (np.array(offset) @ axes)
        for name, offset in _KNUCKLES.items()
    }


def _stature(places: dict[str, np.ndarray]) -> np.ndarray:
    """Estimate stature (F,1), metres, from the length of the legs."""
    bones = [(f"{side}_{a}", f"{side}_{b}") for side in _SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))]
    legs = sum(np.linalg.norm(places[a] - places[b], axis=-1, keepdims=True) for a, b in bones) / 2
    return legs / _LEG_SHARE


def _unit(v: np.ndarray) -> np.ndarray:
    """Scale vectors (...,3) to length 1."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
