# SPDX-License-Identifier: Apache-2.0
"""Counts of the last seconds, and which of their reasons are worth a warning. Knows nothing of ROS."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from paul_ros.stream.reason import AT_ONCE, DROP, NOTE, Reason
from paul_ros.stream.reasons import reason_of
from paul_ros.stream.stream import LiftStream

WINDOW = 10
"""Number of reports, one a second, that a warning is about."""

LASTING = 5
"""Number of these reports that must have a reason with a share before it is a warning: a person who walks into the
image is left out for a moment."""

_STAY = 0.5
"""Share at which a warning ends, over the share at which it began, so that a share near its limit does not flicker."""


@dataclass(frozen=True)
class _Part:
    """Growth of all counts from one report to the next.

    Attributes:
        frames: number of frames.
        persons: number of persons in them.
        messages: number of messages that came, and that were lost on the way.
        reasons: drops and notes by slug.
    """

    frames: int
    persons: int
    messages: int
    reasons: Counter[str]


class RecentCounts:
    """A sliding window over the counts of a stream, which grow from report to report."""

    def __init__(self, stream: LiftStream) -> None:
        """Begin with what a stream has counted until now, which is not recent."""
        self._parts: deque[_Part] = deque(maxlen=WINDOW)
        self._warned: set[str] = set()
        self._remember(stream)

    def add(self, stream: LiftStream, messages: int) -> None:
        """Add the time since the last call; `messages` is the number of messages that came in it."""
        reasons = _reasons(stream) - self._reasons
        frames, persons = (stream.counts[key] - self._counts[key] for key in ("frames", "persons"))
        self._parts.append(_Part(frames, persons, messages + reasons["missed"], reasons))
        self._remember(stream)
        self._warned = {slug for slug in self._recent_reasons() if self._is_excessive(self._row(slug))}

    @property
    def frames(self) -> int:
        """Number of recent frames."""
        return sum(part.frames for part in self._parts)

    @property
    def newest(self) -> Counter[str]:
        """Drops and notes since the last report but one, by slug."""
        return self._parts[-1].reasons if self._parts else Counter()

    @property
    def warnings(self) -> list[Reason]:
        """Reasons that are worth a warning, in alphabetical order.

        A reason with the limit AT_ONCE is one as long as it is recent. Any other must lie above its share of the recent
        messages or persons, and in LASTING reports; it stays until it falls to half of that share.
        """
        return [self._row(slug) for slug in sorted(self._warned)]

    @property
    def recent(self) -> list[Reason]:
        """All reasons that are recent, in alphabetical order."""
        return [self._row(slug) for slug in sorted(self._recent_reasons())]

    def count(self, slug: str) -> int:
        """Return the recent count of a reason."""
        return sum(part.reasons[slug] for part in self._parts)

    def described(self, reason: Reason) -> str:
        """Return a recent count in words, with its share if the limit is one: '9 person_too_far (60 % of persons)'."""
        count = self.count(reason.slug)
        share = "" if reason.limit == AT_ONCE else f" ({100 * count / self._all(reason):.0f} % of {reason.unit})"
        return f"{count} {reason.slug}{share}"

    def _remember(self, stream: LiftStream) -> None:
        self._counts, self._reasons = Counter(stream.counts), _reasons(stream)
        self._notes = frozenset(stream.ledger.notes)

    def _recent_reasons(self) -> set[str]:
        return {slug for part in self._parts for slug in part.reasons}

    def _row(self, slug: str) -> Reason:
        return reason_of(slug, NOTE if slug in self._notes else DROP)

    def _all(self, reason: Reason) -> int:
        """Return the recent number of all messages or persons that a reason may concern; at least 1."""
        return max(1, sum(part.persons if reason.unit == "persons" else part.messages for part in self._parts))

    def _is_excessive(self, reason: Reason) -> bool:
        if reason.limit == AT_ONCE:
            return True
        share = self.count(reason.slug) / self._all(reason)
        if reason.slug in self._warned:
            return share > _STAY * reason.limit
        return share > reason.limit and sum(reason.slug in part.reasons for part in self._parts) >= LASTING


def _reasons(stream: LiftStream) -> Counter[str]:
    """Return all drops and notes of a stream by slug."""
    return Counter(stream.ledger.drops) + Counter(stream.ledger.notes)
