# SPDX-License-Identifier: Apache-2.0
"""The node's parameters, once: descriptors, config/lifter.yaml and the README's table all come from here."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import yaml

from paul_ros.errors import ParameterError


@dataclass(frozen=True)
class Parameter:
    """One parameter. `limits`: inclusive (low, high) of a number; `live`: may change while the node runs.

    `least`: of a number that 0 turns off, the lowest other that makes sense.
    """

    name: str
    default: str | int | float | bool
    description: str
    limits: tuple | None = None
    live: bool = False
    least: float | None = None

    @property
    def range(self) -> str:
        """In words, of one with limits."""
        low, high = self.limits
        return f"{low} to {high}" if self.least is None else f"{low:g} or {self.least} to {high}"

    def allows(self, value) -> bool:
        """Whether it can have a value of its type."""
        if self.limits is None:
            return True
        low, high = self.limits
        return low <= value <= high and (self.least is None or value == low or value >= self.least)


PARAMETERS = (
    Parameter(
        "autostart",
        True,
        "Configure and activate at once; false = wait for the transitions of a managed node, as `ros2 lifecycle` asks "
        "for them.",
    ),
    Parameter(
        "model",
        "human",
        "Model file: the name of one that is shipped, or a path to a .npz, which is read anew each time it is set.",
        live=True,
    ),
    Parameter(
        "layout",
        "",
        "Keypoint layout of the input: a name, or a path to a .yaml; empty = found from the first message that shows "
        "somebody.",
        live=True,
    ),
    Parameter(
        "output_layout",
        "",
        "Keypoint layout of the output: a name, or a path to a .yaml, of whose points the model has all; model = all "
        "points of the model; empty = the input's, or the model's where that lacks a point of the input's.",
        live=True,
    ),
    Parameter(
        "input_type",
        "auto",
        "Message type of `keypoints`, as sensor_msgs/msg/PointCloud2; "
        "auto = the type of the first publisher that can be read, or of the next when that has gone.",
    ),
    Parameter(
        "person_height",
        0.0,
        "Metres, the height of the people in view where it is known, as of children; 0 = the model's adults.",
        (0.0, 3.0),
        live=True,
        least=0.3,
    ),
    Parameter(
        "smoothing",
        0.0,
        "Hz, cut-off of a filter over time for persons at rest (one-euro, not part of PAUL; it needs person ids): the "
        "lower the smoother, 1.0 is a good start; 0 = off, every frame for itself.",
        (0.0, 100.0),
        live=True,
    ),
    Parameter(
        "publish_tf",
        False,
        "Publish on /tf the pose of ~/bodies as body_ID, of every person with an id (REP-155); it needs tf2_msgs, and "
        "metres.",
    ),
    Parameter("min_confidence", 0.3, "Keypoints with a lower confidence count as hidden.", (0.0, 1.0), live=True),
    Parameter(
        "max_persons", 64, "Messages with more persons are dropped, counted as too_many_persons.", (1, 10000), live=True
    ),
)

#: Names of those that may change while the node runs.
LIVE = tuple(parameter.name for parameter in PARAMETERS if parameter.live)
#: Name -> default.
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}


def checked(values: dict) -> dict:
    """Values by name, the defaults of the others added; raises ParameterError for a number out of its limits."""
    for parameter in PARAMETERS:
        value = values.get(parameter.name, parameter.default)
        if not parameter.allows(value):
            raise ParameterError(f"{parameter.name} is {value}; it must be {parameter.range}")
    return {**DEFAULTS, **values}


def as_yaml() -> str:
    """config/lifter.yaml: every parameter with its default and its description."""
    blocks = [
        "# Parameters of the lifter, with their defaults. Made from paul_ros/stream/parameters.py by\n"
        "# python -m paul_ros.stream.parameters > config/lifter.yaml\n"
        "/**:\n  ros__parameters:\n"
    ]
    for parameter in PARAMETERS:
        comment = textwrap.wrap(f"{parameter.description} ({_kind(parameter)})", 100)
        value = yaml.safe_dump({parameter.name: parameter.default}).strip()
        blocks.append("".join(f"    # {line}\n" for line in comment) + f"    {value}\n")
    return "".join(blocks)


def as_markdown() -> str:
    """The README's table of parameters."""
    rows = [f"| `{p.name}` | `{_value(p)}` | {_kind(p)} | {p.description} |" for p in PARAMETERS]
    return "\n".join(["| parameter | default | may be set | meaning |", "|---|---|---|---|", *rows]) + "\n"


def _value(parameter: Parameter) -> str:
    """The default, as YAML and the command line have it."""
    default = parameter.default
    return repr(default) if isinstance(default, str) else str(default).lower()


def _kind(parameter: Parameter) -> str:
    when = "at any time" if parameter.live else "at start"
    if parameter.limits is None:
        return when
    return f"{when}, {parameter.range}"


if __name__ == "__main__":
    print(as_yaml(), end="")
