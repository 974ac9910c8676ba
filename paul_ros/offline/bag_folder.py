# SPDX-License-Identifier: Apache-2.0
"""The files of one recording: those in metadata.yaml, or the numbered splits of a folder."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from paul_ros.offline.bag_file import starts_as_recording

METADATA = "metadata.yaml"

SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
"""Endings of the files of rosbag2."""

_OTHER_SUFFIXES = (".part", ".bag")  # files that are written, and those of ROS 1
_ENDING = r"(?P<suffix>\.mcap|\.db3|\.part|\.mcap\.part)(\.zstd)?"
_NUMBERED = (
    (re.compile(r"(?P<name>.*)_(?P<number>\d+)" + _ENDING), "{name}_{number}{suffix}"),
    (re.compile(r"(?P<number>\d+)_(?P<name>.*?)" + _ENDING), "{number}_{name}{suffix}"),
)
_MAX_GAPS = 1000  # missing numbers between the splits of one recording


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag: a folder, metadata.yaml, or a file that is named or begins as one."""
    named = path.is_dir() or path.name == METADATA or path.name.endswith((*SUFFIXES, *_OTHER_SUFFIXES))
    return named or starts_as_recording(path)


def bag_files(folder: Path) -> list[Path]:
    """Return the recordings' files of a folder, sorted by name; a file still being written only if it is alone."""
    files = sorted(
        file
        for file in folder.iterdir()
        # `ros2 bag record -o NAME.mcap` makes a folder of that name.
        if file.name.endswith(SUFFIXES) and not file.name.startswith(".") and not file.is_dir()
    )
    return files or sorted(folder.glob("*.part"))


def listed_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the files that metadata.yaml lists: those that are there, and the missing ones.

    Both are empty without metadata.yaml, or if it is damaged, as a killed recorder leaves it.
    """
    try:
        metadata = yaml.safe_load((folder / METADATA).read_text(encoding="utf-8"))
        names = metadata["rosbag2_bagfile_information"]["relative_file_paths"]
        named = list(dict.fromkeys(folder / Path(name).name for name in names))
    except (OSError, yaml.YAMLError, ValueError, RecursionError, KeyError, TypeError):
        return [], []
    # The last name of a metadata.yaml that was cut off may be cut too.
    wanted = [file for file in named if file.name.endswith(SUFFIXES) or file.exists()]
    found = {file: _packed_or_unpacked(file) for file in wanted}
    return [file for file in found.values() if file], [file for file, there in found.items() if not there]


def _packed_or_unpacked(file: Path) -> Path | None:
    """Return a listed file, or the same one packed or unpacked with `zstd` since."""
    other = file.with_suffix("") if file.suffix == ".zstd" else file.with_name(file.name + ".zstd")
    return next((path for path in (file, other) if path.exists()), None)


@dataclass(frozen=True)
class Splits:
    """The numbered files of one recording: NAME_0.mcap, NAME_1.mcap, or 0_NAME.mcap, 1_NAME.mcap.

    Attributes:
        files: number -> file, in the order of numbers.
        missing: files that are not there, between the first and the last number.
    """

    files: dict[int, Path]
    missing: list[Path]

    @classmethod
    def of(cls, files: Sequence[Path]) -> Splits | None:
        """Return the splits if the names of all files have one stem and different numbers, else None."""
        for pattern, template in _NUMBERED:
            found = [pattern.fullmatch(file.name) for file in files]
            names = {(match["name"], match["suffix"]) for match in found if match}
            numbered = {int(match["number"]): file for match, file in zip(found, files) if match}
            if len(names) == 1 and len(numbered) == len(files):
                return cls(dict(sorted(numbered.items())), _missing(numbered, template, *names.pop()))
        return None


def _missing(numbered: dict[int, Path], template: str, name: str, suffix: str) -> list[Path]:
    gaps = max(numbered) - min(numbered) + 1 - len(numbered)
    if gaps > _MAX_GAPS:
        return []  # these numbers are dates or the like
    folder = next(iter(numbered.values())).parent
    numbers = range(min(numbered), max(numbered))
    names = (template.format(name=name, number=number, suffix=suffix) for number in numbers if number not in numbered)
    return [folder / name for name in names]
