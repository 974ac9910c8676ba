# SPDX-License-Identifier: Apache-2.0
"""`paul view MODEL`: the mean shape of a model and the shapes of its codes' first modes, as a short film."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from paul_ros.body_axes import body_rotations, left_and_up
from paul_ros.model import Model
from paul_ros.offline.canvas import CALM, CAPTION, Canvas, draw_legend, show_box, turntable
from paul_ros.offline.film import PNG_PICTURES, Film, Progress
from paul_ros.offline.film_files import check_format, write_film
from paul_ros.offline.skeleton_drawing import draw_skeleton

_RANDOM_VIEWS, _NOISE, _SEED = 2000, 0.3, 0  # random views that the modes are found from; noise over the points' rms
_MAX_MODES, _SWING = 3, 2.0  # standard deviations
_PICTURES = 120


def view_model(model: Model, out: Path, progress: Progress = lambda pictures, total: pictures) -> Film:
    """Draw the mean shape turning, and shapes whose codes swing along their first modes.

    Args:
        model: the model to show.
        out: the film, whose suffix chooses the format.
        progress: shows progress over the pictures.

    Raises:
        PictureError: the film cannot be written.
    """
    check_format(out)
    stage = _ModelStage(model)
    # A .png shows quarters of a swing and of a turn, but not the middle, where all modes are the mean.
    quarters = range(_PICTURES // 8, _PICTURES, _PICTURES // PNG_PICTURES)
    shown = quarters if out.suffix == ".png" else range(_PICTURES)
    write_film(out, progress((stage.draw(index) for index in shown), len(shown)))
    summary = f"the mean shape and {len(stage.modes)} modes of its {len(stage.mean)} codes, to {_SWING:g} "
    return Film(out, len(shown), summary + "standard deviations")


class _ModelStage:
    """Panels side by side: the mean shape on a turntable, then one mode each."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.mean, self.modes, self.shares = code_modes(model)
        self._view = _front_view(model)
        self._radius = 1.15 * float(np.linalg.norm(model.mean_shape, axis=0).max())
        self._canvas = Canvas()

    def draw(self, index: int) -> np.ndarray:
        """Return one picture, (height, width, 3) uint8."""
        phase = 2 * np.pi * index / _PICTURES
        turning, swaying = turntable(phase) @ self._view, turntable(np.radians(35) * np.sin(phase)) @ self._view
        codes = self.mean + _SWING * np.sin(2 * phase) * self.modes
        self._canvas.clear()
        self._draw_title()
        self._draw_shape(0, turning @ self.model.mean_shape, "mean shape")
        for column, (code, share) in enumerate(zip(codes, self.shares), 1):
            shape = swaying @ self.model.decode(code[None])[0]
            self._draw_shape(column, shape, f"mode {column}: {100 * share:.0f} % of code variance")
        return self._canvas.pixels()

    def _draw_title(self) -> None:
        unit = self.model.metres_per_unit
        size = f"1 unit = {unit:.3f} m" if unit else "no metres known"
        left = f"{self.model.name}   layout {self.model.layout.name}"
        self._canvas.title(left, f"{len(self.mean)} codes, {size}", CALM)

    def _draw_shape(self, column: int, shape: np.ndarray, caption: str) -> None:
        """Draw a shape (3,P) in the viewer's frame in one of the columns."""
        width, layout = 0.98 / (len(self.modes) + 1), self.model.layout
        ax = self._canvas.panel((0.01 + column * width, 0.03, width, 0.83))
        draw_skeleton(
            ax, shape[:2].T, layout.edges, layout.sides, line_width=2.4 * 1.1, dot_size=14 * 1.1**2, depth=shape[2]
        )
        ax.set_title(caption, **CAPTION)
        show_box(ax, self._radius * np.array([[-0.62, -1.0], [0.62, 1.0]]))
        if column == 0:
            draw_legend(ax, True)


def code_modes(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the principal components of the codes for noisy random views of the mean shape.

    The codes of the training are not used, as the model file does not hold them.

    Returns:
        The mean code (K,), the first modes (M,K), each one standard deviation long, and their shares (M,) of the
        variance.
    """
    rng = np.random.default_rng(_SEED)
    Q, _ = np.linalg.qr(rng.standard_normal((_RANDOM_VIEWS, 3, 3)))
    shape = model.mean_shape.astype(float)
    W = (Q @ shape)[:, :2]
    W = W + _NOISE * shape.std() * rng.standard_normal(W.shape)
    # A model of one fixed scale takes image points in the unit of its training data.
    W = W * model.header.get("image_unit", 1.0)
    codes = model.encode(W, np.ones((_RANDOM_VIEWS, shape.shape[1]), bool)).astype(float)
    mean = codes.mean(0)
    _, sizes, axes = np.linalg.svd((codes - mean) / np.sqrt(_RANDOM_VIEWS), full_matrices=False)
    count = min(_MAX_MODES, int((sizes > 1e-6 * max(sizes[0], 1e-12)).sum()))
    variance = sizes**2
    shares = variance[:count] / max(variance.sum(), 1e-300)
    return mean, sizes[:count, None] * axes[:count], shares


def _front_view(model: Model) -> np.ndarray:
    """Return the rotation (3,3) from the canonical frame to a viewer in front of a body, y down.

    Other objects have no front and are seen in their canonical frame.
    """
    measures = left_and_up(model.layout)
    if measures is None:
        return np.eye(3)
    forward, left, up = body_rotations(model.mean_shape.T[None].astype(float), np.eye(3)[None], measures)[0].T
    return np.stack([left, -up, -forward])
