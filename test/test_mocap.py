# SPDX-License-Identifier: Apache-2.0
"""Raw motion capture: .asf with .amc, .bvh and npz are read exactly; what is damaged is refused by file and line."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.errors import MocapError
from training.people.asf_amc import read_amc, read_asf
from training.people.bvh import read_bvh
from training.people.clips import motion_files, read_clips
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
    """A made-up skeleton of CMU's bones and a motion of it, with a forward kinematics of its own."""

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
        """By one rotation after the other, bone by bone."""
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


@pytest.fixture
def archive(tmp_path):
    body, folder = Body(), tmp_path / "subjects" / "07"
    folder.mkdir(parents=True)
    (folder / "07.asf").write_text(body.asf())
    (folder / "07_03.amc").write_text(body.amc())
    return tmp_path, folder, body


def test_joints_are_those_of_a_forward_kinematics_of_its_own(archive):
    _, folder, body = archive
    joints = read_amc(folder / "07_03.amc", read_asf(folder / "07.asf"))
    assert joints.shape == (4, 31, 3) and joints.dtype == np.float32
    np.testing.assert_allclose(joints, [body.joints(frame) for frame in range(4)], atol=2e-5)


def test_a_knee_of_the_archive_bends_backwards(tmp_path):
    """Thigh and shank of subject 02 point down and 20 degrees out, about an axis turned by as much: as in 02.asf."""
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
def test_what_is_no_motion_is_refused(archive, content):
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


# --- .bvh


def bvh(frames=3, seed=0, complete=False):
    """(text, offsets and parents and names of the joints, values (F,96)) of a made-up body of cgspeed's joints."""
    rng = np.random.default_rng(seed)
    lines, joints = ["HIERARCHY"], []

    def add(name, children, parent):
        offset = rng.uniform(3, 5, 3)
        left_out = ("LowerBack", "Shoulder", "HipJoint", "Neck", "FingerBase", "Thumb")
        if name != "End" and name.endswith(left_out) and not (complete and name.endswith(("Neck", "FingerBase"))):
            offset = np.zeros(3)
        joints.append((name if name != "End" else joints[parent][0] + " end", parent, offset))
        own = len(joints) - 1
        kind = "End Site" if name == "End" else f"{'ROOT' if parent < 0 else 'JOINT'} {name}"
        position = "6 Xposition Yposition Zposition " if parent < 0 else "3 "
        lines.extend([kind, "{", f"\tOFFSET {_row(offset)}"])
        if name != "End":
            lines.append(f"\tCHANNELS {position}Zrotation Yrotation Xrotation")
        for child, below in children:
            add(child, below, own)
        lines.append("}")

    def chain(*names, then=()):
        tree = list(then)
        for name in reversed(names):
            tree = [(name, tree)]
        return tree

    def leg(letter, side):
        return chain(f"{letter}HipJoint", f"{side}UpLeg", f"{side}Leg", f"{side}Foot", f"{side}ToeBase", "End")

    def arm(letter, side):
        hand = chain(f"{side}FingerBase", f"{side}HandIndex1", "End") + chain(f"{letter}Thumb", "End")
        return chain(f"{side}Shoulder", f"{side}Arm", f"{side}ForeArm", f"{side}Hand", then=hand)

    above = chain("Neck", "Neck1", "Head", "End") + arm("L", "Left") + arm("R", "Right")
    add("Hips", leg("L", "Left") + leg("R", "Right") + chain("LowerBack", "Spine", "Spine1", then=above), -1)
    values = rng.uniform(-90, 90, (frames, 96))
    lines += ["MOTION", f"Frames: {frames}", "Frame Time: .0083333", *map(_row, values)]
    return "\n".join(lines) + "\n", joints, values


def test_bvh_joints_are_those_of_a_forward_kinematics_of_its_own(tmp_path):
    """With the two bones that the conversion leaves out there, so nothing is put back; its first frame is left out."""
    text, joints, values = bvh(complete=True)
    (tmp_path / "01_01.bvh").write_text(text)
    found = read_bvh(tmp_path / "01_01.bvh")
    assert found.shape == (2, 31, 3)
    for frame in (1, 2):
        at, turned, column = [], [], 0
        for name, parent, offset in joints:
            if parent < 0:
                at.append(offset + values[frame, :3])
                turned.append(Rotation.from_euler("ZYX", values[frame, 3:6], degrees=True))
                column = 6
                continue
            at.append(at[parent] + turned[parent].apply(offset))
            own = Rotation.identity()
            if not name.endswith(" end"):
                own = Rotation.from_euler("ZYX", values[frame, column : column + 3], degrees=True)
                column += 3
            turned.append(turned[parent] * own)
        by_name = {name: METRES * place for (name, _, _), place in zip(joints, at)}
        for cmu, theirs in (
            ("root", "Hips"),
            ("lhipjoint", "LeftUpLeg"),
            ("ltibia", "LeftFoot"),
            ("rtoes", "RightToeBase end"),
            ("upperback", "Spine1"),
            ("thorax", "Neck"),
            ("head", "Head end"),
            ("rclavicle", "RightArm"),
            ("rradius", "RightHand"),
            ("lwrist", "LeftFingerBase"),
            ("lfingers", "LeftHandIndex1 end"),
            ("rthumb", "RThumb end"),
        ):
            np.testing.assert_allclose(found[frame - 1, CMU31.index(cmu)], by_name[theirs], atol=2e-5)


def test_the_bones_that_the_conversion_leaves_out_are_put_back(tmp_path):
    (tmp_path / "01_01.bvh").write_text(bvh()[0])
    joints = read_bvh(tmp_path / "01_01.bvh")

    def bone(name):
        k = CMU31.index(name)
        return joints[:, k] - joints[:, PARENTS[k]]

    np.testing.assert_allclose(
        np.linalg.norm(bone("thorax"), axis=1), np.linalg.norm(bone("upperback"), axis=1), rtol=1e-4
    )
    np.testing.assert_allclose(
        np.linalg.norm(bone("lwrist"), axis=1), np.linalg.norm(bone("lradius"), axis=1) / 2, rtol=1e-4
    )
    assert np.linalg.norm(bone("lclavicle"), axis=1).min() > 0.2


BVH_FAULTS = {
    "HIERARCHY": ("HIERARCHIE", ":1: no HIERARCHY"),
    "JOINT LeftFoot": ("JOINT LeftFeet", "no joint 'LeftFoot'"),
    "JOINT RightShoulder": ("JOINT Shoulder", "no joint 'RightShoulder'"),
    "JOINT RightFoot": ("JOINT LeftFoot", r":\d+: joint 'LeftFoot' occurs twice"),
    "CHANNELS 3 Zrotation": ("CHANNELS 4 Zrotation", r":\d+: CHANNELS must be their number"),
    "Frames: 3": ("Frames: 4", "holds 3 of 4 frames"),
    "Frame Time:": ("Frametime:", "'Frame Time:' must follow"),
    "}\nMOTION": ("MOTION", r":\d+: 'MOTION' does not belong here"),
    "\tOFFSET 0 0 0\n": ("", r":\d+: joint '.*' has no OFFSET"),
    "MOTION\n": ("", "does not belong here"),
}


@pytest.mark.parametrize("old", BVH_FAULTS)
def test_a_wrong_bvh_is_refused(tmp_path, old):
    new, message = BVH_FAULTS[old]
    text = bvh()[0]
    assert old in text
    (tmp_path / "x.bvh").write_text(text.replace(old, new))
    with pytest.raises(MocapError, match=message) as refusal:
        read_bvh(tmp_path / "x.bvh")
    assert "x.bvh" in str(refusal.value)


def test_a_bad_frame_of_a_bvh_is_named_by_its_line(tmp_path):
    lines = bvh()[0].splitlines()
    for value in ("nan", "x", "1 2", ""):
        changed = [*lines[:-1], f"{value} " + lines[-1].split(maxsplit=1)[1]]
        (tmp_path / "x.bvh").write_text("\n".join(changed))
        with pytest.raises(MocapError, match=f"x.bvh:{len(lines)}: a frame must be 96 numbers"):
            read_bvh(tmp_path / "x.bvh")


def test_a_bvh_cut_off_anywhere_is_refused(tmp_path):
    text = bvh()[0]
    for end in range(0, len(text) - 20, 83):
        (tmp_path / "x.bvh").write_text(text[:end])
        with pytest.raises(MocapError):
            read_bvh(tmp_path / "x.bvh")


# --- folders


def test_a_folder_is_searched_for_all_formats(archive):
    root, folder, body = archive
    (root / "deep" / "down").mkdir(parents=True)
    (root / "deep" / "down" / "09_01.bvh").write_text(bvh()[0])
    (root / "deep" / "07_03.bvh").write_text(bvh()[0])
    np.savez(root / "more.npz", S_root=np.tile(body.joints(0), (3, 1, 1)), seq_names=["walking_1"], seq_len=[3])
    clips = dict(read_clips(root))
    assert sorted(clips) == ["07_03", "09_01", "walking_1"] and len(motion_files(root)) == 4
    np.testing.assert_allclose(clips["07_03"][1], body.joints(1), atol=2e-5)  # the .amc, not the .bvh
    assert len(clips["walking_1"]) == 3


def test_a_skeleton_is_found_beside_its_motions(archive):
    root, folder, _ = archive
    (folder / "07.asf").rename(folder / "any.asf")
    assert [name for name, _ in read_clips(root)] == ["07_03"]
    (folder / "any.asf").unlink()
    with pytest.raises(MocapError, match="no 07.asf beside it"):
        read_clips(root)


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({"W": np.zeros(3)}, "no array S_root"),
        ({"S_world": np.zeros((3, 17, 3)), "trial_names": ["a"], "trial_len": [3]}, r"must be numbers \(F,31,3\)"),
        ({"S_world": np.ones((3, 31, 3)), "trial_names": ["a"], "trial_len": [4]}, "trial_len must be the frames"),
        ({"S_world": np.ones((3, 31, 3)), "trial_names": ["a"], "trial_len": [3]}, "a thigh is 0 m long"),
        ({"S_world": np.full((3, 31, 3), np.nan), "trial_names": ["a"], "trial_len": [3]}, "NaN"),
    ],
)
def test_wrong_arrays_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(MocapError, match=message):
        read_clips(tmp_path)


def test_an_empty_folder_says_what_is_looked_for(tmp_path):
    (tmp_path / "x.npz").write_bytes(b"no npz")
    with pytest.raises(MocapError, match="x.npz: .*is no npz"):
        read_clips(tmp_path)
    (tmp_path / "x.npz").unlink()
    with pytest.raises(MocapError, match="holds no motion capture: neither .amc"):
        read_clips(tmp_path)
