# SPDX-License-Identifier: Apache-2.0
"""hri_msgs/Skeleton2D (ROS4HRI, REP-155): one message is one body, on a topic of its own.

Coordinates are shares of the image's width and height and become pixels here, so a CameraInfo must have told the
size: shares themselves are squeezed by the image's aspect and cannot be lifted. The 18 points are in an order
of their own, with left and right of eyes and ears swapped against OpenPose's, and are placed by name. The body's id is
not in the message but in its topic.
"""

from __future__ import annotations

import re

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
#: Detectors guess points outside of the image; one that is more than another image away is not worth having.
_LEAST, _MOST = -1.0, 2.0


def read(msg, points: int, source: Source) -> Keypoints2D:
    """Reads one body of a layout with `points` keypoints.

    Field: skeleton[18] with x, y (0..1 from the image's top left corner) and c (0..1; 0 = missing, as in a point that
    was never filled). Raises MessageError: no_image_size, not_normalised, wrong_skeleton_size, no_common_names.
    """
    shares = np.array([(point.x, point.y, point.c) for point in msg.skeleton], dtype=np.float64)
    if len(shares) != len(NAMES):
        raise MessageError(
            "wrong_skeleton_size",
            f"the skeleton has {len(shares)} keypoints; hri_msgs/Skeleton2D has {len(NAMES)}, whatever was not seen",
        )
    seen = shares[:, 2] > 0
    far = ((shares[:, :2] < _LEAST) | (shares[:, :2] > _MOST)).any(axis=1)
    _check(seen, far)
    shares[far | ~seen] = np.nan
    placed = by_name(shares, NAMES, source.names)[None]
    return record(placed[..., :2] * _size(source), placed[..., 2], (_body_id(source.topic),), msg.header)


def _check(seen: np.ndarray, far: np.ndarray) -> None:
    """One point may be far off; where most are, they are pixels."""
    if 2 * (seen & far).sum() > seen.sum():
        raise MessageError(
            "not_normalised",
            f"{(seen & far).sum()} of {seen.sum()} keypoints are no shares of the image; hri_msgs has x and y in 0..1, "
            "so divide pixels by the image's width and height",
        )


def _size(source: Source) -> tuple[int, int]:
    if source.image_size is None or min(source.image_size) <= 0:
        raise MessageError(
            "no_image_size",
            "hri_msgs has shares of the image, whose width and height no CameraInfo has told yet; publish or record "
            "that of the detector's camera, and remap `camera_info` to it",
        )
    return source.image_size


def _body_id(topic: str) -> str:
    """The id in /humans/bodies/ID/skeleton2d; '' from any other topic."""
    found = _TOPIC.search(topic)
    return found[1] if found else ""
