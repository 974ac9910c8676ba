# SPDX-License-Identifier: Apache-2.0
"""Latent spaces of two dimensions, coloured by frame number (the paper's figure 4): a good one keeps neighbours close.

The order of the frames is used to look at the codes, never to find them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from training.judge.experiments import Outcome, Run, chosen, groups, summary
from training.judge.pictures import method_look, middle_and_half, new_figure
from training.judge.studies.study import Study
from training.judge.truth import Sequence

METHODS = ("paul", "adl")
_SMOOTH, _RANDOM = "own cameras", "random cameras"
_PAIRS = 20_000


def runs(sequences: list[Sequence], seeds: int, values: tuple[str, ...], settings: tuple[str, ...]) -> list[Run]:
    """Every method on every sequence as it is and, where its whole truth is known, from random cameras."""
    series = []
    for sequence in sequences:
        series.append((sequence, _SMOOTH))
        if sequence.present.all():
            turned = sequence.from_random_cameras(seed=0)
            series.append((replace(turned, name=sequence.name), _RANDOM))
    return [
        Run(sequence, method, seed, (*settings, "bottleneck=2"), cameras, cameras)
        for sequence, cameras in series
        for method in values
        for seed in range(seeds)
    ]


def roughness(codes: np.ndarray) -> float:
    """Mean distance of the codes (F,K) of successive frames, over that of random pairs: 1 is no order, 0 a thread."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(codes), size=(2, _PAIRS))
    apart = np.linalg.norm(codes[first] - codes[second], axis=1)[first != second].mean()
    return float(np.linalg.norm(np.diff(codes, axis=0), axis=1).mean() / max(apart, np.finfo(float).tiny))


def _series(outcomes: list[Outcome]) -> dict[tuple, list[Outcome]]:
    return groups(outcomes, lambda outcome: (outcome.run.sequence.name, outcome.run.value, outcome.run.method))


def report(outcomes: list[Outcome]) -> dict:
    """A line for each sequence, kind of cameras and method; roughness is that of the run chosen without truth."""
    return {
        "summary": [
            {
                "sequence": name,
                "cameras": cameras,
                "method": method,
                "roughness": roughness(chosen(some).codes),
                **summary(some),
            }
            for (name, cameras, method), some in _series(outcomes).items()
        ]
    }


def table(report: dict) -> str:
    """A line each."""
    lines = [
        f"{row['sequence']:<12}{row['cameras']:<16}{row['method']:<8}{row['roughness']:>10.3f}"
        f"{row['chosen_ne_flip_frame_percent']:>9.2f} /{row['chosen_ne_flip_global_percent']:>7.2f}"
        for row in report["summary"]
    ]
    return "\n".join(
        [
            f"{'sequence':<12}{'cameras':<16}{'method':<8}{'roughness':>10}{'NE %':>18}",
            *lines,
            "roughness: mean distance of successive frames' codes over that of random pairs, 1 where order shows "
            "nothing;\nNE with the depth flipped per frame / once for all; both of the run with the lowest loss, K = 2",
        ]
    )


def draw(outcomes: list[Outcome], report: dict) -> Any:
    """A panel for each sequence, kind of cameras and method; dark blue the first frame, bright yellow the last."""
    series = _series(outcomes)
    columns = list(dict.fromkeys((name, cameras) for name, cameras, _ in series))
    methods = list(dict.fromkeys(method for _, _, method in series))
    figure = new_figure(3.1 * len(columns) + 0.9, 3.1 * len(methods) + 0.5)
    axes = figure.subplots(len(methods), len(columns), squeeze=False)
    for (name, cameras, method), some in series.items():
        ax = axes[methods.index(method), columns.index((name, cameras))]
        codes = chosen(some).codes
        shown = ax.scatter(*codes.T, c=np.arange(len(codes)), cmap="plasma", s=9, linewidths=0)
        (x, y), half = middle_and_half(codes)
        ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half), xticks=[], yticks=[], aspect="equal")
        head = f"{name}, {cameras}\n" if ax in axes[0] else ""
        ax.set_title(f"{head}roughness {roughness(codes):.2f}", fontsize=10)
        if ax in axes[:, 0]:
            ax.set_ylabel(method_look(method)[0], fontsize=12, fontweight="bold")
    bar = figure.colorbar(shown, ax=axes, shrink=0.6, pad=0.01, ticks=[0, len(codes) - 1])
    bar.ax.set_yticklabels(["first\nframe", "last\nframe"])
    return figure


STUDY = Study("latent", runs, report, table, draw, METHODS)
