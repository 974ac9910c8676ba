# SPDX-License-Identifier: Apache-2.0
"""`paul evaluate`: unseen data lifted frame by frame, or a saved reconstruction, judged against the truth.

Needs numpy only, for a model: the forward pass is the robot's. Frames are judged alone and in any order.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from paul_ros import metrics
from paul_ros.errors import ModelError, NpzError
from paul_ros.files import read_npz
from paul_ros.lifter import AMBIGUOUS, DEGENERATE_POINTS, TOO_FEW_POINTS
from paul_ros.model import Model, load_model
from paul_ros.onp import onp
from paul_ros.versions import versions
from training.categories import among_categories
from training.errors import DataError
from training.judge.truth import Sequence, load_sequence

LEAST_VISIBLE = 4
"""Visible points that a frame must have: three fit nearly any shape."""

_BLOCK = 256  # frames at a time
_SINGLES = 100  # frames lifted alone, for the time of one
_MEAN_ROUNDS = 10
_MEAN_FRAMES = 1000

Progress = Callable[[int], None]
"""Called with the number of frames done since the last call."""


@dataclass(frozen=True)
class Prediction:
    """3D of F frames.

    Attributes:
        S: (F,3,P) float32, camera frame, in units of W, centred on the mean of the visible points.
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
    S, dropped = np.zeros((len(W), 3, W.shape[2]), np.float32), np.full(len(W), "", object)
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
        DataError: the file has no truth, or other points than the model; or the model is a saved reconstruction.
        ModelError: the model cannot be used.
    """
    model = _model(model_name)
    truth = among_categories(load_sequence(data), model.layout)
    if len(model.layout.names) != truth.W.shape[2]:
        raise DataError(
            f"'{data}' has {truth.W.shape[2]} points, model '{model_name}' has {len(model.layout.names)}: "
            "evaluate it with data of its own layout"
        )
    found = predict(model, truth.W, truth.visible, progress)
    rigid = predict(model.rigid(), truth.W, truth.visible)
    compared = Comparison.of(truth, found, rigid, flip=not model.header["chirality"]["known"])
    about = {"model": model.name, "model_sha256": model.sha256, "layout": model.layout.name}
    observed = replace(found, S=with_observed(found.S, truth))
    report = _report(compared, observed=errors(compared, observed), **about)
    return report | _single_times(model, truth), compared


def with_observed(S: np.ndarray, truth: Sequence) -> np.ndarray:
    """S_cam of equations 4 and 14: shapes (F,3,P) whose visible points are moved in x and y to where they were seen."""
    seen = np.broadcast_to(truth.visible[:, None], truth.W.shape)
    moved = S.copy()
    moved[:, :2][seen] = centred(truth.W, truth.visible)[seen]
    return moved


def _model(name: str | Path) -> Model:
    try:
        return load_model(name)
    except ModelError:
        try:
            read_npz(name, ("shapes", "rotations"))
        except NpzError:
            pass
        else:
            raise DataError(f"'{name}' holds saved shapes, no model: name their data with --truth DATA") from None
        raise


def evaluate_shapes(shapes: str | Path, truth_file: str | Path) -> tuple[dict, Comparison]:
    """Judge a saved reconstruction against the truth of the same frames in the same order.

    Raises:
        DataError: the file has no truth, or the reconstruction is of other frames or points.
    """
    from training.reconstruction import load_reconstruction

    truth = load_sequence(truth_file)
    try:
        found = load_reconstruction(shapes)
    except DataError as error:
        raise DataError(f"{error}; a model is judged without --truth: MODEL DATA") from error
    given = (len(found.used), *found.shapes.shape[1:])
    if given != truth.S.shape:
        raise DataError(
            f"'{shapes}' holds shapes of frames and points {given}, the truth in '{truth_file}' is {truth.S.shape}: "
            "name the file that was reconstructed"
        )
    S = np.zeros(given, np.float32)
    S[found.used] = found.shapes
    dropped = np.where(found.used, "", TOO_FEW_POINTS).astype(object)
    mean = rigid_mean(found.shapes, found.rotations)
    compared = Comparison.of(truth, Prediction(S, dropped), _rigid(mean, truth), flip=True)
    return _report(compared, shapes=Path(shapes).name, loss=found.loss, seconds=found.seconds), compared


def _rigid(mean: np.ndarray, truth: Sequence) -> Prediction:
    """The mean shape (3,P) put before every camera, with its best scale."""
    S, dropped = np.zeros(truth.S.shape, np.float32), np.full(len(truth.W), "", object)
    for rows in _blocks(np.arange(len(S))):
        pose = onp(np.broadcast_to(mean, (len(rows), *mean.shape)), truth.W[rows], truth.visible[rows])
        S[rows] = pose.scale[:, None, None] * centred(pose.R @ mean, truth.visible[rows])
        dropped[rows] = np.where(pose.determined, "", DEGENERATE_POINTS)
    return Prediction(S, dropped)


def rigid_mean(shapes: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Generalised Procrustes mean (3,P) of shapes (F,3,P) in their cameras' frames, each of rms size 1.

    Rotations (F,3,3), to the camera frame, say how they first lie on each other; of many shapes some suffice.
    """
    rows = np.linspace(0, len(shapes) - 1, min(_MEAN_FRAMES, len(shapes))).astype(int)
    points = (rotations[rows].transpose(0, 2, 1) @ shapes[rows]).transpose(0, 2, 1).astype(float)
    points = points - points.mean(1, keepdims=True)
    points = points / np.sqrt((points**2).sum(2).mean(1))[:, None, None]
    mean = points.mean(0)
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
        plain, flipped = errors_of_signs(found.S, truth, rows).mean(0)
        return cls(truth, rows, found, rigid, bool(flip and flipped < plain))


def errors_of_signs(S: np.ndarray, truth: Sequence, rows: np.ndarray) -> np.ndarray:
    """(M,2) normalised errors of shapes (F,3,P), as they are and with the depth flipped, for some frames (M,)."""
    return np.concatenate([metrics.normalised_error_of_signs(*pair(S, truth, part)) for part in _blocks(rows)])


def pair(S: np.ndarray, truth: Sequence, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Predicted and true points (M,P,3) of some frames; those without truth are at the mean of the others."""
    present = truth.present[rows]
    return tuple(metrics.fill_absent(some[rows].transpose(0, 2, 1), present) for some in (S, truth.S))


def _blocks(rows: np.ndarray) -> list[np.ndarray]:
    """Frame numbers in parts that fit into memory, however many points a frame has."""
    return [rows[begin : begin + _BLOCK] for begin in range(0, len(rows), _BLOCK)]


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
        "certified_share": None if found.certified is None else float(found.certified[rows].mean()),
        "ambiguous_share": None if found.ambiguity is None else float((found.ambiguity[rows] >= AMBIGUOUS).mean()),
        "lift_us_median": None,
        "lift_us_p99": None,
        "observed": None,
        "baseline": errors(compared, compared.rigid),
        "model": None,
        "bag": None,
        "versions": versions(),
        **about,
    }


def errors(compared: Comparison, prediction: Prediction) -> dict:
    """Every error measure under its exact name, means over the frames; hidden points count in all of them.

    Distances end in ``_mm`` where the truth is in metres, else in ``_units`` (of W). NE of the visible and of the
    hidden points alone is None where no point is hidden.
    """
    blocks = [_frame_errors(compared, prediction, part) for part in _blocks(compared.rows)]
    found = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
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
    """Errors of some frames, (M,) each and (M,2) of both signs."""
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
    """(M,) rms distance over some points (M,P) of the centred shapes, as a share of the whole truth's rms size.

    As NE, were all points as far off as these. NaN for frames that have no such points.
    """
    predicted, true = (points - points.mean(1, keepdims=True) for points in (predicted, true))
    part = part & present
    square = np.where(part, ((predicted - true) ** 2).sum(2), 0.0).sum(1)
    size = (true**2).sum((1, 2)) / present.sum(1)
    count = part.sum(1)
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1) / size), np.nan)


def _reprojection(xy: np.ndarray, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(M,) rms distance of visible points (M,2,P) to where they were seen, as a share of their rms extent."""
    seen = visible[:, None]
    W = np.where(seen, centred(W, visible), 0.0)
    off = np.where(seen, centred(xy, visible) - W, 0.0)
    return np.sqrt((off**2).sum((1, 2)) / np.maximum((W**2).sum((1, 2)), np.finfo(float).tiny))


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
        f"  {'':<30}{'predicted':>11}{'x, y seen':>12}{'rigid mean':>12}",
    ]
    for name, key, remark in _LINES:
        key = key if key.endswith("percent") else f"{key}_{unit}"
        predicted, rigid = report[key], report["baseline"][key]
        if None not in (predicted, rigid):
            observed = f"{report['observed'][key]:.4g}" if report["observed"] else ""
            lines.append(f"  {name:<30}{predicted:>11.4g}{observed:>12}{rigid:>12.4g}  {remark or unit}")
    lines += [
        "",
        f"  {'mirrored frames':<30}{100 * report['flipped_share']:>11.2f}{'':>24}  %",
        f"  {'reprojection, median':<30}{report['reprojection_median_percent']:>11.3f}{'':>24}  % of the extent",
    ]
    if report["lift_us_median"] is not None:
        lines.append(f"  {'one frame alone, median':<30}{report['lift_us_median']:>11.0f}{'':>24}  µs")
    if report["observed"]:
        lines.append(
            "  x, y seen: visible points moved to where they were seen, the paper's S_cam; depth is the model's"
        )
    if report["whole_set_mirrored"]:
        lines.append("  the whole set is mirrored: N-MPJPE and PA-MPJPE are of its mirror image")
    return "\n".join(lines)
