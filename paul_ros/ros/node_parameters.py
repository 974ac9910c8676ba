# SPDX-License-Identifier: Apache-2.0
"""The table of parameters as ROS 2 parameters."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError

from paul_ros.errors import PaulError
from paul_ros.stream.parameters import PARAMETERS, Parameter

RCLPY_REFUSALS = (ParameterException, InvalidQosOverridesError, ValueError, RuntimeError)
"""Errors that rclpy raises for parameters and QoS overrides that it cannot use. They have no common base."""

REFUSALS = (PaulError, *RCLPY_REFUSALS)
"""Errors that refuse the value of a parameter."""


def declare(node: Node) -> dict[str, Any]:
    """Declare all parameters of the table; return their values by name.

    Raises:
        REFUSALS: a value has the wrong type or is out of range.
    """
    return {
        parameter.name: node.declare_parameter(parameter.name, parameter.default, _descriptor(parameter)).value
        for parameter in PARAMETERS
    }


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
