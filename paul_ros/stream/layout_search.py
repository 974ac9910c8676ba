# SPDX-License-Identifier: Apache-2.0
"""The search for a detector's layout: it is found from a message if no layout is set."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import msg_adapters
from msg_adapters import Keypoints2D, Source, WrongPointCount
from paul_ros.layout import Layout, layout_names, load_layout

PREFERRED = ("coco17", "h36m17", "openpose18", "body25", "mediapipe33", "cmu31", "hri18", "human")
"""Shipped layouts in the order in which a message's number of points is tried; the others follow."""


def read_in_fitting_layout(model: Layout, type_name: str, msg: Any, source: Source) -> tuple[Keypoints2D, Layout]:
    """Read a message in the layout that fits it best.

    The first of `candidates` with the right number of points is taken. A plain list of keypoints must be one person:
    its number of persons is not guessed.

    Returns:
        The keypoints and the layout in which they were read.

    Raises:
        UnknownLayout: a plain list may be one person or several.
        WrongPointCount: no candidate has as many points.
        MessageError: as `msg_adapters.read`.
    """
    refusal: WrongPointCount | None = None
    layouts = candidates(model, msg_adapters.named_layout(type_name, msg))
    source = replace(source, candidates=tuple({len(layout.names) for layout in layouts}))
    for layout in layouts:
        try:
            return msg_adapters.read(type_name, msg, len(layout.names), replace(source, names=layout.names)), layout
        except WrongPointCount as error:
            refusal = refusal or error
    assert refusal is not None  # the model's own layout is always a candidate
    raise refusal


def candidates(model: Layout, named: str | None = None) -> list[Layout]:
    """Return the layouts that an input may have, the best first.

    They are the named one, the model's own, and the shipped layouts in the order of PREFERRED. All but the model's map
    onto the model.

    Args:
        model: layout of the model.
        named: name of the layout whose points a message names; None if it names none.
    """
    fitting = {layout.name: layout for layout in _shipped() if layout.fits(model)}
    first = [fitting[named]] if named in fitting else []
    return [*first, model, *fitting.values()]


@functools.cache
def _shipped() -> tuple[Layout, ...]:
    """Return the shipped layouts in the order of PREFERRED; reading them takes a tenth of a second."""
    return tuple(load_layout(name) for name in dict.fromkeys([*PREFERRED, *layout_names()]))
