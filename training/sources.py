# SPDX-License-Identifier: Apache-2.0
"""The kind of data of `paul train`, decided once: a folder of motion capture, or files of 2D keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from paul_ros.layout import load_layout
from paul_ros.offline.bag_folder import METADATA, bag_files, is_bag
from training.categories import load_files
from training.data import TrainingData
from training.errors import DataError
from training.options import TrainingOptions


def is_motion_capture(paths: Sequence[Path]) -> bool:
    """Return whether the data is one folder that holds files of motion capture and is no bag."""
    path = Path(paths[0])
    if len(paths) > 1 or not path.is_dir() or (path / METADATA).exists() or bag_files(path):
        return False
    from training.people.clips import motion_files

    return bool(motion_files(path))


def load_keypoints(options: TrainingOptions) -> TrainingData:
    """Load npz files and bags.

    Raises:
        DataError, BagError, LayoutError: see ``load_files``; or a folder holds no data.
    """
    for path in options.data:
        _check_folder(Path(path))
    layout = load_layout(options.layout) if options.layout else None
    return load_files(
        options.data, layout, options.topic, options.min_confidence, options.camera_info_topic, options.image
    )


def _check_folder(path: Path) -> None:
    """Raise DataError if the path is a folder without anything that may be a recording."""
    if path.is_dir() and not any(is_bag(child) for child in path.iterdir()):
        raise DataError(
            f"{path}: no recording in this folder (.mcap, .db3), and no motion capture (.asf with .amc, .bvh, .npz)"
        )
