# SPDX-License-Identifier: Apache-2.0
"""What was published but never came, told by the numbers that publishers give their messages."""

from __future__ import annotations


class PublicationNumbers:
    """Counts the numbers that were left out, of any number of publishers on one topic.

    Every publisher counts from one, and rclpy does not tell whose a number is. It is taken for the next of the
    publisher whose last is nearest below it. Whosever it really was, the sum of the gaps is right: it is by how much
    all numbers have grown, less what came. Only while a publisher has not been heard yet, a gap may be its first
    number, and is taken for that.
    """

    def __init__(self) -> None:
        self._last: list[int] = []  # of each publisher that was heard; whose was heard last is at the end

    def missed(self, number: int, publishers) -> int:
        """How many were left out before this one. publishers(): how many there are now; asked only where it matters."""
        if number - 1 in self._last:
            self._put(number, number - 1)
            return 0
        count, below = max(publishers(), 1), [last for last in self._last if last < number]
        if not below or len(self._last) < count:
            # One that is new, or started again: then another is gone, the one that was not heard for longest.
            self._last = [*self._last, number][-count:]
            return 0
        nearest = max(below)
        self._put(number, nearest)
        return number - nearest - 1

    def _put(self, number: int, instead: int) -> None:
        self._last.remove(instead)
        self._last.append(number)
