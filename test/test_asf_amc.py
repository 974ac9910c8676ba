# SPDX-License-Identifier: Apache-2.0
"""Reader of .asf and .amc: exact joints, and errors that name file and line."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.errors import MocapError
from training.people.asf_amc import read_amc, read_asf
from training.people.bvh import read_bvh
from training.people.mocap import CMU31, PARENTS

METRES = 0.0254 / 0.45
DOF = {
    **dict.fromkeys(("lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head"), "rx ry rz"),
    **{side + bone: dof for side in "lr" for bone, dof in {
        "femur": "rx ry rz", "tibia": "rx", "foot": "rx rz", "toes": "rx", "clavicle": "ry rz", "humerus": "rx ry rz",
        "radius": "rx", "wrist": "ry", "hand": "rx rz", "fingers": "rx", "thumb": "rx rz",
    }.items()},
}  # fmt: skip
"""Degrees of freedom as in the archive's skeletons; hipjoints have none."""


class Body:
    """A random skeleton of CMU's bones and a motion of it, with an independent forward kinematics."""

    def __init__(self, frames=4, seed=0):
        rng = np.random.default_rng(seed)
        self.direction = rng.standard_normal((31, 3))
        self.direction /= np.linalg.norm(self.direction, axis=1, keepdims=True)
        self.length = rng.uniform(5, 7.5, 31)
        self.axis = rng.uniform(-180, 180, (31, 3))
        self.root = np.concatenate([rng.uniform(-20, 20, (frames, 3)), rng.uniform(-180, 180, (frames, 3))], axis=1)
        self.angles = {name: rng.uniform(-90, 90, (frames, len(dof.split()))) for name, dof in DOF.items()}

    def asf(self):
        bones = [
            f"  begin\n    id {k}\n    name {name}\n    direction {_row(self.direction[k])}\n"
            f"    length {self.length[k]}\n    axis {_row(self.axis[k])} XYZ\n"
            + (f"    dof {DOF[name]}\n    limits (-180.0 180.0)\n" if name in DOF else "")
            + "  end\n"
            for k, name in list(enumerate(CMU31))[:0:-1]  # children come first: order must not matter
        ]
        tree = [f"    {CMU31[p]} {name}\n" for p, name in zip(PARENTS, CMU31) if p >= 0]
        return (
            "# made by a test\n:version 1.10\n:name VICON\n:units\n  mass 1.0\n  length 0.45\n  angle deg\n"
            ":documentation\n  bones: begin to end\n:root\n  order TX TY TZ RX RY RZ\n  axis XYZ\n  position 0 0 0\n"
            "  orientation 0 0 0\n:bonedata\n" + "".join(bones) + ":hierarchy\n  begin\n" + "".join(tree) + "  end\n"
        )

    def amc(self):
        frames = [
            f"{k + 1}\nroot {_row(root)}\n" + "".join(f"{name} {_row(self.angles[name][k])}\n" for name in DOF)
            for k, root in enumerate(self.root)
        ]
        return "#!OML:ASF V\n:FULLY-SPECIFIED\n:DEGREES\n" + "".join(frames)

    def joints(self, frame):
        """Return the joints of a frame (31,3), metres, from one rotation after the other."""
        at = {"root": self.root[frame, :3]}
        turned = {"root": Rotation.from_euler("xyz", self.root[frame, 3:], degrees=True)}
        for k, name in list(enumerate(CMU31))[1:]:
            frame_of_bone = Rotation.from_euler("xyz", self.axis[k], degrees=True)
            own = Rotation.identity()
            for letter, angle in zip(DOF.get(name, "").split(), self.angles.get(name, [[]] * 99)[frame]):
                own = Rotation.from_euler(letter[1], angle, degrees=True) * own
            parent = CMU31[PARENTS[k]]
            turned[name] = turned[parent] * frame_of_bone * own * frame_of_bone.inv()
            at[name] = at[parent] + self.length[k] * turned[name].apply(self.direction[k])
        return METRES * np.stack([at[name] for name in CMU31])


def _row(numbers):
    return " ".join(f"{number:.10g}" for number in numbers)


def make_archive(tmp_path):
    """Write a skeleton and a motion below a folder; returns it, their folder, and the body."""
    body, folder = Body(), tmp_path / "subjects" / "07"
    folder.mkdir(parents=True)
    (folder / "07.asf").write_text(body.asf())
    (folder / "07_03.amc").write_text(body.amc())
    return tmp_path, folder, body


@pytest.fixture
def archive(tmp_path):
    return make_archive(tmp_path)


def test_joints_are_those_of_an_independent_forward_kinematics(archive):
    _, folder, body = archive
    joints = read_amc(folder / "07_03.amc", read_asf(folder / "07.asf"))
    assert joints.shape == (4, 31, 3) and joints.dtype == np.float32
    np.testing.assert_allclose(joints, [body.joints(frame) for frame in range(4)], atol=2e-5)


def test_a_knee_of_the_archive_bends_backwards(tmp_path):
    """As in 02.asf, thigh and shank point down and 20 degrees out, and the knee's axis is turned by as much."""
    body = Body(frames=1)
    for bone in ("lfemur", "ltibia"):
        k = CMU31.index(bone)
        body.direction[k], body.axis[k], body.length[k] = (0.34202, -0.939693, 0), (0, 0, 20), 7.5
    body.root[:], body.angles["lfemur"][:], body.angles["ltibia"][:] = 0, 0, 90
    (tmp_path / "02.asf").write_text(body.asf())
    (tmp_path / "02_01.amc").write_text(body.amc())
    joints = read_amc(tmp_path / "02_01.amc", read_asf(tmp_path / "02.asf"))[0]
    hip, knee, ankle = (joints[CMU31.index(name)] for name in ("lhipjoint", "lfemur", "ltibia"))
    np.testing.assert_allclose(knee - hip, 7.5 * METRES * np.array([0.34202, -0.939693, 0]), atol=1e-5)
    np.testing.assert_allclose(ankle - knee, [0, 0, -7.5 * METRES], atol=1e-5)  # z is ahead


def test_radians_other_orders_and_windows_line_ends(archive):
    _, folder, body = archive
    text = body.asf().replace("order TX TY TZ RX RY RZ", "order RX RY RZ TX TY TZ").replace("\n", "\r\n")
    (folder / "07.asf").write_text(text, newline="")
    motion = re.sub(r"^root (\S+ \S+ \S+) (\S+ \S+ \S+)$", r"root \2 \1", body.amc(), flags=re.MULTILINE)
    (folder / "07_03.amc").write_text(motion.replace("\n", "\r\n") + "\r\n\r\n", newline="")
    joints = read_amc(folder / "07_03.amc", read_asf(folder / "07.asf"))
    np.testing.assert_allclose(joints[2], body.joints(2), atol=2e-5)


ASF_FAULTS = {
    "lhand": ("lpaw", "no bone 'lhand', so this is no skeleton of the CMU archive"),
    "dof ry rz": ("dof ry tz", r":\d+: degree of freedom 'tz'"),
    "    rhumerus rradius\n": ("", "bone 'r.*' has no parent"),
    "    lfemur ltibia\n": ("    lfemur lshin\n", r":\d+: 'lshin' under 'lfemur': one of them is no bone"),
    "    lowerback upperback\n": ("    lowerback upperback\n    root upperback\n", "bone 'upperback' has two parents"),
    "angle deg": ("angle grad", "angle deg"),
    "length 0.45": ("", "length in ':units' must be 1 numbers"),
    "order TX TY TZ": ("order TX TY", "an order of tx ty tz rx ry rz"),
    " XYZ": (" XYX", r":\d+: axis must name its order, as XYZ"),
}


@pytest.mark.parametrize("old", ASF_FAULTS)
def test_a_wrong_skeleton_is_refused(archive, old):
    _, folder, body = archive
    new, message = ASF_FAULTS[old]
    (folder / "07.asf").write_text(body.asf().replace(old, new))
    with pytest.raises(MocapError, match=message) as refusal:
        read_asf(folder / "07.asf")
    assert "07.asf" in str(refusal.value)


def test_a_skeleton_cut_off_anywhere_is_refused(archive):
    _, folder, body = archive
    text = body.asf()
    for end in range(0, len(text) - 30, 97):
        (folder / "07.asf").write_text(text[:end])
        with pytest.raises(MocapError):
            read_asf(folder / "07.asf")


def test_a_motion_cut_off_anywhere_is_refused_or_whole_frames_short(archive):
    _, folder, body = archive
    skeleton, text = read_asf(folder / "07.asf"), body.amc()
    whole = read_amc(folder / "07_03.amc", skeleton)
    for end in range(0, len(text) - 1, 61):
        (folder / "07_03.amc").write_text(text[:end])
        try:
            joints = read_amc(folder / "07_03.amc", skeleton)
        except MocapError as error:
            assert "07_03.amc" in str(error)
        else:  # cut within the digits of the last number of a frame
            np.testing.assert_array_equal(joints[:-1], whole[: len(joints) - 1])


AMC_FAULTS = {
    "a bone of another skeleton": (1, "lfemur", "lthigh 1 2 3", r"07_03.amc:\d+: 'lthigh' does not move in 07.asf"),
    "a bone that is missing": (1, "lfemur", None, r"07_03.amc:4: frame 1 has bone 'lfemur' 0 times"),
    "a bone too many": (1, "lfemur", "head 1 2 3", "frame 1 has bone 'lfemur' 0 times"),
    "a value too few": (1, "lfemur", "lfemur 1 2", r":\d+: 'lfemur' must have 3 numbers"),
    "no number": (2, "lfemur", "lfemur 1 2 x", r":\d+: 'lfemur' must have 3 numbers"),
    "not a number": (3, "head", "head 1 nan 3", r":\d+: 'head' must have 3 numbers"),
    "a line lost": (3, "head", None, r":\d+: 'lfemur' where 'head' of frame 3 belongs"),
    "another order": (2, "head", "thorax 1 2 3", r":\d+: 'thorax' where 'head' of frame 2 belongs"),
    "an empty line": (1, "head", "", r":\d+: an empty line within a frame"),
    "a number that is too large": (2, "head", "head 1 1e300 3", r":\d+: 'head' must have 3 numbers"),
    "no number of a frame": (3, "3", "3x", r":\d+: '3x' where its number of frame 3 belongs"),
}


@pytest.mark.parametrize("fault", AMC_FAULTS)
def test_a_wrong_motion_is_refused_by_its_line(archive, fault):
    _, folder, body = archive
    frame, name, line, message = AMC_FAULTS[fault]
    lines = body.amc().splitlines()
    begin = lines.index(str(frame))
    place = next(k for k in range(begin, len(lines)) if lines[k].split()[0] == name)
    lines[place : place + 1] = [] if line is None else [line]
    (folder / "07_03.amc").write_text("\n".join(lines))
    with pytest.raises(MocapError, match=message) as refusal:
        read_amc(folder / "07_03.amc", read_asf(folder / "07.asf"))
    if number := re.search(r"amc:(\d+): '", str(refusal.value)):
        assert int(number[1]) == place + 1


@pytest.mark.parametrize("content", [b"", b"\x00\xff" * 500, b"RIFF", b"1\n", b"1\n1\n1\n", b"root 1 2 3\n"])
def test_files_of_other_formats_are_refused(archive, content):
    _, folder, _ = archive
    (folder / "07_03.amc").write_bytes(content)
    with pytest.raises(MocapError):
        read_amc(folder / "07_03.amc", read_asf(folder / "07.asf"))
    for suffix, read in ((".asf", read_asf), (".bvh", read_bvh)):
        (folder / f"x{suffix}").write_bytes(content)
        with pytest.raises(MocapError):
            read(folder / f"x{suffix}")


def test_another_unit_is_refused(archive):
    _, folder, body = archive
    (folder / "07.asf").write_text(body.asf().replace("length 0.45", "length 45"))
    with pytest.raises(MocapError, match="a thigh is .* m long"):
        read_amc(folder / "07_03.amc", read_asf(folder / "07.asf"))
