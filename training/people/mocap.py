# SPDX-License-Identifier: Apache-2.0
"""Motion capture in the CMU skeleton, read as the keypoints a camera would see. numpy only.

The 43 points of the layout ``human`` are made of the 31 joints of the capture.  Joints of the limbs are ends of bones.
They are not quite where people mark them in images (H is stature, D&C are the segment lengths of Drillis and Contini
1966, as printed in Winter, Biomechanics and Motor Control of Human Movement, 4th edition, figure 4.1):

- hips lie 0.15-0.18 m apart, nearer than D&C's joints (0.191 H), and 0.1 m below the capture's root;
- shoulders are ends of clavicles, at the height of the acromion and 0.08 m above the capture's thorax;
- wrists are ends of the bone ``radius``, at two thirds of the forearm: the capture's bone ``wrist``, half as long, goes
  straight on from there, and the hand bends at its end.  Radius over humerus is 0.6-0.7, D&C have 0.785, Human3.6M 0.9.

Views for training therefore vary these proportions (``training/people/human_data.py``).  What the capture lacks is
placed in frames built from the bones, by the offsets that stand below with their sources.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from paul_ros.errors import LayoutError
from paul_ros.layout import Layout, Mapping, load_layout
from training.errors import MocapError

CMU31 = (
    "root",
    "lhipjoint",
    "lfemur",
    "ltibia",
    "lfoot",
    "ltoes",
    "rhipjoint",
    "rfemur",
    "rtibia",
    "rfoot",
    "rtoes",
    "lowerback",
    "upperback",
    "thorax",
    "lowerneck",
    "upperneck",
    "head",
    "lclavicle",
    "lhumerus",
    "lradius",
    "lwrist",
    "lhand",
    "lfingers",
    "lthumb",
    "rclavicle",
    "rhumerus",
    "rradius",
    "rwrist",
    "rhand",
    "rfingers",
    "rthumb",
)
"""Joint order of the ASF skeleton of mocap.cs.cmu.edu; each point is the END of the bone of that name."""

PARENTS = (
    -1,
    0,
    1,
    2,
    3,
    4,
    0,
    6,
    7,
    8,
    9,
    0,
    11,
    12,
    13,
    14,
    15,
    13,
    17,
    18,
    19,
    20,
    21,
    20,
    13,
    24,
    25,
    26,
    27,
    28,
    27,
)
"""Index of the joint at which each bone begins; -1 for the root."""

_MAX_BYTES = 500_000_000
_MAX_NUMBER = 1e6
_THIGH = (0.15, 0.8)  # metres, of anybody


def read_lines(path: Path) -> list[str]:
    """The lines of a text file; raises MocapError."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise MocapError(f"{path}: more than {_MAX_BYTES // 10**6} MB: this is no motion capture")
        return path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError as error:
        raise MocapError(f"{path}: {error.strerror or error}") from None


def are_numbers(values: np.ndarray) -> bool:
    """Whether all are numbers that a length or an angle can have."""
    return bool((np.abs(values) < _MAX_NUMBER).all())


def rotation(angles: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    """Rotations (N,3,3) by angles (N,3) about the fixed axes x, y, z, in radians: about those of ``order``, in turn."""
    turned = np.tile(np.eye(3), (len(angles), 1, 1))
    for axis in order:
        turned = turn(angles[:, axis], axis) @ turned
    return turned


def turn(angle: np.ndarray, axis: int) -> np.ndarray:
    """Rotations (N,3,3) by angles (N,), in radians, about one axis of 0, 1, 2 for x, y, z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -R[:, j, i]
    return R


def check_size(path: Path, joints: np.ndarray) -> np.ndarray:
    """The joints (F,31,3), if their thighs are those of a person in metres; raises MocapError."""
    thigh = float(np.linalg.norm(_joint(joints, "lfemur") - _joint(joints, "lhipjoint"), axis=1)[0])
    if not _THIGH[0] < thigh < _THIGH[1]:
        raise MocapError(f"{path}: a thigh is {thigh:.3g} m long: the file's unit is not that of the CMU archive")
    return joints


# The head is the same for everybody: averages of adults, metres in the head frame (lateral to the left, up, forward)
# from the ear level.  Eyes and mouth: Farkas, Anthropometry of the Head and Face, 1994 (between the inner corners of
# the eyes 0.033, the outer ones 0.09; mouth 0.05 wide); head_top: tragion to top of head 0.13, ANSUR II 2012.
_EAR_LEVEL = 0.6  # of the way from upperneck to head
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
# wide, ankle 0.039 above the sole; the heel is a quarter of the length behind the ankle, the tip of the fifth toe a
# fifth behind that of the longest.  The capture's toes end at that tip: ankle to toes and heel are 0.152 long together.
_HEEL = (0.0, -0.030, -0.036)  # from the ankle
_TOES = {"big_toe": (-0.010, 0.0, 0.0), "small_toe": (0.030, 0.0, -0.030), "foot_index": (0.0, 0.0, 0.0)}
_SOLE = np.deg2rad(16.0)  # between ankle -> ball and the sole: the ankle's height over its distance from the ball
# Shares of stature in the hand's frame (towards the thumb, towards the fingers).  D&C: hand 0.108 long; the knuckles
# are half-way, and those of index and little finger 0.039 apart (ANSUR II: hand breadth less half a finger each side).
_KNUCKLES = {"index_knuckle": (0.017, 0.054), "pinky_knuckle": (-0.022, 0.048), "thumb_knuckle": (0.032, 0.040)}
_LEG_SHARE = 0.245 + 0.246  # thigh and shank of stature, D&C
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
    """The layout that human_points are in the order of."""
    return load_layout("human")


def human_points(joints: np.ndarray) -> np.ndarray:
    """The points of the layout ``human`` from CMU-31 joints.

    Args:
        joints: (F,31,3) metres in any right-handed frame, order CMU31.

    Returns:
        (F,43,3) float64 in the same frame.
    """
    joints = np.asarray(joints, dtype=np.float64)
    if joints.ndim != 3 or joints.shape[1:] != (len(CMU31), 3):
        raise ValueError(f"CMU joints must be (frames, {len(CMU31)}, 3), got {joints.shape}")
    places = {
        f"{side}_{part}": _joint(joints, letter + bone)
        for side, letter in _SIDES.items()
        for part, bone in _LIMBS.items()
    }
    places |= _trunk(joints, places) | _head(joints)
    for side, letter in _SIDES.items():
        places |= _foot(joints, places, side, letter) | _hand(joints, places, side, letter)
    return np.stack([places[name] for name in human_layout().names], axis=1)


@cache
def human_mapping(name: str) -> Mapping:
    """How points of a layout become points of ``human``.  Raises LayoutError: no such layout, or foreign points."""
    layout = load_layout(name)
    if foreign := [point for point in layout.names if point not in human_layout().names]:
        raise LayoutError(f"layout '{name}' has points that human has not: {', '.join(foreign[:5])}")
    return layout.map_to(human_layout())


def layout_points(joints: np.ndarray, layout: Layout) -> np.ndarray:
    """The points (F,P,3) of a layout whose names are all among those of ``human``; else as human_points."""
    return human_points(joints)[:, [human_layout().names.index(name) for name in layout.names]]


def _trunk(joints: np.ndarray, places: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Human3.6M's spine is at 0.48 of the way from pelvis to thorax, where the capture's lowerback ends; its thorax the
    base of the neck: level with the shoulders, amid the capture's lower neck; its head the joint of neck and skull.
    """
    return {
        "pelvis": (places["left_hip"] + places["right_hip"]) / 2,
        "neck": (places["left_shoulder"] + places["right_shoulder"]) / 2,
        "spine": _joint(joints, "lowerback"),
        "thorax": (_joint(joints, "thorax") + _joint(joints, "lowerneck")) / 2,
        "head": _joint(joints, "upperneck"),
    }


def _head(joints: np.ndarray) -> dict[str, np.ndarray]:
    """Up = upperneck -> head, lateral = right to left clavicle made orthogonal to up, forward = lateral x up."""
    neck, head = _joint(joints, "upperneck"), _joint(joints, "head")
    up = _unit(head - neck)
    lateral = _joint(joints, "lclavicle") - _joint(joints, "rclavicle")
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
    """The foot bends with the ankle in the plane of shank and foot; its tilt to the sides is not captured here."""
    ankle, stature = places[f"{side}_ankle"], _stature(places)
    instep = _unit(_joint(joints, letter + "foot") - ankle)
    # Shank and foot are never in line, but for a slip of the capture: there the hips say what is lateral.
    hips = places["left_hip"] - places["right_hip"]
    to_left = _unit(np.cross(places[f"{side}_knee"] - ankle, instep) + 0.05 * hips)
    upwards = np.cross(instep, to_left)
    forward = _unit(np.cos(_SOLE) * instep + np.sin(_SOLE) * upwards)
    axes = np.stack([to_left if side == "left" else -to_left, _unit(np.cross(forward, to_left)), forward], axis=1)
    tip = _joint(joints, letter + "toes")
    toes = {f"{side}_{name}": tip + stature * (np.array(offset) @ axes) for name, offset in _TOES.items()}
    return {f"{side}_heel": ankle + stature * (np.array(_HEEL) @ axes), **toes}


def _hand(joints: np.ndarray, places: dict[str, np.ndarray], side: str, letter: str) -> dict[str, np.ndarray]:
    """The hand as it bends and turns at the end of the capture's bone ``wrist``, put to the wrist."""
    bend = _joint(joints, letter + "wrist")
    fingers = _unit(_joint(joints, letter + "fingers") - bend)
    # A thumb in line with the fingers shows no palm: there the knuckles lie along the line to the other shoulder.
    spare = places["right_shoulder"] - places["left_shoulder"]
    thumb = _joint(joints, letter + "thumb") - bend + 1e-4 * (spare if side == "left" else -spare)
    thumb = _unit(thumb - (thumb * fingers).sum(-1, keepdims=True) * fingers)
    axes = np.stack([thumb, fingers], axis=1)
    return {
        f"{side}_{name}": places[f"{side}_wrist"] + _stature(places) * (np.array(offset) @ axes)
        for name, offset in _KNUCKLES.items()
    }


def _stature(places: dict[str, np.ndarray]) -> np.ndarray:
    """(F,1) metres, by the length of the legs."""
    bones = [(f"{side}_{a}", f"{side}_{b}") for side in _SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))]
    legs = sum(np.linalg.norm(places[a] - places[b], axis=-1, keepdims=True) for a, b in bones) / 2
    return legs / _LEG_SHARE


def _joint(joints: np.ndarray, name: str) -> np.ndarray:
    return joints[:, CMU31.index(name)]


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
