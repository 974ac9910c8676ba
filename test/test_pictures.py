# SPDX-License-Identifier: Apache-2.0
"""Pictures of the benchmark and of studies, drawn from artificial outcomes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from training.judge import nrsfm
from training.judge.experiments import Experiment, Outcome
from training.judge.pictures import new_figure, percent_axis
from training.judge.published import NORMALISED_ERROR_PERCENT
from training.judge.studies.registry import STUDIES
from training.judge.truth import Sequence

FRAMES = 30


def outcomes(experiments, error, ratio=1.0):
    """Return outcomes with codes on the right half of a ring about (5, 5).

    Args:
        experiments: of the outcomes.
        error: gives the error of an experiment, flip per frame.
        ratio: of the error with one flip for all to that one.
    """
    angle = np.linspace(-np.pi / 2, np.pi / 2, FRAMES)
    codes = 5 + np.stack([np.cos(angle), np.sin(angle)], 1)
    return [Outcome(one, error(one), ratio * error(one), one.seed, 1.0, codes) for one in experiments]


def sequences(*names):
    S = np.random.default_rng(0).standard_normal((FRAMES, 3, 9))
    return [Sequence(name, S[:, :2], np.ones((FRAMES, 9), bool), S, np.zeros((0, 2), int), False) for name in names]


def drawn(name, error, seeds=2, ratio=1.0):
    study = STUDIES[name]
    found = outcomes(study.plan(sequences("drink"), seeds, study.values, ()), error, ratio)
    return study.draw(found, study.report(found))


def legend_names(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize(
    "errors, scale", [((9.2, 9.6, 10.0), "linear"), ((1.0, 4.9), "linear"), ((1, 6), "log"), ((0.3, 40.0), "log")]
)
def test_ticks_of_errors_are_several_and_do_not_overlap(errors, scale):
    figure = new_figure(6, 4)
    ax = figure.subplots()
    ax.plot(range(len(errors)), errors)
    percent_axis(ax)
    figure.canvas.draw()
    shown = [label.get_window_extent() for label in ax.get_yticklabels()]
    shown = [box for box in shown if ax.bbox.y0 <= (box.y0 + box.y1) / 2 <= ax.bbox.y1]
    assert ax.get_yscale() == scale and len(shown) >= 4
    assert all(above.y0 > below.y1 for below, above in zip(shown, shown[1:]))


@pytest.mark.parametrize("name", ["bottleneck", "noise", "hidden"])
def test_sweeps_show_one_flip_for_all_beside_flip_per_frame(name):
    figure = drawn(name, lambda one: 2.0 + one.value, ratio=3.0)
    (ax,) = figure.axes
    dashed, solid = (
        line for style in ("--", "-") for line in ax.lines if line.get_linestyle() == style and len(line.get_ydata())
    )
    np.testing.assert_allclose(dashed.get_ydata(), 3 * solid.get_ydata())
    assert dashed.get_color() == solid.get_color()
    assert legend_names(figure) == ["drink", "one flip for all, where it differs"]


def test_the_median_of_a_bar_is_at_its_foot_not_above_the_highest_run():
    figure = drawn("auto_decoder", lambda one: (2.0, 30.0, 3.0)[one.seed], seeds=3)
    (ax,) = figure.axes
    assert [(text.get_text(), text.xy[1]) for text in ax.texts] == [("3.00", 0)] * 3
    assert [text.xy[0] for text in ax.texts] == pytest.approx([bar.get_x() + bar.get_width() / 2 for bar in ax.patches])
    assert legend_names(figure) == ["PAUL", "ADL", "ADL + low rank"]


def test_codes_fill_their_panel_and_nothing_lies_over_them():
    figure = drawn("latent", lambda one: 3.0)
    panels = figure.axes[:4]
    assert [ax.get_title().splitlines()[0] for ax in panels[:2]] == ["drink, own cameras", "drink, random cameras"]
    assert all("roughness 0." in ax.get_title() and not ax.texts for ax in panels)
    for ax in panels:
        assert ax.get_xlim() == pytest.approx((5.5 - 1.08, 5.5 + 1.08), abs=0.01)
        assert ax.get_ylim() == pytest.approx((5 - 1.08, 5 + 1.08), abs=0.01)
    assert [ax.get_ylabel() for ax in panels[::2]] == ["PAUL", "ADL"]


def test_the_benchmark_names_methods_and_rivals(monkeypatch):
    kept = []
    monkeypatch.setattr(nrsfm, "save_figure", lambda figure, path: kept.append(figure))
    methods = [*nrsfm.METHODS, "/home/me/own.yaml"]
    experiments = [Experiment(sequence, method, 0) for sequence in sequences("drink", "S5") for method in methods]
    nrsfm.write_picture(Path("b.png"), nrsfm.report(outcomes(experiments, lambda one: 2.0)))
    (figure,) = kept
    names = legend_names(figure)
    assert names[:6] == ["PAUL", "ADL", "ADL + low rank", "linear", "rigid", "own"]
    rivals = set(NORMALISED_ERROR_PERCENT["drink"]) - {"PAUL"}
    assert set(names[6:]) == rivals | {"PAUL, published"}
    figure.canvas.draw()
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.x1
    marks = [mark for mark in figure.axes[0].collections if mark.get_label() in rivals]
    heights = {mark.get_label(): mark.get_offsets()[0, 1] for mark in marks[:5]}
    assert heights == {name: NORMALISED_ERROR_PERCENT["drink"][name] for name in rivals}
