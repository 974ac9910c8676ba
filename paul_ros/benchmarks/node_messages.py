# SPDX-License-Identifier: Apache-2.0
"""Messages that `paul benchmark node` sends: poses of the shipped recording, as serialised clouds."""

from __future__ import annotations

import numpy as np

from msg_adapters import outputs, read
from paul_ros.offline.bag_reader import read_records
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.shipped_bags import find_bag

_POINTS = 17
_IMAGE = 1280, 720  # pixels, as in the recording
_FILLED = 0.8  # share of its cell that a person fills
_MESSAGES = 60  # different ones: two seconds of the recording at 30 Hz
_FRAME_ID = "camera_color_optical_frame"


def clouds(persons: int) -> np.ndarray:
    """Return K serialised organised clouds with stamp 0, (K,L) uint8: poses of the recording, spread over the image.

    Raises:
        BagError: the recording is not installed.
    """
    make = BagMessages()
    zero = make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    header = make("std_msgs/msg/Header", stamp=zero, frame_id=_FRAME_ID)
    confidence, ids = np.ones((persons, _POINTS)), np.arange(persons, dtype=np.float32)
    images = spread(_poses(), persons)
    made = (make.serialise(outputs.keypoints_cloud(make, header, xy, confidence, ids)) for xy in images)
    return np.stack([np.frombuffer(data, np.uint8) for data in made])


def spread(poses: np.ndarray, persons: int) -> np.ndarray:
    """Put N of the poses (F,P,2) into each of K images, each pose in its own cell of a grid: (K,N,P,2) pixels."""
    width, height = _IMAGE
    columns = int(np.ceil(np.sqrt(persons * width / height)))
    cell = np.array([width / columns, height / int(np.ceil(persons / columns))])
    size = np.ptp(poses, axis=1)
    fitted = poses * (_FILLED * (cell / size).min(axis=1))[:, None, None]
    fitted -= (fitted.min(axis=1) + fitted.max(axis=1))[:, None] / 2
    person = np.arange(persons)
    centres = (np.stack([person % columns, person // columns], axis=1) + 0.5) * cell
    # Persons are far apart in time, so that no two in an image are alike.
    frames = (np.arange(_MESSAGES)[:, None] + person * len(poses) // persons) % len(poses)
    return fitted[frames] + centres[:, None]


def camera_info() -> np.ndarray:
    """Return the recording's first CameraInfo, serialised, (1,L) uint8."""
    first = next(read_records(find_bag("one_person"), ["/camera_info"]))
    return np.frombuffer(first.data, np.uint8)[None]


def _poses() -> np.ndarray:
    """Return the pixels (F,P,2) of one person whose every point is visible."""
    records = read_records(find_bag("one_person"), ["/keypoints"])
    return np.concatenate([read(record.type_name, record.message(), _POINTS).xy for record in records])
