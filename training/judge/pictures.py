# SPDX-License-Identifier: Apache-2.0
"""What the pictures of evaluation, benchmark and studies share. Matplotlib is imported when one is drawn."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.errors import PictureError
from paul_ros.extras import require
from paul_ros.files import write_atomically

COLOURS = ("#1f77d0", "#e4572e", "#2a9d50", "#f0a030", "#8458b3", "#444444", "#17a2b8", "#c2185b")
_METHODS = {
    "paul": ("PAUL", "#1f77d0"),
    "adl": ("ADL", "#e4572e"),
    "adl_low_rank": ("ADL + low rank", "#f0a030"),
    "linear": ("linear", "#2a9d50"),
    "rigid": ("rigid", "#9a9a9a"),
}
TRUTH_COLOUR = "#b8b8b8"
ERROR_COLOUR = "#d62728"

_WIDE = 5.0
"""Errors that differ by more than this factor are drawn over decades."""

_LEGEND_COLUMN = 1.45
"""Inches of a name in a legend."""

_YAW, _PITCH = np.radians(35.0), np.radians(-15.0)


def method_look(method: str) -> tuple[str, str]:
    """A method's name for people and its colour; recipes of the user's own share one."""
    return _METHODS.get(method, (Path(method).stem, "#8458b3"))


def new_figure(width: float, height: float) -> Any:
    """A figure of so many inches. Raises ImportError, with a text for the user, without matplotlib."""
    require("benchmark", "matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: str | Path) -> None:
    """Write a figure atomically; the suffix chooses the format. Raises PictureError for an odd one."""
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    try:
        figure.savefig(buffer, format=Path(path).suffix.lstrip(".") or "png", dpi=120)
    except ValueError as error:
        raise PictureError(f"{path}: {error}") from error
    write_atomically(path, buffer.getvalue())


def between(share: float) -> tuple[float, ...]:
    """A colour from blue, share 0, to red, share 1."""
    blue, red = np.array([0.12, 0.47, 0.82]), np.array([0.84, 0.15, 0.16])
    return tuple((1 - share) * blue + share * red)


def titled(ax: Any, title: str) -> None:
    """A panel's title, at the left."""
    ax.set_title(title, loc="left", fontweight="bold", fontsize=11)


def legend_above(figure: Any, ax: Any) -> None:
    """The legend of a panel's lines in rows above the figure, each name once."""
    handles, names = ax.get_legend_handles_labels()
    first = dict(zip(reversed(names), reversed(handles)))
    names = list(dict.fromkeys(names))
    if names:
        columns = min(len(names), int(figure.get_figwidth() / _LEGEND_COLUMN))
        place = dict(loc="outside upper center", ncols=columns, frameon=False, fontsize=10)
        figure.legend([first[name] for name in names], names, **place)


def percent_axis(ax: Any, label: str = "normalised error, %") -> None:
    """Errors that have been drawn: over decades, ticked with plain numbers; where they differ little, a usual axis."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    low, high = ax.dataLim.intervaly
    if high > _WIDE * low:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(FixedLocator(_ticks(*ax.get_ylim())))
        ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_ylabel(label)
    ax.grid(axis="y", color="#ececec", zorder=0)
    ax.set_axisbelow(True)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers between two limits that are far apart, as many as can be read."""
    for steps in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7)):
        ticks = [round(step * 10.0**power, 6) for power in range(-4, 5) for step in steps]
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= 4:
            break
    return inside


def middle_and_half(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle (2,) and half the side of a square that holds points (N,2) with a margin; NaN does not count."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    return (low + high) / 2, 0.54 * (high - low).max() or 1.0


def turned_view(S: np.ndarray) -> np.ndarray:
    """What a viewer a little to the right and above sees of shapes (...,3,P): x right, y down, (...,2,P)."""
    cos, sin = np.cos(_YAW), np.sin(_YAW)
    across = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    cos, sin = np.cos(_PITCH), np.sin(_PITCH)
    return (np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ across @ S)[..., :2, :]


def draw_shape(ax: Any, shape: np.ndarray, edges: np.ndarray, colour: Any, truth: np.ndarray | None = None) -> None:
    """One shape (2,P), y down, as lines and points, over its truth: red lines join each point with where it belongs."""
    size = 10.0 if shape.shape[1] <= 200 else 2000.0 / shape.shape[1]
    if truth is not None:
        _draw_lines(ax, truth, edges, TRUTH_COLOUR, 3.0)
        ax.scatter(*truth, s=2.2 * size, color=TRUTH_COLOUR, linewidths=0, zorder=2)
        for begin, end in zip(truth.T, shape.T):
            ax.plot(*np.stack([begin, end], 1), color=ERROR_COLOUR, linewidth=1.0, zorder=3)
    _draw_lines(ax, shape, edges, colour, 1.4)
    ax.scatter(*shape, s=size, color=[colour], linewidths=0, zorder=5)


def _draw_lines(ax: Any, shape: np.ndarray, edges: np.ndarray, colour: Any, width: float) -> None:
    for pair in edges:
        ax.plot(*shape[:, list(pair)], color=colour, linewidth=width, solid_capstyle="round", zorder=2)


def bare(axes: Any, shapes: np.ndarray) -> None:
    """No axes around panels of shapes (...,2,P), and one scale for all; points of NaN are not drawn."""
    (x, y), half = middle_and_half(np.moveaxis(shapes, -2, -1).reshape(-1, 2))
    for ax in np.ravel(axes):
        ax.set(xlim=(x - half, x + half), ylim=(y + half, y - half))
        ax.set_aspect("equal")
        ax.set_axis_off()
