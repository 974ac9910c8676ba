# SPDX-License-Identifier: Apache-2.0
"""The schema of a layout: check what a YAML file or a model's header says, and resolve names to point indices.

``paul_ros.layout.Layout`` describes the keys. Every error names the key at fault.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from paul_ros.errors import LayoutError

MIN_POINTS = 3
"""Fewest points of a layout, and of a mapping: two would leave the pose of a rigid body open."""

_MAX_POINTS = 20_000
_KEYS = (
    "name",
    "description",
    "names",
    "edges",
    "left_right",
    "root",
    "derived",
    "handedness",
    "categories",
    "min_visible",
)
_RULE_KEYS = ("left", "right", "below", "above", "behind", "front")
_SHOWN = 5  # most names in an error

Points = tuple[int, ...]
Pair = tuple[int, int]


def parse(data: object) -> dict[str, Any]:
    """Return the attributes of a Layout, with points as indices; each rule of handedness is a dict.

    Args:
        data: plain mapping of the keys above, as YAML or JSON gives it.

    Raises:
        LayoutError: the data describe no layout.
    """
    data = _mapping(data, "a layout")
    unknown = [key if isinstance(key, str) else _shown(key) for key in data if key not in _KEYS]
    if unknown:
        raise LayoutError(f"unknown key {_listed(unknown)}; the keys are {', '.join(_KEYS)}")
    missing = [key for key in ("name", "names", "root") if key not in data]
    if missing:
        raise LayoutError(f"{_listed(missing)} missing")
    names = _names(data["names"])
    index = {name: place for place, name in enumerate(names)}
    derived = {
        _text(name, "a name in derived"): _points(parts, f"derived '{name}'", index)
        for name, parts in _mapping(data.get("derived", {}), "derived").items()
    }
    clashes = [name for name in derived if name in index]
    if clashes:
        raise LayoutError(f"derived {_listed(clashes)} is among the names already")
    return {
        "name": _text(data["name"], "name"),
        "names": names,
        "edges": _pairs(data.get("edges", []), "edges", index),
        "left_right": _sides(data.get("left_right", []), index),
        "root": _root(data["root"], index, derived),
        "derived": derived,
        "handedness": [_rule(rule, index) for rule in _list(data.get("handedness", []), "handedness")],
        "description": _text(data["description"], "description").strip() if data.get("description") else "",
        "categories": _categories(data.get("categories", {}), index),
        "min_visible": _min_visible(data["min_visible"], names) if "min_visible" in data else None,
    }


def _names(value: object) -> tuple[str, ...]:
    names = tuple(_text(name, "a name in names") for name in _list(value, "names"))
    if not MIN_POINTS <= len(names) <= _MAX_POINTS:
        raise LayoutError(f"names has {len(names)} points; from {MIN_POINTS} to {_MAX_POINTS} can be lifted")
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise LayoutError(f"names has {_listed(twice)} more than once")
    return names


def _root(value: object, index: dict[str, int], derived: dict[str, Points]) -> Points:
    if isinstance(value, str) and value in derived:
        return derived[value]
    return _points([value] if isinstance(value, str) else value, "root", index)


def _sides(value: object, index: dict[str, int]) -> tuple[Pair, ...]:
    pairs = _pairs(value, "left_right", index)
    used = [point for pair in pairs for point in pair]
    if len(set(used)) < len(used):
        raise LayoutError("left_right has a point in two pairs")
    return pairs


def _categories(value: object, index: dict[str, int]) -> dict[str, Points]:
    categories = {
        _text(name, "a name in categories"): _points(points, f"category '{name}'", index)
        for name, points in _mapping(value, "categories").items()
    }
    if categories and sorted(point for points in categories.values() for point in points) != list(range(len(index))):
        raise LayoutError("categories must have every point once")
    return categories


def _min_visible(value: object, names: tuple[str, ...]) -> int:
    if type(value) is not int or not MIN_POINTS <= value <= len(names):
        raise LayoutError(f"min_visible must be a whole number from {MIN_POINTS} to the {len(names)} points")
    return value


def _rule(value: object, index: dict[str, int]) -> dict[str, Points]:
    rule = _mapping(value, "a rule in handedness")
    if set(rule) != set(_RULE_KEYS):
        raise LayoutError(f"a rule in handedness has the keys {', '.join(_RULE_KEYS)}, all of them and no other")
    return {key: _points(rule[key], f"handedness {key}", index) for key in _RULE_KEYS}


def _pairs(value: object, where: str, index: dict[str, int]) -> tuple[Pair, ...]:
    pairs = [_points(pair, where, index) for pair in _list(value, where)]
    if any(len(pair) != 2 or pair[0] == pair[1] for pair in pairs):
        raise LayoutError(f"{where} must be pairs of two different points")
    return tuple((first, second) for first, second in pairs)


def _points(value: object, where: str, index: dict[str, int]) -> Points:
    names = [_text(name, f"a point in {where}") for name in _list(value, where)]
    unknown = [name for name in names if name not in index]
    if unknown:
        raise LayoutError(f"{where} names {_listed(unknown)}, not in names")
    if not names:
        raise LayoutError(f"{where} names no point")
    return tuple(index[name] for name in names)


def _mapping(value: object, where: str) -> dict:
    if not isinstance(value, dict):
        raise LayoutError(f"{where} must be a mapping, not {type(value).__name__}")
    return value


def _list(value: object, where: str) -> list:
    if not isinstance(value, list):
        raise LayoutError(f"{where} must be a list, not {type(value).__name__}")
    return value


def _text(value: object, where: str) -> str:
    if not isinstance(value, str) or not value:
        if isinstance(value, (bool, int, float)):  # YAML's value of an unquoted `no` or `12`
            raise LayoutError(f"{where} must be text, but YAML reads it as {_shown(value)}: put it in quotes")
        raise LayoutError(f"{where} must be text, not {'empty' if value == '' else type(value).__name__}")
    return value


def _shown(value: object) -> str:
    """Return a scalar as text; Python refuses to print integers of thousands of digits."""
    if isinstance(value, int) and value.bit_length() > 64:
        return f"a number of {value.bit_length()} bits"
    return repr(value)


def _listed(names: list[str]) -> str:
    """Return the first few of some names as text."""
    rest = len(names) - _SHOWN
    return ", ".join(f"'{name[:40]}'" for name in names[:_SHOWN]) + (f" and {rest} more" if rest > 0 else "")
