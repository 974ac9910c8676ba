# SPDX-License-Identifier: Apache-2.0
"""Reading of recordings, message by message, in the order of log time, without ROS.

A recording is an mcap or sqlite3 file of rosbag2, or a folder of its splits, compressed or not. Damage ends a file only
where nothing behind it can be read. After all whole messages comes one BagError that names what is damaged or missing.
"""

from __future__ import annotations

import filecmp
import functools
import itertools
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
        listed, self.missing = listed_files(folder)
        files = bag_files(folder)
        # Files that metadata.yaml lacks belong to the recording if they follow it in name and in time.
        splits = Splits.of([*listed, *(file for file in files if file not in listed)])
        opened = {number: BagFile(file) for number, file in splits.files.items()} if splits else {}
        gap = _gap(opened)
        if opened and not gap:
            self.missing = self.missing or (splits.missing if splits and not listed else [])
            chosen = list(opened.values())
        elif listed or len(files) == 1:
            chosen = [BagFile(file) for file in listed or files]
        else:
            chosen = []
        if copy := _copy_among(chosen or list(opened.values())):
            raise BagError(f"{folder}: {copy}")
        if not chosen:
            raise BagError(_not_one(folder, files, self.missing, gap))
        return _in_order_of_time(chosen)

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
    advice = f", or try `mcap recover {file.path.name}`" if file.storage == "mcap" and not file.packed else ""
    return f"{file.path}: damaged: {file.damage}. {file.whole_messages} were read. Record it again{advice}"


def _in_order_of_time(files: list[BagFile]) -> list[BagFile]:
    """Sort files by their first log time; files without messages come last."""
    return sorted(files, key=lambda file: (file.span is None, file.span or (0, 0)))


def _gap(splits: dict[int, BagFile]) -> str:
    """Return why numbered files do not follow each other in time, as the splits of one recording do; '' if they do.

    Recordings of one name and different numbers overlap by more than half, as those of two robots, or are far apart.
    """
    timed = [(number, file, *file.span) for number, file in splits.items() if file.span]
    longest = max((last - first for *_, first, last in timed), default=0)
    for (number, file, first, last), (next_number, following, next_first, _) in itertools.pairwise(timed):
        missing = next_number - number - 1
        if next_first < first:
            return f"{following.path.name} begins before {file.path.name}"
        if next_first - last > _LONGEST_PAUSE * (1 + missing) + longest * missing:
            seconds = (next_first - last) / 1e9
            return f"{following.path.name} begins {seconds:.0f} s after the end of {file.path.name}"
    for (_, file, *span), (_, other, *other_span) in itertools.combinations(timed, 2):
        if _overlap(span, other_span):
            return f"{file.path.name} and {other.path.name} overlap in time"
    return ""


def _overlap(one: list[int], other: list[int]) -> bool:
    """Return whether two spans of time overlap by more than splits do."""
    common = min(one[1], other[1]) - max(one[0], other[0])
    return common > 0 and common > _LARGEST_OVERLAP * min(one[1] - one[0], other[1] - other[0])


def _copy_among(files: list[BagFile]) -> str:
    """Return which file is a copy of another, and what to do; '' = none. All its messages would come twice."""
    kept: dict[tuple[object, int], BagFile] = {}
    for file in files:
        if not file.span:
            continue
        first = kept.setdefault((file.span, file.path.stat().st_size), file)
        if first is not file and filecmp.cmp(first.path, file.path, shallow=False):
            return f"{file.path.name} is a copy of {first.path.name}: move one of them to another folder"
    return ""


def _not_one(folder: Path, files: list[Path], missing: list[Path], gap: str) -> str:
    """Return the error for a folder that holds no recording of its own, or several.

    Args:
        folder: that was given.
        files: recordings in it.
        missing: files that metadata.yaml lists.
        gap: why numbered files are no splits of one recording; '' = the files are not numbered.
    """
    if not files:
        files = sorted(child for child in folder.iterdir() if child.is_dir() and _holds_bag(child))
    if not files and missing:
        named = ", ".join(file.name for file in missing[:_NAMED_FILES])
        return f"{folder}: the files that {METADATA} lists are missing ({named}): copy them into this folder"
    if not files:
        ros1 = sorted(folder.glob("*.bag"))
        if ros1:
            return f"{folder}: {BagFile(ros1[0]).refusal}"
        return f"{folder}: no recording in this folder (no {', no '.join(SUFFIXES)} file)"
    named = " or ".join(f"`{_quoted(file)}`" for file in files[:_NAMED_FILES])
    if len(files) == 1:
        return f"{folder}: the recording lies in a folder of its own: give that, {named}"
    more = f" and {len(files) - _NAMED_FILES} more" if len(files) > _NAMED_FILES else ""
    one_by_one = f"ive them one by one: {named}{more}; `paul train` takes several at once"
    if not gap:
        return f"{folder}: holds {quantity(len(files), 'recording')}, not the files of one. G{one_by_one}"
    storage = "sqlite3" if ".db3" in files[0].name else "mcap"
    return (
        f"{folder}: holds {len(files)} numbered files whose times do not follow each other: {gap}. If they are one "
        f"recording, list them in {METADATA} with `ros2 bag reindex -s {storage} {_quoted(folder)}`. Otherwise "
        f"g{one_by_one}"
    )


def _holds_bag(folder: Path) -> bool:
    return (folder / METADATA).exists() or bool(bag_files(folder))


def _quoted(path: Path) -> str:
    import shlex

    return shlex.quote(str(path))
