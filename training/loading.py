# SPDX-License-Identifier: Apache-2.0
"""Load one file of 2D keypoints: npz arrays or a bag."""

from __future__ import annotations

from pathlib import Path

from paul_ros.layout import Layout, load_layout
from paul_ros.stream.parameters import DEFAULTS
from training.bag_input import read_bag
from training.data import DEFAULT_LAYOUT, TrainingData
from training.data_checks import checked
from training.errors import DataError
from training.npz_input import read_arrays

MIN_CONFIDENCE = float(DEFAULTS["min_confidence"])
"""Default of the node's parameter of that name."""


def load_training_data(
    path: str | Path,
    layout: Layout | None = None,
    topic: str | None = None,
    min_confidence: float = MIN_CONFIDENCE,
    camera_info_topic: str | None = None,
    image: str = "auto",
) -> TrainingData:
    """Load 2D keypoints to train on.

    Args:
        path: an ``.npz`` or a bag. An npz has ``W`` (F,2,P) and optionally ``visible`` (F,P) (or NaN in W),
            ``calibrated`` (one bool: W are rays) and ``detected`` (F,2,P). A bag (an ``.mcap`` or a rosbag2 folder) has
            one topic of 2D keypoints of any message type with an adapter; with a CameraInfo it is calibrated.
        layout: of the points. None: coco17 for 17 points and for bags, else an anonymous one, with the optional
            ``edges`` (E,2) of the npz.
        topic: of the keypoints, if the bag has several. It may have * for a part of its name, for families with one
            topic per person: /humans/bodies/*/skeleton2d.
        min_confidence: keypoints of a bag with a lower confidence count as hidden, as in the node.
        camera_info_topic: of the camera of the keypoints, if the bag has several.
        image: of a bag's keypoints, ``auto``, ``rectified`` or ``raw``; see ``msg_adapters.read_camera_info``.

    Raises:
        DataError: nothing to train on, arrays that do not fit the layout, or values that are no image points.
        BagError: the bag cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    if path.suffix == ".npz":
        return checked(read_arrays(path, layout), path, guessed=layout is None)
    named = layout or load_layout(DEFAULT_LAYOUT)
    raw = read_bag(path, named, topic, min_confidence, layout is None, camera_info_topic, image)
    return checked(raw, path, guessed=False)
