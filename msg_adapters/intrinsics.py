# SPDX-License-Identifier: Apache-2.0
"""The camera of keypoints: a pinhole camera, and the distortion that lies between it and the image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from msg_adapters.distortion import Distortion
from msg_adapters.keypoints import Keypoints2D, Note


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera, and how pixels of the keypoints' image become pixels of this pinhole camera.

    The numbers are those of the image as it is delivered, after the camera's region of interest and binning.

    Attributes:
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
        width, height: image size in pixels; 0 = unknown.
        matrix: 'P' or 'K', CameraInfo's matrix with these values.
        image: 'rectified' or 'raw', the image of the keypoints.
        distortion: of the raw image, corrected by `to_pinhole`; None for a rectified image or a lens without.
        uncorrected: why a raw image's distortion is not corrected; '' if it is corrected, or if there is none.
        notes: what was irregular in the CameraInfo, or had to be assumed.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    matrix: str = "P"
    image: str = "rectified"
    distortion: Distortion | None = None
    uncorrected: str = field(default="", compare=False)
    notes: tuple[Note, ...] = field(default=(), compare=False)

    def to_pinhole(self, pixels: np.ndarray) -> np.ndarray:
        """Map pixels (...,2) of the keypoints' image to those of the pinhole camera; NaN where no ray leads."""
        if self.distortion is None:
            return pixels
        return self.distortion.undistort((pixels - self._centre) / self._focal) * self._focal + self._centre

    def to_image(self, pixels: np.ndarray) -> np.ndarray:
        """Map pixels (...,2) of the pinhole camera to those of the keypoints' image; NaN where none is defined."""
        if self.distortion is None:
            return pixels
        return self.distortion.distort((pixels - self._centre) / self._focal) * self._focal + self._centre

    @property
    def _centre(self) -> np.ndarray:
        return np.array((self.cx, self.cy))

    @property
    def _focal(self) -> np.ndarray:
        return np.array((self.fx, self.fy))


def in_pinhole(keypoints: Keypoints2D, camera: Intrinsics | None) -> Keypoints2D:
    """Correct the distortion of a camera: map keypoints of its image to pixels of its pinhole camera.

    All code behind the adapters knows only pinhole cameras, so each reader of keypoints calls this right after
    `msg_adapters.read`. Points to which no ray leads become missing.

    Args:
        keypoints: in pixels of the camera's image.
        camera: from `read_camera_info`; None leaves the keypoints as they are.
    """
    if camera is None or camera.distortion is None:
        return keypoints
    xy = np.full_like(keypoints.xy, np.nan)
    xy[keypoints.visible] = camera.to_pinhole(keypoints.xy[keypoints.visible])
    visible = np.isfinite(xy).all(axis=-1)
    return replace(keypoints, xy=xy, confidence=np.where(visible, keypoints.confidence, 0.0), visible=visible)
