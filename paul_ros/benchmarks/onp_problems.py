# SPDX-License-Identifier: Apache-2.0
"""Random orthographic-N-point problems of several kinds, for `paul benchmark onp`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from paul_ros.model import Model
from paul_ros.model_file import load_model

_POSE_VARIETY = 0.6  # noise of the views that human poses are made from, over the shape's standard deviation
_HIDDEN_NOISE = 10.0  # standard deviation of hidden image points, over that of a shape coordinate


@dataclass(frozen=True)
class Scenario:
    """A kind of random problem.

    Attributes:
        name: name of the kind; `title` has the scale mode too.
        scale: 'free' draws camera scales over six decades, 'unit' has scale 1.
        points: number of points, normally distributed.
        noise: standard deviation of each image coordinate, over that of a shape coordinate (rms radius / sqrt 3).
        thickness: extent of the shape along its third axis, over that of the others.
        hidden: share of the points that are hidden.
        weighted: visible points have random weights from 0.1 to 1.
        human: the shapes are 17 points of the shipped model's human poses.
        shape_noise: error of the shape that a solver is given, in the unit of `noise`. The image shows the true shape.
    """

    name: str
    scale: str
    points: int = 17
    noise: float = 0.3
    thickness: float = 1.0
    hidden: float = 0.0
    weighted: bool = False
    human: bool = False
    shape_noise: float = 0.0

    @property
    def title(self) -> str:
        """Name of the kind with its scale mode."""
        return f"{self.name}, {self.scale} scale"


def _in_both(name: str, **kind: Any) -> list[Scenario]:
    return [Scenario(name, scale, **kind) for scale in ("unit", "free")]


SCENARIOS = (
    Scenario("17 points, exact", "free", noise=0.0),
    Scenario("17 points, 10 % noise", "free", noise=0.1),
    *_in_both("17 points, 30 % noise"),
    *_in_both("6 points, 30 % noise", points=6),
    *_in_both("4 points, 30 % noise", points=4),
    Scenario("100 points, 30 % noise", "free", points=100),
    *_in_both("near-planar (5 %), 30 % noise", thickness=0.05),
    *_in_both("planar, 30 % noise", thickness=0.0),
    *_in_both("half hidden, weighted, 30 % noise", hidden=0.5, weighted=True),
    *_in_both("human poses, 10 % noise", human=True, noise=0.1),
)
SHAPE_SCENARIOS = tuple(
    Scenario(f"20 % shape noise, {hidden} % hidden", scale, noise=0, human=True, hidden=hidden / 100, shape_noise=0.2)
    for scale in ("unit", "free")
    for hidden in (0, 30, 60)
)


class Problems(NamedTuple):
    """N problems with P points.

    Attributes:
        S: (N,3,P) shapes as a solver is given them.
        W: (N,2,P) image points.
        weights: (N,P), 0 = hidden; None = all are 1.
        truth: (N,3,P) true points in the camera frame, in image units, hidden ones included.
    """

    S: np.ndarray
    W: np.ndarray
    weights: np.ndarray | None
    truth: np.ndarray


def problems(scenario: Scenario, count: int, rng: np.random.Generator) -> Problems:
    """Return random problems of a kind; the image coordinates of hidden points are far from the truth."""
    true = _human_poses(count, rng) if scenario.human else _normal_points(scenario, count, rng)
    P = true.shape[2]
    spread = true.std(axis=2, keepdims=True)
    spread = np.sqrt((spread**2).mean(axis=1, keepdims=True))
    zoom = 10 ** rng.uniform(-3, 3, (count, 1, 1)) if scenario.scale == "free" else np.ones((count, 1, 1))
    shift = spread * rng.normal(0, 3, (count, 3, 1))
    truth = zoom * (_random_rotations(count, rng) @ true + shift)
    W = truth[:, :2] + scenario.noise * zoom * spread * rng.standard_normal((count, 2, P))
    S = true + scenario.shape_noise * spread * rng.standard_normal((count, 3, P))
    if not (scenario.hidden or scenario.weighted):
        return Problems(S, W, None, truth)
    order = rng.random((count, P)).argsort(axis=1)
    weights = (order >= round(scenario.hidden * P)).astype(float)
    W = np.where(
        weights[:, None] > 0, W, truth[:, :2] + _HIDDEN_NOISE * zoom * spread * rng.standard_normal((count, 2, P))
    )
    if scenario.weighted:
        weights *= rng.uniform(0.1, 1, weights.shape)
    return Problems(S, W, weights, truth)


def _normal_points(scenario: Scenario, count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.standard_normal((count, 3, scenario.points)) * np.array([1.0, 1.0, scenario.thickness])[:, None]


@lru_cache(maxsize=1)
def _human_model() -> Model:
    return load_model()


def _human_poses(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return bodies (N,3,17) in varied poses: shapes that the shipped model gives for noisy views of its mean shape."""
    model = _human_model()
    mean = model.mean_shape.astype(float)
    views = (_random_rotations(count, rng) @ mean)[:, :2]
    views += _POSE_VARIETY * mean.std() * rng.standard_normal(views.shape)
    return model.shape(views, np.ones((count, mean.shape[1]), bool)).astype(float)


def _random_rotations(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return uniform rotations (N,3,3): the orthogonal factors of normal matrices, with the signs of R and det +1."""
    Q, R = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    Q = Q * np.sign(np.diagonal(R, axis1=1, axis2=2))[:, None]
    return Q * np.linalg.det(Q)[:, None, None]
