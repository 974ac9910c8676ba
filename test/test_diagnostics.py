# SPDX-License-Identifier: Apache-2.0
"""Levels, rates, latency and shares of /diagnostics."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from msg_adapters import Intrinsics
from paul_ros.ros.diagnostics import ERROR, OK, QUIET_SECONDS, STALE, STALE_SECONDS, WARN, Health, percentiles
from paul_ros.ros.recent_counts import LASTING, WINDOW
from paul_ros.stream.reason import NOTE
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.stream import open_stream

S = 10**9  # ns


@pytest.fixture
def stream(model_file):
    stream = open_stream(str(model_file))
    stream.session.intrinsics = Intrinsics(600.0, 600.0, 320.0, 240.0, 640, 480)
    return stream


@pytest.fixture
def health(stream):
    return Health(100.0, stream)


def frame(stamp: int = 0, certified=(True,), ambiguity=(0.5,), stamped: bool = True):
    """The parts of a lifted frame that Health uses."""
    lifted = SimpleNamespace(certified=np.array(certified, bool), ambiguity=np.array(ambiguity, float))
    return SimpleNamespace(keypoints=SimpleNamespace(stamp=stamp), lifted=lifted, stamped=stamped)


def run(health, stream, now: float = 101.0) -> None:
    """One good frame."""
    health.received(now - 0.5)
    health.published(frame(), S)
    stream.counts.update(frames=1, persons=1, lifted=1)


def test_all_is_well(health, stream):
    run(health, stream)
    report = health.report(101.0, stream)
    assert (report.level, report.message) == (OK, "1 frames since the last report, units: m")
    assert report.lifting and report.silent_seconds == pytest.approx(0.5)


def test_nothing_yet_then_silence_then_stale(health, stream):
    assert health.report(101.0, stream).level == WARN
    never = health.report(102.0, stream)
    assert "no keypoints yet" in never.message and never.silent_seconds == 2
    run(health, stream, 103.0)
    assert health.report(103.0, stream).level == OK
    assert health.report(102.5 + QUIET_SECONDS - 0.01, stream).level == OK, "as between images at 0.5 Hz"
    quiet = health.report(102.5 + QUIET_SECONDS, stream)
    assert quiet.level == WARN and "no keypoints for 2 s" in quiet.message
    assert health.report(102.5 + STALE_SECONDS - 0.01, stream).level == WARN
    stale = health.report(102.5 + STALE_SECONDS, stream)
    assert stale.level == STALE and "no keypoints for 5 s" in stale.message
    assert stale.values["last_input_age_s"] == "5.0"


def test_an_input_that_cannot_be_read_is_an_error(health, stream):
    run(health, stream)
    report = health.report(101.0, stream, "no such package")
    assert (report.level, report.message) == (ERROR, "no such package")


def seconds(health, stream, begin: int, count: int, persons: int = 30, **reasons: int) -> str:
    """Report `count` times, each after a second of 30 images with `persons` persons and these drops or notes.

    Returns the levels as text: O, W, E or S.
    """
    levels = []
    for second in range(begin, begin + count):
        for _ in range(30):
            health.received(101.0 + second)
        health.published(frame(), S)
        stream.counts.update(frames=30, persons=persons)
        for reason, number in reasons.items():
            is_note = reason in REASONS and REASONS[reason].kind == NOTE
            (stream.ledger.note if is_note else stream.ledger.drop)(reason, f"advice on {reason}", number)
        levels.append("OWES"[health.report(101.0 + second, stream).level])
    return "".join(levels)


def test_a_fault_of_the_node_is_an_error_for_a_while(health, stream):
    assert seconds(health, stream, 0, 1, internal_error=1) == "E"
    assert seconds(health, stream, 1, WINDOW) == "E" * (WINDOW - 1) + "O"


def test_a_callback_that_failed_is_an_error_for_a_while(health, stream):
    run(health, stream)
    stream.ledger.note("callback_failed")
    report = health.report(101.0, stream)
    assert (report.level, report.values["noted_callback_failed"]) == (ERROR, 1) and "see its log" in report.message
    assert seconds(health, stream, 1, WINDOW) == "E" * (WINDOW - 1) + "O"


def test_an_unknown_parameter_is_a_value_and_no_warning(stream):
    stream.ledger.note("unknown_parameter", count=2)
    health = Health(100.0, stream)
    run(health, stream)
    report = health.report(101.0, stream)
    assert (report.level, report.values["noted_unknown_parameter"]) == (OK, 2)


def test_drops_are_a_warning_and_an_error_where_nothing_is_left(health, stream):
    run(health, stream)
    health.received(100.9)
    stream.ledger.drop("wrong_fields", "correct them")
    report = health.report(101.0, stream)
    assert report.level == WARN and "dropped: 1 wrong_fields in the last 10 s" in report.message
    health.received(101.5)
    stream.ledger.drop("wrong_fields", "correct them")
    report = health.report(102.0, stream)
    assert report.level == ERROR and "no message could be used; dropped: 2 wrong_fields" in report.message
    assert report.values["dropped_wrong_fields"] == 2


def test_drops_of_before_it_was_activated_are_old_news(stream):
    stream.ledger.drop("internal_error", "a fault", 2)
    stream.ledger.drop("not_2d", "send 2D", 3)
    health = Health(100.0, stream)
    run(health, stream)
    report = health.report(101.0, stream)
    assert report.level == OK and report.values["dropped_not_2d"] == 3 and not report.warnings
    stream.ledger.drop("not_2d", "send 2D")
    report = health.report(102.0, stream)
    assert "dropped: 1 not_2d" in report.message and [reason.slug for reason in report.warnings] == ["not_2d"]


@pytest.mark.parametrize(
    "reason", ["not_2d", "another_frame", "depth_of_another_size", "bad_intrinsics", "of_a_plugin"]
)
def test_what_is_never_normal_is_a_warning_at_once_and_does_not_flicker(health, stream, reason):
    """Whether it comes every second or every ninth; it ends when it has not come for WINDOW reports."""
    levels = ""
    for second in range(0, 36, 9):
        levels += seconds(health, stream, second, 1, **{reason: 1}) + seconds(health, stream, second + 1, 8)
    assert levels == 36 * "W"
    assert seconds(health, stream, 36, 3) == "WOO"


@pytest.mark.parametrize(
    "reason",
    ["person_too_few_points", "person_degenerate_points", "person_too_far", "unlike_the_model", "depth_disagrees"],
)
def test_persons_at_the_edge_of_the_image_are_counted_and_no_warning(health, stream, reason):
    """A person enters, is fully visible for five seconds, leaves, for half an hour; a second one comes and goes too."""
    levels = ""
    for second in range(0, 1800, 6):
        levels += seconds(health, stream, second, 1, persons=15, **{reason: 15})
        levels += seconds(health, stream, second + 1, 4, persons=60)
        levels += seconds(health, stream, second + 5, 1, persons=0)
    assert levels == 1800 * "O"
    assert {**stream.ledger.drops, **stream.ledger.notes}[reason] == 300 * 15


def test_persons_left_out_are_a_warning_if_they_are_most_for_a_while(health, stream):
    assert seconds(health, stream, 0, LASTING, person_too_few_points=30) == (LASTING - 1) * "O" + "W"
    assert seconds(health, stream, 20, 30, person_too_few_points=14) == 30 * "W", "it does not flicker at its limit"
    assert seconds(health, stream, 60, 20, person_too_few_points=7).endswith("OOO")
    assert seconds(health, stream, 80, 30, person_too_few_points=15) == 30 * "O", "half of them"


def test_a_warning_of_persons_states_their_share(health, stream):
    seconds(health, stream, 0, 9, persons=10, person_too_few_points=6)
    for _ in range(2):
        stream.ledger.drop("person_too_few_points", "", 3)
        stream.counts.update(frames=30, persons=5)
        health.received(110.0)
        report = health.report(110.0, stream)
    assert report.level == WARN
    assert "dropped: 54 person_too_few_points (60 % of persons) in the last 10 s" in report.message
    assert [reason.slug for reason in report.warnings] == ["person_too_few_points"]


@pytest.mark.parametrize("lost, level", [(3, "O"), (4, "W")])
def test_lost_messages_are_a_warning_above_a_tenth(health, stream, lost, level):
    """3 of 33 and 4 of 34 messages."""
    assert seconds(health, stream, 0, LASTING, missed=lost)[-1] == level
    assert seconds(health, stream, LASTING, 1, missed=lost) == level


def test_a_hiccup_that_loses_a_second_of_messages_is_no_warning(health, stream):
    assert seconds(health, stream, 0, 1, missed=30) + seconds(health, stream, 1, 20) == 21 * "O"


def test_notes_are_a_warning_as_long_as_they_are_recent(health, stream):
    assert seconds(health, stream, 0, 1, another_frame=1, stamp_backwards=1, image_assumed=1) == "W"
    report = health.report(102.0, stream)
    assert report.message.startswith("advice on another_frame; 0 frames")
    assert [reason.slug for reason in report.warnings] == ["another_frame", "image_assumed", "stamp_backwards"]
    assert seconds(health, stream, 2, WINDOW)[-2:] == "OO"


@pytest.mark.parametrize("unlike, level", [(15, OK), (16, WARN), (30, WARN)])
def test_persons_unlike_the_model_are_a_warning_if_they_are_most(health, stream, unlike, level):
    """Up to half of them may be misdetections."""
    assert seconds(health, stream, 0, LASTING, unlike_the_model=unlike)[-1] == "OW"[level]


def test_a_person_left_out_or_a_message_lost_is_no_error(health, stream):
    health.received(100.5)  # it waits for the rest of its image
    stream.ledger.drop("missed", "lost", 3)
    stream.ledger.drop("person_too_few_points", "left out", 2)
    assert health.report(101.0, stream).level == OK


def test_trouble_around_the_node_is_a_warning_as_long_as_it_lasts(health, stream):
    run(health, stream)
    report = health.report(101.0, stream, trouble=["A publisher of /a does not match."])
    assert report.level == WARN and report.message.startswith("A publisher of /a does not match; 1 frames")
    run(health, stream, 102.0)
    assert health.report(102.0, stream).level == OK
    stale = health.report(110.0, stream, trouble=["A publisher of /a does not match."])
    assert stale.level == STALE and "A publisher of /a" in stale.message


def test_model_units_are_a_warning_where_the_model_knows_metres(health, stream):
    stream.session.intrinsics = None
    assert "no metres" not in health.report(100.5, stream).message, "before a frame was lifted"
    run(health, stream)
    report = health.report(101.0, stream)
    assert report.level == WARN and "no metres" in report.message
    stream.lifter.metres_per_unit = None
    run(health, stream, 102.0)
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
