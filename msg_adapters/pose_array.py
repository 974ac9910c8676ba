# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/PoseArray as 2D keypoints: the simplest message that a detector can publish.

position.x and position.y are pixels. position.z is the confidence, 0 to 1, or 0 everywhere if there is none. Detectors'
peaks exceed one slightly, so a z up to 1.3 is a confidence and clipped to 1. Several persons follow one another, each
with all keypoints of the layout. NaN, (0, 0) as in the default pose, and (-1, -1) mean missing. Persons have no ids.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_adapters.keypoints import (
    CONFIDENCE_SLACK,
    Keypoints2D,
    MessageError,
    Source,
    is_placeholder,
    record,
    split_persons,
)

_MAX_CONFIDENCE = 1 + CONFIDENCE_SLACK


def read(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read poses as 2D keypoints; an array without poses is an image without persons.

    Raises:
        MessageError: not_2d (a z outside 0..1.3 is a depth), wrong_point_count, layout_unknown.
    """
    positions = [pose.position for pose in msg.poses]
    persons = split_persons(len(positions), points, source)
    xyz = np.array([(p.x, p.y, p.z) for p in positions], dtype=np.float64).reshape(persons, points, 3)
    z = xyz[..., 2]
    if (((z < 0) | (z > _MAX_CONFIDENCE)) & ~is_placeholder(xyz[..., 0], xyz[..., 1])).any():
        raise MessageError(
            "not_2d",
            "a pose has z outside 0..1.3, so these look like 3D poses; send x and y in pixels and z = confidence "
            "(0 to 1, no percentage) or 0",
        )
    confidence = z if (z > 0).any() else None
    return record(xyz[..., :2], confidence, ("",) * persons, msg.header, present=~np.isnan(z))
