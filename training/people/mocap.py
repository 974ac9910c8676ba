# SPDX-License-Identifier: Apache-2.0
"""The CMU-31 skeleton, and what all readers of motion capture share. NumPy only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from training.errors import MocapError

_SPINE = ("lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head")
_LEG = ("hipjoint", "femur", "tibia", "foot", "toes")
_ARM = ("clavicle", "humerus", "radius", "wrist", "hand", "fingers", "thumb")

CMU31 = (
    "root",
    *(side + bone for side in "lr" for bone in _LEG),
    *_SPINE,
    *(side + bone for side in "lr" for bone in _ARM),
)
"""Joint order of the ASF skeleton of mocap.cs.cmu.edu; each joint is the END of the bone of that name."""

PARENTS = (
    *(-1, 0, 1, 2, 3, 4, 0, 6, 7, 8, 9),  # root, left leg, right leg
    *(0, 11, 12, 13, 14, 15),  # spine to head
    *(13, 17, 18, 19, 20, 21, 20),  # left arm; the thumb begins at the wrist
    *(13, 24, 25, 26, 27, 28, 27),  # right arm
)
"""Index of the joint at which each bone begins; -1 for the root."""

_MAX_BYTES = 500_000_000
_MAX_NUMBER = 1e6
_THIGH_METRES = (0.15, 0.8)


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file.

    Raises:
        MocapError: the file cannot be read or is larger than 500 MB.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise MocapError(f"{path}: the file is larger than {_MAX_BYTES // 10**6} MB, too large for motion capture")
        return path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError as error:
        raise MocapError(f"{path}: {error.strerror or error}") from None


def plausible_numbers(words: Sequence[str], count: int) -> np.ndarray | None:
    """Convert words to so many plausible numbers; None if they are not."""
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        return None
    return numbers if len(numbers) == count and are_plausible(numbers) else None


def are_plausible(values: np.ndarray) -> bool:
    """Return whether all values are finite and of a size that lengths and angles can have."""
    return bool((np.abs(values) < _MAX_NUMBER).all())


def fixed_axis_rotations(angles: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    """Compose rotations about the fixed axes x, y, z.

    Args:
        angles: (N,3) radians about x, y, z.
        order: axes (0, 1, 2 for x, y, z) in the order in which the rotations are applied.

    Returns:
        (N,3,3) rotations.
    """
    R = np.tile(np.eye(3), (len(angles), 1, 1))
    for axis in order:
        R = axis_rotations(angles[:, axis], axis) @ R
    return R


def axis_rotations(angle: np.ndarray, axis: int) -> np.ndarray:
    """Return rotations (N,3,3) by angles (N,), radians, about one axis: 0, 1, 2 for x, y, z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -R[:, j, i]
    return R


def joint(joints: np.ndarray, name: str) -> np.ndarray:
    """Return one joint (F,3) of CMU-31 joints (F,31,3) by its name."""
    return joints[:, CMU31.index(name)]


def check_size(path: Path, joints: np.ndarray) -> np.ndarray:
    """Return the joints (F,31,3) if the thigh has a human length in metres.

    Raises:
        MocapError: it has not, so the file uses another unit of length.
    """
    thigh = float(np.linalg.norm(joint(joints, "lfemur") - joint(joints, "lhipjoint"), axis=1)[0])
    if not _THIGH_METRES[0] < thigh < _THIGH_METRES[1]:
        raise MocapError(f"{path}: a thigh is {thigh:.3g} m long: the file's unit is not that of the CMU archive")
    return joints
