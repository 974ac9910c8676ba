# SPDX-License-Identifier: Apache-2.0
"""Studies of the error against one varied quantity: bottleneck, noise, share of hidden points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from paul_ros.offline.tables import Row, figure, render
from training.judge.experiments import Experiment, Outcome, chosen, groups, outcome_row, summary
from training.judge.nrsfm import bad_runs
from training.judge.pictures import COLOURS, legend_above, new_figure, percent_axis, titled
from training.judge.studies.study import Study
from training.judge.truth import Sequence

_FIGURES = ("mean", "deviation", "median", "best", "worst")


@dataclass(frozen=True)
class Sweep:
    """A varied quantity.

    Attributes:
        name: of the study.
        axis: name of the quantity in tables and pictures.
        values: values to try by default.
        vary: makes the experiment of a sequence, value, seed and overrides.
        reference: name of the value that ratios refer to.
        against_best: whether ratios refer to the best value; otherwise to value 0.
        percent: whether values are shares.
    """

    name: str
    axis: str
    values: tuple[float, ...]
    vary: Callable[[Sequence, float, int, tuple[str, ...]], Experiment]
    reference: str
    against_best: bool = False
    percent: bool = False

    def plan(
        self, sequences: list[Sequence], seeds: int, values: tuple[float, ...], settings: tuple[str, ...]
    ) -> list[Experiment]:
        """Plan every value of every sequence with every seed."""
        return [
            self.vary(sequence, value, seed, settings)
            for sequence in sequences
            for value in values
            for seed in range(seeds)
        ]

    def format(self, value: float) -> str:
        """Format a value."""
        return f"{100 * value:g} %" if self.percent else f"{value:g}"

    def report(self, outcomes: list[Outcome]) -> dict[str, Any]:
        """Report a row for each outcome, and a line of summary for each sequence and value."""
        series = groups(outcomes, lambda outcome: (outcome.experiment.sequence.name, outcome.experiment.value))
        picks = {id(chosen(some)) for some in series.values()}
        lines = [{"sequence": name, "value": value, **summary(some)} for (name, value), some in series.items()]
        for line in lines:
            line["ratio"] = self._ratio(line, [other for other in lines if other["sequence"] == line["sequence"]])
        return {
            "axis": self.axis,
            "rows": [
                {
                    "sequence": outcome.experiment.sequence.name,
                    "value": outcome.experiment.value,
                    **outcome_row(outcome, id(outcome) in picks),
                }
                for outcome in outcomes
            ],
            "summary": lines,
        }

    def _ratio(self, line: dict[str, Any], others: list[dict[str, Any]]) -> float | None:
        """Return the median error over that of the reference; None if there is no reference."""
        key = "median_ne_flip_global_percent"
        found = [other[key] for other in others if self.against_best or other["value"] == 0]
        return line[key] / min(found) if found and min(found) > 0 else None

    def table(self, report: dict[str, Any]) -> str:
        """Format a line for each sequence and value."""
        columns = [
            ("sequence", "text"),
            (self.axis, ""),
            *((name, ".2f") for name in _FIGURES),
            ("bad", ""),
            *((name, ".2f") for name in ("one flip", "ratio")),
            ("seconds", ".0f"),
        ]
        rows: list[Row] = []
        last = None
        for row in report["summary"]:
            name = row["sequence"] if row["sequence"] != last else ""
            last = row["sequence"]
            ratio = figure(row["ratio"], "ratio", f"no run is {self.reference}, or its median is 0")
            figures = (row[f"{key}_ne_flip_frame_percent"] for key in _FIGURES)
            more = (bad_runs(row), row["median_ne_flip_global_percent"], ratio, row["seconds_median"])
            rows.append((name, self.format(row["value"]), *figures, *more))
        return (
            f"normalised error in % over {report['summary'][0]['runs']} seeds, depth flip per frame\n"
            + render(columns, rows)
            + "\none flip: the median with one flip for all frames; bad: runs above three times that; "
            f"ratio: that median over that of {self.reference}"
        )

    def draw(self, outcomes: list[Outcome], report: dict[str, Any]) -> Any:
        """Draw a line a sequence, as the paper's figure 5: mean over runs, deviation as a band, runs as faint dots.

        The mean with one flip for all is dashed.  If it is higher, runs mix a shape with its mirror image.
        """
        figure = new_figure(7.5, 5)
        ax = figure.subplots()
        factor = 100 if self.percent else 1
        series = groups(report["summary"], lambda line: line["sequence"])
        for colour, (name, lines) in zip(COLOURS * len(series), series.items()):
            rows = [row for row in report["rows"] if row["sequence"] == name]
            at = [factor * row["value"] for row in rows]
            ax.scatter(at, [row["ne_flip_frame_percent"] for row in rows], s=9, color=colour, alpha=0.45, linewidths=0)
            _draw_line(ax, lines, factor, name, colour)
        ax.plot([], [], color="#444444", linestyle="--", linewidth=1.2, label="one flip for all, where it differs")
        ax.set_xticks(sorted({factor * line["value"] for line in report["summary"]}))
        ax.set_xlabel(f"{self.axis}{', %' if self.percent else ''}")
        percent_axis(ax, "normalised error, %")
        titled(ax, f"Flip per frame: mean and standard deviation over {report['summary'][0]['runs']} runs")
        legend_above(figure, ax)
        return figure

    def study(self) -> Study:
        """Return the study."""
        return Study(self.name, self.plan, self.report, self.table, self.draw, self.values)


def _draw_line(ax: Any, lines: list[dict[str, Any]], factor: float, name: str, colour: str) -> None:
    """Draw mean, deviation and mean with one flip of a sequence."""
    x = np.array([factor * line["value"] for line in lines])
    mean, deviation, best, one_flip = (
        np.array([line[f"{key}_percent"] for line in lines])
        for key in ("mean_ne_flip_frame", "deviation_ne_flip_frame", "best_ne_flip_frame", "mean_ne_flip_global")
    )
    low = np.maximum(mean - deviation, best)  # a logarithmic axis has no zero
    ax.fill_between(x, low, mean + deviation, color=colour, alpha=0.18, linewidth=0)
    ax.plot(x, one_flip, color=colour, linewidth=1.2, linestyle="--")
    ax.plot(x, mean, color=colour, linewidth=2, marker="o", markersize=4, label=name)


def _bottleneck(sequence: Sequence, K: float, seed: int, settings: tuple[str, ...]) -> Experiment:
    return Experiment(sequence, "paul", seed, (*settings, f"bottleneck={K:g}"), f"K = {K:g}", K)


def _noise(sequence: Sequence, share: float, seed: int, settings: tuple[str, ...]) -> Experiment:
    return Experiment(sequence.noisy(share, seed), "paul", seed, settings, f"noise {100 * share:g} %", share)


def _hidden(sequence: Sequence, share: float, seed: int, settings: tuple[str, ...]) -> Experiment:
    return Experiment(sequence.hiding(share, seed), "paul", seed, settings, f"hidden {100 * share:g} %", share)


STUDIES = tuple(
    sweep.study()
    for sweep in (
        Sweep("bottleneck", "bottleneck K", tuple(range(2, 13)), _bottleneck, "the best K", against_best=True),
        Sweep("noise", "noise, of rms coordinate", (0.0, 0.01, 0.02, 0.05, 0.1), _noise, "no noise", percent=True),
        Sweep("hidden", "hidden points", (0.0, 0.3, 0.6), _hidden, "all points seen", percent=True),
    )
)
