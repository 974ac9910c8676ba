# SPDX-License-Identifier: Apache-2.0
"""Synthetic dense data: a body of bones with smooth skin under random cameras, with any number of points and frames.

    python -m training.judge.synthetic -o mesh.npz [--points 6890] [--frames 5000] [--seed 0] [--truth]

The file holds W (F,2,P) and edges (E,2), for ``paul train``; with --truth also S (F,3,P), for ``paul evaluate``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.files import write_npz

_Bone = tuple[int, tuple[float, float, float], tuple[float, float, float], float]

#: Bones of a body two units tall, y up: parent, start, end and radius.
_BONES: tuple[_Bone, ...] = (
    (-1, (0.0, 0.0, 0.0), (0.0, 0.5, 0.0), 0.16),  # trunk
    (0, (0.0, 0.55, 0.0), (0.0, 0.8, 0.0), 0.11),  # head
    (0, (0.2, 0.5, 0.0), (0.5, 0.5, 0.0), 0.06),  # left arm
    (2, (0.5, 0.5, 0.0), (0.8, 0.5, 0.0), 0.045),
    (0, (-0.2, 0.5, 0.0), (-0.5, 0.5, 0.0), 0.06),  # right arm
    (4, (-0.5, 0.5, 0.0), (-0.8, 0.5, 0.0), 0.045),
    (0, (0.1, 0.0, 0.0), (0.12, -0.45, 0.0), 0.08),  # left leg
    (6, (0.12, -0.45, 0.0), (0.13, -0.9, 0.03), 0.055),
    (0, (-0.1, 0.0, 0.0), (-0.12, -0.45, 0.0), 0.08),  # right leg
    (8, (-0.12, -0.45, 0.0), (-0.13, -0.9, 0.03), 0.055),
)
_MOTIONS = 6
"""Degrees of freedom of the poses; each bends all joints at once."""

_BEND = 0.35
"""Standard deviation of a joint's rotation vector, radians."""

_BLOCK = 256
_GOLDEN_ANGLE = np.pi * (3 - 5**0.5)


def articulated_mesh(points: int, frames: int, seed: int = 0) -> np.ndarray:
    """Return the moving body's points by linear blend skinning; equal arguments give equal points.

    Poses have ``_MOTIONS`` degrees of freedom, camera rotations are uniform over SO(3).

    Args:
        points: number of points P.
        frames: number of frames F.
        seed: of poses and cameras.

    Returns:
        (F,3,P) float32 in the camera frame, centred; the first two rows are the orthographic image W.
    """
    rng = np.random.default_rng(seed)
    skin = _skin(points)
    mix = rng.standard_normal((_MOTIONS, 3 * len(_BONES))) * _BEND / _MOTIONS**0.5
    S = np.empty((frames, 3, points), np.float32)
    for rows in _blocks(frames):
        angles = (rng.standard_normal((len(S[rows]), _MOTIONS)) @ mix).reshape(-1, len(_BONES), 3)
        camera = _rotations(rng.standard_normal((len(angles), 4)))
        posed = skin @ _bone_motions(angles).reshape(len(angles), -1, 3)
        posed -= posed.mean(1, keepdims=True)
        S[rows] = camera @ posed.transpose(0, 2, 1)
    return S


def mesh_edges(points: int, neighbours: int = 3) -> np.ndarray:
    """Return edges (E,2) from each point of the body at rest to its nearest ones, each once, sorted."""
    rest = _surface(points)
    pairs: set[tuple[int, int]] = set()
    for rows in _blocks(points):
        distance = ((rest[rows, None] - rest[None]) ** 2).sum(2)
        distance[np.arange(len(distance)), np.arange(points)[rows]] = np.inf
        nearest = np.argpartition(distance, neighbours, axis=1)[:, :neighbours]
        pairs |= {(min(a, b), max(a, b)) for a, near in enumerate(nearest.tolist(), rows.start) for b in near}
    return np.array(sorted(pairs))


def _surface(points: int) -> np.ndarray:
    """Return points (P,3) of the body at rest, evenly spread on spirals around the bones."""
    area = np.array([np.linalg.norm(np.subtract(end, start)) * radius for _, start, end, radius in _BONES])
    last = np.round(np.cumsum(area) / area.sum() * points).astype(int)
    counts = np.diff(last, prepend=0)
    return np.concatenate([_tube(*bone[1:], count) for bone, count in zip(_BONES, counts.tolist())])


def _tube(start: tuple[float, float, float], end: tuple[float, float, float], radius: float, count: int) -> np.ndarray:
    """Return so many points (N,3) on a spiral around a bone."""
    axis = np.subtract(end, start)
    side = np.cross(axis, (0.0, 0.0, 1.0))
    side /= np.linalg.norm(side)
    front = np.cross(axis, side) / np.linalg.norm(axis)
    along, angle = (np.arange(count) + 0.5) / max(count, 1), np.arange(count) * _GOLDEN_ANGLE
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * front
    return np.array(start) + along[:, None] * axis + radius * ring


def _skin(points: int) -> np.ndarray:
    """Return the skinning matrix (P,4B), in which nearer bones weigh more.

    Its product with the stacked 4 x 3 motions of the B bones is the posed points.
    """
    rest = _surface(points)
    distance = np.stack([_distance(rest, np.array(start), np.array(end)) for _, start, end, _ in _BONES], axis=1)
    weight = np.exp(-((distance / 0.08) ** 2)) + 1e-12
    weight /= weight.sum(1, keepdims=True)
    homogeneous = np.concatenate([rest, np.ones((points, 1))], axis=1)
    return (weight[:, :, None] * homogeneous[:, None]).reshape(points, -1).astype(np.float32)


def _distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the distances (P,) of points (P,3) from a line segment."""
    axis = end - start
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1)


def _bone_motions(angles: np.ndarray) -> np.ndarray:
    """Return the bones' motions (N,B,4,3) of homogeneous row vectors at rest, from rotation vectors (N,B,3)."""
    size = np.linalg.norm(angles, axis=2, keepdims=True)
    half = np.concatenate([np.cos(size / 2), np.sinc(size / (2 * np.pi)) / 2 * angles], axis=2)
    turn = _rotations(half.reshape(-1, 4)).reshape(*angles.shape[:2], 3, 3)
    motion = np.zeros((*angles.shape[:2], 4, 3))
    for bone, (parent, start, _, _) in enumerate(_BONES):
        R, joint = turn[:, bone], np.broadcast_to(np.array(start), angles[:, 0].shape)
        shift = joint - (R @ joint[..., None])[..., 0]
        if parent >= 0:
            above, above_shift = motion[:, parent, :3].transpose(0, 2, 1), motion[:, parent, 3]
            R, shift = above @ R, (above @ shift[..., None])[..., 0] + above_shift
        motion[:, bone, :3], motion[:, bone, 3] = R.transpose(0, 2, 1), shift
    return motion.astype(np.float32)


def _rotations(quaternion: np.ndarray) -> np.ndarray:
    """Return rotations (N,3,3) of quaternions (N,4), w first, of any length; Gaussian ones give uniform rotations."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows, np.float32).transpose(2, 0, 1)


def _blocks(count: int) -> Iterator[slice]:
    """Yield slices of frames or points that fit into memory."""
    return (slice(begin, min(begin + _BLOCK, count)) for begin in range(0, count, _BLOCK))


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog="python -m training.judge.synthetic",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="file to write (.npz)")
    parser.add_argument("--points", type=int, default=6890, help="number of points (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=5000, help="number of frames (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of poses and cameras (default: %(default)s)")
    parser.add_argument("--truth", action="store_true", help="write the truth S as well")
    args = parser.parse_args()
    S = articulated_mesh(args.points, args.frames, args.seed)
    arrays: dict[str, Any] = {"W": S[:, :2], "edges": mesh_edges(args.points)}
    if args.truth:
        arrays["S"] = S
    write_npz(args.output, arrays)


if __name__ == "__main__":
    main()
