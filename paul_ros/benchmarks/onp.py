# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark onp`: orthographic-N-point solvers compared, in the manner of PoseLib's benchmark.

Every method solves the same random problems. A search that shares nothing with `paul_ros.onp` finds the optimum. All
residuals are computed here from the poses; the residuals that the methods report are ignored.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np

from paul_ros.benchmarks import rivals
from paul_ros.benchmarks.naive import naive_optimum
from paul_ros.benchmarks.onp_problems import SCENARIOS, SHAPE_SCENARIOS, Problems, Scenario, problems
from paul_ros.extras import require
from paul_ros.orthographic_n_point import onp
from paul_ros.versions import versions

METHODS: dict[str, Callable] = {
    "ours": onp,
    "lsq_svd": rivals.lsq_svd,
    "polar": rivals.polar,
    "majorise": rivals.majorise,
    "lm_search": rivals.lm_search,
}

#: Largest excess of an optimal mean squared distance over the best known, as a share of the image's mean square.
TOLERANCE = 1e-9

#: Number of cases of a scenario that `lm_search` solves, as it takes milliseconds each.
LM_CASES = 200

_BLOCK = 1000  # cases solved at a time
_EXACT = 1e-6  # of the image's rms size: smaller residuals count as this, as ratios of rounding errors mean nothing
_SINGLES = 24  # problems that are timed alone
_REPEATS = 8  # measurements of each call, of which the fastest counts
_MIN_SECONDS = 1e-3  # of a measurement: faster calls are repeated
_SLOW_SINGLE, _SLOW_BATCH = 1e-3, 0.1  # seconds: slower calls are measured only twice


# --- judging poses


def _mean_square(found: Any, given: Problems) -> np.ndarray:
    """Return the weighted mean squared distances (N,) of poses."""
    camera = found.scale[:, None, None] * found.R[:, :2]
    return _weighted(((camera @ given.S + found.translation[..., None] - given.W) ** 2).sum(1), given)


def _weighted(values: np.ndarray, given: Problems) -> np.ndarray:
    """Return weighted means (N,) of values (N,P)."""
    return values.mean(1) if given.weights is None else (values * given.weights).sum(1) / given.weights.sum(1)


def _image_square(given: Problems) -> np.ndarray:
    """Return the weighted mean squares (N,) of the image points about their weighted means."""
    x, y = (_weighted((part - _weighted(part, given)[:, None]) ** 2, given) for part in given.W.swapaxes(0, 1))
    return x + y


def _degrees(R: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles (N,) between rotations (N,3,3) in degrees."""
    chord = np.sqrt(((R - other) ** 2).sum((1, 2))) / 8**0.5
    return np.degrees(2 * np.arcsin(np.minimum(chord, 1.0)))


def _shape_error(found: Any, given: Problems) -> np.ndarray:
    """Return the normalised 3D errors (N,) of posed shapes over all points, depths taken about their means."""
    posed = found.scale[:, None, None] * (found.R @ given.S)
    posed[:, :2] += found.translation[..., None]
    error, truth = posed - given.truth, given.truth - given.truth.mean(2, keepdims=True)
    error[:, 2] -= error[:, 2].mean(1, keepdims=True)
    return np.sqrt((error**2).sum((1, 2)) / (truth**2).sum((1, 2)))


def judge(given: Problems, scenario: Scenario, found: dict[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """Measure the poses of several methods against the best known optimum.

    Args:
        given: N problems.
        scenario: their kind.
        found: method -> its poses; 'ours' must be among them.

    Returns:
        Method -> measure -> (N,) values: angle (degrees to the nearest optimum), ratio (residual over the best known),
        missed, better (than ours); and for ours certified, certified_wrong, undetermined, naive_missed (all bool).
    """
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
        # A planar shape has two equally good optima; the nearer one counts.
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
    """Yield the sizes of the blocks, and whether `lm_search` solves them too, which is so for the first one only."""
    yield min(cases, LM_CASES), True
    for start in range(LM_CASES, cases, _BLOCK):
        yield min(_BLOCK, cases - start), False


def judge_scenario(
    scenario: Scenario,
    cases: int,
    rng: np.random.Generator,
    solver: Callable = onp,
    tick: Callable[[int], Any] = lambda count: None,
) -> dict[str, dict[str, np.ndarray]]:
    """Judge many problems of a scenario block by block.

    Args:
        scenario: the kind of problems.
        cases: number of problems.
        rng: source of the problems.
        solver: the solver measured as 'ours'.
        tick: called with the number of cases done.

    Returns:
        As `judge`; for `lm_search` of the first LM_CASES problems only.
    """
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
    """Return the seconds of each call, the best of several, in turns so that a disturbance of the machine hits all."""
    best = {name: _seconds(call, 1) for name, call in calls.items()}
    for repeat in range(_REPEATS):
        for name, call in calls.items():
            if repeat == 0 or best[name] < slow:
                best[name] = min(best[name], _seconds(call, max(1, int(_MIN_SECONDS / best[name]))))
    return best


def times(scenario: Scenario, batch: int, rng: np.random.Generator) -> dict[str, dict[str, float | None]]:
    """Return method -> microseconds a problem: alone (us_single, median of several) and in a batch (us_batch)."""

    def solving(given: Problems, rows: slice, names: Iterable[str]) -> dict[str, Callable[[], Any]]:
        part = [None if array is None else array[rows] for array in given[:3]]
        return {name: partial(METHODS[name], *part, scenario.scale) for name in names}

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
    """Run the whole benchmark, with a progress bar if stderr is a terminal.

    Args:
        cases: problems of each scenario.
        batch: problems in one call where a batch is timed.
        seed: seed of the problems.

    Returns:
        The report, ready for JSON: `rows`, one for each scenario and method, and their `summary`.

    Raises:
        MissingPackageError: scipy or tqdm is not installed.
    """
    require("benchmark", "scipy", "tqdm")
    from tqdm import tqdm

    scenarios = (*SCENARIOS, *SHAPE_SCENARIOS)
    rows = []
    with tqdm(total=len(scenarios) * cases, unit=" cases", disable=None, dynamic_ncols=True) as bar:
        for index, scenario in enumerate(scenarios):
            bar.set_description(scenario.title)
            judged = judge_scenario(scenario, cases, np.random.default_rng([seed, index]), tick=bar.update)
            timed = times(scenario, batch, np.random.default_rng([seed, index, 1])) if scenario in SCENARIOS else {}
            rows += [_row(scenario, name, figures, timed.get(name, {})) for name, figures in judged.items()]
    return {
        "benchmark": "onp",
        "versions": versions("scipy"),
        "settings": {"cases": cases, "batch": batch, "seed": seed, "tolerance": TOLERANCE, "lm_cases": LM_CASES},
        "summary": _summary(rows),
        "rows": rows,
    }


def _row(scenario: Scenario, method: str, figures: dict[str, np.ndarray], timed: dict[str, float | None]) -> dict:
    """Return one row of the report; None where a method has no such figure."""
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
    """Return totals and extremes over all scenarios."""
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
    """Return least, median and largest ratio of our times to those of `lsq_svd`, one ratio a scenario."""
    ours, lsq = ([row[key] for row in rows if row["method"] == name and row[key]] for name in ("ours", "lsq_svd"))
    return [float(f(np.divide(ours, lsq))) for f in (np.min, np.median, np.max)]
