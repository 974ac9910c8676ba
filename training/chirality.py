# SPDX-License-Identifier: Apache-2.0
"""The mirror image of shapes, by the layout's handedness rules or by agreement with their mean."""

from __future__ import annotations

from typing import Any

import numpy as np

from paul_ros.layout import Layout

CLEAR_SHARE = 0.95
"""Share of shapes on the right side of the handedness rules above which the chirality is known."""


def rule_share(shapes: np.ndarray, layout: Layout) -> float | None:
    """Return the share of shapes (F,3,P) on the right side of every handedness rule; None without a rule."""
    if not layout.handedness:
        return None
    keeps = np.ones(len(shapes), bool)
    for rule in layout.handedness:
        middle = {part: shapes[:, :, list(points)].mean(2) for part, points in vars(rule).items()}
        axes = [
            middle["left"] - middle["right"],
            middle["above"] - middle["below"],
            middle["front"] - middle["behind"],
        ]
        keeps &= np.linalg.det(np.stack(axes, axis=1)) > 0
    return float(keeps.mean())


def chirality_text(chirality: dict[str, Any]) -> str:
    """Return the header's ``chirality`` in words, and why it is unknown."""
    if chirality["known"]:
        return f"known, {chirality['source']}"
    share = chirality.get("training_share", 1.0)
    if share >= CLEAR_SHARE:
        return f"UNKNOWN, {chirality['source']}"
    return f"UNKNOWN, only {100 * share:.0f} % of the frames obey the {chirality['source']}: train longer"


def same_side_share(shapes: np.ndarray, mean: np.ndarray) -> float:
    """Return the share of shapes (F,3,P) that rotate onto the mean (3,P) better than their mirror images do.

    Let a >= b >= c be the singular values of S mean^T. S fits by a + b +- c, and its mirror image by a + b -+ c. The
    sign is that of the determinant.
    """
    return float((np.linalg.det(shapes @ mean.T) > 0).mean())
