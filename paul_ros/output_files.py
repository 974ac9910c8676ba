# SPDX-License-Identifier: Apache-2.0
"""Checks of output paths, made before long work begins so that nobody waits in vain."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from paul_ros.errors import OutputError
from paul_ros.files import is_stream

_BAG_FILES = (".mcap", ".db3")


def check_output(path: Path) -> None:
    """Check that a file can be written at a path. Nothing is made, not even its folder.

    Raises:
        OutputError: the path is a folder, or the system refuses to write there.
    """
    if os.path.isdir(path):
        raise OutputError(f"cannot write {path}: it is a folder; name a file in it")
    try:
        _try_to_write(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


def _try_to_write(path: Path) -> None:
    """Raise OSError if a file cannot be written; devices and pipes are not opened, since that may wait for a reader."""
    stream = is_stream(path)
    if path.exists() and not os.access(path, os.W_OK, effective_ids=True):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    if not stream:
        target = Path(os.path.realpath(path))
        tempfile.TemporaryFile(dir=next(folder for folder in target.parents if folder.exists())).close()


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[str | Path | None]) -> None:
    """Check that all outputs can be written and that none overwrites an input or another output.

    Links and other names of one file count as that file.

    Args:
        outputs: paths to write; None = an output that was not asked for.
        inputs: paths to read, or names of shipped models and layouts; None = an input that was not given.

    Raises:
        OutputError: an output is an input, lies in a bag folder that is an input, is named twice, lies below another
            output, or cannot be written.
    """
    sources = [Path(source) for source in inputs if source is not None and Path(source).exists()]
    taken: list[Path] = []
    for output in filter(None, outputs):
        check_output(output)
        if is_stream(output):
            continue
        if any(_is_part(output, source) for source in sources):
            raise OutputError(f"{output}: would overwrite part of an input; name another output")
        if any(_same(output, source) for source in sources):
            raise OutputError(f"{output}: would overwrite an input; name another output")
        if any(_same(output, other) for other in taken):
            raise OutputError(f"{output}: is named for two outputs; name another one")
        if any(_lies_in(output, other) or _lies_in(other, output) for other in taken):
            raise OutputError(f"{output}: one output is the folder of another; name another one")
        taken.append(output)


def _same(one: Path, other: Path) -> bool:
    """Return whether two paths lead to one file, which need not exist."""
    if one.exists() and other.exists():
        return one.samefile(other)
    return os.path.realpath(one) == os.path.realpath(other)


def _lies_in(path: Path, folder: Path) -> bool:
    return Path(os.path.realpath(folder)) in Path(os.path.realpath(path)).parents


def _is_part(output: Path, source: Path) -> bool:
    """Return whether an output would be a file of a bag folder."""
    name = Path(os.path.realpath(output)).name
    return _lies_in(output, source) and (name == "metadata.yaml" or any(suffix in name for suffix in _BAG_FILES))
