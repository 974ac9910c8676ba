# SPDX-License-Identifier: Apache-2.0
"""The Lifter: 2D keypoints of single frames to 3D points in the camera frame; error, ambiguity and units stated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msg_adapters.keypoints import Intrinsics
from paul_ros.errors import ModelError
from paul_ros.layout import middles
from paul_ros.model import Model, RigidModel, enough_visible
from paul_ros.onp import onp
from paul_ros.pinhole_pose import refine
from paul_ros.placement import centred_view, place

TOO_FEW_POINTS = "too_few_points"
DEGENERATE_POINTS = "degenerate_points"
TOO_FAR = "too_far"
BEHIND_CAMERA = "behind_camera"

AMBIGUOUS = 0.9
"""From this ambiguity on the depth-reversed pose explains the image nearly as well."""

_WILD, _WILD_EXTENT = 3.0, 0.35
"""A point is taken for a misdetection where it is missed by more than so many medians of the person's points, and by
more than this share of the person's extent (some 11 % of the height)."""

HEIGHT_SPREAD = 0.06
"""Standard deviation of the heights of adults over their mean: men 175.3, women 161.3 cm, each with one of some 7.3 cm
(Fryar et al., Anthropometric Reference Data, United States 2015-2018, Vital and Health Statistics 3(46), 2021)."""

MIN_EXTENT = 1.0
"""Pixels, root mean square distance of the visible points from their mean: below it an image says nothing of a pose."""

_LINE = 0.005
"""Points are on one line where they spread across it by less than this share of their spread along it, root mean
squares both: of 0.3 pixels, what rounding to whole ones makes, on 60. The persons of the bags, some of them seen from
the side and half hidden, have 0.028 and more."""

_FARTHEST_PIXEL = 1e6
"""No image is that large: what lies farther out was not seen, and squares of it need not be numbers."""

MAX_DISTANCE = 200.0
"""Metres: there a grown person's points keep about 1.5 pixels of extent for 900 pixels of focal length."""


@dataclass(frozen=True)
class Lifted:
    """N persons in 3D.

    Attributes:
        points: (N,P,3) camera optical frame (x right, y down, z forward). In metres from the camera's centre where
            ``units`` is ``"m"``; else in model units from the root. NaN for persons that were not lifted.
        root: (N,3) the layout's root point, same frame and units: of a shipped layout the middle of the hips in
            ``points``, but where a pelvis was seen beside a hidden hip.
        rotation: (N,3,3) canonical frame to camera frame, det +1.
        scale: (N,) pixels per model unit (at the person's distance).
        reprojection: (N,) pixels, root mean square over the points used, of the shape as the model has it: before its
            points were moved to where they are seen (S_cam of the paper's equation 4), after which ``points`` project
            nearer to their pixels than this says.
        unexplained: (N,) reprojection over the rms extent of the points used: 0 where the shape is that of the image,
            near 1 where it has nothing of it, as where the points are in another order than the layout's.
        ambiguity: (N,) 0..1, residual of the pose over that of its depth-reversed rival, the second optimum of
            orthographic-N-point; 0 where there is none, 1 where the image cannot tell them apart.
        certified: (N,) the pose, or what a pinhole camera's was refined from, is the proven optimum of
            orthographic-N-point.
        distance_sigma: (N,) metres, standard deviation of the root's distance: that of people's heights, unless the
            height is known, and of the fit, ``unexplained``, which the distances of the bags' persons are found to be
            wrong by. NaN in model units.
        used: (N,P) bool, the points it was lifted from: visible, within 60 degrees of the person, and not so far from
            where the lifted shape has them that a detector must have been wrong.
        reason: N slugs, '' where lifted, else why not: ``too_few_points``, fewer visible than the model asks for;
            ``degenerate_points``, they fix no pose: all on one line or in two places or, with intrinsics, an rms extent
            below ``MIN_EXTENT``; ``too_far``, in metres a coordinate would exceed ``MAX_DISTANCE``; ``behind_camera``,
            the root, or in metres a point used, would not be in front of the camera. Points that were not used may be
            behind it, as the feet of somebody close by, seen by a camera that looks up.
        units: ``"m"`` or ``"model"``.
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

    @property
    def ok(self) -> np.ndarray:
        """(N,) bool: lifted."""
        return np.array([not reason for reason in self.reason], bool)


class Lifter:
    """Lifts every person of every frame on its own: encode, decode, orthographic-N-point, perspective, placement.

    Section 4.2 of the paper, "Prediction on unseen data".
    """

    def __init__(self, model: Model, person_height: float = 0.0) -> None:
        """person_height: see that property. Raises ModelError: the model is of one fixed scale, which no image has."""
        if model.scale != "free":
            raise ModelError(
                f"model '{model.name}' is for orthographic data of one fixed scale: judge it with `paul evaluate`, "
                f"or train a model to lift with by a recipe with scale: free"
            )
        self.model = model
        self.person_height = person_height
        between = middles(model.layout)
        # (M,) points and (2,M) the two that each is the middle of.
        self._middles = np.array(list(between), int), np.array(list(between.values()), int).reshape(-1, 2).T

    @property
    def person_height(self) -> float:
        """Metres, the height that people are known to have; 0 = unknown, and the model's stature taken for it.

        Raises ModelError where it is set and the model does not tell the stature it has its metres from.
        """
        return self._person_height

    @person_height.setter
    def person_height(self, height: float) -> None:
        if height and not (self.model.stature and self.model.metres_per_unit):
            raise ModelError(
                f"model '{self.model.name}' does not tell the stature that its metres are of, so person_height cannot "
                "change them: leave it at 0"
            )
        self._person_height = height
        # What is no person has the size that the model gives it.
        self.size_spread = HEIGHT_SPREAD if self.model.stature and not height else 0.0
        self.metres_per_unit = self.model.metres_per_unit
        if height:
            self.metres_per_unit *= height / self.model.stature

    def lift(self, xy: np.ndarray, visible: np.ndarray, camera: Intrinsics | None = None) -> Lifted:
        """Lift N persons.

        Args:
            xy: (N,P,2) pixels in the model's layout; anything, NaN too, where hidden.
            visible: (N,P) bool; points more than a million pixels out count as hidden.
            camera: intrinsics of the (rectified) image; with them, and a model that knows its metres per unit, the
                output is in metres.

        Raises:
            ValueError: the arrays do not have these shapes.
        """
        xy, visible = self._checked(xy, visible)
        rows = enough_visible(visible, self.model.layout)
        if rows.all() and len(rows):
            return self._lift_seen(xy, visible, camera)
        lifted = _nothing(*visible.shape, self._units(camera))
        return _replaced(lifted, rows, self._lift_seen(xy[rows], visible[rows], camera)) if rows.any() else lifted

    def _units(self, camera: Intrinsics | None) -> str:
        return "m" if camera and self.metres_per_unit else "model"

    def _checked(self, xy: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        xy, visible = np.asarray(xy, float), np.asarray(visible, bool)
        P = len(self.model.layout.names)
        if xy.ndim != 3 or xy.shape[1:] != (P, 2) or visible.shape != xy.shape[:2]:
            raise ValueError(
                f"lift needs xy (N,{P},2) and visible (N,{P}) in layout '{self.model.layout.name}', "
                f"got {xy.shape} and {visible.shape}"
            )
        return xy, visible & (np.abs(xy) <= _FARTHEST_PIXEL).all(2)

    def _lift_seen(self, xy: np.ndarray, visible: np.ndarray, camera: Intrinsics | None) -> Lifted:
        """Persons of whom enough points are visible."""
        W, turn, pixels = xy.transpose(0, 2, 1), None, 1.0
        if camera is not None:
            view = centred_view(xy, visible, camera)
            W, visible, turn, pixels = view.W, view.seen, view.turn, (camera.fx + camera.fy) / 2
        fit = self._fit_sure(W, visible, camera is not None)
        root, units, near = list(self.model.layout.root), self._units(camera), np.True_
        shape = self._as_seen(fit, camera is not None)
        self._place_middles(shape, fit.used)
        if units == "m":
            points = place(shape + fit.T[:, :, None], turn, self.metres_per_unit)
            near = (np.abs(points) <= MAX_DISTANCE).all((1, 2))
        else:
            points = (shape - shape[:, :, root].mean(2, keepdims=True)).transpose(0, 2, 1)
        # Again: a virtual camera does not see all points.
        enough = enough_visible(visible, self.model.layout)
        fixed = fit.fixed & ~_on_a_line(W, fit.used) & (camera is None or fit.extent * pixels >= MIN_EXTENT)
        root = points[:, root].mean(1)
        unexplained = fit.residual / np.maximum(fit.extent, 1e-12)
        lifted = Lifted(
            points=points,
            root=root,
            rotation=fit.R if turn is None else turn @ fit.R,
            scale=pixels / fit.T[:, 2],
            reprojection=pixels * fit.residual,
            unexplained=unexplained,
            ambiguity=fit.ambiguity,
            certified=fit.certified,
            distance_sigma=self._sigma(root, unexplained, units),
            used=fit.used,
            reason=("",) * len(xy),
            units=units,
        )
        front = fit.T[:, 2] > 0
        if units == "m":
            front &= (root[:, 2] > 0) & ((points[..., 2] > 0) | ~fit.used).all(1)
        done = enough & fixed & near & front
        if done.all():
            return lifted
        placed = np.where(near, BEHIND_CAMERA, TOO_FAR)
        why = np.where(~enough, TOO_FEW_POINTS, np.where(~fixed, DEGENERATE_POINTS, placed))[~done]
        nothing = _nothing(len(why), visible.shape[1], units)
        return _replaced(lifted, ~done, replace(nothing, reason=tuple(why.tolist())))

    def _as_seen(self, fit: _Fit, pinhole: bool) -> np.ndarray:
        """Shapes (N,3,P) in the virtual cameras' frames, their points moved sideways to where they were seen.

        S_cam of the paper's equation 4, [W; z], as far as a detector can be trusted: a point within two standard
        deviations of the model's own misfit is taken where it is seen, one farther away moves less the farther it is.
        """
        shape = fit.R @ fit.S
        if self.model.misfit is None or isinstance(self.model, RigidModel):
            return shape
        depth = fit.T[:, 2:] + shape[:, 2] if pinhole else fit.T[:, 2:]
        square = np.maximum(fit.square * depth * depth, 1e-300)
        shape[:, :2] += (np.minimum(1.0, (2 * self.model.misfit) ** 2 / square) * depth)[:, None] * fit.missed
        return shape

    def _place_middles(self, shape: np.ndarray, used: np.ndarray) -> None:
        """Puts points that are middles of others there, in shapes (N,3,P), where they were not seen or the others were.

        So the root of a person is in the middle of its hips; a pelvis that was seen beside a hidden hip stays.
        """
        point, parts = self._middles
        known = ~used[:, point] | used[:, parts].all(1)
        shape[..., point] = np.where(known[:, None], shape[..., parts].mean(2), shape[..., point])

    def _sigma(self, root: np.ndarray, unexplained: np.ndarray, units: str) -> np.ndarray:
        if units != "m":
            return np.full(len(root), np.nan)
        return np.sqrt((root * root).sum(1) * (self.size_spread**2 + unexplained * unexplained))

    def _fit_sure(self, W: np.ndarray, visible: np.ndarray, pinhole: bool) -> _Fit:
        """Fits, once more without the points that must be misdetections, where enough are left."""
        fit = self._fit(W, visible, pinhole)
        if isinstance(self.model, RigidModel):
            return fit  # What the mean shape misses is its own fault.
        wild = _wild(fit)
        if not wild.any():
            return fit
        sure = visible & ~wild
        again = np.flatnonzero(wild.any(1) & enough_visible(sure, self.model.layout))
        if not len(again):
            return fit
        second = self._fit(W[again], sure[again], pinhole)
        for value, new in zip(fit, second):
            value[again] = new
        return fit

    def _fit(self, W: np.ndarray, visible: np.ndarray, pinhole: bool) -> _Fit:
        """From image points (N,2,P): normalised ones of a pinhole camera, or any under weak perspective."""
        S = self.model.shape(W, visible).astype(float)
        pose = onp(S, W, visible)
        fixed = pose.determined & (pose.scale > 0)
        scale = np.where(fixed, pose.scale, 1.0)[:, None]
        R, T = pose.R, np.concatenate([pose.translation, np.ones_like(scale)], axis=1) / scale
        if pinhole:
            R, T, missed = refine(S, W, visible, R, T)
        else:
            missed = np.where(visible[:, None], W - scale[..., None] * (R[:, :2] @ S + T[:, :2, None]), 0.0)
        square = (missed * missed).sum(1)
        residual = np.sqrt(square.sum(1) / np.maximum(visible.sum(1), 1))
        used, certified = visible.copy(), pose.certified.copy()
        return _Fit(S, R, T, missed, square, residual, used, fixed, pose.ambiguity, certified, pose.extent)


class _Fit(NamedTuple):
    """N shapes (N,3,P) and their poses, in model units: R (N,3,3), T (N,3), T[2] the inverse of the scale.

    missed: (N,2,P) image points less those of the model, nothing where not used; square: (N,P) of their lengths;
    residual: (N,) root mean square of those used; used: (N,P) the points it was made from; fixed: (N,), they determine
    a pose; extent: (N,) root mean square distance of the image points from their mean.
    """

    S: np.ndarray
    R: np.ndarray
    T: np.ndarray
    missed: np.ndarray
    square: np.ndarray
    residual: np.ndarray
    used: np.ndarray
    fixed: np.ndarray
    ambiguity: np.ndarray
    certified: np.ndarray
    extent: np.ndarray


def _wild(fit: _Fit) -> np.ndarray:
    """(N,P) bool: points used that the found shape misses so far that a detector must have been wrong."""
    wild = fit.square > (_WILD_EXTENT * fit.extent)[:, None] ** 2
    if wild.any():
        middle = np.maximum(fit.used.sum(1, keepdims=True) - 1, 0) // 2
        median = np.take_along_axis(np.sort(np.where(fit.used, fit.square, np.inf), axis=1), middle, axis=1)
        wild &= fit.square > _WILD**2 * median
    return wild


def _on_a_line(W: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(N,) bool: the used ones (N,P) of image points (N,2,P) have no breadth, by the second moments about their mean.

    The product of the two principal moments over the square of their sum is next to their ratio, where that is small.
    """
    X = np.where(used[:, None], W, 0.0)
    X = np.where(used[:, None], X - X.sum(2, keepdims=True) / np.maximum(used.sum(1), 1)[:, None, None], 0.0)
    (xx, yy), xy = (X * X).sum(2).T, X.prod(1).sum(1)
    return xx * yy - xy * xy <= _LINE**2 * (xx + yy) ** 2


def _nothing(N: int, P: int, units: str) -> Lifted:
    """N persons that were not lifted, for want of points."""
    return Lifted(
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
        reason=(TOO_FEW_POINTS,) * N,
        units=units,
    )


def _replaced(lifted: Lifted, rows: np.ndarray, others: Lifted) -> Lifted:
    """lifted with the rows (N,) bool taken from the persons of others, in their order."""
    mixed = {}
    for name, value in vars(lifted).items():
        if name != "units":
            mixed[name] = np.array(value, object) if name == "reason" else value.copy()
            mixed[name][rows] = getattr(others, name)
    return replace(lifted, **{**mixed, "reason": tuple(mixed["reason"])})
