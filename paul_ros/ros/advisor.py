# SPDX-License-Identifier: Apache-2.0
"""Warnings about the input: what is wrong, how often, and what to do; throttled. Knows nothing of ROS."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

from paul_ros.stream.ledger import Ledger

SILENT_SECONDS = 5.0
"""Time without keypoints before a warning."""

WARNING_SECONDS = 5.0
"""Shortest time between two warnings of one kind."""

NOTE_SECONDS = 60.0
"""Shortest time between two warnings of one kind that are not fatal, such as a missing CameraInfo."""


class ThrottledLog:
    """Writes a line at once, and another with the same key only after an interval."""

    def __init__(self, write: Callable[[str], None]) -> None:
        """Make a log that passes its lines to `write`."""
        self._write = write
        self._written: dict[str, float] = {}

    def __call__(self, key: str, text: str, interval: float | None = None) -> None:
        """Write a line, unless the last one with this key is younger than the interval in seconds."""
        now = time.monotonic()
        if now - self._written.get(key, -float("inf")) >= (WARNING_SECONDS if interval is None else interval):
            self._written[key] = now
            self._write(text)

    def hold(self, key: str) -> None:
        """Suppress lines with this key for one interval from now."""
        self._written[key] = time.monotonic()


class Advisor:
    """Warns of what the stream drops and notes, of silence and of missing metres."""

    def __init__(self, log: ThrottledLog) -> None:
        self._log = log
        self._drops: Counter[str] = Counter()
        self._notes: Counter[str] = Counter()

    def report_drops(self, ledger: Ledger) -> None:
        """Warn of every reason whose drops have grown since the last call."""
        for reason, count in ledger.drops.items():
            if count != self._drops[reason]:
                self._drops[reason] = count
                self._log(reason, f"dropped: {reason}, {count} so far. {ledger.advice.get(reason, '')}")

    def report_notes(self, ledger: Ledger) -> None:
        """Warn of every note that has grown since the last call, if there is advice on it."""
        for reason in ledger.notes.keys() & ledger.advice.keys():
            count = ledger.notes[reason]
            if count != self._notes[reason]:
                self._notes[reason] = count
                self._log(reason, f"noted: {reason}, {count} so far. {ledger.advice[reason]}", NOTE_SECONDS)

    def report_silence(self, seconds: float, topic: str, has_publisher: Callable[[], bool]) -> None:
        """Warn if no keypoints have come on a topic for a while; `has_publisher` is called only then."""
        if seconds >= SILENT_SECONDS:
            advice = (
                "Check the detector." if has_publisher() else "Nobody publishes it: remap `keypoints` to your detector."
            )
            self._log("silent", f"No keypoints for {seconds:.0f} s on {topic}. {advice}")

    def report_model_units(self, reason: str) -> None:
        """Warn that points are in model units; the reason is the stream's description of its scale."""
        text = (
            f"Points are in model units, not metres: {reason.removeprefix('none: ')}. "
            "Remap `camera_info` to a calibrated camera."
        )
        self._log("units", text, NOTE_SECONDS)

    def report_clock_set_back(self, seconds: float) -> None:
        """Warn that simulated time was set back."""
        self._log("clock_set_back", f"Time was set back by {seconds:.1f} s.")
