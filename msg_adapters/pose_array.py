# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/PoseArray as 2D keypoints: the simplest message that a detector can publish.

position.x and position.y are pixels. position.z is the confidence, 0 to 1, or 0 everywhere if there is none. Detectors'
peaks exceed one slightly, so a z up to 1.05 is a confidence and clipped to 1. Several persons follow one another, each
with all keypoints of the layout. NaN and the default pose (0, 0, 0) mean missing. Persons have no ids.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, record, split_persons

_MAX_CONFIDENCE = 1.05


def read(msg: Any, points: int, _source: Source) -> Keypoints2D:
    """Read poses as 2D keypoints; an array without poses is an image without persons.

    Raises:
        MessageError: not_2d (a z outside 0..1.05 is a depth), wrong_point_count.
    """
    positions = [pose.position for pose in msg.poses]
    persons = split_persons(len(positions), points)
    xyz = np.array([(p.x, p.y, p.z) for p in positions], dtype=np.float64).reshape(persons, points, 3)
    z = xyz[..., 2]
    if ((z < 0) | (z > _MAX_CONFIDENCE)).any():
        raise MessageError(
            "not_2d",
            "a pose has z outside 0..1.05, so these look like 3D poses; send x and y in pixels and z = confidence or 0",
        )
    confidence = z if (z > 0).any() else None
    filled = (xyz != 0).any(axis=-1)
    return record(xyz[..., :2], confidence, ("",) * persons, msg.header, present=filled & ~np.isnan(z))
