# SPDX-License-Identifier: Apache-2.0
"""How people are seen: every setting of the training views, for ``human_data.py``."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from paul_ros.errors import LayoutError
from training.errors import ViewsError
from training.people.mocap import human_mapping

COMPLETE = "complete"
"""In place of a layout: a detector of all points of ``human``."""

_RANGES = ("forearm", "distance", "height", "elevation", "field", "level", "hidden")
_SHARES = ("aloft", "tilted", "obstacle", "guessed", "min_confidence")


@dataclass(frozen=True)
class Views:
    """Settings of the views; angles in degrees, lengths in metres.  Pairs are the ends of uniform distributions.

    At level 1 the detector errs as one that was measured (``detector.py``), at level 0 it gives true projections.
    """

    # What is looked at
    motion: float = 10.0  # a frame is taken once a limb has turned by this much since the last one taken
    views: int = 6  # cameras a frame, each of another person, at another place, with another detector
    stature: float = 0.06  # standard deviation of the logarithm of a factor on the whole body
    proportions: float = 0.04  # the same for each of thighs, shanks, feet, hips, trunk, neck, shoulders and upper arms
    forearm: tuple[float, float] = (1.0, 1.5)  # a factor: the capture's radius ends above the wrist (mocap.py)
    # From where
    distance: tuple[float, float] = (1.5, 10.0)  # to the middle of the body; uniform in its logarithm
    height: tuple[float, float] = (0.3, 1.8)  # of cameras on floor robots, above the lowest point of the body
    aloft: float = 0.25  # share of cameras on drones, masts and ceilings ...
    elevation: tuple[float, float] = (10.0, 60.0)  # ... that look down at such angles
    # With which camera
    field: tuple[float, float] = (50.0, 110.0)  # horizontal field of view
    off_axis: float = 0.4  # standard deviation of the body's place in the image, in half widths and half heights
    roll: float = 2.0  # standard deviation of most cameras' ...
    tilted: float = 0.1  # ... and of this share's,
    tilt: float = 15.0  # which are held askew
    border: bool = True  # points outside of the image are not seen
    # What is missing
    hidden: tuple[float, float] = (0.0, 0.4)  # share of a view's points that the detector misses for no visible reason
    obstacle: float = 0.15  # share of views in which a thing in front covers the body beyond a line
    occlusion: bool = True  # the body hides its own points
    guessed: float = 0.7  # share of those that the detector reports nevertheless, less well
    # By which detector
    level: tuple[float, float] = (0.0, 1.0)  # of its errors, drawn for every view
    min_confidence: float = 0.3  # points below are hidden, as in the node
    layouts: tuple[tuple[str, float], ...] = (  # whose points it reports, and its share of the views
        ("coco17", 0.3),
        ("body25", 0.15),
        ("openpose18", 0.1),  # and hri18, of the same points
        ("h36m17", 0.15),
        ("mediapipe33", 0.15),
        (COMPLETE, 0.15),
    )
    seed: int = 0

    def __post_init__(self) -> None:
        for name in _RANGES:
            pair = getattr(self, name)
            numbers = len(pair) == 2 and all(type(end) in (int, float) for end in pair)
            self._need(name, numbers and 0 <= pair[0] <= pair[1], "two growing numbers from 0 up")
        for name in _SHARES:
            self._need(name, 0 <= getattr(self, name) <= 1, "from 0 to 1")
        for name in ("stature", "proportions", "off_axis", "roll", "tilt", "seed"):
            self._need(name, getattr(self, name) >= 0, "at least 0")
        self._need("motion", self.motion > 0, "positive")
        self._need("views", self.views > 0, "positive")
        self._need("forearm", self.forearm[0] > 0, "positive")
        self._need("distance", self.distance[0] >= 0.5, "at least 0.5")
        self._need("elevation", self.elevation[1] <= 85, "at most 85")
        self._need("field", 5 <= self.field[0] and self.field[1] <= 150, "within 5 and 150")
        self._need("level", self.level[1] <= 1, "at most 1")
        self._need("hidden", self.hidden[1] <= 1, "at most 1")
        self._check_layouts()

    def _check_layouts(self) -> None:
        pairs = [item if isinstance(item, tuple) and len(item) == 2 else (None, None) for item in self.layouts]
        shares = [share for name, share in pairs if isinstance(name, str) and type(share) in (int, float)]
        sound = len(shares) == len(pairs) and all(share >= 0 for share in shares) and sum(shares) > 0
        self._need("layouts", sound, "a list of [layout, share]")
        for name, _ in self.layouts:
            try:
                _ = name == COMPLETE or human_mapping(name)
            except LayoutError as error:
                raise ViewsError(f"view setting layouts: {error}") from None

    def _need(self, name: str, holds: object, what: str) -> None:
        if not holds:
            raise ViewsError(f"view setting {name} must be {what}, it is {getattr(self, name)!r}")

    @classmethod
    def from_dict(cls, settings: object) -> Views:
        """Build from plain lists and numbers, as YAML has them; raises ViewsError."""
        if not isinstance(settings, dict):
            raise ViewsError("the views must be settings as key: value")
        defaults = {field.name: field.default for field in dataclasses.fields(cls)}
        if unknown := [str(key) for key in settings if key not in defaults]:
            raise ViewsError(f"unknown view setting {', '.join(unknown)}; known are {', '.join(defaults)}")
        return cls(**{key: _converted(key, value, defaults[key]) for key, value in settings.items()})

    def to_dict(self) -> dict:
        """Plain lists and numbers, for YAML and JSON; the inverse of from_dict."""
        plain = {key: list(value) if isinstance(value, tuple) else value for key, value in vars(self).items()}
        return {**plain, "layouts": [list(pair) for pair in self.layouts]}


def _converted(key: str, value: object, default: object) -> object:
    """The value in the default's type; lists become tuples."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        return tuple(tuple(item) if isinstance(item, list) else item for item in value)
    if isinstance(default, bool) and isinstance(value, bool):
        return value
    numbers = type(default) in (int, float) and type(value) in (int, float)
    if numbers and math.isfinite(value) and (type(default) is float or value == int(value)):
        return type(default)(value)
    raise ViewsError(f"view setting {key} must be like {default!r}, it is {value!r}")
