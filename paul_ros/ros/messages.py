# SPDX-License-Identifier: Apache-2.0
"""rclpy's message classes: found by name, and built from arrays and reports."""

from __future__ import annotations

import array
import functools
import importlib
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from paul_ros.ros.diagnostics import Report


@functools.cache
def message_class(type_name: str) -> Any:
    """Return the class of a type such as 'std_msgs/msg/String'.

    Raises:
        ImportError: its package is not installed, or has no such message.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except AttributeError:
        raise ImportError(f"{package} has no message {name}") from None


class RosMake:
    """The factory of `paul_ros.stream.messages` for rclpy's message classes."""

    def __call__(self, type_name: str, /, **fields: Any) -> Any:
        """Build a message of a type from all its fields."""
        return message_class(type_name)(**fields)

    def header(self, header: Any) -> Any:
        """Convert a header of any family to std_msgs/Header."""
        stamp = self("builtin_interfaces/msg/Time", sec=header.stamp.sec, nanosec=header.stamp.nanosec)
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame_id)

    def octets(self, data: bytes) -> array.array:
        """Convert bytes to the value of a uint8[] field."""
        return array.array("B", data)


def diagnostic_array(report: Report, node_name: str, stamp: Any) -> DiagnosticArray:
    """Build the message of /diagnostics (REP-107) from a report.

    Args:
        report: since the last message.
        node_name: fully qualified name of the node.
        stamp: builtin_interfaces/Time.
    """
    status = DiagnosticStatus(
        level=bytes([report.level]),
        name=f"{node_name.lstrip('/')}: lifting",
        message=report.message,
        hardware_id="",
        values=[KeyValue(key=key, value=str(value)) for key, value in report.values.items()],
    )
    message = DiagnosticArray(status=[status])
    message.header.stamp = stamp
    return message
