# SPDX-License-Identifier: Apache-2.0
"""Placement of persons at the distance that a depth camera measures at their root.

An image fixes a person up to its size: a person twice as large and twice as far away looks the same. If a depth was
measured at the root, the person moves along the rays of its points until its root has that depth. Its size follows.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from msg_adapters import DepthImage, Intrinsics
from paul_ros.lifted import Lifted
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.reasons import REASONS

SURFACE = 0.12
"""Metres from the measured skin to the middle of a person's hips: half of the depth of adults there, about 0.25 m.
Source: buttock depth in Gordon et al., 2012 Anthropometric Survey of U.S. Army Personnel, 2014."""

SIGMA = 0.08
"""Metres, standard deviation of SURFACE. Hips are 1.5 times as broad as deep, so their middle lies farther behind the
skin of a person who stands sideways. Clothes and arms before the hips add to it."""

SIZES = (0.4, 1.4)
"""Limits of a person's size over the model's size. A depth that implies another size is ignored."""

_WINDOW = 0.04  # metres, half the side of the window
_NEAR = 20_000_000  # ns between the stamps of an image and its depths
_SET_BACK = 10**9  # ns
_KEPT = 15  # images, half a second at 30 Hz: the longest delay of a detector that is served


class DepthBuffer:
    """The last depth images, searched by stamp."""

    def __init__(self) -> None:
        self._images: deque[DepthImage] = deque(maxlen=_KEPT)

    def add(self, image: DepthImage) -> None:
        """Add an image. If it is at least a second older than the last one, the clock was set back: forget the rest."""
        if self._images and image.stamp < self._images[-1].stamp - _SET_BACK:
            self._images.clear()
        self._images.append(image)

    def place(self, lifted: Lifted, stamp: int, camera: Intrinsics | None, surface: float, ledger: Ledger) -> Lifted:
        """Move persons to their measured distance.

        Persons stay where they are if they have no metres, if no depth was measured, or if it implies an impossible
        size.

        Args:
            lifted: N persons.
            stamp: of their keypoints, nanoseconds.
            camera: of their image, to which the depth images are aligned.
            surface: metres from the measured surface to the root.
            ledger: notes how many depths were used and ignored, and images that cannot be used.
        """
        image = min(self._images, key=lambda image: abs(image.stamp - stamp), default=None)
        if image is None or camera is None or lifted.units != "m" or not lifted.ok.any():
            return lifted
        if abs(image.stamp - stamp) > _NEAR:
            ledger.note("depth_of_another_time", REASONS["depth_of_another_time"].advice)
            return lifted
        if camera.width and image.values.shape != (camera.height, camera.width):
            ledger.note("depth_of_another_size", REASONS["depth_of_another_size"].advice)
            return lifted
        depth = np.array([_measured(image, root, camera) for root in lifted.root]) + surface
        factor = depth / lifted.root[:, 2]
        known = np.isfinite(factor)
        with np.errstate(invalid="ignore"):
            used = known & (factor >= SIZES[0]) & (factor <= SIZES[1])
        ledger.note("depth_used", count=int(used.sum()))
        ledger.note("depth_disagrees", count=int((known & ~used).sum()))
        factor = np.where(used, factor, 1.0)
        return replace(
            lifted,
            points=lifted.points * factor[:, None, None],
            root=lifted.root * factor[:, None],
            distance_sigma=np.where(used, SIGMA, lifted.distance_sigma),
        )


def _measured(image: DepthImage, root: np.ndarray, camera: Intrinsics) -> float:
    """Return the metres along the optical axis at a root (3,); NaN if none were measured."""
    x, y, z = root.tolist()
    if not z > 0:  # behind the camera, or not lifted
        return np.nan
    radius = max(1, round(_WINDOW * camera.fx / z))
    u, v = camera.to_image(np.array((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy))).tolist()
    return image.at(u, v, radius)
