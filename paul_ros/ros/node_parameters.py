# SPDX-License-Identifier: Apache-2.0
"""The table of parameters as ROS 2 parameters."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException, ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as GivenParameter
from rclpy.qos_overriding_options import InvalidQosOverridesError

from paul_ros.errors import PaulError
from paul_ros.ros.qos import OVERRIDES
from paul_ros.ros.rclpy_internals import parameter_overrides
from paul_ros.stream.messages import OUTPUTS
from paul_ros.stream.parameters import DEFAULTS, PARAMETERS, Parameter
from paul_ros.wording import did_you_mean

INPUTS = ("keypoints", "camera_info", "depth")
"""Topics that the node subscribes to."""

OTHER_OUTPUTS = ("~/layout", "/diagnostics")
"""Topics that the node publishes, beside those of `paul_ros.stream.messages.OUTPUTS`."""

REFUSALS = (PaulError, ParameterException, InvalidQosOverridesError, ValueError, RuntimeError)
"""Errors that refuse the value of a parameter. Those that rclpy raises have no common base."""

_QOS = "qos_overrides."
_LONGEST_TEXT = 1000
_LONGEST_NAME = 200


class UnknownParameterError(ParameterNotDeclaredException):
    """A parameter is not the node's. rclpy's own services turn this error into a refusal with its text."""

    def __init__(self, name: str, names: Iterable[str]) -> None:
        fixed = "; the QoS of a topic can be set only at start" if name.startswith(_QOS) else ""
        Exception.__init__(self, f"there is no parameter {_unknown(name, names)}{fixed}")


def declare(node: Node) -> dict[str, Any]:
    """Declare all parameters of the table; return their values by name.

    Raises:
        REFUSALS: a value has the wrong type or is out of range.
    """
    overrides = parameter_overrides(node)
    overrides.update({name: _in_declared_type(given) for name, given in overrides.items()})
    return {
        parameter.name: node.declare_parameter(parameter.name, parameter.default, _descriptor(parameter)).value
        for parameter in PARAMETERS
    }


def unknown_at_start(node: Node) -> list[str]:
    """Return the parameters that arguments and files give a node and that it does not have, each with the nearest name.

    Args:
        node: with all its parameters declared, except those of QoS: rclpy declares them with their topics.
    """
    known = [*node.list_parameters([], 0).names, *_qos_overrides(node)]
    return [_unknown(name, known) for name in parameter_overrides(node) if name not in known]


def acceptable(node: Node, parameters: list[GivenParameter]) -> list[GivenParameter]:
    """Return parameters that a request sets, with integers as floating-point numbers where those are wanted.

    Raises:
        UnknownParameterError: the node has no parameter of this name.
    """
    for given in parameters:
        if not node.has_parameter(given.name):
            names = node.list_parameters([], 0).names
            raise UnknownParameterError(given.name, [name for name in names if not name.startswith(_QOS)])
    return [_in_declared_type(given) for given in parameters]


def one_line(text: object) -> str:
    """Return an error or a name for a log line or a response.

    It has no line breaks, none of the places in rcl's own source that rcl names, and a limited length.
    """
    line = re.sub(r",? at \S+\.c(pp)?:\d+", "", " ".join(str(text)[:_LONGEST_TEXT].split()))
    return f"{line} ..." if len(str(text)) > _LONGEST_TEXT else line


def _in_declared_type(given: GivenParameter) -> GivenParameter:
    """Turn an integer into the floating-point number that the table wants; leave the rest for rclpy to check."""
    if isinstance(DEFAULTS.get(given.name), float) and given.type_ == GivenParameter.Type.INTEGER:
        return GivenParameter(given.name, value=float(given.value))
    return given


def _unknown(name: str, names: Iterable[str]) -> str:
    """Return a name in quotes, with the nearest of some names if one is like it."""
    # The time to find the nearest grows with the length, and no name is as long as that.
    near = did_you_mean(name, names) if len(name) <= _LONGEST_NAME else ""
    return f"'{one_line(name)}'{near}"


def _qos_overrides(node: Node) -> list[str]:
    """Return the names of all parameters of QoS that the node may have."""
    published = [*(output.topic for output in OUTPUTS.values()), *OTHER_OUTPUTS]
    sides = [*((topic, "subscription") for topic in INPUTS), *((topic, "publisher") for topic in published)]
    return [
        f"{_QOS}{node.resolve_topic_name(topic)}.{side}.{policy.name.lower()}"
        for topic, side in sides
        for policy in OVERRIDES.policy_kinds
    ]


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    described = ParameterDescriptor(description=parameter.description, read_only=not parameter.live)
    if parameter.limits is None:
        return described
    low, high = parameter.limits
    if isinstance(parameter.default, float):
        described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    else:
        described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return described
