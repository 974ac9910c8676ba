# SPDX-License-Identifier: Apache-2.0
"""Persons of one image in a message each: which belong together, and which messages are about one person."""

from __future__ import annotations

import numpy as np
import pytest

from msg_adapters import Keypoints2D
from paul_ros.stream.arrival import Arrival
from paul_ros.stream.person_group import PersonGroup

MS = 1_000_000  # ns
TOPIC = "/humans/bodies/anna/skeleton2d"


def person(
    ident="1", x=1.0, stamp=5, frame_id="camera", received=1000 * MS, topic="/keypoints", stamped=True, seen=True
) -> Arrival:
    visible = np.full((1, 17), seen)
    xy = np.where(visible[..., None], np.full((1, 17, 2), x), np.nan)
    keypoints = Keypoints2D(xy, visible.astype(float), visible, (ident,), stamp, frame_id)
    return Arrival(f"header of {stamp}", keypoints, received, topic, stamped)


def unstamped(milliseconds: int, ident="1", **given) -> Arrival:
    received = 1000 * MS + milliseconds * MS
    return person(ident, stamp=received, received=received, stamped=False, **given)


def group_of(*messages: Arrival) -> PersonGroup:
    group = PersonGroup()
    for message in messages:
        assert group.accepts(message)
        group.add(message)
    return group


def test_an_empty_group_accepts_anybody():
    assert PersonGroup().accepts(person()) and len(PersonGroup()) == 0


@pytest.mark.parametrize(
    "other, accepted",
    [
        (person("2"), True),
        (person(""), True),
        (person("1"), True),
        (person("2", stamp=6), False),
        (person("2", frame_id="other_camera"), False),
        (person("2", stamped=False), False),
        (person("2", received=5000 * MS), True),
        (person("1", received=1010 * MS), True),
        (person("1", received=1011 * MS), False),
        (person("1", received=900 * MS), False),
    ],
)
def test_a_group_accepts_other_persons_of_its_image(other, accepted):
    """A stamp may stand still: then an id that comes again after a pause begins the next image."""
    assert group_of(person("1")).accepts(other) is accepted


def test_without_a_stamp_pauses_part_the_images():
    """The pause counts from the last message: a burst of many persons may take longer than a pause."""
    group = group_of(*(unstamped(8 * n, str(n)) for n in range(6)))
    assert group.accepts(unstamped(50, "7")) and not group.accepts(unstamped(51, "7"))
    assert not group.accepts(unstamped(20, "7"))  # the clock was set back
    message = group.take()
    assert message.keypoints.persons == 6 and message.keypoints.stamp == message.received == 1000 * MS


def test_a_repetition_prolongs_the_burst_and_keeps_the_time_of_the_image():
    group = group_of(unstamped(0, "1"), unstamped(5, "2", x=2.0), unstamped(9, "1"))
    assert group.accepts(unstamped(19, "3")) and not group.accepts(unstamped(20, "3"))
    message = group.take()
    assert message.keypoints.ids == ("1", "2") and message.keypoints.stamp == 1000 * MS
    assert message.header == f"header of {1000 * MS}" and group.accepts(unstamped(99, "3"))


def test_two_persons_with_one_id_are_two_persons():
    group = group_of(person("0", 1), person("0", 2), person("", 3), person("", 4))
    assert group.take().keypoints.ids == ("0", "0", "", "")
    # A topic's name may hold the number by chance.
    group = group_of(*(person("0", x, topic="/camera/0/poses") for x in (1, 2)))
    assert group.take().keypoints.ids == ("0", "0")


@pytest.mark.parametrize(
    "first, again, kept",
    [
        (person("1"), person("1"), 1.0),
        (person(""), person(""), 1.0),
        (person("anna", topic=TOPIC), person("anna", 2, topic=TOPIC), 2.0),
    ],
)
def test_a_message_about_one_person_comes_twice(first, again, kept):
    """Equal pixels, or another message on the topic of one body: the last one is used."""
    group = group_of(person("9", 9), first, person("8", 8))
    assert group.accepts(again) and not group.add(again)
    keypoints = group.take().keypoints
    assert keypoints.xy[:, 0, 0].tolist() == [9, kept, 8] and keypoints.ids[1] == first.keypoints.ids[0]


def test_persons_of_whom_nothing_is_seen_are_not_one():
    assert group_of(person("", seen=False), person("", seen=False)).take().keypoints.persons == 2


def test_one_body_under_two_names_is_two_persons():
    """Only the tracker knows whether they are one."""
    ben = person("ben", topic=TOPIC.replace("anna", "ben"))
    assert group_of(person("anna", topic=TOPIC), ben).take().keypoints.ids == ("anna", "ben")


def test_all_persons_are_taken_in_order_and_the_group_is_empty():
    group = group_of(person("1"), person("22", 2))
    message = group.take()
    assert message.header == "header of 5" and message.keypoints.ids == ("1", "22")
    assert message.keypoints.xy[:, 0, 0].tolist() == [1, 2]
    assert len(group) == 0 and group.accepts(person(stamp=6))
