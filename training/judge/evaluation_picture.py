# SPDX-License-Identifier: Apache-2.0
"""Picture of `paul evaluate --plot`: frames over their truth, and the errors of all frames in order of size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from paul_ros import metrics
from training.judge.comparison import Comparison, errors_of_signs, pair
from training.judge.pictures import (
    BASELINE_COLOUR,
    COLOURS,
    draw_shape,
    frame_panels,
    new_figure,
    percent_axis,
    save_figure,
    titled,
    turned_view,
)

_SHARES = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Frames that are drawn, by the share of frames with a smaller error."""


def write_picture(path: str | Path, compared: Comparison, title: str) -> None:
    """Draw the picture and write it.

    Raises:
        MissingPackageError: matplotlib is not installed.
        PictureError: matplotlib cannot write the format of the suffix.
    """
    signs = errors_of_signs(compared.found.S, compared.truth, compared.rows)
    rigid = errors_of_signs(compared.rigid.S, compared.truth, compared.rows).min(1)
    error, flipped = 100 * signs.min(1), signs[:, 1] < signs[:, 0]
    order = error.argsort()
    chosen = order[[int(round(share * (len(order) - 1))) for share in _SHARES]]
    predicted, true = pair(compared.found.S, compared.truth, compared.rows[chosen])
    predicted = np.where(flipped[chosen, None, None], metrics.flip_depth(predicted), predicted)
    figure = new_figure(14, 8.2)
    figure.suptitle(title, fontsize=13, fontweight="bold")
    above, below = figure.subfigures(2, 1, height_ratios=[1.9, 1])
    _draw_frames(above.subplots(2, len(chosen)), compared, predicted, true, error[chosen])
    _draw_curve(below.subplots(), error[order], 100 * np.sort(rigid))
    save_figure(figure, path)


def _draw_frames(axes: Any, compared: Comparison, predicted: np.ndarray, true: np.ndarray, error: np.ndarray) -> None:
    """Draw frames as the camera sees them and from the side, over the truth in grey, with errors as red lines."""
    predicted, true = ((points - points.mean(1, keepdims=True)).transpose(0, 2, 1) for points in (predicted, true))
    size = np.linalg.norm(true, axis=(1, 2))[:, None, None]
    predicted, true = predicted / size, true / size
    views = ("as the camera sees it", lambda S: S[:, :2]), ("turned by 35 degrees", turned_view)
    for row, (name, view) in zip(axes, views):
        for ax, shape, truth in zip(row, view(predicted), view(true)):
            draw_shape(ax, shape, compared.truth.edges, COLOURS[0], truth)
        row[0].text(-0.04, 0.5, name, rotation=90, va="center", ha="right", transform=row[0].transAxes, fontsize=10)
    frame_panels(axes, np.stack([view(S) for _, view in views for S in (predicted, true)]))
    for ax, share, value in zip(axes[0], _SHARES, error):
        ax.set_title(f"{_frame_name(share)}\nNE {value:.2f} %", fontsize=10)


def _frame_name(share: float) -> str:
    """Return the name of the frame whose error exceeds those of this share of the frames."""
    names = {1.0: "worst frame", 0.5: "median frame"}
    return names.get(share, f"{100 * share:g} % of frames are better")


def _draw_curve(ax: Any, found: np.ndarray, rigid: np.ndarray) -> None:
    """Draw sorted errors (M,) of prediction and baseline over the share of frames."""
    share = 100 * (np.arange(len(found)) + 0.5) / len(found)
    ax.plot(share, rigid, color=BASELINE_COLOUR, label="rigid mean shape")
    ax.plot(share, found, color=COLOURS[0], label="predicted")
    ax.set(xlabel="share of frames that are better, %", xlim=(0, 100))
    percent_axis(ax)
    titled(ax, "Normalised error of every frame, depth flipped where that is better; frames in order of size")
    ax.legend(frameon=False, fontsize=10)
