# SPDX-License-Identifier: Apache-2.0
"""The Lifter: 2D keypoints of single frames to 3D points in the camera frame."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import ArrayLike

from msg_adapters.intrinsics import Intrinsics
from paul_ros.errors import InputError, ModelError
from paul_ros.layout import Layout, midpoints
from paul_ros.lift_arguments import Camera, as_intrinsics, as_layout, as_points, check_height
from paul_ros.lifted import (
    BEHIND_CAMERA,
    DEGENERATE_POINTS,
    MAX_DISTANCE,
    MIN_EXTENT,
    TOO_FAR,
    TOO_FEW_POINTS,
    Lifted,
)
from paul_ros.model import Model, RigidModel
from paul_ros.model_file import load_model
from paul_ros.normalisation import enough_visible
from paul_ros.placement import CentredView, centred_view, place
from paul_ros.route import Route
from paul_ros.shape_fit import ShapeFit, fit_shapes

HEIGHT_SPREAD = 0.06
"""Standard deviation of the heights of adults over their mean: men 175.3, women 161.3 cm, each with about 7.3 cm
(Fryar et al., Anthropometric Reference Data, United States 2015-2018, Vital and Health Statistics 3(46), 2021)."""

_LINE = 0.005
"""Points are on one line if their rms spread across it is below this share of the rms spread along it: 0.3 pixels, the
rounding to whole ones, on 60. Persons in the shipped bags, some seen from the side and half hidden, have at least
0.028."""

_FARTHEST_PIXEL = 1e6
"""No image is that large: a point farther out is hidden, and its square may overflow."""


class Lifter:
    """Lift every person of every frame independently: the paper's section 4.2, "Prediction on unseen data".

    >>> import numpy as np
    >>> lifter = Lifter("human")
    >>> points = np.random.default_rng(0).uniform(100, 500, (17, 2))
    >>> lifted = lifter.lift(points, camera=[[600, 0, 320], [0, 600, 240], [0, 0, 1]], layout="coco17")
    >>> lifted
    Lifted(1 person, 1 lifted, m, coco17)
    >>> lifted.points.shape
    (1, 17, 3)

    Args:
        model: a Model, the name of a shipped model such as ``"human"``, or the path of a model file.
        person_height: known height of the persons in metres; 0 if unknown.

    Raises:
        ModelError: there is no such model, its file is damaged, or it has one fixed scale, which no image has.
        ModelError: a height is given, and the model does not know the stature that its metres refer to.
        InputError: the height is no number of metres.

    Attributes:
        model: the shape model.
        metres_per_unit: metres per model unit; None if the model does not know them.
        size_spread: standard deviation of the persons' size over their mean size; 0 if it is known.
    """

    def __init__(self, model: Model | str | os.PathLike[str], person_height: float = 0.0) -> None:
        """Prepare a model for lifting; the class has the arguments."""
        if not isinstance(model, Model):
            model = load_model(model)
        if model.scale != "free":
            raise ModelError(
                f"model '{model.name}' is for orthographic data of one fixed scale: judge it with `paul evaluate`, "
                f"or train a model to lift with by a recipe with scale: free"
            )
        self.model = model
        self.person_height = person_height
        between = midpoints(model.layout)
        # (M,) midpoints and (2,M) the two points of each.
        self._midpoints = np.array(list(between), int), np.array(list(between.values()), int).reshape(-1, 2).T

    @property
    def person_height(self) -> float:
        """Known height of the persons in metres; 0 if unknown, and the model's stature is assumed.

        Raises:
            InputError: on setting, the height is no number of metres.
            ModelError: on setting, the model does not know the stature that its metres refer to.
        """
        return self._person_height

    @person_height.setter
    def person_height(self, height: float) -> None:
        stature, metres = self.model.stature, self.model.metres_per_unit
        check_height(height)
        if height:
            if not (stature and metres):
                raise ModelError(
                    f"model '{self.model.name}' does not tell the stature that its metres refer to, so person_height "
                    "cannot scale them: leave it at 0"
                )
            metres *= height / stature
        self._person_height = height
        self.metres_per_unit = metres
        # Other objects than persons have the size that the model gives them.
        self.size_spread = HEIGHT_SPREAD if stature and not height else 0.0

    def lift(
        self,
        points: ArrayLike,
        visible: ArrayLike | None = None,
        camera: Camera | None = None,
        layout: Layout | str | os.PathLike[str] | None = None,
    ) -> Lifted:
        """Lift N persons.

        Args:
            points: (N,P,2) pixels, or (P,2) for one person; NaN, or any other value, where hidden.
            visible: (N,P), or (P,) for one person, bool; None for all points with finite coordinates, without (0, 0),
                (-1, -1) and the like. Points more than a million pixels out are always hidden.
            camera: camera of the image, for output in metres; None for output in model units. It is a
                sensor_msgs/CameraInfo message, whose distortion is corrected if the image is raw; the rule is that of
                ``msg_adapters.read_camera_info``. If you know which image it is, pass what that function returns. Or
                it is Intrinsics or a 3x3 camera matrix K in pixels, both of a rectified image.
            layout: layout of the points: a shipped one by name, the path of a YAML file, or a Layout. None
                for the model's own.

        Returns:
            N persons (N = 1 for one person without the first axis). Their points are in the given layout if the
            model completes all of its points, else in the model's; ``Lifted.layout`` names it.

        Raises:
            InputError: an argument has a wrong shape, type or value.
            LayoutError: the layout does not exist, is malformed, or shares fewer than 3 points with the model's.
        """
        intrinsics = as_intrinsics(camera)
        route = Route.between(as_layout(layout), self.model.layout) if layout is not None else None
        xy, seen = as_points(points, visible, route.given if route else self.model.layout)
        if intrinsics and intrinsics.distortion:
            xy = intrinsics.to_pinhole(xy)
            seen = seen & np.isfinite(xy).all(2)
        if route is None:
            return self.lift_in_model_layout(xy, seen, intrinsics)
        xy, seen = route.into.values(xy), route.into.visibility(seen)
        return route.lifted_out(self.lift_in_model_layout(xy, seen, intrinsics))

    def lift_in_model_layout(self, xy: np.ndarray, visible: np.ndarray, camera: Intrinsics | None = None) -> Lifted:
        """Lift N persons whose points are arrays in the model's own layout.

        Args:
            xy: (N,P,2) pixels of the pinhole camera; any value where hidden.
            visible: (N,P) bool; points more than a million pixels out are hidden.
            camera: the pinhole camera, for output in metres; None for model units. Its distortion is ignored.

        Raises:
            InputError: the arrays have other shapes.
        """
        xy, visible = self._checked(xy, visible)
        rows = enough_visible(visible, self.model.layout)
        if rows.all() and len(rows):
            return self._lift_visible(xy, visible, camera)
        lifted = Lifted.nobody((TOO_FEW_POINTS,) * len(xy), self.model.layout, self._units(camera))
        return lifted.with_rows(rows, self._lift_visible(xy[rows], visible[rows], camera)) if rows.any() else lifted

    def _units(self, camera: Intrinsics | None) -> str:
        return "m" if camera and self.metres_per_unit else "model"

    def _checked(self, xy: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        try:
            xy, visible = np.asarray(xy, float), np.asarray(visible, bool)
        except (TypeError, ValueError) as error:
            raise InputError(f"xy and visible must be arrays of numbers: {error}") from None
        P = len(self.model.layout.names)
        if xy.ndim != 3 or xy.shape[1:] != (P, 2) or visible.shape != xy.shape[:2]:
            raise InputError(
                f"lift needs xy (N,{P},2) and visible (N,{P}) in layout '{self.model.layout.name}', "
                f"got {xy.shape} and {visible.shape}"
            )
        return xy, visible & (np.abs(xy) <= _FARTHEST_PIXEL).all(2)

    def _lift_visible(self, xy: np.ndarray, visible: np.ndarray, camera: Intrinsics | None) -> Lifted:
        """Lift persons with enough visible points."""
        # Turn a virtual camera towards every person.
        view, W, seen, pixels = None, xy.transpose(0, 2, 1), visible, 1.0
        if camera is not None:
            view = centred_view(xy, visible, camera)
            W, seen, pixels = view.W, view.seen, (camera.fx + camera.fy) / 2
        # Fit the model's shapes and their poses to the image points.
        fit = fit_shapes(self.model, W, seen, pinhole=view is not None)
        # Move the points to where they were seen, and midpoints between their ends.
        shape = self._as_seen(fit, pinhole=view is not None)
        self._place_midpoints(shape, fit.used)
        # Place the shapes before the real camera.
        points, units = self._placed(shape, fit, view)
        root = points[:, list(self.model.layout.root)].mean(1)
        unexplained = fit.residual / np.maximum(fit.extent, 1e-12)
        lifted = Lifted(
            points=points,
            root=root,
            rotation=fit.R if view is None else view.turn @ fit.R,
            scale=pixels / fit.T[:, 2],
            reprojection=pixels * fit.residual,
            unexplained=unexplained,
            ambiguity=fit.ambiguity,
            certified=fit.certified,
            distance_sigma=self._distance_sigma(root, unexplained, units),
            used=fit.used,
            reason=("",) * len(xy),
            units=units,
            layout=self.model.layout,
        )
        # Reject persons that cannot be as they were lifted. A virtual camera may see fewer points than the real one.
        enough = enough_visible(seen, self.model.layout)
        fixed = fit.fixed & ~_on_a_line(W, fit.used) & (camera is None or fit.extent * pixels >= MIN_EXTENT)
        return _without_rejected(lifted, enough, fixed, fit.T[:, 2] > 0)

    def _as_seen(self, fit: ShapeFit, pinhole: bool) -> np.ndarray:
        """Return shapes (N,3,P) in the virtual cameras' frames, with points moved sideways to where they were seen.

        This is S_cam = [W; z] of the paper's equation 4, as far as a detector can be trusted. Points within two
        standard deviations of the model's misfit move all the way; the farther others are, the less they move.
        """
        shape = fit.R @ fit.S
        if self.model.misfit is None or isinstance(self.model, RigidModel):
            return shape
        depth = fit.T[:, 2:] + shape[:, 2] if pinhole else fit.T[:, 2:]
        square = np.maximum(fit.square * depth * depth, 1e-300)
        shape[:, :2] += (np.minimum(1.0, (2 * self.model.misfit) ** 2 / square) * depth)[:, None] * fit.missed
        return shape

    def _place_midpoints(self, shape: np.ndarray, used: np.ndarray) -> None:
        """Move midpoints in shapes (N,3,P), in place, to the mean of their two points.

        So the root of a person is in the middle of its hips. A midpoint that was seen stays if one of its two points
        was not, for instance a pelvis beside a hidden hip.
        """
        point, parts = self._midpoints
        known = ~used[:, point] | used[:, parts].all(1)
        shape[..., point] = np.where(known[:, None], shape[..., parts].mean(2), shape[..., point])

    def _placed(self, shape: np.ndarray, fit: ShapeFit, view: CentredView | None) -> tuple[np.ndarray, str]:
        """Return points (N,P,3) in the camera's optical frame, and their units.

        They are metres from the camera if it and the model's metres are known, else model units from the root.
        """
        if view is not None and self.metres_per_unit:
            return place(shape + fit.T[:, :, None], view, self.metres_per_unit), "m"
        root = list(self.model.layout.root)
        from_root = shape - shape[:, :, root].mean(2, keepdims=True)
        return from_root.transpose(0, 2, 1) if view is None else place(from_root, view, 1.0), "model"

    def _distance_sigma(self, root: np.ndarray, unexplained: np.ndarray, units: str) -> np.ndarray:
        if units != "m":
            return np.full(len(root), np.nan)
        return np.sqrt((root * root).sum(1) * (self.size_spread**2 + unexplained * unexplained))


def _without_rejected(lifted: Lifted, enough: np.ndarray, fixed: np.ndarray, front: np.ndarray) -> Lifted:
    """Replace persons that cannot be lifted by NaN and the reason.

    Args:
        lifted: N persons.
        enough: (N,) bool, enough points are visible.
        fixed: (N,) bool, the points fix a pose.
        front: (N,) bool, the origin of the shape is in front of the camera.
    """
    near = np.True_
    if lifted.units == "m":
        near = (np.abs(lifted.points) <= MAX_DISTANCE).all((1, 2))
        front = front & (lifted.root[:, 2] > 0) & ((lifted.points[..., 2] > 0) | ~lifted.used).all(1)
    done = enough & fixed & near & front
    if done.all():
        return lifted
    placed = np.where(near, BEHIND_CAMERA, TOO_FAR)
    why = np.where(~enough, TOO_FEW_POINTS, np.where(~fixed, DEGENERATE_POINTS, placed))[~done]
    return lifted.with_rows(~done, Lifted.nobody(tuple(why.tolist()), lifted.layout, lifted.units))


def _on_a_line(W: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return (N,) bool, the used points (N,P) of W (N,2,P) lie on one line, by their second moments.

    The product of the two principal moments over the square of their sum is close to their ratio if that is small.
    """
    X = np.where(used[:, None], W, 0.0)
    X = np.where(used[:, None], X - X.sum(2, keepdims=True) / np.maximum(used.sum(1), 1)[:, None, None], 0.0)
    (xx, yy), xy = (X * X).sum(2).T, X.prod(1).sum(1)
    return xx * yy - xy * xy <= _LINE**2 * (xx + yy) ** 2
