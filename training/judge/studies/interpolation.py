# SPDX-License-Identifier: Apache-2.0
"""Strip of shapes on the straight line between two codes of a finished model. Needs neither torch nor truth."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.files import write_json
from paul_ros.model import Model
from paul_ros.model_file import load_model
from paul_ros.normalisation import normalise
from paul_ros.offline.tables import render
from paul_ros.orthographic_n_point import onp
from paul_ros.versions import versions
from training.errors import DataError
from training.judge.pictures import blue_to_red, draw_shape, frame_panels, new_figure, save_figure, turned_view
from training.judge.truth import Sequence
from training.loading import load_training_data

_SHAPES = 9
_PICTURE_ONLY = ("shapes", "seen", "edges")
_COMPARED = 500  # frames whose codes are compared to find the farthest pair


def run(model_name: str | Path, files: list[Path], folder: Path, frames: tuple[int, int] | None) -> str:
    """Interpolate between two frames of each file, and write interpolation.json and interpolation.png into a folder.

    Args:
        model_name: file or shipped model.
        files: npz files with W.
        folder: of table and picture.
        frames: numbers of the two frames; None takes those whose codes are farthest apart.

    Returns:
        The table.

    Raises:
        ModelError: the model cannot be used.
        DataError: a file cannot be used, or lacks these frames.
    """
    model = load_model(model_name)
    strips = [_strip(model, _load_views(file, model), frames) for file in files]
    lines = [{key: value for key, value in strip.items() if key not in _PICTURE_ONLY} for strip in strips]
    write_json(
        folder / "interpolation.json",
        {"study": "interpolation", "model": model.name, "rows": lines, "versions": versions()},
    )
    save_figure(_draw(model, strips), folder / "interpolation.png")
    return _table(lines)


def _load_views(file: Path, model: Model) -> Sequence:
    """Read a file as a sequence without truth; a file named like one of the model's categories has its points."""
    data = load_training_data(file)
    if data.left_out:
        print(
            f"{file}: {data.left_out} of the frames show too few points; frame numbers do not count them",
            file=sys.stderr,
        )
    unknown = np.full((len(data.W), 3, data.W.shape[2]), np.nan)
    views = Sequence(Path(file).stem, data.W, data.visible, unknown, np.zeros((0, 2), int), metres=False)
    return views.among_categories(model.layout)


def _strip(model: Model, sequence: Sequence, frames: tuple[int, int] | None) -> dict[str, Any]:
    """Return the shapes of one file, in the first frame's camera, and how much they change."""
    count, points = sequence.visible.shape
    if points != len(model.layout.names):
        raise DataError(
            f"'{sequence.name}' has {points} points, but model '{model.name}' has {len(model.layout.names)}: "
            "give the model of these points with --model, or other --data"
        )
    if frames and max(frames) >= count:
        raise DataError(f"'{sequence.name}' has frames 0 to {count - 1}, not {max(frames)}: choose others")
    first, last = frames or _farthest(model, sequence)
    W, visible = sequence.W[[first, last]].astype(float), sequence.visible[[first, last]]
    ends = model.encode(W, visible).astype(float)
    share = np.linspace(0, 1, _SHAPES)[:, None]
    shapes = model.decode((1 - share) * ends[:1] + share * ends[1:]).astype(float)
    pose = onp(shapes[:1], W[:1], visible[:1])
    shapes[:, :, ~_category_points(model, sequence)] = np.nan
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


def _category_points(model: Model, sequence: Sequence) -> np.ndarray:
    """Return which points (P,) belong to the sequence's category; all if the model has no such category."""
    points = range(len(model.layout.names))
    return np.isin(points, model.layout.categories.get(sequence.name, points))


def _norm(shapes: np.ndarray) -> np.ndarray:
    """Return the norm of shapes (...,3,P); points of NaN are ignored."""
    return np.sqrt(np.nansum(shapes**2, axis=(-2, -1)))


def _farthest(model: Model, sequence: Sequence) -> tuple[int, int]:
    """Return the two frames whose codes are farthest apart, of up to ``_COMPARED`` evenly chosen ones."""
    rows = np.linspace(0, len(sequence.W) - 1, min(_COMPARED, len(sequence.W))).astype(int)
    codes = model.encode(sequence.W[rows], sequence.visible[rows]).astype(float)
    square = (codes**2).sum(1)
    apart = square[:, None] + square - 2 * codes @ codes.T
    one, other = np.unravel_index(apart.argmax(), apart.shape)
    first, last = sorted((int(rows[one]), int(rows[other])))
    return first, last


def _table(lines: list[dict[str, Any]]) -> str:
    """Format a row a file."""
    steps = map(str, range(1, _SHAPES))
    columns = [("", "text"), ("frames", ""), *((name, ".2f") for name in (*steps, "ends apart"))]
    rows = [
        (line["data"], "{} and {}".format(*line["frames"]), *line["changes_percent"], line["ends_apart_percent"])
        for line in lines
    ]
    head = "change from shape to shape in % of the size, along the straight line between two codes"
    return head + "\n" + render(columns, rows)


def _draw(model: Model, strips: list[dict[str, Any]]) -> Any:
    """Draw a row a file, blue to red: the first frame as seen, all shapes, the last frame as seen.

    Shapes are in the first frame's camera, turned a little.
    """
    figure = new_figure(1.55 * (_SHAPES + 2), 2.3 * len(strips) + 0.5)
    figure.suptitle(f"Between two codes of {model.name}", fontsize=12, fontweight="bold")
    axes = figure.subplots(len(strips), _SHAPES + 2, squeeze=False)
    for row, strip in zip(axes, strips):
        shares = np.linspace(0, 1, _SHAPES)
        turned = turned_view(strip["shapes"])
        for ax, share, shape in zip(row[1:-1], shares, turned):
            draw_shape(ax, shape, strip["edges"], blue_to_red(share))
            ax.set_title(f"{share:.3g}", fontsize=9)
        for ax, share, seen, number in zip(row[[0, -1]], (0.0, 1.0), strip["seen"], strip["frames"]):
            draw_shape(ax, seen, strip["edges"], blue_to_red(share))
            ax.set_title(f"{strip['data']}\nframe {number} as seen", fontsize=9)
        frame_panels(row[1:-1], turned)
        frame_panels(row[[0, -1]], strip["seen"])
    return figure
