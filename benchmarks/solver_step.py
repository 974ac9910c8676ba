#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Cost of a training step with the exact lower-level solver and with the paper's algebraic one.

    python benchmarks/solver_step.py [--batch 256] [--rounds 50]

A step is: forward pass of the default recipe's networks, the lower-level problem (unit scale, two streams, unknown
depth), the squared losses of both streams, backward pass, Adam.  The three solvers take turns, so that load of the
machine affects all alike.  Views are shapes of the shipped human model from random sides, with noise of 3 % of their
size and a fifth of the points hidden.

The table is Markdown.  Ratios are to ``svd``, the paper's solver with torch.linalg.svd.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from paul_ros.model_file import load_model
from training.networks import build_networks
from training.recipe import Recipe
from training.solver import algebraic_camera, centre, solve_camera

STEPS = 10  # steps of each solver in a round


def views(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return image points (N,2,P) and their visibility (N,P)."""
    rng, model = np.random.default_rng(seed), load_model()
    S = model.decode(rng.standard_normal((count, model.header["bottleneck"])))
    Q, _ = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    W = Q[:, :2] @ S
    W = W + 0.03 * W.std() * rng.standard_normal(W.shape)
    return torch.from_numpy(W).float(), torch.from_numpy(rng.random((count, W.shape[2])) < 0.8)


def svd_streams(S_ae: Tensor, S_ad: Tensor, W: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the paper's steps 1 to 3 (section 4.2) to the letter, with torch's singular value decomposition."""
    seen = visible[:, None].to(W.dtype)
    S = torch.cat([centre(S_ae, visible) * seen, centre(S_ad, visible) * seen], dim=2)
    both = torch.cat([centre(W, visible) * seen] * 2, dim=2)
    M = torch.linalg.solve(S @ S.transpose(1, 2), both @ S.transpose(1, 2), left=False)
    U, _, V = torch.linalg.svd(M, full_matrices=False)
    Q = U @ V
    R = torch.cat([Q, torch.linalg.cross(Q[:, 0], Q[:, 1])[:, None]], dim=1)
    return R, (R[:, 2:] @ centre(S_ae + S_ad, visible))[:, 0] / 2


def algebraic_streams(S_ae: Tensor, S_ad: Tensor, W: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the same in closed form, as the trainer does; differentiable."""
    both = torch.cat([centre(S_ae, visible), centre(S_ad, visible)], dim=2)
    R = algebraic_camera(both, torch.cat([W, W], dim=2), torch.cat([visible, visible], dim=1), "unit").R
    return R, (R[:, 2:] @ centre(S_ae + S_ad, visible))[:, 0] / 2


@torch.no_grad()
def exact_streams(S_ae: Tensor, S_ad: Tensor, W: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the same problem to its global optimum (equation 8); a constant for autograd.

    The best depth is the mean of both streams.  The rest of their difference does not depend on R, so the problem is
    orthographic-N-point of their mean.  If the loss is this cost, no gradient of the pose is needed, because the cost
    is stationary at its optimum (envelope theorem).
    """
    mean = centre(S_ae + S_ad, visible) / 2
    R = solve_camera(mean, W, visible, "unit").R
    return R, (R[:, 2:] @ mean)[:, 0]


SOLVERS: dict[str, Callable[..., tuple[Tensor, Tensor]]] = {
    "svd": svd_streams,
    "algebraic": algebraic_streams,
    "exact": exact_streams,
}
"""Name -> solver: (S_ae (N,3,P), S_ad (N,3,P), W (N,2,P), visible (N,P)) -> R (N,3,3), z (N,P).

Depths z are relative to the mean of the visible points.
"""


class TimedTraining:
    """Training with one of the solvers."""

    def __init__(self, solver: str, W: Tensor, visible: Tensor) -> None:
        torch.manual_seed(0)
        recipe, layout = Recipe(), load_model().layout
        self.solver, self.W, self.visible = SOLVERS[solver], W, visible
        self.networks = build_networks(layout, recipe, len(self.W))
        self.adam = torch.optim.Adam(self.networks.parameters(), recipe.learning_rate, fused=True)

    def step(self) -> float:
        """Do one step, and return its loss."""
        S_ad = self.networks.decoder(self.networks.encoder(self.W, self.visible))
        S_ae = self.networks.decoder(self.networks.shape_encoder(S_ad))
        R, z = self.solver(S_ae, S_ad, self.W, self.visible)
        target = torch.cat([centre(self.W, self.visible), z[:, None]], dim=1)
        seen = self.visible[:, None]
        ae, ad = (((R @ centre(S, self.visible) - target) * seen).square().sum((1, 2)).mean() for S in (S_ae, S_ad))
        loss = ae + ad
        self.adam.zero_grad()
        loss.backward()
        self.adam.step()
        return loss.item()


def main() -> None:
    """Measure the solvers and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=256, help="frames a step (default: %(default)s)")
    parser.add_argument(
        "--rounds", type=int, default=50, help="rounds of ten steps of every solver (default: %(default)s)"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    runs = {name: TimedTraining(name, *views(args.batch, seed=0)) for name in SOLVERS}
    times: dict[str, list[float]] = {name: [] for name in runs}
    losses: dict[str, float] = {}
    for _ in range(args.rounds):
        for name, run in runs.items():
            start = time.perf_counter()
            for _ in range(STEPS):
                losses[name] = run.step()
            times[name].append((time.perf_counter() - start) / STEPS)
    ratios = {name: np.median(np.divide(times[name], times["svd"])) for name in runs}
    print("| solver | ms a step | ratio | loss at the end |\n|---|---|---|---|")
    for name in runs:
        print(f"| {name} | {1e3 * min(times[name]):.2f} | {ratios[name]:.3f} | {losses[name]:.4f} |")


if __name__ == "__main__":
    main()
