# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all, and read without running anything that they hold."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO

import numpy as np

from paul_ros.errors import NpzError

_NAMED = 5  # arrays in a message


def read_npz(
    file: str | os.PathLike | BinaryIO, needed: Collection[str], optional: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Arrays of an npz by their names; nothing else of it is opened.

    Raises:
        NpzError: it cannot be read, is damaged, holds pickled objects where arrays are wanted, or lacks a needed one.
    """
    try:
        with np.load(file, allow_pickle=False) as archive:
            there = archive.files
            arrays = {name: archive[name] for name in (*needed, *optional) if name in there}
    except FileNotFoundError as error:
        raise NpzError("is not there") from error
    except Exception as error:  # numpy and zipfile report damage in a dozen ways; numpy's own advice is to unpickle
        raise NpzError("holds pickled objects or is no npz: save plain arrays with np.savez") from error
    for name in needed:
        if name not in there:
            more = f" and {len(there) - _NAMED} more" if len(there) > _NAMED else ""
            raise NpzError(f"has no array {name}; it has {', '.join(there[:_NAMED]) or 'none'}{more}")
    return arrays


def write_atomically(path: str | os.PathLike, data: bytes) -> None:
    """Write a file that is there whole or not at all; an OSError names it, as of a full disk it would not."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        os.unlink(temporary)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_json(path: str | os.PathLike, report: dict) -> None:
    """Write a report as one JSON object, atomically."""
    write_atomically(path, (json.dumps(report, indent=2, ensure_ascii=False) + "\n").encode())
