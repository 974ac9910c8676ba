# SPDX-License-Identifier: Apache-2.0
"""yolo_msgs/DetectionArray (yolo_ros; formerly yolov8_msgs): pixels, ids if tracking is on.

A detection's keypoint list is sparse and its ids count from 1. Points are placed by id, never by position in the list.
A point at exactly (0, 0) or (-1, -1) is missing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, UnknownLayout, WrongPointCount, record

#: Points of the usual pose models, COCO's.
_COCO = 17


def read(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read detections; one without keypoints is a person without visible points.

    Raises:
        MessageError: wrong_point_count (an id beyond the layout), wrong_keypoint_id (an id below 1), layout_unknown.
    """
    persons = len(msg.detections)
    xy = np.zeros((persons, points, 2))
    confidence = np.zeros((persons, points))
    for person, detection in enumerate(msg.detections):
        for keypoint in detection.keypoints.data:
            column = _column(int(keypoint.id), points, source)
            xy[person, column] = keypoint.point.x, keypoint.point.y
            confidence[person, column] = keypoint.score
    ids = tuple(str(detection.id) for detection in msg.detections)
    return record(xy, confidence, ids, msg.header)


def _column(keypoint_id: int, points: int, source: Source) -> int:
    """Return the layout's column of a 1-based keypoint id."""
    if keypoint_id > _COCO and sum(other >= keypoint_id for other in source.candidates) > 1:
        # The list is sparse, so the largest id does not tell the number of points.
        raise UnknownLayout(
            f"keypoint id {keypoint_id} is beyond COCO's {_COCO} keypoints, so the detector has a layout of its own",
            lambda other: other >= keypoint_id,
        )
    if keypoint_id < 1:
        raise MessageError(
            "wrong_keypoint_id",
            f"a keypoint has the id {keypoint_id}; yolo_msgs counts from 1, correct the detector",
        )
    if keypoint_id > points:
        raise WrongPointCount(
            f"keypoint id {keypoint_id} is beyond the {points} keypoints of the layout",
            lambda other: other >= keypoint_id,
        )
    return keypoint_id - 1
