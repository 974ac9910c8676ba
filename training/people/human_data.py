# SPDX-License-Identifier: Apache-2.0
"""2D training frames of people: CMU motion capture seen by random robot cameras and an imperfect detector.

    python -m training.people.human_data CMU_FOLDER -o human2d.npz [--truth human3d.npz] [--set KEY=VALUE ...]

CMU_FOLDER holds, at any depth, what mocap.cs.cmu.edu offers: ``01_05.amc`` with ``01.asf`` beside it, or ``01_05.bvh``
as cgspeed converted it; or npz files of CMU-31 joints: ``S_world`` (F,31,3) metres, y up, with ``trial_names`` and
``trial_len``, or ``S_root`` with ``seq_names`` and ``seq_len`` for root-relative clips.  Only the 2D file is for the
trainer; the 3D truth of the same frames goes to another file, for evaluation.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from msg_adapters.keypoints import Intrinsics
from paul_ros.errors import BagError, NpzError
from paul_ros.files import read_npz, write_atomically
from paul_ros.model import enough_visible
from paul_ros.offline.bag import check_outputs
from paul_ros.placement import centred_view
from training.errors import MocapError, RecipeError, ViewsError
from training.people.asf_amc import Skeleton, read_amc, read_asf
from training.people.bvh import read_bvh
from training.people.cameras import Cameras, hidden_by_body, random_cameras
from training.people.detector import detect, redefined, reported
from training.people.mocap import CMU31, PARENTS, check_size, human_layout, human_points
from training.people.view_settings import Views
from training.recipe import Recipe

HELD_OUT = ("02", "03", "27", "29", "01_12", "01_13", "01_14", "05_17", "05_18", "05_19", "05_20")
"""Subjects and trials that no training frame comes from; those of 01 and 05 are the unseen split of the literature."""


def read_clips(folder: Path, progress: Callable[[float], object] = lambda share: None) -> list[tuple[str, np.ndarray]]:
    """(name, joints (F,31,3) in metres, y up) of every clip in the folder and the folders in it.

    Raises:
        MocapError: there is none, or a file cannot be used; says what to do.
    """
    files = _files(folder)
    clips: dict[str, np.ndarray] = {}
    skeletons: dict[Path, Skeleton] = {}
    for number, file in enumerate(files, 1):
        for name, joints in _clips_of(file, skeletons):
            clips[name] = joints
        progress(number / len(files))
    return list(clips.items())


def motion_files(folder: Path) -> list[Path]:
    """All files of motion capture below the folder; of trials of one name the last is taken, .npz before .amc."""
    return [file for kind in ("bvh", "amc", "npz") for file in sorted(folder.rglob(f"*.{kind}"))]


def _files(folder: Path) -> list[Path]:
    """The same, where there are any; else MocapError."""
    if files := motion_files(folder):
        return files
    raise MocapError(
        f"'{folder}' holds no motion capture: neither .amc beside their .asf, nor .bvh, nor .npz of CMU joints"
    )


def _clips_of(file: Path, skeletons: dict[Path, Skeleton]) -> Iterator[tuple[str, np.ndarray]]:
    """The clips of one file; skeletons: those read before, and this file's after."""
    if file.suffix == ".npz":
        yield from _npz_clips(file)
    elif file.suffix == ".bvh":
        yield file.stem, read_bvh(file)
    else:
        path = _skeleton_of(file)
        if path not in skeletons:
            skeletons[path] = read_asf(path)
        yield file.stem, read_amc(file, skeletons[path])


def _skeleton_of(amc: Path) -> Path:
    """The .asf of subject 02 for 02_01.amc in its folder; else the only one there."""
    own, there = amc.with_name(f"{amc.stem.partition('_')[0]}.asf"), sorted(amc.parent.glob("*.asf"))
    if own not in there and len(there) != 1:
        raise MocapError(f"{amc}: no {own.name} beside it: get the subject's skeleton as well")
    return own if own in there else there[0]


def _npz_clips(file: Path) -> Iterator[tuple[str, np.ndarray]]:
    try:
        arrays = read_npz(file, (), ("S_world", "trial_names", "trial_len", "S_root", "seq_names", "seq_len"))
    except NpzError as error:
        raise MocapError(f"{file}: {error}") from None
    kind, key = ("trial", "S_world") if "S_world" in arrays else ("seq", "S_root")
    if missing := [name for name in (key, f"{kind}_names", f"{kind}_len") if name not in arrays]:
        raise MocapError(f"{file}: no array {missing[0]}; needed are S_world, trial_names and trial_len")
    joints, names, lengths = arrays[key], arrays[f"{kind}_names"].tolist(), arrays[f"{kind}_len"]
    if joints.ndim != 3 or joints.shape[1:] != (len(CMU31), 3) or joints.dtype.kind != "f":
        raise MocapError(f"{file}: {key} must be numbers (F,{len(CMU31)},3), it is {joints.dtype} {joints.shape}")
    if (
        len(names) != len(lengths)
        or lengths.dtype.kind not in "iu"
        or (lengths < 1).any()
        or lengths.sum() != len(joints)
    ):
        raise MocapError(f"{file}: {kind}_len must be the frames of each of {kind}_names, {len(joints)} together")
    if not np.isfinite(joints).all():
        raise MocapError(f"{file}: {key} holds NaN or infinite numbers: leave such frames out")
    yield from zip(map(str, names), np.split(check_size(file, joints), np.cumsum(lengths)[:-1]))


def training_clips(clips: list[tuple[str, np.ndarray]]) -> list[tuple[str, np.ndarray]]:
    """The clips that are neither held out nor copies of held-out ones under another name."""
    held_out = [joints for name, joints in clips if name.startswith(HELD_OUT)]
    others = [(name, joints) for name, joints in clips if not name.startswith(HELD_OUT)]
    if not held_out:
        return others
    known = np.concatenate([_limb_angles(joints) for joints in held_out])
    key = int(known.std(0).argmax())
    known = known[known[:, key].argsort()]
    return [(name, joints) for name, joints in others if not _is_copy(joints, known, key)]


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


_SAME = 0.02
"""Poses whose limbs' cosines differ by less are one, to rounding."""


def _is_copy(joints: np.ndarray, known: np.ndarray, key: int) -> bool:
    """Most of some sampled poses occur among the known ones (N,28), which are sorted by the angle ``key``."""
    found = []
    for pose in _limb_angles(joints[:: max(1, len(joints) // 12)]):
        begin, end = np.searchsorted(known[:, key], [pose[key] - _SAME, pose[key] + _SAME])
        found.append((np.abs(known[begin:end] - pose).max(1) < _SAME).any())
    return float(np.mean(found)) > 0.5


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
        marked: (N,2,P) float32 the rays of all points as they truly are, NaN of those too near to that camera.
        S: (N,3,P) float32 the truth in those virtual cameras' frames, metres, centred on the mean of all points.
        confidence: (N,P), 0 where hidden.
        xy: (N,P,2) pixels, with the errors; NaN where hidden.
        points: (N,P,3) the truth in the optical frame, metres.
        cameras: the real cameras.
        level: (N,) of the detector's errors. layout: (N,) index of its layout in ``views.layouts``.
    """

    W: np.ndarray
    visible: np.ndarray
    marked: np.ndarray
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
    depth = S[:, 2:]
    return Seen(
        W=np.where(visible[:, None], view.W, 0).astype(np.float32),
        visible=visible,
        marked=np.where(depth > _TOO_NEAR, S[:, :2] / np.maximum(depth, _TOO_NEAR), np.nan).astype(np.float32),
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


_TOO_NEAR = 0.3  # metres before the camera

_BLOCK = 4096
"""Views that are made together."""


def make(
    clips: list[tuple[str, np.ndarray]], views: Views, progress: Callable[[float], object] = lambda share: None
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The 2D arrays of the training file, and those of a file of the same frames with their truth S (F,3,P).

    The trainer is given all points as they truly are in the image, W, and as the detector reports them, ``detected``;
    what is judged is the detector's report alone.  Frames with too few visible points to be lifted are left out.

    Raises:
        MocapError: all of them are.
    """
    rng = np.random.default_rng(views.seed)
    joints = np.concatenate([joints[distinct_frames(joints, views.motion)] for _, joints in clips])
    parts, drawn = [], views.views * len(joints)
    for number, block in enumerate(_blocks(len(joints), views.views)):
        seen = see(human_points(other_people(joints[block], views, rng)), views, rng)
        enough = enough_visible(seen.visible, human_layout())
        parts.append(tuple(array[enough] for array in (seen.W, seen.visible, seen.marked, seen.S)))
        progress(min(1.0, (number + 1) * _BLOCK / drawn))
    W, visible, marked, S = (np.concatenate(arrays) for arrays in zip(*parts))
    if not len(W):
        raise MocapError(
            f"none of the {drawn} views shows enough points to be lifted: lower views.hidden, which is "
            f"{list(views.hidden)}, views.obstacle, {views.obstacle}, or views.min_confidence, {views.min_confidence}"
        )
    about = {
        "source": "CMU motion capture (mocap.cs.cmu.edu)",
        "layout": human_layout().name,
        "clips": [name for name, _ in clips],
        "poses": len(joints),
        "views": views.to_dict(),
        "left_out": drawn - len(W),
    }
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    common = {"calibrated": np.array(True), "about": text}
    detected = np.where(visible[:, None], W, np.float32(np.nan))
    return {"W": marked, "detected": detected, **common}, {"W": W, "visible": visible, "S": S, **common}


def _blocks(frames: int, times: int) -> Iterator[slice]:
    for _ in range(times):
        yield from (slice(begin, begin + _BLOCK) for begin in range(0, frames, _BLOCK))


FORMAT = 1
"""Of the views: raised whenever the same files and settings come to give others, so that kept ones are made anew."""


def make_file(folder: Path, views: Views, path: Path, truth: Path | None = None, quiet: bool = False) -> None:
    """Write the training file of a folder of motion capture, and the truth if it is named.

    A file that was made by this format, from files of the same names and contents with the same settings, is left.

    Raises:
        MocapError: the folder holds none, a file of it cannot be used, or the views show nothing.
    """
    made = {"format": FORMAT, "files": _digest(folder), "views": views.to_dict()}
    if truth is None and _made_of(path) == made:
        return
    with _bar("motion capture", quiet) as progress:
        clips = training_clips(read_clips(folder, progress))
    if not clips:
        raise MocapError(f"'{folder}' holds only trials that are kept for judging ({', '.join(HELD_OUT)})")
    with _bar("views", quiet) as progress:
        arrays, judged = make(clips, views, progress)
    about = {**json.loads(arrays["about"].tobytes()), **made}
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    _save(path, arrays)
    if truth:
        _save(truth, judged)


def _digest(folder: Path) -> str:
    """Of the names and contents of the files, skeletons included; raises MocapError."""
    whole = hashlib.sha256()
    for file in (*_files(folder), *sorted(folder.rglob("*.asf"))):
        whole.update(f"{file.relative_to(folder)}\n{_content(file)}\n".encode())
    return whole.hexdigest()


def _content(file: Path) -> str:
    """A digest of one file, which need not fit into memory."""
    digest = hashlib.sha256()
    try:
        with file.open("rb") as stream:
            while part := stream.read(1 << 20):
                digest.update(part)
    except OSError as error:
        raise MocapError(f"{file}: cannot be read: {error.strerror}") from None
    return digest.hexdigest()


def _made_of(path: Path) -> dict | None:
    """Of what a file was made, if it is there and says so."""
    try:
        about = json.loads(read_npz(path, ("about",))["about"].tobytes())
        return {name: about[name] for name in ("format", "files", "views")}
    except (NpzError, ValueError, KeyError, TypeError):
        return None


@contextlib.contextmanager
def _bar(what: str, quiet: bool) -> Iterator[Callable[[float], object]]:
    """A bar that is told the share of the work that is done."""
    layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
    interval = 0.1 if sys.stderr.isatty() else 30.0
    with tqdm(total=1.0, desc=what, disable=quiet, mininterval=interval, bar_format=layout) as bar:
        yield lambda done: bar.update(done - bar.n)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m training.people.human_data", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="motion capture: .asf and .amc, .bvh, or npz of CMU joints")
    parser.add_argument("-o", "--output", type=Path, required=True, help="2D file for the trainer (.npz)")
    parser.add_argument("--truth", type=Path, help="3D truth of the same frames, for evaluation only (.npz)")
    parser.add_argument("--recipe", default="human", help="whose views are taken (default: %(default)s)")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="as views.distance=[1,3]")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    args = parser.parse_args()
    try:
        views = views_of(Recipe.load(args.recipe, args.set))
        _check_files(args.folder, (args.output, args.truth), args.recipe)
        make_file(args.folder, views, args.output, args.truth, args.quiet)
        detected = read_npz(args.output, ("detected",))["detected"]
    except (MocapError, RecipeError, BagError, OSError, NpzError) as error:
        print(f"human_data: {error}", file=sys.stderr)
        return 1
    missing = np.isnan(detected[:, 0]).mean()
    print(f"{args.output}: {len(detected)} frames, {missing:.0%} of the points not detected")
    return 0


def _check_files(folder: Path, outputs: tuple[Path | None, ...], recipe: str) -> None:
    """Raises MocapError or BagError where an output cannot be written or would cost what is read or another output."""
    for path in filter(None, outputs):
        if path.suffix != ".npz":
            raise MocapError(f"the file must end in .npz, not '{path.name}'")
        if not path.parent.is_dir():
            raise MocapError(f"cannot write {path}: there is no folder '{path.parent}'; make it first")
    check_outside(folder, outputs)
    check_outputs(outputs, [*_files(folder), recipe])


def check_outside(folder: Path, outputs: Iterable[Path | None]) -> None:
    """Raises MocapError for an output in the folder of motion capture, where the next run would take it for some."""
    for path in filter(None, outputs):
        if folder.resolve() in path.resolve().parents:
            raise MocapError(f"{path} lies in '{folder}' and would be read as motion capture; write it elsewhere")


def views_of(recipe: Recipe) -> Views:
    """Return the recipe's settings of views.

    Raises:
        RecipeError: it has none, or they cannot be used.
    """
    if recipe.views is None:
        raise RecipeError("a folder of motion capture needs a recipe that says how people are seen: --recipe human")
    try:
        return Views.from_dict(recipe.views)
    except ViewsError as error:
        raise RecipeError(str(error)) from None


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_atomically(path, buffer.getvalue())


if __name__ == "__main__":
    raise SystemExit(main())
