# SPDX-License-Identifier: Apache-2.0
"""Parts that the pictures of evaluation, benchmark and studies share. Matplotlib is imported when one is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.palette import SIDE_COLOURS
from paul_ros.offline import figures
from paul_ros.offline.skeleton_drawing import draw_skeleton

BLUE, ORANGE = SIDE_COLOURS["left"], SIDE_COLOURS["right"]
COLOURS = (BLUE, ORANGE, "#2a9d50", "#f0a030", "#8458b3", "#444444", "#17a2b8", "#c2185b")
"""Colours of series that have none of their own."""

BASELINE_COLOUR = "#9a9a9a"
TRUTH_COLOUR = "#b8b8b8"
ERROR_COLOUR = "#d62728"

_METHODS = {
    "paul": ("PAUL", BLUE),
    "adl": ("ADL", ORANGE),
    "adl_low_rank": ("ADL + low rank", "#f0a030"),
    "linear": ("linear", "#2a9d50"),
    "rigid": ("rigid", BASELINE_COLOUR),
}
_OWN_RECIPE_COLOUR = "#8458b3"

_DPI = 120
_LOG_FACTOR = 5.0  # errors that differ by more are drawn on a logarithmic axis
_LEGEND_COLUMN = 1.45  # inches of a name in a legend
_DENSE = 200  # points; shapes with more have smaller dots
_YAW, _PITCH = np.radians(35.0), np.radians(-15.0)


def method_style(method: str) -> tuple[str, str]:
    """Return a method's printed name and its colour; recipes of the user share one colour."""
    return _METHODS.get(method, (Path(method).stem, _OWN_RECIPE_COLOUR))


def new_figure(width: float, height: float) -> Any:
    """Return a figure of a size in inches.

    Raises:
        MissingPackageError: matplotlib is not installed.
    """
    return figures.new_figure(width, height, extra="benchmark")


def save_figure(figure: Any, path: str | Path) -> None:
    """Write a figure atomically, without frames at the top and the right; the suffix chooses the format.

    Raises:
        PictureError: matplotlib cannot write the format.
    """
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
    figures.save_figure(figure, path, _DPI)


def blue_to_red(share: float) -> tuple[float, float, float]:
    """Return a colour between blue, share 0, and red, share 1."""
    blue, red = np.array([0.12, 0.47, 0.82]), np.array([0.84, 0.15, 0.16])
    r, g, b = ((1 - share) * blue + share * red).tolist()
    return r, g, b


def titled(ax: Any, title: str) -> None:
    """Set a panel's title, at the left."""
    ax.set_title(title, loc="left", fontweight="bold", fontsize=11)


def legend_above(figure: Any, ax: Any) -> None:
    """Place the legend of a panel's lines in rows above the figure, each name once."""
    handles, names = ax.get_legend_handles_labels()
    first = dict(zip(reversed(names), reversed(handles)))
    names = list(dict.fromkeys(names))
    if names:
        columns = min(len(names), int(figure.get_figwidth() / _LEGEND_COLUMN))
        place = dict(loc="outside upper center", ncols=columns, frameon=False, fontsize=10)
        figure.legend([first[name] for name in names], names, **place)


def percent_axis(ax: Any, label: str = "normalised error, %") -> None:
    """Scale the axis of errors that are already drawn.

    The axis is logarithmic with plain numbers if the errors differ much, otherwise linear.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    low, high = ax.dataLim.intervaly
    if high > _LOG_FACTOR * low:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(FixedLocator(_ticks(*ax.get_ylim())))
        ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_ylabel(label)
    ax.grid(axis="y", color="#ececec", zorder=0)
    ax.set_axisbelow(True)


def _ticks(low: float, high: float) -> list[float]:
    """Return round numbers between two limits that are far apart: at least four, and few enough to be read."""
    inside: list[float] = []
    for steps in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)):
        ticks = [round(step * 10.0**power, 6) for power in range(-4, 5) for step in steps]
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= 4:
            break
    return inside


def bounding_square(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return middle (2,) and half the side of a square that holds points (N,2) with a margin; NaN is ignored."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    return (low + high) / 2, 0.54 * (high - low).max() or 1.0


def turned_view(S: np.ndarray) -> np.ndarray:
    """Project shapes (...,3,P) for a viewer a little to the right and above: x right, y down, (...,2,P)."""
    cos, sin = np.cos(_YAW), np.sin(_YAW)
    across = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    cos, sin = np.cos(_PITCH), np.sin(_PITCH)
    return (np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ across @ S)[..., :2, :]


def draw_shape(ax: Any, shape: np.ndarray, edges: np.ndarray, colour: Any, truth: np.ndarray | None = None) -> None:
    """Draw one shape (2,P), y down, over its truth; red lines join each point with its true position."""
    dot = 10.0 if shape.shape[1] <= _DENSE else 10.0 * _DENSE / shape.shape[1]
    if truth is not None:
        draw_skeleton(ax, truth.T, edges, colour=TRUTH_COLOUR, line_width=3.0, dot_size=2.2 * dot, zorder=1)
        _draw_errors(ax, np.stack([truth.T, shape.T], axis=1))
    draw_skeleton(ax, shape.T, edges, colour=colour, line_width=1.4, dot_size=dot, zorder=4)


def _draw_errors(ax: Any, lines: np.ndarray) -> None:
    """Draw lines (P,2,2) between true and predicted points."""
    from matplotlib.collections import LineCollection

    ax.add_collection(LineCollection(list(lines), colors=ERROR_COLOUR, linewidths=1.0, zorder=3), autolim=False)


def frame_panels(axes: Any, shapes: np.ndarray) -> None:
    """Give panels of shapes (...,2,P) one common scale and no axes; points of NaN are ignored."""
    (x, y), half = bounding_square(np.moveaxis(shapes, -2, -1).reshape(-1, 2))
    for ax in np.ravel(axes):
        ax.set(xlim=(x - half, x + half), ylim=(y + half, y - half))
        ax.set_aspect("equal")
        ax.set_axis_off()
