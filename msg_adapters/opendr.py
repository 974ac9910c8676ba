# SPDX-License-Identifier: Apache-2.0
"""opendr_interface/OpenDRPose2D (OpenDR toolkit): whole pixels, one person per message.

Points are placed by name, so their order and number do not matter. A negative coordinate means missing. The message
has no confidence for each keypoint: conf is the person's, on a scale of its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from msg_adapters.keypoints import Keypoints2D, MessageError, Source, record

# fmt: off
#: OpenDR's abbreviations (reference of its Lightweight OpenPose) -> keypoint names as in layouts.
NAMES = {
    "nose": "nose", "neck": "neck",
    "r_sho": "right_shoulder", "r_elb": "right_elbow", "r_wri": "right_wrist",
    "l_sho": "left_shoulder", "l_elb": "left_elbow", "l_wri": "left_wrist",
    "r_hip": "right_hip", "r_knee": "right_knee", "r_ank": "right_ankle",
    "l_hip": "left_hip", "l_knee": "left_knee", "l_ank": "left_ankle",
    "r_eye": "right_eye", "l_eye": "left_eye", "r_ear": "right_ear", "l_ear": "left_ear",
}
# fmt: on


def read(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read one person; ignore points that the layout lacks.

    Fields: pose_id (negative = unknown), keypoint_list[] with kpt_name, x, y. A name that is not an abbreviation of
    OpenDR is looked up in the layout as it is.

    Raises:
        MessageError: no_common_names.
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
            f"the layout has none of the message's points ({named} ...); set `layout` (paul: --layout) to one "
            "with the same names",
        )
    person = str(msg.pose_id) if msg.pose_id >= 0 else ""
    return record(xy, None, (person,), msg.header, present=np.all(xy >= 0, axis=-1), placeholders=False)
