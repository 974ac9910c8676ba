# SPDX-License-Identifier: Apache-2.0
"""Layouts: the shipped ones are correct, mapping goes by name, and malformed ones are refused with advice."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from paul_ros.errors import LayoutError
from paul_ros.layout import Handedness, Layout, anonymous_layout, layout_names, load_layout, midpoints
from paul_ros.model_file import load_model

POINTS = {
    "ap10k17": 17,
    "body25": 25,
    "cmu31": 31,
    "coco17": 17,
    "drobotics19": 19,
    "h36m17": 17,
    "halpe26": 26,
    "hand21": 21,
    "hri18": 18,
    "human": 43,
    "kinect32": 32,
    "mediapipe33": 33,
    "mpii16": 16,
    "openpose18": 18,
    "wholebody133": 133,
    "wholebody23": 23,
    "zed18": 18,
    "zed34": 34,
    "zed38": 38,
}
#: Layouts of other things than persons.
OTHERS = ("ap10k17", "hand21")
PEOPLE = [name for name in POINTS if name not in OTHERS]
DOOR = {
    "name": "door",
    "names": ["hinge_top", "hinge_bottom", "handle", "latch"],
    "edges": [["hinge_top", "hinge_bottom"], ["handle", "latch"]],
    "left_right": [["handle", "latch"]],
    "root": "middle",
    "derived": {"middle": ["hinge_top", "hinge_bottom"]},
    "handedness": [
        {
            "left": ["handle"],
            "right": ["latch"],
            "below": ["hinge_bottom"],
            "above": ["hinge_top"],
            "behind": ["latch"],
            "front": ["handle", "hinge_top"],
        }
    ],
}
#: Rough positions of points of a standing person in REP-103's body frame (x forward, y left, z up), metres.
STANDING = {
    "nose": (0.12, 0, 1.62),
    "eye": (0.1, 0.03, 1.66),
    "ear": (0, 0.08, 1.64),
    "shoulder": (0, 0.2, 1.42),
    "hip": (0, 0.1, 0.9),
    "knee": (0.05, 0.1, 0.48),
    "ankle": (0, 0.1, 0.08),
    "toe_tip": (0.2, 0.1, 0.02),
}


def door(**changes: object) -> dict:
    return {**copy.deepcopy(DOOR), **changes}


def standing(name: str) -> tuple[float, float, float]:
    side, _, part = name.partition("_")
    x, y, z = STANDING[part if side in ("left", "right") else name]
    return x, -y if side == "right" else y, z


def arrays(layout: Layout, persons: int = 2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    points = len(layout.names)
    rng = np.random.default_rng(3)
    return (
        rng.uniform(0, 640, (persons, points, 2)),
        rng.uniform(0.5, 1, (persons, points)),
        np.ones((persons, points), dtype=bool),
    )


def test_the_shipped_layouts_have_their_points() -> None:
    assert {name: len(load_layout(name).names) for name in layout_names()} == POINTS


@pytest.mark.parametrize("name", POINTS)
def test_a_shipped_layout_is_one_body(name: str) -> None:
    layout = load_layout(name)
    assert layout.name == name and layout.description
    reached = {layout.root[0]}
    for _ in layout.names:
        reached |= {point for edge in layout.edges if set(edge) & reached for point in edge}
    nameless = {"body_kps_17", "body_kps_18"} if name == "drobotics19" else set()
    assert {layout.names[point] for point in set(range(len(layout.names))) - reached} == nameless


@pytest.mark.parametrize("name", POINTS)
def test_sides_are_complete_and_symmetric(name: str) -> None:
    layout = load_layout(name)
    swapped = {"left": "right", "right": "left"}
    prefixes = [point.split("_")[0] for point in layout.names]
    assert layout.sides == tuple(prefix if prefix in swapped else "" for prefix in prefixes)
    for point, twin in zip(layout.names, layout.mirror):
        side, _, rest = point.partition("_")
        assert layout.names[twin] == (f"{swapped[side]}_{rest}" if side in swapped else point)
    mirrored = {frozenset((layout.mirror[a], layout.mirror[b])) for a, b in layout.edges}
    assert mirrored == {frozenset(edge) for edge in layout.edges}
    assert set(layout.mirror[list(layout.root)]) == set(layout.root)


@pytest.mark.parametrize("name", PEOPLE)
def test_handedness_tells_a_person_from_the_mirror_image(name: str) -> None:
    layout = load_layout(name)

    def volume(rule: Handedness, sign: int) -> float:
        def mean(points: tuple[int, ...]) -> np.ndarray:
            return np.mean([standing(layout.names[point]) for point in points], axis=0) * (1, sign, 1)

        across = np.cross(mean(rule.left) - mean(rule.right), mean(rule.above) - mean(rule.below))
        return across @ (mean(rule.front) - mean(rule.behind))

    assert layout.handedness
    assert all(volume(rule, 1) > 0 > volume(rule, -1) for rule in layout.handedness)


@pytest.mark.parametrize("name", POINTS)
def test_a_layout_survives_json_and_yaml(name: str) -> None:
    layout = load_layout(name)
    assert Layout.from_dict(json.loads(json.dumps(layout.to_dict()))) == layout
    assert Layout.from_dict(yaml.safe_load(yaml.safe_dump(layout.to_dict()))) == layout


def test_point_orders_that_are_easily_confused() -> None:
    """OpenPose starts each pair of the face on the right, ROS4HRI on the left (hri_msgs/Skeleton2D.msg)."""
    face = "left_eye", "right_eye", "left_ear", "right_ear"
    assert load_layout("hri18").names[14:] == face
    assert load_layout("openpose18").names[14:] == ("right_eye", "left_eye", "right_ear", "left_ear")
    assert load_layout("coco17").names[1:5] == face
    assert load_layout("openpose18").names[:14] == load_layout("hri18").names[:14]
    assert load_layout("body25").names[8::11] == ("pelvis", "left_big_toe")
    assert load_layout("h36m17").names[1::10] == ("right_hip", "left_shoulder")
    assert load_layout("mediapipe33").names[11] == "left_shoulder"


def test_orders_of_further_layouts() -> None:
    """Facts from the publishers: mmpose's dataset configurations, the ZED and the Azure Kinect SDK, hobot."""
    coco = load_layout("coco17").names
    for name in ("halpe26", "wholebody23", "wholebody133", "drobotics19"):
        assert load_layout(name).names[:17] == coco
    assert load_layout("halpe26").names[17:23] == (
        "head_top", "upper_neck", "pelvis", "left_big_toe", "right_big_toe", "left_small_toe",
    )  # fmt: skip
    whole = load_layout("wholebody133").names
    assert whole[:23] == load_layout("wholebody23").names and whole[17:20] == (
        "left_big_toe",
        "left_small_toe",
        "left_heel",
    )
    # The face begins at the right ear, the hands follow the face, left first.
    assert (whole[23], whole[31], whole[39]) == ("right_jaw_1", "chin", "left_jaw_1")
    assert (whole[59], whole[68]) == ("right_eye_outer", "left_eye_outer")
    assert (whole[71], whole[77]) == ("right_mouth_corner", "left_mouth_corner")
    assert (whole[91], whole[96], whole[111], whole[112], whole[132]) == (
        "left_hand_root", "left_index_knuckle", "left_pinky_4", "right_hand_root", "right_pinky_4",
    )  # fmt: skip
    assert load_layout("mpii16").names[::3] == (
        "right_ankle", "left_hip", "pelvis", "head_top", "right_shoulder", "left_wrist",
    )  # fmt: skip
    assert load_layout("zed18").names == load_layout("openpose18").names
    assert load_layout("zed34").names[:32] == load_layout("kinect32").names
    assert load_layout("kinect32").names[5::13] == ("left_shoulder", "left_hip", "right_ear")
    assert load_layout("zed38").names[5::7] == (
        "nose", "left_shoulder", "right_hip", "left_small_toe", "right_index_knuckle",
    )  # fmt: skip
    assert load_layout("hand21").names[::4] == ("wrist", "thumb_4", "index_4", "middle_4", "ring_4", "pinky_4")
    assert load_layout("ap10k17").names[2:5] == ("animal_nose", "animal_neck", "tail_root")


@pytest.mark.parametrize("name", PEOPLE)
def test_a_projected_person_arrives_in_its_own_places(name: str) -> None:
    """A picture of the human model, given in any layout of persons, shows the model the same pixels again."""
    human, layout = load_layout("human"), load_layout(name)
    points = load_model("human").mean_shape
    pixels = (300 * points[:2] / points[2].max() + 500).T[None]
    place = {name: index for index, name in enumerate(human.names)}
    given = np.array([[pixels[0, place[p]] if p in place else (np.nan, np.nan) for p in layout.names]])
    seen = np.isfinite(given).all(2)
    xy, _, visible = layout.map_to(human)(given, seen.astype(float), seen)
    own = [place[p] for p in layout.names if p in place]
    assert len(own) >= 12 and visible[0, own].all()
    np.testing.assert_allclose(xy[0, own], pixels[0, own])
    # Derived points are midpoints, which the model's own differ from by little.
    np.testing.assert_allclose(xy[visible], pixels[visible], atol=0.05 * np.ptp(pixels))


@pytest.mark.parametrize("name", OTHERS)
def test_other_things_do_not_pass_for_persons(name: str) -> None:
    with pytest.raises(LayoutError, match="has 0 of the 43 points of 'human'.*coco17"):
        load_layout(name).map_to(load_layout("human"))


BODIES = ("body25", "coco17", "h36m17", "hri18", "mediapipe33", "openpose18")


@pytest.mark.parametrize("name", BODIES)
def test_every_body_layout_maps_onto_human_whole_and_back(name: str) -> None:
    human, layout = load_layout("human"), load_layout(name)
    assert set(layout.names) <= set(human.names)
    assert all(human.map_to(layout).sources)
    xy, confidence, visible = arrays(layout)
    back = human.map_to(layout)(*layout.map_to(human)(xy, confidence, visible))
    for out, given_array in zip(back, (xy, confidence, visible)):
        np.testing.assert_array_equal(out, given_array)


def test_human_holds_nothing_that_no_body_layout_has() -> None:
    assert set(load_layout("human").names) == {point for name in BODIES for point in load_layout(name).names}
    assert load_layout("human").min_visible == 6


def test_mapping_onto_itself_changes_nothing() -> None:
    layout = load_layout("body25")
    xy, confidence, visible = arrays(layout)
    visible[0, 3] = False
    for out, given_array in zip(layout.map_to(layout)(xy, confidence, visible), (xy, confidence, visible)):
        np.testing.assert_array_equal(out, given_array)


@pytest.mark.parametrize(
    "source, target",
    [
        ("coco17", "body25"),  # derived points
        ("body25", "coco17"),  # points left out
        ("hri18", "openpose18"),  # another order
        ("h36m17", "mediapipe33"),  # few points in common
        ("cmu31", "human"),  # most points lacking
        ("human", "h36m17"),
    ],
)
def test_mapping_goes_by_name(source: str, target: str) -> None:
    """Each point lands under its own name, or is hidden; nothing lands elsewhere."""
    source_layout, target_layout = load_layout(source), load_layout(target)
    xy, confidence, visible = arrays(source_layout)
    mapped = source_layout.map_to(target_layout)(xy, confidence, visible)
    for place, name in enumerate(target_layout.names):
        if name in source_layout.names:
            origin = source_layout.names.index(name)
            for out, array in zip(mapped, (xy, confidence, visible)):
                np.testing.assert_array_equal(out[:, place], array[:, origin])
        elif name in source_layout.derived:
            parts = list(source_layout.derived[name])
            np.testing.assert_allclose(mapped[0][:, place], xy[:, parts].mean(1))
            assert mapped[2][:, place].all()
        else:
            assert np.isnan(mapped[0][:, place]).all()
            assert not mapped[1][:, place].any() and not mapped[2][:, place].any()


def test_a_derived_point_needs_all_its_parts() -> None:
    coco, body = load_layout("coco17"), load_layout("body25")
    xy, confidence, visible = arrays(coco)
    visible[0, coco.names.index("left_hip")] = False
    xy[0, coco.names.index("left_hip")] = np.nan
    _, _, mapped_visible = coco.map_to(body)(xy, confidence, visible)
    pelvis, neck = body.names.index("pelvis"), body.names.index("neck")
    assert mapped_visible[:, pelvis].tolist() == [False, True]
    assert mapped_visible[:, neck].all()


def test_mapping_keeps_zero_persons_and_refuses_other_shapes() -> None:
    coco, h36m = load_layout("coco17"), load_layout("h36m17")
    mapping = coco.map_to(h36m)
    assert mapping(*arrays(coco, persons=0))[0].shape == (0, 17, 2)
    with pytest.raises(ValueError, match=r"'coco17' needs xy \(N,17,2\)"):
        mapping(*arrays(load_layout("body25")))


def test_mapping_refuses_layouts_that_share_too_little_and_says_which_fit() -> None:
    with pytest.raises(LayoutError, match="'door' has 0 of the 17 points of 'coco17'.*body25, cmu31, coco17"):
        Layout.from_dict(DOOR).map_to(load_layout("coco17"))
    with pytest.raises(LayoutError, match="none of the shipped ones"):
        load_layout("coco17").map_to(Layout.from_dict(DOOR))


def test_mirrored_edges_are_those_of_the_other_side() -> None:
    layout = load_layout("coco17")
    left, middle = layout.edges.index((5, 7)), layout.edges.index((5, 6))
    assert layout.edges[layout.mirrored_edges[left]] == (6, 8)
    assert layout.mirrored_edges[middle] == middle
    np.testing.assert_array_equal(layout.mirrored_edges[layout.mirrored_edges], np.arange(len(layout.edges)))


def test_a_users_layout_is_loaded_from_its_path(tmp_path) -> None:
    path = tmp_path / "door.yaml"
    path.write_text(yaml.safe_dump(DOOR))
    layout = load_layout(path)
    assert layout == load_layout(str(path)) == Layout.from_dict(DOOR)
    assert layout.edges == ((0, 1), (2, 3)) and layout.root == (0, 1) and layout.derived == {"middle": (0, 1)}
    assert layout.handedness[0].front == (2, 0)


def test_all_but_name_names_and_root_may_be_left_out() -> None:
    layout = Layout.from_dict({key: DOOR[key] for key in ("name", "names")} | {"root": "handle"})
    assert layout.root == (2,)
    assert not any((layout.edges, layout.left_right, layout.derived, layout.handedness, layout.description))
    assert Layout.from_dict(layout.to_dict()) == layout


@pytest.mark.parametrize(
    "name, advice",
    [
        ("coco", "did you mean 'coco17'"),
        ("Body_25", "did you mean 'body25'"),
        ("excavator", "There are ap10k17, body25"),
        ("nowhere/door.yaml", "nowhere/door.yaml: no such file"),
    ],
)
def test_an_unknown_name_is_answered_with_the_known_ones(name: str, advice: str) -> None:
    with pytest.raises(LayoutError, match=advice):
        load_layout(name)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"names": ["a", "b", "c", "a"]}, "'a' more than once"),
        ({"names": ["a", "b"]}, "has 2 points"),
        ({"names": ["hinge_top", False, "handle", "latch"]}, "YAML reads it as False: put it in quotes"),
        ({"names": ["a", "", "c"]}, "must be text, not empty"),
        ({"name": 12}, "YAML reads it as 12: put it in quotes"),
        ({"name": 16**5000}, "YAML reads it as a number of 20001 bits"),
        ({"names": "hinge_top"}, "names must be a list, not str"),
        ({"name": None}, "name must be text, not NoneType"),
        ({"edges": [["hinge_top", "handel"]]}, "edges names 'handel', not in names"),
        ({"edges": [["hinge_top"]]}, "edges must be pairs"),
        ({"edges": [["latch", "latch"]]}, "two different points"),
        ({"edges": {"hinge_top": "latch"}}, "edges must be a list, not dict"),
        ({"left_right": [["handle", "latch"], ["handle", "hinge_top"]]}, "a point in two pairs"),
        ({"root": "centre"}, "root names 'centre'"),
        ({"root": []}, "root names no point"),
        ({"derived": {"handle": ["latch"]}}, "derived 'handle' is among the names already"),
        ({"derived": {"middle": ["top"]}}, "derived 'middle' names 'top'"),
        ({"derived": ["middle"]}, "derived must be a mapping, not list"),
        ({"handedness": [{"left": ["handle"]}]}, "all of them"),
        ({"handedness": [7]}, "must be a mapping, not int"),
        ({"edge": []}, "unknown key 'edge'"),
        ({"min_visible": 2}, "min_visible must be a whole number from 3 to the 4 points"),
        ({"min_visible": True}, "min_visible must be a whole number"),
        ({"names": [f"p{i}" for i in range(20_001)]}, "20001 points"),
    ],
)
def test_a_wrong_layout_is_refused_with_the_key_at_fault(changes: dict, message: str) -> None:
    with pytest.raises(LayoutError, match=message):
        Layout.from_dict(door(**changes))


@pytest.mark.parametrize("key", ["name", "names", "root"])
def test_a_missing_key_is_named(key: str) -> None:
    data = door()
    del data[key]
    with pytest.raises(LayoutError, match=f"'{key}' missing"):
        Layout.from_dict(data)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"", "must be a mapping, not NoneType"),
        (b"- a\n- b\n", "must be a mapping, not list"),
        (b"name: [unclosed", "not YAML"),
        (b"name: \x80\x81", "not YAML"),
        (b"a: !!python/object/apply:os.getcwd []", "not YAML"),
        (b"[" * 5000, "not YAML"),
        (b"name: 2020-99-99", "not YAML"),
        (b"#" * 1_000_001, "1000001 bytes"),
        (b"name: 0x" + b"f" * 5000 + b"\nnames: [a, b, c]\nroot: a", "name must be text.*20000 bits"),
        (b"? 0x" + b"f" * 5000 + b"\n: 1", "unknown key 'a number of 20000 bits'"),
        (b"name: " + b"9" * 5000, "not YAML"),
    ],
    ids=["empty", "list", "unclosed", "bytes", "python", "nested", "date", "huge", "number", "key", "decimal"],
)
def test_a_file_that_is_no_layout_is_refused(tmp_path, content: bytes, message: str) -> None:
    path = tmp_path / "broken.yaml"
    path.write_bytes(content)
    with pytest.raises(LayoutError, match=message) as refusal:
        load_layout(path)
    assert str(path) in str(refusal.value)


def test_a_file_of_nested_aliases_is_refused_without_being_unfolded(tmp_path) -> None:
    """Twenty levels of ten would be 10^20 items."""
    lines = ["a0: &a0 [x]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 21)]
    path = tmp_path / "bomb.yaml"
    path.write_text("\n".join([*lines, "name: *a20", "names: [*a20, *a20, *a20]", "root: x"]))
    with pytest.raises(LayoutError, match="unknown key"):
        load_layout(path)
    with pytest.raises(LayoutError, match="must be text, not list"):
        bomb = yaml.safe_load(path.read_text())
        Layout.from_dict({key: bomb[key] for key in ("name", "names", "root")})


json_like = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=10,
)


@settings(max_examples=300, deadline=None)
@given(key=st.sampled_from(sorted(DOOR)), value=json_like)
def test_whatever_stands_under_a_key_a_layout_or_a_layout_error_comes_out(key: str, value: object) -> None:
    try:
        layout = Layout.from_dict(door(**{key: value}))
    except LayoutError:
        return
    assert Layout.from_dict(layout.to_dict()) == layout


# --- anonymous layouts and categories


def test_anonymous_layouts_round_trip_and_sort_by_name():
    layout = anonymous_layout(120, ((0, 1), (118, 119)))
    assert layout.names[:2] == ("p000", "p001") and sorted(layout.names) == list(layout.names)
    assert layout.edges == ((0, 1), (118, 119)) and layout.root == tuple(range(120))
    assert Layout.from_dict(layout.to_dict()) == layout


@pytest.mark.parametrize("points, edges", [(2, ()), (5, ((0, 5),)), (5, ((-1, 2),)), (5, ((2, 2),)), (20_001, ())])
def test_anonymous_layouts_of_no_points_or_wrong_edges_are_refused(points, edges):
    with pytest.raises(LayoutError):
        anonymous_layout(points, edges)


def test_categories_round_trip_and_hold_every_point_once():
    data = {"name": "two", "names": list("abcdef"), "root": "a", "categories": {"x": list("abc"), "y": list("def")}}
    layout = Layout.from_dict(data)
    assert layout.categories == {"x": (0, 1, 2), "y": (3, 4, 5)}
    assert Layout.from_dict(layout.to_dict()) == layout
    for wrong in ({"x": list("abc")}, {"x": list("abcd"), "y": list("def")}, {"x": ["z"]}, ["x"], {"x": []}):
        with pytest.raises(LayoutError):
            Layout.from_dict({**data, "categories": wrong})


def test_midpoints_of_other_points():
    human = load_layout("human")
    place = {name: index for index, name in enumerate(human.names)}
    assert midpoints(human) == {
        place[middle]: (place[f"left_{part}"], place[f"right_{part}"])
        for middle, part in (("pelvis", "hip"), ("neck", "shoulder"))
    }
    assert midpoints(load_layout("coco17")) == {}
    animal = Layout.from_dict({"name": "dog", "names": ["left_shoulder", "neck", "right_shoulder"], "root": "neck"})
    assert midpoints(animal) == midpoints(replace(animal, name="human")) == {}
