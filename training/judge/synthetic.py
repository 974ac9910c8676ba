# SPDX-License-Identifier: Apache-2.0
"""Made-up dense data: a body of bones with smooth skin, as many points and frames as are wanted, random cameras.

``python -m training.judge.synthetic -o mesh.npz --points 6890 --frames 5000`` writes a file that ``paul train`` takes.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from paul_ros.files import write_atomically

#: Bones of a body two units tall, y up: parent, start, end and radius.
_BONES = (
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
"""Ways in which the body moves, each bending all joints at once."""

_BEND = 0.35
"""Radians, standard deviation of a joint's rotation vector."""

_BLOCK = 256
_GOLDEN_ANGLE = np.pi * (3 - 5**0.5)


def articulated_mesh(points: int, frames: int, seed: int = 0) -> np.ndarray:
    """Points (F,3,P) of the moving body in the camera frame, float32, centred; W is their first two rows.

    Smooth (linear blend) skinning; poses of ``_MOTIONS`` degrees of freedom; rotations uniform over SO(3).  The same
    for the same arguments.
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
    """Edges (E,2) from each point of the body at rest to its nearest ones, each once, sorted."""
    rest = _surface(points)
    pairs = set()
    for rows in _blocks(points):
        distance = ((rest[rows, None] - rest[None]) ** 2).sum(2)
        distance[np.arange(len(distance)), np.arange(points)[rows]] = np.inf
        nearest = np.argpartition(distance, neighbours, axis=1)[:, :neighbours]
        pairs |= {(min(a, b), max(a, b)) for a, near in enumerate(nearest.tolist(), rows.start) for b in near}
    return np.array(sorted(pairs))


def _surface(points: int) -> np.ndarray:
    """Points (P,3) of the body at rest, evenly over the bones' surfaces, on a spiral around each."""
    area = np.array([np.linalg.norm(np.subtract(end, start)) * radius for _, start, end, radius in _BONES])
    last = np.round(np.cumsum(area) / area.sum() * points).astype(int)
    return np.concatenate([_tube(*bone[1:], count) for bone, count in zip(_BONES, np.diff(last, prepend=0))])


def _tube(start: tuple, end: tuple, radius: float, count: int) -> np.ndarray:
    axis = np.subtract(end, start)
    side = np.cross(axis, (0.0, 0.0, 1.0))
    side /= np.linalg.norm(side)
    front = np.cross(axis, side) / np.linalg.norm(axis)
    along, angle = (np.arange(count) + 0.5) / max(count, 1), np.arange(count) * _GOLDEN_ANGLE
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * front
    return np.array(start) + along[:, None] * axis + radius * ring


def _skin(points: int) -> np.ndarray:
    """(P,4B): times the stacked 4 x 3 motions of the B bones it gives the posed points; nearer bones weigh more."""
    rest = _surface(points)
    distance = np.stack([_distance(rest, np.array(start), np.array(end)) for _, start, end, _ in _BONES], axis=1)
    weight = np.exp(-((distance / 0.08) ** 2)) + 1e-12
    weight /= weight.sum(1, keepdims=True)
    homogeneous = np.concatenate([rest, np.ones((points, 1))], axis=1)
    return (weight[:, :, None] * homogeneous[:, None]).reshape(points, -1).astype(np.float32)


def _distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distances (P,) of points (P,3) from a line segment."""
    axis = end - start
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1)


def _bone_motions(angles: np.ndarray) -> np.ndarray:
    """(N,B,4,3): what each bone does to homogeneous row vectors at rest, given rotation vectors (N,B,3) of joints."""
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
    """Rotations (N,3,3) of quaternions (N,4), w first, of any length; of Gaussian ones they are uniform."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows, np.float32).transpose(2, 0, 1)


def _blocks(count: int) -> Iterator[slice]:
    return (slice(begin, min(begin + _BLOCK, count)) for begin in range(0, count, _BLOCK))


def main() -> None:
    """Write a file to train on; the 3D truth only where it is asked for."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--points", type=int, default=6890)
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", action="store_true", help="write S (F,3,P) too")
    args = parser.parse_args()
    S = articulated_mesh(args.points, args.frames, args.seed)
    buffer = io.BytesIO()
    np.savez(buffer, W=S[:, :2], edges=mesh_edges(args.points), **({"S": S} if args.truth else {}))
    write_atomically(args.output, buffer.getvalue())


if __name__ == "__main__":
    main()
