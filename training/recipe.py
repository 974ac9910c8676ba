# SPDX-License-Identifier: Apache-2.0
"""The recipe: every setting of a training run, in one YAML file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from paul_ros.layout import Layout
from paul_ros.viewing_goal import Scale
from paul_ros.wording import did_you_mean
from training.errors import RecipeError

CHOICES = {
    "codes": ("encoder", "free"),
    "encoder": ("residual", "convolutional"),
    "scale": ("free", "unit"),
    "solver": ("exact", "algebraic"),
    "streams": ("both", "decoder"),
    "start": ("random", "rigid", "linear"),
}
"""Settings with a fixed set of values."""

_POSITIVE = ("bottleneck", "width", "blocks", "learning_rate", "code_learning_rate", "restarts", "generations")
_NOT_NEGATIVE = (
    *("steps", "regression_steps", "hold", "batch", "seed", "roll"),
    *("code_weight", "decay_weight", "nuclear_weight", "handedness_weight", "bone_weight"),
)
_LARGEST = {"seed": 2**32 - 1, "batch": 2**20, "restarts": 10_000}
"""Largest values of settings that random generators, memory or time would otherwise limit in the middle of a run."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a run. Where a default differs from the paper's value, the list below gives the latter.

    Weights multiply the terms of ``objective.py``. Weights of terms beyond the paper are per square root of the number
    of points, because the Frobenius norms of the streams grow with it.

    Attributes:
        bottleneck: K, the size of a code. Paper: 4 for small or rigid objects, 8 for articulated ones.
        hidden: layer sizes of f_d from the code upwards; f_e is its reverse.
        codes: ``encoder``: phi = h(W, M), which lifts unseen frames. ``free``: one code per frame, the paper's NRSfM.
        encoder: ``residual``, or ``convolutional`` as in Deep NRSfM; see ``networks.py``.
        scale: ``free``: each frame has its own. ``unit``: orthographic views of one scale, as in NRSfM benchmarks.
        width: of the 2D encoder's residual blocks.
        blocks: number of these blocks.
        streams: ``both``: f_d(phi) and f_d f_e f_d(phi). ``decoder``: the former alone, the paper's baseline ADL.
        solver: of the cameras. ``exact``: global optimum. ``algebraic``: the paper's least squares and projection.
        start: ``random`` weights, as in the paper; or ``rigid`` or ``linear``, shapes that the networks learn first.
        regression_steps: steps in which the networks learn the start's shapes.
        steps: steps of the objective. With 0 the start's shapes are the result.
        hold: steps for which solutions of the lower level of all frames are held (beyond the paper). The networks
            learn them as the cameras of other frames see them, and their detectors if the data has detections. With 0
            the lower level is solved for each batch, as in the paper.
        generations: of networks. Later ones start from what the last one made of the frames, without the tenth that it
            explained worst: most frames that show the wrong mirror image are in that tenth.
        batch: frames per step; 0 takes all.
        learning_rate: of Adam, warmed up over 200 steps, then a cosine to zero, in each phase.
        code_learning_rate: of free codes; each belongs to one frame.
        seed: of all random numbers.
        restarts: runs, with seeds from ``seed`` up. The one of the lowest final loss is kept.
        code_weight: of |phi|^2. Paper: 0.01.
        decay_weight: of |theta_d|^2. Paper: 1e-4.
        nuclear_weight: of the nuclear norm of a batch's N shapes, over N. Paper, ADL + low rank: 0.01.
        handedness_weight: keeps frames from settling on mirrored shapes (beyond the paper).
        bone_weight: keeps the layout's edges at their lengths (beyond the paper).
        upright: h sees every view turned and mirrored to one side, for cameras that roll freely; ``roll`` and
            ``mirror_view`` are then not needed. Cameras, depths and rays are those of the original view, so that
            perspective may be fitted. h loses gravity and the side that perspective shows to be near.
        roll: radians, largest in-plane turn of W: an exact augmentation under an orthographic camera.
        mirror_view: mirror W in x: the same shape seen from behind, exact too.
        perspective: fit calibrated data by a pinhole camera (beyond the paper).
        mirror_object: exchange left and right; only for symmetric objects.
        known_lengths: (point, point, metres), which set the metres per model unit.
        stature: metres, height of the people with these lengths; 0 for other objects.
        views: settings of the synthetic views, for a folder of motion capture (``people/view_settings.py``).
    """

    bottleneck: int = 8
    hidden: tuple[int, ...] = (16, 32, 64, 128, 256)
    codes: str = "encoder"
    encoder: str = "residual"
    scale: Scale = "free"
    width: int = 256
    blocks: int = 2
    streams: str = "both"
    solver: str = "exact"
    start: str = "random"
    regression_steps: int = 0
    steps: int = 20_000
    hold: int = 0
    generations: int = 1
    batch: int = 256
    learning_rate: float = 1e-3
    code_learning_rate: float = 1e-2
    seed: int = 0
    restarts: int = 1
    code_weight: float = 4.1231e-3
    decay_weight: float = 0.0
    nuclear_weight: float = 0.0
    handedness_weight: float = 1.0
    bone_weight: float = 1.0
    upright: bool = False
    roll: float = 0.3
    mirror_view: bool = True
    perspective: bool = True
    mirror_object: bool = False
    known_lengths: tuple[tuple[str, str, float], ...] = ()
    stature: float = 0.0
    views: dict[str, Any] | None = None

    @classmethod
    def load(cls, name_or_path: str | Path, overrides: Sequence[str] = ()) -> Recipe:
        """Read a shipped recipe by name, or any YAML file, and apply overrides.

        A file may name a shipped recipe as its ``base``, whose settings it then changes.

        Args:
            name_or_path: of the recipe.
            overrides: ``key=value`` or ``views.key=value``, values in YAML.

        Raises:
            RecipeError: unknown file, key or value.
        """
        settings = _read(name_or_path)
        for override in overrides:
            key, equals, text = override.partition("=")
            if not equals:
                raise RecipeError(f"'{override}' is no override: write key=value")
            key, _, part = key.strip().partition(".")
            value = _parsed(text, f"the value in '{override}'")
            settings[key] = {**_mapping(settings.get(key), key), part: value} if part else value
        return cls.from_dict(settings)

    @classmethod
    def from_dict(cls, settings: dict[str, Any]) -> Recipe:
        """Check settings and build the recipe.

        Raises:
            RecipeError: unknown key or value.
        """
        fields = {field.name: field for field in dataclasses.fields(cls)}
        unknown = sorted(str(key) for key in settings if key not in fields)
        if unknown:
            near = did_you_mean(unknown[0], fields)
            raise RecipeError(f"unknown recipe setting {', '.join(unknown)}{near or ';'} known are {', '.join(fields)}")
        return cls(**{key: _converted(key, value, fields[key].default) for key, value in settings.items()})

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            self._need(name, getattr(self, name) in known, f"one of {', '.join(known)}")
        for name in _POSITIVE:
            self._need(name, getattr(self, name) > 0, "positive")
        for name in _NOT_NEGATIVE:
            self._need(name, getattr(self, name) >= 0, "at least 0")
        for name, largest in _LARGEST.items():
            self._need(name, getattr(self, name) <= largest, f"at most {largest}")
        self._need("stature", not self.stature or 1e-3 <= self.stature < 1e3, "0, or metres from 0.001 to 1000")
        self._need("hidden", self.hidden and all(type(size) is int and size > 0 for size in self.hidden), "layer sizes")
        self._check_together()

    def _check_together(self) -> None:
        """Refuse settings that are valid alone but not together."""
        if self.codes == "free" and self.mirror_object:
            raise RecipeError("mirror_object needs codes: encoder, for the mirrored object has another code")
        if self.hold and (self.codes == "free" or self.start == "random"):
            raise RecipeError(
                "hold needs codes: encoder, for a free code sees no other views, and a start other than random, for "
                "solutions of random networks teach nothing"
            )
        if self.generations > 1 and not self.hold:
            raise RecipeError("generations need held solutions: give the recipe hold, such as 1000 steps")
        if self.start == "random" and not self.steps:
            raise RecipeError("with start: random and steps: 0 nothing is trained: choose start: linear, or some steps")
        if self.start != "random" and self.steps and not self.regression_steps:
            raise RecipeError(f"start: {self.start} needs regression_steps, or the networks never learn it")

    def _need(self, name: str, holds: object, needed: str) -> None:
        if not holds:
            raise RecipeError(f"recipe setting {name} must be {needed}, it is {getattr(self, name)!r}")

    def check_points(self, layout: Layout) -> None:
        """Check that known lengths lie between two points of the layout.

        Raises:
            RecipeError: one does not.
        """
        for length in self.known_lengths:
            a, b, metres = length if isinstance(length, tuple) and len(length) == 3 else (None, None, None)
            between = a in layout.names and b in layout.names and a != b
            if not between or type(metres) not in (int, float) or not 1e-3 <= metres < 1e3:
                unknown = [f"'{name}'" for name in (a, b) if isinstance(name, str) and name not in layout.names]
                why = f"; the layout has no {' and no '.join(unknown)}" if unknown else ""
                raise RecipeError(
                    f"known_lengths must be [point, point, metres] with two points of layout '{layout.name}', "
                    f"one is {length!r}{why}"
                )

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers, for YAML and the model's header; absent views are left out."""
        plain = {key: _plain(value) for key, value in vars(self).items()}
        if self.views is None:
            del plain["views"]
        return plain


def recipe_names() -> list[str]:
    """Return the names of the shipped recipes."""
    folder = resources.files("training") / "recipes"
    return sorted(item.name[:-5] for item in folder.iterdir() if item.name.endswith(".yaml"))


def architecture(recipe: Recipe) -> dict[str, Any]:
    """Return the part of a model file's header that describes the networks."""
    return {
        "bottleneck": recipe.bottleneck,
        "architecture": {
            "encoder": {
                "kind": recipe.encoder,
                "width": recipe.width,
                "blocks": recipe.blocks,
                "upright": recipe.upright,
            },
            "decoder": {"kind": "mlp", "hidden": list(recipe.hidden)},
        },
    }


def _read(name_or_path: str | Path) -> dict[str, Any]:
    text = str(name_or_path)
    path = resources.files("training") / "recipes" / f"{text}.yaml" if text in recipe_names() else Path(text)
    if not path.is_file():
        hint = did_you_mean(text, recipe_names()) or "."
        raise RecipeError(f"no recipe '{text}'{hint} It is neither a file nor one of {', '.join(recipe_names())}")
    settings = _parsed(path.read_bytes(), f"recipe '{text}'") or {}
    if not isinstance(settings, dict):
        raise RecipeError(f"recipe '{text}' must be settings as key: value")
    base = settings.pop("base", None)
    if base is None:
        return settings
    if base == text or base not in recipe_names():
        raise RecipeError(f"the base of recipe '{text}' must be another one of {', '.join(recipe_names())}")
    return {**_read(base), **settings}


def _parsed(text: str | bytes, source: str) -> Any:
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise RecipeError(f"{source} is not YAML: {' '.join(str(error).split())[:200]}") from None


def _mapping(value: object, key: str) -> dict[str, Any]:
    if value is not None and not isinstance(value, dict):
        raise RecipeError(f"recipe setting {key} has no settings of its own")
    return value or {}


def _converted(key: str, value: Any, default: Any) -> Any:
    """Return the value in the default's type; lists become tuples."""
    if key == "views":
        if value is None or isinstance(value, dict):
            return value
        raise RecipeError(f"recipe setting views must be settings as key: value, it is {value!r}")
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        return tuple(tuple(item) if isinstance(item, list) else item for item in value)
    if isinstance(default, bool) and isinstance(value, bool):
        return value
    if isinstance(default, str) and isinstance(value, str):
        return value
    if type(default) in (int, float) and type(value) in (int, float, str):
        try:
            number = float(value)  # YAML 1.1 reads 1e-3 as text
        except (ValueError, OverflowError):
            number = math.nan
        if math.isfinite(number) and (type(default) is float or number.is_integer()):
            return type(default)(number)
    raise RecipeError(f"recipe setting {key} must be like {default!r}, it is {value!r}")


def _plain(value: Any) -> Any:
    """Return a setting's value with lists in place of tuples."""
    if isinstance(value, dict):
        return dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
