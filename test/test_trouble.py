# SPDX-License-Identifier: Apache-2.0
"""Trouble around the node: simulated time whose clock comes and goes."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from paul_ros.ros import trouble
from paul_ros.ros.advisor import SILENT_SECONDS
from paul_ros.ros.trouble import Trouble


@pytest.fixture
def node(monkeypatch):
    """A node in simulated time, with as many publishers of /clock as `clocks`, at the second `now`."""
    node = SimpleNamespace(clocks=0, now=100.0, clock=SimpleNamespace(ros_time_is_active=True))
    node.get_clock = lambda: node.clock
    node.resolve_topic_name = lambda name: name
    node.count_publishers = lambda topic: node.clocks
    monkeypatch.setattr(trouble.time, "monotonic", lambda: node.now)
    return node


def test_a_clock_that_never_came_or_is_gone_is_named_after_a_while(node):
    """A bag that starts again is no trouble; a simulator that has crashed is."""
    watched = Trouble(node)

    def after(seconds: float, clocks: int) -> list[str]:
        node.now, node.clocks = node.now + seconds, clocks
        return watched.sentences()

    assert after(SILENT_SECONDS - 1, 0) == []
    (text,) = after(1, 0)
    assert text.startswith("use_sim_time is true, but nobody publishes /clock, so time stands still. Start")
    assert after(1, 1) == after(1000, 1) == after(SILENT_SECONDS - 1, 0) == after(1, 1) == []
    assert after(SILENT_SECONDS - 1, 0) == [] and after(1, 0) == [text]
    node.clock.ros_time_is_active = False
    assert after(1000, 0) == []
