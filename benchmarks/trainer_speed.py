#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Frames per second of the trainer and of a plain twin: the same model in eager torch with an SVD.

    python benchmarks/trainer_speed.py [--rounds 30] [--threads 1] [--json FILE]

The twin is a direct implementation of the paper: the same networks, batches, losses and Adam, layer by layer.  Its
cameras come from least squares and torch.linalg.svd with gradients (section 4.2); nothing is fused or batched by hand.

The trainer is ``training.trainer.Trainer``.  With ``solver: algebraic`` it computes the same as the twin.  Its exact
cameras, the default, are more work.  It also does work that the twin omits: learning rates that change, hidden points,
terms and seconds for the log, and steps that Ctrl-C cannot break.

Both take turns in rounds of ten steps, so that load of the machine affects both alike.  The ratio is the median over
rounds.  Views are shapes of the shipped human model from random sides, all of one scale.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from paul_ros.files import write_atomically
from paul_ros.model_file import load_model
from training.data import TrainingData
from training.judge.truth import random_rotations
from training.networks import build_networks
from training.recipe import Recipe
from training.trainer import Trainer

STEPS = 10  # steps of each in a round
FRAMES = 4000
MODES = {"free codes": "free", "2D encoder": "encoder"}
SOLVERS = ("exact", "algebraic")


def views() -> TrainingData:
    """Return the image points of FRAMES frames, all visible."""
    rng, model = np.random.default_rng(0), load_model()
    S = random_rotations(FRAMES, 0) @ model.decode(0.3 * rng.standard_normal((FRAMES, model.header["bottleneck"])))
    visible = np.ones((FRAMES, S.shape[2]), bool)
    return TrainingData(
        np.ascontiguousarray(S[:, :2], np.float32), visible, model.layout, False, "made", np.ones(len(S), bool)
    )


class Twin:
    """Plain implementation of the paper's method, for views of one scale without hidden points."""

    def __init__(self, data: TrainingData, recipe: Recipe) -> None:
        torch.manual_seed(recipe.seed)
        self.recipe = recipe
        self.networks = build_networks(data.layout, recipe, len(data.W))
        self.W = torch.from_numpy(data.W / data.image_unit)
        self.W = self.W - self.W.mean(2, keepdim=True)
        self.visible = torch.from_numpy(data.visible)
        codes = recipe.codes == "free"
        used = [p for name, p in self.networks.named_parameters() if not (codes and name.startswith("encoder."))]
        self.adam = torch.optim.Adam(used, lr=recipe.learning_rate)

    def step(self) -> float:
        """Do one step, and return its loss."""
        loss = self.loss(torch.randint(len(self.W), (self.recipe.batch,)))
        self.adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.networks.parameters(), self.W.shape[2] ** 0.5)
        self.adam.step()
        return loss.item()

    def loss(self, rows: Tensor) -> Tensor:
        """Return the paper's equation 7 of some frames (N,)."""
        W = self.W[rows]
        code = self.code(rows)
        ad = self.decode(code)
        ae = self.decode(self.layers(self.networks.shape_encoder, ad.flatten(1)))
        R = self.camera(ad, ae, W)
        z = (R[:, 2:] @ (ad + ae)) / 2
        target = R.transpose(1, 2) @ torch.cat([W, z], dim=1)
        loss = torch.linalg.matrix_norm(ae - target).mean() + torch.linalg.matrix_norm(ad - target).mean()
        loss = loss + self.recipe.code_weight * code.square().sum(1).mean()
        for weight in self.networks.decoder.parameters():
            loss = loss + self.recipe.decay_weight * weight.square().sum()
        return loss

    def code(self, rows: Tensor) -> Tensor:
        """Return codes (N,K), free ones or those of the residual encoder."""
        if self.recipe.codes == "free":
            free_codes = cast(nn.Embedding, self.networks.free_codes)
            return free_codes(rows)
        encoder: Any = self.networks.encoder
        x = F.relu(encoder.input(torch.cat([self.W[rows].flatten(1), self.visible[rows].float()], dim=1)))
        for block in encoder.blocks:
            x = x + F.relu(block.second(F.relu(block.first(x))))
        return encoder.output(x)

    def decode(self, code: Tensor) -> Tensor:
        """Return centred shapes (N,3,P)."""
        S = self.layers(self.networks.decoder, code).unflatten(1, (3, -1))
        return S - S.mean(2, keepdim=True)

    @staticmethod
    def layers(layers: nn.ModuleList, x: Tensor) -> Tensor:
        """Apply linear layers with ELU between them."""
        *inner, last = layers
        for layer in inner:
            x = F.elu(layer(x))
        return last(x)

    @staticmethod
    def camera(ad: Tensor, ae: Tensor, W: Tensor) -> Tensor:
        """Solve steps 1 and 2 of the paper: least squares for both streams, then the nearest rotation by SVD."""
        S = torch.cat([ae, ad], dim=2)
        M = torch.linalg.lstsq(S.transpose(1, 2), torch.cat([W, W], dim=2).transpose(1, 2)).solution
        U, _, Vt = torch.linalg.svd(M.transpose(1, 2), full_matrices=False)
        Q = U @ Vt
        return torch.cat([Q, torch.linalg.cross(Q[:, 0], Q[:, 1])[:, None]], dim=1)


def timed(step: Callable[[], object]) -> float:
    """Return the seconds of a step."""
    begun = time.perf_counter()
    for _ in range(STEPS):
        step()
    return (time.perf_counter() - begun) / STEPS


def measure(mode: str, solver: str, batch: int, rounds: int) -> dict[str, Any]:
    """Measure the frames per second of both, and the ratio of their times."""
    steps = STEPS * (rounds + 2)
    settings = [f"steps={steps}", f"batch={batch}", "start=random", "regression_steps=0"]
    settings += [f"codes={MODES[mode]}", f"solver={solver}"]
    recipe, data = Recipe.load("nrsfm", settings), views()
    with tempfile.TemporaryDirectory() as folder:
        twin, trainer = Twin(data, recipe), Trainer(data, recipe, Path(folder))
        run = cast(Generator[dict[str, Any], None, None], trainer.run())
        times = []
        for number in range(rounds + 1):
            pair = timed(lambda: next(run)), timed(twin.step)
            times += [pair] if number else []  # the first warms up
        run.close()
    ours, plain = np.array(times).T
    return {
        "mode": mode,
        "solver": solver,
        "batch": batch,
        "frames_per_second": float(batch / np.median(ours)),
        "twin_frames_per_second": float(batch / np.median(plain)),
        "speed_ratio": float(np.median(plain / ours)),
    }


def main() -> None:
    """Measure all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30, help="rounds of ten steps of both (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the rows as JSON")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cases = itertools.product(MODES, SOLVERS, (128, 256))
    rows = [measure(*case, args.rounds) for case in cases]
    if args.json:
        write_atomically(args.json, json.dumps({"rows": rows, "threads": args.threads}, indent=1).encode())
    print("| codes | camera | batch | trainer, frames/s | plain twin, frames/s | ratio |\n|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['mode']} | {row['solver']} | {row['batch']} | {row['frames_per_second']:.0f} | "
            f"{row['twin_frames_per_second']:.0f} | {row['speed_ratio']:.2f} |"
        )


if __name__ == "__main__":
    main()
