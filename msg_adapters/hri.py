# SPDX-License-Identifier: Apache-2.0
"""hri_msgs/Skeleton2D (ROS4HRI, REP-155): one body per message, each body on its own topic.

Coordinates are normalised by the image's width and height. They become pixels here, with the size from CameraInfo:
normalised coordinates are distorted by the aspect ratio and cannot be lifted. The 18 points have their own order; left
and right of eyes and ears are swapped against OpenPose's. Points are placed by name. The topic has the body's id.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, by_name, record

# fmt: off
#: The order of the message (constants of hri_msgs/Skeleton2D).
NAMES = (
    "nose", "neck",
    "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist",
    "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle",
    "left_eye", "right_eye", "left_ear", "right_ear",
)
# fmt: on
_TOPIC = re.compile(r"/humans/bodies/([^/]+)/skeleton2d")
#: Detectors guess points outside the image. Points more than one image size outside are ignored.
_MIN_COORDINATE, _MAX_COORDINATE = -1.0, 2.0


def read(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read one body.

    Field: skeleton[18] with x, y (0 to 1 from the image's top left corner) and c (0 to 1). A point with c = 0 is
    missing, also one that was never filled.

    Raises:
        MessageError: no_image_size, not_normalised, wrong_skeleton_size, no_common_names.
    """
    values = np.array([(point.x, point.y, point.c) for point in msg.skeleton], dtype=np.float64)
    if len(values) != len(NAMES):
        raise MessageError(
            "wrong_skeleton_size",
            f"the skeleton has {len(values)} keypoints; hri_msgs/Skeleton2D needs {len(NAMES)}, with c = 0 for missing "
            "ones",
        )
    seen = values[:, 2] > 0
    far = np.any((values[:, :2] < _MIN_COORDINATE) | (values[:, :2] > _MAX_COORDINATE), axis=1)
    _check_normalised(seen, far)
    values[far | ~seen] = np.nan
    placed = by_name(values, NAMES, source.names)[None]
    ids = (_body_id(source.topic),)
    return record(placed[..., :2] * _size(source), placed[..., 2], ids, msg.header, placeholders=False)


def _check_normalised(seen: np.ndarray, far: np.ndarray) -> None:
    """Refuse a skeleton if most points lie far outside the image: then they are pixels."""
    if 2 * (seen & far).sum() > seen.sum():
        raise MessageError(
            "not_normalised",
            f"{(seen & far).sum()} of {seen.sum()} keypoints lie far outside 0..1; hri_msgs has normalised "
            "coordinates, so divide pixels by the image's width and height",
        )


def _size(source: Source) -> tuple[int, int]:
    if source.image_size is None or min(source.image_size) <= 0:
        raise MessageError(
            "no_image_size",
            "hri_msgs has normalised coordinates, and no CameraInfo has given the image size yet; publish or record "
            "that of the detector's camera, and remap `camera_info` to it",
        )
    return source.image_size


def _body_id(topic: str) -> str:
    """Return the id in /humans/bodies/ID/skeleton2d, or '' for any other topic."""
    found = _TOPIC.search(topic)
    return found[1] if found else ""
