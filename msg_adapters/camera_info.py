# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo as the pinhole intrinsics of the rectified image."""

from __future__ import annotations

import math

import numpy as np

from msg_adapters.keypoints import Intrinsics, MessageError

#: The focal length of a camera lies within these multiples of the image's larger side ...
_FOCAL_PER_SIDE = (0.1, 100.0)
#: ... or, where the message does not give the size, within these limits in pixels.
_FOCAL_PIXELS = (10.0, 1e6)


def read_camera_info(msg) -> Intrinsics:
    """Reads focal lengths and principal point (pixels) of the rectified image.

    That is described by P (row-major 3x4), not by K, which is of the raw image. K (row-major 3x3) is used only
    where P is not filled: its focal lengths are not positive, or a number of it is not finite. The result says
    which it was, and whether K then comes with distortion that nobody corrects. Source: the comments of
    sensor_msgs/CameraInfo.

    Raises MessageError bad_intrinsics for a focal length or principal point that no camera has: zero as of an
    uncalibrated camera, not finite, or out of all proportion to the image, as where K is normalised.
    """
    rectified = [float(msg.p[index]) for index in (0, 5, 2, 6)]
    if rectified[0] > 0 and rectified[1] > 0 and all(map(math.isfinite, rectified)):
        matrix, numbers = "P", rectified
    else:
        matrix, numbers = "K", [float(msg.k[index]) for index in (0, 4, 2, 5)]
    width, height = int(msg.width), int(msg.height)
    _check(matrix, *numbers, max(width, height))
    return Intrinsics(*numbers, width, height, matrix, distorted=matrix == "K" and bool(np.any(msg.d)))


def _check(matrix: str, fx: float, fy: float, cx: float, cy: float, side: int) -> None:
    least, most = (limit * side for limit in _FOCAL_PER_SIDE) if side else _FOCAL_PIXELS
    # Comparisons with NaN are false. A cropped image may have its principal point outside, but not that far.
    if not (least <= fx <= most and least <= fy <= most and abs(cx) <= most and abs(cy) <= most):
        raise MessageError(
            "bad_intrinsics",
            f"CameraInfo's {matrix} has fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}; in pixels of this image focal "
            f"lengths lie within {least:g} and {most:g}; calibrate the camera or correct its driver",
        )
