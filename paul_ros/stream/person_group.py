# SPDX-License-Identifier: Apache-2.0
"""Grouping of the persons of one image, for detectors that send one message per person."""

from __future__ import annotations

from typing import Any

import msg_adapters
from msg_adapters import Keypoints2D


class PersonGroup:
    """The persons of one image that have come so far, each in a message of its own.

    A group closes when a person of another stamp or frame arrives, or one whose id it already has.
    """

    def __init__(self) -> None:
        self._header: Any = None
        self._parts: list[Keypoints2D] = []

    def __len__(self) -> int:
        """Number of messages in the group."""
        return len(self._parts)

    def accepts(self, keypoints: Keypoints2D) -> bool:
        """Return whether these keypoints belong to the group's image; an empty group accepts any."""
        if not self._parts:
            return True
        first = self._parts[0]
        known = {name for part in self._parts for name in part.ids if name}
        same = (keypoints.stamp, keypoints.frame_id) == (first.stamp, first.frame_id)
        return same and not known.intersection(keypoints.ids)

    def add(self, header: Any, keypoints: Keypoints2D) -> None:
        """Add a person. The group's header is the last one's; stamp and frame are those of all."""
        self._header = header
        self._parts.append(keypoints)

    def take(self) -> tuple[Any, Keypoints2D]:
        """Return the header and all persons in the order of arrival, and empty the group."""
        parts, self._parts = self._parts, []
        return self._header, msg_adapters.join(parts)
