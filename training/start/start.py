# SPDX-License-Identifier: Apache-2.0
"""The start of a run: 3D shapes of some frames, found from 2D alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Start:
    """Shapes that the networks first learn to give.

    Attributes:
        rows: (n,) numbers of the frames that have a shape.
        shapes: (n,3,P) in one canonical frame, centred on the visible points. ``rotations @ shapes`` fits image points
            of root mean square coordinate 1.
        rotations: (n,3,3) from the canonical to the camera frame, det +1.
        score: mean negative log likelihood of a frame. Lower is better; seeds are comparable.
        seconds: duration of the search.
    """

    rows: np.ndarray
    shapes: np.ndarray
    rotations: np.ndarray
    score: float
    seconds: float = 0.0

    def mirrored(self) -> Start:
        """Explain the same views by the mirror images of the shapes; orthographic views fit both alike."""
        flip = np.diag([1, 1, -1]).astype(np.float32)
        return replace(self, shapes=flip @ self.shapes, rotations=flip @ self.rotations @ flip)
