# SPDX-License-Identifier: Apache-2.0
"""The one drawing of a skeleton in 2D, shared by reports, films and the pictures of the trainer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from msg_adapters.palette import SIDE_COLOURS

HIDDEN_OPACITY = 0.25


def draw_skeleton(
    ax: Any,
    points: np.ndarray,
    edges: Any,
    sides: Sequence[str] | None = None,
    *,
    colour: Any = None,
    line_width: float = 2.2,
    dot_size: float = 0.0,
    visible: np.ndarray | None = None,
    depth: np.ndarray | None = None,
    rim: str = "",
    zorder: float = 2.0,
) -> None:
    """Draw the bones and points of one skeleton; a bone with a NaN end is left out.

    A point without a drawn bone always gets a dot, so that no layout is invisible.

    Args:
        ax: matplotlib axes. Their limits are not changed.
        points: (P,2) in data coordinates of the axes.
        edges: (E,2) indices of the ends of each bone.
        sides: (P,) 'left', 'right' or '' of each point. A bone between two sides has the middle's colour.
        colour: one matplotlib colour for all, instead of the colours of the sides.
        line_width: width of a bone in typographic points.
        dot_size: area of a keypoint's dot in square typographic points; 0 draws dots, as wide as bones, only for points
            without bones.
        visible: (P,) bool; bones and dots of other points are dimmed. None = all are visible.
        depth: (P,) distance from the viewer; nearer bones cover farther ones. None = the order of `edges`.
        rim: colour of a wide rim behind bones, and behind points without bones; '' = none.
        zorder: drawing order of the bones; dots lie one above.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba

    bones: np.ndarray = np.asarray(edges, int).reshape(-1, 2)
    if depth is not None:
        bones = bones[np.argsort(-depth[bones].mean(1))]
    seen = np.ones(len(points), bool) if visible is None else visible
    labels = [""] * len(points) if sides is None else sides

    def paint(side: str, is_seen: bool) -> tuple[float, float, float, float]:
        base = to_rgba(SIDE_COLOURS[side] if colour is None else colour)
        return base if is_seen else (*base[:3], HIDDEN_OPACITY * base[3])

    segments, lone = points[bones], _lone(points, bones)
    if rim:
        width = 2.3 * line_width
        wide = LineCollection(segments, colors=rim, linewidths=width, capstyle="round", alpha=0.9, zorder=zorder)
        ax.add_collection(wide, autolim=False)
        ax.scatter(*points[lone].T, s=width**2, color=rim, linewidths=0, alpha=0.9, zorder=zorder)
    colours = [
        paint(labels[one] if labels[one] == labels[other] else "", bool(seen[one] and seen[other]))
        for one, other in bones.tolist()
    ]
    lines = LineCollection(segments, colors=colours, linewidths=line_width, capstyle="round", zorder=zorder)
    ax.add_collection(lines, autolim=False)
    dotted = np.ones(len(points), bool) if dot_size else lone
    dots = [paint(side, bool(is_seen)) for side, is_seen, shown in zip(labels, seen, dotted) if shown]
    if dots:
        ax.scatter(*points[dotted].T, s=dot_size or line_width**2, c=dots, linewidths=0, zorder=zorder + 1)


def _lone(points: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """Return (P,) bool: points (P,2) that are no end of a drawn bone (E,2)."""
    drawn = bones[np.isfinite(points[bones]).all(axis=(1, 2))]
    return ~np.isin(np.arange(len(points)), drawn)
