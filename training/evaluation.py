# SPDX-License-Identifier: Apache-2.0
"""`paul evaluate`: unseen data lifted frame by frame, or a saved reconstruction, judged against the truth.

Needs numpy only, for a model: the forward pass is the robot's. Frames are judged alone and in any order.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from paul_ros import metrics
from paul_ros.lifter import AMBIGUOUS, DEGENERATE_POINTS, TOO_FEW_POINTS
from paul_ros.model import Model, load_model
from paul_ros.onp import onp
from paul_ros.replay import versions
from training.categories import among_categories
from training.data import DataError
from training.truth import Sequence, load_sequence

ERRORS = (DataError,)
"""What a user can cause and mend; the text of each is one clear line."""

LEAST_VISIBLE = 4
"""Visible points that a frame must have: three fit nearly any shape."""

_BLOCK = 256  # frames at a time
_SINGLES = 100  # frames lifted alone, for the time of one
_MEAN_ROUNDS = 10

Progress = Callable[[int], None]
"""Called with the number of frames done since the last call."""


@dataclass(frozen=True)
class Prediction:
    """3D of F frames.

    Attributes:
        S: (F,3,P) camera frame, in units of W, centred on the mean of the visible points.
        dropped: F slugs, '' where there is a prediction, else why not.
        certified: (F,) the camera is the proven optimum; None where no camera was solved.
        ambiguity: (F,) 0..1, see ``paul_ros.onp``; None where no camera was solved.
    """

    S: np.ndarray
    dropped: np.ndarray
    certified: np.ndarray | None = None
    ambiguity: np.ndarray | None = None


def predict(model: Model, W: np.ndarray, visible: np.ndarray, progress: Progress = lambda count: None) -> Prediction:
    """Single-frame prediction (the paper's section 4.2): h, f_d, and orthographic-N-point to the camera frame.

    The result has the observed scale: a model of unit scale knows it, else it is the camera's, which is the image's
    own unit and so, under an orthographic camera, that of the truth. Visible points are where the model has them, not
    moved to where they were seen.

    Args:
        W: (F,2,P) image points, any unit (the training's for a model of unit scale).
        visible: (F,P) bool.
    """
    unit = model.header["image_unit"] if model.scale == "unit" else 1.0
    S, dropped = np.zeros((len(W), 3, W.shape[2])), np.full(len(W), "", object)
    certified, ambiguity = np.zeros(len(W), bool), np.zeros(len(W))
    for begin in range(0, len(W), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        shapes = model.shape(W[rows], visible[rows]).astype(float)
        pose = onp(shapes, W[rows] / unit, visible[rows], model.scale)
        S[rows] = unit * pose.scale[:, None, None] * centred(pose.R @ shapes, visible[rows])
        dropped[rows] = np.where(pose.determined, "", DEGENERATE_POINTS)
        certified[rows], ambiguity[rows] = pose.certified, pose.ambiguity
        progress(len(shapes))
    dropped[visible.sum(1) < LEAST_VISIBLE] = TOO_FEW_POINTS
    return Prediction(S, dropped, certified, ambiguity)


def centred(X: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Points (N,D,P) minus the mean of the visible ones (N,P)."""
    seen = visible[:, None]
    return X - np.where(seen, X, 0.0).sum(2, keepdims=True) / np.maximum(seen.sum(2, keepdims=True), 1)


def evaluate_model(
    model_name: str | Path, data: str | Path, progress: Progress = lambda count: None
) -> tuple[dict, Comparison]:
    """Lift every frame of a file and judge it; gives the report (keys as `paul replay --json`) and what was compared.

    Raises:
        DataError: the file has no truth, or other points than the model.
        ModelError: the model cannot be used.
    """
    model = load_model(model_name)
    truth = among_categories(load_sequence(data), model.layout)
    if len(model.layout.names) != truth.W.shape[2]:
        raise DataError(
            f"'{data}' has {truth.W.shape[2]} points, model '{model_name}' has {len(model.layout.names)}: "
            "evaluate it with data of its own layout"
        )
    found = predict(model, truth.W, truth.visible, progress)
    rigid = predict(model.rigid(), truth.W, truth.visible)
    compared = Comparison.of(truth, found, rigid, flip=not model.header["chirality"]["known"])
    report = _report(compared, model=model.name, model_sha256=model.sha256, layout=model.layout.name)
    return report | _single_times(model, truth), compared


def evaluate_shapes(shapes: str | Path, truth_file: str | Path) -> tuple[dict, Comparison]:
    """Judge a saved reconstruction against the truth of the same frames in the same order.

    Raises:
        DataError: the file has no truth, or the reconstruction is of other frames or points.
    """
    from training.reconstruction import load_reconstruction

    truth, found = load_sequence(truth_file), load_reconstruction(shapes)
    if found.shapes.shape != truth.S.shape:
        raise DataError(
            f"'{shapes}' holds shapes {found.shapes.shape}, the truth in '{truth_file}' is {truth.S.shape}: "
            "name the file that was reconstructed"
        )
    mean = rigid_mean(found.rotations.transpose(0, 2, 1) @ found.shapes)
    compared = Comparison.of(truth, Prediction(found.shapes, _none_dropped(truth)), _rigid(mean, truth), flip=True)
    return _report(compared, shapes=Path(shapes).name, loss=found.loss, seconds=found.seconds), compared


def _none_dropped(truth: Sequence) -> np.ndarray:
    return np.full(len(truth.W), "", object)


def _rigid(mean: np.ndarray, truth: Sequence) -> Prediction:
    """The mean shape (3,P) put before every camera, with its best scale."""
    pose = onp(np.broadcast_to(mean, truth.S.shape), truth.W, truth.visible)
    S = pose.scale[:, None, None] * centred(pose.R @ mean, truth.visible)
    return Prediction(S, np.where(pose.determined, "", DEGENERATE_POINTS).astype(object))


def rigid_mean(shapes: np.ndarray) -> np.ndarray:
    """Generalised Procrustes mean (3,P) of shapes (F,3,P), each of rms size 1."""
    points = shapes.transpose(0, 2, 1)
    points = points - points.mean(1, keepdims=True)
    points = points / np.sqrt((points**2).sum(2).mean(1))[:, None, None]
    mean = points[0]
    for _ in range(_MEAN_ROUNDS):
        R, _ = metrics.procrustes(points, np.broadcast_to(mean, points.shape))
        mean = np.einsum("nij,npj->pi", R, points) / len(points)
    return mean.T


def _single_times(model: Model, truth: Sequence) -> dict:
    """Microseconds of frames lifted alone, evenly chosen."""
    rows = np.linspace(0, len(truth.W) - 1, min(_SINGLES, len(truth.W))).astype(int)
    times = []
    for row in rows:
        begun = time.perf_counter()
        predict(model, truth.W[[row]], truth.visible[[row]])
        times.append(1e6 * (time.perf_counter() - begun))
    return {"lift_us_median": float(np.median(times)), "lift_us_p99": float(np.percentile(times, 99))}


@dataclass(frozen=True)
class Comparison:
    """What was judged: M frames whose prediction, baseline and truth are there.

    Attributes:
        truth: of all F frames.
        rows: (M,) their numbers.
        found, rigid: predictions of all F frames.
        mirrored: the whole set is shown and judged by N-MPJPE and PA-MPJPE with its depth flipped.
    """

    truth: Sequence
    rows: np.ndarray
    found: Prediction
    rigid: Prediction
    mirrored: bool

    @classmethod
    def of(cls, truth: Sequence, found: Prediction, rigid: Prediction, flip: bool) -> Comparison:
        """``flip``: which mirror image the set is was open, so that the better one counts.

        Raises:
            DataError: no frame is left.
        """
        usable = (found.dropped == "") & (rigid.dropped == "") & (truth.present.sum(1) >= LEAST_VISIBLE)
        rows = np.flatnonzero(usable)
        if not len(rows):
            raise DataError(f"no frame of '{truth.name}' has {LEAST_VISIBLE} visible points and their truth")
        predicted, true = _points(found.S, truth, rows), _points(truth.S, truth, rows)
        plain, other = (
            metrics.normalised_error(points, true).mean() for points in (predicted, metrics.flip_depth(predicted))
        )
        return cls(truth, rows, found, rigid, bool(flip and other < plain))

    def points(self, prediction: Prediction | None = None) -> np.ndarray:
        """(M,P,3) of a prediction, or of the truth; points without truth are at the mean of the others."""
        return _points(self.truth.S if prediction is None else prediction.S, self.truth, self.rows)


def _points(S: np.ndarray, truth: Sequence, rows: np.ndarray) -> np.ndarray:
    return metrics.fill_absent(S[rows].transpose(0, 2, 1), truth.present[rows])


def _report(compared: Comparison, **about: object) -> dict:
    """All keys of `paul evaluate --json`. Keys of what does not apply are None: no pixels, no root in the world."""
    truth, found, rows = compared.truth, compared.found, compared.rows
    reasons, counts = np.unique(found.dropped[found.dropped != ""].astype(str), return_counts=True)
    visible = truth.visible[rows]
    return {
        "data": truth.name,
        "frames": len(truth.W),
        "persons": len(truth.W),
        "judged": len(rows),
        "dropped": dict(zip(reasons.tolist(), counts.tolist())),
        "hidden_share": float(1 - visible[truth.present[rows]].mean()),
        "whole_set_mirrored": compared.mirrored,
        "n_mpjpe_mm": None,
        "pa_mpjpe_mm": None,
        **errors(compared, found),
        "root_error_median_mm": None,
        "root_error_median_percent": None,
        "reprojection_median_px": None,
        "reprojection_median_percent": _reprojection(truth, found, rows),
        "certified_share": None if found.certified is None else float(found.certified[rows].mean()),
        "ambiguous_share": None if found.ambiguity is None else float((found.ambiguity[rows] >= AMBIGUOUS).mean()),
        "lift_us_median": None,
        "lift_us_p99": None,
        "baseline": errors(compared, compared.rigid),
        "model": None,
        "bag": None,
        "versions": versions(),
        **about,
    }


def errors(compared: Comparison, prediction: Prediction) -> dict:
    """Every error measure under its exact name, means over the frames; hidden points count in all of them.

    Distances end in ``_mm`` where the truth is in metres, else in ``_units`` (of W). The last two are NE of the visible
    and of the hidden points alone: the rms distance over them as a share of the whole truth's rms size, depth flipped
    as in NE with a flip per frame; None where no point is hidden.
    """
    predicted, true = compared.points(prediction), compared.points()
    rows, metres = compared.rows, compared.truth.metres
    present, visible = compared.truth.present[rows], compared.truth.visible[rows]
    hidden = present & ~visible
    share, factor, unit = present.mean(1), 1000.0 if metres else 1.0, "mm" if metres else "units"
    one_sign = metrics.flip_depth(predicted) if compared.mirrored else predicted

    def mean(values: np.ndarray, factor: float) -> float:
        return float(factor * values.mean())

    return {
        "ne_flip_frame_percent": mean(metrics.normalised_error_flip_frame(predicted, true), 100),
        "ne_flip_global_percent": mean(metrics.normalised_error_flip_global(predicted, true), 100),
        "ne_o3_percent": mean(metrics.normalised_error_o3(predicted, true), 100),
        f"mpjpe_flip_frame_{unit}": mean(metrics.mpjpe_flip_frame(predicted, true) / share, factor),
        f"n_mpjpe_{unit}": mean(metrics.n_mpjpe(one_sign, true) / share, factor),
        f"pa_mpjpe_{unit}": mean(metrics.pa_mpjpe(one_sign, true) / share, factor),
        "flipped_share": metrics.flipped_share(predicted, true),
        "ne_visible_percent": _part_error(predicted, true, present & visible) if hidden.any() else None,
        "ne_hidden_percent": _part_error(predicted, true, hidden) if hidden.any() else None,
    }


def _part_error(predicted: np.ndarray, true: np.ndarray, part: np.ndarray) -> float:
    """NE in % of some points (M,P) of shapes (M,P,3), mean over the frames that have such points."""
    some = part.any(1)
    predicted, true = (points[some] - points[some].mean(1, keepdims=True) for points in (predicted, true))
    flipped = metrics.flip_depth(predicted)
    worse = np.linalg.norm(flipped - true, axis=(1, 2)) < np.linalg.norm(predicted - true, axis=(1, 2))
    square = ((np.where(worse[:, None, None], flipped, predicted) - true) ** 2).sum(2)
    distance = np.where(part[some], square, 0.0).sum(1) / part[some].sum(1)
    return float(100 * np.sqrt(distance / (true**2).sum(2).mean(1)).mean())


def _reprojection(truth: Sequence, found: Prediction, rows: np.ndarray) -> float:
    """Median over frames of the rms distance of visible points to where they were seen, in % of their rms extent."""
    visible = truth.visible[rows]
    seen = visible[:, None]
    W = np.where(seen, centred(truth.W[rows], visible), 0.0)
    off = np.where(seen, centred(found.S[rows][:, :2], visible) - W, 0.0)
    extent = np.maximum((W**2).sum((1, 2)), np.finfo(float).tiny)
    return float(100 * np.median(np.sqrt((off**2).sum((1, 2)) / extent)))


_LINES = (
    ("NE, flip per frame", "ne_flip_frame_percent", "%"),
    ("NE, one flip for all", "ne_flip_global_percent", "%"),
    ("NE, O(3) aligned and scaled", "ne_o3_percent", "%  (Deep NRSfM's, milder)"),
    ("MPJPE, flip per frame", "mpjpe_flip_frame", ""),
    ("N-MPJPE", "n_mpjpe", ""),
    ("PA-MPJPE", "pa_mpjpe", ""),
    ("NE, visible points alone", "ne_visible_percent", "%"),
    ("NE, hidden points alone", "ne_hidden_percent", "%"),
)


def table(report: dict) -> str:
    """The report as a few aligned lines."""
    unit = "mm" if "mpjpe_flip_frame_mm" in report else "units"
    dropped = ", ".join(f"{count} {reason}" for reason, count in report["dropped"].items()) or "none"
    lines = [
        f"{report['data']}: {report['judged']} of {report['frames']} frames judged, dropped: {dropped}",
        f"  {100 * report['hidden_share']:.1f} % of the points hidden; they count in all errors",
        "",
        f"  {'':<30}{'predicted':>11}{'rigid mean':>12}",
    ]
    for name, key, remark in _LINES:
        key = key if key.endswith("percent") else f"{key}_{unit}"
        both = report[key], report["baseline"][key]
        if None not in both:
            lines.append(f"  {name:<30}{both[0]:>11.4g}{both[1]:>12.4g}  {remark or unit}")
    lines += [
        "",
        f"  {'mirrored frames':<30}{100 * report['flipped_share']:>11.2f}{'':>12}  %",
        f"  {'reprojection, median':<30}{report['reprojection_median_percent']:>11.3f}{'':>12}  % of the extent",
    ]
    if report["lift_us_median"] is not None:
        lines.append(f"  {'one frame alone, median':<30}{report['lift_us_median']:>11.0f}{'':>12}  µs")
    if report["whole_set_mirrored"]:
        lines.append("  the whole set is mirrored: N-MPJPE and PA-MPJPE are of its mirror image")
    return "\n".join(lines)
