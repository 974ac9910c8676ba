# SPDX-License-Identifier: Apache-2.0
"""Sentences for users that depend on the model, the camera and the layouts in use."""

from __future__ import annotations

import functools

from msg_adapters import Intrinsics, WrongPointCount
from paul_ros.layout import layout_names, load_layout


def scale_source(intrinsics: Intrinsics | None, metres_per_unit: float | None) -> str:
    """Say where the outputs have their scale from, or why they have none."""
    if metres_per_unit is None:
        return "none: the model does not know its size in metres"
    if intrinsics is None:
        return "none: no usable CameraInfo has come"
    image = {"P": "the rectified image", "K": "the raw image, for P is not filled"}[intrinsics.matrix]
    uncorrected = ", whose distortion is not corrected" if intrinsics.distorted else ""
    return (
        "the model's metres per unit; distance from the camera's focal length, "
        f"CameraInfo's {intrinsics.matrix}: {image}{uncorrected}; both from `depth` where that has a value at the root"
    )


def unlike_the_model(model: str, layout: str) -> str:
    """Explain that keypoints hardly fit any shape of a model; both arguments are names."""
    return (
        f"The keypoints of a person hardly fit any shape of model '{model}'. If many persons are counted, their points "
        f"are not in the order of layout '{layout}': set the parameter `layout` to the one your detector uses."
    )


def wrong_point_count(error: WrongPointCount) -> str:
    """Say which shipped layouts have as many points as the message."""
    fitting = [name for name, points in _layout_sizes().items() if error.fits(points)]
    if not fitting:
        return f"{error}; no shipped layout has that many: set the parameter `layout` to the path of your own"
    return f"{error}; set the parameter `layout` to the one your detector uses: {', '.join(fitting)}"


@functools.cache
def _layout_sizes() -> dict[str, int]:
    return {name: len(load_layout(name).names) for name in layout_names()}
