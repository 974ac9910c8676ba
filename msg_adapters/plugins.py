# SPDX-License-Identifier: Apache-2.0
"""Adapters of other packages: found by an entry point, loaded with the first message of their type, never trusted.

A package declares, in the group GROUP, an entry point named like the message type and pointing to an Adapter; how, with
a complete example, is in docs/adapters.md. What such an adapter does wrong costs its messages, which are dropped with a
reason that names its package, and nothing else.
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from msg_adapters.keypoints import ABSURD_PIXELS, Keypoints2D, MessageError, Source, WrongPointCount

GROUP = "paul_ros.msg_adapters"
_TYPE_NAME = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*")

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Adapter:
    """How the messages of one type are read.

    read(msg, points, source): as Keypoints2D of a layout of `points` keypoints; raises MessageError.
    layout(msg): the shipped layout whose points the messages are, by what this one says; None = it does not say.
    one_person: a message is one person, and those of one stamp are of one image.
    """

    read: Callable[[object, int, Source], Keypoints2D]
    layout: Callable[[object], str | None] = lambda _: None
    one_person: bool = False


class Adapters(Mapping):
    """Type name -> Adapter: the shipped ones, then those of other packages, which are looked for when first asked for.

    A package cannot take a shipped type over: its adapter is left aside with a warning.
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
        found: dict[str, list] = {}
        for point in _entry_points():
            if point.name in self._shipped:
                _log.warning("%s has an adapter for %s, which paul_ros reads itself; not used", _of(point), point.name)
            elif not _TYPE_NAME.fullmatch(point.name):
                _log.warning("%s has an adapter for %s, which is no PACKAGE/msg/NAME; not used", _of(point), point.name)
            else:
                found.setdefault(point.name, []).append(point)
        return {name: Plugin(name, points) for name, points in found.items()}


class OnePerson(Container):
    """The types whose message is one person: those of one stamp are of one image."""

    def __init__(self, adapters: Adapters) -> None:
        self._adapters = adapters

    def __contains__(self, type_name: object) -> bool:
        return type_name in self._adapters and self._adapters[type_name].one_person


class Plugin:
    """Stands for the Adapter of another package and says whose fault it is where that cannot be used.

    Raises MessageError: broken_adapter (it cannot be loaded), adapter_failed (it raised something else than a
    MessageError, or its result is no record of the message).
    """

    def __init__(self, type_name: str, points: list) -> None:
        self._type_name = type_name
        self._points = points

    def read(self, msg, points: int, source: Source) -> Keypoints2D:
        """See Adapter."""
        return self._ask(lambda adapter: _checked(adapter.read(msg, points, source), points))

    def layout(self, msg) -> str | None:
        """See Adapter."""
        return self._ask(lambda adapter: _name(adapter.layout(msg)))

    @property
    def one_person(self) -> bool:
        """See Adapter; of one that cannot be loaded nothing is known."""
        return isinstance(self._loaded, Adapter) and bool(self._loaded.one_person)

    def _ask(self, question: Callable[[Adapter], object]):
        if isinstance(self._loaded, str):
            raise MessageError("broken_adapter", self._loaded)
        try:
            return question(self._loaded)
        except WrongPointCount as error:
            raise WrongPointCount(str(error), functools.partial(_fits, error)) from error
        except MessageError as error:
            raise MessageError(str(error.reason), str(error)) from error
        except (Exception, SystemExit) as error:
            raise MessageError(
                "adapter_failed", f"{self._who()} failed ({_line(error)}); tell its authors, or uninstall it"
            ) from error

    @functools.cached_property
    def _loaded(self) -> Adapter | str:
        """The adapter, or why there is none."""
        if len(self._points) > 1:
            packages = " and ".join(map(_of, self._points))
            return f"{packages} all have an adapter for {self._type_name}; uninstall all but one"
        try:
            adapter = self._points[0].load()
        except (Exception, SystemExit) as error:
            return f"{self._who()} cannot be loaded ({_line(error)}); mend or uninstall it"
        if not isinstance(adapter, Adapter):
            return f"{self._who()} is a {type(adapter).__name__}, not a msg_adapters.Adapter; mend or uninstall it"
        return adapter

    def _who(self) -> str:
        return f"the adapter for {self._type_name} of {_of(self._points[0])}"


def _entry_points() -> list:
    """One of each package that has some."""
    from importlib import metadata  # a tenth of the node's start, and mostly not needed

    try:
        return list(metadata.entry_points(group=GROUP))
    except Exception as error:  # one damaged package among all that are installed is enough
        _log.warning("adapters of other packages cannot be looked for (%s)", _line(error))
        return []


def _of(point) -> str:
    return f"the Python package {point.dist.name} {point.dist.version}" if point.dist else point.value


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _fits(error: WrongPointCount, points: int) -> bool:
    try:
        return bool(error.fits(points))
    except Exception:
        return False


def _name(layout: str | None) -> str | None:
    if not (layout is None or isinstance(layout, str)):
        raise TypeError(f"layout gave a {type(layout).__name__}, not a name or None")
    return layout


def _checked(keypoints: Keypoints2D, points: int) -> Keypoints2D:
    """Raises TypeError or ValueError where this is not what Keypoints2D says."""
    if not isinstance(keypoints, Keypoints2D):
        raise TypeError(f"read gave a {type(keypoints).__name__}, not a Keypoints2D")
    persons = len(keypoints.ids)
    wanted = {
        "xy": ("f", (persons, points, 2)),
        "confidence": ("f", (persons, points)),
        "visible": ("b", (persons, points)),
    }
    for name, (kind, shape) in wanted.items():
        array = np.asarray(getattr(keypoints, name))
        if array.shape != shape or array.dtype.kind != kind:
            raise ValueError(f"{name} is {array.dtype} {array.shape}; of {persons} ids it must be {kind} {shape}")
    seen = keypoints.xy[keypoints.visible]
    sure = keypoints.confidence[keypoints.visible]
    # Comparisons with NaN are false.
    if not ((np.abs(seen) <= ABSURD_PIXELS).all() and ((sure >= 0) & (sure <= 1)).all()):
        raise ValueError("a visible point has no pixels, or a confidence outside 0..1; make the result with record()")
    if not (type(keypoints.stamp) is int and all(type(name) is str for name in (*keypoints.ids, keypoints.frame_id))):
        raise TypeError("stamp must be an int, ids and frame_id text; make the result with record()")
    return keypoints
