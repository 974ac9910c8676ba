# SPDX-License-Identifier: Apache-2.0
"""The start of a run: 3D shapes that the networks first learn to give, found once and kept beside the checkpoint."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from paul_ros.files import read_npz, write_atomically
from paul_ros.layout import Layout
from paul_ros.metrics import procrustes
from training.data import TrainingData
from training.distributed import from_first
from training.errors import StartError
from training.networks import to_centre, to_unit_size
from training.objective import Views
from training.recipe import Recipe

START = "start.npz"

START_UNIT = {"free": 0.5**0.5, "unit": 1.0}
"""Root mean square coordinate of ``Views.W`` by the recipe's scale: starts are searched for where it is 1."""

Progress = Callable[[float], None]
"""Is told the share of the work that is done, 0 to 1."""


_NEAREST = 0.2  # of the distance of an object: its points are not nearer, while shapes are still wild


@dataclass(frozen=True)
class Start:
    """What ``warm_start.py`` found, as the trainer uses it.

    Attributes:
        rows: (n,) the frames that have a shape.
        shapes: (n,3,P) float32 in one canonical frame: ``rotations @ shapes`` fits W at unit root mean square
            coordinate.
        rotations: (n,3,3) float32.
        score: lower is better, comparable between seeds.
        seconds: that the search took.
    """

    rows: np.ndarray
    shapes: np.ndarray
    rotations: np.ndarray
    score: float
    seconds: float


def search(kind: str, W: np.ndarray, visible: np.ndarray, seed: int, progress: Progress | None) -> Start:
    """Find a start from 2D alone; W (F,2,P) centred on the visible points, of root mean square coordinate 1."""
    from training.start import warm_start

    begun = time.monotonic()
    find = {"linear": warm_start.linear_start, "rigid": warm_start.rigid_start}[kind]
    found = find(W, visible, seed, progress)
    return Start(
        np.asarray(found.rows, np.int64),
        np.asarray(found.shapes, np.float32),
        np.asarray(found.rotations, np.float32),
        float(found.score),
        time.monotonic() - begun,
    )


def start_identity(data: TrainingData, recipe: Recipe) -> dict[str, str | int]:
    """All that a start depends on: runs that have this in common have one start."""
    return {"data": data.sha256, **{name: getattr(recipe, name) for name in ("start", "scale", "seed")}}


def kept_start(folder: Path, identity: dict, find: Callable[[], Start], device: torch.device) -> Start:
    """The start kept in a run's folder; if there is none, ``find`` one and keep it.

    Args:
        identity: what the start belongs to (``start_identity``), plain JSON values.

    Raises:
        StartError: the file is damaged, or belongs to something else.
    """
    path = folder / START

    def read_or_find() -> bytes:
        if not path.exists():
            write_atomically(path, _packed(find(), identity))
        return path.read_bytes()

    return _unpacked(from_first(read_or_find, device), identity, path)


def _packed(start: Start, identity: dict) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, identity=np.array(json.dumps(identity, sort_keys=True)), **vars(start))
    return buffer.getvalue()


def _unpacked(data: bytes, identity: dict, path: Path) -> Start:
    try:
        kept = read_npz(io.BytesIO(data), ("identity", "rows", "shapes", "rotations", "score", "seconds"))
        found = json.loads(str(kept["identity"]))
        start = Start(kept["rows"], kept["shapes"], kept["rotations"], float(kept["score"]), float(kept["seconds"]))
    except (TypeError, ValueError) as error:  # an NpzError is a ValueError
        raise StartError(f"'{path}' cannot be read ({type(error).__name__}): start over with --fresh") from error
    other = [name for name in identity if found.get(name) != identity[name]]
    if other:
        raise StartError(f"'{path}' belongs to a run with different {' and '.join(other)}: start over with --fresh")
    return start


def mirrored(start: Start) -> Start:
    """The same views explained by the mirror images: nothing in orthographic views tells which of them is right."""
    flip = np.diag([1, 1, -1]).astype(np.float32)
    return Start(start.rows, flip @ start.shapes, flip @ start.rotations @ flip, start.score, start.seconds)


def symmetry(shapes: np.ndarray, layout: Layout) -> np.ndarray:
    """The reflection (3,3) that best takes shapes (n,3,P) with left and right exchanged onto themselves on average."""
    mean = shapes.mean(0, dtype=np.float64)
    exchanged = np.diag([-1.0, 1.0, 1.0]) @ mean[:, layout.mirror]
    R, _ = procrustes(exchanged.T[None], mean.T[None])
    return (R[0] @ np.diag([-1.0, 1.0, 1.0])).astype(np.float32)


class Lesson:
    """Canonical shapes that the networks learn to give: a start's, or what they themselves last made of all frames.

    Args:
        shapes: (n,3,P) float32 in one canonical frame, of any scale.
        rotations: (n,3,3) float32, the cameras that saw them.
        rows: (n,) the frames' numbers.
        sizes: (n,1,1) units of the frames' images per unit of the shapes.
        perspective: the images are rays of pinhole cameras, so that sizes are inverse distances.
        scale: the recipe's.
    """

    def __init__(
        self,
        shapes: Tensor,
        rotations: Tensor,
        rows: Tensor,
        sizes: Tensor,
        perspective: bool,
        layout: Layout,
        scale: str,
    ) -> None:
        self._shapes = to_unit_size(shapes, layout) if scale == "free" else to_centre(shapes, layout)
        self._cameras = rotations
        before, after = (S.flatten(1).norm(dim=1)[:, None, None] for S in (to_centre(shapes, layout), self._shapes))
        self._sizes = sizes * before / after
        self._nearness = self._sizes if perspective else torch.zeros_like(self._sizes)
        self._symmetry = torch.from_numpy(symmetry(shapes.cpu().numpy(), layout)).to(shapes)
        self._mirror = list(layout.mirror)
        self.rows = rows

    @classmethod
    def of(cls, start: Start, views: Views, layout: Layout, scale: str) -> Lesson:
        """What a start teaches; views: its own frames'."""
        shapes, rotations = (torch.from_numpy(array).to(views.W) for array in (start.shapes, start.rotations))
        sizes = START_UNIT[scale] * views.size
        return cls(shapes, rotations, torch.from_numpy(start.rows), sizes, views.calibrated, layout, scale)

    def shapes_of(self, chosen: Tensor, exchanged: Tensor | None) -> Tensor:
        """Shapes (N,3,P) by their places in the lesson (N,), mirrored where left and right are exchanged (N,1,1)."""
        S = self._shapes[chosen.to(self._shapes.device)]
        return S if exchanged is None else torch.where(exchanged, self._symmetry @ S[:, :, self._mirror], S)

    def seen_by(self, cameras: Tensor, S: Tensor) -> Tensor:
        """Image points (N,2,P) of shapes S (N,3,P) for the cameras of other frames, by places in the lesson (N,).

        The shape is the same from wherever it is seen, and cameras and distances are those that do occur.
        """
        cameras = cameras.to(S.device)
        X, sizes, nearness = self._cameras[cameras] @ S, self._sizes[cameras], self._nearness[cameras]
        return sizes * X[:, :2] / (1 + nearness * X[:, 2:]).clamp_min(_NEAREST)
