# SPDX-License-Identifier: Apache-2.0
"""2D training frames of people: CMU motion capture seen by random robot cameras and an imperfect detector.

    python -m training.human_data CMU_FOLDER -o human2d.npz [--truth human3d.npz] [--set KEY=VALUE ...]

CMU_FOLDER holds npz files of CMU-31 joints: ``S_world`` (F,31,3) metres, y up, with ``trial_names`` and ``trial_len``,
or ``S_root`` with ``seq_names`` and ``seq_len`` for root-relative clips.  Only the 2D file is for the trainer; the
3D truth of the same frames goes to another file, for evaluation.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from tqdm import tqdm

from msg_adapters.keypoints import Intrinsics
from paul_ros.files import write_atomically
from paul_ros.model import enough_visible
from paul_ros.placement import centred_view
from training.cameras import Cameras, hidden_by_body, random_cameras
from training.detector import detect, redefined, reported
from training.mocap import CMU31, PARENTS, human_layout, human_points
from training.view_settings import Views, ViewsError

HELD_OUT = ("02", "03", "27", "29", "01_12", "01_13", "01_14", "05_17", "05_18", "05_19", "05_20")
"""Subjects and trials that no training frame comes from; those of 01 and 05 are the unseen split of the literature."""


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
        raise SystemExit(f"no npz files of CMU joints in '{folder}'")
    return clips


def training_clips(clips: list[tuple[str, np.ndarray]]) -> list[tuple[str, np.ndarray]]:
    """The clips that are neither held out nor copies of held-out ones under another name."""
    held_out = [joints for name, joints in clips if name.startswith(HELD_OUT)]
    known = np.concatenate([_limb_angles(joints) for joints in held_out] or [np.full((1, 28), np.inf)])
    return [(name, joints) for name, joints in clips if not name.startswith(HELD_OUT) and not _is_copy(joints, known)]


_LIMBS = {"femur": "hipjoint", "tibia": "femur", "humerus": "clavicle", "radius": "humerus"}


def _limbs(joints: np.ndarray) -> np.ndarray:
    """Unit directions (F,8,3) of thighs, shanks, upper and lower arms."""
    index = CMU31.index
    bones = np.stack(
        [
            joints[:, index(side + bone)] - joints[:, index(side + parent)]
            for side in "lr"
            for bone, parent in _LIMBS.items()
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


# Bones that are longer or shorter together, without the side letter.
_SEGMENTS = (
    ("femur",),
    ("tibia",),
    ("foot", "toes"),
    ("hipjoint",),
    ("lowerback", "upperback", "thorax"),
    ("lowerneck", "upperneck"),
    ("clavicle",),
    ("humerus",),
)


def other_people(joints: np.ndarray, views: Views, rng: np.random.Generator) -> np.ndarray:
    """The poses (F,31,3) of people of other stature and proportions, each frame another one, roots where they were."""
    factors = np.ones((len(joints), len(CMU31)))
    for bones in _SEGMENTS:
        own = [index for index, name in enumerate(CMU31) if name in bones or name[1:] in bones]
        factors[:, own] = np.exp(views.proportions * rng.standard_normal((len(joints), 1)))
    forearms = [CMU31.index(side + "radius") for side in "lr"]
    factors[:, forearms] *= rng.uniform(*views.forearm, (len(joints), 1))
    factors *= np.exp(views.stature * rng.standard_normal((len(joints), 1)))
    grown = np.array(joints, dtype=float)
    for bone, parent in enumerate(PARENTS):
        if parent >= 0:
            grown[:, bone] = grown[:, parent] + factors[:, bone, None] * (joints[:, bone] - joints[:, parent])
    return grown


@dataclass(frozen=True)
class Seen:
    """N views of bodies, in the order of the layout ``human``.

    Attributes:
        W: (N,2,P) float32 rays (x/z, y/z), with the detector's errors, of virtual cameras turned to the visible points
            as the Lifter turns them; 0 where hidden.
        visible: (N,P).
        S: (N,3,P) float32 the truth in those virtual cameras' frames, metres, centred on the mean of all points.
        confidence: (N,P), 0 where hidden.
        xy: (N,P,2) pixels, with the errors; NaN where hidden.
        points: (N,P,3) the truth in the optical frame, metres.
        cameras: the real cameras.
        level: (N,) of the detector's errors. layout: (N,) index of its layout in ``views.layouts``.
    """

    W: np.ndarray
    visible: np.ndarray
    S: np.ndarray
    confidence: np.ndarray
    xy: np.ndarray
    points: np.ndarray
    cameras: Cameras
    level: np.ndarray
    layout: np.ndarray


def see(points: np.ndarray, views: Views, rng: np.random.Generator) -> Seen:
    """Look at bodies (N,P,3) of ``human`` in a y-up world, metres, each with a camera and a detector of its own."""
    N = len(points)
    cameras = random_cameras(points, views, rng)
    truth = cameras.see(points)
    level = rng.uniform(*views.level, N)
    marked = redefined(truth, level, rng)
    xy = cameras.project(marked)
    inside = cameras.inside(marked, xy) if views.border else truth[..., 2] > 0
    occluded = hidden_by_body(truth) if views.occlusion else np.zeros(inside.shape, bool)
    found = detect(xy, _height(cameras, truth), occluded, level, views, rng)
    missed = rng.random(inside.shape) < rng.uniform(*views.hidden, (N, 1))
    found.visible[:] &= inside & ~missed & ~_covered(cameras.rays(xy), views, rng)
    shares = np.array([share for _, share in views.layouts], float)
    layout = rng.choice(len(shares), N, p=shares / shares.sum())
    found = reported(found, layout, views)
    return _turned(found.xy, found.confidence, found.visible, truth, cameras, level, layout)


def _turned(xy, confidence, visible, truth, cameras: Cameras, level, layout) -> Seen:
    """The views as the Lifter takes them; where nothing is visible, turned to the whole body."""
    some = visible | ~visible.any(1, keepdims=True)
    view = centred_view(cameras.rays(xy), some, Intrinsics(1.0, 1.0, 0.0, 0.0, 0, 0))
    visible = visible & np.isfinite(view.W).all(1)
    S = (truth @ view.turn).transpose(0, 2, 1)
    return Seen(
        W=np.where(visible[:, None], view.W, 0).astype(np.float32),
        visible=visible,
        S=(S - S.mean(2, keepdims=True)).astype(np.float32),
        confidence=np.where(visible, confidence, 0.0),
        xy=np.where(visible[..., None], xy, np.nan),
        points=truth,
        cameras=cameras,
        level=level,
        layout=layout,
    )


def _height(cameras: Cameras, truth: np.ndarray) -> np.ndarray:
    """(N,) pixels: of the body in the image, or its width where that is more; as from afar, without perspective."""
    span = np.ptp(truth[..., :2], axis=1).max(1)
    return cameras.focal * span / np.linalg.norm(cameras.place, axis=1)


def _covered(rays: np.ndarray, views: Views, rng: np.random.Generator) -> np.ndarray:
    """(N,P): behind something in front of the body: beyond a line, from below as a table, from a side as a door."""
    N = len(rays)
    side = rng.choice(3, N, p=[0.7, 0.15, 0.15])
    along = np.where((side == 0)[:, None], rays[..., 1], np.where((side == 1)[:, None], 1, -1) * rays[..., 0])
    low, high = along.min(1, keepdims=True), along.max(1, keepdims=True)
    line = low + rng.uniform(0.35, 1.0, (N, 1)) * (high - low)
    return (rng.random((N, 1)) < views.obstacle) & (along > line)


_BLOCK = 4096
"""Views that are made together."""


def make(
    clips: list[tuple[str, np.ndarray]], views: Views, progress: Callable[[float], object] = lambda share: None
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The 2D arrays of the training file, and the truth (F,3,P) of the same frames.

    Frames with too few visible points to be lifted are left out.
    """
    rng = np.random.default_rng(views.seed)
    joints = np.concatenate([joints[distinct_frames(joints, views.motion)] for _, joints in clips])
    parts, drawn = [], views.views * len(joints)
    for number, block in enumerate(_blocks(len(joints), views.views)):
        seen = see(human_points(other_people(joints[block], views, rng)), views, rng)
        enough = enough_visible(seen.visible, human_layout())
        parts.append((seen.W[enough], seen.visible[enough], seen.S[enough]))
        progress(min(1.0, (number + 1) * _BLOCK / drawn))
    W, visible, S = (np.concatenate(arrays) for arrays in zip(*parts))
    about = {
        "source": "CMU motion capture (mocap.cs.cmu.edu)",
        "layout": human_layout().name,
        "clips": [name for name, _ in clips],
        "poses": len(joints),
        "views": views.to_dict(),
        "left_out": drawn - len(W),
    }
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    return {"W": W, "visible": visible, "calibrated": np.array(True), "about": text}, S


def _blocks(frames: int, times: int) -> Iterator[slice]:
    for _ in range(times):
        yield from (slice(begin, begin + _BLOCK) for begin in range(0, frames, _BLOCK))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m training.human_data",
        description=__doc__.split("\n")[0],
        epilog="settings and their defaults:\n"
        + yaml.safe_dump(Views().to_dict(), default_flow_style=None, sort_keys=False),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="npz files of CMU-31 joints")
    parser.add_argument("-o", "--output", type=Path, required=True, help="2D file for the trainer (.npz)")
    parser.add_argument("--truth", type=Path, help="3D truth of the same frames, for evaluation only (.npz)")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="change a setting of the views")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    args = parser.parse_args()
    try:
        views = Views.from_dict(dict(_override(text) for text in args.set))
    except ViewsError as error:
        print(f"human_data: {error}", file=sys.stderr)
        return 1
    clips = training_clips(read_clips(args.folder))
    with tqdm(
        total=1.0, desc="views", disable=args.quiet, bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}"
    ) as bar:
        arrays, truth = make(clips, views, lambda done: bar.update(done - bar.n))
    _save(args.output, arrays)
    if args.truth:
        _save(args.truth, {**arrays, "S": truth})
    print(f"{args.output}: {len(truth)} frames, {1 - arrays['visible'].mean():.0%} of the points hidden")
    return 0


def _override(text: str) -> tuple[str, object]:
    key, equals, value = text.partition("=")
    if not equals:
        raise ViewsError(f"'{text}' is no setting: write key=value")
    try:
        return key.strip(), yaml.safe_load(value)
    except yaml.YAMLError:
        raise ViewsError(f"the value in '{text}' is no YAML") from None


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_atomically(path, buffer.getvalue())


if __name__ == "__main__":
    raise SystemExit(main())
