# SPDX-License-Identifier: Apache-2.0
"""The Lifter: 2D keypoints of single frames to 3D points in the camera frame; error, ambiguity and units stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.keypoints import Intrinsics
from paul_ros.model import Model, ModelError, enough_visible
from paul_ros.onp import OnP, onp
from paul_ros.placement import centred_view, place, undo_perspective

TOO_FEW_POINTS = "too_few_points"
DEGENERATE_POINTS = "degenerate_points"
TOO_FAR = "too_far"

AMBIGUOUS = 0.9
"""From this ambiguity on the depth-reversed pose explains the image nearly as well."""

MIN_EXTENT = 1.0
"""Pixels, root mean square distance of the visible points from their mean: below it an image says nothing of a pose."""

MAX_DISTANCE = 200.0
"""Metres: there a grown person's points keep about 1.5 pixels of extent for 900 pixels of focal length."""


@dataclass(frozen=True)
class Lifted:
    """N persons in 3D.

    Attributes:
        points: (N,P,3) camera optical frame (x right, y down, z forward). In metres from the camera's centre where
            ``units`` is ``"m"``; else in model units from the root. NaN for persons that were not lifted.
        root: (N,3) the layout's root point, same frame and units.
        rotation: (N,3,3) canonical frame to camera frame, det +1.
        scale: (N,) pixels per model unit (at the person's distance).
        reprojection: (N,) pixels, root mean square over the visible points (those within 60 degrees of the person).
        ambiguity: (N,) 0..1, residual of the pose over that of its depth-reversed rival, the second optimum; 0 where
            there is none, 1 where the image cannot tell them apart.
        certified: (N,) the pose is the proven optimum of orthographic-N-point.
        reason: N slugs, '' where lifted, else why not: ``too_few_points``, fewer visible than the model asks for;
            ``degenerate_points``, they fix no pose: all on one line or, with intrinsics, an rms extent below
            ``MIN_EXTENT``; ``too_far``, in metres a coordinate would exceed ``MAX_DISTANCE``.
        units: ``"m"`` or ``"model"``.
    """

    points: np.ndarray
    root: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    reprojection: np.ndarray
    ambiguity: np.ndarray
    certified: np.ndarray
    reason: tuple[str, ...]
    units: str

    @property
    def ok(self) -> np.ndarray:
        """(N,) bool: lifted."""
        return np.array([not reason for reason in self.reason], bool)


class Lifter:
    """Lifts every person of every frame on its own: encode, decode, orthographic-N-point, placement.

    Section 4.2 of the paper, "Prediction on unseen data".
    """

    def __init__(self, model: Model) -> None:
        """Raises ModelError: the model is of one fixed scale, which no camera's image has."""
        if model.scale != "free":
            raise ModelError(
                f"model '{model.name}' is for orthographic data of one fixed scale: judge it with `paul evaluate`, "
                f"or train a model to lift with by a recipe with scale: free"
            )
        self.model = model

    def lift(self, xy: np.ndarray, visible: np.ndarray, camera: Intrinsics | None = None) -> Lifted:
        """Lift N persons.

        Args:
            xy: (N,P,2) pixels in the model's layout; anything, NaN too, where hidden.
            visible: (N,P) bool.
            camera: intrinsics of the (rectified) image; with them, and a model that knows its metres per unit, the
                output is in metres.

        Raises:
            ValueError: the arrays do not have these shapes.
        """
        xy, visible = self._checked(xy, visible)
        reason = np.where(enough_visible(visible, self.model.layout), "", TOO_FEW_POINTS).astype(object)
        lifted = _nothing(len(xy), xy.shape[1], "m" if camera and self.model.metres_per_unit else "model")
        rows = np.flatnonzero(reason == "")
        if len(rows):
            reason[rows] = self._lift_rows(xy[rows], visible[rows], camera, rows, lifted)
        return Lifted(**lifted, reason=tuple(reason.tolist()))

    def _checked(self, xy: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        xy, visible = np.asarray(xy, float), np.asarray(visible, bool)
        P = len(self.model.layout.names)
        if xy.ndim != 3 or xy.shape[1:] != (P, 2) or visible.shape != xy.shape[:2]:
            raise ValueError(
                f"lift needs xy (N,{P},2) and visible (N,{P}) in layout '{self.model.layout.name}', "
                f"got {xy.shape} and {visible.shape}"
            )
        return xy, visible & np.isfinite(xy).all(2)

    def _lift_rows(self, xy, visible, camera, rows, lifted) -> np.ndarray:
        """Fill the given rows of the output arrays; returns why the others of them were not lifted, '' where done."""
        W, turn, pixels = xy.transpose(0, 2, 1), None, 1.0
        if camera is not None:
            view = centred_view(xy, visible, camera)
            W, turn, pixels = view.W, view.turn, (camera.fx + camera.fy) / 2
            visible = visible & np.isfinite(W).all(1)
        S = self.model.shape(W, visible).astype(float)
        pose = onp(S, W, visible)
        if camera is not None:
            # Once is enough: it leaves half a pixel and 5 mm of a person 2.5 m away, a tenth of that at 6 m.
            pose = onp(S, undo_perspective(W, pose.R @ S, pose.scale), visible)
        enough = enough_visible(visible, self.model.layout)  # again: a virtual camera does not see all points
        fixed = pose.determined & (pose.scale > 0) & (camera is None or _extent(xy, visible) >= MIN_EXTENT)
        points = self._placed(pose, S, fixed, turn if lifted["units"] == "m" else None)
        near = (np.abs(points) <= MAX_DISTANCE).all((1, 2)) if lifted["units"] == "m" else True
        done = enough & fixed & near
        root = list(self.model.layout.root)
        for name, value in (
            ("points", points),
            ("root", points[:, root].mean(1)),
            ("rotation", pose.R if turn is None else turn @ pose.R),
            ("scale", pose.scale * pixels),
            ("reprojection", pose.residual * pixels),
            ("ambiguity", pose.ambiguity),
            ("certified", pose.certified),
        ):
            lifted[name][rows[done]] = value[done]
        return np.where(~enough, TOO_FEW_POINTS, np.where(~fixed, DEGENERATE_POINTS, np.where(done, "", TOO_FAR)))

    def _placed(self, pose: OnP, S: np.ndarray, fixed: np.ndarray, turn: np.ndarray | None) -> np.ndarray:
        """Points (N,P,3): in metres where the camera's turn is given, else in model units from the root."""
        shape = pose.R @ S
        if turn is None:
            return (shape - shape[:, :, list(self.model.layout.root)].mean(2, keepdims=True)).transpose(0, 2, 1)
        scale = np.where(fixed, pose.scale, 1.0)
        return place(shape, scale, pose.translation, turn, self.model.metres_per_unit)


def _extent(xy: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(N,) root mean square distance of the visible points of (N,P,2) from their mean; 0 where there are none."""
    seen = visible[..., None]
    count = np.maximum(visible.sum(1), 1)[:, None]
    mean = np.where(seen, xy, 0.0).sum(1) / count
    return np.sqrt((np.where(seen, xy - mean[:, None], 0.0) ** 2).sum((1, 2)) / count[:, 0])


def _nothing(N: int, P: int, units: str) -> dict:
    """Output arrays of N persons, none lifted yet."""
    return dict(
        points=np.full((N, P, 3), np.nan),
        root=np.full((N, 3), np.nan),
        rotation=np.tile(np.eye(3), (N, 1, 1)),
        scale=np.full(N, np.nan),
        reprojection=np.full(N, np.nan),
        ambiguity=np.full(N, np.nan),
        certified=np.zeros(N, bool),
        units=units,
    )
