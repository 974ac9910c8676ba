# SPDX-License-Identifier: Apache-2.0
"""The canvas of a film: one matplotlib figure that every picture is drawn on, and the view of its turntable."""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_adapters.palette import SIDE_COLOURS
from paul_ros.offline.figures import new_figure

AMBER, CALM, INK, PALE = "#f5a800", "#e9eef2", "#333333", "#d5d8db"

#: Style of a panel's title.
CAPTION: dict[str, Any] = dict(fontsize=8.5, color="#555555", loc="left", pad=3)

_SIZE, _DPI = (9.0, 5.0), 100  # inches, pixels per inch
_PITCH = np.radians(12.0)  # the viewer of the turntable looks down by this angle


class Canvas:
    """A figure of 900 x 500 pixels that is cleared and drawn on again for each picture."""

    def __init__(self) -> None:
        """Make the figure. Raises MissingPackageError without matplotlib."""
        self._figure = new_figure(*_SIZE, dpi=_DPI, facecolor="white", layout="none")

    def clear(self) -> None:
        """Remove everything that was drawn."""
        self._figure.clear()

    def panel(self, place: tuple[float, float, float, float]) -> Any:
        """Return axes at (left, bottom, width, height), shares of the figure."""
        return self._figure.add_axes(place)

    def title(self, left: str, right: str, colour: str) -> None:
        """Draw a bar across the top with a text at either end."""
        bar = self._figure.add_axes((0, 0.93, 1, 0.07), facecolor=colour, xticks=[], yticks=[])
        for spine in bar.spines.values():
            spine.set_visible(False)
        bar.text(0.015, 0.45, left, va="center", fontsize=11, color=INK, fontweight="bold")
        bar.text(0.985, 0.45, right, va="center", ha="right", fontsize=10, color=INK)

    def pixels(self) -> np.ndarray:
        """Return the picture, (height, width, 3) uint8."""
        self._figure.canvas.draw()
        return np.asarray(self._figure.canvas.buffer_rgba())[..., :3].copy()


def draw_legend(ax: Any, all_visible: bool) -> None:
    """Name the colours of the sides in a panel, and the dimming if some keypoints are hidden."""
    words = [(side, SIDE_COLOURS[side]) for side in ("left", "right")]
    words += [] if all_visible else [("pale: not seen", "#888888")]
    for row, (word, colour) in enumerate(words):
        ax.text(0.02, 0.03 + 0.05 * row, word, color=colour, fontsize=9, transform=ax.transAxes, fontweight="bold")


def show_box(ax: Any, box: np.ndarray) -> None:
    """Show a box [[left, top], [right, bottom]] of the plane whole and as large as it fits, y down."""
    (left, top), (right, bottom) = box
    place = ax.get_position()
    wide, tall = place.size * ax.figure.get_size_inches()
    half = max(abs(right - left) / wide, abs(bottom - top) / tall) / 2 * np.array([wide, tall])
    half *= np.sign([right - left, bottom - top])
    middle = np.array([left + right, top + bottom]) / 2
    (left, top), (right, bottom) = middle - half, middle + half
    ax.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set_color(PALE)


def turntable(angle: float) -> np.ndarray:
    """Return the rotation (3,3) from the camera frame to a viewer who went round by an angle and looks down a little.

    Args:
        angle: radians about the vertical.
    """
    c, s = np.cos(angle), np.sin(angle)
    around = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(_PITCH), np.sin(_PITCH)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ around
