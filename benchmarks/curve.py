#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Error over training time of two runs: one starts from 2D alone, the other from the true 3D.

    python benchmarks/curve.py S5_train.npz --unseen S5_test.npz [--recipe lifting] [--seed 0] -o out/curve_S5

Both runs have the same recipe and length.  If the run from the true 3D is better, the search for a start is the limit.
If it is not, the limit is capacity, time or the objective.

DATA and the unseen file hold W (F,2,P) and the truth S (F,3,P).  Only the evaluation and the second run's start use S.
The folder receives curve.json and curve.png.  The same command continues an interrupted measurement.

Errors are NE in % with visible points at their observed x and y (S_cam); for unseen frames also as predicted.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from paul_ros.errors import PaulError
from paul_ros.files import write_atomically
from paul_ros.metrics import normalised_error_of_signs
from training.judge.pictures import COLOURS, legend_above, new_figure, save_figure, titled
from training.judge.truth import Sequence, load_sequence
from training.loading import load_training_data
from training.objective import fit
from training.recipe import Recipe
from training.start.kept_start import kept_start, start_identity
from training.start.start import Start
from training.start.synchronise import aligned
from training.trainer import Trainer
from training.views import NormalisedViews

JUDGED = 3000  # frames, evenly chosen
STARTS = {"2D": "from 2D alone", "truth": "from the true 3D"}
Row = dict[str, Any]
"""Step, seconds, and the errors of training and of unseen frames."""


def true_start(S: np.ndarray, unit: float) -> Start:
    """Return the start that a perfect search would find.

    Args:
        S: (F,3,P) truth in the camera frame, image units.
        unit: image units per unit of the networks.
    """
    shapes, turn = aligned(torch.from_numpy(S - S.mean(2, keepdims=True)).double() / unit)
    return Start(np.arange(len(S)), shapes.float().numpy(), turn.mT.float().numpy(), 0.0, 0.0)


@torch.no_grad()
def errors(trainer: Trainer, truth: Sequence) -> dict[str, float]:
    """Return the NE in % of evenly chosen frames, each lifted alone."""
    rows = np.linspace(0, len(truth.W) - 1, min(JUDGED, len(truth.W))).astype(int)
    W, visible = torch.from_numpy(truth.W[rows]).float(), torch.from_numpy(truth.visible[rows])
    unit = trainer.data.image_unit if trainer.recipe.scale == "unit" else None
    views = NormalisedViews.of(W, visible, torch.ones(len(rows), 1, 1), False, unit)
    found = fit(trainer.networks, trainer.recipe, views, torch.from_numpy(rows))
    shapes = {"observed": found.points, "predicted": found.streams[-1]}
    signs = {
        name: normalised_error_of_signs(*((views.size * S).double().mT.numpy(), truth.S[rows].transpose(0, 2, 1)))
        for name, S in shapes.items()
    }
    return {
        f"{name}_{flip}": 100 * float(value)
        for name, both in signs.items()
        for flip, value in (("flip_frame", both.min(1).mean()), ("flip_global", both.mean(0).min()))
    }


def curve(data_file: Path, unseen_file: Path, recipe: Recipe, kind: str, every: int, folder: Path) -> list[Row]:
    """Train and judge in turns.

    Args:
        data_file: frames to train on, with their truth.
        unseen_file: other frames with their truth.
        recipe: of the training.
        kind: start, a key of ``STARTS``.
        every: steps between evaluations.
        folder: that keeps the run.

    Returns:
        A row each time.
    """
    data, kept = load_training_data(data_file), folder / "rows.json"
    train, unseen = load_sequence(data_file), load_sequence(unseen_file)
    if kind == "truth":
        start = true_start(train.S, data.image_unit)
        kept_start(folder, start_identity(data, recipe), lambda: start, torch.device("cpu"))
    trainer = Trainer(data, recipe, folder)
    trainer.resume()
    rows = json.loads(kept.read_text()) if kept.exists() else []
    while not trainer.finished:
        for row in trainer.run():
            if row["step"] % every == 0:
                break
        judged = {"train": errors(trainer, train), "unseen": errors(trainer, unseen)}
        rows.append({"step": trainer.step, "seconds": trainer.seconds, **judged})
        write_atomically(kept, json.dumps(rows).encode())
        print(f"{STARTS[kind]}: {line(rows[-1])}", flush=True)
    return rows


def line(row: Row) -> str:
    """Format a row."""
    train, unseen = row["train"], row["unseen"]
    return (
        f"step {row['step']:6d} {row['seconds'] / 60:6.1f} min  train {train['observed_flip_frame']:6.2f} / "
        f"{train['observed_flip_global']:6.2f}  unseen {unseen['observed_flip_frame']:6.2f} / "
        f"{unseen['observed_flip_global']:6.2f}, as predicted {unseen['predicted_flip_frame']:6.2f} / "
        f"{unseen['predicted_flip_global']:6.2f} %"
    )


def draw(curves: dict[str, list[Row]], path: Path) -> None:
    """Draw training frames at the left and unseen ones at the right; one flip for all is dashed."""
    figure = new_figure(11, 4.5)
    for ax, part in zip(figure.subplots(1, 2, sharey=True), ("train", "unseen")):
        for colour, (kind, rows) in zip(COLOURS, curves.items()):
            minutes = [row["seconds"] / 60 for row in rows]
            for flip, style in (("frame", "-"), ("global", "--")):
                at = [row[part][f"observed_flip_{flip}"] for row in rows]
                label = STARTS[kind] + (", one flip for all" if flip == "global" else "")
                ax.plot(minutes, at, style, color=colour, label=label)
        ax.set(xlabel="minutes, with the search for the start", ylim=(0, None))
        ax.grid(axis="y", color="#ececec")
        titled(ax, {"train": "training frames", "unseen": "unseen frames"}[part])
    figure.axes[0].set_ylabel("normalised error, %")
    legend_above(figure, figure.axes[0])
    save_figure(figure, path)


def main() -> None:
    """Measure both curves, and write them as lines, JSON and a picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", metavar="DATA", type=Path, help="frames to train on (.npz)")
    parser.add_argument("--unseen", metavar="FILE", type=Path, required=True, help="frames to judge by (.npz)")
    parser.add_argument("--recipe", default="lifting", help="name or YAML file (default: %(default)s)")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="override a recipe setting")
    parser.add_argument("--seed", type=int, default=0, help="seed of the training (default: %(default)s)")
    parser.add_argument("--starts", nargs="+", choices=list(STARTS), default=list(STARTS), help="runs (default: both)")
    parser.add_argument("--every", type=int, default=1000, help="steps between evaluations (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    parser.add_argument("-o", "--output", metavar="FOLDER", type=Path, required=True, help="folder of the results")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    recipe = Recipe.load(args.recipe, [*args.set, f"seed={args.seed}"])
    curves = {kind: curve(args.data, args.unseen, recipe, kind, args.every, args.output / kind) for kind in args.starts}
    write_atomically(args.output / "curve.json", json.dumps(curves, indent=1).encode())
    draw(curves, args.output / "curve.png")


if __name__ == "__main__":
    try:
        main()
    except PaulError as error:
        raise SystemExit(f"curve: {error}") from None
