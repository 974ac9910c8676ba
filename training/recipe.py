# SPDX-License-Identifier: Apache-2.0
"""The recipe: every setting of a training run, in one YAML file."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import yaml

from paul_ros.layout import Layout
from training.errors import RecipeError, ViewsError
from training.people.view_settings import ViewSettings

#: Settings that are one of a few words.
CHOICES = {
    "codes": ("encoder", "free"),
    "encoder": ("residual", "convolutional"),
    "scale": ("free", "unit"),
    "solver": ("exact", "algebraic"),
    "streams": ("both", "decoder"),
    "start": ("random", "rigid", "linear"),
}
_POSITIVE = ("bottleneck", "width", "blocks", "learning_rate", "code_learning_rate", "restarts", "generations")
_NOT_NEGATIVE = (
    *("steps", "regression_steps", "hold", "batch", "patience", "roll", "stature"),
    *("code_weight", "decay_weight", "nuclear_weight", "handedness_weight", "bone_weight"),
)


@dataclass(frozen=True)
class Recipe:
    """Settings of a run. Where a default departs from the paper's, the comment says so.

    Weights multiply the terms of ``objective.py``; those of terms beyond the paper are per square root of the number
    of points, as the Frobenius norms of the streams grow with it.
    """

    bottleneck: int = 8  # K; the paper: 4 for small or rigid objects, 8 for articulated ones
    hidden: tuple[int, ...] = (16, 32, 64, 128, 256)  # f_d from the code upwards; f_e is its reverse
    codes: str = "encoder"  # phi = h(W, M), to lift what was never seen; free: one code a frame, the paper's NRSfM
    encoder: str = "residual"  # or convolutional, as Deep NRSfM's; see networks.py
    scale: str = "free"  # every frame has its own; unit: orthographic views of one fixed scale, as NRSfM's benchmarks
    width: int = 256  # of the 2D encoder's residual blocks
    blocks: int = 2
    streams: str = "both"  # f_d(phi) and f_d f_e f_d(phi); decoder: the first alone, the paper's baseline ADL
    solver: str = "exact"  # of the cameras: the global optimum; algebraic: the paper's least squares and projection
    start: str = "random"  # weights, as in the paper; rigid or linear: shapes that the networks first learn to give
    regression_steps: int = 0  # that they learn them for
    steps: int = 20_000  # of the objective; 0: the shapes of the start are the result
    hold: int = 0  # steps that the lower level's solutions of all frames are held for, while the networks learn them as
    # the cameras of other frames see them, and their detectors where the data has detections (beyond the paper); 0:
    # solved anew for every batch, as the paper does
    generations: int = 1  # of networks; each but the first starts from what the last one made of the frames, less the
    # tenth that it explained worst: most frames that show the wrong mirror image are among those
    batch: int = 256  # 0: all frames at every step
    learning_rate: float = 1e-3  # Adam, warmed up over 200 steps, then a cosine to zero, in either phase
    code_learning_rate: float = 1e-2  # of free codes, which each frame has to itself
    patience: int = 0  # stop when so many steps lowered the mean loss by less than 0.1 %; 0: go through, which ends
    # better: a run that is stopped never comes to the low rates of its schedule's end
    seed: int = 0
    restarts: int = 1  # runs from this seed on; the one with the lowest final loss is kept
    code_weight: float = 4.1231e-3  # the paper: 0.01
    decay_weight: float = 0.0  # of |theta_d|^2; the paper: 1e-4
    nuclear_weight: float = 0.0  # of the nuclear norm of a batch's N shapes, over N; the paper's ADL + low rank: 0.01
    handedness_weight: float = 1.0  # beyond the paper: keeps frames from settling on mirrored shapes
    bone_weight: float = 1.0  # beyond the paper: edges of the layout keep their lengths
    upright: bool = False  # h sees every view turned and mirrored to one side: for cameras that roll freely, where it
    # makes the next two needless. Only h does: cameras, depths and rays are those of the view as it is, so perspective
    # may be fitted; what h no longer sees are gravity, and which side perspective shows to be near
    roll: float = 0.3  # radians; in-plane turns of W, an exact augmentation under an orthographic camera
    mirror_view: bool = True  # x-mirrored W is the same shape seen from behind: exact too
    fade: tuple[float, float] = (1.0, 1.0)  # shares of the run between which roll and mirror_view fade out: where
    # cameras stand upright, gravity tells a stoop from a view from above, and turned images blur that
    perspective: bool = True  # beyond the paper: calibrated data is fitted by a pinhole camera
    mirror_object: bool = False  # left and right exchanged: only for objects that are symmetric
    hide: float = 0.0  # up to this share of a frame's points is hidden anew at every step
    known_lengths: tuple[tuple[str, str, float], ...] = ()  # (point, point, metres): sets the metres per model unit
    stature: float = 0.0  # metres, of the people who have these lengths; 0: no people
    views: ViewSettings | None = (
        None  # how people are seen, where the data is a folder of motion capture (view_settings.py)
    )

    @classmethod
    def load(cls, name_or_path: str | Path, overrides: list[str] = ()) -> Recipe:
        """Read a shipped recipe by name or any YAML file, then apply ``key=value`` or ``views.key=value`` overrides.

        A file may name a shipped recipe as its ``base``, whose settings it then changes.

        Raises:
            RecipeError: unknown file, key or value.
        """
        settings = _read(name_or_path)
        for override in overrides:
            key, equals, value = override.partition("=")
            if not equals:
                raise RecipeError(f"'{override}' is no override: write key=value")
            key, _, part = key.strip().partition(".")
            value = _parsed(value, f"the value in '{override}'")
            settings[key] = {**_mapping(settings.get(key), key), part: value} if part else value
        return cls.from_dict(settings)

    @classmethod
    def from_dict(cls, settings: dict) -> Recipe:
        """Check and build; raises RecipeError."""
        fields = {field.name: field for field in dataclasses.fields(cls)}
        unknown = sorted(str(key) for key in settings if key not in fields)
        if unknown:
            raise RecipeError(f"unknown recipe setting {', '.join(unknown)}; known are {', '.join(fields)}")
        return cls(**{key: _converted(key, value, fields[key].default) for key, value in settings.items()})

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            self._need(name, getattr(self, name) in known, f"one of {', '.join(known)}")
        for name in _POSITIVE:
            self._need(name, getattr(self, name) > 0, "positive")
        for name in _NOT_NEGATIVE:
            self._need(name, getattr(self, name) >= 0, "at least 0")
        self._need("hidden", self.hidden and all(type(size) is int and size > 0 for size in self.hidden), "layer sizes")
        shares = [share for share in self.fade if type(share) in (int, float)]
        self._need("fade", len(shares) == len(self.fade) == 2 and 0 <= shares[0] <= shares[1], "two growing shares")
        self._need("hide", 0 <= self.hide < 1, "in [0, 1)")
        self._check_together()

    def _check_together(self) -> None:
        """Refuse settings that are sound alone and not together."""
        if self.codes == "free" and self.mirror_object:
            raise RecipeError("mirror_object needs codes: encoder, for the mirrored object has another code")
        if self.hold and (self.codes == "free" or self.start == "random"):
            raise RecipeError(
                "hold needs codes: encoder, for a free code sees no other views, and a start other than random, for "
                "what random networks make of the frames teaches nothing"
            )
        if self.generations > 1 and not self.hold:
            raise RecipeError("generations hand on solutions that are held: give the recipe hold, as 1000 steps")
        if self.start == "random" and not self.steps:
            raise RecipeError("with start: random and steps: 0 nothing is trained: choose start: linear, or some steps")
        if self.start != "random" and self.steps and not self.regression_steps:
            raise RecipeError(f"start: {self.start} needs regression_steps, or the networks never learn of it")

    def _need(self, name: str, holds: object, what: str) -> None:
        if not holds:
            raise RecipeError(f"recipe setting {name} must be {what}, it is {getattr(self, name)!r}")

    def check_points(self, layout: Layout) -> None:
        """Refuse known lengths that are none between two points of the layout; raises RecipeError."""
        for length in self.known_lengths:
            a, b, metres = length if isinstance(length, tuple) and len(length) == 3 else (None, None, None)
            between = a in layout.names and b in layout.names and a != b
            if not between or type(metres) not in (int, float) or not 1e-3 <= metres < 1e3:
                raise RecipeError(
                    f"known_lengths must be [point, point, metres] with two points of layout '{layout.name}', "
                    f"one is {length!r}"
                )

    def to_dict(self) -> dict:
        """Plain lists and numbers, for YAML and the model's header; without views where there are none."""
        plain = {
            key: [list(item) if isinstance(item, tuple) else item for item in value]
            if isinstance(value, tuple)
            else value
            for key, value in vars(self).items()
            if key != "views"
        }
        return {**plain, "views": self.views.to_dict()} if self.views else plain


def recipe_names() -> list[str]:
    """Names of the shipped recipes."""
    folder = resources.files("training") / "recipes"
    return sorted(item.name[:-5] for item in folder.iterdir() if item.name.endswith(".yaml"))


def _read(name_or_path: str | Path) -> dict:
    text = str(name_or_path)
    path = resources.files("training") / "recipes" / f"{text}.yaml" if text in recipe_names() else Path(text)
    if not path.is_file():
        raise RecipeError(f"no recipe '{text}': neither a file nor one of {', '.join(recipe_names())}")
    settings = _parsed(path.read_bytes(), f"recipe '{text}'") or {}
    if not isinstance(settings, dict):
        raise RecipeError(f"recipe '{text}' must be settings as key: value")
    base = settings.pop("base", None)
    if base is None:
        return settings
    if base == text or base not in recipe_names():
        raise RecipeError(f"the base of recipe '{text}' must be another one of {', '.join(recipe_names())}")
    return {**_read(base), **settings}


def _parsed(text: str | bytes, what: str) -> object:
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise RecipeError(f"{what} is no YAML: {' '.join(str(error).split())[:200]}") from None


def _mapping(value: object, key: str) -> dict:
    if value is not None and not isinstance(value, dict):
        raise RecipeError(f"recipe setting {key} has no settings of its own")
    return value or {}


def _converted(key: str, value: object, default: object) -> object:
    """The value in the default's type; lists become tuples."""
    if key == "views":
        try:
            return value if value is None or isinstance(value, ViewSettings) else ViewSettings.from_dict(value)
        except ViewsError as error:
            raise RecipeError(str(error)) from None
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        return tuple(tuple(item) if isinstance(item, list) else item for item in value)
    if isinstance(default, bool) and isinstance(value, bool):
        return value
    if isinstance(default, str) and isinstance(value, str):
        return value
    if type(default) in (int, float) and type(value) in (int, float, str):
        try:
            number = float(value)  # YAML 1.1 reads 1e-3 as text
        except ValueError:
            number = math.nan
        if math.isfinite(number) and (type(default) is float or number.is_integer()):
            return type(default)(number)
    raise RecipeError(f"recipe setting {key} must be like {default!r}, it is {value!r}")
