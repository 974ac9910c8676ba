# SPDX-License-Identifier: Apache-2.0
"""The node's health: rates, latency, shares and the level of /diagnostics (REP-107). Knows nothing of ROS.

The levels, from the first that applies:

- ERROR: the input cannot be read; or the node itself failed in the last WINDOW reports; or no message of the last
  second could be used.
- STALE: keypoints came once, but none for STALE_SECONDS.
- WARN: any of these. No keypoints came yet, or none for QUIET_SECONDS. A reason of the last WINDOW reports exceeds its
  share (`RecentCounts`). A CameraInfo is missing for metres. There is other trouble, such as a QoS that does not match.
- OK: none of these.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from paul_ros.lifted import AMBIGUOUS
from paul_ros.ros.recent_counts import WINDOW, RecentCounts
from paul_ros.stream.frame import Frame
from paul_ros.stream.reason import DROP, NEVER, NOTE, PERSON, Reason
from paul_ros.stream.reasons import reason_of
from paul_ros.stream.stream import LiftStream

#: Levels, by the numbers of diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR, STALE = range(4)

STALE_SECONDS = 5.0
"""Silence from which the level is STALE; diagnostic_aggregator allows a silent node as long."""

QUIET_SECONDS = 2.5
"""Silence from which the level is WARN; slower detectors than 0.4 Hz are not expected."""

MAX_LATENCY_SECONDS = 10.0
"""Latency above which a stamp is ignored. Such a stamp, or one in the future, belongs to another clock, as in a bag."""

_LATENCIES_KEPT = 1000  # frames, the last half minute at 30 Hz
_NS = 1e9
_NO_KEYPOINTS = {"missed", "bad_intrinsics", "depth_encoding"}  # drops of messages that never came, or of other inputs


@dataclass(frozen=True)
class Report:
    """The state of the node since the last report.

    Attributes:
        level: OK, WARN, ERROR or STALE.
        message: one line for people.
        values: name -> value, for /diagnostics.
        lifting: whether recent reports had frames.
        silent_seconds: seconds since the last keypoints; before the first, since the node began to wait.
        warnings: reasons that are worth a line in the log.
    """

    level: int
    message: str
    values: dict[str, Any]
    lifting: bool
    silent_seconds: float
    warnings: list[Reason]


class Health:
    """Counts messages and frames, and reports on the time since the last report. Times are monotonic seconds."""

    def __init__(self, now: float, stream: LiftStream) -> None:
        """Begin to wait for keypoints; what the stream has counted until now is old news."""
        self._began = self._last_report = now
        self._last_input: float | None = None
        self._messages = self._frames = 0
        self._latencies: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self._lifted: list[tuple[np.ndarray, np.ndarray]] = []
        self._recent = RecentCounts(stream)

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

    def forget_latency(self) -> None:
        """Discard all latencies, after the clock was set."""
        self._latencies.clear()

    def report(
        self,
        now: float,
        stream: LiftStream,
        problem: str = "",
        input_type: str = "none",
        trouble: Sequence[str] = (),
    ) -> Report:
        """Report on the time since the last report.

        Args:
            now: monotonic seconds.
            stream: the stream in use.
            problem: why the input cannot be read; '' if it can, or if there is none yet.
            input_type: message type of the input.
            trouble: sentences about what else is worth a warning.
        """
        self._recent.add(stream, self._messages)
        silence = None if self._last_input is None else now - self._last_input
        level, message = self._level(silence, problem, stream, trouble)
        values = self._values(now, silence, stream, input_type)
        self._last_report, self._messages, self._frames, self._lifted = now, 0, 0, []
        silent_seconds = now - self._began if silence is None else silence
        return Report(level, message, values, bool(self._recent.frames), silent_seconds, self._worth_logging(stream))

    def _level(
        self, silence: float | None, problem: str, stream: LiftStream, trouble: Sequence[str]
    ) -> tuple[int, str]:
        if problem:
            return ERROR, problem
        if self._recent.count("callback_failed"):
            return ERROR, "a callback of this node failed, see its log"
        if self._recent.count("internal_error"):
            return ERROR, f"a fault of this node, see its log; {self._dropped()}"
        if self._messages and not self._frames and _dropped_messages(self._recent.newest, stream) >= self._messages:
            return ERROR, f"no message could be used; {self._dropped()}"
        if silence is not None and silence >= STALE_SECONDS:
            return STALE, "; ".join([f"no keypoints for {silence:.0f} s; check the detector", *trouble])
        warnings = [*self._warnings(silence, stream), *trouble]
        summary = f"{self._frames} frames since the last report, units: {stream.units}"
        return (
            (WARN, "; ".join([*(warning.removesuffix(".") for warning in warnings), summary]))
            if warnings
            else (OK, summary)
        )

    def _warnings(self, silence: float | None, stream: LiftStream) -> Iterator[str]:
        if silence is None:
            yield "no keypoints yet"
        elif silence >= QUIET_SECONDS:
            yield f"no keypoints for {silence:.0f} s"
        warnings = self._recent.warnings
        if any(reason.kind != NOTE for reason in warnings):
            yield self._dropped()
        for reason in warnings:
            if reason.kind == NOTE:
                yield stream.ledger.advice.get(reason.slug, reason.advice)
        if lacks_camera_info(stream) and self._recent.frames:
            yield "no metres without a usable CameraInfo, remap `camera_info`"

    def _dropped(self) -> str:
        """Return the recent drops that are worth a warning, in words."""
        drops = [self._recent.described(reason) for reason in self._recent.warnings if reason.kind != NOTE]
        return f"dropped: {', '.join(drops)} in the last {WINDOW} s"

    def _worth_logging(self, stream: LiftStream) -> list[Reason]:
        """Return the reasons that are worth a warning, and notes that never are but have advice."""
        never = [r for r in self._recent.recent if r.limit == NEVER and r.slug in stream.ledger.advice]
        return [*self._recent.warnings, *never]

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


def _dropped_messages(reasons: Counter[str], stream: LiftStream) -> int:
    """Return how many drops are messages of keypoints that came, and so neither persons nor other inputs."""
    drops = (slug for slug in reasons if slug in stream.ledger.drops and slug not in _NO_KEYPOINTS)
    return sum(reasons[slug] for slug in drops if reason_of(slug, DROP).kind != PERSON)
