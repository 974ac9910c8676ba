# SPDX-License-Identifier: Apache-2.0
"""Shapes on the straight line between two codes of a finished model, as a strip. Needs no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.model import Model, load_model
from paul_ros.onp import onp
from paul_ros.replay import versions
from paul_ros.report import write_json
from training.data import DataError
from training.pictures import bare, between, draw_shape, new_figure, save_figure, turned_view
from training.truth import Sequence, load_sequence

ERRORS = (DataError,)
"""What a user can cause and mend; the text of each is one clear line."""

_SHAPES = 9
_COMPARED = 500  # frames whose codes are compared for the farthest pair


def run(model_name: str | Path, files: list[Path], folder: Path, frames: tuple[int, int] | None) -> str:
    """Interpolate between two frames of each file; writes interpolation.json and .png, returns the table.

    Args:
        frames: numbers of the two; None takes those whose codes are farthest apart.

    Raises:
        ModelError, DataError: a file that cannot be used, or does not have these frames.
    """
    model = load_model(model_name)
    strips = [_strip(model, load_sequence(file), frames) for file in files]
    lines = [{key: value for key, value in strip.items() if key not in ("shapes", "edges")} for strip in strips]
    write_json(
        folder / "interpolation.json",
        {"study": "interpolation", "model": model.name, "rows": lines, "versions": versions()},
    )
    save_figure(_draw(model, strips), folder / "interpolation.png")
    return _table(lines)


def _strip(model: Model, sequence: Sequence, frames: tuple[int, int] | None) -> dict:
    count, points = sequence.visible.shape
    if points != len(model.layout.names):
        raise DataError(f"'{sequence.name}' has {points} points, model '{model.name}' {len(model.layout.names)}")
    if frames and max(frames) >= count:
        raise DataError(f"'{sequence.name}' has frames 0 to {count - 1}, not {max(frames)}: choose others")
    first, last = frames or _farthest(model, sequence)
    ends = model.encode(sequence.W[[first, last]], sequence.visible[[first, last]]).astype(float)
    share = np.linspace(0, 1, _SHAPES)[:, None]
    shapes = model.decode((1 - share) * ends[:1] + share * ends[1:]).astype(float)
    pose = onp(shapes[:1], sequence.W[[first]], sequence.visible[[first]])
    size = np.linalg.norm(shapes, axis=(1, 2)).mean()
    return {
        "data": sequence.name,
        "frames": [int(first), int(last)],
        "changes_percent": (100 * np.linalg.norm(np.diff(shapes, axis=0), axis=(1, 2)) / size).tolist(),
        "ends_apart_percent": float(100 * np.linalg.norm(shapes[-1] - shapes[0]) / size),
        "edges": sequence.edges if len(sequence.edges) else np.array(model.layout.edges, int).reshape(-1, 2),
        "shapes": pose.R @ shapes,
    }


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
    """A row a file, all shapes from the first frame's camera, turned a little; blue the first, red the last."""
    figure = new_figure(1.55 * _SHAPES, 2.3 * len(strips) + 0.5)
    figure.suptitle(f"Between two codes of {model.name}", fontsize=12, fontweight="bold")
    axes = figure.subplots(len(strips), _SHAPES, squeeze=False)
    for row, strip in zip(axes, strips):
        seen = turned_view(strip["shapes"] - strip["shapes"].mean(2, keepdims=True))
        for place, (ax, shape) in enumerate(zip(row, seen)):
            share = place / (_SHAPES - 1)
            draw_shape(ax, shape, strip["edges"], between(share))
            ends = {0: f"{strip['data']}\nframe {strip['frames'][0]}", _SHAPES - 1: f"frame {strip['frames'][1]}"}
            ax.set_title(ends.get(place, f"{share:.3g}"), fontsize=9)
        bare(row, seen)
    return figure
