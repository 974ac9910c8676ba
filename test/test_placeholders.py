# SPDX-License-Identifier: Apache-2.0
"""Placeholders for missing points are found in images, and points at an origin are left alone."""

from __future__ import annotations

import numpy as np
import pytest

from paul_ros.placeholders import look_normalised, placeholders

FRAMES, POINTS = 40, 9


def pixels() -> np.ndarray:
    """Return (2,F,P) pixels of an object that moves, a few of them outside the image."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(40, 600, (2, FRAMES, POINTS))
    xy[:, 3, 2] = -7.5, -3.25
    return xy


def centred() -> np.ndarray:
    xy = pixels()
    return xy - xy.mean(2, keepdims=True)


def found(xy: np.ndarray, visible: np.ndarray | None = None) -> np.ndarray:
    return placeholders(*xy, np.ones((FRAMES, POINTS), bool) if visible is None else visible)


@pytest.mark.parametrize("value", [0, -1, -999])
def test_equal_coordinates_of_zero_or_less_are_missing_in_images(value) -> None:
    xy, hidden = pixels(), np.random.default_rng(1).random((FRAMES, POINTS)) < 0.3
    xy[:, hidden] = value
    np.testing.assert_array_equal(found(xy), hidden)
    np.testing.assert_array_equal(found(xy / 640), hidden)


def test_a_point_that_is_never_seen_is_missing_in_images() -> None:
    xy = pixels()
    xy[:, :, 4] = 0
    assert found(xy).sum() == FRAMES and found(xy)[:, 4].all()


def test_hidden_points_are_not_counted() -> None:
    xy, visible = pixels(), np.ones((FRAMES, POINTS), bool)
    xy[:, :, 4], visible[:, 4] = np.nan, False
    xy[:, 5, 4] = 0
    assert not found(xy, visible).any()


@pytest.mark.parametrize("root", [0, 5])
def test_the_origin_of_relative_coordinates_is_a_point(root) -> None:
    xy = pixels()
    assert not found(xy - xy[:, :, [root]]).any()
    lowest = xy[:, :, [root]] + [[[0]], [[1000]]]  # all other points are above it
    relative = xy - lowest
    relative[:, :, root] = 0
    assert not found(relative).any()


def test_zeros_for_missing_points_in_centred_coordinates_are_missing() -> None:
    """No measured point of centred data is at exactly (0, 0); the origin of relative data is in every frame."""
    xy, hidden = centred(), np.random.default_rng(1).random((FRAMES, POINTS)) < 0.2
    xy[:, hidden] = 0
    np.testing.assert_array_equal(found(xy), hidden)


def test_nothing_is_found_in_whole_data() -> None:
    assert not found(pixels()).any() and not found(centred()).any()
    assert not found(np.full((2, FRAMES, POINTS), np.nan), np.zeros((FRAMES, POINTS), bool)).any()


def test_normalised_coordinates_are_recognised() -> None:
    every = np.ones((FRAMES, POINTS), bool)
    assert look_normalised(*pixels() / 640, every)
    assert not look_normalised(*pixels(), every)
    assert not look_normalised(*centred() / 640, every)  # rays, or any unit about an origin
    assert not look_normalised(*pixels() / 640, ~every)
