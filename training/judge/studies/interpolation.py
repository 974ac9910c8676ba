# SPDX-License-Identifier: Apache-2.0
"""Shapes on the straight line between two codes of a finished model, as a strip. Needs no torch, and no truth."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.model import Model, load_model, normalise
from paul_ros.offline.replay import versions
from paul_ros.offline.report import write_json
from paul_ros.onp import onp
from training.categories import among_categories
from training.errors import DataError
from training.judge.pictures import bare, between, draw_shape, new_figure, save_figure, turned_view
from training.judge.truth import Sequence
from training.loading import load_training_data

_SHAPES = 9
_DRAWN = ("shapes", "seen", "edges")
_COMPARED = 500  # frames whose codes are compared for the farthest pair


def run(model_name: str | Path, files: list[Path], folder: Path, frames: tuple[int, int] | None) -> str:
    """Interpolate between two frames of each file; writes interpolation.json and .png, returns the table.

    Args:
        frames: numbers of the two; None takes those whose codes are farthest apart.

    Raises:
        ModelError, DataError: a file that cannot be used, or does not have these frames.
    """
    model = load_model(model_name)
    strips = [_strip(model, _views(file, model), frames) for file in files]
    lines = [{key: value for key, value in strip.items() if key not in _DRAWN} for strip in strips]
    write_json(
        folder / "interpolation.json",
        {"study": "interpolation", "model": model.name, "rows": lines, "versions": versions()},
    )
    save_figure(_draw(model, strips), folder / "interpolation.png")
    return _table(lines)


def _views(file: Path, model: Model) -> Sequence:
    """What is seen in a file, of one category where it has the name of one; without truth."""
    data = load_training_data(file)
    if data.left_out:
        print(
            f"{file}: {data.left_out} of the frames show too few points; frame numbers leave them out", file=sys.stderr
        )
    unknown = np.full((len(data.W), 3, data.W.shape[2]), np.nan)
    views = Sequence(Path(file).stem, data.W, data.visible, unknown, np.zeros((0, 2), int), metres=False)
    return among_categories(views, model.layout)


def _strip(model: Model, sequence: Sequence, frames: tuple[int, int] | None) -> dict:
    count, points = sequence.visible.shape
    if points != len(model.layout.names):
        raise DataError(f"'{sequence.name}' has {points} points, model '{model.name}' {len(model.layout.names)}")
    if frames and max(frames) >= count:
        raise DataError(f"'{sequence.name}' has frames 0 to {count - 1}, not {max(frames)}: choose others")
    first, last = frames or _farthest(model, sequence)
    W, visible = sequence.W[[first, last]].astype(float), sequence.visible[[first, last]]
    ends = model.encode(W, visible).astype(float)
    share = np.linspace(0, 1, _SHAPES)[:, None]
    shapes = model.decode((1 - share) * ends[:1] + share * ends[1:]).astype(float)
    pose = onp(shapes[:1], W[:1], visible[:1])
    shapes[:, :, ~_own(model, sequence)] = np.nan
    shapes = pose.R @ (shapes - np.nanmean(shapes, axis=2, keepdims=True))
    size = _norm(shapes).mean()
    return {
        "data": sequence.name,
        "frames": [int(first), int(last)],
        "changes_percent": (100 * _norm(np.diff(shapes, axis=0)) / size).tolist(),
        "ends_apart_percent": float(100 * _norm(shapes[-1] - shapes[0]) / size),
        "edges": np.array(model.layout.edges, int).reshape(-1, 2),
        "shapes": shapes,
        "seen": np.where(visible[:, None], normalise(W, visible), np.nan),
    }


def _own(model: Model, sequence: Sequence) -> np.ndarray:
    """(P,) bool: the points of the sequence's category; all, where it is none."""
    points = range(len(model.layout.names))
    return np.isin(points, model.layout.categories.get(sequence.name, points))


def _norm(shapes: np.ndarray) -> np.ndarray:
    """Of shapes (...,3,P), over the points that are there."""
    return np.sqrt(np.nansum(shapes**2, axis=(-2, -1)))


def _farthest(model: Model, sequence: Sequence) -> tuple[int, int]:
    """The two frames whose codes are farthest apart, of up to _COMPARED evenly chosen ones."""
    rows = np.linspace(0, len(sequence.W) - 1, min(_COMPARED, len(sequence.W))).astype(int)
    codes = model.encode(sequence.W[rows], sequence.visible[rows]).astype(float)
    square = (codes**2).sum(1)
    apart = square[:, None] + square - 2 * codes @ codes.T
    return tuple(sorted(rows[list(np.unravel_index(apart.argmax(), apart.shape))].tolist()))


def _table(lines: list[dict]) -> str:
    head = "change from shape to shape in % of the size, along the straight line between two codes"
    rows = [
        f"{line['data']:<12} frames {line['frames'][0]:>6} and {line['frames'][1]:>6}: "
        + " ".join(f"{value:6.2f}" for value in line["changes_percent"])
        + f"   ends apart {line['ends_apart_percent']:.2f}"
        for line in lines
    ]
    return "\n".join([head, *rows])


def _draw(model: Model, strips: list[dict]) -> Any:
    """A row a file: what was seen in the first and the last frame, and between them all shapes; blue to red.

    The shapes are those before the first frame's camera, turned a little.
    """
    figure = new_figure(1.55 * (_SHAPES + 2), 2.3 * len(strips) + 0.5)
    figure.suptitle(f"Between two codes of {model.name}", fontsize=12, fontweight="bold")
    axes = figure.subplots(len(strips), _SHAPES + 2, squeeze=False)
    for row, strip in zip(axes, strips):
        shares = np.linspace(0, 1, _SHAPES)
        turned = turned_view(strip["shapes"])
        for ax, share, shape in zip(row[1:-1], shares, turned):
            draw_shape(ax, shape, strip["edges"], between(share))
            ax.set_title(f"{share:.3g}", fontsize=9)
        for ax, share, seen, number in zip(row[[0, -1]], (0.0, 1.0), strip["seen"], strip["frames"]):
            draw_shape(ax, seen, strip["edges"], between(share))
            ax.set_title(f"{strip['data']}\nframe {number} as seen", fontsize=9)
        bare(row[1:-1], turned)
        bare(row[[0, -1]], strip["seen"])
    return figure
