#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What the human recipe's networks reach with 3D labels: the ceiling of its training from 2D alone.

    python benchmarks/human_ceiling.py CMU_FOLDER -o out/ceiling [--set KEY=VALUE ...]

The same views, networks, length and losses as ``paul train CMU_FOLDER --recipe human``, but the shapes that are learned
are the true ones from the first step to the last.  Writes ceiling.npz, for ``benchmarks/human_model.py``.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from training.export import export_model
from training.judge.truth import load_sequence
from training.loading import load_training_data
from training.people.human_data import make_file, views_of
from training.people.mocap import human_layout
from training.recipe import Recipe
from training.reconstruction import final_loss
from training.start.kept_start import kept_start, start_identity
from training.start.search import START_UNIT
from training.start.start import Start
from training.start.synchronise import aligned
from training.trainer import Trainer


def labels(trainer: Trainer, S: np.ndarray) -> Start:
    """The true shapes S (F,3,P) of all frames, camera frame, as a perfect search would give them."""
    views = trainer.views(torch.arange(len(S)))
    X = torch.from_numpy(S - S.mean(2, keepdims=True)).float()
    W = views.W / START_UNIT["free"]
    scale = (X[:, :2] * W).sum((1, 2)) / X[:, :2].square().sum((1, 2))
    shapes, turn = aligned((scale[:, None, None] * X).double())
    return Start(np.arange(len(S)), shapes.float().numpy(), turn.mT.float().numpy(), 0.0, 0.0)


def main() -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="motion capture, as training/README.md says")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="a setting of the recipe")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    recipe, run = Recipe.load("human", args.set), args.output / "run"
    make_file(args.folder, views_of(recipe), args.output / "2d.npz", args.output / "3d.npz")
    steps = recipe.regression_steps + recipe.steps
    recipe = replace(recipe, views=None, regression_steps=steps - 1, steps=1)  # without any there would be no networks
    data = load_training_data(args.output / "2d.npz", human_layout())
    trainer = Trainer(data, recipe, run)
    S = load_sequence(args.output / "3d.npz").S
    if len(S) != len(data.W):
        raise SystemExit("some frames were left out, so labels are of others: report this")
    kept_start(run, start_identity(data, recipe), lambda: labels(trainer, S), torch.device("cpu"))
    trainer.resume()
    with tqdm(total=trainer.steps, initial=trainer.step, desc="with 3D labels") as bar:
        for row in trainer.run():
            bar.update()
            bar.set_postfix(loss=f"{row['loss']:.3f}", refresh=False)
    export_model(trainer, final_loss(trainer), args.output / "ceiling.npz", "benchmarks/human_ceiling.py")


if __name__ == "__main__":
    main()
