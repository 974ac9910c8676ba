# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Image as depths in metres, aligned to the image of the keypoints (REP-118).

16UC1 holds millimetres, 0 where nothing was measured. 32FC1 holds metres, NaN where nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_adapters.keypoints import MessageError, stamp_ns

#: Encoding -> numpy type without byte order, metres a unit.
_ENCODINGS = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
#: Smallest share of measured pixels that makes a window's median usable.
_MIN_MEASURED_SHARE = 0.2


@dataclass(frozen=True)
class DepthImage:
    """A depth image.

    Attributes:
        stamp: nanoseconds, from the message's header.
        values: (H, W), in units of `metres`, as in the message.
        metres: metres a unit of `values`.
    """

    stamp: int
    values: np.ndarray
    metres: float

    def at(self, x: float, y: float, radius: int) -> float:
        """Return the median depth in metres of a square window about a pixel.

        It is NaN outside the image and where less than 20 % of the window was measured.
        """
        height, width = self.values.shape
        if not (0 <= x < width and 0 <= y < height):
            return np.nan
        column, row = int(x), int(y)
        window = self.values[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
        measured = window[np.isfinite(window) & (window > 0)]
        if measured.size < _MIN_MEASURED_SHARE * window.size:
            return np.nan
        return float(np.median(measured)) * self.metres

    def nearest(self) -> float:
        """Return the depth in metres that 95 % of the image lie beyond; NaN if nothing was measured.

        One pixel in 64 is looked at.
        """
        some = self.values[::8, ::8]
        measured = some[np.isfinite(some) & (some > 0)]
        return float(np.percentile(measured, 5)) * self.metres if measured.size else np.nan


def read_depth(msg: Any) -> DepthImage:
    """Read a depth image without a copy of its data.

    Raises:
        MessageError: depth_encoding, truncated_data.
    """
    if msg.encoding not in _ENCODINGS:
        raise MessageError(
            "depth_encoding",
            f"the depth image has the encoding {msg.encoding!r}; publish {', '.join(_ENCODINGS)}, aligned to the image "
            "of the keypoints",
        )
    form, metres = _ENCODINGS[msg.encoding]
    dtype = np.dtype((">" if msg.is_bigendian else "<") + form)
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    if step < width * dtype.itemsize or len(msg.data) < height * step or not height * width:
        raise MessageError(
            "truncated_data",
            f"the depth image has {len(msg.data)} bytes for {width} x {height} pixels in rows of {step} bytes; correct "
            "its driver",
        )
    values: np.ndarray = np.ndarray((height, width), dtype, buffer=msg.data, strides=(step, dtype.itemsize))
    return DepthImage(stamp_ns(msg.header), values, metres)
