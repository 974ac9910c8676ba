# SPDX-License-Identifier: Apache-2.0
"""The check that keypoints lie in the image that CameraInfo states.

If they do not, they come from another camera, or the image was resized on its way to the detector. Distances are then
wrong by the factor of the sizes.
"""

from __future__ import annotations

import math

import numpy as np

from msg_adapters import Keypoints2D
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
        self._low = self._high = (0.0, 0.0)

    def check(self, keypoints: Keypoints2D, min_confidence: float, size: tuple[int, int], ledger: Ledger) -> None:
        """Check the keypoints of a message.

        Args:
            keypoints: in pixels of the image, as the adapter read them.
            min_confidence: points of lower confidence may lie anywhere.
            size: width and height that CameraInfo states; 0 = unknown.
            ledger: takes the notes.
        """
        if size != self._size:
            self._restart(size)
        reach = _reach(keypoints.xy)
        if reach is None or not min(size):
            return
        # Python's numbers, since each message comes here and most go no further.
        (left, top), (right, bottom) = reach
        x_margin, y_margin = MARGIN * size[0], MARGIN * size[1]
        if left < -x_margin or top < -y_margin or right > size[0] + x_margin or bottom > size[1] + y_margin:
            sure = keypoints.visible & (keypoints.confidence >= min_confidence)
            self._check_outside(keypoints.xy[sure], ledger)
        elif self._messages < CORNER_MESSAGES:
            self._messages += 1
            self._high = max(self._high[0], right), max(self._high[1], bottom)
            in_corner = self._high[0] < CORNER * size[0] and self._high[1] < CORNER * size[1]
            if self._messages == CORNER_MESSAGES and in_corner:
                ledger.note("corner_of_image", REASONS["corner_of_image"].advice)

    def _check_outside(self, xy: np.ndarray, ledger: Ledger) -> None:
        """Note a message if enough of its points (M,2) lie outside."""
        margin = MARGIN * np.array(self._size)
        beyond = ((xy < -margin) | (xy > self._size + margin)).any(1)
        reach = _reach(xy)
        if reach is None or beyond.mean() < MIN_SHARE:
            return
        low, high = reach
        self._low = min(self._low[0], low[0]), min(self._low[1], low[1])
        self._high = max(self._high[0], high[0]), max(self._high[1], high[1])
        ledger.note("outside_image", self._advice())

    def _advice(self) -> str:
        width, height = self._size
        reach = "x".join(f"{value:.0f}" for value in self._high)
        start = f"from ({self._low[0]:.0f}, {self._low[1]:.0f}) " if any(self._low) else ""
        return (
            f"Keypoints reach {start}to {reach} pixels, but CameraInfo states an image of {width}x{height}: distances "
            f"are wrong if it is another image. {REASONS['outside_image'].fix}"
        )


def _reach(xy: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the lowest and the highest x and y of pixels (...,2); None if all are NaN."""
    flat = xy.reshape(-1, 2)
    if not len(flat):
        return None
    # One row for all x and one for all y: numpy reduces long rows ten times as fast as short ones.
    rows = np.ascontiguousarray(flat.T)
    low, high = np.fmin.reduce(rows, axis=1).tolist(), np.fmax.reduce(rows, axis=1).tolist()
    return None if math.isnan(low[0]) else (tuple(low), tuple(high))
