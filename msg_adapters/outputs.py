# SPDX-License-Identifier: Apache-2.0
"""Arrays to messages, for rclpy classes and rosbags dataclasses alike.

Every writer takes a factory ``make``: ``make(type_name, **fields)`` builds a message and is always given all
its fields; ``make.octets(data)`` turns bytes into what a uint8[] field of the family wants. ``header`` is a
std_msgs/Header of the same family and is passed on as it is. Numbers reach messages as Python's own, since
rclpy publishes garbage for numpy scalars unless its field checks are on.
"""

from __future__ import annotations

import numpy as np

#: Of the cloud of 3D keypoints.
POINT_FIELDS = ("x", "y", "z", "confidence", "keypoint", "person_id", "ambiguity", "distance_sigma")
_FLOAT32 = 7
_SPHERE_LIST, _LINE_LIST = 7, 5
_ANNOTATED_POINTS, _ANNOTATED_LINES = 1, 4
_ADD, _DELETE = 0, 2
_MARKER_SECONDS = 1
#: Up to here float32 holds every whole number.
_LARGEST_ID = 2**24

#: Colours of the sides as (r, g, b): left red and right green, as on ships.
SIDE_COLOURS = {"left": (0.9, 0.2, 0.2), "right": (0.2, 0.75, 0.3), "": (0.35, 0.55, 0.95)}
_OBSERVED_ALPHA, _HIDDEN_ALPHA = 1.0, 0.3


def pose_array(make, header, points: np.ndarray):
    """geometry_msgs/PoseArray of points (N, P, 3), person-major, identity orientation."""
    identity = _quaternion(make)
    poses = [
        make("geometry_msgs/msg/Pose", position=_point(make, xyz), orientation=identity)
        for xyz in points.reshape(-1, 3).tolist()
    ]
    return make("geometry_msgs/msg/PoseArray", header=header, poses=poses)


def body_array(make, header, positions: np.ndarray, quaternions: np.ndarray):
    """geometry_msgs/PoseArray, one pose a person: positions (N, 3), quaternions (N, 4) as x, y, z, w."""
    poses = [
        make("geometry_msgs/msg/Pose", position=_point(make, xyz), orientation=_quaternion(make, *xyzw))
        for xyz, xyzw in zip(positions.tolist(), quaternions.tolist())
    ]
    return make("geometry_msgs/msg/PoseArray", header=header, poses=poses)


def keypoints_cloud(make, header, xy: np.ndarray, confidence: np.ndarray, person_ids):
    """2D keypoints as the native contract: an organised cloud, height = persons, width = keypoints.

    xy (N, P, 2) pixels, NaN = missing; confidence (N, P); person_ids: N ids as text, numbers or ''.
    """
    persons, points = confidence.shape
    ids = np.broadcast_to(id_numbers(person_ids)[:, None], (persons, points))
    return _cloud(make, header, ("x", "y", "confidence", "person_id"), [xy[..., 0], xy[..., 1], confidence, ids])


def points_cloud(make, header, points: np.ndarray, confidence: np.ndarray, ids, ambiguity, distance_sigma):
    """3D keypoints as an organised cloud, persons x P: x, y, z, confidence, keypoint (index); equal for all points of a
    person: person_id, ambiguity, distance_sigma.

    See point_values.
    """
    values = point_values(points, confidence, ids, ambiguity, distance_sigma)
    return _cloud(make, header, POINT_FIELDS, list(np.moveaxis(values, -1, 0)))


def point_values(points: np.ndarray, confidence: np.ndarray, ids, ambiguity, distance_sigma) -> np.ndarray:
    """(N, P, 8) float32 in the order of POINT_FIELDS.

    points (N, P, 3) in the camera's optical frame; confidence (N, P), 0 where the keypoint was not seen; ambiguity (N,)
    0..1; distance_sigma (N,) metres, NaN where there are none.
    """
    values = np.empty((*confidence.shape, len(POINT_FIELDS)), "<f4")
    values[..., :3] = points
    values[..., 3] = confidence
    values[..., 4] = np.arange(confidence.shape[1])
    for column, each in enumerate((id_numbers(ids), ambiguity, distance_sigma), 5):
        values[..., column] = np.asarray(each)[:, None]
    return values


def skeleton_markers(make, header, points: np.ndarray, observed: np.ndarray, edges, sides, thickness: float):
    """visualization_msgs/MarkerArray of all persons: one LINE_LIST (bones), one SPHERE_LIST (keypoints).

    points (N, P, 3); observed (N, P) bool, what was not observed is drawn faint; edges: pairs of keypoint
    indices; sides: P of 'left', 'right', ''; thickness of a bone in the units of the points. A bone has the
    colour of a side where both its ends are of that side.
    With no person both markers are deleted: viewers complain of empty lists.
    """
    edges = np.asarray(edges, dtype=int).reshape(-1, 2)
    bone_sides = [sides[a] if sides[a] == sides[b] else "" for a, b in edges]
    bones = points[:, edges].reshape(-1, 3)
    bones_seen = observed[:, edges].all(axis=-1).repeat(2)
    palette = _palette(make)
    lines = _marker(
        make, header, 0, "bones", _LINE_LIST, thickness, bones, _colours(palette, np.repeat(bone_sides, 2), bones_seen)
    )
    spheres = _marker(
        make,
        header,
        1,
        "keypoints",
        _SPHERE_LIST,
        2 * thickness,
        points.reshape(-1, 3),
        _colours(palette, sides, observed.reshape(-1)),
    )
    return make("visualization_msgs/msg/MarkerArray", markers=[lines, spheres])


def body_transforms(make, header, ids, positions: np.ndarray, quaternions: np.ndarray):
    """tf2_msgs/TFMessage from the header's frame to body_ID (REP-155) of every person that has an id, '' being none.

    positions (N, 3) metres; quaternions (N, 4) as x, y, z, w.
    """
    transforms = [
        make(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=f"body_{ident}",
            transform=make(
                "geometry_msgs/msg/Transform",
                translation=_vector(make, *xyz),
                rotation=_quaternion(make, *xyzw),
            ),
        )
        for ident, xyz, xyzw in zip(ids, positions.tolist(), quaternions.tolist())
        if ident
    ]
    return make("tf2_msgs/msg/TFMessage", transforms=transforms)


def image_annotations(make, header, pixels: np.ndarray, observed: np.ndarray, edges, sides):
    """foxglove_msgs/ImageAnnotations: bones and keypoints of all persons, drawn into the camera's image.

    pixels (N, P, 2), whole numbers at the middle of a pixel as in CameraInfo, NaN where there is nothing to draw;
    observed (N, P) bool, what was not is drawn faint; edges, sides: see skeleton_markers. Of the message only `points`
    is given: its other fields are empty, and are not the same in all releases of the package.
    """
    edges = np.asarray(edges, dtype=int).reshape(-1, 2)
    ends = pixels[:, edges]
    drawn = np.isfinite(ends).all(axis=(2, 3))
    palette = {key: _colour(make, rgb, alpha, "foxglove_msgs/msg/Color") for key, rgb, alpha in _tones()}
    bone_sides = [sides[a] if sides[a] == sides[b] else "" for a, b in edges]
    bones_seen = observed[:, edges].all(axis=-1)
    shown = np.isfinite(pixels).all(axis=2)
    of_bones = [palette[bone_sides[bone], bool(bones_seen[n, bone])] for n, bone in np.argwhere(drawn)]
    of_points = [palette[str(sides[point]), bool(observed[n, point])] for n, point in np.argwhere(shown)]
    lines = _annotation(make, header, _ANNOTATED_LINES, ends[drawn].reshape(-1, 2), of_bones, 2.0)
    dots = _annotation(make, header, _ANNOTATED_POINTS, pixels[shown], of_points, 6.0)
    return make("foxglove_msgs/msg/ImageAnnotations", points=[lines, dots])


def id_numbers(ids) -> np.ndarray:
    """Person ids as numbers a float32 field can carry: -1 for '', the row for an id that is no whole number.

    Exact up to 2^24; a larger id is replaced by its row too, since two persons would share its rounding.
    An array of such numbers is passed on as it is.
    """
    if isinstance(ids, np.ndarray):
        return ids
    return np.array([_id_number(str(text), row) for row, text in enumerate(ids)], dtype=np.float32)


def _id_number(text: str, row: int) -> int:
    if text == "":
        return -1
    digits = text.lstrip("0") or "0"
    # The length first: Python refuses to read a number of thousands of digits.
    known = digits.isdecimal() and len(digits) <= len(str(_LARGEST_ID)) and int(digits) <= _LARGEST_ID
    return int(digits) if known else row


def _cloud(make, header, names: tuple[str, ...], columns: list[np.ndarray]):
    """An organised float32 PointCloud2 of columns, each (height, width)."""
    data = np.stack(columns, axis=-1).astype("<f4")
    height, width, count = data.shape
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * index, datatype=_FLOAT32, count=1)
        for index, name in enumerate(names)
    ]
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header,
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=4 * count,
        row_step=4 * count * width,
        data=make.octets(data.tobytes()),
        is_dense=bool(np.isfinite(data).all()),
    )


def _marker(make, header, index: int, name: str, kind: int, size: float, points: np.ndarray, colours: list):
    """One marker of a packed kind. It expires by itself when no further frame comes."""
    seconds = make("builtin_interfaces/msg/Duration", sec=_MARKER_SECONDS, nanosec=0)
    zero = make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    nothing = make("std_msgs/msg/Header", stamp=zero, frame_id="")
    return make(
        "visualization_msgs/msg/Marker",
        header=header,
        ns=name,
        id=index,
        type=kind,
        action=_ADD if len(points) else _DELETE,
        pose=make("geometry_msgs/msg/Pose", position=_point(make, (0.0, 0.0, 0.0)), orientation=_quaternion(make)),
        scale=_vector(make, *(3 * (float(size),))),
        color=_colour(make, SIDE_COLOURS[""], _OBSERVED_ALPHA),
        lifetime=seconds,
        frame_locked=False,
        points=[_point(make, xyz) for xyz in points.tolist()],
        colors=colours,
        texture_resource="",
        texture=make("sensor_msgs/msg/CompressedImage", header=nothing, format="", data=make.octets(b"")),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=make.octets(b"")),
        mesh_use_embedded_materials=False,
    )


def _palette(make) -> dict:
    """(side, observed) -> colour message; shared by all points, which is what makes many points cheap."""
    return {key: _colour(make, rgb, alpha) for key, rgb, alpha in _tones()}


def _tones():
    """(side, observed), its colour, its opacity."""
    for side, rgb in SIDE_COLOURS.items():
        yield (side, True), rgb, _OBSERVED_ALPHA
        yield (side, False), rgb, _HIDDEN_ALPHA


def _annotation(make, header, kind: int, pixels: np.ndarray, colours: list, thickness: float):
    # The origin is the corner of the first pixel there, its middle in CameraInfo.
    corner = (pixels + 0.5).tolist()
    return make(
        "foxglove_msgs/msg/PointsAnnotation",
        timestamp=header.stamp,
        type=kind,
        points=[make("foxglove_msgs/msg/Point2", x=x, y=y) for x, y in corner],
        outline_colors=colours,
        thickness=thickness,
    )


def _colours(palette: dict, sides, observed: np.ndarray) -> list:
    """One colour a point; `sides` is of one person and repeats for each."""
    return [palette[str(sides[index % len(sides)]), seen] for index, seen in enumerate(observed.tolist())]


def _colour(make, rgb, alpha: float, kind: str = "std_msgs/msg/ColorRGBA"):
    return make(kind, r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def _point(make, xyz):
    return make("geometry_msgs/msg/Point", x=xyz[0], y=xyz[1], z=xyz[2])


def _vector(make, x: float, y: float, z: float):
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(make, x: float = 0.0, y: float = 0.0, z: float = 0.0, w: float = 1.0):
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
