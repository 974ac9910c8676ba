# SPDX-License-Identifier: Apache-2.0
"""Arrays of 2D keypoints lifted without ROS messages: the node's confidence threshold, layouts and lifter."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

from msg_adapters.keypoints import Keypoints2D, record
from paul_ros.errors import LayoutError
from paul_ros.layout import Layout
from paul_ros.lifted import Lifted
from paul_ros.lifter import Lifter
from paul_ros.placeholders import look_normalised, placeholders
from paul_ros.route import Route
from paul_ros.stream.layout_search import candidates
from paul_ros.stream.session import Session

_NORMALISED = (
    "keypoints look normalised to 0..1; multiply x by the image's width and y by its height, or poses are distorted"
)

_UNUSED = "{} not used; keep one array or column of confidences (0 to 1), as confidence"

_NO_HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")


@dataclass(frozen=True)
class Persons:
    """2D keypoints of N persons, in any images.

    Attributes:
        frame: (N,) int, the image of each person.
        person: N ids as text.
        xy: (N,P,2) pixels; NaN where hidden.
        confidence: (N,P) in 0..1; 1 where the source has none.
        visible: (N,P) bool.
        notes: reason -> a sentence about something irregular, and the number of points.
    """

    frame: np.ndarray
    person: tuple[str, ...]
    xy: np.ndarray
    confidence: np.ndarray
    visible: np.ndarray
    notes: dict[str, tuple[str, int]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        frame: np.ndarray,
        person: tuple[str, ...],
        xy: np.ndarray,
        confidence: np.ndarray | None = None,
        visible: np.ndarray | None = None,
        unused: Sequence[str] = (),
    ) -> Persons:
        """Hide what no camera can have seen, by the rules for messages, and placeholders.

        Args:
            frame: (N,) int.
            person: N ids.
            xy: (N,P,2) pixels, of any real type.
            confidence: (N,P), or None if the source has none.
            visible: (N,P) bool, or None if hidden points are NaN.
            unused: names in the source that look like confidences too.
        """
        shown = np.isfinite(xy).all(axis=2) if visible is None else visible
        missing = placeholders(xy[..., 0], xy[..., 1], shown)
        read = record(xy, confidence, person, _NO_HEADER, shown & ~missing, placeholders=False)
        seen = int(read.visible.sum())
        notes = {note.reason: (note.text, seen) for note in read.notes}
        if unused:
            notes["unused_confidences"] = _UNUSED.format(", ".join(unused)), seen
        if missing.any():
            notes["placeholder"] = "points at (0, 0) or (-1, -1) are taken as missing", int(missing.sum())
        if look_normalised(read.xy[..., 0], read.xy[..., 1], read.visible):
            notes["normalised"] = _NORMALISED, seen
        return cls(frame, person, read.xy, read.confidence, read.visible, notes)

    @classmethod
    def stacked(
        cls, frame: list[int], person: list[str], keypoints: list[np.ndarray], unused: Sequence[str] = ()
    ) -> Persons:
        """Stack N persons' x, y, confidence, arrays (P,3); NaN where hidden."""
        every = np.stack(keypoints)
        return cls.of(np.array(frame), tuple(person), every[..., :2], every[..., 2], unused=unused)


def layout_of(points: int, model: Layout) -> Layout:
    """Return the layout that the node would take for this number of keypoints, if nobody names one.

    It is the first of `layout_search.candidates` with as many points.

    Raises:
        LayoutError: no layout fits.
    """
    for layout in candidates(model):
        if len(layout.names) == points:
            return layout
    raise LayoutError(f"no shipped layout of {points} keypoints fits model layout '{model.name}': set --layout")


def lift_persons(
    batches: Iterable[Persons], lifter: Lifter, route: Route, session: Session, min_confidence: float
) -> Iterator[tuple[Persons, Lifted]]:
    """Lift batches of persons, one batch at a time.

    Args:
        batches: persons in the layout `route.given`.
        lifter: lifts in the model's layout.
        route: layouts of input and output.
        session: has the camera, whose distortion is corrected, and takes the notes; without a camera, persons are in
            model units.
        min_confidence: keypoints below it count as hidden.

    Yields:
        Each batch with its persons in 3D, points in the layout `route.output`.
    """
    for batch in batches:
        keypoints = Keypoints2D(batch.xy, batch.confidence, batch.visible, batch.person, 0, "")
        seen = route.keypoints_in(session.in_pinhole(keypoints, min_confidence), min_confidence)
        yield batch, route.lifted_out(lifter.lift_in_model_layout(seen.xy, seen.visible, session.intrinsics))
