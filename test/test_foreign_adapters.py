# SPDX-License-Identifier: Apache-2.0
"""The adapters of foreign packages: points by name, missing values, ids, and messages to refuse."""

from __future__ import annotations

import foreign_messages as foreign
import numpy as np
import pytest
from conftest import ROOT, header_of

from msg_adapters import SUPPORTED, MessageError, Source, WrongPointCount, hri, named_layout, openpose, read, zed
from paul_ros.layout import layout_names, load_layout

COCO = load_layout("coco17").names
ALL_NAMES = tuple(dict.fromkeys(name for layout in layout_names() for name in load_layout(layout).names))
#: A different pixel for every point of any layout; x and y differ too.
POSE = {name: (10.0 + 3 * index, 400.0 - 2 * index) for index, name in enumerate(ALL_NAMES)}


@pytest.fixture(params=["live", "bag"])
def every_make(request, bag_make):
    return foreign.LiveMake() if request.param == "live" else bag_make


@pytest.fixture
def make(bag_make):
    """One family: the details are the same for both, and `every_make` gives both."""
    return bag_make


def source(names=COCO, **changes) -> Source:
    known = {"image_size": foreign.SIZE, "optical_frame": "camera_color_optical_frame"}
    return Source(**{"names": tuple(names), **known, **changes})


def read_of(make, type_name: str, msg, names=COCO, **changes):
    return read(type_name, make.through_cdr(msg), len(names), source(names, **changes))


def reason_of(make, type_name: str, msg, names=COCO, **changes) -> str:
    with pytest.raises(MessageError) as error:
        read_of(make, type_name, msg, names, **changes)
    assert len(str(error.value)) > 20
    return error.value.reason


def expected(names, own) -> np.ndarray:
    """Return (P, 2): the pixel of each point that the family has, NaN for the others."""
    return np.array([POSE[name] if name in own else (np.nan, np.nan) for name in names])


def assert_pose(got, names, own, persons: int = 1) -> None:
    assert got.xy.shape == (persons, len(names), 2)
    for person in got.xy:
        np.testing.assert_allclose(person, expected(names, own), rtol=1e-5)
    np.testing.assert_array_equal(got.visible, [[name in own for name in names]] * persons)
    assert (got.stamp, got.frame_id) == (7_000_000_005, "camera_color_optical_frame")


#: One with fewer points than most families, one with more, in another order.
LAYOUTS = ("coco17", "body25")


# --- ROS4HRI


@pytest.mark.parametrize("layout", ["coco17", "openpose18", "hri18", "body25", "h36m17"])
def test_hri_points_are_placed_by_name(every_make, layout):
    """The left eye comes first here, the right eye in OpenPose: placed by position they would be swapped."""
    names = load_layout(layout).names
    got = read_of(every_make, foreign.HRI, foreign.hri(every_make, header_of(every_make), POSE), names)
    assert_pose(got, names, foreign.HRI18)
    np.testing.assert_allclose(got.confidence[got.visible], 0.9, rtol=1e-6)


def test_hri_shares_become_pixels_by_width_and_height(make):
    msg = foreign.hri(make, header_of(make), POSE)
    small, wide = (read_of(make, foreign.HRI, msg, image_size=size).xy for size in ((640, 480), (1280, 480)))
    np.testing.assert_allclose(wide, small * (2, 1))


@pytest.mark.parametrize("size", [None, (0, 480), (640, 0)])
def test_hri_without_an_image_size_is_refused(make, size):
    msg = foreign.hri(make, header_of(make), POSE)
    assert reason_of(make, foreign.HRI, msg, image_size=size) == "no_image_size"


def test_hri_points_that_were_never_filled_are_missing(make):
    seen = {name: POSE[name] for name in ("nose", "left_hip")}
    got = read_of(make, foreign.HRI, foreign.hri(make, header_of(make), seen))
    assert_pose(got, COCO, seen)
    assert got.confidence.sum() == pytest.approx(1.8)


@pytest.mark.parametrize(
    "point, visible",
    [((0.5, 0.5, np.nan), False), ((np.nan, 0.5, 0.9), False), ((-1.0, -1.0, 0.0), False), ((500.0, 9.0, 0.0), False),
     ((-0.2, 1.4, 0.6), True), ((0.0, 0.0, 0.6), True)],
)  # fmt: skip
def test_hri_odd_points(make, point, visible):
    msg = foreign.hri(make, header_of(make), POSE)
    msg.skeleton[0] = foreign.hri_point(make, *point)
    got = read_of(make, foreign.HRI, msg)
    assert got.visible[0, COCO.index("nose")] == visible and got.visible.sum() == 16 + visible
    if visible:
        np.testing.assert_allclose(got.xy[0, COCO.index("nose")], np.multiply(point[:2], foreign.SIZE), rtol=1e-6)


@pytest.mark.parametrize("x, y", [(320.0, 0.5), (0.5, 240.0), (-1.5, 0.5), (np.inf, 0.5)])
def test_hri_pixels_where_shares_should_be_are_refused(make, x, y):
    """If at least half of the points are normalised, the others are wild guesses of a detector and missing."""
    msg = foreign.hri(make, header_of(make), POSE)
    msg.skeleton[:9] = [foreign.hri_point(make, x, y, 0.9)] * 9
    assert_pose(read_of(make, foreign.HRI, msg), COCO, foreign.HRI18[9:])
    msg.skeleton[9] = foreign.hri_point(make, x, y, 0.9)
    assert reason_of(make, foreign.HRI, msg) == "not_normalised"


def test_hri_of_an_older_package_with_fewer_points():
    make = foreign.LiveMake()
    msg = foreign.hri(make, header_of(make), POSE)
    del msg.skeleton[17]
    assert reason_of(make, foreign.HRI, msg) == "wrong_skeleton_size"


@pytest.mark.parametrize(
    "topic, ident",
    [("/humans/bodies/a1b2c/skeleton2d", "a1b2c"), ("/robot/humans/bodies/7/skeleton2d", "7"), ("/keypoints", "")],
)
def test_hri_id_is_in_the_topic(make, topic, ident):
    got = read_of(make, foreign.HRI, foreign.hri(make, header_of(make), POSE), topic=topic)
    assert got.ids == (ident,)


# --- ZED


@pytest.mark.parametrize("body_format, own", foreign.ZED_ORDERS.items())
@pytest.mark.parametrize("layout", LAYOUTS)
def test_zed_takes_the_slots_of_its_format_by_name(every_make, body_format, own, layout):
    names = load_layout(layout).names
    msg = foreign.zed(every_make, header_of(every_make, frame="zed_left_camera_frame"), [POSE, POSE], body_format)
    for body in msg.objects:  # zero in a real message, and ignored
        for slot in body.skeleton_2d.keypoints[len(own) :]:
            slot.kp[:] = 99.0
    got = read_of(every_make, foreign.ZED, msg, names)
    assert_pose(got, names, own, persons=2)
    np.testing.assert_array_equal(got.confidence, got.visible)
    assert got.ids == ("0", "1")


@pytest.mark.parametrize("xy", [(0, 0), (-1, -1), (-5, 30), (30, -5), (np.nan, 30), (30, np.nan), (np.inf, 3)])
def test_zed_missing_points(make, xy):
    msg = foreign.zed(make, header_of(make), [POSE])
    msg.objects[0].skeleton_2d.keypoints[foreign.ZED38.index("left_knee")].kp[:] = xy
    assert_pose(read_of(make, foreign.ZED, msg), COCO, set(COCO) - {"left_knee"})


def test_zed_points_on_the_border_are_seen(make):
    msg = foreign.zed(make, header_of(make), [POSE])
    msg.objects[0].skeleton_2d.keypoints[foreign.ZED38.index("left_knee")].kp[:] = 0, 30
    assert read_of(make, foreign.ZED, msg).visible.all()


def test_zed_objects_without_a_skeleton_are_no_persons(make):
    msg = foreign.zed(make, header_of(make), [POSE])
    msg.objects.insert(0, foreign.zed_body(make, {}, 0, 5, skeleton=False))
    got = read_of(make, foreign.ZED, msg)
    assert_pose(got, COCO, COCO)
    assert got.ids == ("0",)
    msg = foreign.zed(make, header_of(make), [])
    assert read_of(make, foreign.ZED, msg).xy.shape == (0, 17, 2)


def test_zed_bodies_of_several_formats_in_one_message(make):
    bodies = [foreign.zed_body(make, POSE, body_format, body_format) for body_format in (2, 0, 1)]
    msg = make(foreign.ZED, header=header_of(make), objects=bodies)
    assert_pose(read_of(make, foreign.ZED, msg), COCO, COCO, persons=3)


def test_zed_without_tracking_has_no_ids(make):
    msg = foreign.zed(make, header_of(make), [POSE, POSE], ids=[-1, -1])
    assert read_of(make, foreign.ZED, msg).ids == ("", "")


@pytest.mark.parametrize("body_format", [-1, 3, 70])
def test_zed_with_a_format_nobody_knows(make, body_format):
    msg = foreign.zed(make, header_of(make), [POSE], body_format)
    assert reason_of(make, foreign.ZED, msg) == "unknown_body_format"


# --- D-Robotics


def body(names=COCO, confidence=0.7) -> tuple:
    return [POSE[name] for name in names], [confidence] * len(names)


def test_ai_reads_body_keypoints_and_leaves_faces_and_hands(every_make):
    other = ([(1, 2)] * 5, [0.9] * 5)
    msg = foreign.ai(
        every_make,
        header_of(every_make),
        [
            foreign.ai_target(every_make, 11, face_kps=other),
            foreign.ai_target(every_make, 12, hand_kps=other, body_kps=body()),
            foreign.ai_target(every_make, 13),
            foreign.ai_target(every_make, 2**63, body_kps=body()),
        ],
    )
    got = read_of(every_make, foreign.AI, msg)
    assert_pose(got, COCO, COCO, persons=2)
    np.testing.assert_allclose(got.confidence, 0.7, rtol=1e-6)
    assert got.ids == ("12", str(2**63))


def test_ai_layout_is_the_detectors(make):
    """The message does not name its points: they have the layout's order."""
    names = load_layout("body25").names
    msg = foreign.ai(make, header_of(make), [foreign.ai_target(make, 1, body_kps=body(names))])
    assert_pose(read_of(make, foreign.AI, msg, names), names, names)
    with pytest.raises(WrongPointCount) as error:
        read_of(make, foreign.AI, msg)
    assert error.value.fits(25) and not error.value.fits(17)


def test_ai_missing_points_and_confidences(every_make):
    rows, confidence = body()
    rows[3] = (0.0, 0.0)
    msg = foreign.ai(every_make, header_of(every_make), [foreign.ai_target(every_make, 1, body_kps=(rows, []))])
    got = read_of(every_make, foreign.AI, msg)
    assert_pose(got, COCO, set(COCO) - {COCO[3]})
    np.testing.assert_array_equal(got.confidence, got.visible)
    msg = foreign.ai(
        every_make, header_of(every_make), [foreign.ai_target(every_make, 1, body_kps=(rows, confidence[:-1]))]
    )
    assert reason_of(every_make, foreign.AI, msg) == "wrong_confidence_count"


def test_ai_of_nobody(make):
    assert read_of(make, foreign.AI, foreign.ai(make, header_of(make), [])).xy.shape == (0, 17, 2)


# --- OpenDR


@pytest.mark.parametrize("layout", LAYOUTS)
def test_opendr_points_are_placed_by_name(every_make, layout):
    names = load_layout(layout).names
    msg = foreign.opendr(every_make, header_of(every_make), POSE)
    msg.keypoint_list.reverse()
    got = read_of(every_make, foreign.OPENDR, msg, names)
    assert_pose(got, names, foreign.OPENPOSE18)
    np.testing.assert_array_equal(got.confidence, got.visible)
    assert got.ids == ("1",)


@pytest.mark.parametrize("xy", [(-1, -1), (-1, 50), (50, -1)])
def test_opendr_negative_and_absent_points_are_missing(make, xy):
    pose = {name: POSE[name] for name in ("nose", "right_knee", "left_eye")} | {"left_hip": xy}
    got = read_of(make, foreign.OPENDR, foreign.opendr(make, header_of(make), pose))
    assert_pose(got, COCO, {"nose", "right_knee", "left_eye"})


def test_opendr_points_on_the_border_are_seen(make):
    got = read_of(make, foreign.OPENDR, foreign.opendr(make, header_of(make), POSE | {"nose": (0, 0)}))
    assert got.visible.all() and (got.xy[0, 0] == 0).all()


def test_opendr_names_of_other_things_than_persons(make):
    rows = [("paw", 5, 6), ("tail", 7, 8), ("whiskers", 1, 1)]
    got = read_of(make, foreign.OPENDR, foreign.opendr_of(make, header_of(make), rows), ("tail", "paw"))
    np.testing.assert_array_equal(got.xy[0], [[7, 8], [5, 6]])


def test_opendr_person_without_an_id_or_without_points(make):
    got = read_of(make, foreign.OPENDR, foreign.opendr(make, header_of(make), {}, ident=-1))
    assert got.ids == ("",) and got.persons == 1 and not got.visible.any()


# --- OpenPose


FORMS = {foreign.OPENPOSE_LIST: foreign.openpose_list, foreign.OPENPOSE_FRAME: foreign.openpose_frame}
ORDERS = [foreign.OPENPOSE18, foreign.BODY25]


@pytest.mark.parametrize("type_name", FORMS)
@pytest.mark.parametrize("own", ORDERS, ids=len)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_openpose_models_are_told_by_their_length(every_make, type_name, own, layout):
    names = load_layout(layout).names
    msg = FORMS[type_name](every_make, header_of(every_make), [foreign.openpose_rows(POSE, own)] * 2)
    got = read_of(every_make, type_name, msg, names)
    assert_pose(got, names, own, persons=2)
    np.testing.assert_allclose(got.confidence[got.visible], 0.8, rtol=1e-6)
    assert got.ids == ("", "")


@pytest.mark.parametrize("type_name", FORMS)
def test_openpose_zeros_are_missing_and_peaks_above_one_clipped(make, type_name):
    seen = {name: POSE[name] for name in ("nose", "neck", "left_ear")}
    rows = foreign.openpose_rows(seen, foreign.BODY25, score=1.03)
    got = read_of(make, type_name, FORMS[type_name](make, header_of(make), [rows]))
    assert_pose(got, COCO, seen)
    assert got.confidence.max() == 1


@pytest.mark.parametrize("type_name", FORMS)
def test_openpose_of_nobody_and_of_a_person_without_a_body(make, type_name):
    assert read_of(make, type_name, FORMS[type_name](make, header_of(make), [])).xy.shape == (0, 17, 2)
    rows = foreign.openpose_rows(POSE, foreign.BODY25)
    got = read_of(make, type_name, FORMS[type_name](make, header_of(make), [[], rows]))
    assert not got.visible[0].any() and got.visible[1].all()


@pytest.mark.parametrize("type_name", FORMS)
def test_openpose_of_another_model_is_in_the_layouts_order(make, type_name):
    names = [f"finger_{index}" for index in range(21)]
    rows = [(5.0 + index, 6.0, 0.5) for index in range(21)]
    msg = FORMS[type_name](make, header_of(make), [rows])
    np.testing.assert_array_equal(read_of(make, type_name, msg, names).xy[0, :, 0], 5 + np.arange(21))
    with pytest.raises(WrongPointCount) as error:
        read_of(make, type_name, msg)
    assert error.value.fits(21) and not error.value.fits(17)


def test_openpose_frame_with_the_field_renamed_for_ros_2():
    make = foreign.LiveMake()
    msg = foreign.openpose_frame(make, header_of(make), [foreign.openpose_rows(POSE, foreign.BODY25)])
    for person in msg.persons:
        person.body_parts = vars(person).pop("bodyParts")
    assert_pose(read_of(make, foreign.OPENPOSE_FRAME, msg), COCO, COCO)


# --- what they share


def every_message(make) -> dict:
    """Type name -> a message of those families that name their points."""
    rows = [foreign.openpose_rows(POSE, foreign.OPENPOSE18)]
    return {
        foreign.HRI: foreign.hri(make, header_of(make), POSE),
        foreign.ZED: foreign.zed(make, header_of(make), [POSE]),
        foreign.OPENDR: foreign.opendr(make, header_of(make), POSE),
        foreign.OPENPOSE_LIST: foreign.openpose_list(make, header_of(make), rows),
        foreign.OPENPOSE_FRAME: foreign.openpose_frame(make, header_of(make), rows),
    }


@pytest.mark.parametrize("type_name", every_message(foreign.LiveMake()))
@pytest.mark.parametrize("names", [("hinge", "handle", "corner"), ()])
def test_a_layout_of_another_thing_is_refused(make, type_name, names):
    assert reason_of(make, type_name, every_message(make)[type_name], names) == "no_common_names"


def test_the_reference_names_every_supported_type():
    text = (ROOT / "docs/reference/messages.md").read_text(encoding="utf-8")
    assert [name for name in SUPPORTED if f"`{name.replace('/msg/', '/')}`" not in text] == []


def test_orders_are_those_of_the_shipped_layouts():
    assert openpose.OPENPOSE18 == load_layout("openpose18").names
    assert openpose.BODY25 == load_layout("body25").names
    assert hri.NAMES == load_layout("hri18").names


@pytest.mark.parametrize("own", [zed.BODY34, zed.BODY38], ids=len)
def test_zed_orders_name_points_as_layouts_do_and_both_sides_alike(own):
    named = [name for name in own if name]
    assert len(set(named)) == len(named) and set(COCO) <= set(named) <= set(ALL_NAMES)
    sides = [{name.split("_", 1)[1] for name in named if name.startswith(side)} for side in ("left_", "right_")]
    assert sides[0] == sides[1]


# --- former names and versions


def test_former_type_names_are_the_same_adapters(make):
    assert SUPPORTED[foreign.FORMER_YOLO] is SUPPORTED[foreign.YOLO]
    msg = foreign.zed(make, header_of(make), [POSE])
    assert_pose(read_of(make, foreign.FORMER_ZED, msg), COCO, COCO)
    assert named_layout(foreign.FORMER_ZED, msg) == named_layout(foreign.ZED, msg) == "zed38"


@pytest.mark.parametrize("slots, body_format, own", [(18, 0, foreign.OPENPOSE18), (34, 0, foreign.OPENPOSE18),
                                                     (34, 2, foreign.ZED34), (34, 1, foreign.ZED34)])  # fmt: skip
def test_zed_versions_with_fewer_slots(slots, body_format, own):
    """Before version 4.0: 18 or 34 slots, and the constant of BODY_34 was 2."""
    make = foreign.LiveMake()
    msg = foreign.zed(make, header_of(make), [POSE], {18: 0, 34: 1}[len(own)])
    (body,) = msg.objects
    body.body_format, body.skeleton_2d.keypoints = body_format, body.skeleton_2d.keypoints[:slots]
    assert_pose(read_of(make, foreign.FORMER_ZED, msg), COCO, own)
    if body_format == 0:
        del body.body_format
        assert_pose(read_of(make, foreign.FORMER_ZED, msg), COCO, own)


def test_zed_skeletons_with_too_few_slots_are_refused():
    make = foreign.LiveMake()
    msg = foreign.zed(make, header_of(make), [POSE])
    msg.objects[0].body_format, msg.objects[0].skeleton_2d.keypoints = 2, msg.objects[0].skeleton_2d.keypoints[:18]
    with pytest.raises(MessageError, match="18 keypoints, body_format 2 needs 38"):
        read_of(make, foreign.FORMER_ZED, msg)


@pytest.mark.parametrize("percent, expected", [(80.0, 0.8), (0.0, 1.0), (np.nan, 1.0), (0.8, 0.8), (1.2, 1.0)])
def test_zed_confidences_are_percentages_or_shares(percent, expected):
    make = foreign.LiveMake()
    msg = foreign.zed(make, header_of(make), [POSE])
    msg.objects[0].skeleton_keypoint_confidence = np.full(70, percent)
    got = read_of(make, foreign.ZED, msg)
    np.testing.assert_allclose(got.confidence, expected)
    assert not got.notes


@pytest.mark.parametrize("name, own", [("zed34", zed.BODY34), ("zed38", zed.BODY38), ("zed18", openpose.OPENPOSE18)])
def test_zed_layouts_have_the_orders_of_the_adapter(name, own):
    assert load_layout(name).names == own
