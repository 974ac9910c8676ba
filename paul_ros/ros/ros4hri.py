# SPDX-License-Identifier: Apache-2.0
"""Which topics to read while ROS4HRI's bodies come and go (REP-155); knows nothing of ROS.

/humans/bodies/tracked lists the ids of the bodies in view, and each has its keypoints on a topic of its own,
/humans/bodies/ID/skeleton2d.
"""

from __future__ import annotations

import re
from collections.abc import Callable

LIST = "hri_msgs/msg/IdsList"
"""Type of the list; field ids, string[]."""

BODY = "hri_msgs/msg/Skeleton2D"
"""Type of each body's keypoints."""

# A token of a topic's name begins with no digit (design.ros2.org, Topic and Service Names), so no such topic can be.
_ID = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Tracked:
    """open(topic) -> what close takes, for each body that comes and goes."""

    def __init__(self, list_topic: str, open: Callable[[str], object], close: Callable[[object], None]) -> None:
        """list_topic: of the ids; those of the bodies are beside it."""
        self._beside = list_topic.rpartition("/")[0]
        self._open, self._close = open, close
        self._opened: dict[str, object] = {}

    @property
    def topics(self) -> list[str]:
        """That are open."""
        return sorted(self._opened)

    def update(self, ids, most: int) -> list[str]:
        """Opens the topics of new ids and closes those of ids that are gone; the ids that it cannot follow.

        These are what no topic can be named by, and those beyond the first `most`.
        """
        names = list(dict.fromkeys(ids))
        possible = [name for name in names if _ID.fullmatch(name)][:most]
        wanted = {f"{self._beside}/{name}/skeleton2d" for name in possible}
        for topic in self._opened.keys() - wanted:
            self._close(self._opened.pop(topic))
        for topic in sorted(wanted - self._opened.keys()):
            self._opened[topic] = self._open(topic)
        return [name for name in names if name not in possible]

    def clear(self) -> None:
        """Closes all."""
        self.update([], 0)
