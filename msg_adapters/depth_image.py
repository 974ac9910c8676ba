# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Image as depths in metres, aligned to the image that the keypoints are of (REP-118).

16UC1 holds millimetres, 0 where nothing was measured; 32FC1 metres, NaN there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.keypoints import MessageError, stamp_ns

#: Encoding -> numpy type without byte order, metres a unit.
_ENCODINGS = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
#: Of a window fewer measured pixels than this share tell nothing.
_LEAST_SHARE = 0.2


@dataclass(frozen=True)
class DepthImage:
    """stamp in ns; values (H,W) in units of `metres` metres, as the message has them."""

    stamp: int
    values: np.ndarray
    metres: float

    def at(self, x: float, y: float, radius: int) -> float:
        """Metres, the median of what was measured in a square about a pixel; NaN where too little was, or outside."""
        height, width = self.values.shape
        if not (0 <= x < width and 0 <= y < height):
            return np.nan
        column, row = int(x), int(y)
        window = self.values[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
        measured = window[np.isfinite(window) & (window > 0)]
        if measured.size < _LEAST_SHARE * window.size:
            return np.nan
        return float(np.median(measured)) * self.metres


def read_depth(msg) -> DepthImage:
    """Reads a depth image without copying it.

    Raises MessageError: depth_encoding, truncated_data.
    """
    if msg.encoding not in _ENCODINGS:
        raise MessageError(
            "depth_encoding",
            f"the depth image is of encoding {msg.encoding!r}; it must be {', '.join(_ENCODINGS)} and aligned to the "
            "image of the keypoints",
        )
    form, metres = _ENCODINGS[msg.encoding]
    dtype = np.dtype((">" if msg.is_bigendian else "<") + form)
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    if step < width * dtype.itemsize or len(msg.data) < height * step or not height * width:
        raise MessageError(
            "truncated_data",
            f"the depth image of {width} x {height} in steps of {step} bytes has {len(msg.data)}; correct its driver",
        )
    values = np.ndarray((height, width), dtype, buffer=msg.data, strides=(step, dtype.itemsize))
    return DepthImage(stamp_ns(msg.header), values, metres)
