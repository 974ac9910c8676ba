# SPDX-License-Identifier: Apache-2.0
"""Checks of output paths, made before long work begins so that nobody waits in vain."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

from paul_ros.errors import OutputError


def check_output(path: Path) -> None:
    """Check that a file can be written at a path, and make its folder.

    Raises:
        OutputError: the path is a folder, or the system refuses to write there.
    """
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder; name a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[str | Path | None]) -> None:
    """Check that all outputs can be written and that none overwrites an input or another output.

    Args:
        outputs: paths to write; None = an output that was not asked for.
        inputs: paths to read, or names of shipped models and layouts; None = an input that was not given.

    Raises:
        OutputError: an output is an input, lies in a bag folder that is an input, is named twice, or cannot be written.
    """
    sources = [Path(source).resolve() for source in inputs if source is not None and Path(source).exists()]
    taken: set[Path] = set()
    for output in filter(None, outputs):
        target = output.resolve()
        for source in sources:
            inside_bag = source in target.parents and (target.suffix == ".mcap" or target.name == "metadata.yaml")
            if target == source or inside_bag:
                part = "part of an input" if inside_bag else "an input"
                raise OutputError(f"{output}: would overwrite {part}; name another output")
        if target in taken:
            raise OutputError(f"{output}: is named for two outputs; name another one")
        taken.add(target)
        check_output(output)
