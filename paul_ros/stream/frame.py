# SPDX-License-Identifier: Apache-2.0
"""One lifted image, as arrays."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_adapters import Intrinsics, Keypoints2D
from paul_ros.body_axes import body_rotations, quaternions
from paul_ros.layout import Layout
from paul_ros.lifted import Lifted


@dataclass(frozen=True)
class Frame:
    """The N persons of one image in 2D and 3D. P is the number of points of the output layout.

    Attributes:
        header: std_msgs/Header of the input, with the camera's optical frame and a usable stamp, see `Arrival`.
        keypoints: 2D in the output layout; points that were not used for lifting are hidden.
        lifted: 3D in the output layout.
        layout: the output layout.
        given: 2D in the model's layout; points of low confidence are hidden.
        bone_width: width of a drawn bone, in the units of the points.
        camera: intrinsics that were used; None if there were none.
        model_points: (N,Q,3) 3D points in the model's layout of Q points.
        axis_measures: (2,Q) what `left_and_up` returns for the model's layout.
        person_numbers: (N,) float32 numbers of the persons' ids, see `PersonIds.numbers`.
        stamped: whether the stamp is the input's own; otherwise it is the time of arrival.
    """

    header: Any
    keypoints: Keypoints2D
    lifted: Lifted
    layout: Layout
    given: Keypoints2D
    bone_width: float
    camera: Intrinsics | None
    model_points: np.ndarray
    axis_measures: np.ndarray | None
    person_numbers: np.ndarray
    stamped: bool = True

    @functools.cached_property
    def attitudes(self) -> np.ndarray:
        """(N,4) quaternions x, y, z, w of the body axes, with w >= 0; computed on first use."""
        return quaternions(body_rotations(self.model_points, self.lifted.rotation, self.axis_measures))

    @property
    def metric(self) -> np.ndarray:
        """(N,) bool: persons that were lifted in metres."""
        return self.lifted.ok & (self.lifted.units == "m")
