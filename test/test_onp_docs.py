# SPDX-License-Identifier: Apache-2.0
"""The explanation of OnP: its example runs, its script prints its tables, and its formulas hold."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from test_links import broken_links

from paul_ros.orthographic_n_point import onp

DOCS = Path(__file__).resolve().parent.parent / "docs"
sys.path.append(str(DOCS))

import onp_pictures as pictures
import onp_tables

PAGE = next(DOCS.rglob("onp.md"))
TABLES = ("certificate", "failures", "uncertified", "optima", "approximation")


def cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip("| \n").split("|")]


def differences(printed: list[str], page: str) -> list[tuple[str, str]]:
    """Return cells in which page and printed table differ by more than the rounding of other machines."""
    start = page.index(printed[0] + "\n")
    quoted = page[start:].splitlines()[: len(printed)]
    pairs = [pair for rows in zip(printed, quoted, strict=True) for pair in zip(*map(cells, rows), strict=True)]
    return [pair for pair in pairs if not _agree(*pair)]


def _agree(x: str, y: str) -> bool:
    if x == y:
        return True
    try:
        return abs(float(x) - float(y)) <= 0.021 + 0.03 * abs(float(y))
    except ValueError:
        return False


@pytest.mark.parametrize("name", TABLES)
def test_the_page_quotes_what_its_script_prints(name):
    assert differences(getattr(onp_tables, f"{name}_table")(), PAGE.read_text()) == []


def test_a_wrong_quotation_is_found():
    printed = ["| a | b |", "| --- | --- |", "| 1 | 2.00 |"]
    assert differences(printed, "text\n\n| a | b |\n| --- | --- |\n| 1 | 2.50 |\n") == [("2.00", "2.50")]
    with pytest.raises(ValueError):
        differences(printed, "no such table")


def test_links_and_pictures_exist():
    assert not broken_links(PAGE)


def test_the_example_runs():
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    names = {}
    exec(example, names)
    pose = names["pose"]
    assert names["proven"].all() and names["clear"].sum() == len(names["views"]) > 900
    assert np.median(np.abs(pose.scale - 2.5)) < 0.2 and np.median(names["views"][:, 2]) > 0.98
    error = np.where(names["visible"][:, None], names["image"] - names["W"], 0.0)
    np.testing.assert_allclose(pose.residual, np.sqrt((error**2).sum((1, 2)) / names["visible"].sum(1)))
    np.testing.assert_allclose(names["single"].R, pose.R[:1], atol=1e-7)


@pytest.mark.parametrize("scale", ["free", "unit"])
def test_goal_and_residual_as_written(scale):
    """The page's formulas give the residual of the pose, and no direction has a smaller one."""
    for seed in range(10):
        S, W, _ = pictures.random_problems(1, 7, 0.4, 0.5, seed)
        W = 3.0 * W
        problems, V = pictures.reduced(S, W)
        problem, found = pictures.single(problems), onp(S, W, scale=scale)
        every = np.array(pictures.vs.fibonacci_sphere(500))
        n = np.concatenate([found.R[:1, 2] @ V[0], every])
        g = pictures.goal(problem, *pictures.energies(problem, n), scale)
        residual = pictures.relative_residual(problem.k, g, scale) * np.sqrt(W[0].var(1).sum())
        assert residual[0] == pytest.approx(found.residual[0], rel=1e-6)
        assert (residual >= residual[0] * (1 - 1e-9)).all()


def test_the_certificates_lemma_is_an_identity():
    rng = np.random.default_rng(0)
    for _ in range(20):
        K, multiplier = rng.standard_normal((3, 3)), rng.standard_normal()
        n, best = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        K = K + K.T
        h = multiplier * best - K @ best
        rise = n @ K @ n + 2 * h @ n - best @ K @ best - 2 * h @ best
        assert rise == pytest.approx(-(n - best) @ (multiplier * np.eye(3) - K) @ (n - best))


def test_the_map_keeps_directions():
    frame = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    p, n = pictures.disc_grid(frame, size=21)
    on = (p**2).sum(-1) < 0.99
    np.testing.assert_allclose(pictures.to_disc(frame, n[on]), p[on], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(n[on], axis=1), 1)


def test_the_pictures_can_be_drawn(tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    pictures.draw_maps(tmp_path / "maps.png")
    assert 10_000 < (tmp_path / "maps.png").stat().st_size < 300_000
