# SPDX-License-Identifier: Apache-2.0
"""What the pictures of evaluation, benchmark and studies share. Matplotlib is imported when one is drawn."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.benchmarks import need
from paul_ros.files import write_atomically
from paul_ros.report import PictureError

COLOURS = ("#1f77d0", "#e4572e", "#2a9d50", "#f0a030", "#8458b3", "#444444", "#17a2b8", "#c2185b")
METHOD_COLOURS = {
    "paul": "#1f77d0",
    "adl": "#e4572e",
    "adl_low_rank": "#f0a030",
    "linear": "#2a9d50",
    "rigid": "#9a9a9a",
}
TRUTH_COLOUR = "#b8b8b8"
ERROR_COLOUR = "#d62728"

_YAW, _PITCH = np.radians(35.0), np.radians(-15.0)


def method_colour(method: str) -> str:
    """Of a method's lines and bars; recipes of the user's own share one."""
    return METHOD_COLOURS.get(method, "#8458b3")


def new_figure(width: float, height: float) -> Any:
    """A figure of so many inches. Raises ImportError, with a text for the user, without matplotlib."""
    need("matplotlib")
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
    """The legend of a panel's lines in a row above the figure, each name once."""
    handles, names = ax.get_legend_handles_labels()
    first = dict(zip(reversed(names), reversed(handles)))
    names = list(dict.fromkeys(names))
    if names:
        place = dict(loc="outside upper center", ncols=min(len(names), 6), frameon=False, fontsize=10)
        figure.legend([first[name] for name in names], names, **place)


def percent_axis(ax: Any, label: str = "normalised error, %") -> None:
    """Errors over decades, ticked with plain numbers."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    ax.set_yscale("log")
    ax.yaxis.set_major_locator(FixedLocator(_ticks(*ax.get_ylim())))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.set_ylabel(label)
    ax.grid(axis="y", color="#ececec", zorder=0)
    ax.set_axisbelow(True)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers between two limits, as many as can be read."""
    for steps in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7), np.arange(1, 10, 0.2)):
        ticks = [round(step * 10.0**power, 6) for power in range(-4, 5) for step in steps]
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= 4:
            break
    return inside[:: 1 + len(inside) // 12]


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
    """No axes around panels of shapes (...,2,P), and one scale for all."""
    points = np.moveaxis(shapes, -2, -1).reshape(-1, 2)
    middle = (points.min(0) + points.max(0)) / 2
    half = 0.54 * np.ptp(points, axis=0).max() or 1.0
    for ax in np.ravel(axes):
        ax.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] + half, middle[1] - half))
        ax.set_aspect("equal")
        ax.set_axis_off()
