# SPDX-License-Identifier: Apache-2.0
"""Reading of recordings, message by message, in the order of log time, without ROS.

A recording is an mcap or sqlite3 file of rosbag2, or a folder of its splits, compressed or not. Damage ends a file only
where nothing behind it can be read. After all whole messages comes one BagError that names what is damaged or missing.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from paul_ros.errors import BagError
from paul_ros.extras import require
from paul_ros.offline.bag_file import BagFile
from paul_ros.offline.bag_folder import METADATA, SUFFIXES, Splits, bag_files, listed_files
from paul_ros.offline.bag_records import Record
from paul_ros.offline.time_order import merge_by_time
from paul_ros.wording import quantity

_NAMED_FILES = 5  # most files that an error names
_LONGEST_PAUSE = 60e9  # nanoseconds between two splits of one recording
_LARGEST_OVERLAP = 0.5  # of two splits of one recording, as a share of the shorter


class Recording:
    """A recording, its files found and their times known.

    Attributes:
        path: as it was given.
        files: the files that are there, in the order of their times.
        missing: files that belong to the recording but are not there.
    """

    def __init__(self, path: str | Path) -> None:
        """Find the files of a recording.

        Args:
            path: a file, a folder, or the metadata.yaml in a folder.

        Raises:
            BagError: there is nothing, or several recordings.
        """
        require("bags", "mcap")
        self.path = Path(path)
        if not self.path.exists():
            raise BagError(f"{path}: no such file or folder")
        folder = self.path.parent if self.path.name == METADATA else self.path
        self.missing: list[Path] = []
        if not folder.is_dir():
            self.files = [BagFile(self.path)]
        else:
            self.files = self._files_in(folder)

    def _files_in(self, folder: Path) -> list[BagFile]:
        listed = listed_files(folder)
        if listed and listed[0]:
            files, self.missing = listed
            return _in_order_of_time([BagFile(file) for file in files])
        files = bag_files(folder)
        if listed:
            self.missing = listed[1]
        if len(files) == 1:
            return [BagFile(files[0])]
        splits = Splits.of(files)
        if splits is None:
            raise BagError(_not_one(folder, files))
        opened = {number: BagFile(file) for number, file in splits.files.items()}
        if not _is_one_recording(opened):
            raise BagError(_not_one(folder, files))
        self.missing = self.missing or splits.missing
        return _in_order_of_time(list(opened.values()))

    def records(self, topics: Iterable[str] | None = None) -> Iterator[Record]:
        """Yield the messages on some topics, as `read_records` does; raises the same BagError."""
        yield from self.whole_records(topics)
        if damage := self.damage:
            raise damage

    def whole_records(self, topics: Iterable[str] | None = None) -> Iterator[Record]:
        """Yield the messages on some topics, as `read_records` does. Afterwards, `damage` tells what was lost."""
        names = None if topics is None else frozenset(topics)

        def wanted(topic: str) -> bool:
            return names is None or any(matches(topic, name) for name in names)

        yield from merge_by_time(
            (file.span[0] if file.span else 0, functools.partial(file.records, wanted)) for file in self.files
        )

    @property
    def damage(self) -> BagError | None:
        """The error that names what is damaged or missing, as far as the recording was read."""
        bad = [file for file in self.files if file.damage]
        if not bad and not self.missing:
            return None
        messages = sum(file.messages for file in self.files)
        if len(self.files) == 1 and not self.missing:
            return BagError(_damage_of_file(self.files[0]), messages)
        told = [f"{file.path.name}: {file.damage} ({file.whole_messages} read)" for file in bad]
        told += [f"{file.name}: missing" for file in self.missing]
        more = f"; and {len(told) - _NAMED_FILES} more" if len(told) > _NAMED_FILES else ""
        verb = "is" if len(told) == 1 else "are"
        return BagError(
            f"{self.path}: {len(told)} of {len(self.files) + len(self.missing)} files {verb} damaged or missing: "
            f"{'; '.join(told[:_NAMED_FILES])}{more}. {quantity(messages, 'whole message')} were read in all",
            messages,
        )


def read_messages(path: str | Path, topics: Iterable[str] | None = None) -> Iterator[tuple[str, str, Any, int]]:
    """Decode the messages of a recording in the order of log time.

    Message types need not be installed: the definitions in the recording are used.

    Args:
        path: an mcap or sqlite3 file, a rosbag2 folder, or its metadata.yaml.
        topics: names of the topics to read, as `matches` takes them; None = all.

    Yields:
        (topic, type name, decoded message, log time in ns).

    Raises:
        BagError: the recording cannot be read, or parts of it are damaged or missing; then after everything else.
    """
    for record in read_records(path, topics):
        yield record.topic, record.type_name, record.message(), record.log_time


def read_records(path: str | Path, topics: Iterable[str] | None = None) -> Iterator[Record]:
    """Read the messages of a recording as `read_messages` does, but leave them serialised."""
    yield from Recording(path).records(topics)


@functools.lru_cache(maxsize=1024)
def matches(topic: str, name: str) -> bool:
    """Return whether a topic has a name; * in the name stands for any one part between slashes."""
    parts, wanted = topic.split("/"), name.split("/")
    return len(parts) == len(wanted) and all(want in ("*", part) for part, want in zip(parts, wanted))


def topics_of(path: str | Path) -> dict[str, tuple[str, int]]:
    """Return {topic: (type name, number of whole messages)} of a recording; raises BagError if there is none."""
    recording = Recording(path)
    found: dict[str, tuple[str, int]] = {}
    for file in recording.files:
        for topic, (kind, count) in file.topics().items():
            found[topic] = (kind, count + found.get(topic, ("", 0))[1])
    if not found and recording.damage:
        raise recording.damage
    return found


def _damage_of_file(file: BagFile) -> str:
    if file.refusal:
        return f"{file.path}: {file.refusal}"
    advice = f", or try `mcap recover {file.path.name}`" if file.storage == "mcap" else ""
    return f"{file.path}: damaged: {file.damage}. {file.whole_messages} were read. Record it again{advice}"


def _in_order_of_time(files: list[BagFile]) -> list[BagFile]:
    """Sort files by their first log time; files without messages come last."""
    return sorted(files, key=lambda file: (file.span is None, file.span or (0, 0)))


def _is_one_recording(splits: dict[int, BagFile]) -> bool:
    """Return whether numbered files follow each other in time, as the splits of one recording do.

    Recordings of one name and different numbers overlap by more than half, as those of two robots, or are far apart.
    """
    timed = [(number, *file.span) for number, file in splits.items() if file.span]
    longest = max((last - first for _, first, last in timed), default=0)
    for (number, first, last), (next_number, next_first, next_last) in zip(timed, timed[1:]):
        overlap = min(last, next_last) - max(first, next_first)
        shorter = min(last - first, next_last - next_first)
        missing = next_number - number - 1
        if overlap > _LARGEST_OVERLAP * shorter and overlap > 0:
            return False
        if max(first, next_first) - min(last, next_last) > _LONGEST_PAUSE * (1 + missing) + longest * missing:
            return False
        if next_last < first:
            return False
    return True


def _not_one(folder: Path, files: list[Path]) -> str:
    """Return the error for a folder that holds no recording of its own, or several."""
    if not files:
        files = sorted(child for child in folder.iterdir() if child.is_dir() and _holds_bag(child))
    if not files:
        ros1 = sorted(folder.glob("*.bag"))
        if ros1:
            return f"{folder}: {BagFile(ros1[0]).refusal}"
        return f"{folder}: no recording in this folder (no {', no '.join(SUFFIXES)} file)"
    named = " or ".join(f"`paul replay {_quoted(file)}`" for file in files[:_NAMED_FILES])
    more = f" and {len(files) - _NAMED_FILES} more" if len(files) > _NAMED_FILES else ""
    return (
        f"{folder}: holds {quantity(len(files), 'recording')}, not the files of one. Give them one by one, as in "
        f"{named}{more}; `paul train` takes several at once"
    )


def _holds_bag(folder: Path) -> bool:
    return (folder / METADATA).exists() or bool(bag_files(folder))


def _quoted(path: Path) -> str:
    import shlex

    return shlex.quote(str(path))
