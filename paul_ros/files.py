# SPDX-License-Identifier: Apache-2.0
"""Files: written atomically, and read without executing anything in them."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from paul_ros.errors import NpzError

_NAMED = 5  # most arrays that an error names


def read_npz(
    file: str | os.PathLike | BinaryIO, needed: Collection[str], optional: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Read arrays of an npz file by name; other arrays are not opened.

    Args:
        file: path, or a file opened for reading bytes.
        needed: names of arrays that must exist.
        optional: names of arrays that may be missing.

    Returns:
        The arrays by name, without the missing optional ones.

    Raises:
        NpzError: the file cannot be read, is damaged, has pickled objects for arrays, or lacks a needed array.
    """
    try:
        with np.load(file, allow_pickle=False) as archive:
            present = archive.files
            arrays = {name: archive[name] for name in (*needed, *optional) if name in present}
    except FileNotFoundError as error:
        raise NpzError("is not there") from error
    except Exception as error:  # numpy and zipfile report damage in a dozen ways; numpy itself advises to unpickle
        raise NpzError("has pickled objects or is no npz file: save plain arrays with np.savez") from error
    for name in needed:
        if name not in present:
            more = f" and {len(present) - _NAMED} more" if len(present) > _NAMED else ""
            raise NpzError(f"has no array {name}; it has {', '.join(present[:_NAMED]) or 'none'}{more}")
    return arrays


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Open a file for writing that is complete or unchanged when the block ends; missing folders are made.

    Raises:
        OSError: the file cannot be written. The error names the file, never the temporary one.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        os.unlink(temporary)
        # A full disk names no file, and a refused rename names the temporary one.
        if isinstance(error, OSError) and error.errno and error.filename in (None, temporary):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_atomically(path: str | os.PathLike, data: bytes) -> None:
    """Write a file that is complete or unchanged; see `atomic_file`."""
    with atomic_file(path) as file:
        file.write(data)


def write_npz(path: str | os.PathLike, arrays: Mapping[str, ArrayLike]) -> None:
    """Write arrays by name as an npz file, atomically."""
    with atomic_file(path) as file:
        members: dict[str, Any] = dict(arrays)
        np.savez(file, **members)


def write_json(path: str | os.PathLike, report: dict) -> None:
    """Write a report as one JSON object, atomically."""
    write_atomically(path, (json.dumps(report, indent=2, ensure_ascii=False) + "\n").encode())
