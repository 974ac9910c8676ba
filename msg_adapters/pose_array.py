# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/PoseArray used as 2D: the simplest thing a detector can publish.

position.x, position.y in pixels, position.z = confidence 0..1, or 0 everywhere where there is none.
Detectors' peaks reach a little above one: up to 1.05 a z is taken as a confidence and clipped to 1.
Several persons are multiples of the layout's keypoints, person-major. Missing: NaN, or a pose left at its
default (0, 0, 0). There are no ids.
"""

from __future__ import annotations

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, record, split_persons

_MOST_CONFIDENCE = 1.05


def read(msg, points: int, _source: Source) -> Keypoints2D:
    """Reads poses as 2D keypoints whose layout has `points` of them; no pose is zero persons.

    Raises MessageError: not_2d (a z outside 0..1.05 is a depth, not a confidence), wrong_point_count.
    """
    positions = [pose.position for pose in msg.poses]
    persons = split_persons(len(positions), points)
    xyz = np.array([(p.x, p.y, p.z) for p in positions], dtype=np.float64).reshape(persons, points, 3)
    z = xyz[..., 2]
    if ((z < 0) | (z > _MOST_CONFIDENCE)).any():
        raise MessageError(
            "not_2d",
            "a pose has z outside 0..1.05, so these look like 3D poses; "
            "send x and y in pixels and z = confidence, or 0",
        )
    confidence = z if (z > 0).any() else None
    filled = (xyz != 0).any(axis=-1)
    present = filled & ~np.isnan(z)
    return record(xyz[..., :2], confidence, ("",) * persons, msg.header, present)
