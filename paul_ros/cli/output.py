# SPDX-License-Identifier: Apache-2.0
"""Where a command writes its results: files first, then standard output."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

STDOUT = Path("-")
"""As the FILE of an option: standard output."""


def output_path(text: str) -> Path:
    """Parse the path of an output; /dev/stdout is standard output too."""
    return STDOUT if text == "/dev/stdout" else Path(text)


def check_files(outputs: Iterable[Path | None], inputs: Iterable[str | Path | None]) -> None:
    """Refuse outputs that cannot be written, or that would overwrite an input or each other, before any work is done.

    Raises:
        OutputError: names the file and what to do.
    """
    from paul_ros.errors import OutputError
    from paul_ros.output_files import check_outputs

    paths = list(outputs)
    if STDOUT in paths and sys.stdout is None:
        raise OutputError("standard output is closed: name a file")
    check_outputs([path for path in paths if path != STDOUT], inputs)


def check_suffix(path: Path | None, suffixes: Collection[str]) -> None:
    """Refuse a file, if there is one, whose name does not say its format. Devices and pipes have any name.

    Raises:
        OutputError: names the suffixes.
    """
    from paul_ros.errors import OutputError
    from paul_ros.files import is_stream

    if path and path.suffix not in suffixes and (path == STDOUT or not is_stream(path)):
        what = (
            "this cannot go to standard output" if path == STDOUT else f"{path}: the suffix is no format of this output"
        )
        raise OutputError(f"{what}; name a file that ends in {' or '.join(suffixes)}")


def publish(
    report: dict[str, Any],
    table: Callable[[dict[str, Any]], str],
    json_file: Path | None,
    draw: Callable[[], object] | None = None,
) -> None:
    """Write a report and its picture, then print it.

    Files come first, since the reader of standard output may stop reading. The table is printed even if the picture
    fails, since the work was done.

    Args:
        report: the results, for JSON.
        table: makes the text for people.
        json_file: FILE of --json; STDOUT prints JSON in place of the table, so that standard output holds nothing else.
        draw: writes the picture.
    """
    import json

    from paul_ros.files import write_json

    to_stdout = json_file == STDOUT
    if json_file and not to_stdout:
        write_json(json_file, report)
    try:
        if draw:
            draw()
    finally:
        print(json.dumps(report, indent=2) if to_stdout else table(report))


@contextlib.contextmanager
def open_output(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears whole or not at all, or standard output.

    Raises:
        OSError: the file cannot be written; names it.
    """
    from paul_ros.files import ForwardOnly, atomic_file

    if path == STDOUT:
        yield cast(BinaryIO, ForwardOnly(sys.stdout.buffer))
        return
    with atomic_file(path) as file:
        yield file
