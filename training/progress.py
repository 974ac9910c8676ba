# SPDX-License-Identifier: Apache-2.0
"""Progress of long work: the callback that the work calls, and the bars that show it."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

Progress = Callable[[float], object]
"""Function that is called with the share of the work that is done, 0 to 1."""


def ignore_progress(done: float) -> None:
    """Accept a share of the work and show nothing."""


def progress_bar(quiet: bool, **settings: Any) -> tqdm:
    """Return a bar on stderr; ``settings`` are those of tqdm.

    Args:
        quiet: show nothing.
    """
    # A log file gets two lines a minute.
    interval = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(disable=quiet, mininterval=interval, dynamic_ncols=True, **settings)


@contextlib.contextmanager
def share_bar(quiet: bool, work: str) -> Iterator[Progress]:
    """Show a bar from 0 to 100 % under the name ``work``; yields its progress function."""
    layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
    with progress_bar(quiet, total=1.0, desc=work, bar_format=layout) as bar:
        yield lambda done: bar.update(done - bar.n)
