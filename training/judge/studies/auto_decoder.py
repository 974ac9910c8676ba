# SPDX-License-Identifier: Apache-2.0
"""PAUL against its decoder alone (ADL) and that with a low-rank term (the paper's figure 6), as bars."""

from __future__ import annotations

from typing import Any

import numpy as np

from training.judge import nrsfm as benchmark
from training.judge.experiments import Outcome, Run, groups
from training.judge.pictures import legend_above, method_look, new_figure, titled
from training.judge.studies.study import Study
from training.judge.truth import Sequence

METHODS = ("paul", "adl", "adl_low_rank")


def runs(sequences: list[Sequence], seeds: int, values: tuple[str, ...], settings: tuple[str, ...]) -> list[Run]:
    """Every method on every sequence."""
    return benchmark.plan(sequences, list(values), seeds, 0.0, list(settings))


def draw(outcomes: list[Outcome], report: dict) -> Any:
    """A bar a method at the median over runs, its figure at the foot; runs as dots."""
    names = list(dict.fromkeys(line["sequence"] for line in report["summary"]))
    methods = list(dict.fromkeys(line["method"] for line in report["summary"]))
    figure = new_figure(max(6.5, 1.5 + 1.6 * len(names)), 5)
    ax = figure.subplots()
    width = 0.8 / len(methods)
    series = groups(outcomes, lambda outcome: (outcome.run.sequence.name, outcome.run.method))
    for (name, method), some in series.items():
        x = names.index(name) - 0.4 + width * (methods.index(method) + 0.5)
        errors = np.array([outcome.ne_flip_frame_percent for outcome in some])
        label, colour = method_look(method)
        ax.bar(x, np.median(errors), 0.9 * width, color=colour, label=label)
        ax.scatter(np.full(len(errors), x), errors, s=14, color="black", alpha=0.5, linewidths=0, zorder=3)
        # At the foot, where no dot of a run can lie.
        place = dict(xytext=(0, -3), textcoords="offset points", annotation_clip=False)
        ax.annotate(f"{np.median(errors):.2f}", (x, 0), ha="center", va="top", fontsize=8, **place)
    ax.set_xticks(range(len(names)), names)
    ax.tick_params(axis="x", length=0, pad=16)
    ax.set(ylabel="normalised error, flip per frame, %", ylim=(0, None))
    titled(ax, "Median over runs, and every run")
    legend_above(figure, ax)
    return figure


STUDY = Study("auto_decoder", runs, benchmark.report, benchmark.table, draw, METHODS)
