# SPDX-License-Identifier: Apache-2.0
"""Errors of lifted persons against the ground truth, kept as a few numbers for each person."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from paul_ros import metrics
from paul_ros.lifted import Lifted

#: Keys of a report that hold errors; its baseline has the same.
ERROR_KEYS = (
    "n_mpjpe_mm",
    "pa_mpjpe_mm",
    "ne_flip_frame_percent",
    "ne_flip_global_percent",
    "root_error_median_mm",
    "root_error_median_percent",
)

#: Least number of points with a ground truth for a person to be judged: three fit nearly any shape.
MIN_TRUTH_POINTS = 4

_MM = 1000.0
_MIN_TRUTH_EXTENT = 1e-6  # metres; a ground truth with all points in one place is missing

Pairs = Sequence[tuple[Lifted, np.ndarray]]
"""(Lifted of N persons, their ground truth (N,P,3) in metres) of several frames."""


@dataclass(frozen=True)
class Matched:
    """M lifted persons beside their ground truth.

    Attributes:
        predicted: (M,P,3). A point without a ground truth holds the mean of the person's other points, so that it
            moves no centre and has no error.
        truth: (M,P,3) metres, filled in the same way.
        present: (M,P) bool, the points that have a ground truth.
        metric: (M,) bool, the persons that were lifted in metres.
    """

    predicted: np.ndarray
    truth: np.ndarray
    present: np.ndarray
    metric: np.ndarray

    def distances(self, measure: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """Return (M,) values of a measure that is a mean over points, taken over the points with a ground truth."""
        return measure(self.predicted, self.truth) / self.present.mean(axis=1)


def match_truth(pairs: Pairs) -> Matched:
    """Return all lifted persons with MIN_TRUTH_POINTS true points or more that are not all in one place."""
    # Before the first person is seen, the layout may be unknown, and frames have another number of points.
    pairs = [(lifted, truth) for lifted, truth in pairs if len(truth) == len(lifted.points) and lifted.ok.any()]
    if not pairs:
        return Matched(np.zeros((0, 1, 3)), np.zeros((0, 1, 3)), np.zeros((0, 1), bool), np.zeros(0, bool))
    truth = np.concatenate([truth for _, truth in pairs])
    present = np.isfinite(truth).all(axis=2)
    usable = np.concatenate([lifted.ok for lifted, _ in pairs]) & (present.sum(axis=1) >= MIN_TRUTH_POINTS)
    predicted = np.concatenate([lifted.points for lifted, _ in pairs])[usable]
    metric = np.concatenate([np.full(len(lifted.ok), lifted.units == "m") for lifted, _ in pairs])[usable]
    present = present[usable]
    predicted, truth = metrics.fill_absent(predicted, present), metrics.fill_absent(truth[usable], present)
    sized = np.ptp(truth, axis=1).max(axis=1) > _MIN_TRUTH_EXTENT
    return Matched(predicted[sized], truth[sized], present[sized], metric[sized])


class TruthErrors:
    """Errors of the persons of a whole bag.

    Errors in mm after scaling are of all persons. Errors that need metres are of the persons that were lifted in
    metres.
    """

    def __init__(self) -> None:
        self._n_mpjpe, self._pa_mpjpe = array("d"), array("d")
        self._signs = array("d")  # NE as it is, and with its depth flipped, in turn
        self._root, self._root_share = array("d"), array("d")
        self._points = self._points_present = 0

    @property
    def persons(self) -> int:
        """Number of persons with a ground truth."""
        return len(self._n_mpjpe)

    def add(self, pairs: Pairs, root: Sequence[int]) -> None:
        """Take persons of several frames.

        Args:
            pairs: lifted persons beside their ground truth.
            root: indices of the points whose mean is the root.
        """
        both = match_truth(pairs)
        if not len(both.truth):
            return
        self._points += both.present.size
        self._points_present += int(both.present.sum())
        self._n_mpjpe.extend(both.distances(metrics.n_mpjpe).tolist())
        self._pa_mpjpe.extend(both.distances(metrics.pa_mpjpe).tolist())
        predicted, truth, present = both.predicted[both.metric], both.truth[both.metric], both.present[both.metric]
        self._signs.extend(metrics.normalised_error_of_signs(predicted, truth).ravel().tolist())
        placed = present[:, list(root)].all(axis=1)
        true_root = truth[placed][:, list(root)].mean(1)
        error = np.linalg.norm(predicted[placed][:, list(root)].mean(1) - true_root, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):  # a truth without position has its root in the camera
            share = error / np.linalg.norm(true_root, axis=1)
        self._root.extend(error.tolist())
        self._root_share.extend(share.tolist())

    def report(self) -> dict:
        """Return the errors, with the keys that `judge.evaluate` explains; None where there are no persons."""
        found: dict = {
            "persons_with_truth": self.persons,
            "persons_with_truth_in_metres": len(self._signs) // 2,
            "points_with_truth_share": self._points_present / self._points if self._points else None,
            **dict.fromkeys(ERROR_KEYS),
        }
        if self._n_mpjpe:
            found["n_mpjpe_mm"] = number(_MM * np.mean(self._n_mpjpe))
            found["pa_mpjpe_mm"] = number(_MM * np.mean(self._pa_mpjpe))
        if self._signs:
            signs = np.array(self._signs).reshape(-1, 2)
            found["ne_flip_frame_percent"] = number(100 * signs.min(1).mean())
            found["ne_flip_global_percent"] = number(100 * signs[:, signs.mean(0).argmin()].mean())
        if self._root:
            found["root_error_median_mm"] = number(_MM * np.median(self._root))
            found["root_error_median_percent"] = number(100 * np.median(self._root_share))
        return found


def number(value: float) -> float | None:
    """Return a Python float; None for NaN, which JSON lacks."""
    return float(value) if np.isfinite(value) else None
