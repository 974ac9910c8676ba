# SPDX-License-Identifier: Apache-2.0
"""Counts of what became of the cases."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_FAILURES_KEPT = 20


class WrongOutput(Exception):
    """An output that cannot be right."""


@dataclass
class Tally:
    """Counts of the cases of one kind.

    Attributes:
        cases: number of cases.
        accepted: cases that became a frame or part of one, or were read.
        refused: cases that became counted drops or a promised error.
        crashes: cases that crashed.
        misreadings: cases whose output is wrong, or whose fault has no note or drop.
        uncounted: sessions that lost messages uncounted, and errors that are not one line.
        slowest_ms: most processor time of a case.
        reasons: reasons of drops and names of errors.
        failures: texts of the first crashes and losses.
    """

    cases: int = 0
    accepted: int = 0
    refused: int = 0
    crashes: int = 0
    uncounted: int = 0
    misreadings: int = 0
    slowest_ms: float = 0.0
    reasons: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def crash(self, where: str) -> None:
        """Count a crash, with the traceback of the exception that is being handled."""
        self.crashes += 1
        self._keep(f"{where}: {traceback.format_exc(limit=-3)}")

    def lost(self, where: str, text: str) -> None:
        """Count a loss."""
        self.uncounted += 1
        self._keep(f"{where}: {text}")

    def misread(self, where: str, text: str) -> None:
        """Count an output that is wrong although nothing says so, or a false alarm."""
        self.misreadings += 1
        self._keep(f"{where}: {text}")

    def refuse(self, error: Exception, where: str) -> None:
        """Count a promised error by its type; its text must be one line."""
        self.reasons[type(error).__name__] += 1
        if not str(error) or "\n" in str(error):
            self.lost(where, f"the error is not one line: {error!r}")

    def drops(self, new: Mapping[str, int]) -> None:
        """Count a case of messages by the drops that it caused."""
        self.reasons += Counter(new)
        dropped = sum(new.values()) - persons_in(new)
        self.refused += dropped > 0
        self.accepted += not dropped

    def time(self, seconds: float) -> None:
        """Record the processor time of a case."""
        self.slowest_ms = max(self.slowest_ms, 1000 * seconds)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**vars(self), "reasons": dict(self.reasons.most_common())}

    def _keep(self, text: str) -> None:
        if len(self.failures) < _FAILURES_KEPT:
            self.failures.append(text)


def persons_in(drops: Mapping[str, int]) -> int:
    """Return how many drops are of persons; the others are of messages."""
    return sum(count for reason, count in drops.items() if reason.startswith("person_"))
