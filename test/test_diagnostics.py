# SPDX-License-Identifier: Apache-2.0
"""Levels, rates, latency and shares of /diagnostics."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from msg_adapters import Intrinsics
from paul_ros.ros.diagnostics import ERROR, OK, STALE, STALE_SECONDS, WARN, Health, percentiles
from paul_ros.stream.stream import open_stream

S = 10**9  # ns


@pytest.fixture
def stream(model_file):
    stream = open_stream(str(model_file))
    stream.session.intrinsics = Intrinsics(600.0, 600.0, 320.0, 240.0, 640, 480)
    return stream


@pytest.fixture
def health():
    return Health(100.0)


def frame(stamp: int = 0, certified=(True,), ambiguity=(0.5,), stamped: bool = True):
    """The parts of a lifted frame that Health uses."""
    lifted = SimpleNamespace(certified=np.array(certified, bool), ambiguity=np.array(ambiguity, float))
    return SimpleNamespace(keypoints=SimpleNamespace(stamp=stamp), lifted=lifted, stamped=stamped)


def run(health, now: float = 101.0) -> None:
    """One good frame."""
    health.received(now - 0.5)
    health.published(frame(), S)


def test_all_is_well(health, stream):
    run(health)
    report = health.report(101.0, stream)
    assert (report.level, report.message) == (OK, "1 frames since the last report, units: m")
    assert report.frames == 1 and report.silent_seconds == pytest.approx(0.5)


def test_nothing_yet_then_silence_then_stale(health, stream):
    assert health.report(101.0, stream).level == WARN
    never = health.report(102.0, stream)
    assert "no keypoints yet" in never.message and never.silent_seconds == 2
    run(health, 103.0)
    assert health.report(103.0, stream).level == OK
    quiet = health.report(104.0, stream)
    assert quiet.level == WARN and "no keypoints since" in quiet.message
    assert health.report(102.5 + STALE_SECONDS - 0.01, stream).level == WARN
    stale = health.report(102.5 + STALE_SECONDS, stream)
    assert stale.level == STALE and "no keypoints for 5 s" in stale.message
    assert stale.values["last_input_age_s"] == "5.0"


def test_an_input_that_cannot_be_read_is_an_error(health, stream):
    run(health)
    report = health.report(101.0, stream, "no such package")
    assert (report.level, report.message) == (ERROR, "no such package")


def test_a_fault_of_the_node_is_an_error(health, stream):
    run(health)
    stream.ledger.drop("internal_error", "a fault")
    assert health.report(101.0, stream).level == ERROR
    run(health, 102.0)
    assert health.report(102.0, stream).level == OK


def test_drops_are_a_warning_and_an_error_where_nothing_is_left(health, stream):
    run(health)
    health.received(100.9)
    stream.ledger.drop("wrong_fields", "correct them")
    report = health.report(101.0, stream)
    assert report.level == WARN and "dropped: 1 wrong_fields" in report.message
    health.received(101.5)
    stream.ledger.drop("wrong_fields", "correct them")
    report = health.report(102.0, stream)
    assert report.level == ERROR and "no message could be used; dropped: 1 wrong_fields" in report.message
    assert report.values["dropped_wrong_fields"] == 2


def test_drops_of_before_it_was_activated_are_old_news(stream):
    stream.ledger.drop("internal_error", "a fault", 2)
    stream.ledger.drop("not_2d", "send 2D", 3)
    health = Health(100.0, stream.ledger.drops)
    run(health)
    report = health.report(101.0, stream)
    assert report.level == OK and report.values["dropped_not_2d"] == 3
    stream.ledger.drop("not_2d", "send 2D")
    assert "dropped: 1 not_2d" in health.report(102.0, stream).message


def test_notes_are_a_warning_as_long_as_they_are_counted(stream):
    stream.ledger.note("another_frame", "another frame", 4)
    stream.ledger.note("unlike_the_model", "hardly fit", 9)
    health = Health(100.0, stream.ledger.drops, stream.ledger.notes)
    run(health)
    assert health.report(101.0, stream).level == OK
    run(health, 104.0)
    stream.ledger.note("another_frame", "another frame")
    stream.ledger.note("unlike_the_model", "hardly fit")
    report = health.report(104.0, stream)
    assert report.level == WARN and report.message.startswith("another frame; hardly fit; 1 frames")
    run(health, 105.0)
    assert health.report(105.0, stream).level == OK


@pytest.mark.parametrize("outside, level", [(1, OK), (2, WARN), (20, WARN)])
def test_keypoints_outside_the_image_are_a_warning_if_they_are_in_some_frames(health, stream, outside, level):
    for _ in range(10):
        run(health)
    stream.ledger.note("outside_image", "outside", outside)
    assert health.report(101.0, stream).level == level


@pytest.mark.parametrize("persons, unlike, level", [(20, 9, OK), (20, 10, OK), (20, 11, WARN), (20, 20, WARN)])
def test_persons_unlike_the_model_are_a_warning_if_they_are_most(health, stream, persons, unlike, level):
    """Up to half of them may be misdetections. A person that was not lifted does not count."""
    health.received(100.5)
    health.published(frame(certified=(True,) * persons + (False,), ambiguity=(0.5,) * persons + (np.nan,)), S)
    stream.ledger.note("unlike_the_model", "hardly fit", unlike)
    assert health.report(101.0, stream).level == level


def test_a_person_left_out_or_a_message_lost_is_no_error(health, stream):
    health.received(100.5)  # it waits for the rest of its image
    stream.ledger.drop("missed", "lost", 3)
    stream.ledger.drop("person_too_few_points", "left out", 2)
    assert health.report(101.0, stream).level == WARN


def test_a_qos_that_does_not_match_is_a_warning_once(health, stream):
    run(health)
    health.qos_mismatch()
    report = health.report(101.0, stream)
    assert report.level == WARN and "QoS" in report.message
    run(health, 102.0)
    assert health.report(102.0, stream).level == OK


def test_model_units_are_a_warning_where_the_model_knows_metres(health, stream):
    stream.session.intrinsics = None
    assert "no metres" not in health.report(100.5, stream).message, "before a frame was lifted"
    run(health)
    report = health.report(101.0, stream)
    assert report.level == WARN and "no metres" in report.message
    stream.lifter.metres_per_unit = None
    run(health, 102.0)
    assert health.report(102.0, stream).level == OK


def test_rates_are_of_the_time_since_the_last_report(health, stream):
    for _ in range(30):
        health.received(100.1)
    for _ in range(20):
        health.published(frame(), S)
    values = health.report(102.0, stream).values
    assert (values["rate_in_hz"], values["rate_out_hz"]) == ("15.0", "10.0")
    values = health.report(103.0, stream).values
    assert (values["rate_in_hz"], values["rate_out_hz"]) == ("0.0", "0.0")


def test_latency_is_known_if_the_clocks_agree(health, stream):
    health.published(frame(stamp=50 * S), 3 * S)  # from the future
    health.published(frame(stamp=0), 1_700_000_000 * S)  # a bag of long ago
    health.published(frame(stamp=S), 11 * S + 1)  # older than 10 s
    health.published(frame(stamp=S, stamped=False), S + 1)  # the time of arrival
    values = health.report(101.0, stream).values
    assert values["latency_ms_median"] == values["latency_ms_p99"] == "unknown"
    for ms in range(1, 102):
        health.published(frame(stamp=S), S + ms * 10**6)
    values = health.report(102.0, stream).values
    assert (values["latency_ms_median"], values["latency_ms_p99"]) == ("51.00", "100.00")
    health.forget_latency()
    assert health.report(103.0, stream).values["latency_ms_median"] == "unknown"


def test_shares_are_of_the_persons_lifted(health, stream):
    health.published(frame(certified=(True, False, False), ambiguity=(0.9, 0.89, np.nan)), S)
    health.published(frame(certified=(True, True), ambiguity=(0.1, 0.0)), S)
    health.published(frame(certified=(), ambiguity=()), S)
    values = health.report(101.0, stream).values
    assert (values["certified_share"], values["ambiguous_share"]) == ("0.750", "0.250")
    assert health.report(102.0, stream).values["certified_share"] == "none"


def test_model_and_layouts_are_reported(health, stream):
    values = health.report(101.0, stream, input_type="a/msg/B").values
    assert (values["model"], len(values["model_sha256"]), values["input_type"]) == ("stand", 64, "a/msg/B")
    assert (values["input_layout"], values["layout"]) == (None, "coco17")


def test_percentiles_of_nothing():
    assert percentiles([]) is None and percentiles([3.0]) == (3.0, 3.0)
