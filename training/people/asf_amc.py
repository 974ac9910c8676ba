# SPDX-License-Identifier: Apache-2.0
"""Reader of the CMU archive's Acclaim skeletons (.asf) and motions (.amc); gives CMU-31 joints. NumPy only.

The format is Acclaim ATG, Skeleton File Definition 1.10, 1995.  A bone at rest has a direction and a length in the
world's axes, and an axis frame, a rotation C.  A motion gives angles about that frame's axes for the bone's degrees of
freedom; M is their rotation.  C M C^-1 turns the bone and its descendants, and the bone ends at
``parent + length R direction``.  Rotations are about fixed axes in the listed order: XYZ means first x, so Rz Ry Rx.

No maintained package reads these files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from training.errors import MocapError
from training.people.mocap import CMU31, are_plausible, check_size, fixed_axis_rotations, plausible_numbers, read_lines

INCH = 0.0254
"""Metres.  CMU's lengths divided by the skeleton's unit of length are inches (mocap.cs.cmu.edu, Frequently Asked)."""

_ROTATIONS = {"rx": 0, "ry": 1, "rz": 2}
_ROOT_ORDER = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass
class Bone:
    """A bone at rest.

    Attributes:
        name: of the bone.
        parent: name of the parent bone, or ``root``.
        direction: (3,) unit vector in the world's axes.
        length: in the file's unit of length.
        axis: (3,3) the rotation C of the bone's axis frame.
        dof: axes of its rotations in their order; 0, 1, 2 for x, y, z.
    """

    name: str
    parent: str = ""
    direction: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: np.ndarray = field(default_factory=lambda: np.eye(3))
    dof: tuple[int, ...] = ()


@dataclass(frozen=True)
class AsfSkeleton:
    """The contents of an .asf file.

    Attributes:
        path: of the file.
        bones: parents before children.
        metres: metres per unit of length.
        degrees: whether angles are degrees; else radians.
        order: order of the root's six values, as indices of tx, ty, tz, rx, ry, rz.
        position: (3,) offset added to the root's position.
        axis: (3,3) the rotation C of the root.
    """

    path: Path
    bones: tuple[Bone, ...]
    metres: float
    degrees: bool
    order: tuple[int, ...]
    position: np.ndarray
    axis: np.ndarray


def read_asf(path: Path) -> AsfSkeleton:
    """Read a skeleton.

    Raises:
        MocapError: the file cannot be read, or is no skeleton of the CMU archive; names file and line.
    """
    return _AsfReader(path).skeleton()


class _AsfReader:
    """Parser of an .asf file: one pass over the lines, then a check that nothing is missing."""

    def __init__(self, path: Path) -> None:
        self.path, self.line = path, 0
        self.units: dict[str, str] = {}
        self.root: dict[str, list[str]] = {}
        self.bones: dict[str, Bone] = {}
        self._bone: dict[str, list[str]] | None = None
        section = ""
        for self.line, text in enumerate(read_lines(path), 1):
            words = text.split("#")[0].replace("(", " ").replace(")", " ").replace(",", " ").split()
            if not words:
                continue
            if words[0].startswith(":"):
                section = words[0].lower()
            elif reader := getattr(self, f"_{section[1:]}", None) if section in _SECTIONS else None:
                reader([words[0].lower(), *words[1:]])
        if self._bone is not None:
            raise self._error("the file ends within a bone: it is cut off, get it again")

    def _error(self, text: str) -> MocapError:
        """Return an error at the current line."""
        return MocapError(f"{self.path}:{self.line}: {text}")

    def _units(self, words: list[str]) -> None:
        self.units[words[0]] = " ".join(words[1:]).lower()

    def _root(self, words: list[str]) -> None:
        self.root[words[0]] = [word.lower() for word in words[1:]]

    def _bonedata(self, words: list[str]) -> None:
        if words[0] == "begin":
            self._bone = {}
        elif self._bone is None:
            raise self._error(f"'{words[0][:40]}' outside of a bone; a bone goes from begin to end")
        elif words[0] == "end":
            bone = self._parse_bone(self._bone)
            if bone.name in self.bones:
                raise self._error(f"bone '{bone.name}' occurs twice")
            self.bones[bone.name], self._bone = bone, None
        else:
            self._bone[words[0]] = words[1:]

    def _parse_bone(self, given: dict[str, list[str]]) -> Bone:
        """Return the bone of the lines between begin and end, by their first words."""
        if missing := [key for key in ("name", "direction", "length", "axis") if not given.get(key)]:
            raise self._error(f"the bone that ends here has no {missing[0]}")
        direction = self._numbers(given["direction"], 3, "direction")
        size = np.linalg.norm(direction)
        if not 0.9 < size < 1.1:
            raise self._error(f"the direction of '{given['name'][0]}' has length {size:.3g}, not 1")
        dof = [word.lower() for word in given.get("dof", [])]
        if unknown := [word for word in dof if word not in _ROTATIONS]:
            raise self._error(f"degree of freedom '{unknown[0]}' is not supported, only rotations: rx, ry, rz")
        order = self._axes(given["axis"][3:], "axis")
        axis = fixed_axis_rotations(self._angles(given["axis"][:3], "axis")[None], order)[0]
        length = self._numbers(given["length"], 1, "length")[0]
        return Bone(given["name"][0], "", direction / size, length, axis, tuple(_ROTATIONS[word] for word in dof))

    def _hierarchy(self, words: list[str]) -> None:
        if words[0] in ("begin", "end"):
            return
        for child in words[1:]:
            if child not in self.bones or words[0] not in self.bones and words[0] != "root":
                raise self._error(f"'{child}' under '{words[0]}': one of them is no bone")
            if self.bones[child].parent:
                raise self._error(f"bone '{child}' has two parents")
            self.bones[child].parent = words[0]

    def _numbers(self, words: list[str], count: int, what: str) -> np.ndarray:
        """Convert words to so many numbers."""
        numbers = plausible_numbers(words, count)
        if numbers is None:
            raise self._error(f"{what} must be {count} numbers, it is '{' '.join(words)[:40]}'")
        return numbers

    def _angles(self, words: list[str], what: str) -> np.ndarray:
        """Convert words to three angles in radians."""
        angles = self._numbers(words, 3, what)
        return angles if self.units.get("angle") == "rad" else np.deg2rad(angles)

    def _axes(self, words: list[str], what: str) -> tuple[int, ...]:
        """Convert an order of axes, such as XYZ, to indices."""
        text = "".join(words).lower()
        if sorted(text) != ["x", "y", "z"]:
            raise self._error(f"{what} must name its order, as XYZ, it is '{text[:40]}'")
        return tuple("xyz".index(letter) for letter in text)

    def skeleton(self) -> AsfSkeleton:
        """Return the skeleton.

        Raises:
            MocapError: a part of it is missing in the file.
        """
        if missing := [name for name in CMU31[1:] if name not in self.bones]:
            raise MocapError(f"{self.path}: no bone '{missing[0]}', so this is no skeleton of the CMU archive")
        if self.units.get("angle") not in ("deg", "rad"):
            raise MocapError(f"{self.path}: ':units' must say 'angle deg' or 'angle rad'")
        unit = self._numbers(self.units.get("length", "").split(), 1, "length in ':units'")[0]
        order = self.root.get("order", [])
        if sorted(order) != sorted(_ROOT_ORDER):
            raise MocapError(f"{self.path}: ':root' must have an order of {' '.join(_ROOT_ORDER)}")
        turn = self._angles(self.root.get("orientation", []), "orientation of ':root'")
        return AsfSkeleton(
            self.path,
            self._sorted(),
            INCH / unit,
            self.units["angle"] == "deg",
            tuple(_ROOT_ORDER.index(word) for word in order),
            self._numbers(self.root.get("position", []), 3, "position of ':root'"),
            fixed_axis_rotations(turn[None], self._axes(self.root.get("axis", []), "axis of ':root'"))[0],
        )

    def _sorted(self) -> tuple[Bone, ...]:
        """Return the bones, parents before children."""
        done: dict[str, Bone] = {}
        while len(done) < len(self.bones):
            ready = [b for b in self.bones.values() if b.name not in done and (b.parent in done or b.parent == "root")]
            if not ready:
                loose = next(name for name in self.bones if name not in done)
                raise MocapError(f"{self.path}: bone '{loose}' has no parent in ':hierarchy'")
            done |= {bone.name: bone for bone in ready}
        return tuple(done.values())


_SECTIONS = (":units", ":root", ":bonedata", ":hierarchy")


def read_amc(path: Path, skeleton: AsfSkeleton) -> np.ndarray:
    """Read a motion.

    Args:
        path: of the .amc file.
        skeleton: of the same person.

    Returns:
        (F,31,3) float32 joints in metres, y up, order ``CMU31``.

    Raises:
        MocapError: the file cannot be read, is cut off, or belongs to another skeleton; names file and line.
    """
    angles = _read_values(path, skeleton)
    root = np.empty_like(angles["root"])
    root[:, list(skeleton.order)] = angles["root"]
    turn = tuple(index - 3 for index in skeleton.order if index >= 3)
    ends = {"root": skeleton.position + root[:, :3]}
    turns = {"root": skeleton.axis @ fixed_axis_rotations(_radians(root[:, 3:], skeleton), turn) @ skeleton.axis.T}
    for bone in skeleton.bones:
        turned = turns[bone.parent]
        if bone.dof:
            given = np.zeros((len(root), 3))
            given[:, list(bone.dof)] = _radians(angles[bone.name], skeleton)
            turned = turned @ bone.axis @ fixed_axis_rotations(given, bone.dof) @ bone.axis.T
        turns[bone.name] = turned
        ends[bone.name] = ends[bone.parent] + bone.length * (turned @ bone.direction)
    joints = skeleton.metres * np.stack([ends[name] for name in CMU31], axis=1)
    return check_size(path, joints).astype(np.float32)


def _radians(values: np.ndarray, skeleton: AsfSkeleton) -> np.ndarray:
    return np.deg2rad(values) if skeleton.degrees else values


def _read_values(path: Path, skeleton: AsfSkeleton) -> dict[str, np.ndarray]:
    """Return the values (F,D) of the root and of every moving bone, as they stand in the file.

    All frames must list the same bones in the same order, so that a bone is every B-th line.  Frames are numbered;
    numbers may be left out.
    """
    lines, first = _frames(path)
    end = next((k for k, text in enumerate(lines[1:], 1) if text.strip().isdecimal()), len(lines))
    moving = {"root": 6, **{bone.name: len(bone.dof) for bone in skeleton.bones if bone.dof}}
    names = [" ".join(text.split()[:1]) for text in lines[1:end]]
    for number, name in enumerate(names, first + 1):
        if not name:
            raise MocapError(f"{path}:{number}: an empty line within a frame")
        if name not in moving:
            raise MocapError(f"{path}:{number}: '{name[:40]}' does not move in {skeleton.path.name}: another skeleton?")
    if missing := [name for name in moving if names.count(name) != 1]:
        raise MocapError(f"{path}:{first}: frame 1 has bone '{missing[0]}' {names.count(missing[0])} times, not once")
    if over := len(lines) % end:
        _check_lines(path, lines, ["", *names], first, moving)
        raise MocapError(f"{path}:{first + len(lines) - over}: the last frame is cut off: get the file again")
    try:
        if not all(text.strip().isdecimal() for text in lines[::end]):
            raise ValueError("number of a frame")
        return {name: _column(lines[k::end], name, moving[name]) for k, name in enumerate(names, 1)}
    except ValueError:
        _check_lines(path, lines, ["", *names], first, moving)
        raise


def _frames(path: Path) -> tuple[list[str], int]:
    """Return the lines from the first frame on, and the line number of the first one."""
    lines = read_lines(path)
    while lines and not lines[-1].strip():
        lines.pop()
    for index, text in enumerate(lines):
        words = text.split()
        if words and words[0].isdecimal():
            return lines[index:], index + 1
        if words and words[0].lower() in (":radians", ":rotation-only"):
            raise MocapError(f"{path}:{index + 1}: '{words[0]}' is not supported, only :FULLY-SPECIFIED and :DEGREES")
        if words and not words[0].startswith(("#", ":")):
            break
    raise MocapError(f"{path}: the file has no frames, so it is no .amc file")


def _column(lines: list[str], name: str, count: int) -> np.ndarray:
    """Return the values (F,D) of a bone's lines.

    Raises:
        ValueError: a line is not the bone's name followed by D numbers.
    """
    words = [text.split() for text in lines]
    if any(len(line) != count + 1 or line[0] != name for line in words):
        raise ValueError(name)
    values = np.array([line[1:] for line in words], dtype=float)
    if not are_plausible(values):
        raise ValueError(name)
    return values


def _check_lines(path: Path, lines: list[str], names: list[str], first: int, counts: dict[str, int]) -> None:
    """Raise MocapError for the first line that differs from frame 1; names[0] stands for the frame's number."""
    for index, text in enumerate(lines):
        number, words, expected = first + index, text.split(), names[index % len(names)]
        if not words or words[0] != expected and (expected or not text.strip().isdecimal()):
            found = f"'{words[0][:40]}'" if words else "nothing"
            wanted = f"'{expected}'" if expected else "its number"
            raise MocapError(f"{path}:{number}: {found} where {wanted} of frame {index // len(names) + 1} belongs")
        if expected in counts:
            try:
                _column([text], expected, counts[expected])
            except ValueError:
                raise MocapError(f"{path}:{number}: '{expected}' must have {counts[expected]} numbers") from None
