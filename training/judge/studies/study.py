# SPDX-License-Identifier: Apache-2.0
"""A study: a list of runs and two ways to look at what they gave.

Training, resuming and judging are ``training.judge.experiments``, the same as for the benchmark.
``interpolation`` looks into a finished model and is no such study.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from paul_ros.files import write_json
from paul_ros.versions import versions
from training.errors import DataError
from training.judge.experiments import Keeping, Outcome, Run, perform
from training.judge.pictures import save_figure
from training.judge.truth import Sequence, load_sequence


@dataclass(frozen=True)
class Study:
    """A question.

    Attributes:
        name: of the command, and of its files.
        runs: all runs for some sequences, number of seeds, values to try and overrides of recipes.
        report: rows and summary of what they gave, for JSON.
        table: a report for people.
        draw: a figure of outcomes and report.
        values: tried where no others are asked for.
    """

    name: str
    runs: Callable[[list[Sequence], int, tuple, tuple[str, ...]], list[Run]]
    report: Callable[[list[Outcome]], dict]
    table: Callable[[dict], str]
    draw: Callable[[list[Outcome], dict], Any]
    values: tuple = ()


def studies() -> dict[str, Study]:
    """All that train, by name."""
    from training.judge.studies import auto_decoder, latent, sweeps

    found = (*sweeps.STUDIES, auto_decoder.STUDY, latent.STUDY)
    return {study.name: study for study in found}


def run(
    study: Study, files: list[Path], folder: Path, seeds: int, values: tuple, settings: list[str], keeping: Keeping
) -> str:
    """Do a study; writes NAME.json and NAME.png into the folder and returns the table.

    Raises:
        DataError: a file without truth; and see ``training.judge.experiments.perform``.
    """
    sequences = [load_sequence(file) for file in files]
    names = [sequence.name for sequence in sequences]
    if len(set(names)) < len(names):
        raise DataError(f"two of the files have one name ({', '.join(names)}): rename one")
    outcomes = perform(study.runs(sequences, seeds, values or study.values, tuple(settings)), keeping)
    report = {"study": study.name, **study.report(outcomes), "settings": settings, "versions": versions()}
    write_json(folder / f"{study.name}.json", report)
    save_figure(study.draw(outcomes, report), folder / f"{study.name}.png")
    return study.table(report)
