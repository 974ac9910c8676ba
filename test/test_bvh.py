# SPDX-License-Identifier: Apache-2.0
"""Reader of .bvh: exact joints, restored bones, and errors that name file and line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.errors import MocapError
from training.people.bvh import METRES, read_bvh
from training.people.mocap import CMU31, PARENTS


def _row(numbers):
    return " ".join(f"{number:.10g}" for number in numbers)


def bvh(frames=3, seed=0, complete=False):
    """Return a random body of cgspeed's joints: the file's text, the joints (name, parent, offset), values (F,96)."""
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


def test_joints_are_those_of_an_independent_forward_kinematics(tmp_path):
    """The file has the two bones that the conversion lacks, so none is restored; the first frame is skipped."""
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


def test_bones_that_the_conversion_lacks_are_restored(tmp_path):
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
