# SPDX-License-Identifier: Apache-2.0
"""Study of PAUL against its decoder alone (ADL), with and without a low-rank term: the paper's figure 6, as bars."""

from __future__ import annotations

from typing import Any

import numpy as np

from training.judge import nrsfm
from training.judge.experiments import Experiment, Outcome, groups
from training.judge.pictures import legend_above, method_style, new_figure, titled
from training.judge.studies.study import Study
from training.judge.truth import Sequence

METHODS = ("paul", "adl", "adl_low_rank")


def plan(sequences: list[Sequence], seeds: int, values: tuple[str, ...], settings: tuple[str, ...]) -> list[Experiment]:
    """Plan every method on every sequence."""
    return nrsfm.plan(sequences, list(values), seeds, 0.0, list(settings))


def draw(outcomes: list[Outcome], report: dict[str, Any]) -> Any:
    """Draw a bar a method, as high as the median over seeds, with the figure at its foot and seeds as dots."""
    names = list(dict.fromkeys(line["sequence"] for line in report["summary"]))
    methods = list(dict.fromkeys(line["method"] for line in report["summary"]))
    figure = new_figure(max(6.5, 1.5 + 1.6 * len(names)), 5)
    ax = figure.subplots()
    width = 0.8 / len(methods)
    series = groups(outcomes, lambda outcome: (outcome.experiment.sequence.name, outcome.experiment.method))
    for (name, method), some in series.items():
        x = names.index(name) - 0.4 + width * (methods.index(method) + 0.5)
        errors = np.array([outcome.ne_flip_frame_percent for outcome in some])
        label, colour = method_style(method)
        ax.bar(x, np.median(errors), 0.9 * width, color=colour, label=label)
        ax.scatter(np.full(len(errors), x), errors, s=14, color="black", alpha=0.5, linewidths=0, zorder=3)
        # No dot can lie at the foot.
        place: dict[str, Any] = dict(xytext=(0, -3), textcoords="offset points", annotation_clip=False)
        ax.annotate(f"{np.median(errors):.2f}", (x, 0), ha="center", va="top", fontsize=8, **place)
    ax.set_xticks(range(len(names)), names)
    ax.tick_params(axis="x", length=0, pad=16)
    ax.set(ylabel="normalised error, flip per frame, %", ylim=(0, None))
    titled(ax, "Median over runs, and every run")
    legend_above(figure, ax)
    return figure


STUDY = Study("auto_decoder", plan, nrsfm.report, nrsfm.table, draw, METHODS)
