# SPDX-License-Identifier: Apache-2.0
"""Figures and generated tables of README and pages are those of docs/numbers.json and of the code."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest
from conftest import needs

ROOT = Path(__file__).resolve().parent.parent


def script(name: str) -> ModuleType:
    """A script of docs/, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"docs/{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


generate = script("generate")
PAGES = [page for page in generate.PAGES if "<!--" in page.read_text()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_figures_and_generated_tables_are_up_to_date(page: Path) -> None:
    text = page.read_text()
    assert generate.filled(text) == text, "run python docs/generate.py"


@needs("mcap", "rosbags")
def test_quick_figures_are_those_measured_now() -> None:
    measure = script("measure")
    stored = json.loads(generate.NUMBERS.read_text())
    for group, values in (("recordings", measure.recordings()), ("model", measure.model())):
        assert stored[group]["values"] == pytest.approx(values, rel=1e-3, abs=1e-3), "run python docs/measure.py"


def test_every_group_says_where_its_figures_come_from() -> None:
    for group in json.loads(generate.NUMBERS.read_text()).values():
        assert group["command"] and group["machine"] and group["date"].startswith("20")


def test_a_figure_keeps_its_decimals_commas_and_stars(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "numbers", lambda: {"a.b": 1234.5678, "c": 0.5})
    assert (
        generate.filled("1<!--a.b-->, 1,1.0<!--a.b-->, **9.99**<!--c-->")
        == "1235<!--a.b-->, 1,234.6<!--a.b-->, **0.50**<!--c-->"
    )


def test_an_unknown_figure_is_refused() -> None:
    with pytest.raises(KeyError):
        generate.filled("1<!--nothing.of_the_kind-->")


def test_slow_figures_come_from_the_reports_of_their_commands() -> None:
    measure = script("measure")
    row = {"persons": 1, "rate_hz": 100, "latency_median_us": 2000.0, "rss_mb": 80.0}
    assert measure.node([{"node": "lifter", **row}, {"node": "echo", **row}])["node.1_100.echo_median_ms"] == 2.0
    rows = [{"sequence": "yoga", "method": "paul", "ne_flip_frame_percent": value} for value in (1.0, 3.0, 2.0)]
    assert measure.nrsfm([*rows, {"sequence": "yoga", "method": "adl"}]) == {"nrsfm.yoga.median": 2.0}
    errors = dict.fromkeys(("pa_mpjpe_mm", "n_mpjpe_mm", "root_error_median_mm", "root_error_median_percent"), 5.0)
    what = ("coco17, true 2D", "coco17, noise profile")
    rows = [{"model": name, "what": one, **errors} for name in ("human", measure.RIGID, "labels.npz") for one in what]
    found = measure.human(rows)
    assert found.keys() == json.loads(generate.NUMBERS.read_text())["human"]["values"].keys()
