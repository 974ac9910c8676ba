# SPDX-License-Identifier: Apache-2.0
"""A table of 2D keypoints (.csv) read as batches of persons."""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from msg_adapters.keypoints import CONFIDENCE_NAMES
from paul_ros.errors import KeypointFileError, LayoutError
from paul_ros.layout import Layout, layout_names, load_layout
from paul_ros.offline.arrays import Persons
from paul_ros.stream.layout_search import PREFERRED

_MAX_FRAME = 2**63  # of an int64
_NEEDED = ("frame", "keypoint", "x", "y")
_COLUMNS = f"{','.join(_NEEDED)} and, if there are any, person and confidence"


class _Row(NamedTuple):
    line: int
    frame: int
    person: str
    keypoint: str
    x: float
    y: float
    confidence: float


def read_csv(file: BinaryIO, layout: Layout | None, batch: int) -> tuple[Layout, Iterator[Persons]]:
    """Read persons from a table with a row for each keypoint, no more than needed at a time.

    Args:
        file: UTF-8 text with the columns frame, keypoint, x, y and, if there are any, person and confidence.
        layout: of the keypoints; None = the first shipped one that has every keypoint named in the first frame.
        batch: persons at a time, or a few more: a frame is kept together.

    Returns:
        The layout, and the persons in batches.

    Raises:
        KeypointFileError: the table cannot be used; names the line. Also raised while the batches are read.
        LayoutError: no shipped layout has the keypoints of the first frame, or they are numbered.
    """
    lines = csv.reader(io.TextIOWrapper(file, "utf-8-sig", newline=""), strict=True)
    with _csv_errors(lines):
        header = next(lines, [])
    place = _places(header)
    confidence, unused = _confidence_columns(place)
    frames = _frames(_rows(lines, place, confidence, len(header)))
    first = next(frames, None)
    if first is None:
        raise KeypointFileError(f"holds no keypoints: write rows of {_COLUMNS}")
    layout = layout or _layout_naming(first)
    return layout, _batches(itertools.chain([first], frames), layout, batch, unused)


@contextlib.contextmanager
def _csv_errors(lines: Any) -> Iterator[None]:
    """Name the line of a text that is no table."""
    try:
        yield
    except (csv.Error, UnicodeDecodeError) as error:
        raise KeypointFileError(f"line {lines.line_num + 1} is not CSV in UTF-8 ({error})") from error


def _places(cells: list[str]) -> dict[str, int]:
    """Return the index of each column by its name."""
    header = [name.strip().lower() for name in cells]
    twice = sorted({name for name in (*_NEEDED, "person", *CONFIDENCE_NAMES) if header.count(name) > 1})
    if twice:
        raise KeypointFileError(f"has the column {twice[0]} twice: keep one of them")
    missing = [name for name in _NEEDED if name not in header]
    if missing:
        found = ",".join(header)[:100] or "none"
        raise KeypointFileError(f"lacks {', '.join(missing)} in its columns ({found}): they must be {_COLUMNS}")
    return {name: index for index, name in enumerate(header)}


def _confidence_columns(place: dict[str, int]) -> tuple[str, list[str]]:
    """Return the name of the column with the confidences, '' if there is none, and other names that look like it."""
    named = [name for name in CONFIDENCE_NAMES if name in place]
    return (named[0], named[1:]) if named else ("", [])


def _rows(lines: Any, place: dict[str, int], confidence_name: str, width: int) -> Iterator[_Row]:
    person, confidence = place.get("person"), place.get(confidence_name)
    with _csv_errors(lines):
        for cells in lines:
            if not cells:
                continue
            line = lines.line_num
            if len(cells) != width:
                raise KeypointFileError(f"line {line} has {len(cells)} cells; it must have {width}")
            yield _Row(
                line,
                _frame_number(cells[place["frame"]], line),
                cells[person].strip() if person is not None else "0",
                cells[place["keypoint"]].strip(),
                _coordinate(cells[place["x"]], "x", line),
                _coordinate(cells[place["y"]], "y", line),
                _coordinate(cells[confidence], confidence_name, line) if confidence is not None else 1.0,
            )


def _frame_number(text: str, line: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = _MAX_FRAME
    if abs(number) >= _MAX_FRAME:
        raise KeypointFileError(f"line {line}: frame is '{text[:40]}'; it must be a whole number")
    return number


def _coordinate(text: str, column: str, line: int) -> float:
    try:
        return float(text) if text.strip() else float("nan")
    except ValueError:
        raise KeypointFileError(
            f"line {line}: {column} is '{text[:40]}'; it must be a number, or empty if the keypoint is hidden"
        ) from None


def _frames(rows: Iterable[_Row]) -> Iterator[list[_Row]]:
    """Group rows by their frame."""
    last: int | None = None
    for frame, group in itertools.groupby(rows, lambda row: row.frame):
        one = list(group)
        if last is not None and frame < last:
            raise KeypointFileError(f"line {one[0].line}: frame {frame} follows frame {last}; sort the rows by frame")
        last = frame
        yield one


def _layout_naming(rows: list[_Row]) -> Layout:
    """Return the first shipped layout that has every keypoint named in a frame."""
    names = {row.keypoint for row in rows}
    if any(name.isdecimal() for name in names):
        raise LayoutError("its keypoints are numbered: name their layout with --layout")
    for name in dict.fromkeys([*PREFERRED, *layout_names()]):
        if names <= set(load_layout(name).names):
            return load_layout(name)
    raise LayoutError(f"no shipped layout has all of {', '.join(sorted(names))[:200]}: name one with --layout")


def _batches(frames: Iterable[list[_Row]], layout: Layout, batch: int, unused: Sequence[str]) -> Iterator[Persons]:
    index = {name: place for place, name in enumerate(layout.names)}
    index.update((str(place), place) for place in range(len(layout.names)))
    frame: list[int] = []
    person: list[str] = []
    values: list[np.ndarray] = []
    for rows in frames:
        persons = _persons_of(rows, layout, index)
        frame += [rows[0].frame] * len(persons)
        person += persons
        values += persons.values()
        if len(values) >= batch:
            yield Persons.stacked(frame, person, values, unused)
            frame, person, values = [], [], []
    if values:
        yield Persons.stacked(frame, person, values, unused)


def _persons_of(rows: list[_Row], layout: Layout, index: dict[str, int]) -> dict[str, np.ndarray]:
    """Return x, y, confidence (P,3) of each person of a frame; NaN for keypoints without a row."""
    persons: dict[str, np.ndarray] = {}
    seen: set[tuple[str, int]] = set()
    for row in rows:
        place = index.get(row.keypoint)
        if place is None:
            raise KeypointFileError(
                f"line {row.line}: layout '{layout.name}' has no keypoint '{row.keypoint[:40]}'; "
                "name the layout with --layout"
            )
        if (row.person, place) in seen:
            raise KeypointFileError(
                f"line {row.line}: frame {row.frame} has keypoint '{row.keypoint}' of person '{row.person}' twice"
            )
        seen.add((row.person, place))
        if row.person not in persons:
            persons[row.person] = np.full((len(layout.names), 3), np.nan)
        persons[row.person][place] = row.x, row.y, row.confidence
    return persons
