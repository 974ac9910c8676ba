# SPDX-License-Identifier: Apache-2.0
"""The way of a keypoint through the node: from the detector's layout to the model's, and on to the one published.

Points find their place by name, so one model serves every detector whose points it has; the rest is hidden to it, and
completed by it. Which layout a detector uses is found from its messages where nobody says it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

import msg_adapters
from msg_adapters import Keypoints2D, Source, WrongPointCount
from paul_ros.errors import LayoutError
from paul_ros.layout import Layout, Mapping, layout_names, load_layout
from paul_ros.lifter import Lifted

PREFERRED = ("coco17", "h36m17", "openpose18", "body25", "mediapipe33")
"""Of the shipped layouts with as many points as a message has, the first of these is taken, then any other."""

MODEL = "model"
"""As output layout: the model's own, whatever the input."""


@dataclass(frozen=True)
class Route:
    """Three layouts and the mappings between them. into: input to model; out: model to output, all points of it."""

    into: Mapping
    out: Mapping

    @classmethod
    def between(cls, given: Layout, model: Layout, output: Layout | None = None) -> Route:
        """output: None = the input's layout where the model completes every point of that, else the model's.

        Raises LayoutError: input and model have too little in common, or the model lacks a point of the output.
        """
        return cls(given.map_to(model), _outward(model, given, output))

    @property
    def given(self) -> Layout:
        """The input's layout."""
        return self.into.source

    @property
    def output(self) -> Layout:
        """The layout of what is published."""
        return self.out.target

    def keypoints_in(self, keypoints: Keypoints2D, min_confidence: float) -> Keypoints2D:
        """Of the input's layout -> of the model's; low confidences are hidden."""
        sure = keypoints.visible & (keypoints.confidence >= min_confidence)
        xy, confidence, visible = self.into(keypoints.xy, keypoints.confidence, sure)
        return replace(keypoints, xy=xy, confidence=np.where(visible, confidence, 0.0), visible=visible)

    def keypoints_out(self, keypoints: Keypoints2D) -> Keypoints2D:
        """Of the model's layout -> of the output's."""
        xy, confidence, visible = self.out(keypoints.xy, keypoints.confidence, keypoints.visible)
        return replace(keypoints, xy=xy, confidence=confidence, visible=visible)

    def lifted_out(self, lifted: Lifted) -> Lifted:
        """Of the model's layout -> of the output's; root and `used` stay the model's."""
        return replace(lifted, points=self.out.values(lifted.points))

    def points_out(self, points: np.ndarray) -> np.ndarray:
        """3D points (N,P,3) of the input's layout -> (N,Q,3) of the output's; NaN for those that the input lacks."""
        return self.out.values(self.into.values(points))


def _outward(model: Layout, given: Layout, output: Layout | None) -> Mapping:
    lacking = missing(model, output or given)
    if output is None:
        return model.map_to(model if lacking else given)
    if lacking:
        raise LayoutError(
            f"output_layout '{output.name}': the model's layout '{model.name}' has no {', '.join(lacking)}; "
            f"choose one whose points it has, or '{MODEL}' for all points of the model"
        )
    return model.map_to(output)


def missing(model: Layout, target: Layout) -> list[str]:
    """Names of the target's points that the model's layout neither has nor derives."""
    return [name for name in target.names if name not in model.names and name not in model.derived]


def read_unknown(model: Layout, type_name: str, msg, source: Source) -> tuple[Keypoints2D, Layout]:
    """A message of which nobody said the layout, and the layout that it was read in.

    That is the one whose points the message names, if the model shares enough of them; else the model's own if the
    number of points is right for it; else the first shipped layout of that number that maps onto the model, in the
    order of PREFERRED. Raises MessageError as `msg_adapters.read` does; WrongPointCount where none has the number.
    """
    refusal: WrongPointCount | None = None
    for layout in _candidates(model, msg_adapters.named_layout(type_name, msg)):
        try:
            return msg_adapters.read(type_name, msg, len(layout.names), replace(source, names=layout.names)), layout
        except WrongPointCount as error:
            refusal = refusal or error
    raise refusal


def _candidates(model: Layout, named: str | None) -> list[Layout]:
    fitting = {layout.name: layout for layout in _shipped() if _maps(layout, model)}
    first = [fitting[named]] if named in fitting else []
    return [*first, model, *fitting.values()]


@functools.cache
def _shipped() -> tuple[Layout, ...]:
    """In the order of PREFERRED. Reading them takes a tenth of a second."""
    return tuple(load_layout(name) for name in dict.fromkeys([*PREFERRED, *layout_names()]))


def _maps(layout: Layout, model: Layout) -> bool:
    try:
        return bool(layout.map_to(model))
    except LayoutError:
        return False
