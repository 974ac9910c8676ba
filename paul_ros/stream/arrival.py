# SPDX-License-Identifier: Apache-2.0
"""Messages of keypoints as they arrive, each with a usable stamp and, if one is known, a frame."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

from msg_adapters import Keypoints2D
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.reasons import REASONS

_NS = 10**9


@dataclass(frozen=True)
class Arrival:
    """A message of keypoints.

    Attributes:
        header: std_msgs/Header with the stamp and the frame of `keypoints`.
        keypoints: of its persons.
        received: nanoseconds by the clock of the stamps, when it arrived; 0 = unknown.
        topic: of the message; '' = unknown.
        stamped: whether the stamp is the message's own. Otherwise it is `received`.
    """

    header: Any
    keypoints: Keypoints2D
    received: int = 0
    topic: str = ""
    stamped: bool = True


def complete(header: Any, keypoints: Keypoints2D, received: int, topic: str, camera: str, ledger: Ledger) -> Arrival:
    """Return a message with a stamp and, if one is known, a frame.

    The time of its arrival replaces an unusable stamp: zero, negative, or with nanoseconds of a second or more.
    CameraInfo's frame replaces an empty one.

    Args:
        header: of the message; it is not changed.
        keypoints: of the message.
        received: nanoseconds by the clock of the stamps; 0 = unknown, then the stamp becomes 0.
        topic: of the message.
        camera: frame_id of CameraInfo; '' = unknown.
        ledger: notes what is missing.
    """
    stamp, frame_id = keypoints.stamp, keypoints.frame_id
    stamped = stamp > 0 and header.stamp.nanosec < _NS
    if not stamp:
        ledger.note("no_stamp", REASONS["no_stamp"].advice)
    elif not stamped:
        text = f"A stamp has {header.stamp.sec} s and {header.stamp.nanosec} ns. {REASONS['invalid_stamp'].advice}"
        ledger.note("invalid_stamp", text)
    if not frame_id:
        ledger.note("no_frame", REASONS["no_frame"].advice)
        frame_id = camera
    if not stamped or frame_id != keypoints.frame_id:
        keypoints = replace(keypoints, stamp=stamp if stamped else received, frame_id=frame_id)
    if not stamped or header.frame_id != frame_id:
        header = _changed(header, None if stamped else received, frame_id)
    return Arrival(header, keypoints, received, topic, stamped)


def _changed(header: Any, stamp: int | None, frame_id: str) -> Any:
    """Return a copy of a header with another frame and, unless it is None, another stamp in nanoseconds."""
    header = copy.copy(header)
    header.frame_id = frame_id
    if stamp is not None:
        header.stamp = copy.copy(header.stamp)
        header.stamp.sec, header.stamp.nanosec = divmod(stamp, _NS)
    return header
