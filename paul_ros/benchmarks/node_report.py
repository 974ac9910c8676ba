# SPDX-License-Identifier: Apache-2.0
"""The report of `paul benchmark node` as a table of plain text, and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.offline.figures import new_figure, save_figure
from paul_ros.offline.tables import figure, render

_COLOURS = {"lifter": "#1f77d0", "echo": "#8a8a8a"}
_MIN_US = 100  # where the axes of the picture begin
_COLUMNS = (
    ("persons", "d", "persons"),
    ("Hz", "g", "rate_hz"),
    ("node", "text", "node"),
    ("sent", "d", "sent"),
    ("received", "d", "received"),
    ("median", ".0f", "latency_median_us"),
    ("99 %", ".0f", "latency_p99_us"),
    ("CPU", ".0f", "cpu_us_per_frame"),
    ("MB", ".1f", "rss_mb"),
    ("x echo", ".2f", "latency_median_ratio"),
    ("99 %", ".2f", "latency_p99_ratio"),
    ("+ CPU", ".0f", "cpu_added_us_per_frame"),
)
"""Heading, kind and key."""


def table(report: dict) -> str:
    """Return a report as text: a line for each node, number of persons and rate; times in µs."""
    ratios = {(ratio["persons"], ratio["rate_hz"]): ratio for ratio in report["ratios"]}
    rows = []
    for row in report["rows"]:
        ratio = ratios.get((row["persons"], row["rate_hz"])) if row["node"] == "lifter" else None
        shown = {**row, **(ratio or {})}
        name = f"{row['persons']} persons at {row['rate_hz']:g} Hz"
        rows.append([figure(shown[key], name, "a node answered no message") for *_, key in _COLUMNS if key in shown])
    starts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in report["start_to_first_output_s"].items())
    machine = report["machine"]
    lines = [
        render([column[:2] for column in _COLUMNS], rows),
        "",
        f"  start to first output: {starts}",
        f"  {machine['processor']}, {machine['cpus']} processors, load {machine['load_before']:.1f} before and "
        f"{machine['load_after']:.1f} after",
    ]
    return "\n".join(lines + (_soak_lines(report["soak"]) if "soak" in report else []))


def _soak_lines(soak: dict) -> list[str]:
    """Return the memory at about twenty times, and its growth."""
    every = max(1, len(soak["memory"]) // 20)
    growth = soak["growth_mb_per_hour"]
    verdict = "too short to tell" if growth is None else f"{growth:+.2f} MB an hour in the second half"
    rows = [(at["s"] / 60, at["rss_mb"]) for at in soak["memory"][::every]]
    return ["", render((("minutes", ".1f"), ("MB", ".2f")), rows), f"  at most {soak['rss_mb_max']:.2f} MB, {verdict}"]


# --- the picture


def write_picture(path: str | Path, report: dict) -> None:
    """Draw bars of latency and CPU time for each number of persons and each rate, or the memory of a long run.

    Args:
        path: the suffix chooses the format (.png, .svg, .pdf).
        report: from `paul_ros.benchmarks.node`.

    Raises:
        MissingPackageError: matplotlib is not installed.
        PictureError: matplotlib cannot write this format.
    """
    figure = new_figure(12.5, 4.8, extra="benchmark")
    if "soak" in report:
        _draw_memory(figure.subplots(), report)
    else:
        latency, cpu = figure.subplots(1, 2)
        _draw_bars(latency, report["rows"], "latency_median_us", "latency_p99_us")
        latency.set_title("Latency: bar the median, tick the 99th percentile", loc="left", fontweight="bold")
        _draw_bars(cpu, report["rows"], "cpu_us_per_frame")
        cpu.set_title("CPU time of the node's process", loc="left", fontweight="bold")
        handles, names = latency.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=2, frameon=False)
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def _draw_bars(ax: Any, rows: list[dict], key: str, tick: str | None = None) -> None:
    """Draw a bar for each row in µs, the nodes side by side, on a log scale: ten persons cost ten times one."""
    cells = list(dict.fromkeys((row["persons"], row["rate_hz"]) for row in rows))
    for place, (name, colour) in enumerate(_COLOURS.items()):
        own = [row for row in rows if row["node"] == name and row[key] is not None]
        x = np.array([cells.index((row["persons"], row["rate_hz"])) for row in own]) + 0.42 * (place - 0.5)
        label = "lifter" if name == "lifter" else "echo: the same messages, no lifting"
        bars = ax.bar(x, [row[key] for row in own], 0.4, color=colour, label=label)
        ax.bar_label(bars, [_short(row[key]) for row in own], fontsize=8, label_type="center", color="white")
        if tick:
            ax.scatter(x, [row[tick] for row in own], marker="_", s=200, color=colour, zorder=3)
    ax.set_xticks(range(len(cells)), [f"{persons} at\n{rate:g} Hz" for persons, rate in cells], fontsize=9)
    ax.set(yscale="log", ylim=(_MIN_US, None), ylabel="µs per frame", xlabel="persons, rate")


def _short(value: float) -> str:
    """Return a number that fits into a bar."""
    return f"{value:.0f}" if value < 10_000 else f"{value / 1000:.0f}k"


def _draw_memory(ax: Any, report: dict) -> None:
    memory, row = report["soak"]["memory"], report["rows"][0]
    ax.plot([at["s"] / 60 for at in memory], [at["rss_mb"] for at in memory], color=_COLOURS["lifter"])
    ax.set(xlabel="minutes", ylabel="MB resident", ylim=(0, 1.2 * report["soak"]["rss_mb_max"]))
    ax.set_title(
        f"Memory of the lifter, {row['persons']} persons at {row['rate_hz']:g} Hz, {row['sent']} frames sent, "
        f"{row['received']} answered",
        loc="left",
        fontweight="bold",
    )
