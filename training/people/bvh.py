# SPDX-License-Identifier: Apache-2.0
"""Biovision motions (.bvh), as cgspeed converted the CMU archive to them, to CMU-31 joints. numpy only.

A joint has an offset from its parent, and channels: with R the product of its rotations in the order of its channels,
it and all that hangs on it are turned by ``R_parent R``, and it is at ``parent + R_parent offset``.  Lengths are those
of the archive's skeletons, 0.45 units an inch.  The first frame is a T-pose that nobody took, and is left out.

The conversion leaves out two bones: ``thorax``, so that neck and shoulders hang on the end of ``upperback``, and
``wrist``.  They are put back, a thorax as long as upperback and in its direction at rest, and a wrist half as long as
radius and in line with it, as the archive's skeletons have them (the first frames of trial 01_02: 5 mm off above the
thorax, all else as in the archive).

There are readers on PyPI, one of them kept up (pybvh); it needs matplotlib, and says less of what is wrong in a file
than this needs to.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from training.errors import MocapError
from training.people.asf_amc import INCH
from training.people.mocap import CMU31, are_numbers, check_size, read_lines, rotation

METRES = INCH / 0.45
"""Of a unit of length."""

_CHANNELS = ("xposition", "yposition", "zposition", "xrotation", "yrotation", "zrotation")
_END = " end"  # of the name of an End Site; names in the file have no spaces
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
_ON_THE_LEFT_OUT = ("LeftShoulder", "RightShoulder", "LThumb", "RThumb")
"""Joints that hang on a bone that the conversion leaves out, and are no ends of bones themselves."""


@dataclass
class Joint:
    """A joint. parent: index, -1 for the root. channels: indices of _CHANNELS."""

    name: str
    parent: int
    offset: np.ndarray | None = None
    channels: tuple[int, ...] = ()


def read_bvh(path: Path) -> np.ndarray:
    """The joints of a motion, (F,31,3) float32 metres, y up, order CMU31.

    Raises:
        MocapError: it cannot be read, is cut off, or is not of this skeleton; with file, line and what is wrong.
    """
    reader = _BvhReader(path)
    joints, values = reader.hierarchy(), reader.motion()
    index = {joint.name: k for k, joint in enumerate(joints)}
    if missing := [name for name in (*_JOINTS.values(), *_ON_THE_LEFT_OUT) if name not in index]:
        raise MocapError(
            f"{path}: no joint '{missing[0].strip()}', this is none of cgspeed's conversions of the archive"
        )
    _put_back(joints, index)
    places = kinematics(joints, values[1:] if len(values) > 1 else values)
    return check_size(path, METRES * places[:, [index[_JOINTS[name]] for name in CMU31]]).astype(np.float32)


def _put_back(joints: list[Joint], index: dict[str, int]) -> None:
    """Give the bones that the conversion left out their lengths."""
    if not joints[index["Neck"]].offset.any():
        for name in ("Neck", "LeftShoulder", "RightShoulder"):
            joints[index[name]].offset = joints[index["Spine1"]].offset
    for side in ("Left", "Right"):
        if not joints[index[f"{side}FingerBase"]].offset.any():
            for name in (f"{side}FingerBase", f"{side[0]}Thumb"):
                joints[index[name]].offset = joints[index[f"{side}Hand"]].offset / 2


def kinematics(joints: list[Joint], values: np.ndarray) -> np.ndarray:
    """Where joints are, (F,J,3) in the file's unit, given the values of all channels (F,C)."""
    places, turns, column = [], [], 0
    for joint in joints:
        own = values[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        given = np.zeros((len(values), 6))
        given[:, list(joint.channels)] = own
        order = tuple(channel - 3 for channel in joint.channels if channel >= 3)
        turn = rotation(np.deg2rad(given[:, 3:]), order[::-1])  # about moving axes: the last listed turns first
        at = joint.offset + given[:, :3]
        if joint.parent >= 0:
            at = places[joint.parent] + (turns[joint.parent] @ at[:, :, None])[:, :, 0]
            turn = turns[joint.parent] @ turn
        places.append(at)
        turns.append(turn)
    return np.stack(places, axis=1)


class _BvhReader:
    """The lines of a file, read once from top to bottom."""

    def __init__(self, path: Path) -> None:
        self.path, self.lines, self.line = path, read_lines(path), 0
        self.channels = 0

    def _wrong(self, what: str) -> MocapError:
        return MocapError(f"{self.path}:{self.line}: {what}")

    def _next(self) -> list[str]:
        """The words of the next line that has any."""
        while self.line < len(self.lines):
            self.line += 1
            if words := self.lines[self.line - 1].split():
                return words
        raise self._wrong("the file ends here: it is cut off, get it again")

    def hierarchy(self) -> list[Joint]:
        """The joints, parents before children."""
        if [word.upper() for word in self._next()] != ["HIERARCHY"]:
            raise self._wrong("no HIERARCHY: this is no .bvh file")
        joints: list[Joint] = []
        opened: list[int] = []
        while True:
            words = self._next()
            key = words[0].upper()
            if key in ("ROOT", "JOINT", "END") and len(words) == 2:
                self._open(joints, opened, words)
            elif key == "}" and opened:
                if joints[opened[-1]].offset is None:
                    raise self._wrong(f"joint '{joints[opened[-1]].name}' has no OFFSET")
                opened.pop()
            elif key == "OFFSET" and opened:
                joints[opened[-1]].offset = self._numbers(words[1:], 3, "OFFSET")
            elif key == "CHANNELS" and opened:
                joints[opened[-1]].channels = self._channels(words[1:])
            elif key == "MOTION" and joints and not opened:
                return joints
            else:
                raise self._wrong(f"'{' '.join(words)[:40]}' does not belong here")

    def _open(self, joints: list[Joint], opened: list[int], words: list[str]) -> None:
        if (words[0].upper() == "ROOT") == bool(joints) or joints and not opened:
            raise self._wrong(f"'{' '.join(words)[:40]}': there must be one ROOT, and all else in it")
        parent = opened[-1] if opened else -1
        name = words[1] if words[0].upper() != "END" else joints[parent].name + _END
        if name in (joint.name for joint in joints):
            raise self._wrong(f"joint '{name.strip()}' is there twice")
        if self._next() != ["{"]:
            raise self._wrong("'{' must follow the name of a joint")
        opened.append(len(joints))
        joints.append(Joint(name, parent))

    def _channels(self, words: list[str]) -> tuple[int, ...]:
        names = [word.lower() for word in words[1:]]
        if (
            words[:1] != [str(len(names))]
            or any(name not in _CHANNELS for name in names)
            or len(set(names)) < len(names)
        ):
            raise self._wrong(
                f"CHANNELS must be their number and names such as Zrotation, it is '{' '.join(words)[:60]}'"
            )
        self.channels += len(names)
        return tuple(_CHANNELS.index(name) for name in names)

    def _numbers(self, words: list[str], count: int, what: str) -> np.ndarray:
        try:
            numbers = np.array([float(word) for word in words])
        except ValueError:
            numbers = np.array([])
        if len(numbers) != count or not are_numbers(numbers):
            raise self._wrong(f"{what} must be {count} numbers, it is '{' '.join(words)[:40]}'")
        return numbers

    def motion(self) -> np.ndarray:
        """The values of all channels, (F,C)."""
        words = self._next()
        if words[0].lower() != "frames:" or len(words) != 2 or not words[1].isdecimal():
            raise self._wrong("'Frames:' and their number must follow MOTION")
        frames = int(words[1])
        if [word.lower() for word in self._next()[:2]] != ["frame", "time:"]:
            raise self._wrong("'Frame Time:' must follow Frames")
        rows = [(number, text) for number, text in enumerate(self.lines[self.line :], self.line + 1) if text.strip()]
        if len(rows) != frames or not frames:
            self.line = rows[-1][0] if rows else self.line
            raise self._wrong(f"{len(rows)} of {frames} frames are there: the file is damaged, get it again")
        try:
            values = np.array([text.split() for _, text in rows], dtype=float)
            sound = values.shape == (frames, self.channels) and are_numbers(values)
        except ValueError:
            sound = False
        if not sound:
            for self.line, text in rows:
                self._numbers(text.split(), self.channels, "a frame")
        return values
