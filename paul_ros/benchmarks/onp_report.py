# SPDX-License-Identifier: Apache-2.0
"""The report of `paul benchmark onp` as a table of plain text, and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.offline.figures import new_figure, save_figure
from paul_ros.offline.tables import Row, figure, render

_COLOURS = {"ours": "#111111", "lsq_svd": "#e4572e", "polar": "#f0a030", "majorise": "#1f77d0", "lm_search": "#2a9d50"}
_MIN_ANGLE = 1e-3  # degrees; smaller angles are drawn here
_COLUMNS = (
    ("method", "text", "method"),
    ("cases", "d", "cases"),
    ("cert. %", ".2f", "certified_percent"),
    ("wrong", "d", "certified_wrong"),
    ("missed", "d", "missed"),
    ("better", "d", "better_than_ours"),
    ("angle", ".3f", "angle_median_deg"),
    ("95 %", ".3f", "angle_p95_deg"),
    ("ratio", ".4f", "residual_ratio_median"),
    ("worst", ".4g", "residual_ratio_max"),
    ("µs", ".1f", "us_single"),
    ("x lsq", ".2f", "single_over_lsq"),
    ("µs batch", ".2f", "us_batch"),
    ("x lsq", ".2f", "batch_over_lsq"),
)
"""Heading, kind and key."""

_WHY_MISSING = {
    "certified_percent": ("cert. %", "only the method ours has a certificate"),
    "certified_wrong": ("wrong", "only the method ours has a certificate"),
    "better_than_ours": ("better", "it compares the other methods with ours"),
    "us_batch": ("µs batch", "lm_search is too slow for a batch"),
    "batch_over_lsq": ("µs batch", "lm_search is too slow for a batch"),
}


def table(report: dict) -> str:
    """Return a report as text: each scenario, the effect of noisy shapes, and a summary."""
    by_scenario: dict[str, dict[str, dict]] = {}
    for row in report["rows"]:
        by_scenario.setdefault(row["scenario"], {})[row["method"]] = row
    solved: list[Row] = []
    noisy_shapes = {}
    for title, rows in by_scenario.items():
        if rows["ours"]["ne_percent"] is None:
            solved += [(title,), *(_cells(row, rows["lsq_svd"]) for row in rows.values())]
        else:
            noisy_shapes[title] = rows
    parts = (
        render([column[:2] for column in _COLUMNS], solved),
        _shape_table(noisy_shapes),
        _summary(report["summary"]),
    )
    return "\n\n".join(parts)


def _cells(row: dict, lsq: dict) -> Row:
    share, single, batch = row["certified_share"], row["us_single"], row["us_batch"]
    shown = {
        **row,
        "method": f"  {row['method']}",
        "certified_percent": None if share is None else 100 * share,
        "single_over_lsq": single and single / lsq["us_single"],
        "batch_over_lsq": batch and batch / lsq["us_batch"],
    }
    return [figure(shown[key], *_WHY_MISSING.get(key, (key, ""))) for *_, key in _COLUMNS]


def _shape_table(scenarios: dict[str, dict[str, dict]]) -> str:
    columns = [
        ("normalised 3D error in %, human poses", "text"),
        *((name, ".2f") for name in (*_COLOURS, "cert. %")),
        ("wrong", "d"),
    ]
    rows: list[Row] = []
    for title, methods in scenarios.items():
        errors, ours = (row["ne_percent"] for row in methods.values()), methods["ours"]
        rows.append((title, *errors, 100 * ours["certified_share"], ours["certified_wrong"]))
    first = ", ".join(f"{methods['ours']['ne_percent_first']:.2f}" for methods in scenarios.values())
    count = max(methods["lm_search"]["cases"] for methods in scenarios.values())
    return f"{render(columns, rows)}\n  lm_search: mean of the first {count} cases; ours of the same cases: {first}"


def _summary(summary: dict) -> str:
    single, batch = (
        "{0:.2f} to {2:.2f} (median {1:.2f})".format(*summary[f"{key}_over_lsq"]) for key in ("us_single", "us_batch")
    )
    lines = [
        f"ours, over {summary['cases']} problems with noise up to 30 %:",
        f"  certified {100 * summary['certified_share']:.3f} %, in the worst scenario "
        f"{100 * summary['certified_share_least']:.2f} %",
        f"  certified and wrong {summary['certified_wrong']}; optimum missed {summary['missed']} times "
        f"(by the naive search {summary['naive_missed']} times)",
        f"  a rival better {summary['better_than_ours']} times; worst residual over the best known "
        f"{summary['residual_ratio_max']:.9f}",
        f"  time over lsq_svd's, by scenario: one pose {single}; batched {batch}",
    ]
    return "\n".join(lines)


# --- the picture


def write_picture(path: str | Path, report: dict) -> None:
    """Draw angles to the optimum, residuals against times, and 3D errors against hidden points.

    Args:
        path: the suffix chooses the format (.png, .svg, .pdf).
        report: from `paul_ros.benchmarks.onp`.

    Raises:
        MissingPackageError: matplotlib is not installed.
        PictureError: matplotlib cannot write this format.
    """
    figure = new_figure(15, 9, extra="benchmark")
    left, right = figure.subfigures(1, 2, width_ratios=[1.35, 1])
    above, below = right.subplots(2, 1)
    _draw_angles(left.subplots(), report["rows"])
    _draw_times(above, report["rows"])
    _draw_shape_errors(below, report["rows"])
    handles, names = above.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names), frameon=False, fontsize=11)
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def _rows_with(rows: list[dict], method: str, key: str) -> list[dict]:
    return [row for row in rows if row["method"] == method and row[key] is not None]


def _draw_angles(ax: Any, rows: list[dict]) -> None:
    """Draw a line for each method and scenario, from the median angle to its 95th percentile."""
    for place, (name, colour) in enumerate(_COLOURS.items()):
        own = _rows_with(rows, name, "us_single")
        y = np.arange(len(own)) + 0.15 * (place - 2)
        low, high = (np.maximum([row[key] for row in own], _MIN_ANGLE) for key in ("angle_median_deg", "angle_p95_deg"))
        ax.hlines(y, low, high, color=colour, linewidth=1.6)
        ax.scatter(low, y, color=colour, s=26, zorder=3)
        ax.scatter(high, y, color=colour, s=30, marker="|", zorder=3)
    titles = [row["scenario"] for row in _rows_with(rows, "ours", "us_single")]
    ax.set_yticks(range(len(titles)), titles, fontsize=9)
    ax.set(xscale="log", ylim=(len(titles) - 0.5, -0.5), xlim=(0.7 * _MIN_ANGLE, 200))
    ax.set_xlabel(
        f"degrees to the optimum: dot the median, tick the 95th percentile; smaller angles are drawn at {_MIN_ANGLE}"
    )
    ax.set_title("Angle to the optimum", loc="left", fontweight="bold")
    ax.hlines(np.arange(len(titles) - 1) + 0.5, 0.7 * _MIN_ANGLE, 200, color="#eeeeee", linewidth=0.8, zorder=0)


def _draw_times(ax: Any, rows: list[dict]) -> None:
    """Draw a dot for each scenario, time against median residual: filled for one pose alone, hollow in a batch."""
    for name, colour in _COLOURS.items():
        for key, face in (("us_single", colour), ("us_batch", "white")):
            own = _rows_with(rows, name, key)
            place = [row[key] for row in own], [row["residual_ratio_median"] for row in own]
            label = name if key == "us_single" else None
            ax.scatter(*place, s=26, edgecolors=colour, facecolors=face, linewidths=1.2, label=label, alpha=0.7)
    ax.set(
        xscale="log",
        xlabel="µs a pose: full dots alone, hollow dots in a batch",
        ylabel="residual over that of the optimum",
    )
    ax.set_title("Time against residual (a dot for each scenario, the median)", loc="left", fontweight="bold")
    ax.axhline(1, color="#dddddd", zorder=0)


def _draw_shape_errors(ax: Any, rows: list[dict]) -> None:
    """Draw bars of the methods that solved all cases, for each scenario."""
    titles = [row["scenario"] for row in _rows_with(rows, "ours", "ne_percent")]
    for place, name in enumerate(name for name in _COLOURS if name != "lm_search"):
        heights = [row["ne_percent"] for row in _rows_with(rows, name, "ne_percent")]
        ax.bar(np.arange(len(titles)) + 0.2 * (place - 1.5), heights, 0.18, color=_COLOURS[name])
    labels = [title.replace("20 % shape noise, ", "").replace(", ", ",\n") for title in titles]
    ax.set_xticks(range(len(titles)), labels, fontsize=9)
    ax.set_ylabel("normalised 3D error, %")
    ax.set_title("Human poses whose shape is known up to 20 % noise", loc="left", fontweight="bold")
