# SPDX-License-Identifier: Apache-2.0
"""A progress bar on standard error, shown only where a terminal watches."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import TypeVar

T = TypeVar("T")


@contextlib.contextmanager
def progress(doing: str, unit: str = "frame", total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Show a bar while the block runs.

    Without a terminal, or without tqdm, nothing is shown: the bar is no reason to fail on a robot.

    Args:
        doing: what is done, as "lift".
        unit: what is counted.
        total: their number; None if it is not known.

    Yields:
        A function that adds to the count.
    """
    if not sys.stderr or not sys.stderr.isatty() or not find_spec("tqdm"):
        yield lambda number: None
        return
    from tqdm import tqdm

    with tqdm(desc=doing, unit=unit, total=total, dynamic_ncols=True, leave=False) as bar:

        def count(number: int) -> None:
            bar.update(number)

        yield count


def counted(doing: str, unit: str, items: Iterable[T], total: int) -> Iterator[T]:
    """Yield the items while a bar counts them."""
    with progress(doing, unit, total) as count:
        for item in items:
            yield item
            count(1)


drawing = partial(counted, "draw", "picture")
"""Yields pictures (items, their number) while a bar counts them."""
