# SPDX-License-Identifier: Apache-2.0
"""Convert arrays to messages, for rclpy's classes and rosbags' dataclasses alike.

Every writer takes a message factory `make` and a std_msgs/Header of the same family, which becomes the message's
header. N is the number of persons, P the number of keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from msg_adapters.factory import MessageFactory
from msg_adapters.palette import SIDE_COLOURS, rgb

#: Fields of the cloud of 3D keypoints.
POINT_FIELDS = ("x", "y", "z", "confidence", "keypoint", "person_id", "ambiguity", "distance_sigma")
_FLOAT32 = 7
_SPHERE_LIST, _LINE_LIST = 7, 5
_ANNOTATED_POINTS, _ANNOTATED_LINES = 1, 4
_ADD, _DELETE = 0, 2
_MARKER_SECONDS = 1
#: float32 holds every whole number up to this one.
_LARGEST_ID = 2**24
_OBSERVED_ALPHA, _HIDDEN_ALPHA = 1.0, 0.3
_COLOUR, _FOXGLOVE_COLOUR = "std_msgs/msg/ColorRGBA", "foxglove_msgs/msg/Color"

#: Pairs of keypoint indices.
Edges = np.ndarray | Sequence[Sequence[int]]
#: N ids as text ('' = unknown), or N numbers from `id_numbers`.
Ids = np.ndarray | Sequence[object]
#: (side, observed) -> colour message.
_Palette = dict[tuple[str, bool], Any]


def pose_array(make: MessageFactory, header: Any, points: np.ndarray) -> Any:
    """Make a geometry_msgs/PoseArray of points (N, P, 3), one person after the other, with identity orientation."""
    identity = _quaternion(make)
    poses = [
        make("geometry_msgs/msg/Pose", position=_point(make, xyz), orientation=identity)
        for xyz in points.reshape(-1, 3).tolist()
    ]
    return make("geometry_msgs/msg/PoseArray", header=header, poses=poses)


def body_array(make: MessageFactory, header: Any, positions: np.ndarray, quaternions: np.ndarray) -> Any:
    """Make a geometry_msgs/PoseArray with one pose per person: positions (N, 3), quaternions (N, 4) as x, y, z, w."""
    poses = [
        make("geometry_msgs/msg/Pose", position=_point(make, xyz), orientation=_quaternion(make, *xyzw))
        for xyz, xyzw in zip(positions.tolist(), quaternions.tolist())
    ]
    return make("geometry_msgs/msg/PoseArray", header=header, poses=poses)


def named_poses(
    make: MessageFactory, header: Any, ids: Sequence[str], positions: np.ndarray, quaternions: np.ndarray
) -> Any:
    """Make a sensor_msgs/MultiDOFJointState: a name and a pose for each person.

    Args:
        make: message factory.
        header: std_msgs/Header.
        ids: N ids, '' = unknown.
        positions: (N, 3).
        quaternions: (N, 4) as x, y, z, w.
    """
    return make(
        "sensor_msgs/msg/MultiDOFJointState",
        header=header,
        joint_names=list(ids),
        transforms=_transforms(make, positions, quaternions),
        twist=[],
        wrench=[],
    )


def keypoints_cloud(make: MessageFactory, header: Any, xy: np.ndarray, confidence: np.ndarray, person_ids: Ids) -> Any:
    """Make the native cloud of 2D keypoints: organised, height = persons, width = keypoints.

    Args:
        make: message factory.
        header: std_msgs/Header.
        xy: (N, P, 2) pixels, NaN = missing.
        confidence: (N, P).
        person_ids: N ids.
    """
    persons, points = confidence.shape
    ids = np.broadcast_to(id_numbers(person_ids)[:, None], (persons, points))
    return _cloud(make, header, ("x", "y", "confidence", "person_id"), [xy[..., 0], xy[..., 1], confidence, ids])


def points_cloud(
    make: MessageFactory,
    header: Any,
    points: np.ndarray,
    confidence: np.ndarray,
    ids: Ids,
    ambiguity: np.ndarray,
    distance_sigma: np.ndarray,
) -> Any:
    """Make an organised cloud of 3D keypoints, height = persons, width = keypoints, with the fields POINT_FIELDS.

    See `point_values` for the arguments.
    """
    values = point_values(points, confidence, ids, ambiguity, distance_sigma)
    return _cloud(make, header, POINT_FIELDS, list(np.moveaxis(values, -1, 0)))


def point_values(
    points: np.ndarray, confidence: np.ndarray, ids: Ids, ambiguity: np.ndarray, distance_sigma: np.ndarray
) -> np.ndarray:
    """Return (N, P, 8) float32 in the order of POINT_FIELDS.

    The field keypoint is the keypoint's index. The last three fields are equal for all points of a person.

    Args:
        points: (N, P, 3) in the camera's optical frame.
        confidence: (N, P), 0 for keypoints that were not observed.
        ids: N ids.
        ambiguity: (N,), 0 to 1.
        distance_sigma: (N,) metres, NaN if unknown.
    """
    values = np.empty((*confidence.shape, len(POINT_FIELDS)), "<f4")
    values[..., :3] = points
    values[..., 3] = confidence
    values[..., 4] = np.arange(confidence.shape[1])
    for column, each in enumerate((id_numbers(ids), ambiguity, distance_sigma), 5):
        values[..., column] = np.asarray(each)[:, None]
    return values


def skeleton_markers(
    make: MessageFactory,
    header: Any,
    points: np.ndarray,
    observed: np.ndarray,
    edges: Edges,
    sides: Sequence[str],
    thickness: float,
) -> Any:
    """Make a visualization_msgs/MarkerArray of all persons: a LINE_LIST of bones and a SPHERE_LIST of keypoints.

    A bone has the colour of a side if both its ends have that side. Without persons both markers are deleted: viewers
    complain about empty lists.

    Args:
        make: message factory.
        header: std_msgs/Header.
        points: (N, P, 3).
        observed: (N, P) bool; hidden points are faint.
        edges: pairs of keypoint indices.
        sides: P of 'left', 'right', ''.
        thickness: of a bone, in the units of the points.
    """
    edges = np.asarray(edges, dtype=int).reshape(-1, 2)
    palette = _palette(make, _COLOUR)
    bones = points[:, edges].reshape(-1, 3)
    bone_colours = _colours(palette, _bone_sides(edges, sides), np.all(observed[:, edges], axis=-1), ends=2)
    lines = _marker(make, header, 0, "bones", _LINE_LIST, thickness, bones, bone_colours)
    point_colours = _colours(palette, sides, observed)
    spheres = _marker(make, header, 1, "keypoints", _SPHERE_LIST, 2 * thickness, points.reshape(-1, 3), point_colours)
    return make("visualization_msgs/msg/MarkerArray", markers=[lines, spheres])


def body_transforms(
    make: MessageFactory, header: Any, ids: Sequence[str], positions: np.ndarray, quaternions: np.ndarray
) -> Any:
    """Make a tf2_msgs/TFMessage from the header's frame to body_ID (REP-155) for every person with an id.

    Args:
        make: message factory.
        header: std_msgs/Header.
        ids: N ids, '' = unknown.
        positions: (N, 3) metres.
        quaternions: (N, 4) as x, y, z, w.
    """
    kind = "geometry_msgs/msg/TransformStamped"
    transforms = [
        make(kind, header=header, child_frame_id=f"body_{ident}", transform=transform)
        for ident, transform in zip(ids, _transforms(make, positions, quaternions))
        if ident
    ]
    return make("tf2_msgs/msg/TFMessage", transforms=transforms)


def image_annotations(
    make: MessageFactory,
    header: Any,
    pixels: np.ndarray,
    observed: np.ndarray,
    edges: Edges,
    sides: Sequence[str],
) -> Any:
    """Make foxglove_msgs/ImageAnnotations: bones and keypoints of all persons for the camera's image.

    Only the field `points` is set. The others stay empty, and differ between releases of the package.

    Args:
        make: message factory.
        header: std_msgs/Header.
        pixels: (N, P, 2), NaN for points not to draw. Whole numbers are at the middle of a pixel, as in CameraInfo.
        observed: (N, P) bool; hidden points are faint.
        edges: pairs of keypoint indices.
        sides: P of 'left', 'right', ''.
    """
    edges = np.asarray(edges, dtype=int).reshape(-1, 2)
    palette = _palette(make, _FOXGLOVE_COLOUR)
    ends = pixels[:, edges]
    bones_drawn = np.isfinite(ends).all(axis=(2, 3))
    bones_observed = np.all(observed[:, edges], axis=-1)
    bone_sides = _bone_sides(edges, sides)
    bone_colours = [palette[bone_sides[bone], bool(bones_observed[n, bone])] for n, bone in np.argwhere(bones_drawn)]
    points_drawn = np.isfinite(pixels).all(axis=2)
    point_colours = [palette[str(sides[point]), bool(observed[n, point])] for n, point in np.argwhere(points_drawn)]
    lines = _annotation(make, header, _ANNOTATED_LINES, ends[bones_drawn].reshape(-1, 2), bone_colours, 2.0)
    dots = _annotation(make, header, _ANNOTATED_POINTS, pixels[points_drawn], point_colours, 6.0)
    return make("foxglove_msgs/msg/ImageAnnotations", points=[lines, dots])


def id_numbers(ids: Ids) -> np.ndarray:
    """Return person ids as numbers that a float32 field can hold; an array of numbers is returned as it is.

    The number is -1, unknown, for an id that is not a whole number, and for one above 2^24: two persons could share its
    rounded value.
    """
    return ids if isinstance(ids, np.ndarray) else np.array([_id_number(str(text)) for text in ids], np.float32)


def _id_number(text: str) -> int:
    # Check the length first: Python refuses to convert thousands of digits.
    known = text.isdecimal() and len(text) <= len(str(_LARGEST_ID)) and int(text) <= _LARGEST_ID
    return int(text) if known else -1


def _cloud(make: MessageFactory, header: Any, names: tuple[str, ...], columns: list[np.ndarray]) -> Any:
    """Make an organised float32 PointCloud2 of columns, each (height, width)."""
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


def _bone_sides(edges: np.ndarray, sides: Sequence[str]) -> list[str]:
    """Return the side of each bone: that of both its ends, or '' if they differ."""
    return [str(sides[a]) if sides[a] == sides[b] else "" for a, b in edges]


def _marker(
    make: MessageFactory, header: Any, index: int, name: str, kind: int, size: float, points: np.ndarray, colours: list
) -> Any:
    """Make one marker of a list type. It expires if no further frame comes."""
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
        color=_colour(make, _COLOUR, SIDE_COLOURS[""], _OBSERVED_ALPHA),
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


def _palette(make: MessageFactory, kind: str) -> _Palette:
    """Return (side, observed) -> colour message. All points share these messages, so many points are cheap."""
    alphas = {True: _OBSERVED_ALPHA, False: _HIDDEN_ALPHA}
    return {
        (side, observed): _colour(make, kind, colour, alpha)
        for side, colour in SIDE_COLOURS.items()
        for observed, alpha in alphas.items()
    }


def _colours(palette: _Palette, sides: Sequence[str], observed: np.ndarray, ends: int = 1) -> list:
    """Return the colours of all persons, `ends` for each of the parts with these sides; observed (N, parts)."""
    rows = observed.tolist()
    return [palette[str(side), seen] for row in rows for side, seen in zip(sides, row) for _ in range(ends)]


def _annotation(
    make: MessageFactory, header: Any, kind: int, pixels: np.ndarray, colours: list, thickness: float
) -> Any:
    # Foxglove's origin is the corner of the first pixel, CameraInfo's its middle.
    corner = (pixels + 0.5).tolist()
    return make(
        "foxglove_msgs/msg/PointsAnnotation",
        timestamp=header.stamp,
        type=kind,
        points=[make("foxglove_msgs/msg/Point2", x=x, y=y) for x, y in corner],
        outline_colors=colours,
        thickness=thickness,
    )


def _colour(make: MessageFactory, kind: str, colour: str, alpha: float) -> Any:
    red, green, blue = rgb(colour)
    return make(kind, r=red, g=green, b=blue, a=alpha)


def _transforms(make: MessageFactory, positions: np.ndarray, quaternions: np.ndarray) -> list[Any]:
    """Return a geometry_msgs/Transform for each position (N, 3) and quaternion (N, 4)."""
    return [
        make("geometry_msgs/msg/Transform", translation=_vector(make, *xyz), rotation=_quaternion(make, *xyzw))
        for xyz, xyzw in zip(positions.tolist(), quaternions.tolist())
    ]


def _point(make: MessageFactory, xyz: Sequence[float]) -> Any:
    return make("geometry_msgs/msg/Point", x=xyz[0], y=xyz[1], z=xyz[2])


def _vector(make: MessageFactory, x: float, y: float, z: float) -> Any:
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(make: MessageFactory, x: float = 0.0, y: float = 0.0, z: float = 0.0, w: float = 1.0) -> Any:
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
