# SPDX-License-Identifier: Apache-2.0
"""The training loop: minibatches of 2D frames in, a checkpoint and a log out; resumable to the bit."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from paul_ros.files import write_atomically
from paul_ros.model import min_visible, normalise
from paul_ros.skeleton import Layout
from training.data import TrainingData
from training.networks import Paul, build_networks
from training.objective import Terms, Views, paul_terms
from training.recipe import Recipe

CHECKPOINT, LOG = "checkpoint.pt", "log.csv"
LOG_COLUMNS = ("step", "seconds", "loss", "recon_ae", "recon_ad", "code", "handedness", "bones", "learning_rate")
_LOG_EVERY = 100
_CHECKPOINT_SECONDS = 30.0
_WARM_UP_STEPS = 200
_GRADIENT_LIMIT = 1.0


class TrainingError(RuntimeError):
    """Training cannot go on; the text says what to do."""


class Trainer:
    """One run: data, recipe and a folder for its checkpoint and log.

    The folder holds ``checkpoint.pt`` (tensors and plain values, read without unpickling objects) and ``log.csv``.
    Interrupted and continued, a run gives the same weights to the bit as one that went through.
    """

    def __init__(self, data: TrainingData, recipe: Recipe, folder: Path) -> None:
        self.data, self.recipe, self.folder = data, recipe, folder
        self.generator = torch.Generator().manual_seed(recipe.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            self.networks = build_networks(data.layout, recipe, len(data.W))
        self.optimizer = torch.optim.Adam(self.networks.parameters(), lr=recipe.learning_rate, fused=True)
        self.step, self.seconds, self.rows = 0, 0.0, []
        self._W = torch.from_numpy(data.W)
        self._visible = torch.from_numpy(data.visible)
        self._mirror = torch.tensor(data.layout.mirror)

    @property
    def checkpoint(self) -> Path:
        """Where the run is kept."""
        return self.folder / CHECKPOINT

    def resume(self) -> bool:
        """Continue from the folder's checkpoint; False where there is none.

        Raises:
            TrainingError: the checkpoint is damaged, or belongs to other data or another recipe.
        """
        if not self.checkpoint.exists():
            return False
        try:
            state = torch.load(self.checkpoint, weights_only=True)
            self._check_identity(state["identity"])
            self.networks.load_state_dict(state["networks"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.generator.set_state(state["generator"])
            self.step, self.seconds, self.rows = state["step"], state["seconds"], [tuple(row) for row in state["rows"]]
        except TrainingError:
            raise
        except Exception as error:  # torch reports damage in many ways
            raise TrainingError(
                f"checkpoint '{self.checkpoint}' cannot be read ({type(error).__name__}): start over with --fresh"
            ) from error
        return True

    def run(self) -> Iterator[dict[str, float]]:
        """Train to the recipe's last step, yielding the log row of every step's progress.

        A checkpoint is written now and then, at the end, and when the caller stops iterating.

        Raises:
            TrainingError: the loss became infinite or NaN.
        """
        saved, begun = time.monotonic(), time.monotonic() - self.seconds
        try:
            while self.step < self.recipe.steps:
                row = self._advance(begun)
                if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                    self.save()
                    saved = time.monotonic()
                yield row
        finally:
            self.save()

    def save(self) -> None:
        """Write checkpoint and log, each atomically."""
        buffer = io.BytesIO()
        torch.save(
            {
                "identity": self._identity(),
                "networks": self.networks.state_dict(),
                "step": self.step,
                "optimizer": self.optimizer.state_dict(),
                "generator": self.generator.get_state(),
                "seconds": self.seconds,
                "rows": [list(row) for row in self.rows],
            },
            buffer,
        )
        write_atomically(self.checkpoint, buffer.getvalue())
        log = io.StringIO()
        csv.writer(log).writerows([LOG_COLUMNS, *self.rows])
        write_atomically(self.folder / LOG, log.getvalue().encode())

    def _advance(self, begun: float) -> dict[str, float]:
        """One optimisation step."""
        rate = self._learning_rate()
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        terms = paul_terms(self.networks, self.data.layout, self._batch())
        loss = self._loss(terms)
        if not torch.isfinite(loss):
            raise TrainingError(
                f"the loss is {loss.item()} at step {self.step}: lower learning_rate in the recipe, "
                f"and look for frames with wrong points in '{self.data.source}'"
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.networks.parameters(), _GRADIENT_LIMIT)
        self.optimizer.step()
        self.step += 1
        self.seconds = time.monotonic() - begun
        values = (loss, terms.recon_ae, terms.recon_ad, terms.code, terms.handedness, terms.bones)
        row = (self.step, round(self.seconds, 2), *(round(value.item(), 6) for value in values), round(rate, 8))
        if self.step % _LOG_EVERY == 0 or self.step == self.recipe.steps:
            self.rows.append(row)
        return dict(zip(LOG_COLUMNS, row))

    def _loss(self, terms: Terms) -> Tensor:
        recipe = self.recipe
        decay = sum(weight.square().sum() for weight in self.networks.decoder.parameters())
        return (
            terms.recon_ae
            + terms.recon_ad
            + recipe.code_weight * terms.code
            + recipe.decay_weight * decay
            + recipe.handedness_weight * terms.handedness
            + recipe.bone_weight * terms.bones
        )

    def _learning_rate(self) -> float:
        warm_up = min(1.0, (self.step + 1) / _WARM_UP_STEPS)
        cosine = 0.5 * (1 + np.cos(np.pi * self.step / self.recipe.steps))
        return float(self.recipe.learning_rate * warm_up * cosine)

    def _batch(self) -> Views:
        """Random frames, each seen anew: turned, mirrored and with more points hidden."""
        recipe, size = self.recipe, self.recipe.batch
        rows = torch.randint(len(self._W), (size,), generator=self.generator)
        W, visible = self._W[rows], self._visible[rows]
        if recipe.mirror_object:
            chosen = self._uniform(size) < 0.5
            W = torch.where(chosen[:, None, None], W[:, :, self._mirror] * torch.tensor([-1.0, 1.0])[:, None], W)
            visible = torch.where(chosen[:, None], visible[:, self._mirror], visible)
        if recipe.hide:
            fewer = visible & (self._uniform(size, visible.shape[1]) >= recipe.hide * self._uniform(size, 1))
            enough = fewer.sum(1) >= min_visible(visible.shape[1])
            visible = torch.where(enough[:, None], fewer, visible)
        turn, facing = self._turns(size)
        return Views.of(turn @ W, visible, facing, self.data.calibrated and recipe.perspective)

    def _turns(self, size: int) -> tuple[Tensor, Tensor]:
        """Random in-plane turns (N,2,2), half of them mirrored in x where the recipe says so; (N,1,1) is -1 for those.

        Both fade during the run as the recipe says.
        """
        strength = self._strength()
        angle = (2 * self._uniform(size) - 1) * self.recipe.roll * strength
        cos, sin = angle.cos(), angle.sin()
        turn = torch.stack([torch.stack([cos, -sin], 1), torch.stack([sin, cos], 1)], 1)
        mirrored = self._uniform(size) < (0.5 * strength if self.recipe.mirror_view else 0.0)
        facing = torch.where(mirrored, -1.0, 1.0)[:, None]
        turn[:, 0] *= facing
        return turn, facing[:, None]

    def _strength(self) -> float:
        """Of the view augmentations: 1 before the fade, 0 after it."""
        begin, end = self.recipe.fade
        done = self.step / self.recipe.steps
        if done < begin:
            return 1.0
        return (end - done) / (end - begin) if done < end else 0.0

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator)

    def _identity(self) -> dict[str, str]:
        """What a checkpoint belongs to."""
        return {
            "data": self.data.sha256,
            "recipe": repr(sorted(self.recipe.to_dict().items())),
            "layout": repr(sorted(self.data.layout.to_dict().items(), key=lambda item: item[0])),
        }

    def _check_identity(self, identity: dict[str, str]) -> None:
        other = [name for name, value in self._identity().items() if identity.get(name) != value]
        if other:
            raise TrainingError(
                f"'{self.folder}' holds a run with another {' and '.join(other)}: "
                f"start over with --fresh, or choose another output"
            )


def predict_shapes(networks: Paul, data: TrainingData, limit: int = 20_000) -> np.ndarray:
    """Canonical shapes (F,3,P) of up to ``limit`` evenly chosen training frames, from their 2D points."""
    rows = np.linspace(0, len(data.W) - 1, min(limit, len(data.W))).astype(int)
    W = torch.from_numpy(normalise(data.W[rows], data.visible[rows]).astype(np.float32))
    with torch.no_grad():
        return networks.decoder(networks.encoder(W, torch.from_numpy(data.visible[rows]))).double().numpy()


def rule_share(shapes: np.ndarray, layout: Layout) -> float | None:
    """Share of shapes (F,3,P) on the right side of every handedness rule; None where the layout has no rule."""
    if not layout.handedness:
        return None
    keeps = np.ones(len(shapes), bool)
    for rule in layout.handedness:
        middle = {part: shapes[:, :, list(points)].mean(2) for part, points in vars(rule).items()}
        volume = np.linalg.det(
            np.stack(
                [
                    middle["left"] - middle["right"],
                    middle["above"] - middle["below"],
                    middle["front"] - middle["behind"],
                ],
                axis=1,
            )
        )
        keeps &= volume > 0
    return float(keeps.mean())
