# SPDX-License-Identifier: Apache-2.0
"""Sentences for users that depend on the model, the camera and the layouts in use."""

from __future__ import annotations

from msg_adapters import Intrinsics, PointCountError
from paul_ros.layout import Layout, layout_names
from paul_ros.stream.layout_search import candidates


def sentence(text: str) -> str:
    """Return the text of an error as a sentence: with a capital, unless it starts with an identifier, and a stop."""
    first = text.partition(" ")[0]
    if first.isalpha() and first.islower():
        text = text[0].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."


def scale_source(intrinsics: Intrinsics | None, metres_per_unit: float | None) -> str:
    """Say where the outputs have their scale from, or after "none: " why they have none; without a full stop."""
    if metres_per_unit is None:
        return "none: the model does not know its size in metres"
    if intrinsics is None:
        return "none: no usable CameraInfo has been received"
    image = image_of(intrinsics)
    return (
        "Size: the model's metres per unit. "
        f"Distance: the focal length in CameraInfo's {intrinsics.matrix}. "
        f"The keypoints are taken as those of the {image['image']} image; its distortion: {image['distortion']}. "
        "A depth image replaces size and distance where it has a value at the root"
    )


def image_of(intrinsics: Intrinsics | None) -> dict[str, str | None]:
    """Return the image of the keypoints, 'raw' or 'rectified', and what is done about its distortion; None unknown."""
    if intrinsics is None:
        return {"image": None, "distortion": None}
    distortion = "none"
    if intrinsics.uncorrected:
        distortion = "not corrected"
    elif intrinsics.distortion:
        distortion = f"{intrinsics.distortion.model}, corrected"
    return {"image": intrinsics.image, "distortion": distortion}


def unlike_the_model(model: str, layout: str) -> str:
    """Explain that keypoints hardly fit any shape of a model; both arguments are names."""
    return (
        f"The keypoints of a person hardly fit any shape of model '{model}'. If many persons are counted, their points "
        f"may have another order than layout '{layout}': set `layout` to the one your detector uses. "
        "Or the model has not seen such poses: train it on more."
    )


def wrong_point_count(error: PointCountError, model: Layout) -> str:
    """Say which layouts have as many points as a message: the model's own, and shipped ones that map onto it."""
    shipped = layout_names()
    fitting = {layout.name: None for layout in candidates(model) if error.fits(len(layout.names))}
    names = [name if name in shipped else f"{name} (the model's own, by the path of its file)" for name in fitting]
    if not names:
        return (
            f"{sentence(str(error))} No shipped layout that the model can use has that many: set `layout` to the path "
            "of your own."
        )
    choice = f"{', '.join(names)}, or the path of your own"
    return f"{sentence(str(error))} Set `layout` to the one your detector uses: {choice}."
