# SPDX-License-Identifier: Apache-2.0
"""`paul view`: a bag lifted, or a model's shapes, as a short film to look at. Matplotlib and Pillow draw it.

Left is left in its colour, what the camera did not see is dimmed, what it could not tell apart from its mirror image
is marked. Of a long bag only so many frames are lifted and drawn; what was left out is said.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters import ONE_PERSON
from paul_ros.body_axes import body_rotations, left_and_up
from paul_ros.errors import BagError, PictureError
from paul_ros.files import write_atomically
from paul_ros.layout import Layout
from paul_ros.lifted import AMBIGUOUS
from paul_ros.model import Model
from paul_ros.offline.bag import BagWriter, Record, matches, read_records
from paul_ros.offline.replay import LiftedFrame, Replay, Topics, replay
from paul_ros.offline.report import SIDE_COLOUR
from paul_ros.stream.stream import LiftStream

PICTURES_PER_SECOND = 10
MOST_PICTURES = 200
"""Of a film; a longer bag is shown in larger steps."""
SUFFIXES = (".gif", ".mp4", ".png")

Progress = Callable[[Iterable[np.ndarray], int], Iterable[np.ndarray]]
"""Goes round the pictures, of which there are so many."""

_TOGETHER = 30_000_000  # ns within which persons of one image come, where each is a message of its own
_SIZE, _DPI = (9.0, 5.0), 100
_ROWS = 4  # pictures of a .png
_TURN = np.radians(3.0)  # a picture
_PITCH = np.radians(12.0)  # the viewer looks down by
_SMOOTH = 15  # pictures over which the turntable follows the persons
_GRID = 4  # lines to either side
_AMBER, _CALM, _INK, _PALE = "#f5a800", "#e9eef2", "#333333", "#d5d8db"
_DIM = 0.25
_SAMPLES, _NOISE, _SEED = 2000, 0.3, 0  # views that the codes' modes are found from; of the points' rms
_MODES, _SWING = 3, 2.0  # standard deviations
_MODEL_PICTURES = 120


@dataclass(frozen=True)
class Film:
    """What was drawn. said: one line for the user, of what is shown and what was left out."""

    path: Path
    pictures: int
    said: str


# --- a bag


def view_bag(
    bag: Path,
    stream: LiftStream,
    out: Path,
    topics: Topics = Topics(),
    start: float = 0.0,
    seconds: float | None = None,
    progress: Progress = lambda pictures, total: pictures,
) -> tuple[Film, BagError | None]:
    """Lift frames of a bag by the code of replay and draw them; also what is wrong with the bag, if it is damaged.

    start, seconds: of the bag, from its first keypoints on; None = to the end. Raises BagError, PictureError.
    """
    check_format(out)
    choice = _choose(bag, topics, start, seconds)
    if choice is None:
        replay(bag, stream, topics=topics)
        raise BagError(f"{bag}: no keypoints from {start:g} s on for so long; `paul inspect` tells how long it is")
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / "part.mcap"
        _copy(bag, part, topics, choice)
        done = replay(part, stream, topics=topics)
    if not any(frame.lifted.ok.any() for frame in done.frames):
        raise PictureError(f"{bag}: nobody was lifted, so there is nothing to draw; `paul replay` tells why")
    stage = _Stage.of(done, bag.stem, choice.first)
    shown = _fullest(done) if out.suffix == ".png" else range(len(done.frames))
    write_film(out, progress((stage.draw(index) for index in shown), len(shown)))
    return Film(out, len(shown), choice.said(len(shown))), choice.damage


@dataclass(frozen=True)
class _Choice:
    """What is drawn of a bag.

    times: log times (ns) of the keypoint messages that are, of so many. first, last, length: seconds from the bag's
    first keypoints to the first that are drawn, the last, and the bag's last. speed: of the film, 1 = as in life.
    """

    times: frozenset[int]
    messages: int
    first: float
    last: float
    length: float
    speed: float
    damage: BagError | None

    def said(self, pictures: int) -> str:
        """In one line, what is shown and what was left out."""
        speed = "as fast as in life" if self.speed < 1.01 else f"{self.speed:.1f} times as fast as in life"
        return (
            f"{pictures} pictures of {self.messages} messages, {self.first:.1f} to {self.last:.1f} s "
            f"of {self.length:.1f} s, {speed}"
        )


def _choose(bag: Path, topics: Topics, start: float, seconds: float | None) -> _Choice | None:
    """So many messages, evenly over the time that is asked for, that a film shows; nothing is decoded.

    None where there are no keypoints then. Raises BagError where not one message can be read.
    """
    found, one_person, damage = [], False, None
    try:
        for record in read_records(bag, topics.all):
            if matches(record.topic, topics.keypoints):
                found.append(record.log_time)
                one_person = one_person or record.type_name in ONE_PERSON
    except BagError as error:
        if not found:
            raise
        damage = error
    times = np.array(found, int)
    since = (times - times[:1]) / 1e9
    wanted = np.flatnonzero((since >= start) & (since <= start + (np.inf if seconds is None else seconds)))
    if not len(wanted):
        return None
    first, last = since[wanted[0]], since[wanted[-1]]
    step = max(1 / PICTURES_PER_SECOND, (last - first) / (MOST_PICTURES - 1))
    # Rounded, so that a camera's jitter makes no step a frame longer.
    slots = np.round((since[wanted] - first) / step, 2).astype(int)
    chosen = times[wanted[np.unique(slots, return_index=True)[1]]]
    if one_person:
        chosen = _with_company(times, chosen)
    speed = step * PICTURES_PER_SECOND
    return _Choice(frozenset(chosen.tolist()), len(times), first, last, since[-1], speed, damage)


def _with_company(times: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The chosen messages and those that came together with them: other persons of the same images."""
    before = chosen[np.maximum(np.searchsorted(chosen, times, side="right") - 1, 0)]
    return times[(times >= before) & (times < before + _TOGETHER)]


def _copy(bag: Path, part: Path, topics: Topics, choice: _Choice) -> None:
    """The chosen messages, and what came on the other topics between them last, as a bag of its own."""
    waiting: dict[str, Record] = {}
    with BagWriter(part) as writer:
        try:
            for record in read_records(bag, topics.all):
                if not matches(record.topic, topics.keypoints):
                    waiting[record.topic] = record
                elif record.log_time in choice.times:
                    for other in waiting.values():
                        writer.write_record(other)
                    waiting = {}
                    writer.write_record(record)
        except BagError:
            if not choice.damage:
                raise


@dataclass(frozen=True)
class _Stage:
    """All that stays from picture to picture.

    centres: (F,3) what the turntable turns about. radii: (F,) that it shows. floor: y of the ground, the lowest point.
    room: x and z from and to, (2,2), as seen from above; None in model units, which have no place. image: pixels from
    and to, (2,2). first: seconds of the bag at the first picture.
    """

    done: Replay
    name: str
    first: float
    centres: np.ndarray
    radii: np.ndarray
    floor: float
    room: np.ndarray | None
    image: np.ndarray
    paint: Paint

    @classmethod
    def of(cls, done: Replay, name: str, first: float) -> _Stage:
        """The stage that all frames of a replay fit on."""
        bodies = [frame.lifted.points[frame.lifted.ok] for frame in done.frames]
        centres = _followed([points.mean((0, 1)) if len(points) else None for points in bodies])
        around = [points - centre for points, centre in zip(bodies, centres)]
        reach = [np.linalg.norm(points, axis=2).max() * np.ones(1) if len(points) else None for points in around]
        everywhere = np.concatenate([points.reshape(-1, 3) for points in bodies])
        metric = done.stream.units == "m"
        return cls(
            done,
            name,
            first,
            centres,
            1.05 * _followed(reach)[:, 0],
            float(np.percentile(everywhere[:, 1] if metric else np.concatenate(around)[..., 1], 98)),
            _room(everywhere) if metric else None,
            _image(done),
            Paint(_SIZE),
        )

    def draw(self, index: int) -> np.ndarray:
        """One picture (height, width, 3) uint8."""
        frame, paint = self.done.frames[index], self.paint
        paint.clear()
        self._draw_title(frame)
        tall = self.room is None
        self._draw_image(paint.panel((0.02, 0.1 if tall else 0.5, 0.42, 0.75 if tall else 0.37)), frame)
        if self.room is not None:
            self._draw_above(paint.panel((0.02, 0.06, 0.42, 0.37)), frame)
        self._draw_turntable(paint.panel((0.46, 0.06, 0.52, 0.81)), frame, index)
        return paint.pixels()

    def _draw_title(self, frame: LiftedFrame) -> None:
        ok = frame.lifted.ok
        doubtful = ok & (frame.lifted.ambiguity >= AMBIGUOUS)
        seconds = self.first + (frame.stamp - self.done.frames[0].stamp) / 1e9
        persons = f"{len(ok)} person{'' if len(ok) == 1 else 's'}"
        persons += f", {int((~ok).sum())} not lifted" if not ok.all() else ""
        model = self.done.stream.lifter.model.name
        self.paint.title(
            f"{self.name}   {seconds:5.1f} s   {persons}",
            "ambiguous: the mirror image fits nearly as well" if doubtful.any() else f"lifted by {model}",
            _AMBER if doubtful.any() else _CALM,
        )

    def _draw_image(self, ax: Any, frame: LiftedFrame) -> None:
        ax.set_title("2D input, pixels; grey: the lifted points seen by the camera", **_CAPTION)
        seen = frame.keypoints.visible
        again = _seen_by(frame)
        for person in range(len(seen)):
            if again is not None and frame.lifted.ok[person]:
                self.paint.bones(ax, again[person], self.done.layout, np.ones_like(seen[person]), plain="#bbbbbb")
            self.paint.bones(ax, _where(seen[person], frame.keypoints.xy[person]), self.done.layout, seen[person])
        _frame(ax, self.image)

    def _draw_above(self, ax: Any, frame: LiftedFrame) -> None:
        ax.set_title("seen from above, metres; camera at the bottom", **_CAPTION)
        (left, near), (right, far) = self.room
        for metres in range(int(np.floor(near)), int(np.ceil(far)) + 1):
            ax.axhline(metres, color="#e6e6e6", linewidth=0.8, zorder=0)
            if near < metres < far - 0.3:
                ax.text(left, metres, f" {metres}", fontsize=7, color="#999999", va="bottom")
        for metres in range(int(np.floor(left)), int(np.ceil(right)) + 1):
            ax.axvline(metres, color="#e6e6e6", linewidth=0.8, zorder=0)
        ax.scatter([0], [0], marker="^", s=70, color=_INK, zorder=2)
        for person in np.flatnonzero(frame.lifted.ok):
            points = frame.lifted.points[person]
            doubtful = frame.lifted.ambiguity[person] >= AMBIGUOUS
            self.paint.bones(
                ax, points[:, [0, 2]], self.done.layout, frame.keypoints.visible[person], points[:, 1], doubtful, 0.7
            )
        _frame(ax, np.array([[left, far], [right, near]]))

    def _draw_turntable(self, ax: Any, frame: LiftedFrame, index: int) -> None:
        units = "metres" if self.room is not None else "model units"
        turn = turntable(_TURN * index)
        centre, radius = self.centres[index], self.radii[index]
        spacing = _spacing(radius)
        floor = np.array([0.0, self.floor - (centre[1] if self.room is not None else 0.0), 0.0])
        _draw_floor(ax, turn, floor, spacing)
        ax.set_title(f"turntable, {units}; a square is {spacing:g}", **_CAPTION)
        for person in np.flatnonzero(frame.lifted.ok):
            points = (frame.lifted.points[person] - centre) @ turn.T
            doubtful = frame.lifted.ambiguity[person] >= AMBIGUOUS
            self.paint.bones(
                ax, points[:, :2], self.done.layout, frame.keypoints.visible[person], points[:, 2], doubtful, 1.3
            )
        self.paint.legend(ax, frame.keypoints.visible.all())
        _frame(ax, radius * np.array([[-1.0, -1.0], [1.0, 1.0]]))


def _fullest(done: Replay) -> list[int]:
    """A few frames, evenly over time, of those that show most persons at once."""
    lifted = np.array([frame.lifted.ok.sum() for frame in done.frames])
    full = np.flatnonzero(lifted == lifted.max())
    return full[np.unique(np.linspace(0, len(full) - 1, _ROWS + 2).round().astype(int)[1:-1])].tolist()


def _followed(values: list[np.ndarray | None]) -> np.ndarray:
    """(F,D) values frame by frame as a camera on a tripod would follow them: smooth, and never nowhere."""
    there = [index for index, value in enumerate(values) if value is not None]
    known = np.array([values[index] for index in there])
    frames = np.arange(len(values))
    filled = np.stack([np.interp(frames, there, column) for column in known.T], axis=1)
    half = _SMOOTH // 2
    padded = np.concatenate([filled[:1].repeat(half, 0), filled, filled[-1:].repeat(half, 0)])
    return np.stack([padded[index : index + _SMOOTH].mean(0) for index in frames])


def _room(points: np.ndarray) -> np.ndarray:
    """(2,2) x and z from and to, the camera included, 1 % of the points at either end left aside."""
    low, high = np.percentile(points[:, [0, 2]], (1, 99), axis=0)
    low, high = np.minimum(low, 0.0) - 0.5, np.maximum(high, 0.0) + 0.5
    return np.array([low, high])


def _image(done: Replay) -> np.ndarray:
    """(2,2) pixels from and to: all that was seen, and a margin."""
    seen = np.concatenate([frame.keypoints.xy[frame.keypoints.visible] for frame in done.frames])
    low, high = np.percentile(seen, (0.2, 99.8), axis=0)
    return np.array([low, high]) + 0.08 * np.linalg.norm(high - low) * np.array([[-1.0], [1.0]])


def _seen_by(frame: LiftedFrame) -> np.ndarray | None:
    """(N,P,2) pixels of the lifted points; None without a place in metres."""
    camera = frame.camera
    if camera is None or frame.lifted.units != "m":
        return None
    x, y, z = np.moveaxis(frame.lifted.points, 2, 0)
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=2)


def _spacing(radius: float) -> float:
    """Of grid lines: 1, 2 or 5 times a power of ten, so that some four lie within the radius."""
    power = 10 ** np.floor(np.log10(radius / _GRID))
    return float(power * next(factor for factor in (1, 2, 5, 10) if factor * power >= radius / _GRID))


# --- a model


def view_model(model: Model, out: Path, progress: Progress = lambda pictures, total: pictures) -> Film:
    """Draw the mean shape turning, and shapes of codes that swing along their first modes. Raises PictureError.

    The modes are the principal components of the codes that the encoder gives for noisy random views of the mean shape:
    the model file does not hold the codes of its training.
    """
    check_format(out)
    mean, modes, shares = code_modes(model)
    view = _towards(model)
    radius = 1.15 * float(np.linalg.norm(model.mean_shape, axis=0).max())
    paint = Paint(_SIZE)

    def draw(index: int) -> np.ndarray:
        swing = _SWING * np.sin(2 * np.pi * index / _MODEL_PICTURES * 2)
        paint.clear()
        unit = model.metres_per_unit
        size = f"1 unit = {unit:.3f} m" if unit else "no metres known"
        paint.title(f"{model.name}   layout {model.layout.name}", f"{len(mean)} codes, {size}", _CALM)
        turning = turntable(2 * np.pi * index / _MODEL_PICTURES) @ view
        swaying = turntable(np.radians(35) * np.sin(2 * np.pi * index / _MODEL_PICTURES)) @ view
        columns = len(modes) + 1
        for column, shape in enumerate(
            [model.mean_shape, *(model.decode(code[None])[0] for code in mean + swing * modes)]
        ):
            ax = paint.panel((0.01 + 0.98 * column / columns, 0.03, 0.98 / columns, 0.83))
            turn = turning if column == 0 else swaying
            points = (turn @ shape).T
            seen = np.ones(len(points), bool)
            paint.bones(ax, points[:, :2], model.layout, seen, points[:, 2], width=1.1)
            caption = "mean shape" if column == 0 else f"mode {column}: {100 * shares[column - 1]:.0f} % of the codes"
            ax.set_title(caption, **_CAPTION)
            _frame(ax, radius * np.array([[-0.62, -1.0], [0.62, 1.0]]))
            if column == 0:
                paint.legend(ax, True)
        return paint.pixels()

    # Of a .png: a quarter of a swing and of a turn apart, off the middle, where all modes are the mean.
    shown = range(_MODEL_PICTURES // 8, _MODEL_PICTURES, _MODEL_PICTURES // _ROWS)
    shown = shown if out.suffix == ".png" else range(_MODEL_PICTURES)
    write_film(out, progress((draw(index) for index in shown), len(shown)))
    said = f"the mean shape and {len(modes)} modes of its {len(mean)} codes, to {_SWING:g} standard deviations"
    return Film(out, len(shown), said)


def code_modes(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean code (K,), first modes (M,K), each a standard deviation long, and their shares (M,) of the variance."""
    rng = np.random.default_rng(_SEED)
    Q, _ = np.linalg.qr(rng.standard_normal((_SAMPLES, 3, 3)))
    shape = model.mean_shape.astype(float)
    W = (Q @ shape)[:, :2]
    W = W + _NOISE * shape.std() * rng.standard_normal(W.shape)
    # A model of one fixed scale takes image points in the unit of its training data.
    W = W * model.header.get("image_unit", 1.0)
    codes = model.encode(W, np.ones((_SAMPLES, shape.shape[1]), bool)).astype(float)
    mean = codes.mean(0)
    _, sizes, axes = np.linalg.svd((codes - mean) / np.sqrt(_SAMPLES), full_matrices=False)
    count = min(_MODES, int((sizes > 1e-6 * max(sizes[0], 1e-12)).sum()))
    variance = sizes**2
    shares = variance[:count] / max(variance.sum(), 1e-300)
    return mean, sizes[:count, None] * axes[:count], shares


def _towards(model: Model) -> np.ndarray:
    """(3,3) canonical frame to a view from the front, y down: of a body, else the canonical frame itself."""
    measures = left_and_up(model.layout)
    if measures is None:
        return np.eye(3)
    forward, left, up = body_rotations(model.mean_shape.T[None].astype(float), np.eye(3)[None], measures)[0].T
    return np.stack([left, -up, -forward])


# --- drawing


def turntable(angle: float) -> np.ndarray:
    """(3,3) from a camera's frame to that of a viewer who went round by the angle and looks down a little."""
    c, s = np.cos(angle), np.sin(angle)
    around = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(_PITCH), np.sin(_PITCH)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ around


_CAPTION: dict[str, Any] = dict(fontsize=8.5, color="#555555", loc="left", pad=3)


def _where(seen: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.where(seen[:, None], points, np.nan)


def _frame(ax: Any, box: np.ndarray) -> None:
    """Show a box [[left, top], [right, bottom]] of the plane whole, as large as it fits, y down."""
    (left, top), (right, bottom) = box
    place = ax.get_position()
    wide, tall = place.size * ax.figure.get_size_inches()
    half = max(abs(right - left) / wide, abs(bottom - top) / tall) / 2 * np.array([wide, tall])
    half *= np.sign([right - left, bottom - top])
    middle = np.array([left + right, top + bottom]) / 2
    (left, top), (right, bottom) = middle - half, middle + half
    ax.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set_color(_PALE)


def _draw_floor(ax: Any, turn: np.ndarray, middle: np.ndarray, spacing: float) -> None:
    """A square grid, level with the camera, about a point."""
    ends = spacing * _GRID
    for at in spacing * np.arange(-_GRID, _GRID + 1):
        for line in ([[at, 0, -ends], [at, 0, ends]], [[-ends, 0, at], [ends, 0, at]]):
            ax.plot(*((np.array(line) + middle) @ turn.T)[:, :2].T, color="#e2e5e8", linewidth=0.8, zorder=0)


class Paint:
    """A figure that is drawn on again and again."""

    def __init__(self, size: tuple[float, float]) -> None:
        """Raises PictureError without matplotlib."""
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.collections import LineCollection
            from matplotlib.colors import to_rgba
            from matplotlib.figure import Figure
        except ImportError as error:
            raise PictureError("a film needs matplotlib: pip install 'paul_ros[bags]'") from error
        self._figure = Figure(figsize=size, dpi=_DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        self._lines, self._rgba = LineCollection, to_rgba

    def clear(self) -> None:
        self._figure.clear()

    def panel(self, place: tuple[float, float, float, float]) -> Any:
        """Axes at (left, bottom, width, height), shares of the figure."""
        return self._figure.add_axes(place)

    def title(self, left: str, right: str, colour: str) -> None:
        """A bar across the top."""
        bar = self._figure.add_axes((0, 0.93, 1, 0.07), facecolor=colour, xticks=[], yticks=[])
        for spine in bar.spines.values():
            spine.set_visible(False)
        bar.text(0.015, 0.45, left, va="center", fontsize=11, color=_INK, fontweight="bold")
        bar.text(0.985, 0.45, right, va="center", ha="right", fontsize=10, color=_INK)

    def bones(
        self,
        ax: Any,
        points: np.ndarray,
        layout: Layout,
        seen: np.ndarray,
        depth: np.ndarray | None = None,
        doubtful: bool = False,
        width: float = 1.0,
        plain: str | None = None,
    ) -> None:
        """One skeleton (P,2): what was not seen is dimmed, what is farther off is covered by what is nearer.

        doubtful: with a rim of amber. plain: all in one colour instead.
        """
        edges = np.array(layout.edges, int).reshape(-1, 2)
        if depth is not None:
            edges = edges[np.argsort(-depth[edges].mean(1))]
        segments = points[edges]
        rgba = [self._bone_colour(layout, seen, edge, plain) for edge in edges.tolist()]
        if doubtful:
            ax.add_collection(self._lines(segments, colors=_AMBER, linewidths=5.5 * width, capstyle="round", alpha=0.9))
        ax.add_collection(self._lines(segments, colors=rgba, linewidths=2.4 * width, capstyle="round"))
        if plain is None:
            dots = [self._rgba(SIDE_COLOUR[side], 1 if there else _DIM) for side, there in zip(layout.sides, seen)]
            ax.scatter(*points.T, s=14 * width**2, c=dots, linewidths=0, zorder=3)

    def _bone_colour(self, layout: Layout, seen: np.ndarray, edge: list[int], plain: str | None) -> tuple:
        one, other = edge
        side = layout.sides[one] if layout.sides[one] == layout.sides[other] else ""
        return self._rgba(plain or SIDE_COLOUR[side], 1.0 if seen[one] and seen[other] else _DIM)

    def legend(self, ax: Any, all_seen: bool) -> None:
        """Which colour is which side."""
        words = [("left", SIDE_COLOUR["left"]), ("right", SIDE_COLOUR["right"])]
        words += [] if all_seen else [("pale: not seen", "#888888")]
        for row, (word, colour) in enumerate(words):
            ax.text(0.02, 0.03 + 0.05 * row, word, color=colour, fontsize=9, transform=ax.transAxes, fontweight="bold")

    def pixels(self) -> np.ndarray:
        """(height, width, 3) uint8 of what was drawn."""
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


# --- files


def check_format(path: Path) -> None:
    """Raises PictureError where a film of this suffix cannot be written here."""
    if path.suffix not in SUFFIXES:
        raise PictureError(f"{path}: the name must end in {', '.join(SUFFIXES)}")
    if path.suffix == ".mp4" and not shutil.which("ffmpeg"):
        raise PictureError(f"{path}: mp4 needs the program ffmpeg, which is not there; choose a name ending in .gif")


def write_film(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """Write pictures, equal in size, as a film, or below each other as a .png; whole or not at all."""
    check_format(path)
    {".gif": _write_gif, ".mp4": _write_mp4, ".png": _write_png}[path.suffix](path, pictures)


def _write_gif(path: Path, pictures: Iterable[np.ndarray]) -> None:
    from PIL import Image

    palette = _palette()
    frames = (Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    buffer = io.BytesIO()
    next(frames).save(buffer, "GIF", save_all=True, append_images=frames, duration=1000 // PICTURES_PER_SECOND, loop=0)
    write_atomically(path, buffer.getvalue())


def _palette() -> Any:
    """An image with the colours of the drawings in steps down to white: the same in all pictures: nothing flickers."""
    from PIL import Image, ImageColor

    colours = [*SIDE_COLOUR.values(), _AMBER, _CALM, _INK, "#000000"]
    steps = np.linspace(0, 1, 24)[:, None]
    blended = [steps * ImageColor.getrgb(colour) + (1 - steps) * 255 for colour in colours]
    mixed = [
        steps[::3] * ImageColor.getrgb(_INK) + (1 - steps[::3]) * ImageColor.getrgb(bar) for bar in (_CALM, _AMBER)
    ]
    table = np.concatenate([*blended, *mixed]).round().astype(np.uint8)
    image = Image.new("P", (1, 1))
    image.putpalette(np.concatenate([table, np.zeros((256 - len(table), 3), np.uint8)]).tobytes())
    return image


def _write_png(path: Path, pictures: Iterable[np.ndarray]) -> None:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(list(pictures))).save(buffer, "PNG")
    write_atomically(path, buffer.getvalue())


def _write_mp4(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """By ffmpeg, into a file beside the target that takes its name when it is whole."""
    pictures = iter(pictures)
    first = next(pictures)
    height, width = first.shape[:2]
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        part = Path(folder) / path.name
        command = ["ffmpeg", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
        command += ["-s", f"{width}x{height}", "-r", str(PICTURES_PER_SECOND), "-i", "-", "-pix_fmt", "yuv420p", part]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            try:
                for picture in chain([first], pictures):
                    ffmpeg.stdin.write(picture.tobytes())
            except BrokenPipeError:
                pass  # it says why on stderr
            _, said = ffmpeg.communicate()
        if ffmpeg.returncode or not part.exists():
            raise PictureError(f"{path}: ffmpeg failed: {' '.join(said.decode(errors='replace').split())}")
        os.replace(part, path)
