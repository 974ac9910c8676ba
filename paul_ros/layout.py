# SPDX-License-Identifier: Apache-2.0
"""Layouts: named keypoints, their edges and sides, and mappings between layouts.

All shipped layouts take their names from one vocabulary, so a layout maps onto another by name alone. Points at only
nearly the same place on the body have different names.
"""

from __future__ import annotations

import functools
import os
import re
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from paul_ros.errors import InputError, LayoutError
from paul_ros.layout_schema import MIN_POINTS, Pair, Points, parse
from paul_ros.wording import did_you_mean

_SHIPPED = resources.files("paul_ros") / "layouts"
_MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Handedness:
    """A rule of anatomy that distinguishes a shape from its mirror image; each attribute holds point indices.

    Let m(.) be the mean of points. Then (m(left) - m(right)) x (m(above) - m(below)) points along
    m(front) - m(behind) in any right-handed frame. This is left x up = forward, as in REP-103's body frame.
    """

    left: Points
    right: Points
    below: Points
    above: Points
    behind: Points
    front: Points


@dataclass(frozen=True)
class Part:
    """The points of one object and the edges between them, as indices of the layout."""

    points: Points
    edges: tuple[Pair, ...]

    @functools.cached_property
    def columns(self) -> slice | list[int]:
        """Index of arrays that selects the points: a slice, which copies nothing, if they lie side by side."""
        first, last = self.points[0], self.points[-1]
        adjacent = self.points == tuple(range(first, last + 1))
        return slice(first, last + 1) if adjacent else list(self.points)

    @functools.cached_property
    def ends(self) -> np.ndarray:
        """(2,E) point indices of the ends of the edges."""
        return np.array(self.edges, int).reshape(-1, 2).T


@dataclass(frozen=True)
class Layout:
    """P named keypoints in order.

    >>> layout = load_layout("coco17")
    >>> layout.names[:3], len(layout.names), layout.derived["pelvis"]
    (('nose', 'left_eye', 'right_eye'), 17, (11, 12))

    Attributes:
        name: name of the layout.
        names: P names of points.
        edges: bones, pairs of point indices.
        left_right: pairs of (left, right) point indices.
        root: the indices whose mean is the root point.
        derived: names of further points -> the indices whose mean each is.
        handedness: rules of anatomy; may be empty.
        description: what the layout is and the source of its order.
        categories: kinds of objects whose points lie side by side: name -> point indices. A frame of one kind has
            points of that category only. Empty if all points belong to one object.
        min_visible: fewest visible points of an object that are lifted; None for 30 %, at least 4.
    """

    name: str
    names: tuple[str, ...]
    edges: tuple[Pair, ...]
    left_right: tuple[Pair, ...]
    root: Points
    derived: dict[str, Points]
    handedness: tuple[Handedness, ...]
    description: str = ""
    categories: dict[str, Points] = field(default_factory=dict)
    min_visible: int | None = None

    @classmethod
    def from_dict(cls, data: object) -> Layout:
        """Build the layout that a YAML file or a model's header describes; the inverse of ``to_dict``.

        Raises:
            LayoutError: the data describe no layout; the text names the key at fault.
        """
        attributes = parse(data)
        rules = tuple(Handedness(**rule) for rule in attributes.pop("handedness"))
        return cls(**attributes, handedness=rules)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and names, for JSON or YAML."""
        layout: dict[str, Any] = {
            "name": self.name,
            "description": self.description,
            "names": list(self.names),
            "edges": [self.point_names(edge) for edge in self.edges],
            "left_right": [self.point_names(pair) for pair in self.left_right],
            "root": self.point_names(self.root),
            "derived": {name: self.point_names(parts) for name, parts in self.derived.items()},
            "handedness": [
                {part: self.point_names(points) for part, points in vars(rule).items()} for rule in self.handedness
            ],
        }
        if self.categories:
            layout["categories"] = {name: self.point_names(points) for name, points in self.categories.items()}
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
        """(E,) index of every edge's counterpart on the other side, or of the edge itself without one."""
        place = {frozenset(edge): index for index, edge in enumerate(self.edges)}
        twins = (frozenset(self.mirror[list(edge)].tolist()) for edge in self.edges)
        return np.array([place.get(twin, index) for index, twin in enumerate(twins)], int)

    @functools.cached_property
    def parts(self) -> tuple[Part, ...]:
        """One part per category, or one part of all points without categories."""
        if not self.categories:
            return (Part(tuple(range(len(self.names))), self.edges),)
        own = [(points, set(points)) for points in self.categories.values()]
        return tuple(
            Part(points, tuple(edge for edge in self.edges if found.issuperset(edge))) for points, found in own
        )

    @property
    def sides(self) -> tuple[str, ...]:
        """P sides: 'left', 'right' or '' for a point of the middle."""
        sides = [""] * len(self.names)
        for left, right in self.left_right:
            sides[left], sides[right] = "left", "right"
        return tuple(sides)

    def map_to(self, target: Layout) -> Mapping:
        """Return the mapping of arrays to another layout, by name; derived points are means.

        Raises:
            LayoutError: fewer than 3 points of the target can be filled; the text names layouts that fit.
        """
        sources = self._sources(target)
        filled = sum(bool(parts) for parts in sources)
        if filled < MIN_POINTS:
            raise LayoutError(
                f"layout '{self.name}' has {filled} of the {len(target.names)} points of '{target.name}', "
                f"at least {MIN_POINTS} are needed. Layouts that map onto '{target.name}': {_layouts_onto(target)}"
            )
        return Mapping(self, target, sources)

    def fits(self, target: Layout) -> bool:
        """Return whether the layout maps onto another one."""
        return sum(map(bool, self._sources(target))) >= MIN_POINTS

    def point_names(self, points: tuple[int, ...]) -> list[str]:
        """Return the names of points by index."""
        return [self.names[index] for index in points]

    def _sources(self, target: Layout) -> tuple[Points, ...]:
        known = {**self.derived, **{name: (index,) for index, name in enumerate(self.names)}}
        return tuple(known.get(name, ()) for name in target.names)


@dataclass(frozen=True)
class Mapping:
    """A mapping of arrays from one layout to another.

    Attributes:
        source: layout of the arrays that come in.
        target: layout of the arrays that come out.
        sources: for each point of the target the source indices whose mean it is; () if the source lacks it.
    """

    source: Layout
    target: Layout
    sources: tuple[Points, ...]

    def __call__(
        self, xy: np.ndarray, confidence: np.ndarray, visible: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Map 2D keypoints. Points that the source lacks are hidden: xy NaN, confidence 0.

        Args:
            xy: (N,P,2) any unit.
            confidence: (N,P).
            visible: (N,P) bool. A derived point is visible only if all its parts are.

        Returns:
            The same with the target's points.

        Raises:
            InputError: the arrays do not have the source's points.
        """
        self._check(xy, confidence, visible)
        if self.source.names == self.target.names:
            return xy, confidence, visible
        return self.values(xy), self.values(confidence, 0.0), self.visibility(visible)

    def values(self, array: np.ndarray, lacking: float = np.nan) -> np.ndarray:
        """Map values (N,P,...) of the source's points to (N,Q,...); ``lacking`` for points that the source lacks."""
        if self.source.names == self.target.names:
            return array
        mapped = np.full((len(array), len(self.sources), *array.shape[2:]), lacking)
        for points, parts in self._groups:
            mapped[:, points] = array[:, parts].sum(1) / len(parts)
        return mapped

    def visibility(self, visible: np.ndarray) -> np.ndarray:
        """Map visibility (N,P) to (N,Q): a point is visible if the source has all its parts, and they are visible."""
        if self.source.names == self.target.names:
            return visible
        mapped = np.zeros((len(visible), len(self.sources)), dtype=bool)
        for points, parts in self._groups:
            mapped[:, points] = visible[:, parts].all(1)
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
            raise InputError(
                f"layout '{self.source.name}' needs xy (N,{expected[1]},2), confidence and visible "
                f"(N,{expected[1]}), got {xy.shape}, {confidence.shape}, {visible.shape}"
            )


def layout_names() -> tuple[str, ...]:
    """Return the names of the shipped layouts, sorted."""
    return tuple(sorted(file.name[:-5] for file in _SHIPPED.iterdir() if file.name.endswith(".yaml")))


def load_layout(name_or_path: str | os.PathLike[str]) -> Layout:
    """Load a shipped layout by name, an anonymous one by number (``points41``), or a YAML file by path.

    Raises:
        LayoutError: the name is unknown, or the file is unreadable, too large, or describes no layout.
    """
    if not isinstance(name_or_path, (str, os.PathLike)):
        raise LayoutError(f"layout is a {type(name_or_path).__name__}: pass a name or the path of a YAML file")
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


def anonymous_layout(points: int, edges: tuple[Pair, ...] = ()) -> Layout:
    """Return a layout of so many points without meaning: p00, p01, ...

    Raises:
        LayoutError: too few or too many points, or an edge that does not join two of them.
    """
    names = [f"p{point:0{max(2, len(str(points - 1)))}d}" for point in range(points)]
    if any(not 0 <= point < points for edge in edges for point in edge):
        raise LayoutError(f"edges must join points 0 to {points - 1}")
    named = [[names[point] for point in edge] for edge in edges]
    return Layout.from_dict({"name": f"points{points}", "names": names, "edges": named, "root": names})


def midpoints(layout: Layout) -> dict[int, Points]:
    """Return the points of a shipped layout that are means of others of its points.

    They are found from other shipped layouts, which derive them: pelvis and neck of ``human`` are the midpoints of
    hips and shoulders. A user's layout has none, because its names may belong to an animal, whose neck is elsewhere.

    Returns:
        Index of each such point -> indices of the points whose mean it is.
    """
    if layout.name not in layout_names() or layout.names != load_layout(layout.name).names:
        return {}
    place = {name: index for index, name in enumerate(layout.names)}
    found: dict[int, Points] = {}
    for other in map(load_layout, layout_names()):
        for name, parts in other.derived.items():
            named = other.point_names(parts)
            if name in place and place.keys() >= set(named):
                found[place[name]] = tuple(place[part] for part in named)
    return found


@functools.cache
def _shipped(name: str) -> Layout:
    # libyaml takes a tenth of the time. It is not for users' files: it recurses in C, and deep nesting would crash it.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return Layout.from_dict(yaml.load((_SHIPPED / f"{name}.yaml").read_bytes(), loader))


def _unknown(name: str) -> str:
    hint, known = did_you_mean(name, layout_names()) or ".", ", ".join(layout_names())
    return f"no layout '{name}'{hint} There are {known}; for one of your own give the path of its .yaml"


def _read_yaml(path: Path) -> object:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise LayoutError(f"{path.stat().st_size} bytes; a layout has at most {_MAX_BYTES}")
        return yaml.safe_load(path.read_bytes())
    except FileNotFoundError:
        raise LayoutError("no such file") from None
    except OSError as error:
        raise LayoutError(error.strerror or str(error)) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, LayoutError):
            raise
        raise LayoutError(f"not YAML: {' '.join(str(error).split())[:200]}") from None


def _layouts_onto(target: Layout) -> str:
    """Return the names of the shipped layouts that map onto the target, as text for an error."""
    names = [name for name in layout_names() if load_layout(name).fits(target)]
    return ", ".join(names) or "none of the shipped ones; name its points as one of them does"
