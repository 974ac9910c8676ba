# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark onp`: orthographic-N-point solvers compared, in the manner of PoseLib's benchmark.

Every method solves the same random problems; a search that shares nothing with ``paul_ros.onp`` says what the optimum
is. All residuals are computed here from the poses, whatever a method says of its own.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from paul_ros import __version__
from paul_ros.benchmarks import rivals
from paul_ros.benchmarks.naive import naive_optimum
from paul_ros.model_file import load_model
from paul_ros.orthographic_n_point import onp

METHODS: dict[str, Callable] = {
    "ours": onp,
    "lsq_svd": rivals.lsq_svd,
    "polar": rivals.polar,
    "majorise": rivals.majorise,
    "lm_search": rivals.lm_search,
}
TOLERANCE = 1e-9
"""Of the image's mean square: a mean of squared distances that is larger by more is worse."""
LM_CASES = 200
"""``lm_search`` takes milliseconds, so it solves only the first cases of a scenario."""

_BLOCK = 1000  # cases solved at a time
_EXACT = 1e-6  # of the image's rms size: residuals below count as this, for ratios of rounding errors mean nothing
_SINGLES = 24
_REPEATS = 8
_LONG_ENOUGH = 1e-3  # seconds to measure: calls shorter than this are repeated for so long
_SLOW_SINGLE, _SLOW_BATCH = 1e-3, 0.1  # seconds: calls longer than this are measured twice only
_POSE_VARIETY = 0.6


@dataclass(frozen=True)
class Scenario:
    """A kind of random problem.

    Attributes:
        name: of the kind; ``title`` has the scale mode too.
        scale: ``"free"`` draws camera scales over six decades, ``"unit"`` has scale 1.
        points: how many, normally distributed.
        noise: standard deviation of each image coordinate, over that of a shape coordinate (rms radius / sqrt 3).
        thickness: of the shape along its third axis, over the others.
        hidden: share of the points that are hidden.
        weighted: visible points have random weights from 0.1 to 1.
        human: 17 points of the shipped model's human poses.
        shape_noise: what the shape given to a solver is off by, in the unit of ``noise``. The image is of the true one.
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
    """N problems: shapes S (N,3,P) as a solver is given them, image points W (N,2,P), weights (N,P) or None for ones.

    ``truth`` (N,3,P) are the true points in the camera frame, in image units; hidden ones too.
    """

    S: np.ndarray
    W: np.ndarray
    weights: np.ndarray | None
    truth: np.ndarray


def problems(scenario: Scenario, count: int, rng: np.random.Generator) -> Problems:
    """Random problems of a kind; the image coordinates of hidden points are far off."""
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
    W = np.where(weights[:, None] > 0, W, truth[:, :2] + 10 * zoom * spread * rng.standard_normal((count, 2, P)))
    if scenario.weighted:
        weights *= rng.uniform(0.1, 1, weights.shape)
    return Problems(S, W, weights, truth)


def _normal_points(scenario: Scenario, count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.standard_normal((count, 3, scenario.points)) * np.array([1.0, 1.0, scenario.thickness])[:, None]


def _human_poses(count: int, rng: np.random.Generator) -> np.ndarray:
    """(N,3,17) what the shipped model makes of noisy views of its mean shape: bodies in all sorts of poses."""
    model = _model()
    mean = model.mean_shape.astype(float)
    views = (_random_rotations(count, rng) @ mean)[:, :2]
    views += _POSE_VARIETY * mean.std() * rng.standard_normal(views.shape)
    return model.shape(views, np.ones((count, mean.shape[1]), bool)).astype(float)


_model = lru_cache(maxsize=1)(load_model)


def _random_rotations(count: int, rng: np.random.Generator) -> np.ndarray:
    """Uniform: a normal matrix' orthogonal factor, its signs made those of the matrix, then its determinant 1."""
    Q, R = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    Q = Q * np.sign(np.diagonal(R, axis1=1, axis2=2))[:, None]
    return Q * np.linalg.det(Q)[:, None, None]


# --- judging poses


def _mean_square(found: Any, given: Problems) -> np.ndarray:
    """(N,) weighted mean of the squared distances that poses leave."""
    camera = found.scale[:, None, None] * found.R[:, :2]
    return _weighted(((camera @ given.S + found.translation[..., None] - given.W) ** 2).sum(1), given)


def _weighted(values: np.ndarray, given: Problems) -> np.ndarray:
    """(N,) weighted means of values (N,P)."""
    return values.mean(1) if given.weights is None else (values * given.weights).sum(1) / given.weights.sum(1)


def _image_square(given: Problems) -> np.ndarray:
    """(N,) weighted mean square of the image points about their weighted mean."""
    x, y = given.W[:, 0], given.W[:, 1]
    return sum(_weighted((part - _weighted(part, given)[:, None]) ** 2, given) for part in (x, y))


def _degrees(R: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N,) angles between rotations."""
    chord = np.sqrt(((R - other) ** 2).sum((1, 2))) / 8**0.5
    return np.degrees(2 * np.arcsin(np.minimum(chord, 1.0)))


def _shape_error(found: Any, given: Problems) -> np.ndarray:
    """(N,) normalised 3D error of the posed shape against the true one, depths about their means; all points."""
    posed = found.scale[:, None, None] * (found.R @ given.S)
    posed[:, :2] += found.translation[..., None]
    error, truth = posed - given.truth, given.truth - given.truth.mean(2, keepdims=True)
    error[:, 2] -= error[:, 2].mean(1, keepdims=True)
    return np.sqrt((error**2).sum((1, 2)) / (truth**2).sum((1, 2)))


def judge(given: Problems, scenario: Scenario, found: dict[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """By method, what is measured of each problem; ``found`` holds poses by method, those of ``ours`` among them."""
    naive = naive_optimum(given.S, given.W, given.weights, scenario.scale)
    image, ours = _image_square(given), found["ours"]
    slack = TOLERANCE * image
    squares = {name: _mean_square(pose, given) for name, pose in found.items()}
    naive_square = _mean_square(naive, given)
    best = np.min([naive_square, *squares.values()], axis=0)
    mirror = rivals.Pose(ours.R_mirror, ours.scale_mirror, ours.translation_mirror, ours.residual_mirror)
    optima = [(pose.R, _mean_square(pose, given) <= best + slack) for pose in (*found.values(), naive, mirror)]
    judged = {}
    for name, pose in found.items():
        # A planar shape has two optima that are equally good, and either will do.
        angles = [np.where(optimal, _degrees(pose.R, R), 180.0) for R, optimal in optima]
        judged[name] = {
            "angle": np.min(angles, axis=0),
            "ratio": np.sqrt(np.maximum(squares[name], _EXACT**2 * image) / np.maximum(best, _EXACT**2 * image)),
            "missed": squares[name] > best + slack,
            "better": squares[name] < squares["ours"] - slack,
        }
        if scenario.shape_noise:
            judged[name]["shape_error"] = _shape_error(pose, given)
    judged["ours"] |= {
        "certified": ours.certified,
        "certified_wrong": ours.certified & (squares["ours"] > naive_square + slack),
        "undetermined": ~ours.determined,
        "naive_missed": naive_square > best + slack,
    }
    return judged


def _blocks(cases: int) -> Iterator[tuple[int, bool]]:
    """Sizes of the blocks, and whether ``lm_search`` solves them too: the first one only."""
    yield min(cases, LM_CASES), True
    for start in range(LM_CASES, cases, _BLOCK):
        yield min(_BLOCK, cases - start), False


def judge_scenario(
    scenario: Scenario,
    cases: int,
    rng: np.random.Generator,
    solver: Callable = onp,
    tick: Callable = lambda count: None,
) -> dict[str, dict[str, np.ndarray]]:
    """``judge`` over so many problems, block by block; ``solver`` stands for ours, ``tick`` hears of cases done."""
    parts: dict[str, list[dict]] = {name: [] for name in METHODS}
    for count, searched in _blocks(cases):
        given = problems(scenario, count, rng)
        methods = {name: method for name, method in METHODS.items() if searched or name != "lm_search"} | {
            "ours": solver
        }
        found = {name: method(*given[:3], scenario.scale) for name, method in methods.items()}
        for name, figures in judge(given, scenario, found).items():
            parts[name].append(figures)
        tick(count)
    return {name: {key: np.concatenate([part[key] for part in of]) for key in of[0]} for name, of in parts.items()}


# --- times


def _seconds(call: Callable[[], Any], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        call()
    return (time.perf_counter() - start) / calls


def _interleaved(calls: dict[str, Callable[[], Any]], slow: float) -> dict[str, float]:
    """Seconds of each call, the best of several: in turns, so that what disturbs the machine disturbs all alike."""
    best = {name: _seconds(call, 1) for name, call in calls.items()}
    for repeat in range(_REPEATS):
        for name, call in calls.items():
            if repeat == 0 or best[name] < slow:
                best[name] = min(best[name], _seconds(call, max(1, int(_LONG_ENOUGH / best[name]))))
    return best


def times(scenario: Scenario, batch: int, rng: np.random.Generator) -> dict[str, dict[str, float | None]]:
    """By method: microseconds of one problem, the median over several, and a problem in a batch."""

    def solving(given: Problems, rows: slice, names: Any) -> dict[str, Callable[[], Any]]:
        part = [None if array is None else array[rows] for array in given[:3]]
        return {name: lambda method=METHODS[name]: method(*part, scenario.scale) for name in names}

    given = problems(scenario, max(batch, _SINGLES), rng)
    singles = [_interleaved(solving(given, slice(i, i + 1), METHODS), _SLOW_SINGLE) for i in range(_SINGLES)]
    batched = _interleaved(solving(given, slice(batch), [name for name in METHODS if name != "lm_search"]), _SLOW_BATCH)
    return {
        name: {
            "us_single": 1e6 * float(np.median([single[name] for single in singles])),
            "us_batch": 1e6 * batched[name] / batch if name in batched else None,
        }
        for name in METHODS
    }


# --- the report


def run(cases: int, batch: int, seed: int) -> dict:
    """The whole benchmark as one object for JSON; a progress bar on stderr where someone is watching.

    The caller sees to it that scipy and tqdm are there.
    """
    from tqdm import tqdm

    scenarios = (*SCENARIOS, *SHAPE_SCENARIOS)
    rows = []
    with tqdm(total=len(scenarios) * cases, unit=" cases", disable=None, dynamic_ncols=True) as bar:
        for index, scenario in enumerate(scenarios):
            bar.set_description(scenario.title)
            judged = judge_scenario(scenario, cases, np.random.default_rng([seed, index]), tick=bar.update)
            timed = times(scenario, batch, np.random.default_rng([seed, index, 1])) if scenario in SCENARIOS else {}
            rows += [_row(scenario, name, figures, timed.get(name, {})) for name, figures in judged.items()]
    versions = {name: version(name) for name in ("numpy", "scipy")}
    return {
        "benchmark": "onp",
        "versions": {"paul_ros": __version__, "python": platform.python_version(), **versions},
        "settings": {"cases": cases, "batch": batch, "seed": seed, "tolerance": TOLERANCE, "lm_cases": LM_CASES},
        "summary": _summary(rows),
        "rows": rows,
    }


def _row(scenario: Scenario, method: str, figures: dict[str, np.ndarray], timed: dict[str, float | None]) -> dict:
    """One row of the report; None where there is no such figure."""
    angle, ratio = figures["angle"], figures["ratio"]
    certified, error = figures.get("certified"), figures.get("shape_error")
    return {
        "scenario": scenario.title,
        "scale": scenario.scale,
        "method": method,
        "cases": len(angle),
        "certified_share": None if certified is None else float(certified.mean()),
        "certified_wrong": _count(figures, "certified_wrong"),
        "undetermined": _count(figures, "undetermined"),
        "angle_median_deg": float(np.median(angle)),
        "angle_p95_deg": float(np.percentile(angle, 95)),
        "residual_ratio_median": float(np.median(ratio)),
        "residual_ratio_max": float(ratio.max()),
        "missed": _count(figures, "missed"),
        "naive_missed": _count(figures, "naive_missed"),
        "better_than_ours": None if method == "ours" else _count(figures, "better"),
        "us_single": timed.get("us_single"),
        "us_batch": timed.get("us_batch"),
        "ne_percent": None if error is None else 100 * float(error.mean()),
        "ne_percent_first": None if error is None else 100 * float(error[:LM_CASES].mean()),
    }


def _count(figures: dict[str, np.ndarray], key: str) -> int | None:
    return int(figures[key].sum()) if key in figures else None


def _summary(rows: list[dict]) -> dict:
    """What the table comes down to, over all scenarios."""
    ours = [row for row in rows if row["method"] == "ours"]
    cases = sum(row["cases"] for row in ours)
    return {
        "cases": cases,
        "certified_share": sum(row["certified_share"] * row["cases"] for row in ours) / cases,
        "certified_share_least": min(row["certified_share"] for row in ours),
        "certified_wrong": sum(row["certified_wrong"] for row in ours),
        "missed": sum(row["missed"] for row in ours),
        "naive_missed": sum(row["naive_missed"] for row in ours),
        "residual_ratio_max": max(row["residual_ratio_max"] for row in ours),
        "better_than_ours": sum(row["better_than_ours"] for row in rows if row["method"] != "ours"),
        **{f"{key}_over_lsq": _over_lsq(rows, key) for key in ("us_single", "us_batch")},
    }


def _over_lsq(rows: list[dict], key: str) -> list[float]:
    """Least, median and largest of our times over those of ``lsq_svd``, scenario by scenario."""
    ours, lsq = ([row[key] for row in rows if row["method"] == name and row[key]] for name in ("ours", "lsq_svd"))
    return [float(f(np.divide(ours, lsq))) for f in (np.min, np.median, np.max)]
