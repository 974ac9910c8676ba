# SPDX-License-Identifier: Apache-2.0
"""Files: written whole or not at all, and read without executing anything in them."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import secrets
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import ArrayLike

from paul_ros.errors import NpzError

_NAMED = 5  # most arrays that an error names

PART = ".part"
"""Suffix of a file that is being written. A killed process leaves such files."""

_MOST_LINKS = 40  # that Linux follows
_LONGEST_NAME = 255  # bytes


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


def is_stream(path: str | os.PathLike) -> bool:
    """Return whether a path leads to a device, a pipe or an open descriptor, which are written and never replaced.

    Raises:
        OSError: the path cannot be followed, for example a loop of links.
    """
    if _descriptor(path) is not None:
        return True
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def make_folders(folder: Path) -> list[Path]:
    """Make a folder and its parents; return those that were missing, the deepest first."""
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing


def remove_if_empty(folders: Iterable[Path]) -> None:
    """Remove folders up to the first one that holds something."""
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike, buffering: int = -1) -> Iterator[BinaryIO]:
    """Open an output that is complete when the block ends, and unchanged if the block raises.

    The bytes go to `NAME.RANDOM.part` beside the file, which then takes the file's place in one step. Several writers
    of one name do not meet: the last one to end wins, with a whole file. A block that raises leaves neither the `.part`
    file nor folders that were made for it. A killed process leaves its `.part` file.

    Missing folders are made. The target of a link is written, and the link stays. An existing file keeps its
    permissions and its owner. Devices, pipes and open descriptors (/dev/null, /dev/fd/3) are written straight.

    Args:
        path: of the output.
        buffering: as for `open`.

    Raises:
        OSError: the file cannot be written. The error names `path`, never the temporary file.
    """
    with _naming(path):
        straight = is_stream(path)
    with (_stream if straight else _replacement)(path, buffering) as file:
        yield file


@contextlib.contextmanager
def _replacement(path: str | os.PathLike, buffering: int) -> Iterator[BinaryIO]:
    """Open a file beside the target of `path`, which replaces it when the block ends."""
    target = Path(os.path.realpath(path))
    part = _part_of(target)
    with _naming(path):
        made = make_folders(target.parent)
    try:
        with _naming(path):
            if target.is_file() and not os.access(target, os.W_OK, effective_ids=True):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            # "x": the name is of this process alone.
            file = open(part, "xb", buffering)
        # The error of a full disk names no file.
        with _naming(path, None, str(part)):
            with file:
                yield file
                file.flush()
                os.fsync(file.fileno())
        with _naming(path):
            _copy_access(target, part)
            _replace(target, part)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        remove_if_empty(made)
        raise


@contextlib.contextmanager
def _stream(path: str | os.PathLike, buffering: int) -> Iterator[BinaryIO]:
    """Open a device, a pipe or a descriptor for writing from front to end."""
    with _naming(path):
        descriptor = _descriptor(path)
        # A descriptor is shared and not opened anew, so that what others write to it stays where it is.
        raw = os.open(path, os.O_WRONLY) if descriptor is None else os.dup(descriptor)
    with _naming(path, None):
        with open(raw, "wb") as file:
            yield cast(BinaryIO, ForwardOnly(file))


class ForwardOnly(io.BufferedIOBase):
    """A file written from front to end: it knows its position, counted from where it began, and cannot change it.

    Formats that would look back, as zip does, then write what others can append to or read from a pipe.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._written = file, 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        count = self._file.write(data)
        self._written += count
        return count

    def flush(self) -> None:
        self._file.flush()

    def tell(self) -> int:
        return self._written


def _descriptor(path: str | os.PathLike) -> int | None:
    """Return the open descriptor that a name such as /dev/stdout or /dev/fd/3 stands for; None = it is another file."""
    link = os.path.abspath(path)
    for _ in range(_MOST_LINKS):
        folder, name = os.path.split(link)
        folder = os.path.realpath(folder)
        if folder == f"/proc/{os.getpid()}/fd" and name.isdecimal():
            return int(name)
        link = os.path.join(folder, name)
        if not os.path.islink(link):
            break
        link = os.path.join(folder, os.readlink(link))
    return None


def _part_of(target: Path) -> Path:
    """Return a new name for a file that is being written, beside its target."""
    end = f".{secrets.token_hex(4)}{PART}"
    begin = os.fsdecode(os.fsencode(target.name)[: _LONGEST_NAME - len(end)])
    return target.with_name(begin + end)


def _copy_access(target: Path, part: Path) -> None:
    """Give a file the permissions of the one that it replaces, and its owner, as far as the file system allows."""
    if target.exists():
        before = target.stat()
        with contextlib.suppress(OSError):
            os.chown(part, before.st_uid, before.st_gid)
        with contextlib.suppress(OSError):
            os.chmod(part, before.st_mode & 0o777)


def _replace(target: Path, part: Path) -> None:
    try:
        os.replace(part, target)
    except OSError as error:
        if error.errno != errno.EBUSY:
            raise
        # The target is a mount of its own, as a file that a container shares with its host.
        shutil.copyfile(part, target)
        part.unlink()


@contextlib.contextmanager
def _naming(path: str | os.PathLike, *names: str | None) -> Iterator[None]:
    """Make an OSError name `path`: every one, or only one that names one of `names` (None = names no file)."""
    try:
        yield
    except OSError as error:
        if error.errno and (not names or error.filename in names):
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
    # Names of files may hold bytes that are no UTF-8; JSON has escapes for them.
    write_atomically(path, (json.dumps(report, indent=2, ensure_ascii=False) + "\n").encode(errors="backslashreplace"))
