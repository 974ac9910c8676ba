# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark nrsfm`: the paper's table of normalised errors, measured and published."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.offline.tables import Row, figure, render
from paul_ros.versions import versions
from training.errors import DataError
from training.judge.experiments import (
    BAD_BASIN,
    Experiment,
    Outcome,
    SeriesOptions,
    chosen,
    groups,
    outcome_row,
    perform,
    summary,
)
from training.judge.pictures import legend_above, method_style, new_figure, percent_axis, save_figure, titled
from training.judge.published import REMARK, SOURCE, published
from training.judge.truth import Sequence, load_sequence

METHODS = ("paul", "adl", "adl_low_rank", "linear", "rigid")

_RIVAL_MARKERS = {"CNS": "s", "PND": "^", "BMM": "v", "BMM-v2": "D", "Deep NRSfM": "*"}

_START_METHODS = ("linear", "rigid")
"""Methods that are a start alone."""

_TRAINING_SETTINGS = ("start", "regression_steps", "steps")
"""Settings that start methods ignore, because these would turn them into other methods."""


def find_sequences(folder: Path, names: list[str] | None = None) -> list[Sequence]:
    """Read the sequences of a folder: npz files with W and S, all or the named ones.

    Without names, files that cannot be used are named on stderr and skipped.

    Raises:
        DataError: the folder or a named sequence is missing or cannot be used, or there is no sequence.
    """
    files = {path.stem: path for path in sorted(folder.glob("*.npz"))}
    if not files:
        raise DataError(f"no npz files in '{folder}': name a folder of sequences with W and S")
    missing = [name for name in names or () if name not in files]
    if missing:
        raise DataError(f"no sequence {', '.join(missing)} in '{folder}'; it holds {', '.join(files)}")
    if names:
        return [load_sequence(files[name]) for name in names]
    found = []
    for path in files.values():
        try:
            found.append(load_sequence(path))
        except DataError as error:
            print(f"skipped: {error}", file=sys.stderr)
    if not found:
        raise DataError(f"no npz file in '{folder}' has both W and the truth S")
    return found


def plan(
    sequences: list[Sequence], methods: list[str], seeds: int, hide: float, settings: list[str]
) -> list[Experiment]:
    """Plan all experiments, sequence by sequence; each seed hides other points."""
    return [
        Experiment(sequence.hiding(hide, seed) if hide else sequence, method, seed, _fitting(method, settings))
        for sequence in sequences
        for method in methods
        for seed in range(seeds)
    ]


def _fitting(method: str, settings: list[str]) -> tuple[str, ...]:
    """Return the overrides that apply to a method."""
    refused = _TRAINING_SETTINGS if method in _START_METHODS else ()
    return tuple(setting for setting in settings if setting.partition("=")[0].strip() not in refused)


def _print_ignored(methods: list[str], settings: list[str]) -> None:
    """Name the overrides that methods ignore, on stderr."""
    for method in methods:
        fitting = _fitting(method, settings)
        if ignored := [setting for setting in settings if setting not in fitting]:
            print(f"{method}: {', '.join(ignored)} ignored, because the method is the start alone", file=sys.stderr)


def run(
    folder: Path,
    *,
    sequences: list[str] | None,
    methods: list[str],
    seeds: int,
    hide: float,
    settings: list[str],
    options: SeriesOptions,
) -> dict[str, Any]:
    """Train the experiments that are not kept yet, and judge all.

    Args:
        folder: of npz files.
        sequences: names of files to use; None uses all.
        methods: names or recipes.
        seeds: number of seeds.
        hide: share of every frame's points to hide.
        settings: overrides of recipes, as for ``--set``.
        options: of the experiments.

    Returns:
        The report of `--json`.

    Raises:
        DataError: a sequence is missing or cannot be used.
        RecipeError: a recipe or a setting is wrong.
        TrainingError: an experiment failed.
    """
    found = find_sequences(folder, sequences)
    _print_ignored(methods, settings)
    outcomes = perform(plan(found, methods, seeds, hide, settings), options)
    return report(outcomes) | {"hidden_share": hide, "settings": settings, "versions": versions()}


def report(outcomes: list[Outcome]) -> dict[str, Any]:
    """Return rows of all outcomes, their summary, and the published figures."""
    series = groups(outcomes, lambda outcome: (outcome.experiment.sequence.name, outcome.experiment.method))
    picks = {id(chosen(some)) for some in series.values()}
    names = dict.fromkeys(outcome.experiment.sequence.name for outcome in outcomes)
    return {
        "rows": [_row(outcome, id(outcome) in picks) for outcome in outcomes],
        "summary": [{"sequence": key[0], "method": key[1], **summary(some)} for key, some in series.items()],
        "published_ne_percent": {name: published(name) for name in names},
        "published_source": SOURCE,
    }


def _row(outcome: Outcome, is_chosen: bool) -> dict[str, Any]:
    experiment = outcome.experiment
    return {
        "sequence": experiment.sequence.name,
        "method": experiment.method,
        **outcome_row(outcome, is_chosen),
    }


_RUNS = ("chosen", "median", "best", "worst")


def table(report: dict[str, Any]) -> str:
    """Format the measured errors, and below them the published ones, sequence by sequence."""
    hidden = f", {report['hidden_share']:.0%} of the points hidden" if report.get("hidden_share") else ""
    columns = [
        *((name, "text") for name in ("sequence", "method")),
        *((name, "") for name in (*_RUNS, "bad")),
        ("seconds", ".0f"),
    ]
    rows: list[Row] = []
    last = None
    for row in report["summary"]:
        name = row["sequence"]
        rows += [()] if last not in (None, name) else []
        rows.append((name if name != last else "", Path(row["method"]).stem, *_cells(row)))
        last = name
    parts = [
        f"normalised error in %, depth flip per frame / one flip for all{hidden}\n" + render(columns, rows),
        *_published_parts(report["published_ne_percent"]),
        "chosen: the seed with the lowest loss, a choice without truth; bad: runs whose NE with one flip is above "
        f"{BAD_BASIN:g} times the median\n"
        f"published: {report['published_source']}; {REMARK}",
    ]
    return "\n\n".join(parts)


def _cells(row: dict[str, Any]) -> Row:
    """Return the cells of the errors of one line."""
    pairs = [
        f"{row[f'{name}_ne_flip_frame_percent']:.2f} / {row[f'{name}_ne_flip_global_percent']:.2f}" for name in _RUNS
    ]
    return [*pairs, bad_runs(row), row["seconds_median"]]


def bad_runs(row: dict[str, Any]) -> str:
    """Return the number of runs in a bad basin, of all runs, as in "1/10"."""
    return f"{round(row['bad_basin_share'] * row['runs'])}/{row['runs']}"


def _published_parts(figures: dict[str, dict[str, float]]) -> list[str]:
    """Return the table of the published figures; none if no sequence has any."""
    methods = list(dict.fromkeys(method for known in figures.values() for method in known))
    why = "no figure is published"
    rows = [
        (name, *(figure(known.get(method), f"{method} of {name}", why) for method in methods))
        for name, known in figures.items()
        if known
    ]
    columns = [("sequence", "text"), *((method, ".2f") for method in methods)]
    return [f"published\n{render(columns, rows)}"] if rows else []


def write_picture(path: Path, report: dict[str, Any]) -> None:
    """Draw every run as a dot, the chosen one filled, with a bar at the median.

    Black lines are the published figures of PAUL, grey marks those of other methods.

    Raises:
        MissingPackageError: matplotlib is not installed.
        PictureError: matplotlib cannot write the format of the suffix.
    """
    names = list(report["published_ne_percent"])
    methods = list(dict.fromkeys(row["method"] for row in report["rows"]))
    figure = new_figure(max(7.0, 2.0 + 1.0 * len(names) + 0.25 * len(names) * len(methods)), 5.5)
    ax = figure.subplots()
    step = 0.76 / len(methods)
    for place, method in enumerate(methods):
        for middle, name in enumerate(names):
            rows = [row for row in report["rows"] if (row["sequence"], row["method"]) == (name, method)]
            x = middle - 0.38 + step * (place + 0.5)
            _draw_runs(ax, x, 0.36 * step, rows, method)
    for middle, figures in enumerate(report["published_ne_percent"].values()):
        _draw_published(ax, middle, figures)
    ax.set_xticks(range(len(names)), names)
    ax.set_xlim(-0.55, len(names) - 0.4)
    percent_axis(ax, "normalised error, flip per frame, %")
    titled(ax, "Every run; filled: chosen without truth, bar: median;\nblack line and grey marks: published")
    legend_above(figure, ax)
    save_figure(figure, path)


def _draw_runs(ax: Any, x: float, half: float, rows: list[dict[str, Any]], method: str) -> None:
    """Draw the runs of one method on one sequence."""
    name, colour = method_style(method)
    errors = np.array([row["ne_flip_frame_percent"] for row in rows])
    face = [colour if row["chosen"] else "white" for row in rows]
    ax.hlines(np.median(errors), x - half, x + half, color=colour, linewidth=2.5, label=name)
    spread = np.linspace(-0.6, 0.6, len(rows)) * half if len(rows) > 1 else np.zeros(1)
    ax.scatter(x + spread, errors, s=30, facecolors=face, edgecolors=colour, linewidths=1.3, zorder=3)


def _draw_published(ax: Any, middle: int, figures: dict[str, float]) -> None:
    """Draw the published figures of one sequence."""
    for name, value in figures.items():
        if name == "PAUL":
            span = middle - 0.42, middle + 0.42
            ax.hlines(value, *span, color="black", linewidth=1, label="PAUL, published", zorder=1)
        else:
            mark: dict[str, Any] = dict(
                marker=_RIVAL_MARKERS[name], s=22, facecolors="none", edgecolors="#707070", linewidths=1
            )
            ax.scatter(middle + 0.44, value, label=name, **mark)
