# SPDX-License-Identifier: Apache-2.0
"""The one path from a 2D keypoint message to 3D messages; node and replay are thin shells over it.

message -> adapter -> confidence threshold -> model's layout -> Lifter -> output layout -> messages. Nothing a message
holds may stop the stream: what cannot be used is dropped, counted by its reason and explained.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

import msg_adapters
from msg_adapters import Intrinsics, Keypoints2D, MessageError, Source, WrongPointCount, outputs
from msg_adapters.cdr import CloudReader, CloudWriter, PoseArrayWriter
from paul_ros.body_axes import ContinuousSigns, body_rotations, left_and_up, quaternions
from paul_ros.layout import Layout, layout_names, load_layout
from paul_ros.lifted import BEHIND_CAMERA, DEGENERATE_POINTS, MAX_DISTANCE, TOO_FAR, TOO_FEW_POINTS, Lifted
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.route import MODEL, Route
from paul_ros.stream.depth import SURFACE, Depths
from paul_ros.stream.parameters import checked
from paul_ros.stream.route import read_unknown
from paul_ros.stream.smoothing import OneEuro

#: Lift times kept for the median and the 99th percentile: the last half minute at 30 Hz.
_TIMES_KEPT = 1000
#: Bones are drawn this wide, as a share of the mean shape's largest extent.
_BONE_WIDTH = 0.01
#: A person of whom more is not explained is noted. In the bags at most 0.37 is, with noise of 5 % of the height 0.42;
#: of COCO's points taken for Human3.6M's, or the other way round, more than 0.5 of 97 % of the persons.
_UNLIKE = 0.5
#: Why a person is left out.
_LEFT_OUT = {
    TOO_FEW_POINTS: "too few of its keypoints are visible",
    DEGENERATE_POINTS: "its keypoints lie on one line, in two places or within about a pixel",
    TOO_FAR: f"it would stand more than {MAX_DISTANCE:.0f} m away; if it does not, check camera_info",
    BEHIND_CAMERA: "it would stand beside or behind the camera; check camera_info and the layout of the keypoints",
}
#: Why depth images are of no use.
_DEPTH_UNUSED = {
    "depth_of_another_size": "depth images have not the size that CameraInfo tells, so they are not aligned to the "
    "image of the keypoints and are not used; remap `depth` to the images that are",
    "depth_of_another_time": "no depth image within 20 ms of the keypoints' stamp had come before them, so distances "
    "are not measured there; is `depth` of the same clock, and as often?",
}

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """One lifted message.

    header: the input's own header; keypoints: its N persons, hidden what was not used; lifted: their 3D, both in the
    layout of the output; given: the keypoints in the model's layout, low confidences hidden; bone_width in the units of
    the points; camera: its intrinsics, None where they are not known; axes: works out the attitudes.
    """

    header: object
    keypoints: Keypoints2D
    lifted: Lifted
    layout: Layout
    given: Keypoints2D
    bone_width: float
    camera: Intrinsics | None
    axes: Callable[[], np.ndarray]

    @functools.cached_property
    def attitudes(self) -> np.ndarray:
        """(N,4) quaternions of the body axes, worked out only where somebody listens to them."""
        return self.axes()

    def message(self, output: str, make):
        """One output message by name, of OUTPUTS or OPTIONAL; persons that were not lifted are left out."""
        return getattr(self, "_" + output)(make, self.lifted.ok)

    def serialised(self, output: str, writer) -> bytes:
        """The same, of PACKED, as the bytes that `writer`, one of its own for each output, makes of it."""
        ok = self.lifted.ok
        values = self.lifted.points[ok] if output == "poses" else outputs.point_values(*self._points(ok))
        return writer(self.header, values)

    def messages(self, make) -> dict:
        """All output messages by name."""
        return {output: self.message(output, make) for output in OUTPUTS}

    def _poses(self, make, ok: np.ndarray):
        return outputs.pose_array(make, self.header, self.lifted.points[ok])

    def _bodies(self, make, ok: np.ndarray):
        return outputs.body_array(make, self.header, self.lifted.root[ok], self.attitudes[ok])

    def _keypoints3d(self, make, ok: np.ndarray):
        return outputs.points_cloud(make, self.header, *self._points(ok))

    def _points(self, ok: np.ndarray) -> tuple:
        # An id that is no number becomes its row of the input, so rows are numbered before any is left out.
        ids = outputs.id_numbers(self.keypoints.ids)[ok]
        lifted = self.lifted
        return lifted.points[ok], self.keypoints.confidence[ok], ids, lifted.ambiguity[ok], lifted.distance_sigma[ok]

    def _markers(self, make, ok: np.ndarray):
        return outputs.skeleton_markers(
            make,
            self.header,
            self.lifted.points[ok],
            self.keypoints.visible[ok],
            self.layout.edges,
            self.layout.sides,
            self.bone_width,
        )

    def _transforms(self, make, ok: np.ndarray):
        # Frames are in metres (REP-103): of model units there are none.
        ok = ok & (self.lifted.units == "m")
        ids = [ident for ident, good in zip(self.keypoints.ids, ok) if good]
        return outputs.body_transforms(make, self.header, ids, self.lifted.root[ok], self.attitudes[ok])

    def _annotations(self, make, ok: np.ndarray):
        ok = ok & (self.lifted.units == "m")
        pixels = project(self.lifted.points[ok], self.camera)
        visible, layout = self.keypoints.visible[ok], self.layout
        return outputs.image_annotations(make, self.header, pixels, visible, layout.edges, layout.sides)


#: Output name -> type name of its message.
OUTPUTS = {
    "poses": "geometry_msgs/msg/PoseArray",
    "bodies": "geometry_msgs/msg/PoseArray",
    "keypoints3d": "sensor_msgs/msg/PointCloud2",
    "markers": "visualization_msgs/msg/MarkerArray",
}

#: Outputs that can be had serialised, which costs a tenth -> what makes a writer of them.
PACKED = {"poses": PoseArrayWriter, "keypoints3d": functools.partial(CloudWriter, outputs.POINT_FIELDS)}

#: The same of those that the node publishes only where it is asked to, or has the package.
OPTIONAL = {
    "transforms": "tf2_msgs/msg/TFMessage",
    "annotations": "foxglove_msgs/msg/ImageAnnotations",
}


def project(points: np.ndarray, camera: Intrinsics | None) -> np.ndarray:
    """Points (...,3) of the camera's frame as pixels (...,2); NaN for those behind it, and without a camera."""
    pixels = np.full((*points.shape[:-1], 2), np.nan)
    if camera is None:
        return pixels
    ahead = points[..., 2] > 0
    x, y, z = points[ahead].T
    pixels[ahead] = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    return pixels


def open_stream(model: str | None = None, layout: str | None = None, **parameters) -> LiftStream:
    """The stream of the node's parameters; one that is left out, or None, has its default.

    Raises ModelError, LayoutError, ParameterError.
    """
    given = {"model": model, "layout": layout, **parameters}
    values = checked({name: value for name, value in given.items() if value is not None})
    loaded = load_model(values["model"])
    output = values["output_layout"]
    return LiftStream(
        Lifter(loaded, values["person_height"]),
        load_layout(values["layout"]) if values["layout"] else None,
        values["min_confidence"],
        values["max_persons"],
        loaded.layout if output == MODEL else load_layout(output) if output else None,
        values["smoothing"],
    )


class LiftStream:
    """Lifts a stream of 2D keypoint messages, one image at a time and, unless `smoothing` is set, each for itself.

    Of most types a message is an image. Where it is one person, those of one stamp are lifted together as soon as a
    message of another stamp tells that they are all, or flush() does.

    counts: frames, persons, lifted. drops: reason -> how many messages, or persons ('person_...').
    notes: what was odd but used, as 'stamp_backwards'. explanations: reason -> what to do about the last one.
    lift_us: the last lift times in microseconds, of frames with persons.
    """

    def __init__(
        self,
        lifter: Lifter,
        layout: Layout | None,
        min_confidence: float,
        max_persons: int,
        output_layout: Layout | None = None,
        smoothing: float = 0.0,
    ) -> None:
        """layout: of the messages, None = found from the first that shows somebody; output_layout: see Route.between.

        smoothing: see OneEuro.

        Raises LayoutError where these cannot be had from each other.
        """
        self.lifter = lifter
        self.min_confidence = min_confidence
        self.max_persons = max_persons
        self.intrinsics: Intrinsics | None = None
        self.counts: Counter = Counter(frames=0, persons=0, lifted=0)
        self.drops: Counter = Counter()
        self.notes: Counter = Counter()
        self.explanations: dict[str, str] = {}
        self.lift_us: deque[float] = deque(maxlen=_TIMES_KEPT)
        self._known = Route.between(layout, lifter.model.layout, output_layout) if layout else None
        # Until the input's layout is known there are only empty frames.
        self._nobody = Route.between(lifter.model.layout, lifter.model.layout, output_layout)
        self._output_layout = output_layout
        self._last_stamp: int | None = None
        self._image_size: tuple[int, int] | None = None
        self._camera_frame = ""
        self._gathered = _Gathered()
        self._measures, self._steady = left_and_up(lifter.model.layout), ContinuousSigns()
        self._bone_width = _BONE_WIDTH * float(np.ptp(lifter.model.mean_shape, axis=1).max())
        self._filter = OneEuro(smoothing)
        self._depths = Depths()
        self._cloud = CloudReader()

    @property
    def route(self) -> Route:
        """The layouts that points go through; as if the input had the model's own until its layout is known."""
        return self._known or self._nobody

    @property
    def person_height(self) -> float:
        """The lifter's. Setting raises ParameterError for a height of nobody, ModelError where the model has none."""
        return self.lifter.person_height

    @person_height.setter
    def person_height(self, height: float) -> None:
        checked({"person_height": height})
        self.lifter.person_height = height

    @property
    def smoothing(self) -> float:
        """Cut-off of the filter over time in Hz, 0 = off."""
        return self._filter.cutoff

    @smoothing.setter
    def smoothing(self, cutoff: float) -> None:
        self._filter.cutoff = cutoff

    @property
    def units(self) -> str:
        """'m' once the intrinsics are known and the model knows its size, else 'model'."""
        metric = self.intrinsics is not None and self.lifter.model.metres_per_unit is not None
        return "m" if metric else "model"

    def take_over(self, before: LiftStream) -> None:
        """Goes on where another stream stopped: camera, depth images and counts are those of before."""
        self.intrinsics, self._image_size = before.intrinsics, before._image_size
        self._camera_frame = before._camera_frame
        self._depths, self._steady, self._last_stamp = before._depths, before._steady, before._last_stamp
        self.counts, self.drops, self.notes = before.counts, before.drops, before.notes
        self.explanations, self.lift_us = before.explanations, before.lift_us

    def camera_info(self, msg) -> None:
        """Takes the intrinsics; of an unusable CameraInfo nothing is taken and the drop is counted."""
        with self.guard():
            # A camera that is not calibrated has a size and a frame too.
            self._image_size, self._camera_frame = (int(msg.width), int(msg.height)), str(msg.header.frame_id)
            self.intrinsics = msg_adapters.read_camera_info(msg)
            if self.intrinsics.distorted:
                self.notes["distorted_image"] += 1
                self.explanations["distorted_image"] = (
                    "CameraInfo has distortion but no P, so K is used: positions are a little wrong unless the "
                    "keypoints are of an undistorted image; let the camera's driver fill P and rectify the image"
                )

    def depth(self, msg) -> None:
        """Keeps a depth image; an unusable one is a counted drop."""
        with self.guard():
            self._depths.add(msg_adapters.read_depth(msg))

    def keypoints(self, type_name: str, msg, topic: str = "") -> Frame | None:
        """Lifts one message, or the bytes of a PointCloud2; None = dropped, counted and explained.

        Zero persons are a frame too.
        A message of one person is kept, which gives None too, or the frame of the image before.
        topic: that it came from; some families have the person's id there.
        """
        with self.guard():
            if isinstance(msg, bytes):
                msg = self._cloud(msg)
            keypoints = self._read(type_name, msg, topic)
            header = _optical(msg.header, keypoints.frame_id)
            # Without a stamp nothing tells which persons are of one image.
            if type_name in msg_adapters.ONE_PERSON and keypoints.stamp:
                return self._gather(header, keypoints)
            return self._frame(header, keypoints)
        return None

    def flush(self) -> Frame | None:
        """Lifts the persons that are kept, when no more will come; None where there are none."""
        with self.guard():
            if self._gathered.parts:
                return self._frame(*self._gathered.take())
        return None

    def _gather(self, header, keypoints: Keypoints2D) -> Frame | None:
        """Keeps one person; the frame of those of the image before, where this one tells that they are all."""
        complete = None
        if self._gathered.takes(keypoints):
            self._check_persons(len(self._gathered.parts) + keypoints.persons)
        else:
            complete = self._gathered.take()
        self._gathered.add(header, keypoints)
        return self._frame(*complete) if complete else None

    @contextlib.contextmanager
    def guard(self):
        """The one place where what goes wrong with a message becomes a counted drop."""
        try:
            yield
        except WrongPointCount as error:
            self._drop(error.reason, f"{error}; {_layout_advice(error)}")
        except MessageError as error:
            self._drop(error.reason, str(error))
        except Exception as error:
            if not self.drops["internal_error"]:
                _log.exception("a message could not be lifted; this is a fault of paul_ros, please report it")
            self._drop("internal_error", f"{type(error).__name__}: {error}")

    def describe(self) -> dict:
        """What the outputs mean, for ~/layout and the head of a report."""
        model, layout = self.lifter.model, self.route.output
        return {
            "layout": layout.name,
            "keypoints": list(layout.names),
            "edges": [list(edge) for edge in layout.edges],
            "sides": list(layout.sides),
            "input_layout": self.route.given.name if self._known else None,
            "model_layout": model.layout.name,
            "units": self.units,
            "frame": "header.frame_id of the input, an optical frame (REP-103): x right, y down, z forward",
            "scale_source": _scale_source(self.intrinsics, model.metres_per_unit),
            "person_height": self.person_height or model.stature,
            "size_spread": self.lifter.size_spread,
            "smoothing_hz": self.smoothing,
            "chirality": model.header.get("chirality"),
            "model": model.name,
            "model_sha256": model.sha256,
            "metres_per_unit": self.lifter.metres_per_unit,
        }

    def _read(self, type_name: str, msg, topic: str) -> Keypoints2D:
        """In the model's layout."""
        route = self.route
        source = Source(route.given.names, self._image_size, topic, self._camera_frame)
        if self._known:
            keypoints = msg_adapters.read(type_name, msg, len(source.names), source)
            self._check_persons(keypoints.persons)
        else:
            keypoints, found = read_unknown(self.lifter.model.layout, type_name, msg, source)
            self._check_persons(keypoints.persons)
            route = Route.between(found, self.lifter.model.layout, self._output_layout)
            if keypoints.visible.any():
                self._known = route
        return route.keypoints_in(keypoints, self.min_confidence)

    def _check_persons(self, persons: int) -> None:
        if persons > self.max_persons:
            raise MessageError(
                "too_many_persons",
                f"{persons} persons in one image; if that is "
                f"right, raise the parameter `max_persons` above {self.max_persons}",
            )

    def _frame(self, header, given: Keypoints2D) -> Frame:
        # Time may run backwards, as when a bag loops; it is only noted.
        if self._last_stamp is not None and given.stamp < self._last_stamp:
            self.notes["stamp_backwards"] += 1
        self._last_stamp = given.stamp
        self._note_frame(given.frame_id)
        lifted = self._lift(given)
        self.counts.update(frames=1, persons=given.persons, lifted=int(lifted.ok.sum()))
        for reason in filter(None, lifted.reason):
            self._drop("person_" + reason, f"{_LEFT_OUT[reason]}; this person is left out of the outputs")
        self._note_unlike(int((lifted.unexplained > _UNLIKE).sum()))
        model, route = self.lifter.model, self.route
        # What is no person has its root anywhere, on its skin for all that is known.
        surface = SURFACE if model.stature else 0.0
        lifted, said = self._depths.place(lifted, given.stamp, self.intrinsics, surface)
        if said:
            self.notes += Counter(said)
            self.explanations.update({what: _DEPTH_UNUSED[what] for what in said.keys() & _DEPTH_UNUSED.keys()})
        lifted = self._filter(given.ids, given.stamp, lifted, model.layout.root)
        unit = self.lifter.metres_per_unit if lifted.units == "m" else 1.0
        visible = np.where(lifted.ok[:, None], lifted.used, given.visible)
        used = replace(given, visible=visible, confidence=np.where(visible, given.confidence, 0.0))
        return Frame(
            header,
            route.keypoints_out(used),
            route.lifted_out(lifted),
            route.output,
            given,
            self._bone_width * unit,
            self.intrinsics,
            functools.partial(self._attitudes, given.ids, lifted),
        )

    def _attitudes(self, ids: tuple[str, ...], lifted: Lifted) -> np.ndarray:
        """Quaternions (N,4) of persons in the model's layout; signs are steady over the frames that are asked for."""
        return self._steady(ids, quaternions(body_rotations(lifted.points, lifted.rotation, self._measures)))

    def _lift(self, keypoints: Keypoints2D) -> Lifted:
        start = time.perf_counter_ns()
        lifted = self.lifter.lift(keypoints.xy, keypoints.visible, self.intrinsics)
        if keypoints.persons:
            self.lift_us.append((time.perf_counter_ns() - start) / 1000)
        return lifted

    def _note_frame(self, frame_id: str) -> None:
        """Image and CameraInfo of one camera have one frame, its optical one (REP-104): another is not that."""
        if self._camera_frame and frame_id != self._camera_frame:
            self.notes["another_frame"] += 1
            self.explanations["another_frame"] = (
                f"the keypoints' frame_id is {frame_id!r}, CameraInfo's {self._camera_frame!r}: is it of their camera? "
                "What is published has the keypoints' frame_id and the axes of an optical frame (x right, y down, "
                "z forward), so let the detector name the optical frame"
            )

    def _note_unlike(self, persons: int) -> None:
        if persons:
            self.notes["unlike_the_model"] += persons
            self.explanations["unlike_the_model"] = (
                f"the points are hardly those of any shape of model '{self.lifter.model.name}'; if that is so of many "
                f"persons, they are in another order than that of layout '{self.route.given.name}': set the parameter "
                "`layout` to the one your detector uses"
            )

    def _drop(self, reason: str, explanation: str) -> None:
        self.drops[reason] += 1
        self.explanations[reason] = explanation


class _Gathered:
    """Persons of one image that come in a message each.

    header: of the last of them; stamp and frame are those of all. parts: what was read of each.
    """

    def __init__(self) -> None:
        self.header: object = None
        self.parts: list[Keypoints2D] = []

    def takes(self, keypoints: Keypoints2D) -> bool:
        """Whether this person is of the same image: same stamp and frame, and not one that it has already."""
        if not self.parts:
            return True
        first = self.parts[0]
        known = {name for part in self.parts for name in part.ids if name}
        same = (keypoints.stamp, keypoints.frame_id) == (first.stamp, first.frame_id)
        return same and not known.intersection(keypoints.ids)

    def add(self, header, keypoints: Keypoints2D) -> None:
        """One person more."""
        self.header = header
        self.parts.append(keypoints)

    def take(self) -> tuple[object, Keypoints2D]:
        """Header and all persons, in the order they came; then there is nobody."""
        parts, self.parts = self.parts, []
        return self.header, msg_adapters.join(parts)


def _optical(header, frame_id: str):
    """A message's header as the outputs have it: with the optical frame, where it names another of the camera's."""
    if header.frame_id == frame_id:
        return header
    header = copy.copy(header)
    header.frame_id = frame_id
    return header


def _scale_source(intrinsics: Intrinsics | None, metres_per_unit: float | None) -> str:
    if metres_per_unit is None:
        return "none: the model does not know its size in metres"
    if intrinsics is None:
        return "none: no usable CameraInfo has come"
    image = {"P": "the rectified image", "K": "the raw image, for P is not filled"}[intrinsics.matrix]
    uncorrected = ", whose distortion is not corrected" if intrinsics.distorted else ""
    return (
        "the model's metres per unit; distance from the camera's focal length, "
        f"CameraInfo's {intrinsics.matrix}: {image}{uncorrected}; both from `depth` where that has a value at the root"
    )


@functools.cache
def _layout_sizes() -> dict[str, int]:
    return {name: len(load_layout(name).names) for name in layout_names()}


def _layout_advice(error: WrongPointCount) -> str:
    fitting = [name for name, points in _layout_sizes().items() if error.fits(points)]
    if not fitting:
        return "no shipped layout has that many; set the parameter `layout` to the path of one of your own"
    return f"set the parameter `layout` to the one your detector uses: {', '.join(fitting)}"
