# SPDX-License-Identifier: Apache-2.0
"""Warnings of the node: what they say, and how often."""

from __future__ import annotations

import pytest

from paul_ros.ros import advisor as module
from paul_ros.ros.advisor import NOTE_SECONDS, SILENT_SECONDS, WARNING_SECONDS, Advisor, ThrottledLog
from paul_ros.stream.ledger import Ledger


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The present, which a test may set."""
    now = [1000.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def advisor(clock, lines) -> Advisor:
    return Advisor(ThrottledLog(lines.append))


def test_a_key_is_written_again_only_after_its_interval(clock, lines):
    log = ThrottledLog(lines.append)
    log.hold("b")
    for clock[0] in (1000.0, 1004.9, 1005.0, 1009.9, 1010.0):
        log("a", "a")
        log("b", "b", 7.0)
    assert lines == ["a", "a", "b", "a"]


def test_drops_are_warned_of_when_they_grow(advisor, clock, lines):
    ledger = Ledger()
    ledger.drop("not_2d", "send 2D", 2)
    advisor.report_drops(ledger)
    assert lines == ["dropped: not_2d, 2 so far. send 2D"]
    clock[0] += WARNING_SECONDS
    advisor.report_drops(ledger)
    ledger.drop("not_2d", "send 2D now")
    advisor.report_drops(ledger)
    assert lines[1:] == ["dropped: not_2d, 3 so far. send 2D now"]


def test_notes_are_warned_of_rarely_and_only_with_advice(advisor, clock, lines):
    ledger = Ledger()
    ledger.note("stamp_backwards")
    for _ in range(2):
        ledger.note("image_assumed", "say which")
        advisor.report_notes(ledger)
        clock[0] += NOTE_SECONDS - 1
    assert lines == ["noted: image_assumed, 1 so far. say which"]
    ledger.note("image_assumed", "say which")
    advisor.report_notes(ledger)
    assert lines[1:] == ["noted: image_assumed, 3 so far. say which"]


def test_silence_is_warned_of_and_a_missing_publisher_named(advisor, clock, lines):
    asked = []
    advisor.report_silence(SILENT_SECONDS - 0.1, "/keypoints", lambda: asked.append(1))
    assert lines == asked == []
    advisor.report_silence(SILENT_SECONDS, "/keypoints", lambda: True)
    clock[0] += WARNING_SECONDS
    advisor.report_silence(60.0, "/keypoints", lambda: False)
    assert lines[0] == "No keypoints for 5 s on /keypoints. Check the detector."
    assert lines[1] == "No keypoints for 60 s on /keypoints. Nobody publishes it: remap `keypoints` to your detector."


def test_model_units_and_a_clock_that_was_set_back(advisor, lines):
    advisor.report_model_units("none: no usable CameraInfo has been received")
    advisor.report_model_units("none: no usable CameraInfo has been received")
    advisor.report_clock_set_back(95.0)
    assert lines[0] == (
        "Points are in model units, not metres: no usable CameraInfo has been received. "
        "Remap `camera_info` to a calibrated camera."
    )
    assert lines[1:] == ["Time was set back by 95.0 s."]
