# SPDX-License-Identifier: Apache-2.0
"""How the node fares: rates, latency, shares and the level of /diagnostics (REP-107), by rules stated here.

ERROR: the input cannot be read, a fault of the node itself since the last report, or every message since then was of no
use. STALE: keypoints came once, but none for STALE_SECONDS. WARN: no keypoints yet or since the last report, something
was dropped, a QoS does not match, keypoints name another frame than the camera's, most persons are like no shape of the
model, or points are in model units though the model knows its metres. OK: none of these.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from paul_ros.lifted import AMBIGUOUS
from paul_ros.stream.stream import Frame, LiftStream

#: Levels, by the numbers of diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR, STALE = range(4)

STALE_SECONDS = 5.0
"""Of silence; diagnostic_aggregator calls a node that says nothing stale after as long."""

MOST_LATENCY_SECONDS = 10.0
"""A stamp that is older, or from the future, is of another clock, as in a bag that is played, and tells no latency."""

_LATENCIES_KEPT = 1000  # frames, the last half minute at 30 Hz
_NS = 1e9


class Aloud:
    """Says a text at once, and what has the same key again only after a while; `say` writes the log."""

    def __init__(self, say: Callable[[str], None], every: float = 5.0) -> None:
        self._say, self._every, self._said = say, every, {}

    def __call__(self, key: str, text: str, every: float | None = None) -> None:
        """every: seconds, of this key."""
        now = time.monotonic()
        if now - self._said.get(key, -np.inf) >= (every or self._every):
            self._said[key] = now
            self._say(text)

    def hold(self, *keys: str) -> None:
        """Says nothing of these for as long as if it had just been said."""
        self._said.update(dict.fromkeys(keys, time.monotonic()))


@dataclass(frozen=True)
class Report:
    """level: one of OK, WARN, ERROR, STALE; message: one line; values: name -> what /diagnostics tells of it.

    frames: since the last report. waited: seconds without keypoints, before the first since it began to wait for them.
    """

    level: int
    message: str
    values: dict
    frames: int
    waited: float


class Health:
    """Counts what comes and goes, and reports on the time since the last report. Times are in seconds, monotonic."""

    def __init__(self, now: float, drops: Counter = Counter(), notes: Counter = Counter()) -> None:
        """drops, notes: that are old news."""
        self._began = self._since = now
        self._last_input: float | None = None
        self._came = self._went = 0
        self._latencies: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self._doubts: list = []
        self._counted, self._noted = Counter(drops), Counter(notes)
        self._mismatches = 0

    def came(self, now: float) -> None:
        """A message of keypoints."""
        self._came += 1
        self._last_input = now

    def went(self, frame: Frame, clock: int) -> None:
        """A frame was published; clock: ns now, by the clock that stamps are of."""
        self._went += 1
        # Looked at once a second: a frame must not wait for that.
        self._doubts.append((frame.lifted.certified, frame.lifted.ambiguity))
        latency = (clock - frame.keypoints.stamp) / _NS
        if 0 <= latency <= MOST_LATENCY_SECONDS:
            self._latencies.append(latency)

    def mismatch(self) -> None:
        """An endpoint was found whose QoS does not match."""
        self._mismatches += 1

    def forget_latency(self) -> None:
        """The clock was set."""
        self._latencies.clear()

    def report(self, now: float, stream: LiftStream, problem: str = "", source: str = "none") -> Report:
        """problem: why the input cannot be read, '' where it can, or is not there yet; source: its type."""
        silence = None if self._last_input is None else now - self._last_input
        drops = stream.drops - self._counted
        level, message = self._level(drops, silence, problem, stream)
        frames, values = self._went, self._values(now, silence, stream, source)
        self._since, self._came, self._went, self._mismatches = now, 0, 0, 0
        self._counted, self._noted, self._doubts = Counter(stream.drops), Counter(stream.notes), []
        return Report(level, message, values, frames, now - self._began if silence is None else silence)

    def _level(self, drops: Counter, silence: float | None, problem: str, stream: LiftStream) -> tuple[int, str]:
        if problem:
            return ERROR, problem
        if drops["internal_error"]:
            return ERROR, f"a fault of this node; dropped: {listed(drops)}"
        if self._came and not self._went and _messages(drops) >= self._came:
            return ERROR, f"nothing that came could be used; dropped: {listed(drops)}"
        if silence is not None and silence >= STALE_SECONDS:
            return STALE, f"no keypoints for {silence:.0f} s"
        odd = list(self._odd(drops, silence, stream))
        said = f"{self._went} frames since the last report, units: {stream.units}"
        return (WARN, "; ".join([*odd, said])) if odd else (OK, said)

    def _odd(self, drops: Counter, silence: float | None, stream: LiftStream):
        """What is worth a warning."""
        if silence is None:
            yield "no keypoints yet"
        elif not self._came:
            yield "no keypoints since the last report"
        if drops:
            yield f"dropped: {listed(drops)}"
        if self._mismatches:
            yield f"{self._mismatches} endpoints with a QoS that does not match"
        notes = stream.notes - self._noted
        if notes["another_frame"]:
            yield stream.explanations["another_frame"]
        if notes["unlike_the_model"] > 0.5 * self._lifted():
            yield stream.explanations["unlike_the_model"]
        if unscaled(stream) and self._went:
            yield "no metres, for no usable CameraInfo has come"

    def _values(self, now: float, silence: float | None, stream: LiftStream, source: str) -> dict:
        elapsed = max(now - self._since, 1e-9)
        lift = percentiles(stream.lift_us)
        latency = percentiles(self._latencies)
        told = stream.describe()
        return {
            **stream.counts,
            **{f"dropped_{reason}": count for reason, count in sorted(stream.drops.items())},
            **{f"noted_{what}": count for what, count in sorted(stream.notes.items())},
            "rate_in_hz": f"{self._came / elapsed:.1f}",
            "rate_out_hz": f"{self._went / elapsed:.1f}",
            "last_input_age_s": "none" if silence is None else f"{silence:.1f}",
            "latency_ms_median": f"{1e3 * latency[0]:.2f}" if latency else "unknown",
            "latency_ms_p99": f"{1e3 * latency[1]:.2f}" if latency else "unknown",
            "lift_us_median": f"{lift[0]:.1f}" if lift else "0.0",
            "lift_us_p99": f"{lift[1]:.1f}" if lift else "0.0",
            **self._shares(),
            "units": stream.units,
            "input_type": source,
            **{key: told[key] for key in ("input_layout", "layout", "model", "model_sha256")},
        }

    def _lifted(self) -> int:
        """Persons since the last report."""
        return sum(int(np.isfinite(ambiguity).sum()) for _, ambiguity in self._doubts)

    def _shares(self) -> dict:
        """Of the persons that were lifted since the last report; a person that was not has no ambiguity."""
        certified, ambiguity = map(np.concatenate, zip(*self._doubts)) if self._doubts else np.empty((2, 0))
        lifted = np.isfinite(ambiguity)
        if not lifted.any():
            return {"certified_share": "none", "ambiguous_share": "none"}
        return {
            "certified_share": f"{np.mean(certified[lifted]):.3f}",
            "ambiguous_share": f"{np.mean(ambiguity[lifted] >= AMBIGUOUS):.3f}",
        }


def unscaled(stream: LiftStream) -> bool:
    """Whether points are in model units although the model knows its metres: a CameraInfo is what lacks."""
    return stream.units == "model" and stream.lifter.metres_per_unit is not None


def percentiles(values) -> tuple[float, float] | None:
    """Median and 99th percentile; None of nothing."""
    return tuple(np.percentile(values, (50, 99)).tolist()) if values else None


def listed(counter: Counter) -> str:
    """As '2 wrong_fields, 1 not_2d'."""
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counter.items())) or "none"


def _messages(drops: Counter) -> int:
    """How many of the drops are messages that came: not persons of one, nor what never came."""
    return sum(count for reason, count in drops.items() if not reason.startswith("person_") and reason != "missed")
