# SPDX-License-Identifier: Apache-2.0
"""A reason to count a drop or a note, and when it is worth a warning. `reasons` has the table of all."""

from __future__ import annotations

import math
from dataclasses import dataclass

DROP = "drop"
"""Kind: a whole message was not used."""

PERSON = "person"
"""Kind: one person was left out of the outputs; the others of its message were lifted."""

NOTE = "note"
"""Kind: something was irregular or worth counting, but was used."""

AT_ONCE = 0.0
"""Share that any count exceeds."""

SOME = 0.1
"""Share above which too many are affected to be chance: lost messages, or points beyond the image's border."""

MOST = 0.5
"""Share above which most are affected. Fewer are normal: persons at the image's edge, or misdetections."""

NEVER = math.inf
"""Share that no count exceeds."""

_WARN_ABOVE = {DROP: AT_ONCE, PERSON: MOST, NOTE: NEVER}


@dataclass(frozen=True)
class Reason:
    """One reason.

    Attributes:
        slug: key in the ledger, in JSON reports and, after ``dropped_`` or ``noted_``, in /diagnostics.
        kind: DROP, PERSON or NOTE.
        what: what happened, one sentence without a full stop.
        fix: what to do, one or two sentences. Parameters and topics of the node stand in backticks.
        warn_above: share of the recent messages or persons above which it is a WARN; None = that of its kind.
        counts_persons: whether it counts persons; otherwise it counts messages.
    """

    slug: str
    kind: str
    what: str
    fix: str
    warn_above: float | None = None
    counts_persons: bool = False

    @property
    def advice(self) -> str:
        """Both sentences, for a log line or a report."""
        return f"{self.what}. {self.fix}"

    @property
    def limit(self) -> float:
        """Share of the recent messages or persons above which /diagnostics is WARN: AT_ONCE, NEVER or between."""
        return _WARN_ABOVE[self.kind] if self.warn_above is None else self.warn_above

    @property
    def unit(self) -> str:
        """The whole that the share is taken of: "persons" or "messages"."""
        return "persons" if self.counts_persons or self.kind == PERSON else "messages"

    @property
    def warns(self) -> str:
        """When it is a WARN, for the documentation."""
        if self.limit == AT_ONCE:
            return "at once"
        return "never" if self.limit == NEVER else f"above {100 * self.limit:.0f} % of {self.unit}"
