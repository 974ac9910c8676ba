# SPDX-License-Identifier: Apache-2.0
"""Warnings of the node: what they say, and how often."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from paul_ros.ros import advisor as module
from paul_ros.ros.advisor import REPEAT_SECONDS, SILENT_SECONDS, Advisor, ThrottledLog
from paul_ros.ros.diagnostics import OK, Health
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.stream import open_stream


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


def test_a_line_is_repeated_ever_more_rarely(clock, lines):
    """At once, after a minute, then every ten minutes: 4 lines in half an hour."""
    log = ThrottledLog(lines.append)
    for second in range(1800):
        clock[0] = 1000.0 + second
        log("a", str(second))
    assert lines == ["0", "60", "660", "1260"]
    log.forget()
    log("a", "after a change")
    assert lines[4:] == ["after a change"]


def test_keys_are_apart_and_may_be_held(clock, lines):
    log = ThrottledLog(lines.append)
    log.hold("b", 5.0)
    for clock[0] in (1000.0, 1004.9, 1005.0, 1064.9, 1065.0):
        log("a", f"a {clock[0]}")
        log("b", f"b {clock[0]}")
    assert lines == ["a 1000.0", "b 1005.0", "a 1064.9", "b 1065.0"]


def test_reasons_are_warned_of_when_they_grow(advisor, clock, lines):
    ledger, reasons = Ledger(), [REASONS["not_2d"], REASONS["image_assumed"]]
    ledger.drop("not_2d", "send 2D", 2)
    ledger.note("image_assumed", "rectify")
    advisor.report_reasons(reasons, ledger)
    assert lines == ["dropped: not_2d, 2 so far. send 2D", "noted: image_assumed, 1 so far. rectify"]
    clock[0] += REPEAT_SECONDS[0]
    advisor.report_reasons(reasons, ledger)
    ledger.drop("not_2d", "send 2D now")
    advisor.report_reasons(reasons, ledger)
    assert lines[2:] == ["dropped: not_2d, 3 so far. send 2D now"]


def test_silence_is_warned_of_and_a_missing_publisher_named(advisor, clock, lines):
    asked = []
    advisor.report_silence(SILENT_SECONDS - 0.1, "/keypoints", lambda: asked.append(1))
    assert lines == asked == []
    for second in range(1800):
        clock[0] = 1000.0 + second
        advisor.report_silence(SILENT_SECONDS + second, "/keypoints", lambda: True)
    advisor.report_silence(1805.0, "/keypoints", lambda: False)
    assert len(lines) == 5 and lines[0] == "No keypoints for 5 s on /keypoints. Check the detector."
    assert lines[4] == "No keypoints for 1805 s on /keypoints. Nobody publishes it: remap `keypoints` to your detector."


def test_other_trouble_is_warned_of_by_its_text(advisor, lines):
    for _ in range(3):
        advisor.report_trouble(["A publisher of /a does not match.", "There is no clock."])
    assert lines == ["A publisher of /a does not match.", "There is no clock."]


def test_half_an_hour_with_persons_who_come_and_go_is_quiet(advisor, clock, lines, model_file):
    """A new person every 6 s, left out for a second at either edge of the image, with all else as it should be."""
    stream = open_stream(str(model_file))
    stream.session.intrinsics = SimpleNamespace(matrix="P", image="rectified", distortion=None, uncorrected="")
    health = Health(clock[0], stream)
    levels = set()
    for second in range(1800):
        clock[0] += 1.0
        for _ in range(30):
            health.received(clock[0])
        stream.counts.update(frames=30, persons=30)
        if second % 6 in (0, 5):
            stream.ledger.drop("person_too_few_points", "left out", 15)
        report = health.report(clock[0], stream)
        advisor.report_reasons(report.warnings, stream.ledger)
        advisor.report_silence(report.silent_seconds, "/keypoints", lambda: True)
        levels.add(report.level)
    assert lines == [] and levels == {OK}
    assert stream.ledger.drops == {"person_too_few_points": 9000}


def test_model_units_and_a_clock_that_was_set_back(advisor, lines):
    advisor.report_model_units("none: no usable CameraInfo has been received")
    advisor.report_model_units("none: no usable CameraInfo has been received")
    advisor.report_clock_set_back(95.0)
    assert lines[0] == (
        "Points are in model units, not metres: no usable CameraInfo has been received. "
        "Remap `camera_info` to a calibrated camera."
    )
    assert lines[1:] == ["Time was set back by 95.0 s."]
