# SPDX-License-Identifier: Apache-2.0
"""The arguments of the Lifter: checked, and converted to arrays, intrinsics and layouts."""

from __future__ import annotations

import math
import numbers
import os
import warnings
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from msg_adapters.camera_info import read_camera_info
from msg_adapters.intrinsics import Intrinsics
from msg_adapters.keypoints import MessageError
from paul_ros.errors import InputError
from paul_ros.layout import Layout, layout_names, load_layout
from paul_ros.placeholders import look_normalised, placeholders

_FOCAL_LENGTHS = (10.0, 1e6)
"""Lowest and highest plausible focal length in pixels. A normalised K is below them."""

HEIGHTS = (0.3, 3.0)
"""Lowest and highest height of a person in metres, as for the parameter person_height. Centimetres are above them."""
_LIMITS = "{:g} to {:g}".format(*_FOCAL_LENGTHS)


class CameraInfo(Protocol):
    """A sensor_msgs/CameraInfo of any message library, as far as `read_camera_info` reads it."""

    @property
    def width(self) -> Any: ...
    @property
    def height(self) -> Any: ...
    @property
    def distortion_model(self) -> Any: ...
    @property
    def d(self) -> Any: ...
    @property
    def k(self) -> Any: ...
    @property
    def p(self) -> Any: ...
    @property
    def binning_x(self) -> Any: ...
    @property
    def binning_y(self) -> Any: ...
    @property
    def roi(self) -> Any: ...


Camera = Intrinsics | CameraInfo | ArrayLike
"""A camera: intrinsics, a CameraInfo message, or a 3x3 camera matrix K in pixels of a rectified image."""


def as_points(points: ArrayLike, visible: ArrayLike | None, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Convert 2D points and their visibility to arrays.

    Args:
        points: (N,P,2) or (P,2) pixels, any array or nested list.
        visible: (N,P) or (P,) bool, or 0 and 1; None for all points with finite coordinates but placeholders.
        layout: layout of the P points.

    Returns:
        Points (N,P,2) float64 and visibility (N,P) bool; N = 1 for points (P,2).

    Raises:
        InputError: a shape or type is wrong; the text says what to pass instead.
    """
    given = _as_floats(points, "points")
    xy = given[None] if given.ndim == 2 else given
    P = len(layout.names)
    if xy.ndim != 3 or xy.shape[1:] != (P, 2):
        raise InputError(
            f"points have shape {given.shape}, layout '{layout.name}' needs (N,{P},2), or ({P},2) for one "
            f"person{_advice(xy, layout)}"
        )
    if visible is None:
        seen = np.isfinite(xy).all(2)
        seen &= ~placeholders(xy[..., 0], xy[..., 1], seen)
    else:
        seen = _as_visibility(visible, given).reshape(xy.shape[:2])
    if look_normalised(xy[..., 0], xy[..., 1], seen):
        text = "points look normalised to 0..1: multiply x by the image's width and y by its height"
        warnings.warn(text, stacklevel=3)  # at the caller of Lifter.lift
    return xy, seen


def as_intrinsics(camera: Camera | None) -> Intrinsics | None:
    """Convert a camera to intrinsics.

    Args:
        camera: Intrinsics, a 3x3 camera matrix K in pixels (array or nested list), or a sensor_msgs/CameraInfo of any
            message library; None stays None.

    Raises:
        InputError: the camera is none of these, or has implausible values.
    """
    if camera is None:
        return None
    if isinstance(camera, Intrinsics):
        if not _plausible(camera.fx, camera.fy, camera.cx, camera.cy):
            high = _FOCAL_LENGTHS[1]
            raise InputError(
                f"camera has fx {camera.fx!r}, fy {camera.fy!r}, cx {camera.cx!r}, cy {camera.cy!r}: pass numbers "
                f"that are finite, focal lengths of {_LIMITS} pixels, and a principal point within {high:g}"
            )
        return camera
    if hasattr(camera, "k") and hasattr(camera, "p"):
        try:
            intrinsics = read_camera_info(camera)
        except MessageError as error:
            raise InputError(str(error)) from None
        except (AttributeError, IndexError, TypeError, ValueError) as error:
            raise InputError(f"camera of type {type(camera).__name__} is no sensor_msgs/CameraInfo: {error}") from None
        for note in intrinsics.notes:
            warnings.warn(note.text, stacklevel=3)  # at the caller of Lifter.lift
        return intrinsics
    K = _as_floats(camera, "camera")
    if K.shape != (3, 3):
        raise InputError(
            f"camera has shape {K.shape}: pass Intrinsics, a 3x3 camera matrix K in pixels, or a sensor_msgs/CameraInfo"
        )
    (fx, skew, cx), (zero, fy, cy), last = K.tolist()
    if skew or zero or last != [0, 0, 1] or not _plausible(fx, fy, cx, cy):
        raise InputError(
            f"camera {K.tolist()} is no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with focal lengths from "
            f"{_LIMITS} pixels: pass the K of the rectified image, not normalised, without skew"
        )
    return Intrinsics(fx, fy, cx, cy, 0, 0, matrix="K")


def as_layout(layout: Layout | str | os.PathLike[str]) -> Layout:
    """Return a layout, given itself, its name, or the path of its YAML file.

    Raises:
        LayoutError: the argument is none of these, or there is no such layout.
    """
    return layout if isinstance(layout, Layout) else load_layout(layout)


def check_height(height: Any) -> None:
    """Check a height of persons in metres; 0 is an unknown height.

    Raises:
        InputError: the height is no number, or no person's in metres.
    """
    low, high = HEIGHTS
    if not (isinstance(height, numbers.Real) and (height == 0 or low <= float(height) <= high)):
        raise InputError(f"person_height is {height!r}: pass metres, from {low:g} to {high:g}, or 0 if it is unknown")


def _plausible(fx: Any, fy: Any, cx: Any, cy: Any) -> bool:
    """Return whether focal lengths and principal point in pixels are numbers of a camera."""
    low, high = _FOCAL_LENGTHS
    are_numbers = all(isinstance(value, numbers.Real) and math.isfinite(value) for value in (fx, fy, cx, cy))
    return are_numbers and low <= fx <= high and low <= fy <= high and max(abs(cx), abs(cy)) <= high


def _as_visibility(visible: ArrayLike, points: np.ndarray) -> np.ndarray:
    """Return visibility as bool, of the shape of the points (..., 2) without their last axis."""
    try:
        seen = np.asarray(visible)
    except ValueError as error:  # rows of unequal length
        raise InputError(f"visible cannot be an array: {error}") from None
    if seen.shape != points.shape[:-1]:
        raise InputError(f"visible has shape {seen.shape}, points {points.shape} need {points.shape[:-1]}")
    if seen.dtype != bool:
        if seen.dtype.kind not in "iuf" or not ((seen == 0) | (seen == 1)).all():
            raise InputError("visible must be true or false: compare confidences with a threshold, as in scores > 0.3")
        seen = seen.astype(bool)
    return seen


def _as_floats(values: Any, name: str) -> np.ndarray:
    try:
        # A masked value is a hidden one.
        return np.ma.filled(np.ma.asarray(values, float), np.nan) if np.ma.isMA(values) else np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} of type {type(values).__name__} cannot be an array of numbers: {error}") from None


def _advice(xy: np.ndarray, layout: Layout) -> str:
    """Return what to change about points of a wrong shape, as the end of an error; '' if nothing comes to mind."""
    P = len(layout.names)
    if xy.ndim != 3:
        return ""
    if xy.shape[2] == 3:
        return ": pass x and y as points[..., :2], and confidences as visible=points[..., 2] > 0.3"
    if xy.shape[1:] == (2, P):
        return ": transpose them"
    shipped = map(load_layout, layout_names())
    fitting = [other.name for other in shipped if (len(other.names), 2) == xy.shape[1:] and other.fits(layout)]
    if not fitting:
        return ""
    return f": name their layout, as in layout='{fitting[0]}'; these have so many points: {', '.join(fitting)}"
