# SPDX-License-Identifier: Apache-2.0
"""The outputs: which messages a frame becomes, and how each is built."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from msg_adapters import Intrinsics, Keypoints2D, outputs
from msg_adapters.cdr import CloudWriter, PoseArrayWriter
from msg_adapters.factory import MessageFactory
from paul_ros.body_axes import ContinuousSigns
from paul_ros.stream.frame import Frame

Attitudes = Callable[[], np.ndarray]
"""Returns (N,4) quaternions of the body axes; not called by outputs that have no attitudes."""


@dataclass(frozen=True)
class Packed:
    """A way to build an output as serialised bytes, at about a tenth of the cost.

    Attributes:
        writer: makes a writer(header, values) -> bytes, one for each output that is published.
        values: what the writer gets of a frame.
    """

    writer: Callable[[], Callable[[Any, np.ndarray], bytes]]
    values: Callable[[Frame], np.ndarray]


@dataclass(frozen=True)
class Output:
    """One output topic of the node.

    Attributes:
        name: name in this package, and of the topic below the node's name in bags.
        message_type: type of its messages.
        build: makes the message object of a frame; persons that were not lifted are left out.
        topic: of the node.
        packed: how to build serialised bytes instead; None = only as an object.
        optional: whether the node runs without the message package.
        parameter: boolean parameter that asks for this output; '' = none is needed.
    """

    name: str
    message_type: str
    build: Callable[[MessageFactory, Frame, Attitudes], Any]
    topic: str
    packed: Packed | None = None
    optional: bool = False
    parameter: str = ""


def _poses(make: MessageFactory, frame: Frame, _: Attitudes) -> Any:
    return outputs.pose_array(make, frame.header, _lifted_points(frame))


def _bodies(make: MessageFactory, frame: Frame, attitudes: Attitudes) -> Any:
    ok = frame.lifted.ok
    return outputs.body_array(make, frame.header, frame.lifted.root[ok], attitudes()[ok])


def _persons(make: MessageFactory, frame: Frame, attitudes: Attitudes) -> Any:
    ok = frame.lifted.ok
    ids = [ident for ident, good in zip(frame.keypoints.ids, ok) if good]
    return outputs.named_poses(make, frame.header, ids, frame.lifted.root[ok], attitudes()[ok])


def _keypoints3d(make: MessageFactory, frame: Frame, _: Attitudes) -> Any:
    return outputs.points_cloud(make, frame.header, *_point_columns(frame))


def _markers(make: MessageFactory, frame: Frame, _: Attitudes) -> Any:
    ok, layout = frame.lifted.ok, frame.layout
    points, visible = frame.lifted.points[ok], frame.keypoints.visible[ok]
    return outputs.skeleton_markers(make, frame.header, points, visible, layout.edges, layout.sides, frame.bone_width)


def _transforms(make: MessageFactory, frame: Frame, attitudes: Attitudes) -> Any:
    # Frames are in metres (REP-103), so persons in model units have none. Listeners of tf2 need a stamp and a parent.
    metric = frame.metric & bool(frame.keypoints.stamp and frame.header.frame_id)
    ids = [ident for ident, good in zip(frame.keypoints.ids, metric) if good]
    return outputs.body_transforms(make, frame.header, ids, frame.lifted.root[metric], attitudes()[metric])


def _annotations(make: MessageFactory, frame: Frame, _: Attitudes) -> Any:
    metric, layout = frame.metric, frame.layout
    pixels = project(frame.lifted.points[metric], frame.camera)
    visible = frame.keypoints.visible[metric]
    return outputs.image_annotations(make, frame.header, pixels, visible, layout.edges, layout.sides)


def _lifted_points(frame: Frame) -> np.ndarray:
    return frame.lifted.points[frame.lifted.ok]


def _point_columns(frame: Frame) -> tuple[np.ndarray, ...]:
    """Return points, confidence, numbers of ids, ambiguity and distance_sigma of the lifted persons."""
    lifted, ok = frame.lifted, frame.lifted.ok
    numbers = frame.person_numbers[ok]
    return lifted.points[ok], frame.keypoints.confidence[ok], numbers, lifted.ambiguity[ok], lifted.distance_sigma[ok]


def _point_values(frame: Frame) -> np.ndarray:
    return outputs.point_values(*_point_columns(frame))


def image_pixels(keypoints: Keypoints2D, camera: Intrinsics | None) -> np.ndarray:
    """Return keypoints that the stream has undistorted as pixels (N,P,2) of their own image, raw or rectified."""
    return keypoints.xy if camera is None else camera.to_image(keypoints.xy)


def project(points: np.ndarray, camera: Intrinsics | None) -> np.ndarray:
    """Project points (...,3) of the camera's frame to pixels (...,2) of the keypoints' image, raw or rectified.

    They are NaN behind the camera, where the lens shows nothing, and without a camera.
    """
    pixels = np.full((*points.shape[:-1], 2), np.nan)
    if camera is None:
        return pixels
    ahead = points[..., 2] > 0
    x, y, z = points[ahead].T
    pinhole = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    pixels[ahead] = camera.to_image(pinhole)
    return pixels


_TABLE = (
    Output("poses", "geometry_msgs/msg/PoseArray", _poses, "~/poses", Packed(PoseArrayWriter, _lifted_points)),
    Output("bodies", "geometry_msgs/msg/PoseArray", _bodies, "~/bodies"),
    Output("persons", "sensor_msgs/msg/MultiDOFJointState", _persons, "~/persons"),
    Output(
        "keypoints3d",
        "sensor_msgs/msg/PointCloud2",
        _keypoints3d,
        "~/keypoints3d",
        Packed(functools.partial(CloudWriter, outputs.POINT_FIELDS), _point_values),
    ),
    Output("markers", "visualization_msgs/msg/MarkerArray", _markers, "~/markers"),
    Output("transforms", "tf2_msgs/msg/TFMessage", _transforms, "/tf", optional=True, parameter="publish_tf"),
    Output("annotations", "foxglove_msgs/msg/ImageAnnotations", _annotations, "~/annotations", optional=True),
)

OUTPUTS: dict[str, Output] = {output.name: output for output in _TABLE}
"""Name -> Output, all of them."""

STANDARD = tuple(output.name for output in _TABLE if not output.optional)
"""Names of the outputs that every node and every replay has."""


class MessageBuilder:
    """Builds the output messages of frames that follow each other.

    q and -q are one attitude. The builder keeps each person's quaternion sign continuous over the frames that it builds
    attitudes for, so one stream of frames needs one builder.
    """

    def __init__(
        self, make: MessageFactory, packed: bool = False, convert_header: Callable[[Any], Any] = lambda header: header
    ) -> None:
        """Make a builder.

        Args:
            make: factory of message objects.
            packed: whether outputs that have a packed form are built as bytes.
            convert_header: converts a frame's header for message objects, if `make` needs one of its own family.
        """
        self._make = make
        self._convert_header = convert_header
        self._continuous_signs = ContinuousSigns()
        self._writers = {
            name: (output.packed.writer(), output.packed.values)
            for name, output in OUTPUTS.items()
            if packed and output.packed
        }

    def messages(self, frame: Frame, names: Iterable[str] = STANDARD) -> dict[str, Any]:
        """Build the outputs of these names; name -> message object, or bytes."""
        names = list(names)
        built: dict[str, Any] = {}
        for name in names:
            if name in self._writers:
                writer, values = self._writers[name]
                built[name] = writer(frame.header, values(frame))
        if len(built) < len(names):
            # All outputs of a frame share one settlement of the signs.
            attitudes = functools.cache(lambda: self._continuous_signs(frame.keypoints.ids, frame.attitudes))
            with_header = replace(frame, header=self._convert_header(frame.header))
            built |= {
                name: OUTPUTS[name].build(self._make, with_header, attitudes) for name in names if name not in built
            }
        return built
