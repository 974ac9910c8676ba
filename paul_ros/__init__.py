# SPDX-License-Identifier: Apache-2.0
"""Lift 2D keypoints to 3D.

>>> from paul_ros import Lifter, load_layout
>>> lifter = Lifter("human")
>>> lifter.model.layout.name, len(load_layout("coco17").names)
('human', 17)

The names below are imported when they are first used: the node sets the number of threads before numpy is imported,
and ``paul --help`` needs no numpy. The package itself needs NumPy, PyYAML and, for the node, ROS 2.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_adapters.intrinsics import Intrinsics
    from paul_ros.errors import PaulError
    from paul_ros.layout import Layout, load_layout
    from paul_ros.lifted import Lifted
    from paul_ros.lifter import Lifter
    from paul_ros.model import Model
    from paul_ros.model_file import load_model
    from paul_ros.orthographic_n_point import OnP, onp

__version__ = "0.1.0"

__all__ = [
    "Intrinsics",
    "Layout",
    "Lifted",
    "Lifter",
    "Model",
    "OnP",
    "PaulError",
    "load_layout",
    "load_model",
    "onp",
]

_HOMES = {
    "Intrinsics": "msg_adapters.intrinsics",
    "Layout": "paul_ros.layout",
    "Lifted": "paul_ros.lifted",
    "Lifter": "paul_ros.lifter",
    "Model": "paul_ros.model",
    "OnP": "paul_ros.orthographic_n_point",
    "PaulError": "paul_ros.errors",
    "load_layout": "paul_ros.layout",
    "load_model": "paul_ros.model_file",
    "onp": "paul_ros.orthographic_n_point",
}
"""Module of each public name."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'paul_ros' has no attribute '{name}'")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
