# SPDX-License-Identifier: Apache-2.0
"""Files of 2D keypoints (.npz, .csv, .json) read as batches of persons."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np

from msg_adapters.keypoints import CONFIDENCE_NAMES
from paul_ros.errors import KeypointFileError, LayoutError, NpzError
from paul_ros.files import read_npz
from paul_ros.layout import Layout
from paul_ros.offline.arrays import Persons, layout_of
from paul_ros.offline.keypoint_csv import read_csv

BATCH = 4096
"""Persons that are lifted in one call: some 30 MB."""


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
    names = ("keypoints", "W", "visible", "frame", "person", *CONFIDENCE_NAMES)
    arrays = read_npz(io.BytesIO(file.read()) if not file.seekable() else file, (), names)
    xy, confidence = _points(arrays)
    count, points = xy.shape[:2]
    layout = _checked_layout(layout, points, model)
    confidence, unused = _confidences(arrays, (count, points), confidence)
    visible = _flags(arrays, "visible", (count, points))
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
                unused,
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


def _confidences(
    arrays: dict[str, np.ndarray], shape: tuple[int, int], beside: np.ndarray | None
) -> tuple[np.ndarray | None, list[str]]:
    """Return the confidences (N,P), those beside the coordinates first, and the names of arrays left unused."""
    named = [name for name in CONFIDENCE_NAMES if name in arrays]
    if beside is not None:
        return beside, named
    fitting = [name for name in named if name == "confidence" or arrays[name].shape == shape]
    unused = [name for name in named if name not in fitting[:1]]
    return _array(arrays, fitting[0], shape, "number") if fitting else None, unused


def _array(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...], kind: str) -> np.ndarray | None:
    if name not in arrays:
        return None
    if arrays[name].shape != shape:
        raise KeypointFileError(f"{name} is {arrays[name].shape}; it must be {shape}")
    _check_kind(name, arrays[name], kind)
    return arrays[name].astype(str) if kind == "text" else arrays[name]


def _flags(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return an array of flags, (shape) bool; numbers must be 0 or 1, so that no confidence passes for a flag."""
    flags = _array(arrays, name, shape, "number")
    if flags is None or flags.dtype == bool:
        return flags
    if not np.isin(flags, (0, 1)).all():
        raise KeypointFileError(f"{name} has values other than 0 and 1; save confidences as confidence")
    return flags.astype(bool)


def _check_kind(name: str, array: np.ndarray, kind: str) -> None:
    codes = {"number": "biuf", "integer": "iu", "text": "iuU"}[kind]
    if array.dtype.kind not in codes:
        raise KeypointFileError(f"{name} has type {array.dtype}; it must be {kind}")


# --- csv


def _open_csv(file: BinaryIO, layout: Layout | None, model: Layout) -> KeypointFile:
    layout, batches = read_csv(file, layout, BATCH)
    return KeypointFile(layout, None, batches)


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
    unused = _unused_lists(frames[number][place])
    layout = _checked_layout(layout, len(_json_person(frames[number][place], number, place)[1]), model)

    def batches() -> Iterator[Persons]:
        for start in range(0, len(where), BATCH):
            rows = where[start : start + BATCH]
            read = [_json_person(frames[number][place], number, place) for number, place in rows]
            for (number, place), (_, keypoints) in zip(rows, read):
                _check_points(len(keypoints), layout, f"frame {number}, person {place}: ")
            numbers, names = [number for number, _ in rows], [name for name, _ in read]
            yield Persons.stacked(numbers, names, [values for _, values in read], unused)

    return KeypointFile(layout, len(where), batches())


def _json_person(person: Any, frame: int, place: int) -> tuple[str, np.ndarray]:
    """Return a person's id and its x, y, confidence (P,3)."""
    name, keypoints = str(place), person
    if isinstance(person, dict):
        name, keypoints = str(person.get("id", place)), _with_confidences(person, frame, place)
    try:
        if keypoints and all(isinstance(value, (int, float)) for value in keypoints):  # x, y, confidence in a row
            return name, np.array(keypoints, float).reshape(-1, 3)
        return name, np.array([_json_keypoint(keypoint) for keypoint in keypoints], float).reshape(-1, 3)
    except (TypeError, ValueError, OverflowError):
        raise KeypointFileError(
            f"frame {frame}, person {place}: keypoints must be [x, y], [x, y, confidence], or null if hidden"
        ) from None


def _with_confidences(person: dict[str, Any], frame: int, place: int) -> Any:
    """Return the keypoints of a person; confidences in a list of their own, as of MMPose, are put beside x and y.

    Raises:
        KeypointFileError: their numbers differ.
    """
    keypoints: Any = person.get("keypoints")
    lists = _confidence_lists(person)
    if not lists or not _are_pairs(keypoints):
        return keypoints
    confidences = person[lists[0]]
    if len(confidences) != len(keypoints):
        raise KeypointFileError(
            f"frame {frame}, person {place}: {lists[0]} has {len(confidences)} numbers for {len(keypoints)} keypoints; "
            "give one for each"
        )
    return [point and [*point, value] for point, value in zip(keypoints, confidences)]


def _unused_lists(person: Any) -> list[str]:
    """Return the names of a person's lists that look like confidences and are not used."""
    if not isinstance(person, dict):
        return []
    return _confidence_lists(person)[_are_pairs(person.get("keypoints")) :]


def _confidence_lists(person: dict[str, Any]) -> list[str]:
    return [name for name in CONFIDENCE_NAMES if isinstance(person.get(name), list)]


def _are_pairs(keypoints: Any) -> bool:
    """Return whether keypoints are [x, y] or null, without confidences."""
    return isinstance(keypoints, list) and all(
        point is None or (isinstance(point, list) and len(point) == 2) for point in keypoints
    )


def _json_keypoint(keypoint: Any) -> list[float | None]:
    if keypoint is None:
        return [None, None, 0.0]
    if not isinstance(keypoint, list) or len(keypoint) not in (2, 3) or any(isinstance(x, str) for x in keypoint):
        raise ValueError
    return keypoint if len(keypoint) == 3 else [*keypoint, 1.0]


# --- all


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
