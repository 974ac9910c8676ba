# SPDX-License-Identifier: Apache-2.0
"""Files of 2D keypoints (.npz, .csv, .json) read as batches of persons."""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from paul_ros.errors import LayoutError, NpzError, PaulError
from paul_ros.files import read_npz
from paul_ros.layout import Layout, layout_names, load_layout
from paul_ros.offline.arrays import Persons, layout_of
from paul_ros.stream.route import PREFERRED

BATCH = 4096
"""Persons that are lifted in one call: some 30 MB."""

_MAX_FRAME = 2**63  # of an int64
_COLUMNS = "frame,keypoint,x,y and, if there are any, person and confidence"


class KeypointFileError(PaulError, ValueError):
    """A file of 2D keypoints cannot be used."""


@dataclass(frozen=True)
class KeypointFile:
    """Persons of a file.

    Attributes:
        layout: of the keypoints.
        persons: their number; None if it shows only at the end.
        batches: the persons, BATCH or a few more at a time.
    """

    layout: Layout
    persons: int | None
    batches: Iterator[Persons]


def open_keypoints(file: BinaryIO, name: str, kind: str, layout: Layout | None, model: Layout) -> KeypointFile:
    """Open a file of 2D keypoints; `paul lift --help` describes the three kinds.

    Args:
        file: the open file; it must stay open while the batches are read.
        name: of the file, for errors.
        kind: `npz`, `csv` or `json`.
        layout: of the keypoints; None = found from their number (npz, json) or their names (csv).
        model: layout of the model that will lift them.

    Raises:
        KeypointFileError: the file cannot be read, holds nobody, or has no layout; also while the batches are read.
    """
    readers = {"npz": _open_npz, "csv": _open_csv, "json": _open_json}
    with _named(name):
        opened = readers[kind](file, layout, model)
    return replace(opened, batches=_named_batches(name, opened.batches))


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Put the file's name in front of an error."""
    try:
        yield
    except (KeypointFileError, LayoutError, NpzError) as error:
        raise KeypointFileError(f"{name}: {error}") from error


def _named_batches(name: str, batches: Iterator[Persons]) -> Iterator[Persons]:
    with _named(name):
        yield from batches


# --- npz


def _open_npz(file: BinaryIO, layout: Layout | None, model: Layout) -> KeypointFile:
    names = ("keypoints", "W", "visible", "confidence", "frame", "person")
    arrays = read_npz(io.BytesIO(file.read()) if not file.seekable() else file, (), names)
    xy, confidence = _points(arrays)
    count, points = xy.shape[:2]
    layout = _checked_layout(layout, points, model)
    confidence = _array(arrays, "confidence", (count, points), "number") if confidence is None else confidence
    visible = _array(arrays, "visible", (count, points), "bool")
    frame = _array(arrays, "frame", (count,), "integer")
    person = _array(arrays, "person", (count,), "text")
    frame = np.arange(count) if frame is None else frame
    person = np.full(count, "0") if person is None else person

    def batches() -> Iterator[Persons]:
        for start in range(0, count, BATCH):
            rows = slice(start, start + BATCH)
            yield Persons.of(
                frame[rows],
                tuple(person[rows].tolist()),
                xy[rows],
                None if confidence is None else confidence[rows],
                None if visible is None else visible[rows],
            )

    return KeypointFile(layout, count, batches())


def _points(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return xy (N,P,2) and, if they are beside the coordinates, confidences (N,P)."""
    if "keypoints" in arrays:
        keypoints = arrays["keypoints"]
        if keypoints.ndim != 3 or keypoints.shape[2] not in (2, 3):
            raise KeypointFileError(f"keypoints is {keypoints.shape}; it must be (N,P,2), or (N,P,3) with confidences")
        _check_kind("keypoints", keypoints, "number")
        _check_anybody(len(keypoints))
        return keypoints[..., :2], keypoints[..., 2] if keypoints.shape[2] == 3 else None
    if "W" in arrays:
        W = arrays["W"]
        if W.ndim != 3 or W.shape[1] != 2:
            raise KeypointFileError(f"W is {W.shape}; it must be (F,2,P)")
        _check_kind("W", W, "number")
        _check_anybody(len(W))
        return W.transpose(0, 2, 1), None
    raise KeypointFileError("has neither keypoints (N,P,2) nor W (F,2,P): save one with np.savez")


def _array(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...], kind: str) -> np.ndarray | None:
    if name not in arrays:
        return None
    if arrays[name].shape != shape:
        raise KeypointFileError(f"{name} is {arrays[name].shape}; it must be {shape}")
    _check_kind(name, arrays[name], kind)
    return arrays[name].astype({"bool": bool, "text": str}.get(kind, arrays[name].dtype))


def _check_kind(name: str, array: np.ndarray, kind: str) -> None:
    codes = {"number": "biuf", "bool": "biuf", "integer": "iu", "text": "iuU"}[kind]
    if array.dtype.kind not in codes:
        raise KeypointFileError(f"{name} has type {array.dtype}; it must be {kind}")


# --- csv


class _Row(NamedTuple):
    line: int
    frame: int
    person: str
    keypoint: str
    x: float
    y: float
    confidence: float


def _open_csv(file: BinaryIO, layout: Layout | None, model: Layout) -> KeypointFile:
    frames = _csv_frames(_csv_rows(csv.reader(io.TextIOWrapper(file, "utf-8-sig", newline=""), strict=True)))
    first = next(frames, None)
    if first is None:
        raise KeypointFileError(f"holds no keypoints: write rows of {_COLUMNS}")
    layout = layout or _layout_naming(first)
    return KeypointFile(layout, None, _csv_batches(itertools.chain([first], frames), layout))


def _csv_rows(lines: Any) -> Iterator[_Row]:
    try:
        header = [name.strip().lower() for name in next(lines, [])]
        place = {name: index for index, name in enumerate(header)}
        missing = [name for name in ("frame", "keypoint", "x", "y") if name not in place]
        if missing:
            found = ",".join(header)[:100] or "none"
            raise KeypointFileError(f"lacks {', '.join(missing)} in its columns ({found}): they must be {_COLUMNS}")
        person, confidence = place.get("person"), place.get("confidence")
        for cells in lines:
            if not cells:
                continue
            line = lines.line_num
            if len(cells) != len(header):
                raise KeypointFileError(f"line {line} has {len(cells)} cells; it must have {len(header)}")
            yield _Row(
                line,
                _frame_number(cells[place["frame"]], line),
                cells[person].strip() if person is not None else "0",
                cells[place["keypoint"]].strip(),
                _coordinate(cells[place["x"]], "x", line),
                _coordinate(cells[place["y"]], "y", line),
                _coordinate(cells[confidence], "confidence", line) if confidence is not None else 1.0,
            )
    except (csv.Error, UnicodeDecodeError) as error:
        raise KeypointFileError(f"line {lines.line_num + 1} is not CSV in UTF-8 ({error})") from error


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


def _csv_frames(rows: Iterable[_Row]) -> Iterator[list[_Row]]:
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


def _csv_batches(frames: Iterable[list[_Row]], layout: Layout) -> Iterator[Persons]:
    index = {name: place for place, name in enumerate(layout.names)}
    index.update((str(place), place) for place in range(len(layout.names)))
    frame: list[int] = []
    person: list[str] = []
    values: list[np.ndarray] = []
    for rows in frames:
        persons = _csv_persons(rows, layout, index)
        frame += [rows[0].frame] * len(persons)
        person += persons
        values += persons.values()
        if len(values) >= BATCH:
            yield _persons(frame, person, values)
            frame, person, values = [], [], []
    if values:
        yield _persons(frame, person, values)


def _csv_persons(rows: list[_Row], layout: Layout, index: dict[str, int]) -> dict[str, np.ndarray]:
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


# --- json


def _open_json(file: BinaryIO, layout: Layout | None, model: Layout) -> KeypointFile:
    try:
        frames = json.loads(file.read())
    except (ValueError, RecursionError) as error:
        raise KeypointFileError(f"is not JSON ({' '.join(str(error).split())[:100]})") from error
    if not isinstance(frames, list) or not all(isinstance(persons, list) for persons in frames):
        raise KeypointFileError("must be a list of frames, each a list of persons, each a list of keypoints")
    where = [(number, place) for number, persons in enumerate(frames) for place in range(len(persons))]
    _check_anybody(len(where))
    number, place = where[0]
    layout = _checked_layout(layout, len(_json_person(frames[number][place], number, place)[1]), model)

    def batches() -> Iterator[Persons]:
        for start in range(0, len(where), BATCH):
            rows = where[start : start + BATCH]
            read = [_json_person(frames[number][place], number, place) for number, place in rows]
            for (number, place), (_, keypoints) in zip(rows, read):
                _check_points(len(keypoints), layout, f"frame {number}, person {place}: ")
            yield _persons([number for number, _ in rows], [name for name, _ in read], [k for _, k in read])

    return KeypointFile(layout, len(where), batches())


def _json_person(person: Any, frame: int, place: int) -> tuple[str, np.ndarray]:
    """Return a person's id and its x, y, confidence (P,3)."""
    name, keypoints = str(place), person
    if isinstance(person, dict):
        name, keypoints = str(person.get("id", place)), person.get("keypoints")
    try:
        if keypoints and all(isinstance(value, (int, float)) for value in keypoints):  # x, y, confidence in a row
            return name, np.array(keypoints, float).reshape(-1, 3)
        return name, np.array([_json_keypoint(keypoint) for keypoint in keypoints], float).reshape(-1, 3)
    except (TypeError, ValueError, OverflowError):
        raise KeypointFileError(
            f"frame {frame}, person {place}: keypoints must be [x, y], [x, y, confidence], or null if hidden"
        ) from None


def _json_keypoint(keypoint: Any) -> list[float | None]:
    if keypoint is None:
        return [None, None, 0.0]
    if not isinstance(keypoint, list) or len(keypoint) not in (2, 3) or any(isinstance(x, str) for x in keypoint):
        raise ValueError
    return keypoint if len(keypoint) == 3 else [*keypoint, 1.0]


# --- all


def _persons(frame: list[int], person: list[str], values: list[np.ndarray]) -> Persons:
    """Return persons of x, y, confidence, N arrays (P,3)."""
    every = np.stack(values)
    return Persons.of(np.array(frame), tuple(person), every[..., :2], every[..., 2])


def _checked_layout(layout: Layout | None, points: int, model: Layout) -> Layout:
    layout = layout or layout_of(points, model)
    _check_points(points, layout)
    return layout


def _check_points(points: int, layout: Layout, where: str = "") -> None:
    if points != len(layout.names):
        raise KeypointFileError(
            f"{where}{points} keypoints, but layout '{layout.name}' has {len(layout.names)}; "
            "name the right one with --layout"
        )


def _check_anybody(persons: int) -> None:
    if not persons:
        raise KeypointFileError("holds no persons")
