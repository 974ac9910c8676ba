# SPDX-License-Identifier: Apache-2.0
"""Bodies of ROS4HRI that come and go."""

from __future__ import annotations

import pytest

from paul_ros.ros.ros4hri import Tracked

LIST = "/humans/bodies/tracked"


@pytest.fixture
def log():
    return []


@pytest.fixture
def tracked(log):
    return Tracked(LIST, lambda topic: log.append(("open", topic)) or topic, lambda sub: log.append(("close", sub)))


def topic(name: str) -> str:
    return f"/humans/bodies/{name}/skeleton2d"


def test_topics_are_opened_and_closed_as_ids_come_and_go(tracked, log):
    assert tracked.update(["anna", "b2"], 10) == []
    assert log == [("open", topic("anna")), ("open", topic("b2"))]
    log.clear()
    assert tracked.update(["b2", "anna", "b2"], 10) == [] and log == []
    assert tracked.update(["b2", "c"], 10) == []
    assert log == [("close", topic("anna")), ("open", topic("c"))]
    assert tracked.topics == [topic("b2"), topic("c")]
    log.clear()
    tracked.clear()
    assert sorted(log) == [("close", topic("b2")), ("close", topic("c"))] and tracked.topics == []


@pytest.mark.parametrize("name", ["", "a/b", "../x", "1st", "a b", "ä", "a\n", "{}", "~"])
def test_an_id_that_no_topic_can_have_is_told(tracked, log, name):
    assert tracked.update(["anna", name], 10) == [name]
    assert log == [("open", topic("anna"))]


def test_more_than_the_most_are_told(tracked):
    assert tracked.update(["a", "b", "c"], 2) == ["c"]
    assert tracked.topics == [topic("a"), topic("b")]


def test_the_bodies_are_beside_their_list():
    opened = []
    Tracked("/robot/humans/bodies/tracked", opened.append, print).update(["x"], 1)
    assert opened == ["/robot/humans/bodies/x/skeleton2d"]
