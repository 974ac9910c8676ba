# SPDX-License-Identifier: Apache-2.0
"""Lens distortion by the models of sensor_msgs/CameraInfo: plumb_bob, rational_polynomial and equidistant.

Positions are normalised: x/z and y/z of a ray for the pinhole camera, (u - cx) / fx and (v - cy) / fy in the image.
Sources: sensor_msgs/distortion_models.hpp (names), the manual of OpenCV's calib3d (polynomials, order of coefficients),
Kannala and Brandt, A generic camera model and calibration method, PAMI 2006 (equidistant).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: The model of fisheye lenses.
EQUIDISTANT = "equidistant"
#: Model -> allowed numbers of coefficients. Trailing zeros beyond these are ignored. Drivers send eight numbers as
#: plumb_bob too, so both names stand for OpenCV's polynomial of that many coefficients.
_COUNTS = {"plumb_bob": (4, 5, 8, 12), "rational_polynomial": (4, 5, 8, 12), EQUIDISTANT: (4,)}
#: Largest plausible coefficient; others come from uninitialised memory or from a calibration that failed.
_MAX_COEFFICIENT = 1e6
#: Smallest plausible angle from the axis at which a polynomial may fold the image back.
_MIN_ANGLE = np.radians(1.0)
#: Rays farther from the optical axis have no usable position in a pinhole image.
_MAX_ANGLE = np.radians(89.0)
#: Number of angles at which the distorted radius is tabulated.
_SAMPLES = 1781
_MAX_STEPS = 20
_TINY = 1e-12
#: Largest error of a solution in normalised units, about a millionth of a pixel.
_TOLERANCE = 1e-9
#: Share by which the tangential terms may move the border of the invertible region.
_BORDER = 1.02


@dataclass(frozen=True)
class Distortion:
    """The distortion of a lens.

    Attributes:
        model: name in CameraInfo's distortion_model.
        coefficients: k1 to k4 of equidistant; otherwise k1, k2, p1, p2, k3 to k6, s1 to s4 in the order of OpenCV, the
            missing ones 0.
    """

    model: str
    coefficients: tuple[float, ...]

    def distort(self, rays: np.ndarray) -> np.ndarray:
        """Map x/z and y/z of rays (...,2) to their positions in the image (...,2); NaN where none is defined.

        A ray has no position if it is farther from the axis than the invertible region of the model.
        """
        ray = _as_complex(rays)
        tangent = np.abs(ray)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            if self.model == EQUIDISTANT:
                position = ray * _distorted_angle(self, np.arctan(tangent)) / np.maximum(tangent, _TINY)
            else:
                position, *_ = _polynomial(self, ray)
        return _as_pairs(position, tangent <= _BORDER * np.tan(_table(self)[0][-1]))

    def undistort(self, positions: np.ndarray) -> np.ndarray:
        """Map positions in the image (...,2) to x/z and y/z of their rays (...,2); NaN where no ray leads."""
        position = _as_complex(positions)
        radius = np.abs(position)
        angles, radii = _table(self)
        # The radial terms alone, inverted by a table, are a start close to the solution.
        angle = np.interp(radius, radii, angles)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            if self.model == EQUIDISTANT:
                angle, solved = _solve_angle(self, angle, radius)
                return _as_pairs(position * np.tan(angle) / np.maximum(radius, _TINY), solved)
            start = position * np.tan(angle) / np.maximum(radius, _TINY)
            return _as_pairs(*_solve_polynomial(self, start, position))


def read_distortion(model: str, coefficients: Sequence[float]) -> Distortion | None:
    """Read distortion_model and D of a CameraInfo.

    An empty name stands for OpenCV's polynomial of that many coefficients, as in OpenCV's own calibration files.

    Returns:
        The distortion, or None if all coefficients are 0 and the model is a pinhole camera then. An equidistant lens
        is none: its image radius is the focal length times the angle, corrected by the coefficients.

    Raises:
        ValueError: the model is unknown, or the coefficients are not those of the model; the text says why.
    """
    values = [float(value) for value in coefficients]
    if not any(values):
        if model != EQUIDISTANT:
            return None
        values = [0.0] * 4
    model = model or "rational_polynomial"
    if model not in _COUNTS:
        raise ValueError(f"the distortion model '{model}' is not known; known are {', '.join(_COUNTS)}")
    wrong = [value for value in values if not abs(value) <= _MAX_COEFFICIENT]
    if wrong:
        raise ValueError(f"D holds {wrong[0]:g}, which no calibration gives")
    counts = _COUNTS[model]
    while len(values) > counts[-1] and not values[-1]:
        values.pop()
    if len(values) not in counts:
        raise ValueError(f"D has {len(coefficients)} numbers, and {model} takes {', '.join(map(str, counts))}")
    size = 4 if model == EQUIDISTANT else 12
    lens = Distortion(model, (*values, *[0.0] * (size - len(values))))
    if (border := _table(lens)[0][-1]) < _MIN_ANGLE:
        raise ValueError(f"D folds the image back {np.degrees(border):.2g} degrees from the axis")
    return lens


def _distorted_angle(lens: Distortion, angle: np.ndarray) -> np.ndarray:
    """Return the distance from the principal point, in focal lengths, at angles from the axis in radians."""
    k1, k2, k3, k4 = lens.coefficients
    square = angle * angle
    return angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))


def _solve_angle(lens: Distortion, angle: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles whose distance is `radius`, by Newton's method from `angle`, and where there is one."""
    k1, k2, k3, k4 = lens.coefficients
    farthest = _table(lens)[0][-1]
    for _ in range(_MAX_STEPS):
        error = radius - _distorted_angle(lens, angle)
        solved = np.abs(error) <= _TOLERANCE
        if solved.all():
            break
        square = angle * angle
        slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
        angle = np.clip(angle + error / slope, 0.0, farthest)
    return angle, solved


def _solve_polynomial(lens: Distortion, ray: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays of positions, by Newton's method from `ray`, and where there is one."""
    farthest = _BORDER * np.tan(_table(lens)[0][-1])
    for _ in range(_MAX_STEPS):
        reached, by_ray, by_conjugate = _polynomial(lens, ray)
        error = position - reached
        solved = np.abs(error) <= _TOLERANCE
        if solved.all():
            break
        determinant = np.abs(by_ray) ** 2 - np.abs(by_conjugate) ** 2
        # The solution of by_ray * step + by_conjugate * conj(step) = error.
        ray = ray + (by_ray.conj() * error - by_conjugate * error.conj()) / determinant
        # A step too far could reach a solution beyond the border, where the image folds back.
        ray = ray * np.minimum(1.0, farthest / np.maximum(np.abs(ray), _TINY))
    return ray, solved


def _polynomial(lens: Distortion, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions of rays, all as complex numbers, and the derivatives by the ray and by its conjugate.

    With z = x + iy and q = |z|^2 OpenCV's polynomials are z L(q) + 2 q p + conj(p) z^2 + q s + q^2 t. L is radial,
    p = p2 + i p1 tangential, s = s1 + i s3 and t = s2 + i s4 are those of a thin prism.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = lens.coefficients
    tangential, offset, prism = complex(p2, p1), complex(2 * p2 + s1, 2 * p1 + s3), complex(s2, s4)
    square = ray.real * ray.real + ray.imag * ray.imag
    below = 1 + square * (k4 + square * (k5 + square * k6))
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / below
    slope = k1 + square * (2 * k2 + square * 3 * k3) - radial * (k4 + square * (2 * k5 + square * 3 * k6))
    slope = slope / below
    power = ray * ray
    shared = offset + 2 * prism * square
    return (
        ray * radial + tangential.conjugate() * power + square * (offset + prism * square),
        radial + square * slope + shared * ray.conj() + 2 * tangential.conjugate() * ray,
        power * slope + shared * ray,
    )


def _as_complex(pairs: np.ndarray) -> np.ndarray:
    return np.asarray(pairs[..., 0] + 1j * pairs[..., 1])


def _as_pairs(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return complex values (...) as pairs (...,2), NaN where they are not known."""
    return np.where(known[..., None], np.stack([values.real, values.imag], -1), np.nan)


@functools.lru_cache(maxsize=8)
def _table(lens: Distortion) -> tuple[np.ndarray, np.ndarray]:
    """Return angles from the axis and the distorted radii there, as far as the radii grow.

    Beyond, the polynomial folds the image back: two rays would have one position.
    """
    angles = np.linspace(0.0, _MAX_ANGLE, _SAMPLES)
    if lens.model == EQUIDISTANT:
        radii = _distorted_angle(lens, angles)
    else:
        k1, k2, _, _, k3, k4, k5, k6 = lens.coefficients[:8]
        square = np.tan(angles) ** 2
        below = 1 + square * (k4 + square * (k5 + square * k6))
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            radii = np.tan(angles) * (1 + square * (k1 + square * (k2 + square * k3))) / below
    folded = ~((np.diff(radii) > 0) & np.isfinite(radii[1:]))
    count = int(np.argmax(folded)) + 1 if folded.any() else len(angles)
    return angles[:count], radii[:count]
