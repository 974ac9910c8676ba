# SPDX-License-Identifier: Apache-2.0
"""The result of lifting: 3D points of N persons, with error, ambiguity, units, layout and reasons of failure."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from paul_ros.layout import Layout

TOO_FEW_POINTS = "too_few_points"
DEGENERATE_POINTS = "degenerate_points"
TOO_FAR = "too_far"
BEHIND_CAMERA = "behind_camera"

AMBIGUOUS = 0.9
"""From this ambiguity on, the depth-reversed pose explains the image nearly as well."""

UNLIKE_MODEL = 0.5
"""Unexplained share above which a person is hardly a shape of the model. Persons in the bags reach 0.37, with noise of
5 % of the height 0.42. If COCO's points are taken for Human3.6M's or the reverse, 97 % of the persons exceed 0.5."""

OPTICAL_FRAME = "optical frame of the camera (REP-103): x right, y down, z forward"
"""Axes of points that were lifted with a camera."""

IMAGE_AXES = "axes of the image: x right, y down, z away from the viewer along the line of sight to each person"
"""Axes of points that were lifted without a camera: only its intrinsics tell how far its own axes are turned from the
line of sight."""

MIN_EXTENT = 1.0
"""Pixels, rms distance of the visible points from their mean: a smaller image cannot show a pose."""

MAX_DISTANCE = 200.0
"""Metres: at this distance the points of an adult have an extent of about 1.5 pixels with a focal length of 900."""


@dataclass(frozen=True)
class Lifted:
    """N persons in 3D.

    >>> from paul_ros.layout import load_layout
    >>> Lifted.nobody((TOO_FEW_POINTS, TOO_FAR), load_layout("coco17"), units="m")
    Lifted(2 persons, 0 lifted, m, coco17)

    Attributes:
        points: (N,P,3) points of ``layout`` in the camera's optical frame (x right, y down, z forward). Without a
            camera, z is the line of sight to each person. They are metres from the camera's centre if ``units`` is
            ``"m"``, else model units from the root. NaN if not lifted.
        root: (N,3) root point of the model's layout, same frame and units. In shipped layouts this is the middle of
            the hips in ``points``, except if the pelvis was seen but not both hips.
        rotation: (N,3,3) canonical frame to camera frame, det +1.
        scale: (N,) pixels per model unit at the person's distance.
        reprojection: (N,) pixels, rms error of the model's own shape over the points used. The error of ``points`` is
            smaller: they are moved to where they were seen (S_cam of the paper's equation 4).
        unexplained: (N,) reprojection over the rms extent of the points used. It is 0 if the shape explains the image,
            and near 1 if it explains nothing, for instance if the points are in the order of another layout.
        ambiguity: (N,) 0..1, residual of the pose over that of its depth-reversed rival, the second optimum of
            orthographic-N-point.  0 without a rival, 1 if the image cannot distinguish them.
        certified: (N,) bool, the pose, or the start of its pinhole refinement, is the proven optimum of
            orthographic-N-point.
        distance_sigma: (N,) metres, standard deviation of the root's distance; NaN in model units. It combines the
            spread of people's heights (unless the height is known) with ``unexplained``, which equals the relative
            distance errors of persons in the shipped bags.
        used: (N,P) bool, the points that the person was lifted from: the visible ones without misdetections. Those
            are points beyond 60 degrees from the person's direction, or far from the lifted shape.
        reason: N short names, '' if lifted, else why not:
            ``too_few_points``: fewer visible points than the model needs.
            ``degenerate_points``: the points fix no pose. They lie on one line or in two places or, with intrinsics,
            have an rms extent below 1 pixel.
            ``too_far``: a coordinate would exceed 200 m.
            ``behind_camera``: the root, or in metres a point used, would not be in front of the camera. Points not
            used may be behind it, such as the feet of a near person if the camera looks up.
        units: ``"m"`` or ``"model"``.
        layout: layout of the P points.
    """

    points: np.ndarray
    root: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    reprojection: np.ndarray
    unexplained: np.ndarray
    ambiguity: np.ndarray
    certified: np.ndarray
    distance_sigma: np.ndarray
    used: np.ndarray
    reason: tuple[str, ...]
    units: str
    layout: Layout

    def __repr__(self) -> str:
        """Return the counts, units and layout; the arrays would fill the screen."""
        persons = len(self.reason)
        counts = f"{persons} person{'' if persons == 1 else 's'}, {int(self.ok.sum())} lifted"
        return f"Lifted({counts}, {self.units}, {self.layout.name})"

    @property
    def ok(self) -> np.ndarray:
        """(N,) bool, the person was lifted."""
        return np.array([not reason for reason in self.reason], bool)

    @classmethod
    def nobody(cls, reasons: tuple[str, ...], layout: Layout, units: str) -> Lifted:
        """Return N persons that were not lifted, for the given reasons."""
        N, P = len(reasons), len(layout.names)
        return cls(
            points=np.full((N, P, 3), np.nan),
            root=np.full((N, 3), np.nan),
            rotation=np.tile(np.eye(3), (N, 1, 1)),
            scale=np.full(N, np.nan),
            reprojection=np.full(N, np.nan),
            unexplained=np.full(N, np.nan),
            ambiguity=np.full(N, np.nan),
            certified=np.zeros(N, bool),
            distance_sigma=np.full(N, np.nan),
            used=np.zeros((N, P), bool),
            reason=reasons,
            units=units,
            layout=layout,
        )

    def with_rows(self, rows: np.ndarray, others: Lifted) -> Lifted:
        """Return a copy whose rows (N,) bool are the persons of ``others``, in their order."""
        mixed: dict[str, Any] = {}
        for name in _ARRAYS:
            mixed[name] = getattr(self, name).copy()
            mixed[name][rows] = getattr(others, name)
        reason = np.array(self.reason, object)
        reason[rows] = others.reason
        return replace(self, **mixed, reason=tuple(reason))


_ARRAYS = tuple(field.name for field in fields(Lifted) if field.name not in ("reason", "units", "layout"))
