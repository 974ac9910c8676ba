# SPDX-License-Identifier: Apache-2.0
"""Searches for a start: an annealed linear Procrustean model finds 3D shapes of some frames from 2D points alone.

From random weights the auto-encoder's objective falls into poor local minima, although it is lower at the true shapes.
A linear model with much noise has few minima; the noise is then lowered step by step (``linear_model.py``).

1. Basin: many random starts on few frames, halved by likelihood on the way. The best few different ones go on to all
   frames, and the most likely of them wins. Starts are random shapes, not rigid ones: the rigid factorisation of lowest
   residual can lie in a wrong basin.
2. One mirror image for all frames, if many viewpoints have mixed them (``synchronise.py``).
3. Detail: many bases and ever less noise. The right level of noise differs from data to data. The likelihood and
   held-out points do not show it. Two models show it, each fitted to one half of the frames, by their difference in
   the depth of all frames. The result is the mean of both, over all levels that are nearly as good as the best.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from training.errors import StartError
from training.progress import Progress, ignore_progress
from training.start.linear_model import LinearModel, random_rotations
from training.start.moments import Moments
from training.start.observations import Observations, centred_on_visible
from training.start.start import Start
from training.start.synchronise import synchronised

_MAX_FRAMES, _MAX_POINTS = 1200, 256
_MIN_VISIBLE = 3
_STARTS, _START_FRAMES = 48, 300
_CANDIDATES = 4

_SAME_BASIN = 0.1
"""Nats a frame; models of a smaller difference are in one basin."""

_BASES = (6, 10, 30)
"""K of the starts, the candidates and the detail."""

# Stages of annealing: sigma, penalty, steps of expectation maximisation. Candidates have L-BFGS iterations as well.
_WARM = ((1.0, 3.0, 15), (0.5, 2.0, 15), (0.3, 1.0, 20))
_COOLER = ((0.2, 0.3, 20), (0.1, 0.1, 20))
_COOLED = 60
"""L-BFGS iterations after the stages _COOLER."""
_CANDIDATE = ((0.1, 0.03, 15, 60), (0.05, 0.01, 10, 60), (0.03, 0.0, 10, 160))
_RIGID = ((1.0, 0.0, 20), (0.3, 0.0, 30))
_RIGID_ITERATIONS = 100
_RIGID_NOISE = 0.01

_DETAIL = ((0.03, 60), (0.015, 60), (0.0075, 80), (0.004, 100), (0.002, 100))
"""Sigma and L-BFGS iterations of the detail."""

_SETTLING = 10
"""Alternations of codes and cameras that fit the cameras of the other half to given bases."""

_DOUBT_MARGIN = 1.25
"""Levels of noise with at most so many times the least doubt are averaged."""

_BLOCK = 512
"""Points that are extended together."""

_EXTENSION_RIDGE = 1e-3


@contextmanager
def _breakdown_explained() -> Iterator[None]:
    try:
        yield
    except (np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:
        raise StartError(
            "the search for a start broke down on these image points: look for outliers among them, "
            f"or choose start: random ({error})"
        ) from error


@_breakdown_explained()
def linear_start(W: np.ndarray, visible: np.ndarray, seed: int, progress: Progress | None = None) -> Start:
    """Find shapes of up to 1200 frames by the linear model.

    Args:
        W: (F,2,P) image points of one scale, root mean square coordinate 1; hidden ones may have any value.
        visible: (F,P) bool.
        seed: of the random starts.
        progress: called with the share of the work that is done.

    Raises:
        StartError: fewer than two frames show three points, or the numbers are infinite or too large.
    """
    generator, advance = np.random.default_rng(seed), progress or ignore_progress
    points = _chosen(W.shape[2], _MAX_POINTS, generator)
    usable = np.flatnonzero(visible[:, points].sum(1) >= _MIN_VISIBLE)
    if len(usable) < 2:
        raise StartError(
            f"only {len(usable)} of {len(W)} frames show {_MIN_VISIBLE} points and more, a start needs two: "
            "give more data, or choose start: random"
        )
    rows = usable[_chosen(len(usable), _MAX_FRAMES, generator)]
    seen = Observations.of(W[np.ix_(rows, np.arange(2), points)], visible[np.ix_(rows, points)])
    basin = find_basin(seen, generator, lambda done: advance(0.4 * done))
    basin = synchronised(basin, seen, generator, lambda done: advance(0.4 + 0.3 * done))
    score = basin.objective(seen, _CANDIDATE[-1][0], 0.0)
    shapes, rotations = find_detail(basin, seen, generator, lambda done: advance(0.7 + 0.3 * done))
    if len(points) < W.shape[2]:
        shapes = _extended(shapes, rotations, W[rows], visible[rows], points)
    advance(1.0)
    return Start(rows, shapes, rotations, score)


@_breakdown_explained()
def rigid_start(W: np.ndarray, visible: np.ndarray, seed: int, progress: Progress | None = None) -> Start:
    """Find one rigid shape for all frames, a baseline, by the same search without bases; see ``linear_start``."""
    generator, advance = np.random.default_rng(seed), progress or ignore_progress
    seen = Observations.of(W, visible)
    models, (sigma, penalty, _) = [], _RIGID[-1]
    for number in range(_CANDIDATES):
        model = LinearModel.random(len(seen), seen.points, 0, generator)
        model = annealed(model, seen, _RIGID, generator)
        models.append(model.polished(seen, sigma, penalty, _RIGID_ITERATIONS))
        advance((number + 1) / _CANDIDATES)
    best = _best(models, seen, _RIGID[-1])[0]
    # Without bases the noise only weighs the curvature in the cameras, which shrinks a truly rigid body.
    best = best.polished(seen, _RIGID_NOISE, penalty, _RIGID_ITERATIONS)
    shapes = centred_on_visible(best.V.expand(len(seen), -1, -1), seen.visible).numpy()
    return Start(np.arange(len(seen)), shapes, best.R.numpy(), best.objective(seen, _RIGID_NOISE, penalty))


def find_basin(seen: Observations, generator: np.random.Generator, progress: Progress) -> LinearModel:
    """Return the most likely of many random starts, fitted to all frames at a noise of 0.03."""
    bases = [min(bases, seen.points - 1) for bases in _BASES]
    some = seen[_chosen(len(seen), _START_FRAMES, generator)]
    models = []
    for number in range(_STARTS):
        model = LinearModel.random(len(some), some.points, bases[0], generator)
        models.append(annealed(model, some, _WARM, generator))
        progress(0.5 * (number + 1) / _STARTS)
    models = _best(models, some, _WARM[-1])[: _STARTS // 4]
    for number, model in enumerate(models):
        sigma, penalty, _ = _COOLER[-1]
        models[number] = annealed(model, some, _COOLER, generator).polished(some, sigma, penalty, _COOLED)
        progress(0.5 + 0.2 * (number + 1) / len(models))
    models = _different(_best(models, some, _COOLER[-1]), some, _COOLER[-1])[:_CANDIDATES]
    for number, model in enumerate(models):
        models[number] = _on_all_frames(model, seen, bases[1], generator)
        progress(0.7 + 0.3 * (number + 1) / len(models))
    return _best(models, seen, _CANDIDATE[-1])[0].widened(bases[2], generator)


def find_detail(
    basin: LinearModel, seen: Observations, generator: np.random.Generator, progress: Progress
) -> tuple[np.ndarray, np.ndarray]:
    """Return shapes (F,3,P) and rotations (F,3,3): two halves of the frames find the level of noise; see above."""
    order = generator.permutation(len(seen))
    halves = [np.sort(order[::2]), np.sort(order[1::2])]
    models = [LinearModel(basin.V, basin.R) for _ in halves]
    found = []
    for number, (sigma, iterations) in enumerate(_DETAIL):
        models = [_fitted_to(half, model, seen, sigma, iterations) for half, model in zip(halves, models)]
        views = [model.in_camera(seen, sigma) for model in models]
        found.append((_doubt(views, seen), sum(seen.completed(view) for view in views) / len(views), models[0].R))
        progress((number + 1) / len(_DETAIL))
    least, _, R = min(found, key=lambda one: one[0])
    good = [shapes for doubt, shapes, _ in found if doubt <= _DOUBT_MARGIN * least]
    return (R.transpose(1, 2) @ sum(good) / len(good)).numpy(), R.numpy()


def annealed(model: LinearModel, seen: Observations, stages: tuple, generator: np.random.Generator) -> LinearModel:
    """Run expectation maximisation through stages (sigma, penalty, steps), with one global search of cameras each."""
    for sigma, penalty, steps in stages:
        for step in range(steps):
            model = model.em_step(seen, sigma, penalty)
            if step == steps // 2:
                model = model.searched(seen, sigma, generator)
    return model


def _chosen(count: int, limit: int, generator: np.random.Generator) -> np.ndarray:
    """Return all of ``count`` numbers, or ``limit`` random ones in order."""
    return np.arange(count) if count <= limit else np.sort(generator.choice(count, limit, replace=False))


def _best(models: list[LinearModel], seen: Observations, stage: tuple) -> list[LinearModel]:
    return sorted(models, key=lambda model: model.objective(seen, *stage[:2]))


def _different(models: list[LinearModel], seen: Observations, stage: tuple) -> list[LinearModel]:
    """Return sorted models, one for each basin: models as good as the one before are in its basin."""
    kept = models[:1]
    for model in models[1:]:
        if model.objective(seen, *stage[:2]) > kept[-1].objective(seen, *stage[:2]) + _SAME_BASIN:
            kept.append(model)
    return kept


def _on_all_frames(model: LinearModel, seen: Observations, bases: int, generator: np.random.Generator) -> LinearModel:
    """Fit a model of few frames to all, with more bases."""
    model = LinearModel(model.V, random_rotations(len(seen), generator)).searched(seen, 0.2, generator)
    model = model.widened(bases, generator)
    for sigma, penalty, steps, iterations in _CANDIDATE:
        model = annealed(model, seen, ((sigma, penalty, steps),), generator)
        model = model.polished(seen, sigma, penalty, iterations).searched(seen, sigma, generator)
    return model


def _fitted_to(half: np.ndarray, model: LinearModel, seen: Observations, sigma: float, iterations: int) -> LinearModel:
    """Fit bases to one half of the frames, and the cameras of the other half to these bases."""
    fitted = LinearModel(model.V, model.R[half]).polished(seen[half], sigma, 0.0, iterations)
    R = model.R.clone()
    R[half] = fitted.R
    moments = Moments.of(seen, fitted.V)
    for _ in range(_SETTLING):
        R = moments.best_rotations(moments.posterior(R, sigma))
    return LinearModel(fitted.V, R)


def _doubt(views: list[Tensor], seen: Observations) -> float:
    """Estimate the error of depth: the difference of two models, and their distance from the observed points.

    With too little noise each model follows its own frames; with too much both smooth alike. The image shows how much.
    """
    apart = (seen.completed(views[0]) - seen.completed(views[1])).flatten(1).norm(dim=1).mean()
    off = sum((seen.completed(view) - view).flatten(1).norm(dim=1).mean() for view in views) / len(views)
    return float(torch.hypot(apart, off / 2**0.5))


def _extended(
    shapes: np.ndarray, rotations: np.ndarray, W: np.ndarray, visible: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Extend shapes of some points to all points (F,3,P), as linear functions of the codes of the former.

    Args:
        shapes: (F,3,p) canonical frame, centred on the visible points among them.
        rotations: (F,3,3).
        W: (F,2,P) of all points.
        visible: (F,P) of all points.
        points: (p,) numbers of the points that have shapes.
    """
    frames, _, total = W.shape
    shown = visible[:, None, points]
    centre = np.where(shown, W[:, :, points], 0.0).sum(2, keepdims=True) / shown.sum(2, keepdims=True)
    codes = _codes(shapes.reshape(frames, -1))
    size = 3 * codes.shape[1]
    D = (codes[:, None, :, None] * rotations[:, :2, None, :]).reshape(frames, 2, size)
    products = (D.transpose(0, 2, 1) @ D).reshape(frames, size * size)
    V = np.empty((total, size))
    for begin in range(0, total, _BLOCK):
        block = slice(begin, begin + _BLOCK)
        mask = visible[:, block].astype(float)
        image = np.where(mask[:, None], W[:, :, block] - centre, 0.0)
        left = (mask.T @ products).reshape(-1, size, size) + _EXTENSION_RIDGE * np.eye(size)
        right = D.reshape(2 * frames, size).T @ image.reshape(2 * frames, -1)
        V[block] = np.linalg.solve(left, right.T[..., None])[..., 0]
    return centred_on_visible(np.einsum("fk,pki->fip", codes, V.reshape(total, -1, 3), optimize=True), visible)


def _codes(shapes: np.ndarray) -> np.ndarray:
    """Return principal codes (1, c) (F,K+1), of unit variance, of flattened shapes (F,N)."""
    frames = len(shapes)
    U, size, _ = np.linalg.svd(shapes - shapes.mean(0), full_matrices=False)
    kept = size[: _BASES[-1]] > 1e-6 * max(size[0], 1e-12)
    return np.concatenate([np.ones((frames, 1)), U[:, : len(kept)][:, kept] * frames**0.5], axis=1)
