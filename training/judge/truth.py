# SPDX-License-Identifier: Apache-2.0
"""2D keypoints with their 3D truth, for evaluation; the trainer never reads the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from msg_adapters.intrinsics import Intrinsics
from paul_ros.errors import NpzError
from paul_ros.files import read_npz
from paul_ros.layout import Layout
from paul_ros.placeholders import placeholders
from paul_ros.placement import centred_view
from training.errors import DataError

SAME_UNIT = (0.8, 1.25)
"""Size of W over that of S seen from the front, if both have one unit; with 20 % noise on W it is 1.02."""

_LEAST_LIKENESS = 0.5
"""Least correlation of W and S seen from the front, if S is in the camera frame."""

_RAYS = Intrinsics(1, 1, 0, 0, 0, 0)
"""The camera whose pixels are rays."""

_LEAST_POINTS = 4
"""Points of a frame by which W and S are compared."""


@dataclass(frozen=True)
class Sequence:
    """F frames of P points in any order; the trainer gets them shuffled.

    Attributes:
        name: file name without suffix.
        W: (F,2,P) image points, float32 or float64, y down; 0 where hidden.
        visible: (F,P) bool.
        S: (F,3,P) truth in the camera frame and the unit of W, float32 or float64; NaN where it is unknown.
        edges: (E,2) points that pictures join by lines; may be empty.
        metres: whether S is in metres.
        has_camera: whether W was saved as pixels or rays of a camera.
    """

    name: str
    W: np.ndarray
    visible: np.ndarray
    S: np.ndarray
    edges: np.ndarray
    metres: bool
    has_camera: bool = False

    @property
    def present(self) -> np.ndarray:
        """Mask (F,P) of the points with a known truth."""
        return np.isfinite(self.S).all(1)

    def hiding(self, share: float, seed: int) -> Sequence:
        """Return a copy with this share of every frame's visible points hidden at random."""
        drawn = np.where(self.visible, np.random.default_rng([seed, 1]).random(self.visible.shape), 2.0)
        order = drawn.argsort(1).argsort(1)
        count = np.round(share * self.visible.sum(1)).astype(int)
        visible = self.visible & (order >= count[:, None])
        return replace(self, visible=visible, W=np.where(visible[:, None], self.W, 0.0))

    def noisy(self, share: float, seed: int) -> Sequence:
        """Return a copy with Gaussian noise on W only; its deviation is this share of the rms coordinate."""
        seen = self.visible[:, None]
        count = np.maximum(self.visible.sum(1), 1)[:, None, None]
        offset = np.where(seen, self.W - self.W.sum(2, keepdims=True) / count, 0.0)
        rms = np.sqrt((offset**2).sum() / (2 * self.visible.sum()))
        noise = np.random.default_rng([seed, 2]).standard_normal(self.W.shape)
        return replace(self, W=np.where(seen, self.W + share * rms * noise, 0.0))

    def from_random_cameras(self, seed: int) -> Sequence:
        """Return the same shapes, each seen by an orthographic camera with a random rotation of its own.

        Raises:
            DataError: the truth of some points is unknown.
        """
        if not self.present.all():
            raise DataError(f"'{self.name}' cannot be seen by other cameras: the truth S of some points is unknown")
        S = random_rotations(len(self.S), seed) @ (self.S - self.S.mean(2, keepdims=True))
        return replace(self, W=np.where(self.visible[:, None], S[:, :2], 0.0), S=S)

    def among_categories(self, layout: Layout) -> Sequence:
        """Return a sequence of one category, which has the category's name, in the joint layout.

        Points of other categories are hidden, and their truth is unknown. Any other sequence is returned as it is.
        """
        points = list(layout.categories.get(self.name, ()))
        if self.W.shape[2] != len(points):
            return self
        frames, every = len(self.W), len(layout.names)
        W, visible = np.zeros((frames, 2, every)), np.zeros((frames, every), bool)
        S = np.full((frames, 3, every), np.nan)
        W[:, :, points], visible[:, points], S[:, :, points] = self.W, self.visible, self.S
        edges = np.array(points)[self.edges] if len(self.edges) else self.edges
        return replace(self, W=W, visible=visible, S=S, edges=edges)


def random_rotations(count: int, seed: int) -> np.ndarray:
    """Return rotations (count,3,3), det +1, uniform over all orientations."""
    Q, triangle = np.linalg.qr(np.random.default_rng([seed, 3]).standard_normal((count, 3, 3)))
    Q = Q * np.sign(np.diagonal(triangle, axis1=1, axis2=2))[:, None]
    Q[:, :, 0] *= np.linalg.det(Q)[:, None]
    return Q


def load_sequence(path: str | Path, turned: bool = False) -> Sequence:
    """Read an npz with W (F,2,P) and the truth S (F,3,P).

    Optional arrays: visible (F,P), edges (E,2), metres (one bool), K (3,3), the camera matrix of pixels W, and
    calibrated (one bool): W are rays. With either of the last two, W becomes the view of a weak-perspective camera at
    the mean depth of S, in the units of S.

    Args:
        path: of the npz.
        turned: with K, W and S become those of cameras that are turned to the object, as the Lifter's are.

    Raises:
        DataError: the file is missing or damaged, an array is missing or does not fit the others, or W and S have
            different units or frames.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    try:
        arrays = read_npz(path, ("W", "S"), ("visible", "edges", "metres", "K", "calibrated"))
    except NpzError as error:
        raise DataError(f"'{path}' {error} (evaluation needs W (F,2,P) and the truth S (F,3,P))") from error
    for name, rows in (("W", 2), ("S", 3)):
        if arrays[name].ndim != 3 or arrays[name].shape[1] != rows or arrays[name].dtype.kind not in "fiu":
            raise DataError(
                f"{name} in '{path}' must be numbers (F,{rows},P), it is {arrays[name].dtype} {arrays[name].shape}"
            )
    return _sequence(path, turned, **arrays)


def _sequence(
    path: Path,
    turned: bool,
    W: np.ndarray,
    S: np.ndarray,
    visible: np.ndarray | None = None,
    edges: np.ndarray | None = None,
    metres: np.ndarray | None = None,
    K: np.ndarray | None = None,
    calibrated: np.ndarray | None = None,
) -> Sequence:
    frames, points = len(W), W.shape[2]
    if S.shape != (frames, 3, points) or not frames:
        raise DataError(f"W {W.shape} and S {S.shape} in '{path}' must have the same frames and points, at least one")
    visible = np.ones((frames, points), bool) if visible is None else visible
    if visible.shape != (frames, points) or not np.isin(visible, (0, 1)).all():
        raise DataError(f"visible in '{path}' must be {(frames, points)} of bool (or 0 and 1), it is {visible.shape}")
    visible = visible.astype(bool) & np.isfinite(W).all(1)
    visible &= ~placeholders(W[:, 0], W[:, 1], visible)
    if not np.isfinite(S).any():
        raise DataError(f"the truth S in '{path}' holds no number")
    camera = _camera(K, path) if K is not None else _RAYS if _is_true(calibrated) else None
    if camera is not None:
        S = np.where((S == 0).all(1, keepdims=True), np.nan, S)  # in the camera's centre: marks a missing point
        W, S = _rays(W, S, visible, camera, turned)
        W = W * _mean_depth(S, path)[:, None, None]
    _check_units(W, S, visible & np.isfinite(S).all(1), path, K is not None)
    edges = np.zeros((0, 2), int) if edges is None else edges
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.dtype.kind not in "iu" or not _within(edges, points):
        raise DataError(f"edges in '{path}' must be (E,2) indices of the {points} points")
    return Sequence(
        name=path.stem,
        W=np.where(visible[:, None], W, 0).astype(_floating(W)),
        visible=visible,
        S=S.astype(_floating(S), copy=False),
        edges=edges,
        metres=_is_true(metres),
        has_camera=camera is not None,
    )


def _camera(K: np.ndarray, path: Path) -> Intrinsics:
    if K.shape != (3, 3) or K.dtype.kind not in "fiu" or not (K[[0, 1], [0, 1]] > 0).all():
        raise DataError(f"K in '{path}' must be a camera matrix (3,3) in pixels with positive focal lengths")
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    return Intrinsics(fx, fy, cx, cy, 0, 0)


def _rays(
    W: np.ndarray, S: np.ndarray, visible: np.ndarray, camera: Intrinsics, turned: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return rays (F,2,P) of pixels W and the truth S (F,3,P), in the frames of cameras turned to the object or not."""
    if not turned:
        offset, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
        return (W - offset[:, None]) / focal[:, None], S
    rays, truth = np.zeros(W.shape), S.astype(float)
    some = visible.any(1)
    view = centred_view(W[some].transpose(0, 2, 1), visible[some], camera)
    rays[some], truth[some] = np.nan_to_num(view.W), view.turn.transpose(0, 2, 1) @ truth[some]
    return rays, truth


def _mean_depth(S: np.ndarray, path: Path) -> np.ndarray:
    """Return the mean depth (F,) of the true points; 1 in frames without any, which are not judged."""
    known = np.isfinite(S[:, 2])
    depth = np.where(known, S[:, 2], 0.0).sum(1) / np.maximum(known.sum(1), 1)
    if not (depth[known.any(1)] > 0).all():
        raise DataError(f"'{path}' has a camera, but S is not in front of it: save S in the frame of the camera")
    return np.where(known.any(1), depth, 1.0)


def _check_units(W: np.ndarray, S: np.ndarray, known: np.ndarray, path: Path, has_camera: bool) -> None:
    """Refuse points W (F,2,P) that are no view of S (F,3,P) in its units, by the points known in both (F,P)."""
    seen, front = (_about_mean(points, known) for points in (W, S[:, :2]))
    size, true_size = (np.sqrt((points**2).sum((1, 2))) for points in (seen, front))
    rows = (known.sum(1) >= _LEAST_POINTS) & (size > 0) & (true_size > 0)
    if not rows.any():
        return
    scale = float(np.median(size[rows] / true_size[rows]))
    along = (seen * front).sum(2)[rows] / (size * true_size)[rows, None]
    alike_x, alike_y = np.median(along, axis=0).tolist()
    if alike_y < 0 < alike_x and alike_x - alike_y >= _LEAST_LIKENESS:
        raise DataError(f"y of W and of S in '{path}' point in opposite directions: let both point down")
    if alike_x + alike_y < _LEAST_LIKENESS:
        raise DataError(
            f"W in '{path}' is no view of S along its z axis: save S in the frame of the camera (x right, y down, z "
            "forward)"
        )
    low, high = SAME_UNIT
    if low <= scale <= high:
        return
    if has_camera:
        raise DataError(
            f"with K, W in '{path}' is {scale:.3g} times as large as its truth S is seen: save the K of the image that "
            "W belongs to, and W in pixels"
        )
    raise DataError(
        f"W in '{path}' is {scale:.3g} times as large as x and y of S: they have different units, such as "
        "pixels and metres. Save the camera matrix as K (3,3), or bring W and S to one unit"
    )


def _about_mean(points: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return points (F,2,P) about the mean of the known ones (F,P); 0 where unknown."""
    points = np.where(known[:, None], points, 0.0).astype(float)
    count = np.maximum(known.sum(1), 1)[:, None, None]
    return np.where(known[:, None], points - points.sum(2, keepdims=True) / count, 0.0)


def _floating(array: np.ndarray) -> type:
    """Return the array's floating type; float32 is kept because dense truth fills memory."""
    return np.float32 if array.dtype == np.float32 else np.float64


def _is_true(flag: np.ndarray | None) -> bool:
    return flag is not None and flag.size == 1 and bool(flag.all())


def _within(edges: np.ndarray, points: int) -> bool:
    return bool((edges >= 0).all() and (edges < points).all())
