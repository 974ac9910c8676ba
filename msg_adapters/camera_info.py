# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo as the pinhole camera of the keypoints' image.

CameraInfo describes two images: the raw one by K and D, and the rectified one by P. It does not say which of them a
detector sees; `read_camera_info` has the rule. All numbers of the message refer to the full resolution of the sensor.
The delivered image is its region of interest, binned. Source: the comments of sensor_msgs/CameraInfo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_adapters.distortion import EQUIDISTANT, Distortion, read_distortion
from msg_adapters.intrinsics import Intrinsics
from msg_adapters.keypoints import MessageError, Note

#: Limits of a focal length in multiples of the image's larger side.
_FOCAL_PER_SIDE = (0.1, 100.0)
#: Limits of a focal length in pixels, for messages without an image size.
FOCAL_PIXELS = (10.0, 1e6)
#: Pixels by which P may differ from a K that was copied to it: calibration files round their numbers.
_COPIED = 0.01
_MAX_BINNING = 16


def read_camera_info(msg: Any, image: str = "auto") -> Intrinsics:
    """Read the pinhole camera of the keypoints' image, and the distortion of that image.

    A rectified image has P (row-major 3x4), or K (row-major 3x3) if P is not filled. A raw image has K and the
    distortion D, which `in_pinhole` corrects; the outputs are then in the raw camera's frame, without R. P is filled if
    its focal lengths are positive and its numbers finite.

    The rule of 'auto', in this order:

    - D is zero or empty, and the model is not equidistant: both images are equal. P is used if it is filled.
    - P is not filled: raw.
    - P equals K: raw, since no rectification leaves K as it is; the driver copied it.
    - Otherwise: rectified, noted as `image_assumed`.

    An equidistant lens bends the image also if its D is zero. An image that is taken as raw for it is noted as
    `image_assumed` too, since drivers may publish rectified images that way.

    Args:
        msg: the message, of rclpy or rosbags.
        image: the image of the keypoints: 'rectified', 'raw', or 'auto'.

    Returns:
        The camera of the delivered image. Its `notes` state what was irregular or assumed.

    Raises:
        MessageError: bad_intrinsics. A number is not finite, is zero (the camera is not calibrated), or is out of
            proportion to the image (K is normalised). Or the region of interest or the binning is impossible.
    """
    window = _window(msg)
    p, k = ([float(matrix[index]) for index in at] for matrix, at in ((msg.p, (0, 5, 2, 6)), (msg.k, (0, 4, 2, 5))))
    filled = p[0] > 0 and p[1] > 0 and all(map(math.isfinite, p))
    has_numbers = bool(np.any(msg.d))
    distorted = has_numbers or str(msg.distortion_model) == EQUIDISTANT
    taken = image if image != "auto" else _likely_image(p, k, filled, distorted)
    matrix, (fx, fy, cx, cy) = ("P", p) if taken == "rectified" and filled else ("K", k)
    _check(matrix, fx, fy, cx, cy, max(int(msg.width), int(msg.height)))
    notes = []
    if image == "auto" and taken == "rectified" and distorted:
        notes.append(Note("image_assumed", _ASSUMED))
    if image == "auto" and taken == "raw" and distorted and not has_numbers:
        notes.append(Note("image_assumed", _IDEAL_FISHEYE))
    if image == "rectified" and not filled and distorted:
        notes.append(Note("rectified_without_p", _WITHOUT_P))
    distortion, uncorrected = _distortion(msg) if taken == "raw" else (None, "")
    if uncorrected:
        text = f"CameraInfo's distortion is not corrected: {uncorrected}. {_CALIBRATE}"
        notes.append(Note("distortion_ignored", text))
    return Intrinsics(
        fx=fx / window.binning_x,
        fy=fy / window.binning_y,
        cx=(cx - window.x) / window.binning_x,
        cy=(cy - window.y) / window.binning_y,
        width=window.size[0],
        height=window.size[1],
        matrix=matrix,
        image=taken,
        distortion=distortion,
        uncorrected=uncorrected,
        notes=tuple(notes),
    )


def image_size(msg: Any) -> tuple[int, int]:
    """Return width and height in pixels of the image that a CameraInfo's camera delivers; 0 = unknown.

    Raises:
        MessageError: bad_intrinsics. The region of interest or the binning is impossible.
    """
    return _window(msg).size


_ASSUMED = (
    "CameraInfo has distortion, and its P differs from K, so the keypoints are taken as those of the rectified image. "
    "Set `image` to raw if the detector sees the raw image, or to rectified to confirm."
)
_IDEAL_FISHEYE = (
    "CameraInfo names the model equidistant, and its D is zero, so the keypoints are taken as those of an ideal "
    "fisheye's raw image. Set `image` to rectified if the detector sees a rectified image, or to raw to confirm."
)
_WITHOUT_P = (
    "`image` is rectified, but P of CameraInfo is not filled, so K is used. Let the camera's driver fill P, or set "
    "`image` to raw."
)
_CALIBRATE = "Calibrate the camera, or let the detector see the rectified image."


@dataclass(frozen=True)
class _Window:
    """The part of the sensor that is delivered, in pixels of full resolution, and its binning."""

    x: int
    y: int
    width: int
    height: int
    binning_x: int
    binning_y: int

    @property
    def size(self) -> tuple[int, int]:
        return self.width // self.binning_x, self.height // self.binning_y


def _window(msg: Any) -> _Window:
    """Return the delivered part of the image; raise MessageError (bad_intrinsics) if there is none such."""
    # 0 is the same as 1, and a region of zeros is the whole image.
    binning = [max(int(value), 1) for value in (msg.binning_x, msg.binning_y)]
    if max(binning) > _MAX_BINNING:
        raise MessageError(
            "bad_intrinsics",
            f"CameraInfo's binning is {binning[0]} x {binning[1]}; no camera has more than {_MAX_BINNING}; correct its "
            "driver",
        )
    full = int(msg.width), int(msg.height)
    x, y, width, height = (int(getattr(msg.roi, name)) for name in ("x_offset", "y_offset", "width", "height"))
    if not (x or y or width or height):
        return _Window(0, 0, *full, *binning)
    fits = all(not side or start + part <= side for start, part, side in zip((x, y), (width, height), full))
    if not (width and height and fits):
        raise MessageError(
            "bad_intrinsics",
            f"CameraInfo's roi is {width} x {height} pixels at ({x}, {y}), and the full image {full[0]} x {full[1]}; "
            "correct the camera's driver: roi counts pixels of the full resolution",
        )
    return _Window(x, y, width, height, *binning)


def _likely_image(p: Sequence[float], k: Sequence[float], filled: bool, distorted: bool) -> str:
    """Return the image of the keypoints by the rule of 'auto'."""
    if not distorted:
        return "rectified" if filled else "raw"
    copied = all(abs(a - b) <= _COPIED for a, b in zip(p, k))
    return "rectified" if filled and not copied else "raw"


def _distortion(msg: Any) -> tuple[Distortion | None, str]:
    """Return the distortion, and why it cannot be used or ''."""
    try:
        return read_distortion(str(msg.distortion_model), msg.d), ""
    except ValueError as error:
        return None, str(error)


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
