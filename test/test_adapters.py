# SPDX-License-Identifier: Apache-2.0
"""The shipped adapters and the writers: round trips, missing values, and messages to refuse."""

from __future__ import annotations

import array

import numpy as np
import pytest
from conftest import camera_info, header_of
from foreign_messages import LiveMake

from msg_adapters import MessageError, Source, UnknownLayout, WrongPointCount, outputs, read, read_camera_info
from msg_adapters.palette import SIDE_COLOURS, rgb

CLOUD, POSES, YOLO = ("sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseArray", "yolo_msgs/msg/DetectionArray")
P = 5
FORMATS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


@pytest.fixture
def make(bag_make):
    """One family: the details are the same for both, and `every_make` gives both."""
    return bag_make


def some_points(persons: int = 2) -> np.ndarray:
    """Return (N, P, 2) whole pixels, which integer fields can hold too; none is (0, 0)."""
    return np.arange(1, persons * P * 2 + 1, dtype=float).reshape(persons, P, 2)


def cloud_of(
    make,
    columns: dict,
    formats: dict | None = None,
    order: str = "<",
    padding: int = 0,
    row_padding: int = 0,
    offset: int = 0,
    **changes,
):
    """Return a PointCloud2 of columns, each (height, width), with these types, byte order, padding and offsets."""
    formats = formats or {}
    height, width = next(iter(columns.values())).shape
    forms = [formats.get(name, "f4") for name in columns]
    sizes = [np.dtype(form).itemsize for form in forms]
    offsets = [offset + sum(sizes[:index]) for index in range(len(sizes))]
    step = offset + sum(sizes) + padding
    row_step = width * step + row_padding
    data = np.full(height * row_step, 0xEE, np.uint8)
    dtype = np.dtype(
        {"names": list(columns), "formats": [order + form for form in forms], "offsets": offsets, "itemsize": step}
    )
    cloud = np.ndarray((height, width), dtype, data, strides=(row_step, step))
    for name, column in columns.items():
        cloud[name] = column
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=where, datatype=FORMATS[form], count=1)
        for name, where, form in zip(columns, offsets, forms)
    ]
    message = dict(
        header=header_of(make),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=order == ">",
        point_step=step,
        row_step=row_step,
        data=make.octets(data.tobytes()),
        is_dense=True,
    )
    return make(CLOUD, **{**message, **changes})


def poses_of(make, xyz: np.ndarray):
    orientation = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    poses = [
        make("geometry_msgs/msg/Pose", orientation=orientation, position=make("geometry_msgs/msg/Point", x=x, y=y, z=z))
        for x, y, z in xyz.reshape(-1, 3).tolist()
    ]
    return make(POSES, header=header_of(make), poses=poses)


def detections_of(make, persons: list):
    """persons: (id, [(keypoint id, x, y, score), ...])."""

    def keypoint(number, x, y, score):
        return make("yolo_msgs/msg/KeyPoint2D", id=number, score=score, point=make("yolo_msgs/msg/Point2D", x=x, y=y))

    def detection(name, keypoints):
        data = [keypoint(*values) for values in keypoints]
        return make(
            "yolo_msgs/msg/Detection",
            class_id=0,
            class_name="person",
            score=0.9,
            id=name,
            keypoints=make("yolo_msgs/msg/KeyPoint2DArray", data=data),
        )

    detections = [detection(*person) for person in persons]
    return make(YOLO, header=header_of(make), detections=detections)


def xy_columns(xy: np.ndarray) -> dict:
    return {"x": xy[..., 0], "y": xy[..., 1]}


def reason_of(type_name: str, msg) -> str:
    with pytest.raises(MessageError) as error:
        read(type_name, msg, P)
    assert len(str(error.value)) > 20
    return error.value.reason


# --- PointCloud2: valid messages


def test_cloud_round_trip(every_make):
    xy, confidence = some_points(), np.linspace(0.1, 1, 2 * P).reshape(2, P)
    xy[1, 2] = np.nan
    got = read(CLOUD, outputs.keypoints_cloud(every_make, header_of(every_make), xy, confidence, ("12", "")), P)
    np.testing.assert_array_equal(got.xy, xy)
    np.testing.assert_array_equal(got.visible, ~np.isnan(xy[..., 0]))
    np.testing.assert_allclose(got.confidence, np.where(got.visible, confidence, 0), atol=1e-7)
    assert got.ids == ("12", "")
    assert (got.stamp, got.frame_id) == (7_000_000_005, "camera_color_optical_frame")


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("order", "<>")
def test_cloud_in_every_number_type_and_byte_order(make, form, order):
    msg = cloud_of(make, xy_columns(some_points()), {"x": form, "y": form}, order)
    got = read(CLOUD, msg, P)
    np.testing.assert_array_equal(got.xy, some_points())
    np.testing.assert_array_equal(got.confidence, 1)
    assert got.ids == ("", "")


def test_cloud_with_padding_mixed_types_and_another_field_order(make):
    xy = some_points() + 0.25
    columns = {
        "person_id": np.array([[3] * P, [-1] * P]),
        "y": xy[..., 1],
        "confidence": np.full((2, P), 0.5),
        "label": np.zeros((2, P)),
        "x": xy[..., 0],
    }
    formats = {"person_id": "i2", "y": "f8", "confidence": "f8", "label": "u1"}
    got = read(CLOUD, cloud_of(make, columns, formats, padding=3, row_padding=11, offset=4), P)
    np.testing.assert_array_equal(got.xy, xy)
    np.testing.assert_array_equal(got.confidence, 0.5)
    assert got.ids == ("3", "")


def test_flat_cloud_is_split_into_persons(every_make):
    msg = cloud_of(every_make, xy_columns(some_points(3).reshape(1, -1, 2)), row_step=0)
    np.testing.assert_array_equal(read(CLOUD, msg, P).xy, some_points(3))


def test_cloud_person_id_survives_missing_points(make):
    ids = np.array([[np.nan, 16777216, np.nan, np.nan, np.nan]])
    got = read(CLOUD, cloud_of(make, {**xy_columns(some_points(1)), "person_id": ids}), P)
    assert got.ids == ("16777216",)


@pytest.mark.parametrize("size", [(0, 0), (0, P), (3, 0)])
def test_empty_cloud_is_zero_persons(make, size):
    msg = cloud_of(make, xy_columns(np.empty((0, P, 2))), height=size[0], width=size[1], fields=[])
    got = read(CLOUD, msg, P)
    assert got.xy.shape == (0, P, 2) and got.visible.shape == (0, P) and got.ids == ()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e7, -3e38])
def test_cloud_points_that_no_camera_saw_are_missing(make, value):
    xy = some_points()
    xy[0, 1, 1] = value
    got = read(CLOUD, cloud_of(make, xy_columns(xy)), P)
    assert not got.visible[0, 1] and got.visible.sum() == 2 * P - 1
    assert np.isnan(got.xy[0, 1]).all() and got.confidence[0, 1] == 0


def test_cloud_confidence_nan_is_missing_and_others_are_clipped(make):
    confidence = np.array([[np.nan, 1.05, -0.5, 0.25, np.inf]])
    got = read(CLOUD, cloud_of(make, {**xy_columns(some_points(1)), "confidence": confidence}), P)
    np.testing.assert_array_equal(got.visible, [[False, True, True, True, False]])
    np.testing.assert_array_equal(got.confidence, [[0, 1, 0, 0.25, 0]])


def test_reading_a_cloud_changes_nothing_in_it(every_make):
    xy = some_points()
    xy[0, 0] = np.inf
    msg = cloud_of(every_make, xy_columns(xy), {"x": "f8", "y": "f8"})
    before = bytes(msg.data)
    read(CLOUD, msg, P)
    assert bytes(msg.data) == before


# --- PointCloud2: messages to refuse


def test_cloud_with_other_field_names(make):
    xy = some_points()
    assert reason_of(CLOUD, cloud_of(make, {"u": xy[..., 0], "v": xy[..., 1]})) == "wrong_fields"


def test_cloud_without_fields(make):
    assert reason_of(CLOUD, cloud_of(make, xy_columns(some_points()), fields=[])) == "wrong_fields"


@pytest.mark.parametrize("datatype, count", [(0, 1), (9, 1), (7, 2)])
def test_cloud_with_unknown_datatype_or_vector_field(make, datatype, count):
    msg = cloud_of(make, xy_columns(some_points()), padding=8)
    msg.fields[1] = make("sensor_msgs/msg/PointField", name="y", offset=4, datatype=datatype, count=count)
    assert reason_of(CLOUD, msg) == "wrong_fields"


def test_cloud_with_integer_confidence(make):
    columns = {**xy_columns(some_points()), "confidence": np.full((2, P), 87)}
    assert reason_of(CLOUD, cloud_of(make, columns, {"confidence": "u1"})) == "wrong_fields"


def test_cloud_of_3d_points(make):
    xy = some_points()
    assert reason_of(CLOUD, cloud_of(make, {**xy_columns(xy), "z": xy[..., 0]})) == "not_2d"


@pytest.mark.parametrize(
    "changes",
    [
        {"point_step": 7},
        {"point_step": 0},
        {"row_step": 3},
        {"row_step": 0},
    ],
)
def test_cloud_whose_steps_contradict_its_fields(make, changes):
    assert reason_of(CLOUD, cloud_of(make, xy_columns(some_points()), **changes)) == "wrong_steps"


def test_cloud_cut_short(every_make):
    msg = cloud_of(every_make, xy_columns(some_points()))
    msg.data = every_make.octets(bytes(msg.data)[:-1])
    assert reason_of(CLOUD, msg) == "truncated_data"


@pytest.mark.parametrize(
    "changes",
    [
        {"height": 2**32 - 1},
        {"height": 1, "width": 2**32 - 1},
        {"height": 1, "point_step": 2**32 - 1},
        {"row_step": 2**32 - 1},
    ],
)
def test_cloud_of_absurd_size(make, changes):
    assert reason_of(CLOUD, cloud_of(make, xy_columns(some_points()), **changes)) == "truncated_data"


@pytest.mark.parametrize("shape, fitting", [((2, 4), {4}), ((1, 12), {3, 4, 6}), ((3, 6), {6})])
def test_cloud_with_another_number_of_points_says_which_would_fit(make, shape, fitting):
    with pytest.raises(WrongPointCount) as error:
        read(CLOUD, cloud_of(make, {"x": np.ones(shape), "y": np.ones(shape)}), P)
    assert {points for points in (3, 4, 5, 6, 7) if error.value.fits(points)} == fitting


# --- PoseArray


def test_pose_array_of_two_persons_with_confidence(every_make):
    confidence = np.linspace(0, 0.9, 2 * P).reshape(2, P, 1)
    got = read(POSES, poses_of(every_make, np.concatenate([some_points(), confidence], axis=-1)), P)
    np.testing.assert_array_equal(got.xy, some_points())
    np.testing.assert_allclose(got.confidence, confidence[..., 0])
    assert got.visible.all() and got.ids == ("", "")


def test_pose_array_without_confidence_or_with_missing_points(make):
    xyz = np.concatenate([some_points(1), np.zeros((1, P, 1))], axis=-1)
    xyz[0, 1], xyz[0, 2] = np.nan, 0
    got = read(POSES, poses_of(make, xyz), P)
    np.testing.assert_array_equal(got.visible, [[True, False, False, True, True]])
    np.testing.assert_array_equal(got.confidence, got.visible.astype(float))


def test_pose_array_of_nobody(make):
    assert read(POSES, poses_of(make, np.empty((0, 3))), P).xy.shape == (0, P, 2)


def test_pose_array_confidence_a_little_above_one_is_clipped(make):
    confidence = np.array([1.28, 1.11, 1, 0.5, 0.9])[None, :, None]
    got = read(POSES, poses_of(make, np.concatenate([some_points(1), confidence], axis=-1)), P)
    np.testing.assert_array_equal(got.confidence, [[1, 1, 1, 0.5, 0.9]])
    assert got.visible.all()


@pytest.mark.parametrize("z", [1.31, 1.7, -0.2, np.inf])
def test_pose_array_that_is_3d(make, z):
    xyz = np.concatenate([some_points(), np.zeros((2, P, 1))], axis=-1)
    xyz[1, 3, 2] = z
    assert reason_of(POSES, poses_of(make, xyz)) == "not_2d"


def test_pose_array_with_another_number_of_points(make):
    assert reason_of(POSES, poses_of(make, np.zeros((P + 1, 3)))) == "wrong_point_count"


@pytest.mark.parametrize("total, points", [(10, 5), (10, 10), (15, 5)])
def test_a_list_is_not_divided_while_the_layout_is_unknown(make, total, points):
    """10 points are one body of 10 or two of 5; with a known layout the number of persons is sure."""
    xy = np.random.default_rng(0).uniform(10, 500, (total, 2))
    lists = {
        POSES: poses_of(make, np.column_stack([xy, np.zeros(total)])[None]),
        CLOUD: cloud_of(make, xy_columns(xy[None])),
    }
    for type_name, msg in lists.items():
        with pytest.raises(UnknownLayout, match=f"{total} keypoints in one list") as error:
            read(type_name, msg, points, Source(candidates=(5, 10)))
        assert error.value.reason == "layout_unknown" and error.value.fits(5) and not error.value.fits(7)
        assert read(type_name, msg, points).persons == total // points


def test_a_list_of_one_person_and_rows_of_persons_are_read_while_the_layout_is_unknown(make):
    source = Source(candidates=(5, 10, 7))
    for xyz in (np.ones((0, 3)), np.column_stack([some_points(1)[0] * 9, np.zeros(P)])):
        assert read(POSES, poses_of(make, xyz), P, source).persons == len(xyz) // P
    assert read(CLOUD, cloud_of(make, xy_columns(some_points(4))), P, source).persons == 4


@pytest.mark.parametrize(
    "ids, persons",
    [([4, 4, 4, 4, 4, 2, 2, 2, 2, 2], 2), ([0] * 10, 0), ([1, 1, 1, 2, 2, 2, 2, 2, 2, 2], 0), ([np.nan] * 10, 0),
     ([1, 1, 1, 1, 1, 2, 2, 2, 2, np.nan], 0), ([1, 2] * 5, 0)],
)  # fmt: skip
def test_ids_show_the_number_of_persons_in_a_list(make, ids, persons):
    """Ids that are all 0, as of some trackers, show nothing."""
    columns = {**xy_columns(np.random.default_rng(0).uniform(9, 500, (1, 10, 2))), "person_id": np.array([ids])}
    msg, source = cloud_of(make, columns), Source(candidates=(P, 10))
    if persons:
        assert read(CLOUD, msg, P, source).ids == ("4", "2")
        with pytest.raises(WrongPointCount, match="10 keypoints of 2 persons"):
            read(CLOUD, msg, 10, source)
    else:
        with pytest.raises(UnknownLayout):
            read(CLOUD, msg, P, source)


# --- numbers that mean something else


@pytest.mark.parametrize("x, y", [(0, 0), (-1, -1), (-999, -999)])
def test_placeholders_are_missing_in_every_family(make, x, y):
    xy = some_points(1) * 9
    xy[0, 2] = x, y
    messages = {
        CLOUD: cloud_of(make, {**xy_columns(xy), "confidence": np.full((1, P), 0.9)}),
        POSES: poses_of(make, np.dstack([xy, [[0.9, 0.8, min(x, 0.7), 0.9, 0.9]]])),
        YOLO: detections_of(make, [("1", [(n + 1, *xy[0, n].tolist(), 0.9) for n in range(P)])]),
    }
    for type_name, msg in messages.items():
        assert read(type_name, make.through_cdr(msg), P).visible.tolist() == [[True, True, False, True, True]]


@pytest.mark.parametrize("confidence", [[0, 34, 87.5, 99, 100], [-4.1, 2.2, 0.3, 5, -0.2], [0.9, 0.8, 1.4, 0.7, 1]])
def test_confidences_outside_0_to_1_are_noted(make, confidence):
    """Percentages, logits, and peaks far over 1."""
    got = read(CLOUD, cloud_of(make, {**xy_columns(some_points(1) * 9), "confidence": np.array([confidence])}), P)
    (note,) = got.notes
    assert note.reason == "confidence_range" and f"{max(confidence):.4g}" in note.text and "percent" in note.text
    assert got.confidence.tolist() == np.clip(np.float32([confidence]), 0, 1).tolist()


@pytest.mark.parametrize(
    "confidence",
    [
        [0, 0.5, 1, 1.05, 0.9],
        [0.87, 1.112, 0.95, 1.28, 1.01],
        [-1, -1, 0.5, 0.6, 1],
        [np.nan, -0.01, 1, 1, 1],
        [0, 1, 2, 2, 0],
    ],
)
def test_usual_confidences_are_not_noted(make, confidence):
    columns = {**xy_columns(some_points(1) * 9), "confidence": np.array([confidence])}
    assert read(CLOUD, cloud_of(make, columns), P).notes == ()


def test_percentages_in_a_pose_array_are_refused_as_such(make):
    xyz = np.dstack([some_points(1) * 9, [[87, 45, 99, 100, 3]]])
    with pytest.raises(MessageError, match="no percentage"):
        read(POSES, poses_of(make, xyz), P)


@pytest.mark.parametrize("name", ["score", "visibility", "conf", "likelihood", "probability", "keypoint_scores", "c"])
def test_a_confidence_by_another_name_is_used(make, name):
    confidence = np.linspace(0.1, 0.9, P)[None]
    got = read(CLOUD, cloud_of(make, {**xy_columns(some_points(1) * 9), name: confidence}), P)
    np.testing.assert_allclose(got.confidence, confidence, rtol=1e-6)
    assert got.notes == ()


def test_fields_that_are_not_used_are_named(make):
    half, other = np.full((1, P), 0.5), np.full((1, P), 0.1)
    columns = {**xy_columns(some_points(1) * 9), "visibility": other, "confidence": half, "track_id": other}
    got = read(CLOUD, cloud_of(make, columns), P)
    (note,) = got.notes
    assert note.reason == "unused_fields" and "fields visibility, track_id of" in note.text
    np.testing.assert_array_equal(got.confidence, half)
    columns = {**xy_columns(some_points(1) * 9), "visibility": other, "score": half}
    got = read(CLOUD, cloud_of(make, columns), P)
    np.testing.assert_array_equal(got.confidence, half)
    assert "fields visibility of" in got.notes[0].text and "only x, y, score are" in got.notes[0].text


@pytest.mark.parametrize("name, form, value", [("c", "u1", 0), ("score", "i4", 7), ("visibility", "u1", 2)])
def test_whole_numbers_by_another_name_are_no_confidence(make, name, form, value):
    """A class number of 0 must not hide every point, and no such field may cost the message."""
    columns = {**xy_columns(some_points(1) * 9), name: np.full((1, P), value)}
    got = read(CLOUD, cloud_of(make, columns, {name: form}), P)
    assert got.visible.all() and (got.confidence == 1).all()
    assert f"fields {name} of" in got.notes[0].text


def test_normalised_keypoints_are_refused(make):
    xy = np.random.default_rng(0).uniform(-0.2, 1.3, (2, P, 2))
    messages = {
        CLOUD: cloud_of(make, xy_columns(xy)),
        POSES: poses_of(make, np.dstack([xy, np.zeros((2, P))])),
        YOLO: detections_of(make, [("1", [(n + 1, *xy[0, n].tolist(), 0.9) for n in range(P)])]),
    }
    for type_name, msg in messages.items():
        assert reason_of(type_name, make.through_cdr(msg)) == "normalised"


@pytest.mark.parametrize("scale, spread", [(400, 1), (1, 0)])
def test_pixels_and_points_in_one_place_are_not_normalised(make, scale, spread):
    xy = 1 + spread * np.random.default_rng(0).uniform(0, scale, (1, P, 2))
    assert read(CLOUD, cloud_of(make, xy_columns(xy)), P).visible.all()


# --- yolo_msgs, which has no rclpy package here


def test_yolo_places_points_by_their_one_based_id(bag_make):
    msg = bag_make.through_cdr(
        detections_of(
            bag_make,
            [
                ("4", [(5, 50.0, 51.0, 0.5), (1, 10.0, 11.0, 0.9), (2, 0.0, 0.0, 0.8)]),
                ("", [(3, 30.0, 0.0, 0.7)]),
            ],
        )
    )
    got = read(YOLO, msg, P)
    np.testing.assert_array_equal(got.visible, [[True, False, False, False, True], [False, False, True, False, False]])
    np.testing.assert_array_equal(got.xy[0, [0, 4]], [[10, 11], [50, 51]])
    np.testing.assert_array_equal(got.xy[1, 2], [30, 0])
    np.testing.assert_array_equal(got.confidence, [[0.9, 0, 0, 0, 0.5], [0, 0, 0.7, 0, 0]])
    assert got.ids == ("4", "")


def test_yolo_of_more_points_than_coco_needs_the_layout(make):
    """A hand of 21 points fits the first 21 points of every larger layout."""
    msg = detections_of(make, [("1", [(21, 50.0, 51.0, 0.5), (1, 10.0, 11.0, 0.9)])])
    with pytest.raises(UnknownLayout, match="id 21 is beyond COCO's 17"):
        read(YOLO, msg, 43, Source(candidates=(17, 25, 43)))
    for source in (Source(), Source(candidates=(17, 21))):
        assert read(YOLO, msg, 21, source).visible.sum() == 2


def test_yolo_person_without_keypoints_and_nobody(bag_make):
    assert not read(YOLO, detections_of(bag_make, [("1", [])]), P).visible.any()
    assert read(YOLO, detections_of(bag_make, []), P).xy.shape == (0, P, 2)


@pytest.mark.parametrize(
    "keypoint, reason", [(0, "wrong_keypoint_id"), (-1, "wrong_keypoint_id"), (P + 1, "wrong_point_count")]
)
def test_yolo_with_ids_outside_the_layout(bag_make, keypoint, reason):
    assert reason_of(YOLO, detections_of(bag_make, [("", [(keypoint, 1.0, 1.0, 1.0)])])) == reason


def test_unknown_type(make):
    assert reason_of("vision_msgs/msg/Detection2DArray", header_of(make)) == "unknown_type"


# --- CameraInfo


def test_camera_info(every_make):
    got = read_camera_info(camera_info(every_make, fy=610.0))
    assert (got.fx, got.fy, got.cx, got.cy, got.width, got.height) == (600, 610, 320, 240, 640, 480)


@pytest.mark.parametrize(
    "wrong", [{"fx": 0.0, "fy": 0.0}, {"fx": np.nan}, {"fy": -600.0}, {"fy": np.inf}, {"cx": np.nan}]
)
def test_camera_info_that_is_no_camera(every_make, wrong):
    with pytest.raises(MessageError) as error:
        read_camera_info(camera_info(every_make, **wrong))
    assert error.value.reason == "bad_intrinsics"


def info_with(make, p=(600, 600, 320, 240), k=(600, 600, 320, 240), d=(0.0,) * 5, size=(640, 480)):
    """Return a CameraInfo with fx, fy, cx, cy of P and of K."""
    msg = camera_info(make)
    msg.p = np.array([p[0], 0, p[2], 0, 0, p[1], p[3], 0, 0, 0, 1.0, 0])
    msg.k = np.array([k[0], 0, k[2], 0, k[1], k[3], 0, 0, 1.0])
    msg.d, (msg.width, msg.height) = array.array("d", d), size
    return msg


def test_camera_info_is_that_of_the_rectified_image(make):
    got = read_camera_info(info_with(make, p=(580, 581, 330, 250), k=(610, 611, 315, 235), d=(-0.3, 0.1, 0, 0, 0)))
    assert (got.fx, got.fy, got.cx, got.cy) == (580, 581, 330, 250)
    assert (got.matrix, got.image, got.distortion) == ("P", "rectified", None)


@pytest.mark.parametrize("p", [(0, 0, 0, 0), (580, 0, 330, 250), (np.nan, 581, 330, 250), (580, 581, np.inf, 250)])
@pytest.mark.parametrize("d, distorted", [((), False), ((0.0,) * 5, False), ((0, 0, 0.01, 0, 0), True)])
def test_camera_info_without_p_is_that_of_the_raw_image(make, p, d, distorted):
    got = read_camera_info(info_with(make, p=p, k=(610, 611, 315, 235), d=d))
    assert (got.fx, got.fy, got.cx, got.cy) == (610, 611, 315, 235)
    assert (got.matrix, got.image, got.distortion is not None) == ("K", "raw", distorted)


@pytest.mark.parametrize("unfilled", [(0, 0, 0, 0), None])
@pytest.mark.parametrize(
    "numbers, size",
    [
        ((1e300, 1e300, 320, 240), (640, 480)),
        ((1e-300, 1e-300, 320, 240), (0, 0)),
        ((600, 1e6, 320, 240), (640, 480)),
        ((600, 600, 1e300, 240), (640, 480)),
        ((1.2, 1.6, 0.5, 0.5), (1280, 720)),
        ((1.2, 1.6, 0.5, 0.5), (0, 0)),
        ((1e7, 1e7, 320, 240), (0, 0)),
    ],
)
def test_camera_info_out_of_all_proportion(make, numbers, size, unfilled):
    with pytest.raises(MessageError, match="calibrate") as error:
        read_camera_info(info_with(make, p=unfilled or numbers, k=numbers, size=size))
    assert error.value.reason == "bad_intrinsics"


@pytest.mark.parametrize("focal, size", [(64.1, (640, 480)), (63_000, (480, 640)), (100, (0, 0)), (9e5, (0, 0))])
def test_camera_info_of_wide_and_long_lenses(make, focal, size):
    assert read_camera_info(info_with(make, p=(focal, focal, 300, 200), size=size)).fx == focal


# --- writers


def written(make, bag_make, msg):
    """Return a message of rosbags as a bag delivers it; rclpy has checked the fields of its own already."""
    return bag_make.through_cdr(msg) if make is bag_make else msg


def test_pose_array_writer(every_make, bag_make):
    points = np.random.default_rng(1).normal(size=(2, P, 3)).astype(np.float32)
    header = header_of(every_make)
    msg = outputs.pose_array(every_make, header, points)
    assert msg.header is header
    msg = written(every_make, bag_make, msg)
    got = [(p.position.x, p.position.y, p.position.z) for p in msg.poses]
    np.testing.assert_array_equal(got, points.reshape(-1, 3))
    assert {(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in msg.poses} == {(0, 0, 0, 1)}


def test_points_cloud_writer(every_make, bag_make):
    points = np.random.default_rng(2).normal(size=(3, P, 3)).astype(np.float32)
    confidence = np.full((3, P), 0.5)
    msg = written(
        every_make,
        bag_make,
        outputs.points_cloud(
            every_make,
            header_of(every_make),
            points,
            confidence,
            ("7", "anna", "99999999999"),
            np.array([0.0, 0.5, 1.0]),
            np.array([0.1, 0.2, 0.3]),
        ),
    )
    assert (msg.height, msg.width, msg.point_step, msg.row_step) == (3, P, 32, 32 * P)
    names = ["x", "y", "z", "confidence", "keypoint", "person_id", "ambiguity", "distance_sigma"]
    assert [field.name for field in msg.fields] == names
    data = np.frombuffer(msg.data, "<f4").reshape(3, P, 8)
    np.testing.assert_array_equal(data[..., 6], np.tile(np.float32([[0], [0.5], [1]]), P))
    np.testing.assert_array_equal(data[:, 3, 7], np.float32([0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(data[..., :3], points)
    np.testing.assert_array_equal(data[..., 3], 0.5)
    np.testing.assert_array_equal(data[..., 4], np.tile(np.arange(P), (3, 1)))
    np.testing.assert_array_equal(data[:, 0, 5], [7, -1, -1])
    assert msg.is_dense


@pytest.mark.parametrize(
    "text, number",
    [
        ("", -1),
        ("0", 0),
        ("00000012", 12),
        ("16777216", 16777216),
        ("16777217", -1),
        ("-3", -1),
        ("anna", -1),
        ("9" * 5000, -1),
        ("\u0660" * 5000, -1),
    ],
    ids=lambda value: str(value)[:20].encode("ascii", "replace").decode(),
)
def test_person_ids_as_numbers(text, number):
    assert outputs.id_numbers(["", text]).tolist() == [-1, number]


def test_markers_are_two_packed_lists_with_sides_and_hidden_points(every_make, bag_make):
    points = np.random.default_rng(3).normal(size=(2, 4, 3))
    observed = np.array([[True, True, True, True], [True, False, True, True]])
    sides = ("right", "left", "left", "right")
    edges, header = [(1, 2), (0, 3), (2, 3)], header_of(every_make)
    msg = outputs.skeleton_markers(every_make, header, points, observed, edges, sides, 0.02)
    msg = written(every_make, bag_make, msg)
    bones, spheres = msg.markers
    assert (bones.type, spheres.type) == (bones.LINE_LIST, bones.SPHERE_LIST)
    assert (bones.ns, bones.id) != (spheres.ns, spheres.id)
    assert bones.action == spheres.action == bones.ADD
    ends = np.array([(p.x, p.y, p.z) for p in bones.points]).reshape(2, 3, 2, 3)
    np.testing.assert_array_equal(ends, points[:, [[1, 2], [0, 3], [2, 3]]])
    np.testing.assert_array_equal([(p.x, p.y, p.z) for p in spheres.points], points.reshape(-1, 3))
    assert [c.a < 1 for c in spheres.colors] == [False] * 5 + [True] + [False] * 2
    assert [c.a < 1 for c in bones.colors] == [False] * 6 + [True] * 2 + [False] * 4
    for side, colours in {
        "left": (spheres.colors[1], bones.colors[0], bones.colors[1]),
        "right": (spheres.colors[0], bones.colors[2], bones.colors[3]),
        "": bones.colors[4:6],  # from the left to the right: the colour of neither
    }.items():
        assert [(c.r, c.g, c.b) for c in colours] == [pytest.approx(rgb(SIDE_COLOURS[side]))] * len(colours)
    assert bones.pose.orientation.w == 1 and 0 < bones.scale.x < spheres.scale.x


def test_left_is_blue_and_right_is_orange():
    """These survive colour blindness; red and green do not."""
    (_, _, blue), (red, green, _) = rgb(SIDE_COLOURS["left"]), rgb(SIDE_COLOURS["right"])
    assert blue > 0.75 and red > 0.75 and 0.25 < green < 0.65


def test_annotations_count_from_the_corner_of_the_first_pixel():
    """CameraInfo counts from its middle, half a pixel further."""
    pixels = np.array([[[0.0, 0.0], [10.0, 20.5], [np.nan, np.nan], [3.0, 4.0]]])
    observed = np.array([[True, True, True, False]])
    sides, edges = ("left", "right", "", "left"), [(0, 3), (0, 1), (1, 2)]
    make = LiveMake()
    lines, dots = outputs.image_annotations(make, header_of(make), pixels, observed, edges, sides).points
    assert [(p.x, p.y) for p in dots.points] == [(0.5, 0.5), (10.5, 21.0), (3.5, 4.5)]
    assert [(p.x, p.y) for p in lines.points] == [(0.5, 0.5), (3.5, 4.5), (0.5, 0.5), (10.5, 21.0)]
    assert [(c.r, c.a) for c in dots.outline_colors] == [
        (rgb(SIDE_COLOURS[side])[0], alpha) for side, alpha in (("left", 1.0), ("right", 1.0), ("left", 0.3))
    ]
    assert [(c.r, c.a) for c in lines.outline_colors] == [
        (rgb(SIDE_COLOURS[side])[0], alpha) for side, alpha in (("left", 0.3), ("", 1.0))
    ]


def test_nobody_is_written_as_empty_messages(every_make, bag_make):
    nobody, nothing, header = np.empty((0, P, 3)), np.empty((0, P)), header_of(every_make)
    poses = written(every_make, bag_make, outputs.pose_array(every_make, header, nobody))
    assert len(poses.poses) == 0
    cloud = outputs.points_cloud(every_make, header, nobody, nothing, (), np.empty(0), np.empty(0))
    cloud = written(every_make, bag_make, cloud)
    assert (cloud.height, cloud.width, len(cloud.data)) == (0, P, 0)
    markers = outputs.skeleton_markers(every_make, header, nobody, nothing > 0, [(0, 1)], ("",) * P, 0.02)
    markers = written(every_make, bag_make, markers).markers
    assert all(marker.action == marker.DELETE and len(marker.points) == 0 for marker in markers)
