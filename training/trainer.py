# SPDX-License-Identifier: Apache-2.0
"""The training loop: batches of 2D frames in, a checkpoint and a log out; resumable to the bit.

A run has up to three parts: a start is found (``starting.py``), the networks learn to give its shapes, and then the
paper's objective is minimised: over both levels at once, or over one while the other is held (``Recipe.hold``), in
which case fresh networks may then do it all again, starting from what the first made of the frames.
"""

from __future__ import annotations

import csv
import io
import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from paul_ros.files import write_atomically
from paul_ros.layout import Layout
from paul_ros.normalisation import enough_visible
from training.data import TrainingData
from training.distributed import Share, from_first, is_first, processes, share_of
from training.errors import StartError, TrainingError
from training.networks import Paul, build_networks, main_axes
from training.objective import Terms, Views, fit, paul_terms, regression_terms
from training.recipe import Recipe
from training.start import kept_start as starting
from training.start.kept_start import START_UNIT, Lesson, Progress, Start, kept_start, start_identity

CHECKPOINT, LOG = "checkpoint.pt", "log.csv"
LOG_COLUMNS = (
    *("step", "seconds", "loss", "recon_ae", "recon_ad", "code", "handedness", "bones", "nuclear"),
    *("learning_rate", "phase"),
)
REGRESSION, UNSUPERVISED, HELD = "regression", "unsupervised", "held"
_HELD_BATCH = 1000  # frames whose lower level is solved at once
_LEFT_OUT = 0.1  # of the frames: the least explained, which do not teach the next generation
_FAR = 1 / 3  # of the frames: those that starts are searched for in where there is perspective
_AS_MARKED = 0.3  # of a batch of held solutions: views without the detector's errors, as the lower level sees them
_AXES_VIEWS = 1000  # evenly chosen frames that main axes are found from
_LOG_EVERY = 100
_CHECKPOINT_SECONDS = 30.0
_WARM_UP_STEPS = 200
_GRADIENT_LIMIT = 1.0  # per square root of the number of points, as the objective grows with it
_SETTLED = 1e-3


@contextmanager
def _whole_step() -> Iterator[None]:
    """Hold Ctrl-C back until the step is done: half of one in a checkpoint, and the run would not continue the same."""
    if threading.current_thread() is not threading.main_thread():  # signals reach the main thread only
        yield
        return
    asked = []
    before = signal.signal(signal.SIGINT, lambda *about: asked.append(about))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked and callable(before):
        before(*asked[0])


class _Objective(nn.Module):
    """The objective as a module: what DistributedDataParallel can wrap."""

    def __init__(self, networks: Paul, layout: Layout, recipe: Recipe) -> None:
        super().__init__()
        self.networks, self.layout, self.recipe = networks, layout, recipe

    def forward(self, views: Views, rows: Tensor, goal: Tensor | None, share: Share) -> Terms:
        if goal is None:
            return paul_terms(self.networks, self.layout, self.recipe, views, rows, share)
        return regression_terms(self.networks, self.layout, self.recipe, views, rows, goal, share)


class Trainer:
    """One run: data, recipe, and a folder for what it keeps.

    The folder holds ``checkpoint.pt`` (tensors and plain values, read without unpickling objects), ``log.csv`` and, if
    the recipe asks for one, ``start.npz``. Interrupted and continued, a run gives the same weights to the bit as one
    that went through, on the same machine (on a GPU as far as torch's deterministic algorithms reach).

    Started by ``torchrun``, every process has its Trainer; the first one alone touches the folder.

    Attributes:
        networks: on ``device``.
        start: the start once ``prepare`` was called, of the chirality that the layout asks for; None for random ones.
        step: steps done, of both phases.
        seconds: that they took, with the search for the start.
        rows: of the log.
    """

    def __init__(self, data: TrainingData, recipe: Recipe, folder: Path, device: torch.device | str = "cpu") -> None:
        self.data, self.recipe, self.folder, self.device = data, recipe, folder, torch.device(device)
        if processes() > len(data.W) or 0 < recipe.batch < processes():
            raise TrainingError(f"{processes()} processes cannot share a batch of fewer frames: start fewer")
        self._W = torch.from_numpy(data.W).to(self.device)
        self._visible = torch.from_numpy(data.visible).to(self.device)
        self._detected = None if data.detected is None else torch.from_numpy(data.detected).to(self.device)
        self._mirror = torch.tensor(data.layout.mirror, device=self.device)
        self.generator = torch.Generator().manual_seed(recipe.seed)
        self.step, self.seconds, self.rows = 0, 0.0, []
        self.networks = self._fresh_networks()
        self.optimizer = self._optimizer()
        self._objective: nn.Module = _Objective(self.networks, data.layout, recipe)
        if processes() > 1:
            self._objective = nn.parallel.DistributedDataParallel(self._objective)
        self.start: Start | None = None
        self._lesson: Lesson | None = None
        self._teacher: dict[str, Tensor] | None = None  # weights of the networks whose solutions are held
        self.stopped = False
        self._window = [0, 0.0, math.inf]  # steps and losses since the last look at them, and the mean before it

    def _fresh_networks(self) -> Paul:
        """With the weights that the recipe's seed gives the generation that begins."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.recipe.seed + self.step)
            networks = build_networks(self.data.layout, self.recipe, len(self.data.W), self._axes())
        return networks.to(self.device)

    def _axes(self) -> Tensor | None:
        """What h brings views upright by, if the recipe asks for it."""
        if not self.recipe.upright:
            return None
        frames = len(self.data.W)
        rows = torch.linspace(0, frames - 1, min(frames, _AXES_VIEWS)).long()
        return main_axes(self.views(rows).W, self.data.layout)

    @property
    def checkpoint(self) -> Path:
        """Where the run is kept."""
        return self.folder / CHECKPOINT

    @property
    def regression_steps(self) -> int:
        """Steps before those of the objective."""
        return self.recipe.regression_steps if self.recipe.start != "random" else 0

    @property
    def steps(self) -> int:
        """Steps of both phases, of all generations."""
        return self.recipe.generations * self._steps_each

    @property
    def _steps_each(self) -> int:
        """Steps of one generation."""
        return self.regression_steps + self.recipe.steps

    @property
    def _lesson_steps(self) -> int:
        """Steps of this generation before those of the objective.

        Later ones begin with shapes better than they give for long: renewed too soon, these would be lost.
        """
        return self.regression_steps if self.step < self._steps_each else self._steps_each // 2

    @property
    def _own_step(self) -> int:
        """Steps that this generation has done."""
        return self.step % self._steps_each

    @property
    def finished(self) -> bool:
        """Nothing is left to do: all steps are done, or patience was out."""
        return self.stopped or self.step >= self.steps

    def resume(self) -> bool:
        """Continue from the folder's checkpoint; False where there is none.

        Raises:
            TrainingError: the checkpoint is damaged, or belongs to other data or another recipe.
        """
        data = from_first(lambda: self.checkpoint.read_bytes() if self.checkpoint.exists() else None, self.device)
        if data is None:
            return False
        try:
            state = torch.load(io.BytesIO(data), map_location=self.device, weights_only=True)
            self._check_identity(state["identity"])
            self.networks.load_state_dict(state["networks"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.generator.set_state(state["generator"].cpu())
            self.step, self.seconds, self.rows = state["step"], state["seconds"], [tuple(row) for row in state["rows"]]
            self.stopped, self._window = state["stopped"], list(state["window"])
            self._teacher = state["teacher"]
        except TrainingError:
            raise
        except Exception as error:  # torch reports damage in many ways
            raise TrainingError(
                f"checkpoint '{self.checkpoint}' cannot be read ({type(error).__name__}): start over with --fresh"
            ) from error
        return True

    def prepare(self, progress: Progress | None = None) -> None:
        """Find the recipe's start, or read the one that the folder keeps.

        Raises:
            TrainingError: the folder's start is damaged, or belongs to other data or another recipe.
        """
        if self.recipe.start == "random" or self.start is not None:
            return
        identity = start_identity(self.data, self.recipe)
        try:
            start = kept_start(self.folder, identity, lambda: self._search(progress), self.device)
        except StartError as error:
            raise TrainingError(str(error)) from error
        share = rule_share(start.shapes, self.data.layout)
        self.start = starting.mirrored(start) if share is not None and share < 0.5 else start
        if self.step == 0:
            self.seconds = start.seconds
        if self.regression_steps:
            views = self.views(torch.from_numpy(self.start.rows))
            self._lesson = Lesson.of(self.start, views, self.data.layout, self.recipe.scale)

    def run(self) -> Iterator[dict[str, float | str]]:
        """Train to the recipe's last step, yielding the log row of every step's progress.

        A checkpoint is written now and then, at the end, and when the caller stops iterating.

        Raises:
            TrainingError: the loss became infinite or NaN.
        """
        self.prepare()
        if self._teacher is not None:
            self._lesson = self._held_again()
        saved, begun = time.monotonic(), time.monotonic() - self.seconds
        try:
            while not self.finished:
                with _whole_step():
                    row = self._advance(begun)
                if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                    self.save()
                    saved = time.monotonic()
                yield row
        finally:
            self.save()

    def save(self) -> None:
        """Write checkpoint and log, each atomically."""
        if not is_first():
            return
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
                "stopped": self.stopped,
                "window": self._window,
                "teacher": self._teacher,
            },
            buffer,
        )
        write_atomically(self.checkpoint, buffer.getvalue())
        log = io.StringIO()
        csv.writer(log).writerows([LOG_COLUMNS, *self.rows])
        write_atomically(self.folder / LOG, log.getvalue().encode())

    def views(self, rows: Tensor) -> Views:
        """Frames by their numbers (N,), as they are."""
        rows = rows.to(self.device)
        facing = torch.ones(len(rows), 1, 1, device=self.device)
        return self._seen(self._W[rows], self._visible[rows], facing)

    def _seen(self, image: Tensor, visible: Tensor, facing: Tensor) -> Views:
        perspective = self.data.calibrated and self.recipe.perspective and self.recipe.scale == "free"
        unit = self.data.image_unit if self.recipe.scale == "unit" else None
        return Views.of(image, visible, facing, perspective, unit)

    def _search(self, progress: Progress | None) -> Start:
        views = self.views(torch.arange(len(self.data.W)))
        W, visible = views.W.cpu().numpy() / START_UNIT[self.recipe.scale], views.visible.cpu().numpy()
        if not views.calibrated:
            return starting.search(self.recipe.start, W, visible, self.recipe.seed, progress)
        # Starts know no perspective, of which the small images have least.
        far = views.size.flatten().argsort().cpu().numpy()[: max(1, round(_FAR * len(W)))]
        found = starting.search(self.recipe.start, W[far], visible[far], self.recipe.seed, progress)
        return replace(found, rows=far[found.rows])

    def _optimizer(self) -> torch.optim.Optimizer:
        """Adam on what this recipe trains, free codes at a rate of their own."""
        codes = [] if self.networks.free_codes is None else list(self.networks.free_codes.parameters())
        idle = [self.networks.encoder] if codes else []
        idle += [self.networks.shape_encoder] if self.recipe.streams == "decoder" else []
        for part in idle:
            part.requires_grad_(False)
        weights = [w for w in self.networks.parameters() if w.requires_grad and not any(w is code for code in codes)]
        groups = [{"params": [one_buffer(weights)], "peak": self.recipe.learning_rate}]
        if codes:
            groups.append({"params": [one_buffer(codes)], "peak": self.recipe.code_learning_rate})
        return torch.optim.Adam(groups, lr=self.recipe.learning_rate, fused=True)

    def _advance(self, begun: float) -> dict[str, float | str]:
        """One optimisation step."""
        phase = self._phase()
        if self._lesson_is_over(phase):
            self._renew(phase)
        factor = self._rate_factor()
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * factor
        terms = self._objective(*self._batch(phase))
        loss = terms.loss.item()
        if not math.isfinite(loss):
            raise TrainingError(
                f"the loss is {loss} at step {self.step}: lower learning_rate in the recipe, "
                f"and look for frames with wrong points in '{self.data.source}'"
            )
        trained = [weights for group in self.optimizer.param_groups for weights in group["params"]]
        for weights in trained:
            weights.grad.zero_()
        terms.loss.backward()
        limit = _GRADIENT_LIMIT * self.data.W.shape[2] ** 0.5
        torch.nn.utils.clip_grad_norm_(trained, limit)
        self.optimizer.step()
        self.step += 1
        self.seconds = time.monotonic() - begun
        if phase != REGRESSION and self.recipe.patience:
            self.stopped = self._settled(loss)
        row = self._row(terms, self.recipe.learning_rate * factor, phase)
        if self.step % _LOG_EVERY == 0 or self._own_step in (0, self._lesson_steps) or self.finished:
            self.rows.append(row)
        return dict(zip(LOG_COLUMNS, row))

    def _phase(self) -> str:
        """Of the step to come."""
        if self._own_step < self._lesson_steps:
            return REGRESSION
        return HELD if self.recipe.hold else UNSUPERVISED

    def _lesson_is_over(self, phase: str) -> bool:
        """Whether the next step is the first one after the lesson: a generation's first, or when a hold ends."""
        if phase == REGRESSION:
            return self.step > 0 and self._own_step == 0
        return phase == HELD and (self._own_step - self._lesson_steps) % self.recipe.hold == 0

    def _renew(self, phase: str) -> None:
        """The networks' own solutions become the lesson; where a generation begins, fresh networks learn it."""
        self._teacher = {name: weights.clone() for name, weights in self.networks.state_dict().items()}
        self._lesson = self._held(phase)
        if phase == REGRESSION:
            self._forget()

    @torch.no_grad()
    def _held(self, phase: str) -> Lesson:
        """What the networks make of all frames, R^T [W; z] of equations 8-10 and 14, to be learned for a while.

        Where it is for the next generation to begin with, the frames that are explained worst are left out.
        """
        parts = []
        for rows in torch.arange(len(self.data.W)).split(_HELD_BATCH):
            views = self.views(rows)
            found = fit(self.networks, self.recipe, views, rows.to(self.device))
            error = (found.streams.mean(0) - found.points).flatten(1).norm(dim=1)
            parts.append((found.camera.R.mT @ found.points, found.camera.R, views.size, error))
        shapes, cameras, sizes, errors = map(torch.cat, zip(*parts))
        left_out = int(_LEFT_OUT * len(self.data.W)) if phase == REGRESSION else 0
        rows = errors.argsort()[: len(self.data.W) - left_out].sort().values
        perspective, layout = views.calibrated, self.data.layout
        return Lesson(shapes[rows], cameras[rows], rows.cpu(), sizes[rows], perspective, layout, self.recipe.scale)

    def _held_again(self) -> Lesson:
        """The lesson of an interrupted run, from the weights that made it."""
        weights = {name: values.clone() for name, values in self.networks.state_dict().items()}
        self.networks.load_state_dict(self._teacher)
        lesson = self._held(self._phase())
        self.networks.load_state_dict(weights)
        return lesson

    def _forget(self) -> None:
        """Give the networks fresh weights, in place: the next generation's."""
        fresh = self._fresh_networks()
        self.networks.load_state_dict(fresh.state_dict())
        self.optimizer.state.clear()

    def _row(self, terms: Terms, rate: float, phase: str) -> tuple:
        values = (getattr(terms, name) for name in LOG_COLUMNS[2:9])
        losses = (round(value.item(), 6) for value in values)
        return (self.step, round(self.seconds, 2), *losses, round(rate, 8), phase)

    def _settled(self, loss: float) -> bool:
        """Whether the last ``patience`` steps had a mean loss that is not lower by a thousandth than that before them.

        Means of windows that do not overlap: single batches are noise.
        """
        count, total, before = self._window
        count, total = count + 1, total + loss
        if count < self.recipe.patience:
            self._window = [count, total, before]
            return False
        self._window = [0, 0.0, total / count]
        return total / count > (1 - _SETTLED) * before

    def _rate_factor(self) -> float:
        """Of all learning rates: a warm-up and a cosine to zero in either phase.

        With held solutions both phases are one, for they do the same; and half of it is at the full rate, as a solution
        that is renewed late has to be learned anew.
        """
        if self.recipe.hold:
            step, steps = self._own_step, self._steps_each
            done = max(0.0, 2 * step / steps - 1)
        else:
            first = self._own_step < self.regression_steps
            step = self._own_step if first else self._own_step - self.regression_steps
            done = step / (self.regression_steps if first else self.recipe.steps)
        warm_up = min(1.0, (step + 1) / _WARM_UP_STEPS)
        return float(warm_up * 0.5 * (1 + np.cos(np.pi * done)))

    def _batch(self, phase: str) -> tuple[Views, Tensor, Tensor | None, Share]:
        """This process's share of a batch: views, frame numbers, and in the first phase the shapes to be learned.

        Every view is seen anew, turned, mirrored and with more points hidden. None of that changes the canonical shape,
        but for a mirrored object, whose shape is mirrored as well.  Where the lower level is held, shapes are seen by
        other frames' cameras, not their own, with the points that these saw: a frame whose depth is wrong then does not
        go on to teach it to itself, and one shape gets one code whatever is hidden.
        """
        recipe = self.recipe
        pool = len(self.data.W) if phase == UNSUPERVISED else len(self._lesson.rows)
        size = recipe.batch or pool
        chosen = torch.randint(pool, (size,), generator=self.generator) if recipe.batch else torch.arange(pool)
        rows = (chosen if phase == UNSUPERVISED else self._lesson.rows[chosen]).to(self.device)
        W, visible = self._W.index_select(0, rows), self._visible.index_select(0, rows)  # faster than [rows]
        exchanged = None
        if recipe.mirror_object:
            exchanged = (self._uniform(size) < 0.5)[:, None, None]
            W = torch.where(exchanged, W[:, :, self._mirror] * torch.tensor([[-1.0], [1.0]], device=self.device), W)
            visible = torch.where(exchanged[:, 0], visible[:, self._mirror], visible)
        goal = None if phase == UNSUPERVISED else self._lesson.shapes_of(chosen, exchanged)
        if recipe.hold:
            others = torch.randint(pool, (size,), generator=self.generator)
            seen = self._lesson.rows[others].to(self.device)
            W, visible = self._detected_as(seen, self._lesson.seen_by(others, goal))
        if recipe.hide:
            fewer = visible & (self._uniform(size, visible.shape[1]) >= recipe.hide * self._uniform(size, 1))
            visible = torch.where(enough_visible(fewer, self.data.layout)[:, None], fewer, visible)
        facing = torch.ones(size, 1, 1, device=self.device)
        if recipe.roll or recipe.mirror_view:
            turn, facing = self._turns(size)
            W = turn @ W
        share = share_of(size)
        goal = None if goal is None else goal[share.part]
        return self._seen(W, visible, facing)[share.part], rows[share.part], goal, share

    def _detected_as(self, rows: Tensor, W: Tensor) -> tuple[Tensor, Tensor]:
        """Views W (N,2,P) as points were hidden in frames of these numbers (N,), with the detector's errors there."""
        visible = self._visible.index_select(0, rows)
        if self._detected is None:
            return W, visible
        error = self._detected.index_select(0, rows) - self._W.index_select(0, rows)
        marked = self._uniform(len(rows), 1) < _AS_MARKED
        visible = torch.where(marked, visible, error.isfinite().all(1))
        return W + torch.where(marked[..., None], 0.0, error.nan_to_num(0.0)), visible

    def _turns(self, size: int) -> tuple[Tensor, Tensor]:
        """Random in-plane turns (N,2,2), half of them mirrored in x where the recipe says so; (N,1,1) is -1 for those.

        Both fade during the run as the recipe says.
        """
        strength = self._strength()
        angle = (2 * self._uniform(size) - 1) * self.recipe.roll * strength
        mirrored = self._uniform(size) < (0.5 * strength if self.recipe.mirror_view else 0.0)
        return turned_views(angle, mirrored)

    def _strength(self) -> float:
        """Of the view augmentations: 1 before the fade, 0 after it."""
        begin, end = self.recipe.fade
        done = max(0, self._own_step - self.regression_steps) / max(1, self.recipe.steps)
        if done < begin:
            return 1.0
        return (end - done) / (end - begin) if done < end else 0.0

    def _uniform(self, *shape: int) -> Tensor:
        # On the CPU always, so that every device and every number of processes sees the same.
        return torch.rand(shape, generator=self.generator).to(self.device)

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
                f"'{self.folder}' holds a run with different {' and '.join(other)}: "
                f"start over with --fresh, or choose another output"
            )


def one_buffer(parameters: list[nn.Parameter]) -> nn.Parameter:
    """All parameters in one vector that they and their gradients are views of from here on.

    An optimiser's step then costs one tensor's calls, where networks this small would wait for dozens.
    """
    buffer = nn.Parameter(nn.utils.parameters_to_vector(parameters).detach().clone())
    buffer.grad = torch.zeros_like(buffer)
    begin = 0
    for parameter in parameters:
        part = slice(begin, begin + parameter.numel())
        begin = part.stop
        parameter.data, parameter.grad = (x[part].view_as(parameter) for x in (buffer.data, buffer.grad))
    return buffer


def turned_views(angle: Tensor, mirrored: Tensor) -> tuple[Tensor, Tensor]:
    """Turns by angles (N,) in the image plane, then mirrored in x where asked (N,): (N,2,2), and facing (N,1,1)."""
    cos, sin = angle.cos(), angle.sin()
    turn = torch.stack([torch.stack([cos, -sin], 1), torch.stack([sin, cos], 1)], 1)
    facing = torch.where(mirrored, -1.0, 1.0)[:, None]
    turn[:, 0] *= facing
    return turn, facing[:, None]


@torch.no_grad()
def predict_shapes(networks: Paul, data: TrainingData, limit: int = 4096) -> np.ndarray:
    """Canonical shapes (F,3,P) of up to ``limit`` evenly chosen training frames, from their 2D points by h."""
    rows = np.linspace(0, len(data.W) - 1, min(limit, len(data.W))).astype(int)
    device = next(networks.parameters()).device
    W, visible = torch.from_numpy(data.W[rows]).to(device), torch.from_numpy(data.visible[rows]).to(device)
    unit = None if networks.decoder.unit_size else data.image_unit
    views = Views.of(W, visible, torch.ones(len(rows), 1, 1, device=device), False, unit)
    return networks.decoder(networks.encoder(views.W, visible)).double().cpu().numpy()


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
