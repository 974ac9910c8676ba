# SPDX-License-Identifier: Apache-2.0
"""The layout of a detector, found from its messages where nobody says it."""

from __future__ import annotations

import functools
from dataclasses import replace

import msg_adapters
from msg_adapters import Keypoints2D, Source, WrongPointCount
from paul_ros.errors import LayoutError
from paul_ros.layout import Layout, layout_names, load_layout

PREFERRED = ("coco17", "h36m17", "openpose18", "body25", "mediapipe33")
"""Of the shipped layouts with as many points as a message has, the first of these is taken, then any other."""


def read_unknown(model: Layout, type_name: str, msg, source: Source) -> tuple[Keypoints2D, Layout]:
    """A message of which nobody said the layout, and the layout that it was read in.

    That is the one whose points the message names, if the model shares enough of them; else the model's own if the
    number of points is right for it; else the first shipped layout of that number that maps onto the model, in the
    order of PREFERRED. Raises MessageError as `msg_adapters.read` does; WrongPointCount where none has the number.
    """
    refusal: WrongPointCount | None = None
    for layout in _candidates(model, msg_adapters.named_layout(type_name, msg)):
        try:
            return msg_adapters.read(type_name, msg, len(layout.names), replace(source, names=layout.names)), layout
        except WrongPointCount as error:
            refusal = refusal or error
    raise refusal


def _candidates(model: Layout, named: str | None) -> list[Layout]:
    fitting = {layout.name: layout for layout in _shipped() if _maps(layout, model)}
    first = [fitting[named]] if named in fitting else []
    return [*first, model, *fitting.values()]


@functools.cache
def _shipped() -> tuple[Layout, ...]:
    """In the order of PREFERRED. Reading them takes a tenth of a second."""
    return tuple(load_layout(name) for name in dict.fromkeys([*PREFERRED, *layout_names()]))


def _maps(layout: Layout, model: Layout) -> bool:
    try:
        return bool(layout.map_to(model))
    except LayoutError:
        return False
