# SPDX-License-Identifier: Apache-2.0
"""opendr_interface/OpenDRPose2D (OpenDR toolkit): whole pixels; one message is one person.

Points are keyed by name and placed by it, so their order and number do not matter. A negative coordinate
means missing. There is no confidence a keypoint: conf is of the person, and on a scale of its own.
"""

from __future__ import annotations

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, record

# fmt: off
#: OpenDR's abbreviations (reference of its Lightweight OpenPose), in the names that layouts use.
NAMES = {
    "nose": "nose", "neck": "neck",
    "r_sho": "right_shoulder", "r_elb": "right_elbow", "r_wri": "right_wrist",
    "l_sho": "left_shoulder", "l_elb": "left_elbow", "l_wri": "left_wrist",
    "r_hip": "right_hip", "r_knee": "right_knee", "r_ank": "right_ankle",
    "l_hip": "left_hip", "l_knee": "left_knee", "l_ank": "left_ankle",
    "r_eye": "right_eye", "l_eye": "left_eye", "r_ear": "right_ear", "l_ear": "left_ear",
}
# fmt: on


def read(msg, points: int, source: Source) -> Keypoints2D:
    """Reads one person of a layout with `points` keypoints; points that the layout lacks are left out.

    Fields: pose_id (negative = unknown), keypoint_list[] with kpt_name, x, y. A name that is no abbreviation of
    OpenDR's is taken as the layout's own. Raises MessageError no_common_names.
    """
    xy = np.full((1, points, 2), np.nan)
    columns = {name: column for column, name in enumerate(source.names)}
    placed = 0
    for keypoint in msg.keypoint_list:
        column = columns.get(NAMES.get(keypoint.kpt_name, keypoint.kpt_name))
        if column is not None:
            xy[0, column] = keypoint.x, keypoint.y
            placed += 1
    if len(msg.keypoint_list) and not placed:
        named = ", ".join(keypoint.kpt_name for keypoint in msg.keypoint_list[:5])
        raise MessageError(
            "no_common_names",
            f"the layout has none of the points of this message ({named} ...); set the parameter `layout` to one "
            "whose names are the same",
        )
    person = str(msg.pose_id) if msg.pose_id >= 0 else ""
    return record(xy, None, (person,), msg.header, present=(xy >= 0).all(axis=-1))
