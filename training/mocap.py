# SPDX-License-Identifier: Apache-2.0
"""Motion capture in the CMU skeleton, read as the keypoints a camera would see. numpy only."""

from __future__ import annotations

import numpy as np

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

# The capture has no face points. They are placed in the head frame (lateral, up, forward), in metres from the
# ear level: anatomical averages of an adult head, the same for everybody.
_EAR_LEVEL = 0.6  # of the way from upperneck to head
_FACE = np.array(
    [
        [0.0, -0.02, 0.11],  # nose
        [0.032, 0.02, 0.085],  # left eye
        [-0.032, 0.02, 0.085],  # right eye
        [0.075, 0.0, 0.0],  # left ear
        [-0.075, 0.0, 0.0],  # right ear
    ]
)
# COCO's shoulder, elbow, wrist, hip, knee, ankle as bone ends, without the side letter.
_BODY_BONES = ("clavicle", "humerus", "radius", "hipjoint", "femur", "tibia")


def coco17_from_cmu31(joints: np.ndarray) -> np.ndarray:
    """COCO-17 points of CMU-31 joints.

    joints: (F,31,3) metres in any right-handed frame, order CMU31. Returns (F,17,3) float64 in the same frame.
    Body points are bone ends. Face points stand at fixed offsets in the head frame: up = upperneck -> head,
    lateral = right to left clavicle made orthogonal to up, forward = lateral x up.
    """
    joints = np.asarray(joints, dtype=np.float64)
    if joints.ndim != 3 or joints.shape[1:] != (len(CMU31), 3):
        raise ValueError(f"CMU joints must be (frames, {len(CMU31)}, 3), got {joints.shape}")
    sides = [_joint(joints, side + bone) for bone in _BODY_BONES for side in "lr"]
    return np.concatenate([_face(joints), np.stack(sides, axis=1)], axis=1)


def _face(joints: np.ndarray) -> np.ndarray:
    neck, head = _joint(joints, "upperneck"), _joint(joints, "head")
    up = _unit(head - neck)
    lateral = _joint(joints, "lclavicle") - _joint(joints, "rclavicle")
    lateral = _unit(lateral - (lateral * up).sum(-1, keepdims=True) * up)
    axes = np.stack([lateral, up, np.cross(lateral, up)], axis=1)
    return (neck + _EAR_LEVEL * (head - neck))[:, None] + _FACE @ axes


def _joint(joints: np.ndarray, name: str) -> np.ndarray:
    return joints[:, CMU31.index(name)]


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
