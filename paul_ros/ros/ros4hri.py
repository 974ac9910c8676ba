# SPDX-License-Identifier: Apache-2.0
"""The topics of ROS4HRI's tracked bodies (REP-155), as they appear and leave. Knows nothing of ROS.

/humans/bodies/tracked lists the ids of the bodies in view. Each body has its keypoints on a topic of its own,
/humans/bodies/ID/skeleton2d.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

LIST = "hri_msgs/msg/IdsList"
"""Type of the list; field ids, string[]."""

BODY = "hri_msgs/msg/Skeleton2D"
"""Type of each body's keypoints."""

# A token of a topic's name does not begin with a digit (design.ros2.org, Topic and Service Names).
_ID = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MAX_TOPIC = 247  # characters, in ROS's middleware


class BodyTopics:
    """Opens a topic for each tracked body, and closes it when the body leaves."""

    def __init__(self, list_topic: str, open: Callable[[str], Any], close: Callable[[Any], Any]) -> None:
        """Make it without open topics.

        Args:
            list_topic: topic of the ids; the topics of the bodies are beside it.
            open: opens a topic by its name; its result is passed to `close`.
            close: closes an open topic.
        """
        self._parent = list_topic.rpartition("/")[0]
        self._open, self._close = open, close
        self._opened: dict[str, Any] = {}

    @property
    def topics(self) -> list[str]:
        """Names of the open topics."""
        return sorted(self._opened)

    def update(self, ids: Iterable[str], limit: int) -> list[str]:
        """Open the topics of new ids and close those of ids that are gone.

        Returns:
            The ids that cannot be followed: no topic can have their name, or they exceed the limit.
        """
        names = list(dict.fromkeys(ids))
        possible = [name for name in names if _ID.fullmatch(name) and len(self._topic(name)) <= _MAX_TOPIC][:limit]
        wanted = set(map(self._topic, possible))
        for topic in self._opened.keys() - wanted:
            self._close(self._opened.pop(topic))
        for topic in sorted(wanted - self._opened.keys()):
            self._opened[topic] = self._open(topic)
        return [name for name in names if name not in possible]

    def _topic(self, name: str) -> str:
        return f"{self._parent}/{name}/skeleton2d"

    def clear(self) -> None:
        """Close all topics."""
        self.update([], 0)
