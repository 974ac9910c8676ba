# SPDX-License-Identifier: Apache-2.0
"""The palette of messages, pictures and films: left is blue, right is orange, also for colour-blind viewers."""

from __future__ import annotations

#: Side of a keypoint ('left', 'right' or '' for the middle) -> colour as '#rrggbb'.
SIDE_COLOURS = {"left": "#1f77d0", "right": "#e4572e", "": "#7f7f7f"}


def rgb(colour: str) -> tuple[float, float, float]:
    """Return '#rrggbb' as (r, g, b), each 0 to 1.

    >>> rgb("#ff0000")
    (1.0, 0.0, 0.0)
    """
    red, green, blue = (int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5))
    return red, green, blue
