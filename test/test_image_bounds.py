# SPDX-License-Identifier: Apache-2.0
"""Keypoints outside the image that CameraInfo states, and keypoints that never leave a corner of it."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import persons_at, seen
from test_camera_info import CLOUD, cloud, info

from msg_adapters import Keypoints2D
from paul_ros.ros.diagnostics import OK, WARN, Health
from paul_ros.ros.recent_counts import LASTING
from paul_ros.stream.image_bounds import CORNER_MESSAGES, ImageBounds
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.stream import LiftStream, open_stream

SIZE = (640, 480)


def box(left: float, top: float, right: float, bottom: float) -> np.ndarray:
    """Return 17 points spread over a box, two of them at its corners."""
    inside = np.random.default_rng(0).uniform((left, top), (right, bottom), (15, 2))
    return np.vstack([inside, [(left, top), (right, bottom)]])


def record(xy: np.ndarray) -> Keypoints2D:
    """Return points (M,2) as a person's keypoints."""
    seen = np.isfinite(xy).all(1)[None]
    return Keypoints2D(xy[None], seen.astype(float), seen, ("1",), 0, "")


def notes(*messages: np.ndarray, size: tuple[int, int] = SIZE) -> Ledger:
    ledger, bounds = Ledger(), ImageBounds()
    for xy in messages:
        bounds.check(record(xy), 0.3, size, ledger)
    return ledger


@pytest.mark.parametrize(
    "xy, noted",
    [
        (box(0, 0, 640, 480), False),
        (box(-63, -47, 703, 527), False),  # a detector guesses just beyond the border
        (np.vstack([box(0, 0, 640, 480), [[5000, 5000]]]), False),  # one wild point
        (np.empty((0, 2)), False),
        (np.full((17, 2), np.nan), False),
        (np.vstack([box(705, 100, 900, 400), np.full((17, 2), np.nan)]), True),
        (box(705, 100, 900, 400), True),
        (box(100, 100, 1900, 1060), True),
        (box(100, 300, 500, 900), True),
        (box(-600, 100, -100, 400), True),
    ],
)
def test_points_outside_the_image(xy, noted):
    assert notes(xy).notes == ({"outside_image": 1} if noted else {})
    assert not notes(xy, size=(0, 480)).notes, "without a size nothing is outside"


def test_the_advice_names_both_sizes_and_the_farthest_reach():
    ledger = notes(box(100, 100, 1900, 1060), box(300, 100, 1200, 500))
    assert "reach to 1900x1060 pixels, but CameraInfo states an image of 640x480" in ledger.advice["outside_image"]
    assert ledger.notes == {"outside_image": 2}
    assert "reach from (-600, 0) to 0x400 pixels" in notes(box(-600, 100, -100, 400)).advice["outside_image"]


def test_another_size_starts_anew():
    ledger, bounds = Ledger(), ImageBounds()
    for right, size in ((1900, SIZE), (1900, (1920, 1080)), (2900, (1920, 1080))):
        bounds.check(record(box(100, 100, right, 1060)), 0.3, size, ledger)
    assert ledger.notes == {"outside_image": 2} and "2900x1060" in ledger.advice["outside_image"]


def test_a_corner_is_noted_once_after_many_messages():
    corner, whole = box(20, 20, 300, 235), box(20, 20, 300, 400)
    assert not notes(*[corner] * (CORNER_MESSAGES - 1)).notes
    assert notes(*[corner] * (2 * CORNER_MESSAGES)).notes == {"corner_of_image": 1}
    assert not notes(*[corner] * (CORNER_MESSAGES - 1), *[whole], *[corner] * CORNER_MESSAGES).notes


# --- in the stream


@pytest.fixture
def stream(model_file) -> LiftStream:
    stream = open_stream(str(model_file))
    stream.camera_info(info())
    return stream


def resized(factor: float) -> np.ndarray:
    """Return the keypoints of three persons in an image `factor` times as large as the camera's."""
    return factor * seen(persons_at((-1.2, 0, 4), (0, 0, 3), (1.3, 0, 4)))


@pytest.mark.parametrize("factor, level", [(1, OK), (1.5, WARN), (3, WARN), (0.5, OK)])
def test_a_resized_image_is_a_warning(stream, factor, level):
    health = Health(0.0, stream)
    for second in range(LASTING):
        health.received(second + 0.5)
        health.published(stream.keypoints(CLOUD, cloud(resized(factor))).frame, 0)
        report = health.report(second + 1.0, stream, input_type=CLOUD)
    assert report.level == level
    assert ("CameraInfo states an image of 640x480" in report.message) == (level == WARN)


def test_points_of_low_confidence_may_lie_anywhere(stream):
    xy = resized(1)
    xy[:, :8] += 2000
    sure = np.ones(xy.shape[:2])
    sure[:, :8] = 0.1
    stream.keypoints(CLOUD, cloud(xy, confidence=sure))
    assert not stream.ledger.notes


def test_the_size_is_that_of_the_delivered_image(model_file):
    stream = open_stream(str(model_file))
    stream.camera_info(info(binning=(2, 2)))
    stream.keypoints(CLOUD, cloud(resized(1)))
    assert "CameraInfo states an image of 320x240" in stream.ledger.advice["outside_image"]


def test_pixels_are_compared_before_the_distortion_is_corrected(model_file):
    """Corrected pixels of a wide lens lie far outside the image."""
    stream = open_stream(str(model_file))
    stream.camera_info(info(d=[-0.02, 0.01, -0.004, 0.001], model="equidistant", k=(200, 200, 320, 240)))
    frame = stream.keypoints(CLOUD, cloud(box(10, 10, 630, 470)[None])).frame
    assert frame.given.xy[frame.given.visible].max() > 1000
    assert stream.ledger.notes.keys() == {"no_ray"}
