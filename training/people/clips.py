# SPDX-License-Identifier: Apache-2.0
"""Reader of a folder of motion capture: .amc beside their .asf, .bvh, and .npz of CMU-31 joints. NumPy only."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from paul_ros.errors import NpzError
from paul_ros.files import read_npz
from training.errors import MocapError
from training.people.asf_amc import AsfSkeleton, read_amc, read_asf
from training.people.bvh import read_bvh
from training.people.mocap import CMU31, check_size
from training.progress import Progress, ignore_progress

Clip = tuple[str, np.ndarray]
"""Name of a trial, and its joints (F,31,3) in metres, y up, order ``CMU31``."""


def read_clips(folder: Path, progress: Progress = ignore_progress) -> list[Clip]:
    """Read every clip in the folder and the folders below it.

    Args:
        folder: of motion capture.
        progress: called with the share of the files that are read.

    Raises:
        MocapError: there is no clip, or a file cannot be used.
    """
    files = require_motion_files(folder)
    clips: dict[str, np.ndarray] = {}
    skeletons: dict[Path, AsfSkeleton] = {}
    for number, file in enumerate(files, 1):
        for name, joints in _clips_of(file, skeletons):
            clips[name] = joints
        progress(number / len(files))
    return list(clips.items())


def motion_files(folder: Path) -> list[Path]:
    """Return all files of motion capture in and below the folder.

    If trials share a name, the last one counts: .npz before .amc before .bvh.
    """
    return [file for kind in ("bvh", "amc", "npz") for file in sorted(folder.rglob(f"*.{kind}"))]


def require_motion_files(folder: Path) -> list[Path]:
    """Return all files of motion capture in and below the folder.

    Raises:
        MocapError: there are none.
    """
    if files := motion_files(folder):
        return files
    raise MocapError(
        f"'{folder}' holds no motion capture: neither .amc beside their .asf, nor .bvh, nor .npz of CMU joints"
    )


def _clips_of(file: Path, skeletons: dict[Path, AsfSkeleton]) -> Iterator[Clip]:
    """Yield the clips of one file; ``skeletons`` caches those that were read."""
    if file.suffix == ".npz":
        yield from _npz_clips(file)
    elif file.suffix == ".bvh":
        yield file.stem, read_bvh(file)
    else:
        path = _skeleton_file(file)
        if path not in skeletons:
            skeletons[path] = read_asf(path)
        yield file.stem, read_amc(file, skeletons[path])


def _skeleton_file(amc: Path) -> Path:
    """Return the .asf of a motion: 02.asf for 02_01.amc in the same folder, else the folder's only .asf."""
    own, found = amc.with_name(f"{amc.stem.partition('_')[0]}.asf"), sorted(amc.parent.glob("*.asf"))
    if own not in found and len(found) != 1:
        raise MocapError(f"{amc}: no {own.name} beside it: get the subject's skeleton as well")
    return own if own in found else found[0]


def _npz_clips(file: Path) -> Iterator[Clip]:
    """Yield the clips of an npz: joints of all trials in a row, with the trials' names and lengths."""
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
        raise MocapError(f"{file}: {key} holds NaN or infinite numbers: remove these frames")
    yield from zip(map(str, names), np.split(check_size(file, joints), np.cumsum(lengths)[:-1]))
