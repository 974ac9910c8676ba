# SPDX-License-Identifier: Apache-2.0
"""`paul evaluate`: a model on unseen frames, or a saved reconstruction, judged against the truth.

A model needs NumPy only: the forward pass is the robot's.  The table needs rich.  Each frame is judged alone.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.errors import ModelError, NpzError
from paul_ros.files import read_npz
from paul_ros.lifted import AMBIGUOUS, TOO_FEW_POINTS
from paul_ros.model import Model
from paul_ros.model_file import load_model
from paul_ros.offline import truth_units
from paul_ros.offline.tables import Row, render
from paul_ros.versions import versions
from training.errors import DataError
from training.judge.comparison import Comparison, errors
from training.judge.prediction import CountFrames, Prediction, centred, predict, predict_rigid, rigid_mean
from training.judge.truth import SAME_UNIT, Sequence, load_sequence

_TIMED_FRAMES = 100


def evaluate_model(
    model_name: str | Path, data: str | Path, count: CountFrames = lambda number: None
) -> tuple[dict[str, Any], Comparison]:
    """Lift every frame of a file and judge it.

    Args:
        model_name: file or shipped model.
        data: npz with W and the truth S.
        count: called with numbers of frames.

    Returns:
        The report, with the keys of `paul replay --json`, and the compared frames.

    Raises:
        DataError: the file has no truth or other points than the model, or the model is a saved reconstruction.
        ModelError: the model cannot be used.
    """
    model = _load_model(model_name)
    truth = load_sequence(data, turned=True).among_categories(model.layout)
    if len(model.layout.names) != truth.W.shape[2]:
        raise DataError(
            f"'{data}' has {truth.W.shape[2]} points, model '{model_name}' has {len(model.layout.names)}: "
            "evaluate it with data of its own layout"
        )
    _check_metres(truth, model, data)
    found = predict(model, truth.W, truth.visible, count)
    rigid = predict(model.rigid(), truth.W, truth.visible)
    compared = Comparison.of(truth, found, rigid, flip=not model.header["chirality"]["known"])
    about = {"model": model.name, "model_sha256": model.sha256, "layout": model.layout.name}
    observed = replace(found, S=with_observed(found.S, truth))
    report = _report(compared, observed=errors(compared, observed), **about)
    return report | _single_times(model, truth), compared


def _check_metres(truth: Sequence, model: Model, data: str | Path) -> None:
    """Refuse a truth that is said to be in metres, and is far from the size that the model has in metres."""
    if not (truth.metres and model.metres_per_unit):
        return
    size = model.metres_per_unit * float(np.ptp(model.mean_shape, axis=1).max())
    S = truth.S[truth.present.all(1)]
    if problem := truth_units.problem((np.ptp(S, axis=2).max(1) / size).tolist()):
        raise DataError(f"'{data}' says that S is in metres. {problem}")


def _load_model(name: str | Path) -> Model:
    """Load a model; a saved reconstruction in its place gets an error of its own."""
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


def with_observed(S: np.ndarray, truth: Sequence) -> np.ndarray:
    """Move the visible points of shapes (F,3,P) in x and y to their observed positions: S_cam, equations 4 and 14."""
    seen = np.broadcast_to(truth.visible[:, None], truth.W.shape)
    moved = S.copy()
    moved[:, :2][seen] = centred(truth.W, truth.visible)[seen]
    return moved


def _single_times(model: Model, truth: Sequence) -> dict[str, float]:
    """Measure the microseconds of evenly chosen frames, each lifted alone."""
    rows = np.linspace(0, len(truth.W) - 1, min(_TIMED_FRAMES, len(truth.W))).astype(int)
    times = []
    for row in rows:
        begun = time.perf_counter()
        predict(model, truth.W[[row]], truth.visible[[row]])
        times.append(1e6 * (time.perf_counter() - begun))
    return {"lift_us_median": float(np.median(times)), "lift_us_p99": float(np.percentile(times, 99))}


def evaluate_shapes(shapes: str | Path, truth_file: str | Path) -> tuple[dict[str, Any], Comparison]:
    """Judge a saved reconstruction against the truth of the same frames in the same order.

    Args:
        shapes: file that `paul train --shapes` wrote.
        truth_file: npz with W and the truth S.

    Returns:
        The report and the compared frames.

    Raises:
        DataError: the truth is missing, or the reconstruction has other frames or points.
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
    S[found.used] = in_units_of(truth, found.shapes, found.used, shapes)
    dropped = np.where(found.used, "", TOO_FEW_POINTS).astype(object)
    rigid = predict_rigid(rigid_mean(found.shapes, found.rotations), truth.W, truth.visible)
    compared = Comparison.of(truth, Prediction(S, dropped), rigid, flip=True)
    return _report(compared, shapes=Path(shapes).name, loss=found.loss, seconds=found.seconds), compared


def in_units_of(truth: Sequence, shapes: np.ndarray, used: np.ndarray, name: str | Path) -> np.ndarray:
    """Scale reconstructed shapes (F,3,P) of image units to the units of the truth, if the image is a camera's.

    Each frame has a scale of its own: x and y of its visible points are those of W.

    Raises:
        DataError: the shapes have other units than the truth, and no camera tells their scale.
    """
    seen = truth.visible[used][:, None]
    image = np.where(seen, centred(truth.W, truth.visible)[used], 0.0)
    found = np.where(seen, shapes[:, :2], 0.0)
    scale = (image * found).sum((1, 2)) / np.maximum((found * found).sum((1, 2)), 1e-300)
    low, high = SAME_UNIT
    if low <= (ratio := float(np.median(scale))) <= high:
        return shapes
    if not (truth.has_camera and (scale > 0).all()):
        raise DataError(
            f"the shapes in '{name}' are {1 / ratio if ratio else np.inf:.3g} times as large as W of the truth: they "
            "have different units, such as pixels and metres. Name the file that was reconstructed; save its camera "
            "matrix as K (3,3) if its W is in pixels and its S in metres"
        )
    return shapes * scale[:, None, None]


def _report(compared: Comparison, **about: object) -> dict[str, Any]:
    """Return all keys of `paul evaluate --json`; None for keys that do not apply, such as pixels and root errors."""
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


_ROWS = (
    ("NE, flip per frame", "ne_flip_frame_percent", "%"),
    ("NE, one flip for all", "ne_flip_global_percent", "%"),
    ("NE, rotated and scaled to fit", "ne_o3_percent", "%, mirror images allowed"),
    ("MPJPE, flip per frame", "mpjpe_flip_frame", ""),
    ("N-MPJPE", "n_mpjpe", ""),
    ("PA-MPJPE", "pa_mpjpe", ""),
    ("NE, visible points alone", "ne_visible_percent", "%"),
    ("NE, hidden points alone", "ne_hidden_percent", "%"),
)


def table(report: dict[str, Any]) -> str:
    """Format the report as text.

    Raises:
        MissingPackageError: rich is not installed.
    """
    length = "mm" if "mpjpe_flip_frame_mm" in report else "units"
    dropped = ", ".join(f"{count} {reason}" for reason, count in report["dropped"].items()) or "none"
    rows: list[Row] = []
    for name, key, unit in _ROWS:
        key = key if key.endswith("percent") else f"{key}_{length}"
        predicted, rigid = report[key], report["baseline"][key]
        if None not in (predicted, rigid):
            observed = report["observed"][key] if report["observed"] else ""
            rows.append((name, predicted, observed, rigid, unit or length))
    rows += [
        (),
        ("mirrored frames", f"{100 * report['flipped_share']:.2f}", "", "", "%"),
        ("reprojection, median", f"{report['reprojection_median_percent']:.3f}", "", "", "% of the extent"),
    ]
    if report["lift_us_median"] is not None:
        rows.append(("one frame alone, median", f"{report['lift_us_median']:.0f}", "", "", "µs"))
    columns = (("", "text"), *((name, ".4g") for name in ("predicted", "x, y seen", "rigid mean")), ("", "unit"))
    lines = [
        f"{report['data']}: {report['judged']} of {report['frames']} frames judged, dropped: {dropped}",
        f"  {100 * report['hidden_share']:.1f} % of the points are hidden; all errors include them",
        "",
        render(columns, rows),
    ]
    if report["observed"]:
        lines.append("  x, y seen: visible points at their observed x and y, the paper's S_cam; the model gives depth")
    if report["whole_set_mirrored"]:
        lines.append("  the whole set is mirrored: N-MPJPE and PA-MPJPE are those of its mirror image")
    return "\n".join(lines)
