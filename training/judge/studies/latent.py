# SPDX-License-Identifier: Apache-2.0
"""Study of two-dimensional latent spaces, coloured by frame number: the paper's figure 4.

Codes of successive frames are close in a good latent space.  The order of the frames is used for the picture and for
roughness only, never by the trainer.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from paul_ros.offline.tables import render
from training.judge.experiments import Experiment, Outcome, chosen, groups, summary
from training.judge.pictures import bounding_square, method_style, new_figure
from training.judge.studies.study import Study
from training.judge.truth import Sequence

METHODS = ("paul", "adl")
_SMOOTH, _RANDOM = "own cameras", "random cameras"
_PAIRS = 20_000


def plan(sequences: list[Sequence], seeds: int, values: tuple[str, ...], settings: tuple[str, ...]) -> list[Experiment]:
    """Plan every method on every sequence, and on its random-camera twin if the whole truth is known."""
    series = []
    for sequence in sequences:
        series.append((sequence, _SMOOTH))
        if sequence.present.all():
            turned = sequence.from_random_cameras(seed=0)
            series.append((replace(turned, name=sequence.name), _RANDOM))
    return [
        Experiment(sequence, method, seed, (*settings, "bottleneck=2"), cameras, cameras)
        for sequence, cameras in series
        for method in values
        for seed in range(seeds)
    ]


def roughness(codes: np.ndarray) -> float:
    """Return the mean distance of successive frames' codes (F,K), over that of random pairs.

    A smooth curve has roughness 0, codes without order have 1.
    """
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(codes), size=(2, _PAIRS))
    apart = np.linalg.norm(codes[first] - codes[second], axis=1)[first != second].mean()
    return float(np.linalg.norm(np.diff(codes, axis=0), axis=1).mean() / max(apart, np.finfo(float).tiny))


def _chosen_codes(outcomes: list[Outcome]) -> np.ndarray:
    """Return the codes (F,K) of the outcome that is chosen without truth."""
    codes = chosen(outcomes).codes
    assert codes is not None  # Study.needs_codes
    return codes


def _series(outcomes: list[Outcome]) -> dict[Any, list[Outcome]]:
    """Group outcomes by sequence, kind of cameras and method."""

    def key(outcome: Outcome) -> tuple[str, float | str, str]:
        experiment = outcome.experiment
        return experiment.sequence.name, experiment.value, experiment.method

    return groups(outcomes, key)


def report(outcomes: list[Outcome]) -> dict[str, Any]:
    """Report a line for each sequence, kind of cameras and method, with the roughness of the chosen seed."""
    return {
        "summary": [
            {
                "sequence": name,
                "cameras": cameras,
                "method": method,
                "roughness": roughness(_chosen_codes(some)),
                **summary(some),
            }
            for (name, cameras, method), some in _series(outcomes).items()
        ]
    }


def table(report: dict[str, Any]) -> str:
    """Format a report."""
    rows = [
        (
            row["sequence"],
            row["cameras"],
            row["method"],
            row["roughness"],
            f"{row['chosen_ne_flip_frame_percent']:.2f} / {row['chosen_ne_flip_global_percent']:.2f}",
        )
        for row in report["summary"]
    ]
    texts = ((name, "text") for name in ("sequence", "cameras", "method"))
    columns = [*texts, ("roughness", ".3f"), ("NE %", "")]
    return (
        render(columns, rows) + "\n"
        "roughness: mean distance of successive frames' codes over that of random pairs; 1 means no order\n"
        "NE: depth flipped per frame / once for all; both figures are of the run with the lowest loss, K = 2"
    )


def draw(outcomes: list[Outcome], report: dict[str, Any]) -> Any:
    """Draw a panel for each sequence, kind of cameras and method, from the first frame (blue) to the last (yellow)."""
    series = _series(outcomes)
    columns = list(dict.fromkeys((name, cameras) for name, cameras, _ in series))
    methods = list(dict.fromkeys(method for _, _, method in series))
    figure = new_figure(3.1 * len(columns) + 0.9, 3.1 * len(methods) + 0.5)
    axes = figure.subplots(len(methods), len(columns), squeeze=False)
    for (name, cameras, method), some in series.items():
        ax = axes[methods.index(method), columns.index((name, cameras))]
        codes = _chosen_codes(some)
        shown = ax.scatter(*codes.T, c=np.arange(len(codes)), cmap="plasma", s=9, linewidths=0)
        (x, y), half = bounding_square(codes)
        ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half), xticks=[], yticks=[], aspect="equal")
        head = f"{name}, {cameras}\n" if ax in axes[0] else ""
        ax.set_title(f"{head}roughness {roughness(codes):.2f}", fontsize=10)
        if ax in axes[:, 0]:
            ax.set_ylabel(method_style(method)[0], fontsize=12, fontweight="bold")
    bar = figure.colorbar(shown, ax=axes, shrink=0.6, pad=0.01, ticks=[0, len(codes) - 1])
    bar.ax.set_yticklabels(["first\nframe", "last\nframe"])
    return figure


STUDY = Study("latent", plan, report, table, draw, METHODS, needs_codes=True)
