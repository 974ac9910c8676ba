# SPDX-License-Identifier: Apache-2.0
"""The filter over time: it calms what is still, follows what moves, keeps persons apart, and starts anew in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import PERSON

from paul_ros.layout import load_layout
from paul_ros.lifted import TOO_FEW_POINTS, Lifted
from paul_ros.stream.smoothing import FORGET_SECONDS, OneEuro

HIPS = (11, 12)
FRAME = 33_333_333  # ns


def nobody(persons: int = 1, units: str = "m") -> Lifted:
    return Lifted.nobody((TOO_FEW_POINTS,) * persons, load_layout("coco17"), units)


def lifted(points: np.ndarray, units: str = "m"):
    """Persons (N,17,3) as the Lifter gives them."""
    return replace(nobody(len(points), units), points=points, root=points[:, HIPS].mean(1), reason=("",) * len(points))


def run(filtered: OneEuro, frames: np.ndarray, ids=("1",), start: int = 0) -> np.ndarray:
    """(F,N,17,3) through the filter, at 30 Hz."""
    return np.array([filtered(ids, start + n * FRAME, lifted(frame), HIPS).points for n, frame in enumerate(frames)])


def noisy(frames: int = 90, sigma: float = 0.03) -> np.ndarray:
    return (PERSON + (0, 0, 4)) + np.random.default_rng(0).normal(0, sigma, (frames, 1, 17, 3))


def test_a_person_at_rest_is_calmed():
    raw = noisy()
    smooth = run(OneEuro(1.0), raw)[30:]
    assert smooth.std(axis=0).mean() < 0.5 * raw[30:].std(axis=0).mean()
    np.testing.assert_allclose(smooth.mean((0, 1)), PERSON + (0, 0, 4), atol=0.03)


def test_a_person_in_motion_is_followed():
    """Walking at 1.5 m/s: within a tenth of a second of the way."""
    way = np.arange(60)[:, None, None, None] / 30 * np.array([1.5, 0, 0])
    raw = PERSON + (0, 0, 4) + way
    behind = np.abs(run(OneEuro(1.0), raw) - raw).max((1, 2, 3))
    assert 0.01 < behind[30:].max() < 0.15


def test_the_higher_the_cutoff_the_less_is_changed():
    raw = noisy()
    change = [np.abs(run(OneEuro(cutoff), raw) - raw).mean() for cutoff in (0.5, 2.0, 50.0)]
    assert change[0] > change[1] > change[2] > 0


def test_off_changes_nothing_and_forgets():
    filtered, raw = OneEuro(0.0), noisy(3)
    np.testing.assert_array_equal(run(filtered, raw), raw)
    filtered.cutoff = 1.0
    run(filtered, raw)
    filtered.cutoff = 0.0
    run(filtered, raw[:1], start=4 * FRAME)
    filtered.cutoff = 1.0
    np.testing.assert_array_equal(run(filtered, raw[:1], start=5 * FRAME), raw[:1])


def test_the_unit_of_length_does_not_matter():
    raw = noisy(20)
    np.testing.assert_allclose(run(OneEuro(1.0), 7 * raw), 7 * run(OneEuro(1.0), raw))


def test_persons_are_kept_apart_by_id_whatever_their_order():
    raw = noisy(20)
    pair = np.concatenate([raw, raw[::-1] + 2], axis=1)
    both, swapped = OneEuro(1.0), OneEuro(1.0)
    straight = run(both, pair, ("1", "2"))
    for n, frame in enumerate(pair):
        order = (0, 1) if n % 2 else (1, 0)
        ids = tuple(("1", "2")[row] for row in order)
        points = swapped(ids, n * FRAME, lifted(frame[list(order)]), HIPS).points
        np.testing.assert_array_equal(points, straight[n][list(order)])
    np.testing.assert_allclose(straight[:, :1], run(OneEuro(1.0), raw))


def test_persons_without_an_id_or_not_lifted_are_as_they_were():
    raw = noisy(5)
    np.testing.assert_array_equal(run(OneEuro(1.0), raw, ("",)), raw)
    filtered = OneEuro(1.0)
    for n in range(3):
        assert np.isnan(filtered(("1",), n * FRAME, nobody(), HIPS).points).all()


def test_the_root_is_that_of_the_filtered_points():
    filtered = OneEuro(1.0)
    for n, frame in enumerate(noisy(5)):
        out = filtered(("1",), n * FRAME, lifted(frame), HIPS)
    np.testing.assert_allclose(out.root, out.points[:, HIPS].mean(1))
    assert not np.allclose(out.root, frame[:, HIPS].mean(1))


@pytest.mark.parametrize("stamp, units", [(5 * FRAME + 500_000_001, "m"), (2 * FRAME, "m"), (6 * FRAME, "model")])
def test_it_starts_anew(stamp, units):
    """After a long silence, after a jump back in time, in other units."""
    filtered, raw = OneEuro(1.0), noisy(7)
    run(filtered, raw[:6])
    np.testing.assert_array_equal(filtered(("1",), stamp, lifted(raw[6], units), HIPS).points, raw[6])


def test_a_person_of_another_camera_with_the_same_id_is_not_mixed_in():
    filtered, raw = OneEuro(1.0), noisy(7)
    run(filtered, raw[:6])
    other = filtered(("1",), 6 * FRAME, lifted(raw[6]), HIPS, "another camera")
    np.testing.assert_array_equal(other.points, raw[6])


def test_it_goes_on_after_half_a_second():
    filtered, raw = OneEuro(1.0), noisy(7)
    run(filtered, raw[:6])
    assert not np.array_equal(filtered(("1",), 5 * FRAME + 500_000_000, lifted(raw[6]), HIPS).points, raw[6])


def test_a_stamp_that_repeats_breaks_nothing():
    filtered, raw = OneEuro(1.0), noisy(4)
    run(filtered, raw[:2])
    assert np.isfinite(filtered(("1",), FRAME, lifted(raw[2]), HIPS).points).all()
    assert np.isfinite(filtered(("1", "1"), 2 * FRAME, lifted(np.repeat(raw[3], 2, 0)), HIPS).points).all()


@pytest.mark.parametrize("step", [FRAME, 0])
def test_persons_who_left_are_forgotten(step):
    """An id of its own in every frame, with stamps and without: what is kept does not grow with time."""
    filtered, raw = OneEuro(1.0), lifted(noisy(1)[0].repeat(2, 0))
    for n in range(300):
        filtered(("stays", str(n)), n * step, raw, HIPS)
    assert "stays" in filtered._tracks and len(filtered._tracks) < 2 + 2 * FORGET_SECONDS * 30
