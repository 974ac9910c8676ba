# SPDX-License-Identifier: Apache-2.0
"""Named keypoints: what the P points of an array are, how they hang together, how layouts map onto another.

All shipped layouts name their points in one vocabulary, so a layout maps onto another by name alone. Points
of two layouts that are only nearly the same place on the body have different names there.
"""

from __future__ import annotations

import difflib
import functools
import re
from dataclasses import dataclass, field, fields
from importlib import resources
from pathlib import Path

import numpy as np
import yaml

from paul_ros.errors import LayoutError

#: Fewest points that a mapping must fill: two would leave the pose of a rigid body open.
MIN_MAPPED = 3

_SHIPPED = resources.files("paul_ros") / "layouts"
_MAX_BYTES = 1_000_000
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


@dataclass(frozen=True)
class Handedness:
    """A rule of anatomy that tells a shape from its mirror image; each field holds point indices.

    With m(.) the mean of points, (m(left) - m(right)) x (m(above) - m(below)) points along m(front) -
    m(behind) in any right-handed frame: left x up = forward, as in REP-103's body frame.
    """

    left: tuple[int, ...]
    right: tuple[int, ...]
    below: tuple[int, ...]
    above: tuple[int, ...]
    behind: tuple[int, ...]
    front: tuple[int, ...]


@dataclass(frozen=True)
class Part:
    """Points that belong to one object, and the edges between them, as indices of the layout."""

    points: tuple[int, ...]
    edges: tuple[tuple[int, int], ...]

    @functools.cached_property
    def columns(self) -> slice | list[int]:
        """The points as an index of arrays; those that lie side by side as a slice, which copies nothing."""
        first, last = self.points[0], self.points[-1]
        together = self.points == tuple(range(first, last + 1))
        return slice(first, last + 1) if together else list(self.points)

    @functools.cached_property
    def ends(self) -> np.ndarray:
        """(2,E) indices of the edges' ends."""
        return np.array(self.edges, int).reshape(-1, 2).T


@dataclass(frozen=True)
class Layout:
    """P named keypoints in order.

    names: P names. edges: bones, as pairs of point indices. left_right: pairs of (left, right) indices.
    root: the indices whose mean is the root point. derived: name -> indices whose mean that point is.
    handedness: rules of anatomy; may be empty. description: what it is and where its order comes from.
    categories: kinds of objects whose points lie side by side: name -> its points, of which alone a frame of that kind
    has any; empty where all points are of one object.
    min_visible: fewest points that a frame of one object must show to be lifted; None: a share of them all (model.py).
    """

    name: str
    names: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    left_right: tuple[tuple[int, int], ...]
    root: tuple[int, ...]
    derived: dict[str, tuple[int, ...]]
    handedness: tuple[Handedness, ...]
    description: str = ""
    categories: dict[str, tuple[int, ...]] = field(default_factory=dict)
    min_visible: int | None = None

    @classmethod
    def from_dict(cls, data: object) -> Layout:
        """The layout that a YAML file or a model's header describes; the inverse of to_dict.

        Raises LayoutError, naming the key at fault.
        """
        return _parse(data)

    def to_dict(self) -> dict:
        """Plain lists and names, for JSON or YAML."""
        layout = {
            "name": self.name,
            "description": self.description,
            "names": list(self.names),
            "edges": [self._named(edge) for edge in self.edges],
            "left_right": [self._named(pair) for pair in self.left_right],
            "root": self._named(self.root),
            "derived": {name: self._named(parts) for name, parts in self.derived.items()},
            "handedness": [
                {part: self._named(points) for part, points in vars(rule).items()} for rule in self.handedness
            ],
        }
        if self.categories:
            layout["categories"] = {name: self._named(points) for name, points in self.categories.items()}
        if self.min_visible:
            layout["min_visible"] = self.min_visible
        return layout

    @functools.cached_property
    def mirror(self) -> np.ndarray:
        """(P,) indices: points[mirror] has left and right swapped."""
        order = np.arange(len(self.names))
        for left, right in self.left_right:
            order[[left, right]] = right, left
        return order

    @functools.cached_property
    def mirrored_edges(self) -> np.ndarray:
        """(E,) indices: for each edge the one on the other side, or itself where there is none."""
        place = {frozenset(edge): index for index, edge in enumerate(self.edges)}
        twins = (frozenset(self.mirror[list(edge)].tolist()) for edge in self.edges)
        return np.array([place.get(twin, index) for index, twin in enumerate(twins)], int)

    @functools.cached_property
    def parts(self) -> tuple[Part, ...]:
        """The categories; one part of all points where there are none."""
        if not self.categories:
            return (Part(tuple(range(len(self.names))), self.edges),)
        own = [(points, set(points)) for points in self.categories.values()]
        return tuple(
            Part(points, tuple(edge for edge in self.edges if found.issuperset(edge))) for points, found in own
        )

    @property
    def sides(self) -> tuple[str, ...]:
        """P of 'left', 'right' or '' for a point of the middle."""
        sides = [""] * len(self.names)
        for left, right in self.left_right:
            sides[left], sides[right] = "left", "right"
        return tuple(sides)

    def map_to(self, target: Layout) -> Mapping:
        """How arrays in this layout become arrays in the target's: by name, derived points as means.

        Raises LayoutError where fewer than MIN_MAPPED points of the target can be filled.
        """
        sources = self._sources(target)
        filled = sum(bool(parts) for parts in sources)
        if filled < MIN_MAPPED:
            raise LayoutError(
                f"layout '{self.name}' has {filled} of the {len(target.names)} points of '{target.name}', "
                f"at least {MIN_MAPPED} are needed. Layouts that map onto '{target.name}': {_fitting(target)}"
            )
        return Mapping(self, target, sources)

    def _sources(self, target: Layout) -> tuple[tuple[int, ...], ...]:
        known = {**self.derived, **{name: (index,) for index, name in enumerate(self.names)}}
        return tuple(known.get(name, ()) for name in target.names)

    def _named(self, points: tuple[int, ...]) -> list[str]:
        return [self.names[index] for index in points]


@dataclass(frozen=True)
class Mapping:
    """Arrays of one layout into another. sources: per target point the source indices whose mean it is."""

    source: Layout
    target: Layout
    sources: tuple[tuple[int, ...], ...]

    def __call__(
        self, xy: np.ndarray, confidence: np.ndarray, visible: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """xy (N,P,2), confidence (N,P), visible (N,P) -> the same in the target's P points.

        A point that the source lacks is hidden: xy NaN, confidence 0. A derived point is the mean of its
        parts, visible only where all of them are. Raises ValueError where the arrays do not have the source's
        points.
        """
        self._check(xy, confidence, visible)
        if self.source.names == self.target.names:
            return xy, confidence, visible
        seen = np.zeros((len(xy), len(self.sources)), dtype=bool)
        for points, parts in self._groups:
            seen[:, points] = visible[:, parts].all(1)
        return self.values(xy), self.values(confidence, 0.0), seen

    def values(self, array: np.ndarray, lacking: float = np.nan) -> np.ndarray:
        """Values (N,P,...) of the source's points as those (N,Q,...) of the target's; `lacking` where none are."""
        if self.source.names == self.target.names:
            return array
        mapped = np.full((len(array), len(self.sources), *array.shape[2:]), lacking)
        for points, parts in self._groups:
            mapped[:, points] = array[:, parts].sum(1) / len(parts)
        return mapped

    @functools.cached_property
    def _groups(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Target points (G,) that are means of k source points each, and these (k,G), for every such k."""
        counts = np.array([len(parts) for parts in self.sources])
        groups = [np.flatnonzero(counts == k) for k in np.unique(counts[counts > 0])]
        return [(points, np.array([self.sources[point] for point in points]).T) for points in groups]

    def _check(self, xy: np.ndarray, confidence: np.ndarray, visible: np.ndarray) -> None:
        expected = len(xy), len(self.source.names)
        if xy.shape != (*expected, 2) or confidence.shape != expected or visible.shape != expected:
            raise ValueError(
                f"layout '{self.source.name}' needs xy (N,{expected[1]},2), confidence and visible "
                f"(N,{expected[1]}), got {xy.shape}, {confidence.shape}, {visible.shape}"
            )


def layout_names() -> tuple[str, ...]:
    """The shipped layouts, sorted."""
    return tuple(sorted(file.name[:-5] for file in _SHIPPED.iterdir() if file.name.endswith(".yaml")))


def middles(layout: Layout) -> dict[int, tuple[int, ...]]:
    """Points of a shipped layout that others derive from points which it has too: point -> those it is the mean of.

    So are pelvis and neck of `human` the middles of hips and shoulders. Of a user's layout nothing is known: the same
    names may be of an animal, whose neck is elsewhere.
    """
    if layout.name not in layout_names() or layout.names != load_layout(layout.name).names:
        return {}
    place, found = {name: index for index, name in enumerate(layout.names)}, {}
    for other in map(load_layout, layout_names()):
        for name, parts in other.derived.items():
            named = other._named(parts)
            if name in place and place.keys() >= set(named):
                found[place[name]] = tuple(place[part] for part in named)
    return found


def anonymous_layout(points: int, edges: tuple[tuple[int, int], ...] = ()) -> Layout:
    """A layout for P points of which nothing is known but how they hang together: p00, p01, ...

    Raises LayoutError: too few or too many points, or edges that join no two of them.
    """
    names = [f"p{point:0{max(2, len(str(points - 1)))}d}" for point in range(points)]
    if any(not 0 <= point < points for edge in edges for point in edge):
        raise LayoutError(f"edges must join points 0 to {points - 1}")
    named = [[names[point] for point in edge] for edge in edges]
    return Layout.from_dict({"name": f"points{points}", "names": names, "edges": named, "root": names})


def load_layout(name_or_path: str | Path) -> Layout:
    """A shipped layout by name, an anonymous one as points41, or a user's own by the path of its YAML file.

    Raises LayoutError: unknown name, unreadable or oversized file, or a file that describes no layout.
    """
    name = str(name_or_path)
    if name in layout_names():
        return _shipped(name)
    if anonymous := re.fullmatch(r"points(\d{1,6})", name):
        return anonymous_layout(int(anonymous[1]))
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml") and len(path.parts) < 2:
        raise LayoutError(_unknown(name))
    try:
        return Layout.from_dict(_read_yaml(path))
    except LayoutError as error:
        raise LayoutError(f"layout file {path}: {error}") from None


@functools.cache
def _shipped(name: str) -> Layout:
    # With libyaml in a tenth of the time. Not for users' files: it recurses in C, where too deep a nesting is no error.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return Layout.from_dict(yaml.load((_SHIPPED / f"{name}.yaml").read_bytes(), loader))


def _unknown(name: str) -> str:
    close = difflib.get_close_matches(name.lower(), layout_names(), n=1)
    hint = f", did you mean '{close[0]}'?" if close else "."
    known = ", ".join(layout_names())
    return f"no layout '{name}'{hint} There are {known}; for one of your own give the path of its .yaml"


def _read_yaml(path: Path) -> object:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise LayoutError(f"{path.stat().st_size} bytes; a layout has at most {_MAX_BYTES}")
        return yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise LayoutError(error.strerror or str(error)) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, LayoutError):
            raise
        raise LayoutError(f"no YAML: {' '.join(str(error).split())[:200]}") from None


def _fitting(target: Layout) -> str:
    shipped = (load_layout(name) for name in layout_names())
    names = [layout.name for layout in shipped if sum(map(bool, layout._sources(target))) >= MIN_MAPPED]
    return ", ".join(names) or "none of the shipped ones; name its points as one of them does"


def _parse(data: object) -> Layout:
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
    return Layout(
        name=_text(data["name"], "name"),
        names=names,
        edges=_pairs(data.get("edges", []), "edges", index),
        left_right=_sides(data.get("left_right", []), index),
        root=_root(data["root"], index, derived),
        derived=derived,
        handedness=tuple(_rule(rule, index) for rule in _list(data.get("handedness", []), "handedness")),
        description=_text(data["description"], "description").strip() if data.get("description") else "",
        categories=_categories(data.get("categories", {}), index),
        min_visible=_min_visible(data["min_visible"], names) if "min_visible" in data else None,
    )


def _names(value: object) -> tuple[str, ...]:
    names = tuple(_text(name, "a name in names") for name in _list(value, "names"))
    if not MIN_MAPPED <= len(names) <= _MAX_POINTS:
        raise LayoutError(f"names has {len(names)} points; from {MIN_MAPPED} to {_MAX_POINTS} can be lifted")
    seen: set[str] = set()
    twice = [name for name in names if name in seen or seen.add(name)]
    if twice:
        raise LayoutError(f"names has {_listed(twice)} more than once")
    return names


def _root(value: object, index: dict[str, int], derived: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    if isinstance(value, str) and value in derived:
        return derived[value]
    return _points([value] if isinstance(value, str) else value, "root", index)


def _sides(value: object, index: dict[str, int]) -> tuple[tuple[int, int], ...]:
    pairs = _pairs(value, "left_right", index)
    used = [point for pair in pairs for point in pair]
    if len(set(used)) < len(used):
        raise LayoutError("left_right has a point in two pairs")
    return pairs


def _categories(value: object, index: dict[str, int]) -> dict[str, tuple[int, ...]]:
    categories = {
        _text(name, "a name in categories"): _points(points, f"category '{name}'", index)
        for name, points in _mapping(value, "categories").items()
    }
    if categories and sorted(point for points in categories.values() for point in points) != list(range(len(index))):
        raise LayoutError("categories must have every point once")
    return categories


def _min_visible(value: object, names: tuple[str, ...]) -> int:
    if type(value) is not int or not MIN_MAPPED <= value <= len(names):
        raise LayoutError(f"min_visible must be a whole number from {MIN_MAPPED} to the {len(names)} points")
    return value


def _rule(value: object, index: dict[str, int]) -> Handedness:
    rule = _mapping(value, "a rule in handedness")
    parts = [field.name for field in fields(Handedness)]
    if set(rule) != set(parts):
        raise LayoutError(f"a rule in handedness has the keys {', '.join(parts)}, all of them and no other")
    return Handedness(*(_points(rule[part], f"handedness {part}", index) for part in parts))


def _pairs(value: object, where: str, index: dict[str, int]) -> tuple[tuple[int, int], ...]:
    pairs = tuple(_points(pair, where, index) for pair in _list(value, where))
    if any(len(pair) != 2 or pair[0] == pair[1] for pair in pairs):
        raise LayoutError(f"{where} must be pairs of two different points")
    return pairs


def _points(value: object, where: str, index: dict[str, int]) -> tuple[int, ...]:
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
        if isinstance(value, (bool, int, float)):  # what YAML makes of an unquoted `no` or `12`
            raise LayoutError(f"{where} must be text, but YAML reads it as {_shown(value)}: put it in quotes")
        raise LayoutError(f"{where} must be text, not {'empty' if value == '' else type(value).__name__}")
    return value


def _shown(value: object) -> str:
    """A scalar for a message; Python refuses to print integers of thousands of digits."""
    if isinstance(value, int) and value.bit_length() > 64:
        return f"a number of {value.bit_length()} bits"
    return repr(value)


def _listed(names: list[str]) -> str:
    """The first few of some names, for a message."""
    rest = len(names) - 5
    return ", ".join(f"'{name[:40]}'" for name in names[:5]) + (f" and {rest} more" if rest > 0 else "")
