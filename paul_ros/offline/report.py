# SPDX-License-Identifier: Apache-2.0
"""What a replay gave, for people: a table to print, a JSON file, a picture. Files appear whole or not at all."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros import metrics
from paul_ros.errors import PictureError
from paul_ros.files import write_atomically
from paul_ros.offline.replay import LEAST_POINTS, LiftedFrame, Replay, matched, rigid_frames

_ROWS = (
    ("N-MPJPE", "n_mpjpe_mm", "mm"),
    ("PA-MPJPE", "pa_mpjpe_mm", "mm"),
    ("NE, flip per frame", "ne_flip_frame_percent", "%"),
    ("NE, one flip for all", "ne_flip_global_percent", "%"),
    ("root error, median", "root_error_median_mm", "mm"),
    ("root error, median", "root_error_median_percent", "% of distance"),
)
SIDE_COLOUR = {"left": "#1f77d0", "right": "#e4572e", "": "#444444"}
_TRUTH_COLOUR = "#c4c4c4"
_VIEWS = (("seen by the camera", 0), ("seen from the right, camera at the left", 2))
_WIDEST, _TALLEST = 3.6, 3.6  # inches of one panel


def write_json(path: str | Path, report: dict) -> None:
    """The report as one JSON object."""
    write_atomically(path, (json.dumps(report, indent=2, ensure_ascii=False) + "\n").encode())


def table(report: dict) -> str:
    """The report as a few aligned lines."""
    dropped = ", ".join(f"{count} {reason}" for reason, count in report["dropped"].items()) or "nothing"
    lines = [
        f"{report['bag']}",
        f"  {report['frames']} frames, {report['persons']} persons, {report['lifted']} lifted; dropped: {dropped}",
        f"  model {report['model']} ({report['model_sha256'][:12]}), layout {report['layout']}, "
        f"units {report['units']}",
    ]
    advice = report["advice"]
    lines += [f"  noted: {count} {what}: {advice[what]}" for what, count in report["noted"].items() if what in advice]
    if report["persons_with_truth"]:
        lines += ["", f"  {_judged(report)}", f"  {'':<22}{'lifted':>9}{'rigid':>9}"]
        lines += [
            f"  {name:<22}{_cell(report[key])}{_cell(report['baseline'][key])}  {unit}" for name, key, unit in _ROWS
        ]
    lines += [
        "",
        f"  {'reprojection, median':<22}{_cell(report['reprojection_median_px'])}{'':>9}  px",
        f"  {'proven optimal':<22}{_cell(report['certified_share'], 100)}{'':>9}  %",
        f"  {'mirror ambiguous':<22}{_cell(report['ambiguous_share'], 100)}{'':>9}  %",
        f"  {'flips in depth':<22}{_cell(report['flips_per_1000_frames'])}{'':>9}  of 1000 frames to the next",
        f"  {'lift, median':<22}{_cell(report['lift_us_median'])}{'':>9}  µs a frame "
        f"(99 %: {_cell(report['lift_us_p99']).strip()})",
    ]
    return "\n".join(lines)


def _judged(report: dict) -> str:
    """Whom the errors are of; they say nothing of the others."""
    judged, persons, share = (report[key] for key in ("persons_with_truth", "persons", "points_with_truth_share"))
    points = "" if share == 1 else f", over {100 * share:.0f} % of their points"
    return f"errors of {judged} of {persons} persons, {100 * (1 - judged / persons):.1f} % left out{points}"


def _cell(value: float | None, factor: float = 1.0) -> str:
    return f"{'-':>9}" if value is None else f"{factor * value:>9.1f}"


def write_picture(path: str | Path, done: Replay) -> None:
    """Several frames in 2D and lifted, from two views over the truth, and the error over time.

    The suffix of the path chooses the format (.png, .svg, .pdf). Raises PictureError.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise PictureError("a picture needs matplotlib: pip install 'paul_ros[bags]'") from error
    chosen = _choose(done)
    if not chosen:
        raise PictureError(f"{done.bag}: no person was lifted, so there is nothing to draw")
    rows = [_image_row(chosen), *(_view_row(done, chosen, axis, name) for name, axis in _VIEWS)]
    width = min(_WIDEST, max(_TALLEST * row.aspect for row in rows))
    heights = [min(_TALLEST, width / row.aspect) + 0.25 for row in rows]
    figure = Figure(figsize=(width * len(chosen) + 0.5, sum(heights) + 2.6), layout="constrained")
    FigureCanvasAgg(figure)
    parts = figure.subfigures(len(rows) + 1, 1, height_ratios=[*heights, 2.2])
    for row, part in zip(rows, parts):
        _draw_row(part.subplots(1, len(chosen), squeeze=False)[0], done, row)
    for ax, frame in zip(parts[0].axes, chosen):
        ax.set_title(f"{_seconds(done, frame):.1f} s", fontsize=10)
        ax.set_facecolor("#f4f4f6")
    _draw_errors(parts[-1].subplots(), done, chosen)
    parts[0].suptitle(f"{done.bag.stem}, lifted by {done.stream.lifter.model.name}", fontsize=13, fontweight="bold")
    buffer = io.BytesIO()
    try:
        # No date and no version inside: an equal replay gives an equal picture.
        figure.savefig(buffer, format=Path(path).suffix.lstrip(".") or "png", dpi=110, metadata=_no_date(path))
    except ValueError as error:
        raise PictureError(f"{path}: {error}") from error
    write_atomically(path, buffer.getvalue())


def _no_date(path: str | Path) -> dict[str, Any]:
    nothing = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    return nothing.get(Path(path).suffix, {})


def _choose(done: Replay) -> list[LiftedFrame]:
    """Frames evenly over time, of those that show most persons at once."""
    lifted = np.array([frame.lifted.ok.sum() for frame in done.frames], int)
    if not lifted.any():
        return []
    full = np.flatnonzero(lifted == lifted.max())
    count = min(len(full), 6 if lifted.max() == 1 else 4)
    return [done.frames[i] for i in full[((np.arange(count) + 0.5) / count * len(full)).astype(int)]]


@dataclass(frozen=True)
class _Row:
    """One row of panels: skeletons (N,P,2) for each panel, y down, and those of the truth behind them."""

    name: str
    bodies: list[np.ndarray]
    truths: list[np.ndarray]
    low: np.ndarray
    high: np.ndarray

    @property
    def aspect(self) -> float:
        """Width over height."""
        size = self.high - self.low
        return float(size[0] / size[1])


def _row(name: str, bodies: list[np.ndarray], truths: list[np.ndarray]) -> _Row:
    """All panels of a row share one scale, so that they can be compared."""
    points = np.concatenate([body.reshape(-1, 2) for body in (*bodies, *truths)])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.08 * (high - low).max() or 1.0  # of bodies without size too
    return _Row(name, bodies, truths, low - margin, high + margin)


def _image_row(chosen: list[LiftedFrame]) -> _Row:
    seen = [np.where(frame.keypoints.visible[..., None], frame.keypoints.xy, np.nan) for frame in chosen]
    return _row("2D input (pixels)", seen, [])


def _view_row(done: Replay, chosen: list[LiftedFrame], axis: int, name: str) -> _Row:
    """3D skeletons projected along an axis; `axis` runs to the right, y down."""
    placed = [_at_true_root(done, frame) for frame in chosen]
    bodies = [points[..., [axis, 1]] for points, _ in placed]
    truths = [truth[..., [axis, 1]] for _, truth in placed]
    return _row(name + ("\nlifted over truth (grey)" if any(map(len, truths)) else ""), bodies, truths)


def _draw_row(axes: Any, done: Replay, row: _Row) -> None:
    for panel, ax in enumerate(axes):
        for body in row.truths[panel] if row.truths else ():
            _draw_bones(ax, done, body, truth=True)
        for body in row.bodies[panel]:
            _draw_bones(ax, done, body)
        ax.set(xlim=(row.low[0], row.high[0]), ylim=(row.high[1], row.low[1]), aspect="equal", xticks=[], yticks=[])
        for spine in ax.spines.values():
            spine.set_color("#d0d0d0")
    axes[0].set_ylabel(row.name, fontsize=10)


def _at_true_root(done: Replay, frame: LiftedFrame) -> tuple[np.ndarray, np.ndarray]:
    """Lifted persons moved to where they truly stood, so that shape and pose can be compared; and their truth,
    empty where there is none.

    Metric shapes keep their size; shapes in model units get the truth's. A person whose truth lacks a point of the root
    is placed by all points that it has, one whose truth cannot be judged by stays.
    """
    points, truth = frame.lifted.points[frame.lifted.ok], done.truth.get(frame.stamp)
    if truth is None or len(truth) != len(frame.lifted.ok):
        return points, np.empty((0, *points.shape[1:]))
    truth, root = truth[frame.lifted.ok], list(done.layout.root)
    present = np.isfinite(truth).all(axis=2)
    for person in np.flatnonzero(present.sum(axis=1) >= LEAST_POINTS):
        anchor = root if present[person, root].all() else present[person]
        body, target = points[person] - points[person, anchor].mean(0), truth[person, anchor].mean(0)
        if frame.lifted.units != "m":
            shown = present[person]
            body *= np.linalg.norm(truth[person, shown] - target) / np.linalg.norm(body[shown])
        points[person] = body + target
    return points, truth


def _draw_bones(ax: Any, done: Replay, points: np.ndarray, truth: bool = False) -> None:
    """One skeleton in 2D (P,2); bones with a NaN end do not show."""
    layout = done.layout
    for a, b in layout.edges:
        side = layout.sides[a] if layout.sides[a] == layout.sides[b] else ""
        style = (
            dict(color=_TRUTH_COLOUR, linewidth=6.0, zorder=1)
            if truth
            else dict(color=SIDE_COLOUR[side], linewidth=2.2, zorder=2)
        )
        ax.plot(*points[[a, b]].T, solid_capstyle="round", **style)
    if not truth:
        ax.scatter(*points.T, s=9, zorder=3, linewidths=0, c=[SIDE_COLOUR[side] for side in layout.sides])


def _draw_errors(ax: Any, done: Replay, chosen: list[LiftedFrame]) -> None:
    with_truth = [frame for frame in done.frames if frame.stamp in done.truth]
    if with_truth:
        rigid = [frame for frame in rigid_frames(done) if frame.stamp in done.truth]
        _draw_line(ax, done, rigid, metrics.pa_mpjpe, "#9a9a9a", "PA-MPJPE, rigid mean shape")
        _draw_line(ax, done, with_truth, metrics.n_mpjpe, "#f0a030", "N-MPJPE, lifted")
        _draw_line(ax, done, with_truth, metrics.pa_mpjpe, "#2a9d50", "PA-MPJPE, lifted")
        ax.set_ylabel("mm")
    else:
        pixels = [np.nanmean(f.lifted.reprojection[f.lifted.ok]) if f.lifted.ok.any() else np.nan for f in done.frames]
        ax.plot([_seconds(done, f) for f in done.frames], pixels, color="#2a9d50", label="reprojection, lifted")
        ax.set_ylabel("px")
    for frame in chosen:
        ax.axvline(_seconds(done, frame), color="#dddddd", zorder=0)
    ax.set(xlabel="seconds", ylim=(0, None))
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=9, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))


def _draw_line(ax: Any, done: Replay, frames: list[LiftedFrame], measure: Any, colour: str, label: str) -> None:
    """Mean error over the persons of each frame; a gap where nobody was lifted."""
    pairs = [matched([(frame.lifted, done.truth[frame.stamp])]) for frame in frames]
    means = [1000 * pair.distances(measure).mean() if len(pair.truth) else np.nan for pair in pairs]
    ax.plot([_seconds(done, frame) for frame in frames], means, color=colour, linewidth=1.3, label=label)


def _seconds(done: Replay, frame: LiftedFrame) -> float:
    return (frame.stamp - done.frames[0].stamp) / 1e9
