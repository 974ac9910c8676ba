# SPDX-License-Identifier: Apache-2.0
"""Topics of ROS4HRI's bodies as they appear and leave."""

from __future__ import annotations

import pytest

from paul_ros.ros.ros4hri import BodyTopics

LIST = "/humans/bodies/tracked"


@pytest.fixture
def log():
    return []


@pytest.fixture
def body_topics(log):
    return BodyTopics(LIST, lambda topic: log.append(("open", topic)) or topic, lambda sub: log.append(("close", sub)))


def topic(name: str) -> str:
    return f"/humans/bodies/{name}/skeleton2d"


def test_topics_are_opened_and_closed_as_ids_come_and_go(body_topics, log):
    assert body_topics.update(["anna", "b2"], 10) == []
    assert log == [("open", topic("anna")), ("open", topic("b2"))]
    log.clear()
    assert body_topics.update(["b2", "anna", "b2"], 10) == [] and log == []
    assert body_topics.update(["b2", "c"], 10) == []
    assert log == [("close", topic("anna")), ("open", topic("c"))]
    assert body_topics.topics == [topic("b2"), topic("c")]
    log.clear()
    body_topics.clear()
    assert sorted(log) == [("close", topic("b2")), ("close", topic("c"))] and body_topics.topics == []


@pytest.mark.parametrize("name", ["", "a/b", "../x", "1st", "a b", "ä", "a\n", "{}", "~", "a" * 300])
def test_an_id_that_no_topic_can_have_is_returned(body_topics, log, name):
    assert body_topics.update(["anna", name], 10) == [name]
    assert log == [("open", topic("anna"))]


def test_ids_beyond_the_limit_are_returned(body_topics):
    assert body_topics.update(["a", "b", "c"], 2) == ["c"]
    assert body_topics.topics == [topic("a"), topic("b")]


def test_the_bodies_are_beside_their_list():
    opened = []
    BodyTopics("/robot/humans/bodies/tracked", opened.append, print).update(["x"], 1)
    assert opened == ["/robot/humans/bodies/x/skeleton2d"]
