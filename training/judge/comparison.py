# SPDX-License-Identifier: Apache-2.0
"""Errors of a prediction and its rigid baseline against the truth of the same frames. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from paul_ros import metrics
from training.errors import DataError
from training.judge.prediction import MIN_POINTS, Prediction, blocks, centred
from training.judge.truth import Sequence


@dataclass(frozen=True)
class Comparison:
    """The frames that are judged: M of F, which have a prediction, a baseline and a truth.

    Attributes:
        truth: of all F frames.
        rows: (M,) numbers of the judged frames.
        found: prediction of all F frames.
        rigid: baseline of all F frames.
        mirrored: whether N-MPJPE, PA-MPJPE and pictures use the depth-flipped shapes, of all frames alike.
    """

    truth: Sequence
    rows: np.ndarray
    found: Prediction
    rigid: Prediction
    mirrored: bool

    @classmethod
    def of(cls, truth: Sequence, found: Prediction, rigid: Prediction, flip: bool) -> Comparison:
        """Compare a prediction and a baseline with the truth.

        Args:
            truth: of all frames.
            found: prediction of all frames.
            rigid: baseline of all frames.
            flip: whether the chirality of the whole set is unknown, so that the better mirror image counts.

        Raises:
            DataError: no frame can be judged.
        """
        usable = (found.dropped == "") & (rigid.dropped == "") & (truth.present.sum(1) >= MIN_POINTS)
        rows = np.flatnonzero(usable)
        if not len(rows):
            raise DataError(
                f"no frame of '{truth.name}' has {MIN_POINTS} visible points and their truth: use other frames"
            )
        plain, flipped = errors_of_signs(found.S, truth, rows).mean(0)
        return cls(truth, rows, found, rigid, bool(flip and flipped < plain))


def errors_of_signs(S: np.ndarray, truth: Sequence, rows: np.ndarray) -> np.ndarray:
    """Return normalised errors (M,2) of shapes (F,3,P), as they are and depth-flipped, for the frames ``rows`` (M,)."""
    return np.concatenate([metrics.normalised_error_of_signs(*pair(S, truth, part)) for part in blocks(rows)])


def pair(S: np.ndarray, truth: Sequence, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return predicted and true points (M,P,3) of some frames; points without truth are at the mean of the others."""
    present = truth.present[rows]
    predicted, true = (metrics.fill_absent(some[rows].transpose(0, 2, 1), present) for some in (S, truth.S))
    return predicted, true


def errors(compared: Comparison, prediction: Prediction) -> dict[str, Any]:
    """Return every error measure under its exact name: means over the judged frames, hidden points included.

    Distances end in ``_mm`` if the truth is in metres, otherwise in ``_units`` (of W).  The errors of visible and of
    hidden points alone are None if no point is hidden.
    """
    parts = [_frame_errors(compared, prediction, rows) for rows in blocks(compared.rows)]
    found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    signs = found["signs"]
    factor, unit = (1000.0, "mm") if compared.truth.metres else (1.0, "units")
    some_hidden = bool(np.isfinite(found["hidden"]).any())
    return {
        "ne_flip_frame_percent": float(100 * signs.min(1).mean()),
        "ne_flip_global_percent": float(100 * signs.mean(0).min()),
        "ne_o3_percent": float(100 * found["o3"].mean()),
        f"mpjpe_flip_frame_{unit}": float(factor * found["mpjpe"].mean()),
        f"n_mpjpe_{unit}": float(factor * found["n_mpjpe"].mean()),
        f"pa_mpjpe_{unit}": float(factor * found["pa_mpjpe"].mean()),
        "flipped_share": metrics.flipped_share(signs),
        "ne_visible_percent": float(100 * np.nanmean(found["visible"])) if some_hidden else None,
        "ne_hidden_percent": float(100 * np.nanmean(found["hidden"])) if some_hidden else None,
        "reprojection_median_percent": float(100 * np.median(found["reprojection"])),
    }


def _frame_errors(compared: Comparison, prediction: Prediction, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the errors of some frames: (M,) each, ``signs`` (M,2)."""
    truth = compared.truth
    predicted, true = pair(prediction.S, truth, rows)
    present, visible = truth.present[rows], truth.visible[rows]
    share, flipped = present.mean(1), metrics.flip_depth(predicted)
    one_sign = flipped if compared.mirrored else predicted
    signs = metrics.normalised_error_of_signs(predicted, true)
    best = np.where((signs[:, 1] < signs[:, 0])[:, None, None], flipped, predicted)
    return {
        "signs": signs,
        "o3": metrics.normalised_error_o3(predicted, true),
        "mpjpe": metrics.mpjpe_flip_frame(predicted, true) / share,
        "n_mpjpe": metrics.n_mpjpe(one_sign, true) / share,
        "pa_mpjpe": metrics.pa_mpjpe(one_sign, true) / share,
        "visible": _part_error(best, true, present, visible),
        "hidden": _part_error(best, true, present, ~visible),
        "reprojection": _reprojection(prediction.S[rows, :2], truth.W[rows], visible),
    }


def _part_error(predicted: np.ndarray, true: np.ndarray, present: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the rms distance (M,) of some points (M,P) of the centred shapes, over the rms size of the whole truth.

    It is the NE that a frame would have if all points were as far off as these; NaN for frames without such points.
    """
    predicted, true = (points - points.mean(1, keepdims=True) for points in (predicted, true))
    part = part & present
    square = np.where(part, ((predicted - true) ** 2).sum(2), 0.0).sum(1)
    size = (true**2).sum((1, 2)) / present.sum(1)
    count = part.sum(1)
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1) / size), np.nan)


def _reprojection(xy: np.ndarray, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the rms distance (M,) between predicted and observed visible points (M,2,P), over their rms extent."""
    seen = visible[:, None]
    W = np.where(seen, centred(W, visible), 0.0)
    off = np.where(seen, centred(xy, visible) - W, 0.0)
    return np.sqrt((off**2).sum((1, 2)) / np.maximum((W**2).sum((1, 2)), np.finfo(float).tiny))
