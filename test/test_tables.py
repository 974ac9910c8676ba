# SPDX-License-Identifier: Apache-2.0
"""Tables on standard output: plain in a pipe, as wide as a terminal allows where one watches."""

from __future__ import annotations

import re
import sys

import pytest

from paul_ros.errors import MissingPackageError
from paul_ros.offline.tables import Missing, cell, figure, render

COLUMNS = ("", "text"), ("lifted", ".1f"), ("99 %", ".2f"), ("", "unit")
ROWS = [
    ("error [bold] of :smile:", 60.3, "9.20 / 11.00", "mm"),
    (),
    ("誤差", 12345.6, Missing("99 %", "too few"), "µs of one pose, alone or in a batch of many"),
]


@pytest.fixture
def terminal(monkeypatch):
    """Draw as on a terminal of the given width; returns the lines with their styles."""

    def drawn(width: int) -> list[str]:
        monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setenv("TERM", "xterm")
        return render(COLUMNS, ROWS).splitlines()

    return drawn


def plain(line: str) -> str:
    return re.sub("\x1b\\[[0-9;]*m", "", line).rstrip()


@pytest.mark.parametrize("variable", ["COLUMNS", "FORCE_COLOR"])
def test_a_pipe_gets_plain_text(variable, monkeypatch):
    monkeypatch.setenv(variable, "20")
    assert render(COLUMNS, ROWS).splitlines() == [
        "                           lifted          99 %",
        " error [bold] of :smile:     60.3  9.20 / 11.00  mm",
        "",
        " 誤差                     12345.6             -  µs of one pose, alone or in a batch of many",
        " - 99 %: too few",
    ]


def test_every_reason_for_a_missing_figure_is_stated_once():
    rows = [
        ("a", figure(None, "x", "no ids")),
        ("b", figure(0.0, "x", "no ids")),
        ("c", Missing("x", "no ids"), Missing("y", "no ids")),
        ("d", Missing("z", "no metres")),
    ]
    lines = render((("", "text"), ("x", ".1f"), ("y", ".1f")), rows).splitlines()
    assert [line.split() for line in lines[1:5]] == [["a", "-"], ["b", "0.0"], ["c", "-", "-"], ["d", "-"]]
    assert lines[5:] == [" - x; y: no ids", " - z: no metres"]


def test_nothing_is_folded_in_a_pipe():
    (line,) = render((("", "text"), ("", "unit")), [("long " * 100, "unit " * 100)]).splitlines()
    assert line.split() == 100 * ["long"] + 100 * ["unit"]


def test_a_terminal_gets_styles_and_a_rule(terminal):
    head, rule, first, *_ = terminal(100)
    assert "\x1b[1m" in head and "\x1b[2m" in first and set(plain(rule)) == {"─"}
    assert plain(first).split() == ["error", "[bold]", "of", ":smile:", "60.3", "9.20", "/", "11.00", "mm"]


@pytest.mark.parametrize("width", [70, 50, 20, 1])
def test_a_narrow_terminal_folds_texts_between_words_and_no_numbers(terminal, width):
    lines = [plain(line) for line in terminal(width)]
    text = "\n".join(lines)
    words = [word for row in ROWS for value in row for word in cell(value).split()]
    assert all(word in text for word in (*words, "lifted", "99 %", "9.20 / 11.00"))
    assert len(lines) > 5 and max(map(len, lines)) <= max(width, 50)


def test_a_dumb_terminal_gets_no_styles(terminal, monkeypatch):
    terminal(100)
    monkeypatch.setenv("TERM", "dumb")
    assert "\x1b" not in render(COLUMNS, ROWS)


def test_a_closed_standard_output_is_no_terminal(monkeypatch):
    monkeypatch.setattr("sys.stdout", None)
    assert render((("a", "text"), ("b", "d")), [("x", 1)]) == " a  b\n x  1"


def test_no_headings_no_head():
    assert render((("", "text"), ("", "d")), [("a", 1), ("bc", 10)]) == " a    1\n bc  10"


def test_a_cell():
    assert [cell(None), cell(1.25, ".2f"), cell(3, "d"), cell("a", ".1f")] == ["-", "1.25", "3", "a"]


def test_without_rich_the_error_names_the_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "rich", None)
    with pytest.raises(MissingPackageError, match="\\.\\[bags\\]"):
        render([("a", "text")], [])
