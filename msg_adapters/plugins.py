# SPDX-License-Identifier: Apache-2.0
"""Adapters of other packages: found by entry points, loaded with the first message of their type, never trusted.

A package declares an entry point in the group GROUP. Its name is the message type; its object is an Adapter.
docs/how_to/write_an_adapter.md has a complete example. Faults of such an adapter cost only its own messages. These are
dropped with a reason that names the package.
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from msg_adapters.keypoints import (
    MAX_PIXELS,
    Keypoints2D,
    MessageError,
    Note,
    PointCountError,
    Source,
    UnknownLayout,
    WrongPointCount,
)

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_T = TypeVar("_T")

GROUP = "paul_ros.msg_adapters"
_TYPE_NAME = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*")

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Adapter:
    """Reader of the messages of one type.

    Attributes:
        read: read(msg, points, source) returns Keypoints2D for a layout of `points` keypoints or raises MessageError.
        layout: layout(msg) returns the name of the shipped layout that the message's points have, None = unknown.
        one_person: whether a message holds one person; messages with equal stamps are then persons of one image.
    """

    read: Callable[[Any, int, Source], Keypoints2D]
    layout: Callable[[Any], str | None] = lambda _: None
    one_person: bool = False


class Adapters(Mapping[str, "Adapter | Plugin"]):
    """Type name -> Adapter: the shipped adapters, then those of other packages.

    Other packages are searched on first use. Their adapters for shipped types are ignored with a warning.
    """

    def __init__(self, shipped: dict[str, Adapter]) -> None:
        self._shipped = shipped

    def __getitem__(self, type_name: str) -> Adapter | Plugin:
        return self._shipped[type_name] if type_name in self._shipped else self._others[type_name]

    def __iter__(self) -> Iterator[str]:
        return iter((*self._shipped, *self._others))

    def __len__(self) -> int:
        return len(self._shipped) + len(self._others)

    @functools.cached_property
    def _others(self) -> dict[str, Plugin]:
        found: dict[str, list[EntryPoint]] = {}
        for point in _entry_points():
            if point.name in self._shipped:
                _log.warning("%s has an adapter for %s; ignored, paul_ros has its own", _of(point), point.name)
            elif not _TYPE_NAME.fullmatch(point.name):
                _log.warning("%s has an adapter for %s; ignored, name it PACKAGE/msg/NAME", _of(point), point.name)
            else:
                found.setdefault(point.name, []).append(point)
        return {name: Plugin(name, points) for name, points in found.items()}


class OnePerson(Container[str]):
    """The types with one person per message: messages with equal stamps are persons of one image."""

    def __init__(self, adapters: Adapters) -> None:
        self._adapters = adapters

    def __contains__(self, type_name: object) -> bool:
        return isinstance(type_name, str) and type_name in self._adapters and self._adapters[type_name].one_person


class Plugin:
    """The Adapter of another package, guarded: every error names that package.

    The reasons of its MessageErrors: broken_adapter (it cannot be loaded) and adapter_failed (it raised anything but a
    MessageError, or its result is malformed).
    """

    def __init__(self, type_name: str, entry_points: list[EntryPoint]) -> None:
        self._type_name = type_name
        self._entry_points = entry_points

    def read(self, msg: Any, points: int, source: Source) -> Keypoints2D:
        """Read a message as `Adapter.read` does."""
        return self._ask(lambda adapter: _checked(adapter.read(msg, points, source), points))

    def layout(self, msg: Any) -> str | None:
        """Return a layout's name as `Adapter.layout` does."""
        return self._ask(lambda adapter: _checked_name(adapter.layout(msg)))

    @property
    def one_person(self) -> bool:
        """True if each message holds one person; False also if the adapter cannot be loaded."""
        return isinstance(self._loaded, Adapter) and bool(self._loaded.one_person)

    def _ask(self, question: Callable[[Adapter], _T]) -> _T:
        if isinstance(self._loaded, str):
            raise MessageError("broken_adapter", self._loaded)
        try:
            return question(self._loaded)
        except WrongPointCount as error:
            raise WrongPointCount(str(error), functools.partial(_fits, error)) from error
        except UnknownLayout as error:
            raise UnknownLayout(str(error), functools.partial(_fits, error)) from error
        except MessageError as error:
            raise MessageError(str(error.reason), str(error)) from error
        except (Exception, SystemExit) as error:
            raise MessageError(
                "adapter_failed", f"{self._who()} failed ({_line(error)}); report it to its authors, or uninstall it"
            ) from error

    @functools.cached_property
    def _loaded(self) -> Adapter | str:
        """The adapter, or the text of the error if it cannot be loaded."""
        if len(self._entry_points) > 1:
            packages = " and ".join(map(_of, self._entry_points))
            return f"{packages} all have an adapter for {self._type_name}; uninstall all but one"
        try:
            adapter = self._entry_points[0].load()
        except (Exception, SystemExit) as error:
            return f"{self._who()} cannot be loaded ({_line(error)}); repair or uninstall it"
        if not isinstance(adapter, Adapter):
            return f"{self._who()} is a {type(adapter).__name__}, not a msg_adapters.Adapter; repair or uninstall it"
        return adapter

    def _who(self) -> str:
        return f"the adapter for {self._type_name} of {_of(self._entry_points[0])}"


def _entry_points() -> list[EntryPoint]:
    from importlib import metadata  # its import takes a tenth of the node's start

    try:
        return list(metadata.entry_points(group=GROUP))
    except Exception as error:  # any damaged package in the environment raises
        _log.warning("adapters of other packages are ignored (%s); reinstall the damaged package", _line(error))
        return []


def _of(point: EntryPoint) -> str:
    """Return the package of an entry point, as text."""
    return f"the Python package {point.dist.name} {point.dist.version}" if point.dist else point.value


def _line(error: BaseException) -> str:
    """Return an error's type and text on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _fits(error: PointCountError, points: int) -> bool:
    try:
        return bool(error.fits(points))
    except Exception:
        return False


def _checked_name(layout: object) -> str | None:
    if not (layout is None or isinstance(layout, str)):
        raise TypeError(f"layout returned a {type(layout).__name__}, not a name or None")
    return layout


def _checked(keypoints: object, points: int) -> Keypoints2D:
    """Return the record; raise TypeError or ValueError if it violates the contract of Keypoints2D."""
    if not isinstance(keypoints, Keypoints2D):
        raise TypeError(f"read returned a {type(keypoints).__name__}, not a Keypoints2D")
    persons = len(keypoints.ids)
    wanted = {
        "xy": ("f", (persons, points, 2)),
        "confidence": ("f", (persons, points)),
        "visible": ("b", (persons, points)),
    }
    for name, (kind, shape) in wanted.items():
        array = np.asarray(getattr(keypoints, name))
        if array.shape != shape or array.dtype.kind != kind:
            raise ValueError(f"{name} is {array.dtype} {array.shape}; with {persons} ids it must be {kind} {shape}")
    xy = keypoints.xy[keypoints.visible]
    confidence = keypoints.confidence[keypoints.visible]
    # Comparisons with NaN are false.
    if not ((np.abs(xy) <= MAX_PIXELS).all() and ((confidence >= 0) & (confidence <= 1)).all()):
        raise ValueError("a visible point has no pixels or a confidence outside 0..1; make the result with record()")
    if not (type(keypoints.stamp) is int and all(type(name) is str for name in (*keypoints.ids, keypoints.frame_id))):
        raise TypeError("stamp must be an int, ids and frame_id text; make the result with record()")
    notes = keypoints.notes
    if not (type(notes) is tuple and all(isinstance(note, Note) and {*map(type, note)} == {str} for note in notes)):
        raise TypeError("notes must be a tuple of Note(reason, text)")
    return keypoints
