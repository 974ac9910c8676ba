# SPDX-License-Identifier: Apache-2.0
"""The route of a keypoint: from the detector's layout to the model's, and on to the output's.

Layouts are mapped by the names of their points, so one model serves every detector. Points that a detector lacks are
hidden, and the model completes them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from msg_adapters import Keypoints2D
from paul_ros.errors import LayoutError
from paul_ros.layout import Layout, Mapping
from paul_ros.lifter import Lifted

MODEL = "model"
"""Value of `output_layout` that stands for the model's own layout."""


@dataclass(frozen=True)
class Route:
    """The two mappings between three layouts.

    Attributes:
        into: from the input's layout to the model's.
        out: from the model's layout to the output's; the model has all points of the output.
    """

    into: Mapping
    out: Mapping

    @classmethod
    def between(cls, given: Layout, model: Layout, output: Layout | None = None) -> Route:
        """Make the route between layouts.

        Args:
            given: layout of the input.
            model: layout of the model.
            output: layout of the output; None = the input's if the model has all its points, else the model's.

        Raises:
            LayoutError: input and model have too few points in common, or the model lacks a point of the output.
        """
        return cls(given.map_to(model), _outward(model, given, output))

    @property
    def given(self) -> Layout:
        """The input's layout."""
        return self.into.source

    @property
    def output(self) -> Layout:
        """The output's layout."""
        return self.out.target

    def keypoints_in(self, keypoints: Keypoints2D, min_confidence: float) -> Keypoints2D:
        """Map keypoints from the input's layout to the model's; hide those of low confidence."""
        sure = keypoints.visible & (keypoints.confidence >= min_confidence)
        xy, confidence, visible = self.into(keypoints.xy, keypoints.confidence, sure)
        return replace(keypoints, xy=xy, confidence=np.where(visible, confidence, 0.0), visible=visible)

    def keypoints_out(self, keypoints: Keypoints2D) -> Keypoints2D:
        """Map keypoints from the model's layout to the output's."""
        xy, confidence, visible = self.out(keypoints.xy, keypoints.confidence, keypoints.visible)
        return replace(keypoints, xy=xy, confidence=confidence, visible=visible)

    def lifted_out(self, lifted: Lifted) -> Lifted:
        """Map the points from the model's layout to the output's; root and `used` stay the model's."""
        return replace(lifted, points=self.out.values(lifted.points))

    def points_out(self, points: np.ndarray) -> np.ndarray:
        """Map 3D points (N,P,3) from the input's layout to the output's, (N,Q,3); NaN for those the input lacks."""
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
    """Return the names of the target's points that the model's layout neither has nor derives."""
    return [name for name in target.names if name not in model.names and name not in model.derived]
