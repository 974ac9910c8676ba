# SPDX-License-Identifier: Apache-2.0
"""Grouping of the persons of one image, for detectors that send one message per person."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import msg_adapters
from paul_ros.stream.arrival import Arrival

SILENCE_SECONDS = 0.01
"""Longest pause between the messages of one image: detectors send them in one burst."""


class PersonGroup:
    """The persons of one image that have come so far, each in a message of its own.

    Messages with equal stamps and frames are one image. Messages without a stamp are one image while the pauses between
    them are short. Two persons of an image may share an id, if the detector's tracker fails.
    """

    def __init__(self) -> None:
        self._parts: dict[Hashable, Arrival] = {}
        self._last: Arrival | None = None

    def __len__(self) -> int:
        """Number of messages in the group."""
        return len(self._parts)

    def accepts(self, message: Arrival) -> bool:
        """Return whether a message belongs to the group's image; an empty group accepts any."""
        last = self._last
        if last is None:
            return True
        new, old = message.keypoints, last.keypoints
        prompt = abs(message.received - last.received) <= SILENCE_SECONDS * 1e9
        if (new.frame_id, message.stamped) != (old.frame_id, last.stamped):
            return False
        if not message.stamped:
            return prompt
        # The stamp of a broken clock stands still. Then an id that comes again after a pause begins the next image.
        return new.stamp == old.stamp and (prompt or not self._knows(new.ids))

    def add(self, message: Arrival) -> bool:
        """Add a person; return False if the message replaces an earlier one about the same person."""
        about = _subject(message)
        earlier = self._parts.get(about)
        self._parts[about] = self._last = message
        if earlier:
            # The image keeps the time of its first message.
            keypoints = replace(message.keypoints, stamp=earlier.keypoints.stamp)
            self._parts[about] = replace(message, header=earlier.header, keypoints=keypoints)
        return earlier is None

    def take(self) -> Arrival:
        """Return all persons in the order of arrival with the first one's header, and empty the group."""
        parts = list(self._parts.values())
        self._parts, self._last = {}, None
        return replace(parts[0], keypoints=msg_adapters.join([part.keypoints for part in parts]))

    def _knows(self, ids: tuple[str, ...]) -> bool:
        known = {name for part in self._parts.values() for name in part.keypoints.ids if name}
        return not known.isdisjoint(ids)


def _subject(message: Arrival) -> Hashable:
    """Return a value that two messages of one image share only if they are about one person.

    Each body of ROS4HRI has a topic of its own, /humans/bodies/ID/skeleton2d. Elsewhere only a message with equal
    pixels is a repetition: trackers exist that give all persons one id, on topics such as /camera/0/poses.
    """
    ids = message.keypoints.ids
    if any(f"/bodies/{name}/" in message.topic for name in ids if name):
        return message.topic
    # Persons of whom nothing is seen look alike.
    return (ids, message.keypoints.xy.tobytes()) if message.keypoints.visible.any() else id(message)
