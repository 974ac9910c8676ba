# SPDX-License-Identifier: Apache-2.0
"""2D training frames of people: CMU motion capture seen by random robot cameras and an imperfect detector.

    python -m training.people.human_data CMU_FOLDER -o human2d.npz [--truth human3d.npz] [--set KEY=VALUE ...]

CMU_FOLDER holds, at any depth, files of mocap.cs.cmu.edu: ``01_05.amc`` with ``01.asf`` beside it, or cgspeed's
conversion ``01_05.bvh``.  It may also hold npz files of CMU-31 joints: ``S_world`` (F,31,3) in metres, y up, with
``trial_names`` and ``trial_len``, or ``S_root`` with ``seq_names`` and ``seq_len`` for root-relative clips.

The trainer reads the 2D file only.  The 3D truth of the same frames goes to another file, for evaluation.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.errors import NpzError, PaulError
from paul_ros.files import read_npz, write_npz
from paul_ros.normalisation import enough_visible
from paul_ros.output_files import check_outputs
from training.errors import MocapError, RecipeError, ViewsError
from training.people.clips import Clip, read_clips, require_motion_files
from training.people.human_points import human_layout, human_points
from training.people.poses import HELD_OUT, distinct_frames, other_people, training_clips
from training.people.simulated_views import simulate_views
from training.people.view_settings import ViewSettings
from training.progress import Progress, ignore_progress, share_bar
from training.recipe import Recipe

FORMAT = 1
"""Version of the views.

Raise it whenever equal files and settings begin to give other views, so that kept views are made anew.
"""

_BLOCK = 4096
"""Views that are made together."""


def make(
    clips: list[Clip], views: ViewSettings, progress: Progress = ignore_progress
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Make the arrays of the training file, and those of a file of the same frames with their truth.

    The trainer gets ``W``, all points as they truly are in the image, and ``detected``, the points as the detector
    reports them.  Evaluation uses the detector's report only, with the truth S (F,3,P).  Frames with too few visible
    points to be lifted are left out.

    Args:
        clips: motion capture.
        views: settings of the views.
        progress: called with the share of the views that are made.

    Raises:
        MocapError: no view shows enough points.
    """
    rng = np.random.default_rng(views.seed)
    joints = np.concatenate([joints[distinct_frames(joints, views.motion)] for _, joints in clips])
    parts, drawn = [], views.views * len(joints)
    for number, block in enumerate(_blocks(len(joints), views.views)):
        seen = simulate_views(human_points(other_people(joints[block], views, rng)), views, rng)
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
    """Yield slices of all frames, so many times over."""
    for _ in range(times):
        yield from (slice(begin, begin + _BLOCK) for begin in range(0, frames, _BLOCK))


def make_file(folder: Path, views: ViewSettings, path: Path, truth: Path | None = None, quiet: bool = False) -> None:
    """Write the training file of a folder of motion capture, and the truth if it is named.

    An existing training file is kept if it has this format and was made from equal files with equal settings.

    Args:
        folder: of motion capture.
        views: settings of the views.
        path: of the training file.
        truth: path of the truth.
        quiet: show no progress bars.

    Raises:
        MocapError: the folder holds no motion capture, a file cannot be used, or no view shows enough points.
    """
    made = {"format": FORMAT, "files": _digest(folder), "views": views.to_dict()}
    if truth is None and _made_of(path) == made:
        return
    with share_bar(quiet, "motion capture") as progress:
        clips = training_clips(read_clips(folder, progress))
    if not clips:
        raise MocapError(
            f"'{folder}' holds only trials that are kept for evaluation ({', '.join(HELD_OUT)}): add others"
        )
    with share_bar(quiet, "views") as progress:
        arrays, judged = make(clips, views, progress)
    about = {**json.loads(arrays["about"].tobytes()), **made}
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    write_npz(path, arrays)
    if truth:
        write_npz(truth, judged)


def _digest(folder: Path) -> str:
    """Return a digest of the names and contents of all files, skeletons included."""
    whole = hashlib.sha256()
    for file in (*require_motion_files(folder), *sorted(folder.rglob("*.asf"))):
        whole.update(f"{file.relative_to(folder)}\n{_content_digest(file)}\n".encode())
    return whole.hexdigest()


def _content_digest(file: Path) -> str:
    """Return a digest of one file, which need not fit into memory."""
    digest = hashlib.sha256()
    try:
        with file.open("rb") as stream:
            while part := stream.read(1 << 20):
                digest.update(part)
    except OSError as error:
        raise MocapError(f"{file}: cannot be read: {error.strerror}") from None
    return digest.hexdigest()


def _made_of(path: Path) -> dict[str, Any] | None:
    """Return format, digest and settings that a training file was made from; None if it is missing or unreadable."""
    try:
        about = json.loads(read_npz(path, ("about",))["about"].tobytes())
        return {name: about[name] for name in ("format", "files", "views")}
    except (NpzError, ValueError, KeyError, TypeError):
        return None


def views_of(recipe: Recipe) -> ViewSettings:
    """Return the recipe's settings of views.

    Raises:
        RecipeError: it has none, or they cannot be used.
    """
    if recipe.views is None:
        raise RecipeError("a folder of motion capture needs a recipe with settings of views: --recipe human")
    try:
        return ViewSettings.from_dict(recipe.views)
    except ViewsError as error:
        raise RecipeError(str(error)) from None


def check_outside(folder: Path, outputs: Iterable[Path | None]) -> None:
    """Raise MocapError if an output lies in the folder, where the next run would read it as motion capture."""
    for path in filter(None, outputs):
        if folder.resolve() in path.resolve().parents:
            raise MocapError(f"{path} lies in '{folder}' and would be read as motion capture; write it elsewhere")


def _check_files(folder: Path, outputs: tuple[Path | None, ...], recipe: str) -> None:
    """Raise MocapError or BagError if an output cannot be written, or would overwrite an input or another output."""
    for path in filter(None, outputs):
        if path.suffix != ".npz":
            raise MocapError(f"the file must end in .npz, not '{path.name}'")
        if not path.parent.is_dir():
            raise MocapError(f"cannot write {path}: there is no folder '{path.parent}'; make it first")
    check_outside(folder, outputs)
    check_outputs(outputs, [*require_motion_files(folder), recipe])


def _parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m training.people.human_data",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, metavar="CMU_FOLDER", help="folder of motion capture")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="2D file for training (.npz)")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="3D truth of the same frames, for evaluation (.npz)")
    parser.add_argument("--recipe", default="human", help="recipe whose views are used (default: %(default)s)")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="override a setting: views.distance=[1,3]"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress bars")
    return parser


def main() -> int:
    """Run the command; returns its exit code."""
    args = _parser().parse_args()
    try:
        views = views_of(Recipe.load(args.recipe, args.set))
        _check_files(args.folder, (args.output, args.truth), args.recipe)
        make_file(args.folder, views, args.output, args.truth, args.quiet)
        detected = read_npz(args.output, ("detected",))["detected"]
    except (PaulError, OSError) as error:
        print(f"human_data: {error}", file=sys.stderr)
        return 1
    missing = np.isnan(detected[:, 0]).mean()
    print(f"{args.output}: {len(detected)} frames, {missing:.0%} of the points not detected")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
