# SPDX-License-Identifier: Apache-2.0
"""The class of studies that train, and the work that all of them share.

Training, resuming and judging are those of the benchmark: ``training.judge.experiments``.  ``interpolation`` uses a
finished model and is no such study.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from paul_ros.files import write_json
from paul_ros.versions import versions
from training.errors import DataError, RecipeError
from training.judge.experiments import Experiment, Outcome, SeriesOptions, perform
from training.judge.pictures import save_figure
from training.judge.truth import Sequence, load_sequence


@dataclass(frozen=True)
class Study:
    """A question about the method.

    Attributes:
        name: of the command and of its files.
        plan: makes all experiments from sequences, number of seeds, values to try and overrides of recipes.
        report: makes rows and summary of the outcomes, for JSON.
        table: formats a report.
        draw: makes a figure of outcomes and report.
        values: values to try by default.
        needs_codes: whether the study uses codes, which only trained networks give.
    """

    name: str
    plan: Callable[[list[Sequence], int, tuple[Any, ...], tuple[str, ...]], list[Experiment]]
    report: Callable[[list[Outcome]], dict[str, Any]]
    table: Callable[[dict[str, Any]], str]
    draw: Callable[[list[Outcome], dict[str, Any]], Any]
    values: tuple[Any, ...] = ()
    needs_codes: bool = False


def run(
    study: Study,
    files: list[Path],
    folder: Path,
    seeds: int,
    values: tuple[Any, ...],
    settings: list[str],
    options: SeriesOptions,
) -> str:
    """Do a study, and write NAME.json and NAME.png into a folder.

    Args:
        study: the question.
        files: npz files with W and the truth S.
        folder: of table and picture.
        seeds: number of seeds.
        values: values to try; empty takes the study's own.
        settings: overrides of recipes, as for ``--set``.
        options: of the experiments.

    Returns:
        The table.

    Raises:
        DataError: a file has no truth, or two files have one name.
        RecipeError: a setting is wrong, or the study needs codes and no networks would be trained.
        TrainingError: an experiment failed.
    """
    sequences = [load_sequence(file) for file in files]
    names = [sequence.name for sequence in sequences]
    if len(set(names)) < len(names):
        raise DataError(f"two of the files have one name ({', '.join(names)}): rename one")
    experiments = study.plan(sequences, seeds, values or study.values, tuple(settings))
    if study.needs_codes:
        _check_codes(study.name, experiments)
    outcomes = perform(experiments, options)
    report = {"study": study.name, **study.report(outcomes), "settings": settings, "versions": versions()}
    write_json(folder / f"{study.name}.json", report)
    save_figure(study.draw(outcomes, report), folder / f"{study.name}.png")
    return study.table(report)


def _check_codes(name: str, experiments: list[Experiment]) -> None:
    """Raise RecipeError if an experiment trains no networks, and so gives no codes."""
    for experiment in experiments:
        if not experiment.recipe().steps:
            raise RecipeError(
                f"study {name} needs the codes of trained networks, and method {experiment.method} trains none with "
                "steps: 0: set steps to at least 1"
            )
