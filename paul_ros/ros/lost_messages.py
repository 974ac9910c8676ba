# SPDX-License-Identifier: Apache-2.0
"""Detection of lost messages by the sequence numbers of their publishers."""

from __future__ import annotations

from collections.abc import Callable


class PublicationNumbers:
    """Counts gaps in the sequence numbers of any number of publishers on one topic.

    Every publisher counts from one, and rclpy does not say which publisher a number belongs to. A number is assigned
    to the publisher whose last number is nearest below it. Even if that is wrong, the sum of the gaps is right: it is
    the growth of all numbers, less the messages that came. Only while a publisher has not been heard yet, a gap may be
    taken for its first number.
    """

    def __init__(self) -> None:
        self._last: list[int] = []  # the last number of each publisher, the most recent at the end

    def missed(self, number: int, count_publishers: Callable[[], int]) -> int:
        """Return how many messages were lost before the one with this number.

        Args:
            number: publication sequence number of the message.
            count_publishers: returns the present number of publishers; called only if there may be a gap.
        """
        if number - 1 in self._last:
            self._replace(number - 1, number)
            return 0
        count, below = max(count_publishers(), 1), [last for last in self._last if last < number]
        if not below or len(self._last) < count:
            # The publisher is new or was restarted. If there are too many, forget the one silent for longest.
            self._last = [*self._last, number][-count:]
            return 0
        nearest = max(below)
        self._replace(nearest, number)
        return number - nearest - 1

    def _replace(self, old: int, new: int) -> None:
        self._last.remove(old)
        self._last.append(new)
