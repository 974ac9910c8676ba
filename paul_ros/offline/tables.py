# SPDX-License-Identifier: Apache-2.0
"""Tables of text on standard output, drawn by rich."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from paul_ros.extras import require


@dataclass(frozen=True)
class Missing:
    """A cell without a figure: "-" in the table, and the reason below it.

    Attributes:
        name: of the figure.
        why: why it is missing, without a full stop.
    """

    name: str
    why: str


Cell = str | float | Missing | None
Row = Sequence[Cell]
"""Cells from the left: texts are shown as they are, numbers in the format of their column, None as "-"."""

_UNLIMITED = 10_000  # width of a file or a pipe, so that no line is folded


def render(columns: Sequence[tuple[str, str]], rows: Iterable[Row]) -> str:
    """Return aligned lines of text.

    A terminal gets a bold heading, dim units, and lines of its own width. Only texts and units are folded, between
    words. A file or a pipe gets plain text, a line for each row. Every reason for a missing figure follows in a line.

    Args:
        columns: heading and kind: "text" (aligned left), "unit" (aligned left, dim), or the format of numbers
            (aligned right), as ".2f". If all headings are empty, none is drawn.
        rows: the cells that a row lacks are empty; a row without cells is an empty line.

    Raises:
        MissingPackageError: rich is not installed.
    """
    require("bags", "rich")
    from rich import box
    from rich.cells import cell_len
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table

    rows = list(rows)
    headings, kinds = zip(*columns)
    texts = [[cell(value, kind) for value, kind in zip(row, kinds)] for row in rows]
    watched = sys.stdout is not None and sys.stdout.isatty()
    console = Console(
        force_terminal=watched, width=None if watched else _UNLIMITED, markup=False, emoji=False, highlight=False
    )
    style = box.SIMPLE_HEAD if watched else None
    table = Table(box=style, show_edge=False, show_header=any(headings), header_style="bold")
    for heading, kind, cells in zip(headings, kinds, zip_longest(headings, *texts, fillvalue="")):
        is_number = kind not in ("text", "unit")
        table.add_column(
            heading,
            justify="right" if is_number else "left",
            style="dim" if kind == "unit" else "",
            no_wrap=is_number,
            min_width=max(map(cell_len, cells if is_number else " ".join(cells).split()), default=0),
        )
    for row in texts:
        table.add_row(*row)
    # In a narrower terminal, rich would fold numbers and leave out columns.
    least = Measurement.get(console, console.options.update_width(_UNLIMITED), table).minimum
    console.width = max(console.width, least)
    with console.capture() as captured:
        console.print(table, crop=False)
    missing: dict[str, dict[str, None]] = {}  # reason -> names, each once
    for value in (value for row in rows for value in row if isinstance(value, Missing)):
        missing.setdefault(value.why, {})[value.name] = None
    reasons = [f" - {'; '.join(names)}: {why}" for why, names in missing.items()]
    return "\n".join([*(line.rstrip() for line in captured.get().splitlines()), *reasons])


def figure(value: str | float | None, name: str, why: str) -> Cell:
    """Return a figure of a report as a cell, which says why it is missing if it is None."""
    return Missing(name, why) if value is None else value


def cell(value: Cell, kind: str = ".1f") -> str:
    """Return the text of a cell in a column of this kind."""
    if value is None or isinstance(value, Missing):
        return "-"
    return value if isinstance(value, str) else format(value, kind)
