# SPDX-License-Identifier: Apache-2.0
"""Distortion against forward models written here point by point, and its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msg_adapters.distortion import Distortion, read_distortion

#: Distortions of real lenses: a webcam, an industrial barrel lens, a depth camera, a fisheye; and a thin prism.
LENSES = [
    ("plumb_bob", [0.11, -0.24, 0.0009, -0.0012, 0.08]),
    ("plumb_bob", [-0.32, 0.12, 0.001, -0.0005]),
    ("rational_polynomial", [0.52, -2.63, 0.0007, 0.0001, 1.52, 0.40, -2.45, 1.45]),
    ("rational_polynomial", [0.2, 0.1, 0.002, -0.001, 0.01, 0.3, 0.1, 0.02, 0.004, -0.002, -0.003, 0.001]),
    ("equidistant", [-0.012, 0.021, -0.006, 0.001]),
    ("equidistant", [0.35, -0.21, 0.09, -0.01]),
]


def forward(model: str, d: list[float], x: float, y: float) -> tuple[float, float]:
    """Return the distorted position of one ray, by the formulas as the manuals print them."""
    r = math.hypot(x, y)
    if model == "equidistant":
        theta = math.atan(r)
        distorted = theta + d[0] * theta**3 + d[1] * theta**5 + d[2] * theta**7 + d[3] * theta**9
        return (x * distorted / r, y * distorted / r) if r else (0.0, 0.0)
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = [*d, *[0.0] * (12 - len(d))]
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2) + s1 * r**2 + s2 * r**4,
        y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y + s3 * r**2 + s4 * r**4,
    )


def rays(rng: np.random.Generator, degrees: float, count: int = 200) -> np.ndarray:
    """Return x/z, y/z of rays up to an angle from the axis, with the axis itself."""
    angle, turn = np.radians(rng.uniform(0, degrees, count)), rng.uniform(0, 2 * np.pi, count)
    angle[0] = 0.0
    return np.tan(angle)[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)


@pytest.mark.parametrize("model, d", LENSES)
def test_the_inverse_of_an_independent_forward_model(model, d):
    lens = read_distortion(model, d)
    given = rays(np.random.default_rng(0), 80 if model == "equidistant" else 35)
    image = np.array([forward(model, d, *ray) for ray in given.tolist()])
    np.testing.assert_allclose(lens.distort(given), image, atol=1e-12)
    np.testing.assert_allclose(lens.undistort(image), given, atol=1e-7)
    assert lens.undistort(image[:6].reshape(2, 3, 2)).shape == (2, 3, 2)


@pytest.mark.parametrize("seed", range(40))
def test_random_lenses_are_inverted_or_refuse(seed):
    """A ray that is returned always leads to its position; inside the calibrated field every position has one."""
    rng = np.random.default_rng(seed)
    equidistant = seed % 2
    model = "equidistant" if equidistant else "rational_polynomial"
    spread = [0.1, 0.05, 0.02, 0.01] if equidistant else [0.3, 0.2, 0.005, 0.005, 0.1, 0.3, 0.2, 0.1]
    d = (rng.uniform(-1, 1, len(spread)) * spread).tolist()
    lens = read_distortion(model, d)
    image = rng.uniform(-3, 3, (300, 2))
    back = lens.undistort(image)
    known = np.isfinite(back).all(1)
    again = np.array([forward(model, d, *ray) for ray in back[known].tolist()]).reshape(-1, 2)
    np.testing.assert_allclose(again, image[known], atol=1e-8)
    assert np.degrees(np.arctan(np.hypot(*back[known].T))).max() < 89.1
    inner = rays(rng, 30)
    np.testing.assert_allclose(lens.undistort(lens.distort(inner)), inner, atol=1e-6)


def test_a_position_beyond_the_fold_has_no_ray():
    """The largest value of r (1 - 0.3 r^2) is 0.7027, at r = 1.054."""
    lens = read_distortion("plumb_bob", [-0.3, 0, 0, 0])
    positions = np.array([[0.70, 0], [0, -0.70], [0.71, 0], [0.5, 0.51], [40.0, 3.0], [np.nan, 0]])
    back = lens.undistort(positions)
    assert np.isfinite(back).all(1).tolist() == [True, True, False, False, False, False]
    assert 0.9 < back[0, 0] < 1.055
    assert np.isnan(lens.distort(np.array([[1.2, 0.0]]))).all()


def test_a_fisheye_sees_as_far_as_89_degrees():
    lens = read_distortion("equidistant", [1e-9, 0, 0, 0])
    back = lens.undistort(np.radians([[88.9, 0], [0, 89.1], [120, 0]]))
    np.testing.assert_allclose(back[0], [np.tan(np.radians(88.9)), 0], rtol=1e-5)
    assert np.isnan(back[1:]).all()


@pytest.mark.parametrize(
    "model, d, read",
    [
        ("plumb_bob", [], None),
        ("equidistant", [], ("equidistant", 4)),
        ("equidistant", [0.0] * 4, ("equidistant", 4)),
        ("plumb_bob", [0.0] * 5, None),
        ("anything", [0.0] * 3, None),
        ("plumb_bob", [0.1, 0, 0, 0], ("plumb_bob", 12)),
        ("plumb_bob", [0.1, 0, 0, 0, 0, 0, 0, 0], ("plumb_bob", 12)),
        ("", [0.1, 0, 0, 0, 0], ("rational_polynomial", 12)),
        ("rational_polynomial", [0.1] + [0.0] * 13, ("rational_polynomial", 12)),
        ("equidistant", [0.1, 0, 0, 0, 0], ("equidistant", 4)),
    ],
)
def test_distortions_that_are_read(model, d, read):
    lens = read_distortion(model, d)
    assert (lens and (lens.model, len(lens.coefficients))) == read


@pytest.mark.parametrize(
    "model, d, why",
    [
        ("fov", [0.9], "'fov' is not known; known are plumb_bob"),
        ("plumb_bob", [0.1, 0, 0], "D has 3 numbers, and plumb_bob takes 4, 5, 8, 12"),
        ("plumb_bob", [0.1, 0, 0, 0, 0, 0.1], "D has 6 numbers"),
        ("rational_polynomial", [0.1] * 6, "D has 6 numbers, and rational_polynomial takes 4, 5, 8, 12"),
        ("rational_polynomial", [0.1] * 14, "D has 14 numbers"),
        ("equidistant", [0.1, 0.1], "D has 2 numbers, and equidistant takes 4"),
        ("plumb_bob", [math.nan, 0, 0, 0, 0], "D holds nan"),
        ("plumb_bob", [0, 0, 0, 0, 1e30], "D holds 1e.30"),
        ("equidistant", [0, -math.inf, 0, 0], "D holds -inf"),
        ("plumb_bob", [-9e5, 0, 0, 0, 0], "folds the image back 0.05 degrees"),
    ],
)
def test_distortions_that_no_lens_has(model, d, why):
    with pytest.raises(ValueError, match=why):
        read_distortion(model, d)


def test_equal_lenses_are_equal():
    assert read_distortion("plumb_bob", [0.1, 0, 0, 0]) == Distortion("plumb_bob", (0.1, *[0.0] * 11))
