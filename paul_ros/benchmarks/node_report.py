# SPDX-License-Identifier: Apache-2.0
"""The report of `paul benchmark node` as a table of plain text, and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.offline.figures import new_figure, save_figure
from paul_ros.offline.report import cell

_COLOURS = {"lifter": "#1f77d0", "echo": "#8a8a8a"}
_MIN_US = 100  # where the axes of the picture begin
_HEAD = (
    f"  {'persons':>7}{'Hz':>6}  {'node':<8}{'sent':>7}{'received':>9}{'median':>9}{'99 %':>9}{'CPU':>9}{'MB':>7}"
    f"{'x echo':>9}{'99 %':>7}{'+ CPU':>8}"
)


def table(report: dict) -> str:
    """Return a report as text: a line for each node, number of persons and rate; times in µs."""
    ratios = {(ratio["persons"], ratio["rate_hz"]): ratio for ratio in report["ratios"]}
    lines = [_HEAD]
    for row in report["rows"]:
        line = _line(row)
        if row["node"] == "lifter":
            line += _ratio_cells(ratios.get((row["persons"], row["rate_hz"])))
        lines.append(line)
    starts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in report["start_to_first_output_s"].items())
    machine = report["machine"]
    lines += [
        "",
        f"  start to first output: {starts}",
        f"  {machine['processor']}, {machine['cpus']} processors, load {machine['load_before']:.1f} before and "
        f"{machine['load_after']:.1f} after",
    ]
    return "\n".join(lines + (_soak_lines(report["soak"]) if "soak" in report else []))


def _line(row: dict) -> str:
    return (
        f"  {row['persons']:>7}{row['rate_hz']:>6g}  {row['node']:<8}{row['sent']:>7}{row['received']:>9}"
        f"{cell(row['latency_median_us'], 9, 0)}{cell(row['latency_p99_us'], 9, 0)}"
        f"{cell(row['cpu_us_per_frame'], 9, 0)}{row['rss_mb']:>7.1f}"
    )


def _ratio_cells(ratio: dict | None) -> str:
    if ratio is None:
        return ""
    return (
        f"{cell(ratio['latency_median_ratio'], 9, 2)}{cell(ratio['latency_p99_ratio'], 7, 2)}"
        f"{cell(ratio['cpu_added_us_per_frame'], 8, 0)}"
    )


def _soak_lines(soak: dict) -> list[str]:
    """Return the memory at about twenty times, and its growth."""
    every = max(1, len(soak["memory"]) // 20)
    growth = soak["growth_mb_per_hour"]
    verdict = "too short to tell" if growth is None else f"{growth:+.2f} MB an hour in the second half"
    return [
        "",
        "  minutes    MB",
        *(f"  {at['s'] / 60:>7.1f}{at['rss_mb']:>8.2f}" for at in soak["memory"][::every]),
        f"  at most {soak['rss_mb_max']:.2f} MB, {verdict}",
    ]


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
    ax.set(yscale="log", ylim=(_MIN_US, None), ylabel="µs a frame", xlabel="persons, rate")


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
