# SPDX-License-Identifier: Apache-2.0
"""The check that keypoints lie in the image that CameraInfo states.

If they do not, they come from another camera, or the image was resized on its way to the detector. Distances are then
wrong by the factor of the sizes.
"""

from __future__ import annotations

import numpy as np

from paul_ros.stream.ledger import Ledger
from paul_ros.stream.reasons import REASONS

MARGIN = 0.1
"""Share of the image's side by which points may lie outside: detectors guess points just beyond the border."""

MIN_SHARE = 0.2
"""Share of the points of a message that must lie beyond the margin before they are noted."""

CORNER = 0.55
"""Share of both sides from the upper left corner, in which all points of a halved image lie."""

CORNER_MESSAGES = 300
"""Number of messages whose points must all lie in the corner before it is noted: 10 s at 30 Hz. A level camera sees
the feet of every standing person below the middle of its image."""


class ImageBounds:
    """Compares the keypoints of all messages with the size of the image."""

    def __init__(self) -> None:
        self._restart((0, 0))

    def _restart(self, size: tuple[int, int]) -> None:
        self._size = size
        self._messages = 0
        self._low, self._high = np.zeros(2), np.zeros(2)

    def check(self, xy: np.ndarray, size: tuple[int, int], ledger: Ledger) -> None:
        """Check the visible points of a message.

        Args:
            xy: (M,2) pixels of the image, all finite.
            size: width and height that CameraInfo states; 0 = unknown.
            ledger: takes the notes.
        """
        if not len(xy) or not min(size):
            return
        if size != self._size:
            self._restart(size)
        low, high = xy.min(0), xy.max(0)
        margin = MARGIN * np.array(size)
        outside = (low < -margin).any() or (high > size + margin).any()
        if outside and ((xy < -margin) | (xy > size + margin)).any(1).mean() >= MIN_SHARE:
            self._low = np.minimum(self._low, low)
            self._high = np.maximum(self._high, high)
            ledger.note("outside_image", self._advice())
        elif self._messages < CORNER_MESSAGES:
            self._high = np.maximum(self._high, high)
            self._messages += 1
            if self._messages == CORNER_MESSAGES and (self._high < CORNER * np.array(size)).all():
                ledger.note("corner_of_image", REASONS["corner_of_image"].advice)

    def _advice(self) -> str:
        width, height = self._size
        reach = "x".join(f"{value:.0f}" for value in self._high)
        start = f"from ({self._low[0]:.0f}, {self._low[1]:.0f}) " if self._low.any() else ""
        return (
            f"Keypoints reach {start}to {reach} pixels, but CameraInfo states an image of {width}x{height}: distances "
            f"are wrong if it is another image. {REASONS['outside_image'].fix}"
        )
