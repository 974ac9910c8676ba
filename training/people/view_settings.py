# SPDX-License-Identifier: Apache-2.0
"""Settings of the simulated training views: poses, cameras, occlusion, detectors."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from paul_ros.errors import LayoutError
from training.errors import ViewsError
from training.people.human_points import human_mapping

COMPLETE = "complete"
"""Name, in place of a layout, of a detector that reports all points of ``human``."""

_RANGES = ("forearm", "distance", "height", "elevation", "field", "level", "hidden")
_SHARES = ("aloft", "tilted", "obstacle", "guessed", "min_confidence")


@dataclass(frozen=True)
class ViewSettings:
    """Settings of the views; angles in degrees, lengths in metres.  Pairs are the ends of uniform distributions.

    A detector of level 1 has measured errors (``detector.py``); one of level 0 gives true projections.
    """

    # Poses and persons
    motion: float = 10.0  # a frame is used if a limb has turned by this much since the last used frame
    views: int = 6  # views per frame, each of another person, by another camera and another detector
    stature: float = 0.06  # standard deviation of the logarithm of a factor on the whole body
    proportions: float = 0.04  # the same for each of thighs, shanks, feet, hips, trunk, neck, shoulders and upper arms
    forearm: tuple[float, float] = (1.0, 1.5)  # factor; the capture's radius ends above the wrist (human_points.py)
    # Camera positions
    distance: tuple[float, float] = (1.5, 10.0)  # to the middle of the body; uniform in its logarithm
    height: tuple[float, float] = (0.3, 1.8)  # of cameras on floor robots, above the lowest point of the body
    aloft: float = 0.25  # share of cameras on drones, masts and ceilings ...
    elevation: tuple[float, float] = (10.0, 60.0)  # ... and the angles at which these look down
    # Cameras
    field: tuple[float, float] = (50.0, 110.0)  # horizontal field of view
    off_axis: float = 0.4  # standard deviation of the body's place in the image, in half widths and half heights
    roll: float = 2.0  # standard deviation of the roll of most cameras
    tilted: float = 0.1  # share of tilted cameras ...
    tilt: float = 15.0  # ... and the standard deviation of their roll
    border: bool = True  # whether points outside of the image are hidden
    # Missing points
    hidden: tuple[float, float] = (0.0, 0.4)  # share of a view's points that the detector misses for no visible reason
    obstacle: float = 0.15  # share of views in which an object in front covers the body beyond a line
    occlusion: bool = True  # whether the body hides its own points
    guessed: float = 0.7  # share of the occluded points that the detector reports nevertheless, with larger errors
    # Detectors
    level: tuple[float, float] = (0.0, 1.0)  # of the errors, drawn for every view
    min_confidence: float = 0.3  # points of lower confidence are hidden, as in the node
    layouts: tuple[tuple[str, float], ...] = (  # layouts of the detectors, and their shares of the views
        ("coco17", 0.3),
        ("body25", 0.15),
        ("openpose18", 0.1),  # and hri18, of the same points
        ("h36m17", 0.15),
        ("mediapipe33", 0.15),
        (COMPLETE, 0.15),
    )
    seed: int = 0  # of all random numbers of the views

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
        """Raise ViewsError, with the valid range, unless the condition holds."""
        if not holds:
            raise ViewsError(f"view setting {name} must be {what}, it is {getattr(self, name)!r}")

    @classmethod
    def from_dict(cls, settings: object) -> ViewSettings:
        """Build from plain lists and numbers, as in YAML.

        Raises:
            ViewsError: a setting is unknown or out of its range.
        """
        if not isinstance(settings, dict):
            raise ViewsError("views must be a mapping of settings (key: value)")
        defaults = {field.name: field.default for field in dataclasses.fields(cls)}
        if unknown := [str(key) for key in settings if key not in defaults]:
            raise ViewsError(f"unknown view setting {', '.join(unknown)}; known are {', '.join(defaults)}")
        converted: dict[str, Any] = {key: _converted(key, value, defaults[key]) for key, value in settings.items()}
        return cls(**converted)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers, for YAML and JSON; the inverse of ``from_dict``."""
        plain = {key: list(value) if isinstance(value, tuple) else value for key, value in vars(self).items()}
        return {**plain, "layouts": [list(pair) for pair in self.layouts]}


def _converted(key: str, value: object, default: object) -> object:
    """Return the value in the default's type; lists become tuples."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        return tuple(tuple(item) if isinstance(item, list) else item for item in value)
    if isinstance(default, bool) and isinstance(value, bool):
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        if type(default) is float:
            return float(value)
        if type(default) is int and value == int(value):
            return int(value)
    raise ViewsError(f"view setting {key} must be like {default!r}, it is {value!r}")
