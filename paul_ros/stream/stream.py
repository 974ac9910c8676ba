# SPDX-License-Identifier: Apache-2.0
"""The one path from a 2D keypoint message to 3D; node and replay are thin shells over it.

message -> adapter -> confidence threshold -> model's layout -> Lifter -> depth -> smoothing -> output layout -> Frame.
No message stops the stream: one that cannot be used is dropped, counted by its reason and explained.
"""

from __future__ import annotations

import contextlib
import enum
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import msg_adapters
from msg_adapters import Intrinsics, Keypoints2D, MessageError, PointCountError, Source
from msg_adapters.cdr import CloudReader
from paul_ros.body_axes import left_and_up
from paul_ros.layout import Layout, load_layout
from paul_ros.lifted import IMAGE_AXES, OPTICAL_FRAME, UNLIKE_MODEL, Lifted
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.route import Route, find_output_layout
from paul_ros.stream import advice
from paul_ros.stream.arrival import Arrival, complete
from paul_ros.stream.depth import SURFACE
from paul_ros.stream.frame import Frame
from paul_ros.stream.layout_search import read_in_fitting_layout
from paul_ros.stream.parameters import checked
from paul_ros.stream.person_group import PersonGroup
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.session import Session
from paul_ros.stream.smoothing import OneEuro

_BONE_WIDTH = 0.01
"""Width of a drawn bone over the mean shape's largest extent."""

_log = logging.getLogger(__name__)


class Outcome(enum.Enum):
    """The fate of one message of keypoints.

    Attributes:
        LIFTED: the frame is this message's image.
        KEPT: the message is one person, kept until its image is complete; there is no frame.
        COMPLETED: the message is one person and kept; the frame is the previous image, which is now complete.
        DROPPED: the message, or the image that it completed, was dropped; the ledger says why; there is no frame.
    """

    LIFTED = "lifted"
    KEPT = "kept"
    COMPLETED = "completed"
    DROPPED = "dropped"


@dataclass(frozen=True)
class Answer:
    """The stream's answer to one message of keypoints: its outcome, and the frame if there is one."""

    outcome: Outcome
    frame: Frame | None = None


def open_stream(
    model: str | None = None, layout: str | None = None, session: Session | None = None, **parameters: Any
) -> LiftStream:
    """Open a stream by the node's parameters; a parameter that is left out, or None, has its default.

    Args:
        model: name or path of the model.
        layout: name or path of the input's layout.
        session: of an earlier stream that this one continues; None = a new one.
        parameters: any other parameters by name.

    Raises:
        ModelError, LayoutError: a file cannot be used, or layouts do not fit each other.
        ParameterError: a parameter is unknown or out of its range.
    """
    given = {"model": model, "layout": layout, **parameters}
    values = checked({name: value for name, value in given.items() if value is not None})
    loaded = load_model(values["model"])
    stream = LiftStream(
        Lifter(loaded, values["person_height"]),
        load_layout(values["layout"]) if values["layout"] else None,
        values["min_confidence"],
        values["max_persons"],
        find_output_layout(values["output_layout"], loaded.layout),
        values["smoothing"],
        session,
    )
    stream.session.choose_image(values["image"])
    return stream


class LiftStream:
    """Lifts 2D keypoint messages, one image at a time, and each on its own unless `smoothing` is set.

    A message of most types is an image. If a detector sends one message per person, a `PersonGroup` gathers those of
    an image; it closes with the first message of another image, or by `flush`. To change the model or a layout, open
    another stream with this one's session.

    Attributes:
        session: the camera, its depth images and all counts.
        ledger, counts, lift_us: the session's.
        lifter: the model in use.
        min_confidence: keypoints of lower confidence are hidden.
        max_persons: messages with more persons are dropped.
    """

    def __init__(
        self,
        lifter: Lifter,
        layout: Layout | None,
        min_confidence: float,
        max_persons: int,
        output_layout: Layout | None = None,
        smoothing: float = 0.0,
        session: Session | None = None,
    ) -> None:
        """Make a stream.

        Args:
            lifter: lifts the persons.
            layout: of the messages; None = found from the first message that shows a person.
            min_confidence: 0..1.
            max_persons: per image.
            output_layout: see `Route.between`.
            smoothing: cut-off of the one-euro filter in Hz; 0 = off.
            session: of an earlier stream that this one continues; None = a new one.

        Raises:
            LayoutError: these layouts do not fit each other.
        """
        self.session = session or Session()
        self.ledger, self.counts, self.lift_us = self.session.ledger, self.session.counts, self.session.lift_us
        self.lifter = lifter
        self.min_confidence = min_confidence
        self.max_persons = max_persons
        self._known = Route.between(layout, lifter.model.layout, output_layout) if layout else None
        # Until the input's layout is known, all frames are empty.
        self._provisional = Route.between(lifter.model.layout, lifter.model.layout, output_layout)
        self._output_layout = output_layout
        self._group = PersonGroup()
        self._axis_measures = left_and_up(lifter.model.layout)
        self._bone_width = _BONE_WIDTH * float(np.ptp(lifter.model.mean_shape, axis=1).max())
        self._filter = OneEuro(smoothing)
        self._cloud_reader = CloudReader()

    @property
    def route(self) -> Route:
        """The layouts that points go through; the input's is taken for the model's until it is known."""
        return self._known or self._provisional

    @property
    def intrinsics(self) -> Intrinsics | None:
        """Intrinsics in use; None before the first usable CameraInfo."""
        return self.session.intrinsics

    @property
    def person_height(self) -> float:
        """Metres, the known height of people; 0 = unknown.

        Raises:
            ParameterError: on setting, the height is out of its range.
            ModelError: on setting, the model does not know the stature that it was made for.
        """
        return self.lifter.person_height

    @person_height.setter
    def person_height(self, height: float) -> None:
        checked({"person_height": height})
        self.lifter.person_height = height

    @property
    def smoothing(self) -> float:
        """Cut-off of the filter over time in Hz; 0 = off."""
        return self._filter.cutoff

    @smoothing.setter
    def smoothing(self, cutoff: float) -> None:
        self._filter.cutoff = cutoff

    @property
    def units(self) -> str:
        """'m' if the intrinsics are known and the model knows its size, else 'model'."""
        metric = self.intrinsics is not None and self.lifter.model.metres_per_unit is not None
        return "m" if metric else "model"

    def camera_info(self, msg: Any) -> None:
        """Take the camera of a CameraInfo; unusable intrinsics are a counted drop."""
        with self.guard():
            self.session.take_camera_info(msg)

    def depth(self, msg: Any) -> None:
        """Keep a depth image; an unusable one is a counted drop."""
        with self.guard():
            self.session.depths.add(msg_adapters.read_depth(msg))

    def keypoints(self, type_name: str, msg: Any, topic: str = "", received: int = 0) -> Answer:
        """Lift one message. An image without persons is a frame too.

        Args:
            type_name: such as 'sensor_msgs/msg/PointCloud2'.
            msg: the message, or the serialised bytes of a PointCloud2.
            topic: topic of the message; some families have the person's id there.
            received: nanoseconds by the clock of the stamps, for messages without a usable stamp; 0 = unknown.
        """
        with self.guard():
            if isinstance(msg, bytes):
                msg = self._cloud_reader(msg)
            keypoints = self._read(type_name, msg, topic)
            message = complete(msg.header, keypoints, received, topic, self.session.camera_frame, self.ledger)
            # Without any time nothing shows which persons belong to one image.
            if type_name in msg_adapters.ONE_PERSON and message.keypoints.stamp:
                return self._keep(message)
            return Answer(Outcome.LIFTED, self._frame(message))
        return Answer(Outcome.DROPPED)

    def flush(self) -> Frame | None:
        """Lift the persons that are kept, when no more will come; None if none are kept, or their image is dropped."""
        with self.guard():
            if len(self._group):
                return self._frame(self._group.take())
        return None

    @contextlib.contextmanager
    def guard(self) -> Iterator[None]:
        """Turn any error about a message into a counted drop; the only place that does."""
        try:
            yield
        except PointCountError as error:
            self.ledger.drop(error.reason, advice.wrong_point_count(error, self.lifter.model.layout))
        except MessageError as error:
            self.ledger.drop(error.reason, advice.sentence(str(error)))
        except Exception as error:
            if not self.ledger.drops["internal_error"]:
                _log.exception("A message could not be lifted. This is a fault of paul_ros: report it with this text.")
            self.ledger.drop("internal_error", advice.sentence(f"{type(error).__name__}: {error}"))

    def describe(self) -> dict[str, Any]:
        """Return what the outputs mean: the content of ~/layout and the head of a report."""
        model, layout = self.lifter.model, self.route.output
        return {
            "layout": layout.name,
            "keypoints": list(layout.names),
            "edges": [list(edge) for edge in layout.edges],
            "sides": list(layout.sides),
            "input_layout": self.route.given.name if self._known else None,
            "model_layout": model.layout.name,
            "units": self.units,
            "frame": f"header.frame_id of the input; {OPTICAL_FRAME if self.intrinsics else IMAGE_AXES}",
            "scale_source": advice.scale_source(self.intrinsics, model.metres_per_unit),
            **advice.image_of(self.intrinsics),
            "person_height": self.person_height or model.stature,
            "size_spread": self.lifter.size_spread,
            "smoothing_hz": self.smoothing,
            "chirality": model.header.get("chirality"),
            "model": model.name,
            "model_sha256": model.sha256,
            "metres_per_unit": self.lifter.metres_per_unit,
        }

    def _read(self, type_name: str, msg: Any, topic: str) -> Keypoints2D:
        """Read a message into the model's layout; the first that shows a person fixes the input's layout."""
        route = self.route
        source = Source(route.given.names, self.session.image_size, topic, self.session.camera_frame)
        if self._known:
            keypoints = msg_adapters.read(type_name, msg, len(source.names), source)
            self._check_persons(keypoints.persons)
        else:
            keypoints, found = read_in_fitting_layout(self.lifter.model.layout, type_name, msg, source)
            self._check_persons(keypoints.persons)
            route = Route.between(found, self.lifter.model.layout, self._output_layout)
            if keypoints.visible.any():
                self._known = route
        for note in keypoints.notes:
            self.ledger.note(note.reason, advice.sentence(note.text))
        return route.keypoints_in(self.session.in_pinhole(keypoints, self.min_confidence), self.min_confidence)

    def _check_persons(self, persons: int) -> None:
        if persons > self.max_persons:
            raise MessageError(
                "too_many_persons",
                f"The image shows {persons} persons. Raise `max_persons` above {self.max_persons} if "
                "that is right; otherwise check the detector.",
            )

    def _keep(self, message: Arrival) -> Answer:
        """Keep one person; lift the previous image if this person belongs to the next."""
        if self._group.accepts(message):
            self._check_persons(len(self._group) + message.keypoints.persons)
            if not self._group.add(message):
                self.ledger.drop("repeated_person", REASONS["repeated_person"].advice)
            return Answer(Outcome.KEPT)
        image = self._group.take()
        self._group.add(message)
        return Answer(Outcome.COMPLETED, self._frame(image))

    def _frame(self, message: Arrival) -> Frame:
        """Lift the persons of one image, given in the model's layout."""
        model, route = self.lifter.model, self.route
        given = self.session.person_ids.identified(message.keypoints, self.ledger)
        self.session.check_header(given.stamp, given.frame_id)
        lifted = self._lift(given)
        self._count(given, lifted)
        # The root of a person lies below the skin. For other objects, assume that it lies on the visible surface.
        surface = SURFACE if model.stature else 0.0
        lifted = self.session.depths.place(lifted, given.stamp, self.intrinsics, surface, self.ledger)
        lifted = self._filter(given.ids, given.stamp, lifted, model.layout.root, given.frame_id)
        visible = np.where(lifted.ok[:, None], lifted.used, given.visible)
        used = replace(given, visible=visible, confidence=np.where(visible, given.confidence, 0.0))
        metres_per_unit = self.lifter.metres_per_unit if lifted.units == "m" else None
        return Frame(
            header=message.header,
            keypoints=route.keypoints_out(used),
            lifted=route.lifted_out(lifted),
            layout=route.output,
            given=given,
            bone_width=self._bone_width * (metres_per_unit or 1.0),
            camera=self.intrinsics,
            model_points=lifted.points,
            axis_measures=self._axis_measures,
            person_numbers=self.session.person_ids.numbers(given.ids),
            stamped=message.stamped,
        )

    def _lift(self, keypoints: Keypoints2D) -> Lifted:
        start = time.perf_counter_ns()
        lifted = self.lifter.lift_in_model_layout(keypoints.xy, keypoints.visible, self.intrinsics)
        if keypoints.persons:
            self.lift_us.append((time.perf_counter_ns() - start) / 1000)
        return lifted

    def _count(self, given: Keypoints2D, lifted: Lifted) -> None:
        """Count an image, the persons that are left out, and those that the model hardly explains."""
        self.counts.update(frames=1, persons=given.persons, lifted=int(lifted.ok.sum()))
        for reason in filter(None, lifted.reason):
            self.ledger.drop(f"person_{reason}", REASONS[f"person_{reason}"].advice)
        if self.smoothing and (unfiltered := sum(not name for name, ok in zip(given.ids, lifted.ok) if ok)):
            self.ledger.note("smoothing_without_ids", REASONS["smoothing_without_ids"].advice, unfiltered)
        if unlike := int((lifted.unexplained > UNLIKE_MODEL).sum()):
            text = advice.unlike_the_model(self.lifter.model.name, self.route.given.name)
            self.ledger.note("unlike_the_model", text, unlike)
