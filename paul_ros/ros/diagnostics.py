# SPDX-License-Identifier: Apache-2.0
"""The node's health: rates, latency, shares and the level of /diagnostics (REP-107). Knows nothing of ROS.

The levels, from the first that applies:

- ERROR: the input cannot be read; or, since the last report, the node itself failed or could use no message.
- STALE: keypoints came once, but none for STALE_SECONDS.
- WARN: any of these was found since the last report. No keypoints came. Something was dropped. A QoS does not match.
  The keypoints' frame is not the camera's, or they lie outside its image. Most persons hardly fit the model. A
  CameraInfo is missing for metres.
- OK: none of these.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from paul_ros.lifted import AMBIGUOUS
from paul_ros.stream.frame import Frame
from paul_ros.stream.stream import LiftStream

#: Levels, by the numbers of diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR, STALE = range(4)

STALE_SECONDS = 5.0
"""Silence from which the level is STALE; diagnostic_aggregator allows a silent node as long."""

MAX_LATENCY_SECONDS = 10.0
"""Latency above which a stamp is ignored. Such a stamp, or one in the future, belongs to another clock, as in a bag."""

MOST_PERSONS = 0.5
"""Share of the lifted persons that must hardly fit the model before it is worth a warning."""

SOME_FRAMES = 0.1
"""Share of the frames whose keypoints must lie outside the image before it is worth a warning: persons of a resized
image are often in the part that CameraInfo states."""

_LATENCIES_KEPT = 1000  # frames, the last half minute at 30 Hz
_NS = 1e9


@dataclass(frozen=True)
class Report:
    """The state of the node since the last report.

    Attributes:
        level: OK, WARN, ERROR or STALE.
        message: one line for people.
        values: name -> value, for /diagnostics.
        frames: number of frames since the last report.
        silent_seconds: seconds since the last keypoints; before the first, since the node began to wait.
    """

    level: int
    message: str
    values: dict[str, Any]
    frames: int
    silent_seconds: float


class Health:
    """Counts messages and frames, and reports on the time since the last report. Times are monotonic seconds."""

    def __init__(self, now: float, drops: Mapping[str, int] = {}, notes: Mapping[str, int] = {}) -> None:
        """Begin to wait for keypoints; drops and notes were counted before and are not reported."""
        self._began = self._last_report = now
        self._last_input: float | None = None
        self._messages = self._frames = self._mismatches = 0
        self._latencies: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self._lifted: list[tuple[np.ndarray, np.ndarray]] = []
        self._old_drops, self._old_notes = Counter(drops), Counter(notes)

    def received(self, now: float) -> None:
        """Count a message of keypoints."""
        self._messages += 1
        self._last_input = now

    def published(self, frame: Frame, clock: int) -> None:
        """Count a frame; `clock` is the present in nanoseconds, by the clock of the stamps."""
        self._frames += 1
        # Evaluated once a second, since a frame must not wait for that.
        self._lifted.append((frame.lifted.certified, frame.lifted.ambiguity))
        latency = (clock - frame.keypoints.stamp) / _NS
        if frame.stamped and 0 <= latency <= MAX_LATENCY_SECONDS:
            self._latencies.append(latency)

    def qos_mismatch(self) -> None:
        """Count an endpoint whose QoS does not match."""
        self._mismatches += 1

    def forget_latency(self) -> None:
        """Discard all latencies, after the clock was set."""
        self._latencies.clear()

    def report(self, now: float, stream: LiftStream, problem: str = "", input_type: str = "none") -> Report:
        """Report on the time since the last report.

        Args:
            now: monotonic seconds.
            stream: the stream in use.
            problem: why the input cannot be read; '' if it can, or if there is none yet.
            input_type: message type of the input.
        """
        silence = None if self._last_input is None else now - self._last_input
        drops = Counter(stream.ledger.drops) - self._old_drops
        level, message = self._level(drops, silence, problem, stream)
        frames, values = self._frames, self._values(now, silence, stream, input_type)
        self._last_report, self._messages, self._frames, self._mismatches = now, 0, 0, 0
        self._old_drops, self._old_notes = Counter(stream.ledger.drops), Counter(stream.ledger.notes)
        self._lifted = []
        return Report(level, message, values, frames, now - self._began if silence is None else silence)

    def _level(self, drops: Counter, silence: float | None, problem: str, stream: LiftStream) -> tuple[int, str]:
        if problem:
            return ERROR, problem
        if drops["internal_error"]:
            return ERROR, f"a fault of this node, see its log; dropped: {listed(drops)}"
        if self._messages and not self._frames and _dropped_messages(drops) >= self._messages:
            return ERROR, f"no message could be used; dropped: {listed(drops)}"
        if silence is not None and silence >= STALE_SECONDS:
            return STALE, f"no keypoints for {silence:.0f} s; check the detector"
        warnings = list(self._warnings(drops, silence, stream))
        summary = f"{self._frames} frames since the last report, units: {stream.units}"
        return (
            (WARN, "; ".join([*(warning.removesuffix(".") for warning in warnings), summary]))
            if warnings
            else (OK, summary)
        )

    def _warnings(self, drops: Counter, silence: float | None, stream: LiftStream) -> Iterator[str]:
        if silence is None:
            yield "no keypoints yet"
        elif not self._messages:
            yield "no keypoints since the last report"
        if drops:
            yield f"dropped: {listed(drops)}"
        if self._mismatches:
            yield f"{self._mismatches} endpoints with a QoS that does not match, see the log"
        notes = Counter(stream.ledger.notes) - self._old_notes
        if notes["another_frame"]:
            yield stream.ledger.advice["another_frame"]
        if notes["unlike_the_model"] > MOST_PERSONS * self._persons_lifted():
            yield stream.ledger.advice["unlike_the_model"]
        if notes["outside_image"] > SOME_FRAMES * self._frames:
            yield stream.ledger.advice["outside_image"]
        if lacks_camera_info(stream) and self._frames:
            yield "no metres without a usable CameraInfo, remap `camera_info`"

    def _values(self, now: float, silence: float | None, stream: LiftStream, input_type: str) -> dict[str, Any]:
        elapsed = max(now - self._last_report, 1e-9)
        lift = percentiles(stream.lift_us)
        latency = percentiles(self._latencies)
        described = stream.describe()
        return {
            **stream.counts,
            **{f"dropped_{reason}": count for reason, count in sorted(stream.ledger.drops.items())},
            **{f"noted_{reason}": count for reason, count in sorted(stream.ledger.notes.items())},
            "rate_in_hz": f"{self._messages / elapsed:.1f}",
            "rate_out_hz": f"{self._frames / elapsed:.1f}",
            "last_input_age_s": "none" if silence is None else f"{silence:.1f}",
            "latency_ms_median": f"{1e3 * latency[0]:.2f}" if latency else "unknown",
            "latency_ms_p99": f"{1e3 * latency[1]:.2f}" if latency else "unknown",
            "lift_us_median": f"{lift[0]:.1f}" if lift else "0.0",
            "lift_us_p99": f"{lift[1]:.1f}" if lift else "0.0",
            **self._shares(),
            "units": stream.units,
            "input_type": input_type,
            **{key: described[key] for key in ("input_layout", "layout", "model", "model_sha256")},
        }

    def _persons_lifted(self) -> int:
        """Return the number of persons lifted since the last report; others have no ambiguity."""
        return sum(int(np.isfinite(ambiguity).sum()) for _, ambiguity in self._lifted)

    def _shares(self) -> dict[str, str]:
        """Return the certified and the ambiguous share of the persons lifted since the last report."""
        if not self._persons_lifted():
            return {"certified_share": "none", "ambiguous_share": "none"}
        certified, ambiguity = map(np.concatenate, zip(*self._lifted))
        lifted = np.isfinite(ambiguity)
        return {
            "certified_share": f"{np.mean(certified[lifted]):.3f}",
            "ambiguous_share": f"{np.mean(ambiguity[lifted] >= AMBIGUOUS):.3f}",
        }


def lacks_camera_info(stream: LiftStream) -> bool:
    """Return whether points are in model units only because no usable CameraInfo has come."""
    return stream.units == "model" and stream.lifter.metres_per_unit is not None


def percentiles(values: Iterable[float]) -> tuple[float, float] | None:
    """Return the median and the 99th percentile; None if there are no values."""
    numbers = list(values)
    if not numbers:
        return None
    median, p99 = np.percentile(numbers, (50, 99)).tolist()
    return median, p99


def listed(counts: Mapping[str, int]) -> str:
    """Return counts as text, such as '1 not_2d, 2 wrong_fields'."""
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items())) or "none"


def summary(stream: LiftStream) -> str:
    """Return in one line what a stream has done."""
    median, p99 = percentiles(stream.lift_us) or (0.0, 0.0)
    counts = stream.counts
    return (
        f"{counts['frames']} frames, {counts['lifted']} of {counts['persons']} persons lifted, "
        f"median {median:.0f} µs, p99 {p99:.0f} µs per frame; dropped: {listed(stream.ledger.drops)}"
    )


def _dropped_messages(drops: Counter) -> int:
    """Return how many drops are messages that came: neither persons nor messages that were lost on the way."""
    return sum(count for reason, count in drops.items() if not reason.startswith("person_") and reason != "missed")
