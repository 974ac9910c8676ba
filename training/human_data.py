# SPDX-License-Identifier: Apache-2.0
"""2D training frames of people: CMU motion capture seen by random robot cameras and an imperfect detector.

    python -m training.human_data CMU_FOLDER -o human2d.npz [--truth human3d.npz]

CMU_FOLDER holds npz files of CMU-31 joints: ``S_world`` (F,31,3) metres, y up, with ``trial_names`` and ``trial_len``,
or ``S_root`` with ``seq_names`` and ``seq_len`` for root-relative clips.  Only the 2D file is for the trainer; the
3D truth of the same frames goes to another file, for evaluation.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from paul_ros.files import write_atomically
from training.mocap import CMU31, coco17_from_cmu31

HELD_OUT = ("02", "03", "27", "29", "01_12", "01_13", "01_14", "05_17", "05_18", "05_19", "05_20")
"""Subjects and trials that no training frame comes from; those of 01 and 05 are the unseen split of the literature."""


@dataclass(frozen=True)
class Views:
    """How the frames are seen; angles in degrees, distances in metres, noise in shares of the height in the image."""

    motion: float = 10.0  # a frame is taken once a limb has turned by this much since the last one taken
    views: int = 6  # random cameras a frame
    elevation: tuple[float, float] = (-15.0, 40.0)  # from below and from above
    roll: float = 5.0  # standard deviation
    distance: tuple[float, float] = (2.5, 10.0)  # log-uniform
    noise: float = 0.007  # standard deviation of most points ...
    outlier_share: float = 0.03  # ... and of the few that a detector misplaces
    outlier_noise: float = 0.06
    swap_share: float = 0.005  # left and right limbs exchanged
    hidden: float = 0.4  # up to this share of a view's points is missing at random
    truncated: float = 0.15  # share of views that lose all points below (or above) a random line
    seed: int = 0


def read_clips(folder: Path) -> list[tuple[str, np.ndarray]]:
    """(name, joints (F,31,3) in metres, y up) of every clip in the folder's npz files."""
    clips = []
    for file in sorted(folder.glob("*.npz")):
        with np.load(file, allow_pickle=False) as archive:
            kind = "trial" if "S_world" in archive.files else "seq"
            joints = archive["S_world" if kind == "trial" else "S_root"]
            ends = np.cumsum(archive[f"{kind}_len"])
            clips += zip(archive[f"{kind}_names"].tolist(), np.split(joints, ends[:-1]))
    if not clips:
        raise SystemExit(f"no npz files of CMU joints in {folder}")
    return clips


def training_clips(clips: list[tuple[str, np.ndarray]]) -> list[tuple[str, np.ndarray]]:
    """The clips that are neither held out nor copies of held-out ones under another name."""
    held_out = [joints for name, joints in clips if name.startswith(HELD_OUT)]
    known = np.concatenate([_limb_angles(joints) for joints in held_out] or [np.full((1, 28), np.inf)])
    return [(name, joints) for name, joints in clips if not name.startswith(HELD_OUT) and not _is_copy(joints, known)]


_PARENTS = {"femur": "hipjoint", "tibia": "femur", "humerus": "clavicle", "radius": "humerus"}


def _limbs(joints: np.ndarray) -> np.ndarray:
    """Unit directions (F,8,3) of thighs, shanks, upper and lower arms."""
    index = CMU31.index
    bones = np.stack(
        [
            joints[:, index(side + bone)] - joints[:, index(side + parent)]
            for side in "lr"
            for bone, parent in _PARENTS.items()
        ],
        axis=1,
    )
    return bones / np.linalg.norm(bones, axis=2, keepdims=True)


def _limb_angles(joints: np.ndarray) -> np.ndarray:
    """Cosines (F,28) between the limbs' directions: the same for a pose however it is placed, turned or scaled."""
    limbs = _limbs(joints)
    upper = np.triu_indices(limbs.shape[1], 1)
    return (limbs @ limbs.transpose(0, 2, 1))[:, upper[0], upper[1]]


def _is_copy(joints: np.ndarray, known: np.ndarray) -> bool:
    """Most of some sampled poses occur among the known ones, to rounding."""
    sample = _limb_angles(joints[:: max(1, len(joints) // 12)])
    nearest = np.array([np.abs(known - pose).max(1).min() for pose in sample])
    return float(np.median(nearest)) < 0.02


def distinct_frames(joints: np.ndarray, motion: float) -> np.ndarray:
    """Indices of the frames in which some limb has turned by ``motion`` degrees since the last index.

    Someone standing still for a minute is one pose, a leap is many.
    """
    limbs, least = _limbs(joints), np.cos(np.deg2rad(motion))
    taken = [0]
    for frame in range(1, len(limbs)):
        if (limbs[frame] * limbs[taken[-1]]).sum(1).min() < least:
            taken.append(frame)
    return np.array(taken)


def random_cameras(count: int, views: Views, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N,3,3) from a y-up world to camera optical frames, and distances (N,) in metres."""
    yaw = rng.uniform(0, 2 * np.pi, count)
    pitch = np.deg2rad(rng.uniform(*views.elevation, count))
    roll = np.deg2rad(rng.normal(0, views.roll, count))
    to_optical = np.diag([1.0, -1.0, -1.0])  # y up to y down, and z into the scene
    R = _turn(roll, 2) @ _turn(pitch, 0) @ to_optical @ _turn(yaw, 1)
    return R, np.exp(rng.uniform(*np.log(views.distance), count))


def _turn(angle: np.ndarray, axis: int) -> np.ndarray:
    """Rotations (N,3,3) about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -R[:, j, i]
    return R


def see(points: np.ndarray, views: Views, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Look at COCO-17 points (F,17,3), each frame with a camera of its own aimed at it.

    Returns:
        W (F,2,17) float32 normalised image points with noise, visible (F,17), and the true points (F,3,17) float32 in
        the camera frame, centred.
    """
    R, distance = random_cameras(len(points), views, rng)
    S = R @ (points - points.mean(1, keepdims=True)).transpose(0, 2, 1)
    W = S[:, :2] / (S[:, 2:] + distance[:, None, None])
    height = np.ptp(W, axis=2).max(1)[:, None, None]
    noise = np.where(rng.random((len(W), 1, 17)) < views.outlier_share, views.outlier_noise, views.noise)
    W = _swapped(W, views, rng) + height * noise * rng.standard_normal(W.shape)
    visible = rng.random((len(W), 17)) >= views.hidden * rng.random((len(W), 1))
    return W.astype(np.float32), visible & _inside(W, views, rng), S.astype(np.float32)


def _swapped(W: np.ndarray, views: Views, rng: np.random.Generator) -> np.ndarray:
    """A few limb joints with left and right exchanged (COCO order: left at odd, right at the next even index)."""
    W = W.copy()
    for left in range(5, 17, 2):
        rows = rng.random(len(W)) < views.swap_share
        W[rows, :, left], W[rows, :, left + 1] = W[rows, :, left + 1], W[rows, :, left]
    return W


def _inside(W: np.ndarray, views: Views, rng: np.random.Generator) -> np.ndarray:
    """(F,17): not cut off by an image border that a truncated view has below or above a random line."""
    y = W[:, 1] - W[:, 1].min(1, keepdims=True)
    border = rng.uniform(0.35, 1.0, (len(W), 1)) * y.max(1, keepdims=True)
    below = rng.random((len(W), 1)) < 0.8
    cut = rng.random((len(W), 1)) < views.truncated
    return ~cut | np.where(below, y <= border, y >= y.max(1, keepdims=True) - border)


def make(folder: Path, views: Views) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The 2D arrays of the training file, and the truth (F,3,17) of the same frames."""
    rng = np.random.default_rng(views.seed)
    clips = training_clips(read_clips(folder))
    points = np.concatenate([coco17_from_cmu31(joints[distinct_frames(joints, views.motion)]) for _, joints in clips])
    seen = [see(points, views, rng) for _ in range(views.views)]
    W, visible, S = (np.concatenate(part) for part in zip(*seen))
    about = {
        "source": "CMU motion capture (mocap.cs.cmu.edu)",
        "clips": [name for name, _ in clips],
        "poses": len(points),
        "views": asdict(views),
    }
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    return {"W": W, "visible": visible, "calibrated": np.array(True), "about": text}, S


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="npz files of CMU-31 joints")
    parser.add_argument("-o", "--output", type=Path, required=True, help="2D file for the trainer (.npz)")
    parser.add_argument("--truth", type=Path, help="3D truth of the same frames, for evaluation only (.npz)")
    args = parser.parse_args()
    arrays, truth = make(args.folder, Views())
    _save(args.output, arrays)
    if args.truth:
        _save(args.truth, {**arrays, "S": truth})
    print(f"{args.output}: {len(truth)} frames, {1 - arrays['visible'].mean():.0%} of the points hidden")


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    import io

    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_atomically(path, buffer.getvalue())


if __name__ == "__main__":
    main()
