# SPDX-License-Identifier: Apache-2.0
"""Persons of one image in a message each: which belong together."""

from __future__ import annotations

import numpy as np
import pytest

from msg_adapters import Keypoints2D
from paul_ros.stream.person_group import PersonGroup


def person(ident: str = "1", stamp: int = 5, frame_id: str = "camera") -> Keypoints2D:
    ones = np.ones((1, 17))
    return Keypoints2D(np.full((1, 17, 2), len(ident)), ones, ones > 0, (ident,), stamp, frame_id)


@pytest.fixture
def group() -> PersonGroup:
    group = PersonGroup()
    group.add("first header", person())
    return group


def test_an_empty_group_accepts_anybody():
    assert PersonGroup().accepts(person()) and len(PersonGroup()) == 0


@pytest.mark.parametrize(
    "other, accepted",
    [
        (person("2"), True),
        (person(""), True),
        (person("1"), False),
        (person("2", stamp=6), False),
        (person("2", frame_id="other_camera"), False),
    ],
)
def test_a_group_accepts_other_persons_of_its_image(group, other, accepted):
    assert group.accepts(other) is accepted


def test_persons_without_an_id_are_different_persons(group):
    group.add("header", person(""))
    assert group.accepts(person(""))


def test_all_persons_are_taken_in_order_and_the_group_is_empty(group):
    group.add("last header", person("22"))
    header, persons = group.take()
    assert header == "last header" and persons.ids == ("1", "22") and persons.xy[:, 0, 0].tolist() == [1, 2]
    assert len(group) == 0 and group.accepts(person())
