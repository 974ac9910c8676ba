# SPDX-License-Identifier: Apache-2.0
"""The factory that makes messages: one interface for rclpy's classes and rosbags' dataclasses."""

from __future__ import annotations

from typing import Any, Protocol


class MessageFactory(Protocol):
    """Makes the messages of one family, rclpy's or rosbags'."""

    def __call__(self, type_name: str, /, **fields: Any) -> Any:
        """Make a message.

        Args:
            type_name: PACKAGE/msg/NAME.
            fields: all fields of the type by name. Numbers are Python's own: rclpy publishes garbage for numpy scalars
                unless its field checks are on.
        """

    def octets(self, data: bytes, /) -> Any:
        """Return bytes as the family's value of a uint8[] field."""
