# SPDX-License-Identifier: Apache-2.0
"""Messages without a usable stamp or without a frame: what takes their place, and what is noted."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from conftest import header_of

from msg_adapters.cdr import Header, Time
from msg_adapters.keypoints import no_persons
from paul_ros.stream.arrival import Arrival, complete
from paul_ros.stream.ledger import Ledger

RECEIVED = 1_700_000_000_123_456_789


def arrived(header, received: int = RECEIVED, camera: str = "optical") -> tuple[Arrival, dict]:
    ledger, before = Ledger(), copy.deepcopy(header)
    message = complete(header, no_persons(17, header), received, "/topic", camera, ledger)
    assert header == before, "the message's own header was changed"
    assert (message.received, message.topic) == (received, "/topic")
    stamp = message.header.stamp
    assert message.keypoints.stamp == stamp.sec * 10**9 + stamp.nanosec and stamp.sec >= 0 and stamp.nanosec < 10**9
    assert message.keypoints.frame_id == message.header.frame_id
    return message, dict(ledger.notes)


def test_a_good_header_is_used_as_it_is(make):
    header = header_of(make)
    message, notes = arrived(header)
    assert message.header is header and message.stamped and not notes


@pytest.mark.parametrize(
    "seconds, nanoseconds, note",
    [
        (0, 0, "no_stamp"),
        (-1, 0, "invalid_stamp"),
        (-1, 999_999_999, "invalid_stamp"),
        (-(2**31), 2**32 - 1, "invalid_stamp"),
        (5, 10**9, "invalid_stamp"),
        (5, 2**32 - 1, "invalid_stamp"),
        (0, 1, None),
        (2**31 - 1, 999_999_999, None),
    ],
)
def test_the_time_of_arrival_replaces_an_unusable_stamp(make, seconds, nanoseconds, note):
    message, notes = arrived(header_of(make, seconds, nanoseconds))
    assert notes == ({note: 1} if note else {})
    assert message.stamped is (note is None)
    assert message.keypoints.stamp == (RECEIVED if note else seconds * 10**9 + nanoseconds)


def test_without_a_clock_an_unusable_stamp_becomes_zero(make):
    """As in simulated time before the first /clock."""
    message, notes = arrived(header_of(make, -5, 7), received=0)
    assert message.keypoints.stamp == 0 and not message.stamped and notes == {"invalid_stamp": 1}


@pytest.mark.parametrize("camera", ["optical", ""])
def test_the_frame_of_camera_info_replaces_an_empty_one(make, camera):
    message, notes = arrived(header_of(make, frame=""), camera=camera)
    assert message.header.frame_id == camera and message.stamped and notes == {"no_frame": 1}
    assert message.keypoints.stamp == 7_000_000_005


def test_a_cloud_that_was_read_from_bytes_has_neither():
    message, notes = arrived(Header(Time(0, 0), ""))
    assert (message.keypoints.stamp, message.header.frame_id) == (RECEIVED, "optical")
    assert notes == {"no_stamp": 1, "no_frame": 1}


def test_advice_says_what_the_stamp_was(make):
    ledger, header = Ledger(), header_of(make, -3, 4)
    complete(header, no_persons(17, header), 1, "", "", ledger)
    assert "-3 s and 4 ns" in ledger.advice["invalid_stamp"]
    assert np.all([text.endswith(".") for text in ledger.advice.values()])
