# SPDX-License-Identifier: Apache-2.0
"""The picture of a replay: several frames in 2D and lifted, over their ground truth, and errors over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros import metrics
from paul_ros.errors import PictureError
from paul_ros.offline.figures import new_figure, save_figure
from paul_ros.offline.judge import rigid_frames
from paul_ros.offline.replay import LiftedFrame, Replay
from paul_ros.offline.skeleton_drawing import draw_skeleton
from paul_ros.offline.truth_errors import MIN_TRUTH_POINTS, match_truth
from paul_ros.stream.messages import image_pixels

_TRUTH_COLOUR = "#c4c4c4"
_LIFTED_COLOUR, _N_MPJPE_COLOUR, _RIGID_COLOUR = "#2a9d50", "#f0a030", "#9a9a9a"
#: Name of a row -> the axis of the camera frame that runs to the right.
_PROJECTIONS = (("seen by the camera", 0), ("seen from the right, camera at the left", 2))
_MAX_PANEL = 3.6  # inches, width and height

#: Number of frames that a replay needs to keep for a picture; up to the double is drawn.
MOST_FRAMES = 2000


def write_picture(path: str | Path, done: Replay) -> None:
    """Draw several frames from two views, and the error over time.

    Args:
        path: the suffix chooses the format (.png, .svg, .pdf).
        done: the replay to draw.

    Raises:
        PictureError: nobody was lifted, or matplotlib cannot write this format.
        MissingPackageError: matplotlib is not installed.
    """
    chosen = _choose_frames(done)
    if not chosen:
        raise PictureError(f"{done.bag}: no person was lifted, so there is nothing to draw")
    rows = [_image_row(chosen), *(_projected_row(done, chosen, axis, name) for name, axis in _PROJECTIONS)]
    width = min(_MAX_PANEL, max(_MAX_PANEL * row.aspect for row in rows))
    heights = [min(_MAX_PANEL, width / row.aspect) + 0.25 for row in rows]
    figure = new_figure(width * len(chosen) + 0.5, sum(heights) + 2.6)
    parts = figure.subfigures(len(rows) + 1, 1, height_ratios=[*heights, 2.2])
    for row, part in zip(rows, parts):
        _draw_row(part.subplots(1, len(chosen), squeeze=False)[0], done, row)
    for ax, frame in zip(parts[0].axes, chosen):
        ax.set_title(f"{_seconds(done, frame):.1f} s", fontsize=10)
        ax.set_facecolor("#f4f4f6")
    _draw_errors(parts[-1].subplots(), done, chosen)
    parts[0].suptitle(f"{done.bag.stem}, lifted by {done.stream.lifter.model.name}", fontsize=13, fontweight="bold")
    save_figure(figure, path)


def _choose_frames(done: Replay) -> list[LiftedFrame]:
    """Return frames evenly over time, from those that show most persons at once."""
    lifted = np.array([frame.lifted.ok.sum() for frame in done.frames], int)
    if not lifted.any():
        return []
    full = np.flatnonzero(lifted == lifted.max())
    count = min(len(full), 6 if lifted.max() == 1 else 4)
    return [done.frames[i] for i in full[((np.arange(count) + 0.5) / count * len(full)).astype(int)]]


@dataclass(frozen=True)
class _Row:
    """One row of panels with one scale, so that they can be compared.

    Attributes:
        name: label of the row.
        bodies: skeletons (N,P,2) of each panel, y down.
        truths: ground truth (N,P,2) of each panel, drawn behind; empty = none.
        low: (2,) least coordinates shown.
        high: (2,) largest coordinates shown.
    """

    name: str
    bodies: list[np.ndarray]
    truths: list[np.ndarray]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, name: str, bodies: list[np.ndarray], truths: list[np.ndarray]) -> _Row:
        """Return a row whose limits hold everything."""
        points = np.concatenate([body.reshape(-1, 2) for body in (*bodies, *truths)])
        points = points[np.isfinite(points).all(axis=1)]
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.08 * (high - low).max() or 1.0  # a body without extent needs a margin too
        return cls(name, bodies, truths, low - margin, high + margin)

    @property
    def aspect(self) -> float:
        """Width over height."""
        size = self.high - self.low
        return float(size[0] / size[1])


def _image_row(chosen: Sequence[LiftedFrame]) -> _Row:
    seen = [
        np.where(frame.keypoints.visible[..., None], image_pixels(frame.keypoints, frame.camera), np.nan)
        for frame in chosen
    ]
    return _Row.of("2D input (pixels)", seen, [])


def _projected_row(done: Replay, chosen: Sequence[LiftedFrame], axis: int, name: str) -> _Row:
    """Return the lifted skeletons along a view; `axis` of the camera frame runs to the right, y down."""
    placed = [_at_true_root(done, frame) for frame in chosen]
    bodies = [points[..., [axis, 1]] for points, _ in placed]
    truths = [truth[..., [axis, 1]] for _, truth in placed]
    return _Row.of(name + ("\nlifted over truth (grey)" if any(map(len, truths)) else ""), bodies, truths)


def _draw_row(axes: Any, done: Replay, row: _Row) -> None:
    edges, sides = done.layout.edges, done.layout.sides
    for panel, ax in enumerate(axes):
        for body in row.truths[panel] if row.truths else ():
            draw_skeleton(ax, body, edges, colour=_TRUTH_COLOUR, line_width=6.0, zorder=1)
        for body in row.bodies[panel]:
            draw_skeleton(ax, body, edges, sides, dot_size=9)
        ax.set(xlim=(row.low[0], row.high[0]), ylim=(row.high[1], row.low[1]), aspect="equal", xticks=[], yticks=[])
        for spine in ax.spines.values():
            spine.set_color("#d0d0d0")
    axes[0].set_ylabel(row.name, fontsize=10)


def _at_true_root(done: Replay, frame: LiftedFrame) -> tuple[np.ndarray, np.ndarray]:
    """Move lifted persons to their true place, so that shape and pose can be compared.

    Metric shapes keep their size; shapes in model units get the size of the ground truth. A person is placed by the
    root, or by all points with a ground truth if a point of the root has none. A person with too few of these stays.

    Returns:
        Lifted points and ground truth, both (N,P,3); the latter (0,P,3) if there is none.
    """
    points, truth = frame.lifted.points[frame.lifted.ok], done.truth.get(frame.stamp)
    if truth is None or len(truth) != len(frame.lifted.ok):
        return points, np.empty((0, *points.shape[1:]))
    truth, root = truth[frame.lifted.ok], list(done.layout.root)
    present = np.isfinite(truth).all(axis=2)
    for person in np.flatnonzero(present.sum(axis=1) >= MIN_TRUTH_POINTS):
        anchor = root if present[person, root].all() else present[person]
        body, target = points[person] - points[person, anchor].mean(0), truth[person, anchor].mean(0)
        if frame.lifted.units != "m":
            shown = present[person]
            body *= np.linalg.norm(truth[person, shown] - target) / np.linalg.norm(body[shown])
        points[person] = body + target
    return points, truth


def _draw_errors(ax: Any, done: Replay, chosen: Sequence[LiftedFrame]) -> None:
    """Draw errors over time; without a ground truth, the distance to the keypoints in the image."""
    with_truth = [frame for frame in done.frames if frame.stamp in done.truth]
    if with_truth:
        rigid = [frame for frame in rigid_frames(done) if frame.stamp in done.truth]
        _draw_line(ax, done, rigid, metrics.pa_mpjpe, _RIGID_COLOUR, "PA-MPJPE, rigid mean shape")
        _draw_line(ax, done, with_truth, metrics.n_mpjpe, _N_MPJPE_COLOUR, "N-MPJPE, lifted")
        _draw_line(ax, done, with_truth, metrics.pa_mpjpe, _LIFTED_COLOUR, "PA-MPJPE, lifted")
        ax.set_ylabel("mm")
    else:
        pixels = [np.nanmean(f.lifted.reprojection[f.lifted.ok]) if f.lifted.ok.any() else np.nan for f in done.frames]
        ax.plot([_seconds(done, f) for f in done.frames], pixels, color=_LIFTED_COLOUR, label="reprojection, lifted")
        ax.set_ylabel("px")
    for frame in chosen:
        ax.axvline(_seconds(done, frame), color="#dddddd", zorder=0)
    ax.set(xlabel="seconds", ylim=(0, None))
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=9, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))


def _draw_line(
    ax: Any,
    done: Replay,
    frames: Sequence[LiftedFrame],
    measure: Callable[[np.ndarray, np.ndarray], np.ndarray],
    colour: str,
    label: str,
) -> None:
    """Draw the mean error over the persons of each frame; a gap where nobody was lifted."""
    pairs = [match_truth([(frame.lifted, done.truth[frame.stamp])]) for frame in frames]
    means = [1000 * pair.distances(measure).mean() if len(pair.truth) else np.nan for pair in pairs]
    ax.plot([_seconds(done, frame) for frame in frames], means, color=colour, linewidth=1.3, label=label)


def _seconds(done: Replay, frame: LiftedFrame) -> float:
    return (frame.stamp - done.frames[0].stamp) / 1e9
