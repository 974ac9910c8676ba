# SPDX-License-Identifier: Apache-2.0
"""Advice that is written for the node, in the words of a command: options in place of parameters and topics."""

from __future__ import annotations

import re
from collections.abc import Collection

TOPICS = {"keypoints": "topic", "camera_info": "camera_info_topic", "depth": "depth_topic"}
"""Topic of the node -> name of the option that chooses it in a bag."""

_NAME = re.compile(r"(?P<remap>[Rr]emap )?(?:the parameter )?`(?P<name>\w+)`")


def in_options(advice: str, arguments: Collection[str]) -> str:
    """Replace parameters and topics of the node, which stand in backticks, by the options of a command.

    "Set `layout`" becomes "Set --layout", and "Remap `depth` to" becomes "Set --depth-topic to".

    Args:
        advice: one sentence or more.
        arguments: names of the command's arguments. A name that is no option of the command stays as it is.
    """
    from paul_ros.stream.parameters import DEFAULTS

    def replaced(match: re.Match[str]) -> str:
        remap, name = match["remap"] or "", match["name"]
        argument = TOPICS.get(name, name)
        if argument not in arguments or (name not in TOPICS and name not in DEFAULTS):
            return match[0]
        option = f"--{argument.replace('_', '-')}"
        if remap:
            return f"{'Set' if remap[0] == 'R' else 'set'} {option}"
        return f"the topic of {option}" if name in TOPICS else option

    return _NAME.sub(replaced, advice)
