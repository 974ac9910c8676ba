# SPDX-License-Identifier: Apache-2.0
"""Routes of keypoints: from the detector's layout to the model's, and on to the layout of the output.

Points are matched by name, so one model serves every detector whose points it has. Other points are hidden to the
model, and the model completes them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from msg_adapters.keypoints import Keypoints2D
from paul_ros.errors import LayoutError
from paul_ros.layout import Layout, Mapping, load_layout
from paul_ros.lifted import Lifted

MODEL = "model"
"""As output layout: the model's own, whatever the input."""


@dataclass(frozen=True)
class Route:
    """Three layouts and the mappings between them.

    Attributes:
        into: mapping from the input's layout to the model's.
        out: mapping from the model's layout to the output's, which fills all its points.
    """

    into: Mapping
    out: Mapping

    @classmethod
    def between(cls, given: Layout, model: Layout, output: Layout | None = None) -> Route:
        """Build the route of keypoints in a given layout.

        Args:
            given: layout of the input.
            model: layout of the model.
            output: layout of the output; None for the input's if the model completes all its points, else the model's.

        Raises:
            LayoutError: input and model share fewer than 3 points, or the model lacks a point of the output.
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
        """Map keypoints from the input's layout to the model's, and hide those of low confidence."""
        sure = keypoints.visible & (keypoints.confidence >= min_confidence)
        xy, confidence, visible = self.into(keypoints.xy, keypoints.confidence, sure)
        return replace(keypoints, xy=xy, confidence=np.where(visible, confidence, 0.0), visible=visible)

    def keypoints_out(self, keypoints: Keypoints2D) -> Keypoints2D:
        """Map keypoints from the model's layout to the output's."""
        xy, confidence, visible = self.out(keypoints.xy, keypoints.confidence, keypoints.visible)
        return replace(keypoints, xy=xy, confidence=confidence, visible=visible)

    def lifted_out(self, lifted: Lifted) -> Lifted:
        """Map ``points`` and ``used`` from the model's layout to the output's; the root stays the model's."""
        points, used = self.out.values(lifted.points), self.out.visibility(lifted.used)
        return replace(lifted, points=points, used=used, layout=self.output)

    def points_out(self, points: np.ndarray) -> np.ndarray:
        """Map 3D points (N,P,3) of the input's layout to (N,Q,3) of the output's; NaN where the input lacks them."""
        return self.out.values(self.into.values(points))


def find_output_layout(name_or_path: str | Path | None, model: Layout) -> Layout | None:
    """Find the layout that an output is asked for in.

    Args:
        name_or_path: name or path of a layout, ``model`` for the model's own, or empty for the default.
        model: layout of the model.

    Returns:
        The layout, or None for the default of ``Route.between``.

    Raises:
        LayoutError: there is no such layout, or it is malformed.
    """
    if not name_or_path:
        return None
    return model if name_or_path == MODEL else load_layout(name_or_path)


def missing(model: Layout, target: Layout) -> list[str]:
    """Return the names of the target's points that the model's layout neither has nor derives."""
    return [name for name in target.names if name not in model.names and name not in model.derived]


def _outward(model: Layout, given: Layout, output: Layout | None) -> Mapping:
    lacking = missing(model, output or given)
    if output is None:
        return model.map_to(model if lacking else given)
    if lacking:
        raise LayoutError(
            f"`output_layout` '{output.name}': the model's layout '{model.name}' has no {', '.join(lacking)}; "
            f"choose one whose points it has, or '{MODEL}' for all points of the model"
        )
    return model.map_to(output)
