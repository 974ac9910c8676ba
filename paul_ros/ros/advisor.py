# SPDX-License-Identifier: Apache-2.0
"""Warnings about the input: what is wrong, how often, and what to do; throttled. Knows nothing of ROS."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable

from paul_ros.stream.ledger import Ledger
from paul_ros.stream.reason import NOTE, Reason

SILENT_SECONDS = 5.0
"""Time without keypoints, or without /clock, before a warning."""

REPEAT_SECONDS = (60.0, 600.0)
"""Shortest time from the first warning of one kind to the second, and between later ones."""


class ThrottledLog:
    """Writes a line at once, another with the same key after a minute, and then one in ten minutes at most."""

    def __init__(self, write: Callable[[str], None]) -> None:
        """Make a log that passes its lines to `write`."""
        self._write = write
        self._due: dict[str, float] = {}
        self._written: Counter[str] = Counter()

    def __call__(self, key: str, text: str) -> None:
        """Write a line, unless the last one with this key is too recent."""
        now = time.monotonic()
        if now >= self._due.get(key, now):
            self._due[key] = now + REPEAT_SECONDS[min(self._written[key], len(REPEAT_SECONDS) - 1)]
            self._written[key] += 1
            self._write(text)

    def hold(self, key: str, seconds: float) -> None:
        """Suppress lines with this key for some seconds from now."""
        self._due[key] = time.monotonic() + seconds

    def forget(self) -> None:
        """Write the next line of every kind at once, as after a change by the user."""
        self._due.clear()
        self._written.clear()


class Advisor:
    """Warns of what the stream drops and notes, of silence, of missing metres and of a missing clock."""

    def __init__(self, log: ThrottledLog) -> None:
        self._log = log
        self._logged: dict[str, int] = {}

    def report_reasons(self, reasons: Iterable[Reason], ledger: Ledger) -> None:
        """Warn of every reason that is worth it, and whose count has grown since the last call."""
        for reason in reasons:
            counts, verb = (ledger.notes, "noted") if reason.kind == NOTE else (ledger.drops, "dropped")
            count = counts[reason.slug]
            if count != self._logged.get(reason.slug):
                self._logged[reason.slug] = count
                advice = ledger.advice.get(reason.slug, "")
                self._log(reason.slug, f"{verb}: {reason.slug}, {count} so far. {advice}")

    def report_silence(self, seconds: float, topic: str, has_publisher: Callable[[], bool]) -> None:
        """Warn if no keypoints have come on a topic for a while; `has_publisher` is called only then."""
        if seconds < SILENT_SECONDS:
            return
        silence = f"No keypoints for {seconds:.0f} s on {topic}."
        if has_publisher():
            self._log("silent", f"{silence} Check the detector.")
        else:
            self._log("no publisher", f"{silence} Nobody publishes it: remap `keypoints` to your detector.")

    def report_model_units(self, reason: str) -> None:
        """Warn that points are in model units; the reason is the stream's description of its scale."""
        text = (
            f"Points are in model units, not metres: {reason.removeprefix('none: ')}. "
            "Remap `camera_info` to a calibrated camera."
        )
        self._log("units", text)

    def report_trouble(self, trouble: Iterable[str]) -> None:
        """Warn of other trouble; each sentence is a kind of its own."""
        for text in trouble:
            self._log(text, text)

    def report_clock_set_back(self, seconds: float) -> None:
        """Warn that simulated time was set back."""
        self._log("clock_set_back", f"Time was set back by {seconds:.1f} s.")
