# SPDX-License-Identifier: Apache-2.0
"""The table of the node's parameters: descriptors, config/lifter.yaml and the reference page are made from it."""

from __future__ import annotations

import numbers
import textwrap
from dataclasses import dataclass
from typing import Any

import yaml

from paul_ros.errors import ParameterError

IMAGES = ("auto", "rectified", "raw")
"""Values of `image`; `msg_adapters.read_camera_info` has the rule of the first."""


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        name: of the parameter.
        default: its default, which also fixes its type.
        description: its meaning, with the unit.
        limits: lowest and highest allowed number; None for other types.
        live: whether it may change while the node runs.
        least: lowest allowed number above 0, for numbers that 0 turns off.
        choices: the allowed words; () for other parameters.
    """

    name: str
    default: str | int | float | bool
    description: str
    limits: tuple[float, float] | None = None
    live: bool = False
    least: float | None = None
    choices: tuple[str, ...] = ()

    @property
    def range(self) -> str:
        """The allowed values in words; '' if any is allowed."""
        if self.choices:
            return " or ".join(self.choices)
        if self.limits is None:
            return ""
        low, high = self.limits
        return f"{low} to {high}" if self.least is None else f"{low:g} or {self.least} to {high}"

    def allows(self, value: Any) -> bool:
        """Return whether a value is one of the choices, or a number in range; without either any value is allowed."""
        if self.choices:
            return value in self.choices
        if self.limits is None:
            return True
        low, high = self.limits
        is_number = isinstance(value, numbers.Real)
        return is_number and low <= value <= high and (self.least is None or value == low or value >= self.least)


PARAMETERS = (
    Parameter(
        "autostart",
        True,
        "Configure and activate at the start. Set false to manage the node by its transitions (`ros2 lifecycle`).",
    ),
    Parameter(
        "model",
        "human",
        "Name of a shipped model, or path of a .npz file. Setting it reads the file again.",
        live=True,
    ),
    Parameter(
        "layout",
        "",
        "Keypoint layout of the input: a name, or the path of a .yaml file. If empty, it is found from the first "
        "message that shows a person.",
        live=True,
    ),
    Parameter(
        "output_layout",
        "",
        "Keypoint layout of the output: a name, or the path of a .yaml file; the model must have all its points. "
        "`model` publishes all points of the model. If empty, it is the input's layout, or the model's if that lacks a "
        "point of the input's.",
        live=True,
    ),
    Parameter(
        "input_type",
        "auto",
        "Message type of `keypoints`, for example sensor_msgs/msg/PointCloud2. `auto` takes the type of the first "
        "publisher that can be read, and looks again when that publisher is gone.",
    ),
    Parameter(
        "image",
        "auto",
        "The image that the detector sees: `rectified` (P of CameraInfo), or `raw` (K; the distortion D is corrected). "
        "`auto` takes it as raw if D is not zero and P is empty or equals K.",
        live=True,
        choices=IMAGES,
    ),
    Parameter(
        "person_height",
        0.0,
        "Height of the people in view in metres, for example of children. 0 assumes the adults of the model.",
        (0.0, 3.0),
        live=True,
        least=0.3,
    ),
    Parameter(
        "smoothing",
        0.0,
        "Cut-off in Hz of a one-euro filter over time, for a person at rest; 1.0 is a good start, lower is smoother. "
        "It needs person ids and is not part of PAUL. 0 turns it off.",
        (0.0, 100.0),
        live=True,
    ),
    Parameter(
        "publish_tf",
        False,
        "Publish the pose of each person with an id as frame body_ID on /tf (REP-155). It needs tf2_msgs and metres.",
    ),
    Parameter("min_confidence", 0.3, "Keypoints of lower confidence are hidden.", (0.0, 1.0), live=True),
    Parameter(
        "max_persons",
        64,
        "Largest number of persons in a message. Messages with more are dropped and counted as too_many_persons.",
        (1, 10000),
        live=True,
    ),
)

#: Names of the parameters that may change while the node runs.
LIVE = tuple(parameter.name for parameter in PARAMETERS if parameter.live)
#: Name -> default.
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}


def checked(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values by name with the defaults of all others.

    Raises:
        ParameterError: a name is unknown, or a number is out of its range or no number.
    """
    for name in values.keys() - DEFAULTS.keys():
        import difflib  # its import would cost the node 9 ms at every start

        near = difflib.get_close_matches(name, DEFAULTS, 1)
        advice = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(DEFAULTS)}"
        raise ParameterError(f"there is no parameter '{name}'; {advice}")
    for parameter in PARAMETERS:
        value = values.get(parameter.name, parameter.default)
        if not parameter.allows(value):
            raise ParameterError(f"{parameter.name} is {value!r}; it must be {parameter.range}")
    return {**DEFAULTS, **values}


def as_yaml() -> str:
    """Return config/lifter.yaml: every parameter with its default and its description."""
    blocks = [
        "# Parameters of the lifter, with their defaults. Made from paul_ros/stream/parameters.py by\n"
        "# python -m paul_ros.stream.parameters > config/lifter.yaml\n"
        "/**:\n  ros__parameters:\n"
    ]
    for parameter in PARAMETERS:
        comment = textwrap.wrap(f"{parameter.description} ({_changeable(parameter)})", 100)
        value = yaml.safe_dump({parameter.name: parameter.default}).strip()
        blocks.append("".join(f"    # {line}\n" for line in comment) + f"    {value}\n")
    return "".join(blocks)


def as_markdown() -> str:
    """Return the table of parameters for the documentation."""
    rows = [f"| `{p.name}` | `{_literal(p)}` | {_changeable(p)} | {p.description} |" for p in PARAMETERS]
    return "\n".join(["| parameter | default | may be set | meaning |", "|---|---|---|---|", *rows]) + "\n"


def as_text(columns: int) -> str:
    """Return the parameters as indented plain text of at most so many columns, for a terminal."""
    lines = []
    for parameter in PARAMETERS:
        lines.append(f"  {parameter.name} (default {_literal(parameter)}; may be set {_changeable(parameter)})")
        lines += textwrap.wrap(parameter.description, columns, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)


def _literal(parameter: Parameter) -> str:
    """Return the default as YAML and the command line write it."""
    default = parameter.default
    return repr(default) if isinstance(default, str) else str(default).lower()


def _changeable(parameter: Parameter) -> str:
    """Return when a parameter may be set, and its range."""
    when = "at any time" if parameter.live else "at start"
    return f"{when}, {parameter.range}" if parameter.range else when


if __name__ == "__main__":
    print(as_yaml(), end="")
