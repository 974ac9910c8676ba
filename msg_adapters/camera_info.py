# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo as pinhole intrinsics."""

from __future__ import annotations

import math

from msg_adapters.keypoints import Intrinsics, MessageError


def read_camera_info(msg) -> Intrinsics:
    """Reads focal lengths and principal point (pixels) from the row-major 3x3 matrix K, not the distortion.

    Raises MessageError bad_intrinsics for a focal length that is not positive and finite, as of an
    uncalibrated camera, whose K is all zero.
    """
    fx, fy, cx, cy = (float(msg.k[index]) for index in (0, 4, 2, 5))
    if not (0 < fx < math.inf and 0 < fy < math.inf and math.isfinite(cx) and math.isfinite(cy)):
        raise MessageError(
            "bad_intrinsics",
            f"CameraInfo has fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}: "
            "focal lengths must be positive; calibrate the camera or correct its driver",
        )
    return Intrinsics(fx, fy, cx, cy, int(msg.width), int(msg.height))
