# SPDX-License-Identifier: Apache-2.0
"""The ledger of a stream: the only place that counts what was dropped and what was irregular but used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType


class Ledger:
    """Counts by reason, and the latest advice on each reason.

    `paul_ros.stream.reasons` lists the reasons. Adapters of other packages may add their own.

    Attributes:
        drops: reason -> number of messages, or of persons if the reason begins with ``person_``. Read-only.
        notes: reason -> how often something irregular was used all the same. Read-only.
        advice: reason -> what happened last and what to do; lacks reasons that need no action. Read-only.
    """

    def __init__(self) -> None:
        self._drops: Counter[str] = Counter()
        self._notes: Counter[str] = Counter()
        self._advice: dict[str, str] = {}
        self.drops: Mapping[str, int] = MappingProxyType(self._drops)
        self.notes: Mapping[str, int] = MappingProxyType(self._notes)
        self.advice: Mapping[str, str] = MappingProxyType(self._advice)

    def drop(self, reason: str, advice: str, count: int = 1) -> None:
        """Count messages or persons that were not used."""
        self._add(self._drops, reason, advice, count)

    def note(self, reason: str, advice: str = "", count: int = 1) -> None:
        """Count something irregular that was used all the same."""
        self._add(self._notes, reason, advice, count)

    def _add(self, counter: Counter[str], reason: str, advice: str, count: int) -> None:
        if count <= 0:
            return
        counter[reason] += count
        if advice:
            self._advice[reason] = advice
