#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Train the human recipe with 3D labels: the upper bound of its training from 2D alone.

    python benchmarks/human_ceiling.py CMU_FOLDER -o out/ceiling [--set KEY=VALUE ...]

Views, networks, length and losses are those of ``paul train CMU_FOLDER --recipe human``, but the networks learn the
true shapes from the first step to the last.  The folder receives ceiling.npz, for ``benchmarks/human_model.py``.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from paul_ros.errors import PaulError
from training.export import export_model
from training.judge.truth import load_sequence
from training.loading import load_training_data
from training.people.human_data import make_file, views_of
from training.people.human_points import human_layout
from training.recipe import Recipe
from training.reconstruction import final_loss
from training.start.kept_start import kept_start, start_identity
from training.start.search import START_UNIT
from training.start.start import Start
from training.start.synchronise import aligned
from training.trainer import Trainer


def labels(trainer: Trainer, S: np.ndarray) -> Start:
    """Return the start that a perfect search would find: the true shapes S (F,3,P) of all frames, camera frame."""
    views = trainer.views(torch.arange(len(S)))
    X = torch.from_numpy(S - S.mean(2, keepdims=True)).float()
    W = views.W / START_UNIT["free"]
    scale = (X[:, :2] * W).sum((1, 2)) / X[:, :2].square().sum((1, 2))
    shapes, turn = aligned((scale[:, None, None] * X).double())
    return Start(np.arange(len(S)), shapes.float().numpy(), turn.mT.float().numpy(), 0.0, 0.0)


def main() -> None:
    """Train and export the model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", metavar="CMU_FOLDER", type=Path, help="folder of motion capture")
    parser.add_argument("-o", "--output", metavar="FOLDER", type=Path, required=True, help="folder of the results")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="override a recipe setting")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    recipe, run = Recipe.load("human", args.set), args.output / "run"
    make_file(args.folder, views_of(recipe), args.output / "2d.npz", args.output / "3d.npz")
    steps = recipe.regression_steps + recipe.steps
    # All steps regress the labels, but for the one without which a recipe trains no networks.
    recipe = replace(recipe, views=None, regression_steps=steps - 1, steps=1)
    data = load_training_data(args.output / "2d.npz", human_layout())
    trainer = Trainer(data, recipe, run)
    S = load_sequence(args.output / "3d.npz").S
    if len(S) != len(data.W):
        raise SystemExit("the trainer left frames out, so labels belong to other frames: report this as a bug")
    kept_start(run, start_identity(data, recipe), lambda: labels(trainer, S), torch.device("cpu"))
    trainer.resume()
    with tqdm(total=trainer.steps, initial=trainer.step, desc="with 3D labels") as bar:
        for row in trainer.run():
            bar.update()
            bar.set_postfix(loss=f"{row['loss']:.3f}", refresh=False)
    export_model(trainer, final_loss(trainer), args.output / "ceiling.npz", "benchmarks/human_ceiling.py")


if __name__ == "__main__":
    try:
        main()
    except PaulError as error:
        raise SystemExit(f"human_ceiling: {error}") from None
