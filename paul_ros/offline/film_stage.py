# SPDX-License-Identifier: Apache-2.0
"""The stage of a bag's film: the 2D input, the persons from above, and a turntable, in one picture a frame.

Left and right keep their colours. Keypoints that the camera did not see are dimmed. Persons whose mirror image fits
nearly as well have a rim of amber.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from paul_ros.lifted import AMBIGUOUS
from paul_ros.offline.canvas import AMBER, CALM, CAPTION, INK, Canvas, draw_legend, show_box, turntable
from paul_ros.offline.replay import LiftedFrame, Replay
from paul_ros.offline.skeleton_drawing import draw_skeleton
from paul_ros.stream.messages import image_pixels, project
from paul_ros.wording import quantity

_TURN = np.radians(3.0)  # of the turntable, a picture
_FOLLOW_PICTURES = 15  # over which the turntable follows the persons
_GRID_LINES = 4  # to either side of the middle
_GRID_COLOUR, _FLOOR_COLOUR = "#e6e6e6", "#cfd4d9"
_REPROJECTION_COLOUR = "#bbbbbb"


@dataclass(frozen=True)
class Stage:
    """All that stays the same from picture to picture.

    Attributes:
        done: the replayed excerpt of F frames.
        name: title of the film.
        first: seconds of the bag at the first picture.
        centres: (F,3) point that the turntable turns about, units of the points.
        radii: (F,) distance around it that the turntable shows: the whole persons, and the ground below them.
        depths: (F,) the ground below the centre, units of the points. The ground is the lowest point of the film.
        spacing: side of a square on the ground, units of the points.
        room: (2,2) least and largest x and z in metres, seen from above; None in model units, which have no place.
        image: (2,2) least and largest pixels.
        canvas: where it is drawn.
    """

    done: Replay
    name: str
    first: float
    centres: np.ndarray
    radii: np.ndarray
    depths: np.ndarray
    spacing: float
    room: np.ndarray | None
    image: np.ndarray
    canvas: Canvas

    @classmethod
    def of(cls, done: Replay, name: str, first: float) -> Stage:
        """Return a stage that holds all frames of a replay; at least one person must be lifted."""
        bodies = [frame.lifted.points[frame.lifted.ok] for frame in done.frames]
        centres = _smooth([points.mean((0, 1)) if len(points) else None for points in bodies])
        around = [points - centre for points, centre in zip(bodies, centres)]
        # Frames without persons may have the points of another layout: the bag's layout shows with the first person.
        everywhere, centred = (np.concatenate([body.reshape(-1, 3) for body in which]) for which in (bodies, around))
        # The stream's units are those after the last frame.
        metric = all(frame.lifted.units == "m" for frame in done.frames if frame.lifted.ok.any())
        floor = np.percentile((everywhere if metric else centred)[:, 1], 98)
        depths = floor - (centres[:, 1] if metric else np.zeros(len(centres)))
        reach = [
            np.array([max(np.linalg.norm(points, axis=2).max(), depth)]) if len(points) else None
            for points, depth in zip(around, depths)
        ]
        radii = 1.05 * _smooth_above(reach)[:, 0]
        return cls(
            done,
            name,
            first,
            centres,
            radii,
            depths,
            _grid_spacing(float(np.median(radii))),
            _room(everywhere) if metric else None,
            _image(done),
            Canvas(),
        )

    def draw(self, index: int) -> np.ndarray:
        """Return the picture of one frame, (height, width, 3) uint8."""
        frame, canvas = self.done.frames[index], self.canvas
        canvas.clear()
        self._draw_title(frame)
        if self.room is None:
            self._draw_image(canvas.panel((0.02, 0.1, 0.42, 0.75)), frame)
        else:
            self._draw_image(canvas.panel((0.02, 0.5, 0.42, 0.37)), frame)
            self._draw_above(canvas.panel((0.02, 0.06, 0.42, 0.37)), frame, self.room)
        self._draw_turntable(canvas.panel((0.46, 0.06, 0.52, 0.81)), frame, index)
        return canvas.pixels()

    def _draw_title(self, frame: LiftedFrame) -> None:
        ok = frame.lifted.ok
        doubtful = bool((ok & (frame.lifted.ambiguity >= AMBIGUOUS)).any())
        seconds = self.first + (frame.stamp - self.done.frames[0].stamp) / 1e9
        persons = quantity(len(ok), "person")
        persons += f", {int((~ok).sum())} not lifted" if not ok.all() else ""
        model = self.done.stream.lifter.model.name
        self.canvas.title(
            f"{self.name}   {seconds:5.1f} s   {persons}",
            "ambiguous: the mirror image fits nearly as well" if doubtful else f"lifted by {model}",
            AMBER if doubtful else CALM,
        )

    def _draw_image(self, ax: Any, frame: LiftedFrame) -> None:
        ax.set_title("2D input, pixels; grey: the lifted points seen by the camera", **CAPTION)
        layout, visible = self.done.layout, frame.keypoints.visible
        reprojected = _reprojected(frame)
        for person in range(len(visible)):
            if reprojected is not None and frame.lifted.ok[person]:
                colour = _REPROJECTION_COLOUR
                draw_skeleton(ax, reprojected[person], layout.edges, colour=colour, line_width=2.4)
            points = np.where(visible[person][:, None], image_pixels(frame.keypoints, frame.camera)[person], np.nan)
            draw_skeleton(ax, points, layout.edges, layout.sides, line_width=2.4, dot_size=14, visible=visible[person])
        show_box(ax, self.image)

    def _draw_above(self, ax: Any, frame: LiftedFrame, room: np.ndarray) -> None:
        ax.set_title("seen from above, metres; camera at the bottom", **CAPTION)
        (left, near), (right, far) = room
        for metres in range(int(np.floor(near)), int(np.ceil(far)) + 1):
            ax.axhline(metres, color=_GRID_COLOUR, linewidth=0.8, zorder=0)
            if near < metres < far - 0.3:
                ax.text(left, metres, f" {metres}", fontsize=7, color="#999999", va="bottom")
        for metres in range(int(np.floor(left)), int(np.ceil(right)) + 1):
            ax.axvline(metres, color=_GRID_COLOUR, linewidth=0.8, zorder=0)
        ax.scatter([0], [0], marker="^", s=70, color=INK, zorder=2)
        for person in np.flatnonzero(frame.lifted.ok):
            points = frame.lifted.points[person]
            self._draw_person(ax, frame, int(person), points[:, [0, 2]], points[:, 1], 0.7)
        show_box(ax, np.array([[left, far], [right, near]]))

    def _draw_turntable(self, ax: Any, frame: LiftedFrame, index: int) -> None:
        units = "metres" if self.room is not None else "model units"
        turn = turntable(_TURN * index)
        centre, radius = self.centres[index], self.radii[index]
        _draw_floor(ax, turn, np.array([0.0, self.depths[index], 0.0]), self.spacing)
        ax.set_title(f"turntable, {units}; a square is {self.spacing:g}", **CAPTION)
        for person in np.flatnonzero(frame.lifted.ok):
            points = (frame.lifted.points[person] - centre) @ turn.T
            self._draw_person(ax, frame, int(person), points[:, :2], points[:, 2], 1.3)
        draw_legend(ax, bool(frame.keypoints.visible.all()))
        show_box(ax, radius * np.array([[-1.0, -1.0], [1.0, 1.0]]))

    def _draw_person(
        self, ax: Any, frame: LiftedFrame, person: int, points: np.ndarray, depth: np.ndarray, size: float
    ) -> None:
        """Draw one lifted person in a view: points (P,2) and depth (P,) away from the viewer."""
        doubtful = frame.lifted.ambiguity[person] >= AMBIGUOUS
        draw_skeleton(
            ax,
            points,
            self.done.layout.edges,
            self.done.layout.sides,
            line_width=2.4 * size,
            dot_size=14 * size**2,
            visible=frame.keypoints.visible[person],
            depth=depth,
            rim=AMBER if doubtful else "",
        )


def _smooth(values: Sequence[np.ndarray | None]) -> np.ndarray:
    """Return values (F,D), one per frame, averaged over time; frames without a value are interpolated."""
    return _windows(_filled(values)).mean(1)


def _smooth_above(values: Sequence[np.ndarray | None]) -> np.ndarray:
    """Return smooth values (F,D) that are nowhere below the given ones."""
    return _windows(_windows(_filled(values)).max(1)).mean(1)


def _filled(values: Sequence[np.ndarray | None]) -> np.ndarray:
    """Return values (F,D), one per frame; frames without a value are interpolated."""
    known = {index: value for index, value in enumerate(values) if value is not None}
    frames = np.arange(len(values))
    return np.stack([np.interp(frames, list(known), column) for column in np.array(list(known.values())).T], axis=1)


def _windows(values: np.ndarray) -> np.ndarray:
    """Return the _FOLLOW_PICTURES values around each frame, (F,_FOLLOW_PICTURES,D) of (F,D); the ends repeat."""
    half = _FOLLOW_PICTURES // 2
    padded = np.concatenate([values[:1].repeat(half, 0), values, values[-1:].repeat(half, 0)])
    return np.stack([padded[index : index + _FOLLOW_PICTURES] for index in range(len(values))])


def _room(points: np.ndarray) -> np.ndarray:
    """Return least and largest x and z (2,2) of points (M,3) and the camera; 1 % of the points at either end are left
    out."""
    low, high = np.percentile(points[:, [0, 2]], (1, 99), axis=0)
    low, high = np.minimum(low, 0.0) - 0.5, np.maximum(high, 0.0) + 0.5
    return np.array([low, high])


def _image(done: Replay) -> np.ndarray:
    """Return least and largest pixels (2,2) of all keypoints, with a margin."""
    seen = np.concatenate(
        [image_pixels(frame.keypoints, frame.camera)[frame.keypoints.visible] for frame in done.frames]
    )
    low, high = np.percentile(seen, (0.2, 99.8), axis=0)
    return np.array([low, high]) + 0.08 * np.linalg.norm(high - low) * np.array([[-1.0], [1.0]])


def _reprojected(frame: LiftedFrame) -> np.ndarray | None:
    """Return the pixels (N,P,2) of the lifted points; None without a camera or in model units."""
    if frame.camera is None or frame.lifted.units != "m":
        return None
    return project(frame.lifted.points, frame.camera)


def _grid_spacing(radius: float) -> float:
    """Return 1, 2 or 5 times a power of ten, so that about four grid lines lie within the radius."""
    power = 10 ** np.floor(np.log10(radius / _GRID_LINES))
    return float(power * next(factor for factor in (1, 2, 5, 10) if factor * power >= radius / _GRID_LINES))


def _draw_floor(ax: Any, turn: np.ndarray, middle: np.ndarray, spacing: float) -> None:
    """Draw a square grid, level with the camera, about a point (3,), seen through a rotation (3,3)."""
    ends = spacing * _GRID_LINES
    for at in spacing * np.arange(-_GRID_LINES, _GRID_LINES + 1):
        for line in ([[at, 0, -ends], [at, 0, ends]], [[-ends, 0, at], [ends, 0, at]]):
            ax.plot(*((np.array(line) + middle) @ turn.T)[:, :2].T, color=_FLOOR_COLOUR, linewidth=0.8, zorder=0)
