# SPDX-License-Identifier: Apache-2.0
"""The drawing of a skeleton: every point of every layout is visible."""

from __future__ import annotations

import numpy as np
import pytest

from paul_ros.offline.skeleton_drawing import draw_skeleton

POINTS = np.array([[0.2, 0.2], [0.8, 0.2], [0.5, 0.8], [0.2, 0.8]])


def ink_at(points: np.ndarray, edges: list, **options) -> list[bool]:
    """Draw a skeleton; return at which of POINTS the picture has ink."""
    agg = pytest.importorskip("matplotlib.backends.backend_agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2, 2), dpi=100)
    canvas = agg.FigureCanvasAgg(figure)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.axis("off")
    draw_skeleton(ax, points, edges, **options)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[::-1, :, :3]
    return [bool((pixels[int(200 * y), int(200 * x)] < 250).any()) for x, y in POINTS.tolist()]


@pytest.mark.parametrize("dot_size", [0.0, 9.0])
@pytest.mark.parametrize("edges", [[], [(0, 1)], [(0, 1), (1, 2), (2, 3)]])
def test_every_point_is_drawn_with_any_edges(edges, dot_size):
    assert ink_at(POINTS, edges, colour="#c4c4c4", line_width=6.0, dot_size=dot_size) == [True] * 4


def test_a_point_whose_bones_end_in_missing_points_is_drawn():
    points = POINTS.copy()
    points[1] = np.nan
    assert ink_at(points, [(0, 1), (1, 2), (2, 3)]) == [True, False, True, True]


def test_the_rim_of_an_ambiguous_person_is_drawn_without_bones_too():
    plain, rimmed = (
        ink_at(POINTS + [0.012, 0.0], [], dot_size=1.0, line_width=3.0, rim=rim) for rim in ("", "#f0a030")
    )
    assert plain == [False] * 4 and rimmed == [True] * 4


def test_no_dot_is_drawn_on_a_bone_unless_asked_for():
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    draw_skeleton(ax, POINTS, [(0, 1), (1, 2), (2, 3)])
    assert len(ax.collections) == 1
