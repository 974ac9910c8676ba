# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo as the pinhole intrinsics of the rectified image."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from msg_adapters.keypoints import Intrinsics, MessageError

#: Limits of a focal length in multiples of the image's larger side.
_FOCAL_PER_SIDE = (0.1, 100.0)
#: Limits of a focal length in pixels, for messages without an image size.
FOCAL_PIXELS = (10.0, 1e6)


def read_camera_info(msg: Any) -> Intrinsics:
    """Read the focal lengths and the principal point, in pixels of the rectified image.

    They come from P (row-major 3x4), which describes the rectified image. K (row-major 3x3) describes the raw image.
    It is the fallback if P's focal lengths are not positive or if one of its numbers is not finite. The result states
    the matrix, and whether K comes with distortion that nobody corrects. Source: the comments of
    sensor_msgs/CameraInfo.

    Raises:
        MessageError: bad_intrinsics. A number is not finite, is zero (the camera is not calibrated), or is out of
            proportion to the image (K is normalised).
    """
    matrix = "P"
    fx, fy, cx, cy = (float(msg.p[index]) for index in (0, 5, 2, 6))
    if not (fx > 0 and fy > 0 and all(map(math.isfinite, (fx, fy, cx, cy)))):
        matrix = "K"
        fx, fy, cx, cy = (float(msg.k[index]) for index in (0, 4, 2, 5))
    width, height = int(msg.width), int(msg.height)
    _check(matrix, fx, fy, cx, cy, max(width, height))
    return Intrinsics(fx, fy, cx, cy, width, height, matrix, distorted=matrix == "K" and bool(np.any(msg.d)))


def _check(matrix: str, fx: float, fy: float, cx: float, cy: float, side: int) -> None:
    shortest, longest = (limit * side for limit in _FOCAL_PER_SIDE) if side else FOCAL_PIXELS
    # Comparisons with NaN are false. The principal point of a cropped image may lie outside, but not that far.
    focal_ok = shortest <= fx <= longest and shortest <= fy <= longest
    if not (focal_ok and abs(cx) <= longest and abs(cy) <= longest):
        raise MessageError(
            "bad_intrinsics",
            f"CameraInfo's {matrix} has fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}; focal lengths of this image must "
            f"be {shortest:g} to {longest:g} pixels; calibrate the camera or correct its driver",
        )
