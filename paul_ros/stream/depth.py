# SPDX-License-Identifier: Apache-2.0
"""Persons put where a depth camera sees their root.

The image fixes a person but for its size: twice as large and twice as far away it looks the same. Where a depth was
measured at the root, the person is moved along the rays of its points until its root has that depth; its size follows.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from msg_adapters import DepthImage, Intrinsics
from paul_ros.lifted import Lifted

SURFACE = 0.12
"""Metres that the middle of people's hips lies behind the skin that is measured, half of the depth of adults there,
about 0.25 m (buttock depth; Gordon et al., 2012 Anthropometric Survey of U.S. Army Personnel, 2014)."""

SIGMA = 0.08
"""Metres: who stands sideways is half as broad as deep again, and clothes and arms hang before the hips."""

SIZES = (0.4, 1.4)
"""Who would have to be smaller or larger than so many times what the model has is not what was measured."""

_WINDOW = 0.04  # metres, half the side of the window
_NEAR = 20_000_000  # ns between the stamps of an image and its depths
_SET_BACK = 10**9  # ns
_KEPT = 15  # images, half a second at 30 Hz: so far behind may a detector be


class Depths:
    """The last depth images, and what they say of lifted persons."""

    def __init__(self) -> None:
        self._images: deque[DepthImage] = deque(maxlen=_KEPT)

    def add(self, image: DepthImage) -> None:
        """One more; where it is a second and more older than the last, the clock was set back, and all start anew."""
        if self._images and image.stamp < self._images[-1].stamp - _SET_BACK:
            self._images.clear()
        self._images.append(image)

    def place(
        self, lifted: Lifted, stamp: int, camera: Intrinsics | None, surface: float
    ) -> tuple[Lifted, dict[str, int]]:
        """Persons at their measured distance where there is one, and how many were moved and how many it cannot be of.

        surface: metres from what is measured to the root. Without metres, or depths of that stamp, none is moved; what
        is wrong with the images is told by its name.
        """
        image = min(self._images, key=lambda image: abs(image.stamp - stamp), default=None)
        if image is None or camera is None or lifted.units != "m" or not lifted.ok.any():
            return lifted, {}
        if abs(image.stamp - stamp) > _NEAR:
            return lifted, {"depth_of_another_time": 1}
        if camera.width and image.values.shape != (camera.height, camera.width):
            return lifted, {"depth_of_another_size": 1}
        depth = np.array([_measured(image, root, camera) for root in lifted.root]) + surface
        factor = depth / lifted.root[:, 2]
        known = np.isfinite(factor)
        with np.errstate(invalid="ignore"):
            used = known & (factor >= SIZES[0]) & (factor <= SIZES[1])
        factor = np.where(used, factor, 1.0)
        moved = replace(
            lifted,
            points=lifted.points * factor[:, None, None],
            root=lifted.root * factor[:, None],
            distance_sigma=np.where(used, SIGMA, lifted.distance_sigma),
        )
        return moved, {"depth_used": int(used.sum()), "depth_disagrees": int((known & ~used).sum())}


def _measured(image: DepthImage, root: np.ndarray, camera: Intrinsics) -> float:
    """Metres along the optical axis where the root is seen; NaN where nothing was measured."""
    x, y, z = root.tolist()
    if not z > 0:  # behind the camera, or not lifted
        return np.nan
    radius = max(1, round(_WINDOW * camera.fx / z))
    return image.at(camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, radius)
