# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark node`: latency, CPU time and memory of the lifter, beside a node that does not lift.

The lifter and the echo node are sent the same messages in turns of a second or two, so that whatever disturbs the
machine disturbs both.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from paul_ros.benchmarks.node_processes import NodeBench, Turn, node_bench
from paul_ros.benchmarks.traffic import NODES
from paul_ros.extras import require
from paul_ros.versions import versions

#: Starts of each node, for the time to its first output.
STARTS = 3

#: Seconds that one node is measured before it is the other's turn.
SLICE_SECONDS = 2.0

#: Seconds between two readings of the memory in a long run.
SOAK_SECONDS = 10.0

_WARM_UP = 20  # messages before anything is measured at a rate and a number of persons
_US = 1e6
_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s"


def run(persons: list[int], rates: list[int], seconds: float) -> dict:
    """Measure both nodes, with a progress bar if stderr is a terminal.

    Args:
        persons: numbers of persons in an image.
        rates: message rates in Hz.
        seconds: time to measure each node at each number of persons and each rate.

    Returns:
        The report, ready for JSON.

        rows: node, persons, rate_hz, sent, received, latency_median_us, latency_p99_us, cpu_us_per_frame, rss_mb.
        ratios: see `ratios`.
        start_to_first_output_s: node -> seconds.

    Raises:
        MissingPackageError: ROS 2 or tqdm is not installed.
        BagError: the shipped recording is not installed.
        NodeBenchmarkError: a process fails.
    """
    require("benchmark", "tqdm")
    from tqdm import tqdm

    cells = [(count, rate) for count in persons for rate in rates]
    total = len(NODES) * len(cells) * seconds
    load, starts = os.getloadavg()[0], first_outputs()
    with (
        tqdm(total=total, unit="s", disable=None, dynamic_ncols=True, bar_format=_BAR) as bar,
        node_bench(persons) as bench,
    ):
        bench.start_all(*NODES)
        rows = []
        for count, rate in cells:
            bar.set_description(f"{count} persons, {rate:g} Hz")
            rows += _measure_cell(bench, count, rate, seconds, bar.update)
    return {**_head(load, seconds), "start_to_first_output_s": starts, "ratios": ratios(rows), "rows": rows}


def soak(persons: int, rate: float, minutes: float) -> dict:
    """Measure the lifter alone for a long time and read its memory every SOAK_SECONDS; else as `run`.

    Returns:
        The report of `run` with one row, and `soak`: minutes, memory (a list of s and rss_mb), rss_mb_max and
        growth_mb_per_hour.
    """
    require("benchmark", "tqdm")
    from tqdm import tqdm

    seconds, load, starts = 60 * minutes, os.getloadavg()[0], first_outputs()
    with (
        tqdm(total=seconds, unit="s", disable=None, dynamic_ncols=True, bar_format=_BAR) as bar,
        node_bench([persons]) as bench,
    ):
        bench.start_all("lifter")
        bar.set_description(f"soak, {persons} persons, {rate:g} Hz")
        bench.measure("lifter", persons, rate, _WARM_UP)
        turns, memory = [], [(0.0, bench.rss_mb("lifter"))]
        began = time.monotonic()
        while (passed := time.monotonic() - began) < seconds:
            part = min(SOAK_SECONDS, max(seconds - passed, 1 / rate))
            turns.append(bench.measure("lifter", persons, rate, _message_count(part, rate)))
            memory.append((time.monotonic() - began, bench.rss_mb("lifter")))
            bar.update(part)
    found = {"minutes": minutes, "memory": [{"s": s, "rss_mb": mb} for s, mb in memory], **memory_growth(memory)}
    rows = [row("lifter", persons, rate, turns, memory[-1][1])]
    return {**_head(load, seconds), "start_to_first_output_s": starts, "soak": found, "ratios": [], "rows": rows}


def first_outputs() -> dict[str, float]:
    """Return the seconds from the start of each node's process to its first output, the median of STARTS in turns.

    The publisher and the listener are started anew each time: after a participant is lost, discovery may take 3 s.
    """
    found: dict[str, list[float]] = {name: [] for name in NODES}
    for _ in range(STARTS):
        for name in NODES:
            with node_bench([1]) as bench:
                found[name].append(bench.start(name))
    return {name: float(np.median(seconds)) for name, seconds in found.items()}


def _head(load: float, seconds: float) -> dict:
    return {
        "benchmark": "node",
        "versions": {**versions("rclpy"), "rmw": os.environ["RMW_IMPLEMENTATION"]},
        "machine": {
            "processor": _processor(),
            "cpus": os.cpu_count(),
            "load_before": load,
            "load_after": os.getloadavg()[0],
        },
        "settings": {"input_type": "sensor_msgs/msg/PointCloud2", "seconds": seconds, "slice_seconds": SLICE_SECONDS},
    }


def _processor() -> str:
    with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _message_count(seconds: float, rate: float) -> int:
    return max(1, round(seconds * rate))


def _measure_cell(
    bench: NodeBench, persons: int, rate: float, seconds: float, tick: Callable[[float], Any]
) -> list[dict]:
    """Measure both nodes at one number of persons and one rate; return their rows."""
    for name in NODES:
        bench.measure(name, persons, rate, _WARM_UP)
    slices = max(1, round(seconds / SLICE_SECONDS))
    turns: dict[str, list[Turn]] = {name: [] for name in NODES}
    for _ in range(slices):
        for name in NODES:
            turns[name].append(bench.measure(name, persons, rate, _message_count(seconds / slices, rate)))
            tick(seconds / slices)
    return [row(name, persons, rate, turns[name], bench.rss_mb(name)) for name in NODES]


def row(node: str, persons: int, rate: float, turns: list[Turn], rss: float) -> dict:
    """Return one row of the report; latencies and CPU time are None if nothing was answered."""
    latency = np.concatenate([turn.latency_us for turn in turns])
    received = len(latency)
    median, p99 = np.percentile(latency, (50, 99)).tolist() if received else (None, None)
    return {
        "node": node,
        "persons": persons,
        "rate_hz": rate,
        "sent": sum(turn.sent for turn in turns),
        "received": received,
        "latency_median_us": median,
        "latency_p99_us": p99,
        "cpu_us_per_frame": _US * sum(turn.cpu_s for turn in turns) / received if received else None,
        "rss_mb": rss,
    }


def ratios(rows: list[dict]) -> list[dict]:
    """Compare the lifter with the echo node at each number of persons and each rate.

    Returns:
        Rows of persons, rate_hz, latency_median_ratio, latency_p99_ratio and cpu_added_us_per_frame.
    """
    found = []
    for lifter in (row for row in rows if row["node"] == "lifter"):
        echo = next(row for row in rows if row["node"] == "echo" and _same_cell(row, lifter))
        both = lifter["received"] and echo["received"]
        found.append(
            {
                "persons": lifter["persons"],
                "rate_hz": lifter["rate_hz"],
                **{
                    f"latency_{kind}_ratio": lifter[f"latency_{kind}_us"] / echo[f"latency_{kind}_us"] if both else None
                    for kind in ("median", "p99")
                },
                "cpu_added_us_per_frame": lifter["cpu_us_per_frame"] - echo["cpu_us_per_frame"] if both else None,
            }
        )
    return found


def _same_cell(one: dict, other: dict) -> bool:
    return all(one[key] == other[key] for key in ("persons", "rate_hz"))


def memory_growth(memory: list[tuple[float, float]]) -> dict[str, float | None]:
    """Return the largest memory, and the slope of a straight line through its second half.

    Args:
        memory: (seconds, MB), oldest first.
    """
    seconds, megabytes = np.array(memory).T
    later = seconds >= seconds[-1] / 2
    slope = np.polyfit(seconds[later], megabytes[later], 1)[0] if later.sum() > 1 else None
    return {
        "rss_mb_max": float(megabytes.max()),
        "growth_mb_per_hour": None if slope is None else 3600 * float(slope),
    }
