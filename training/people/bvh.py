# SPDX-License-Identifier: Apache-2.0
"""Reader of cgspeed's conversions of the CMU archive to Biovision motions (.bvh); gives CMU-31 joints. NumPy only.

A joint has an offset from its parent, and channels.  R is the product of its rotations in the order of the channels.
``R_parent R`` turns the joint and its descendants; the joint is at ``parent + R_parent offset``.  Lengths are those of
the archive's skeletons, 0.45 units an inch.  The first frame is an artificial T-pose and is skipped.

The conversion lacks two bones, which are restored with the proportions of the archive's skeletons:

- ``thorax``: as long as upperback, in its direction at rest.  Without it neck and shoulders begin at upperback's end.
- ``wrist``: half as long as radius, in line with it.

In the first frames of trial 01_02 points above the thorax are 5 mm off; all others equal the archive's.

PyPI has one maintained reader, pybvh.  It needs matplotlib, and its errors do not name the faulty line.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from training.errors import MocapError
from training.people.asf_amc import INCH
from training.people.mocap import CMU31, are_plausible, check_size, fixed_axis_rotations, plausible_numbers, read_lines

METRES = INCH / 0.45
"""Metres per unit of length."""

_CHANNELS = ("xposition", "yposition", "zposition", "xrotation", "yrotation", "zrotation")
_END = " end"  # suffix that names an End Site; names in the file have no spaces
_JOINTS = {
    "root": "Hips",
    "lowerback": "Spine",
    "upperback": "Spine1",
    "thorax": "Neck",
    "lowerneck": "Neck1",
    "upperneck": "Head",
    "head": "Head" + _END,
}
for _letter, _side in (("l", "Left"), ("r", "Right")):
    _JOINTS |= {
        f"{_letter}hipjoint": f"{_side}UpLeg",
        f"{_letter}femur": f"{_side}Leg",
        f"{_letter}tibia": f"{_side}Foot",
        f"{_letter}foot": f"{_side}ToeBase",
        f"{_letter}toes": f"{_side}ToeBase{_END}",
        f"{_letter}clavicle": f"{_side}Arm",
        f"{_letter}humerus": f"{_side}ForeArm",
        f"{_letter}radius": f"{_side}Hand",
        f"{_letter}wrist": f"{_side}FingerBase",
        f"{_letter}hand": f"{_side}HandIndex1",
        f"{_letter}fingers": f"{_side}HandIndex1{_END}",
        f"{_letter}thumb": f"{_letter.upper()}Thumb{_END}",
    }
_BELOW_MISSING_BONES = ("LeftShoulder", "RightShoulder", "LThumb", "RThumb")
"""Joints whose parent bone the conversion lacks, and which are no ends of CMU bones themselves."""


@dataclass
class Joint:
    """A joint of the hierarchy.

    Attributes:
        name: of the joint.
        parent: index of the parent; -1 for the root.
        offset: (3,) from the parent, in the file's unit; None until it is read.
        channels: indices of ``_CHANNELS``.
    """

    name: str
    parent: int
    offset: np.ndarray | None = None
    channels: tuple[int, ...] = ()


def read_bvh(path: Path) -> np.ndarray:
    """Read a motion.

    Returns:
        (F,31,3) float32 joints in metres, y up, order ``CMU31``.

    Raises:
        MocapError: the file cannot be read, is cut off, or has another skeleton; names file and line.
    """
    reader = _BvhReader(path)
    joints, values = reader.hierarchy(), reader.motion()
    index = {joint.name: k for k, joint in enumerate(joints)}
    if missing := [name for name in (*_JOINTS.values(), *_BELOW_MISSING_BONES) if name not in index]:
        raise MocapError(
            f"{path}: no joint '{missing[0].strip()}', so this is no cgspeed conversion of the CMU archive"
        )
    _restore_bones(joints, index)
    places = kinematics(joints, values[1:] if len(values) > 1 else values)
    return check_size(path, METRES * places[:, [index[_JOINTS[name]] for name in CMU31]]).astype(np.float32)


def _restore_bones(joints: list[Joint], index: dict[str, int]) -> None:
    """Give the bones that the conversion lacks their lengths, in place."""
    if not _offset(joints[index["Neck"]]).any():
        for name in ("Neck", "LeftShoulder", "RightShoulder"):
            joints[index[name]].offset = joints[index["Spine1"]].offset
    for side in ("Left", "Right"):
        if not _offset(joints[index[f"{side}FingerBase"]]).any():
            for name in (f"{side}FingerBase", f"{side[0]}Thumb"):
                joints[index[name]].offset = _offset(joints[index[f"{side}Hand"]]) / 2


def _offset(joint: Joint) -> np.ndarray:
    """Return the joint's offset, which ``_BvhReader.hierarchy`` has checked to be there."""
    assert joint.offset is not None
    return joint.offset


def kinematics(joints: list[Joint], values: np.ndarray) -> np.ndarray:
    """Return the positions of joints (F,J,3), in the file's unit, from the values of all channels (F,C)."""
    places: list[np.ndarray] = []
    turns: list[np.ndarray] = []
    column = 0
    for joint in joints:
        own = values[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        given = np.zeros((len(values), 6))
        given[:, list(joint.channels)] = own
        order = tuple(channel - 3 for channel in joint.channels if channel >= 3)
        # Rotations are about moving axes: about fixed axes, the last listed one comes first.
        turn = fixed_axis_rotations(np.deg2rad(given[:, 3:]), order[::-1])
        at = _offset(joint) + given[:, :3]
        if joint.parent >= 0:
            at = places[joint.parent] + (turns[joint.parent] @ at[:, :, None])[:, :, 0]
            turn = turns[joint.parent] @ turn
        places.append(at)
        turns.append(turn)
    return np.stack(places, axis=1)


class _BvhReader:
    """Parser of a .bvh file, once from top to bottom."""

    def __init__(self, path: Path) -> None:
        self.path, self.lines, self.line = path, read_lines(path), 0
        self.channels = 0

    def _error(self, text: str) -> MocapError:
        """Return an error at the current line."""
        return MocapError(f"{self.path}:{self.line}: {text}")

    def _next(self) -> list[str]:
        """Return the words of the next line that is not empty."""
        while self.line < len(self.lines):
            self.line += 1
            if words := self.lines[self.line - 1].split():
                return words
        raise self._error("the file ends here: it is cut off, get it again")

    def hierarchy(self) -> list[Joint]:
        """Return the joints, parents before children."""
        if [word.upper() for word in self._next()] != ["HIERARCHY"]:
            raise self._error("no HIERARCHY, so this is no .bvh file")
        joints: list[Joint] = []
        opened: list[int] = []
        while True:
            words = self._next()
            key = words[0].upper()
            if key in ("ROOT", "JOINT", "END") and len(words) == 2:
                self._open(joints, opened, words)
            elif key == "}" and opened:
                if joints[opened[-1]].offset is None:
                    raise self._error(f"joint '{joints[opened[-1]].name}' has no OFFSET")
                opened.pop()
            elif key == "OFFSET" and opened:
                joints[opened[-1]].offset = self._numbers(words[1:], 3, "OFFSET")
            elif key == "CHANNELS" and opened:
                joints[opened[-1]].channels = self._channels(words[1:])
            elif key == "MOTION" and joints and not opened:
                return joints
            else:
                raise self._error(f"'{' '.join(words)[:40]}' does not belong here")

    def _open(self, joints: list[Joint], opened: list[int], words: list[str]) -> None:
        """Append the joint that begins at the current line."""
        if (words[0].upper() == "ROOT") == bool(joints) or joints and not opened:
            raise self._error(f"'{' '.join(words)[:40]}': there must be one ROOT that holds all other joints")
        parent = opened[-1] if opened else -1
        name = words[1] if words[0].upper() != "END" else joints[parent].name + _END
        if name in (joint.name for joint in joints):
            raise self._error(f"joint '{name.strip()}' occurs twice")
        if self._next() != ["{"]:
            raise self._error("'{' must follow the name of a joint")
        opened.append(len(joints))
        joints.append(Joint(name, parent))

    def _channels(self, words: list[str]) -> tuple[int, ...]:
        """Convert a line of CHANNELS to indices of ``_CHANNELS``."""
        names = [word.lower() for word in words[1:]]
        if (
            words[:1] != [str(len(names))]
            or any(name not in _CHANNELS for name in names)
            or len(set(names)) < len(names)
        ):
            raise self._error(
                f"CHANNELS must be their number and names such as Zrotation, it is '{' '.join(words)[:60]}'"
            )
        self.channels += len(names)
        return tuple(_CHANNELS.index(name) for name in names)

    def _numbers(self, words: list[str], count: int, what: str) -> np.ndarray:
        """Convert words to so many numbers."""
        numbers = plausible_numbers(words, count)
        if numbers is None:
            raise self._error(f"{what} must be {count} numbers, it is '{' '.join(words)[:40]}'")
        return numbers

    def motion(self) -> np.ndarray:
        """Return the values (F,C) of all channels."""
        words = self._next()
        if words[0].lower() != "frames:" or len(words) != 2 or not words[1].isdecimal():
            raise self._error("'Frames:' and their number must follow MOTION")
        frames = int(words[1])
        if [word.lower() for word in self._next()[:2]] != ["frame", "time:"]:
            raise self._error("'Frame Time:' must follow Frames")
        rows = [(number, text) for number, text in enumerate(self.lines[self.line :], self.line + 1) if text.strip()]
        if len(rows) != frames or not frames:
            self.line = rows[-1][0] if rows else self.line
            raise self._error(f"the file holds {len(rows)} of {frames} frames: it is damaged, get it again")
        try:
            values = np.array([text.split() for _, text in rows], dtype=float)
            sound = values.shape == (frames, self.channels) and are_plausible(values)
        except ValueError:
            sound = False
        if not sound:
            for self.line, text in rows:
                self._numbers(text.split(), self.channels, "a frame")
        return values
