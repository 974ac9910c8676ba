# SPDX-License-Identifier: Apache-2.0
"""Tables of text on standard output, drawn by rich."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from itertools import zip_longest

from paul_ros.extras import require

_UNLIMITED = 10_000  # columns of a file or a pipe, so that no line is folded
_STYLES = {"t": "", "n": "", "u": "dim"}


def render(columns: Sequence[str], kinds: str, rows: Iterable[Sequence[str]]) -> str:
    """Return aligned lines of text.

    A terminal gets a bold heading, dim units, and lines of its own width. Only texts and units are folded, between
    words. A file or a pipe gets plain text, a line for each row.

    Args:
        columns: their headings. If all are empty, there is no heading.
        kinds: a letter for each column: t text (aligned left), n number (aligned right), u unit (aligned left, dim).
        rows: cells from the left. The cells that a row lacks are empty; a row without cells is an empty line.

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
    watched = sys.stdout is not None and sys.stdout.isatty()
    console = Console(
        force_terminal=watched, width=None if watched else _UNLIMITED, markup=False, emoji=False, highlight=False
    )
    style = box.SIMPLE_HEAD if watched else None
    table = Table(box=style, show_edge=False, show_header=any(columns), header_style="bold")
    for heading, kind, cells in zip(columns, kinds, zip_longest(columns, *rows, fillvalue="")):
        is_number = kind == "n"
        table.add_column(
            heading,
            justify="right" if is_number else "left",
            style=_STYLES[kind],
            no_wrap=is_number,
            min_width=max(map(cell_len, cells if is_number else " ".join(cells).split()), default=0),
        )
    for row in rows:
        table.add_row(*row)
    # In a narrower terminal, rich would fold numbers and leave out columns.
    least = Measurement.get(console, console.options.update_width(_UNLIMITED), table).minimum
    console.width = max(console.width, least)
    with console.capture() as captured:
        console.print(table, crop=False)
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def cell(value: float | None, digits: int = 1) -> str:
    """Return a number as a table's cell; '-' for None."""
    return "-" if value is None else f"{value:.{digits}f}"
