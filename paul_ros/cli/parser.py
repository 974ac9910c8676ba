# SPDX-License-Identifier: Apache-2.0
"""A parser that answers a mistyped command or option with the nearest one, and with the usage of the command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from paul_ros.wording import did_you_mean


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose commands, as objects of this class too, report their own unknown arguments.

    The base class leaves them to the parser of `paul`, whose usage does not name the command's options.
    """

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse all arguments; exit with code 2 if one is unknown or empty. An empty path would be this folder."""
        words = sys.argv[1:] if args is None else list(args)
        parsed, unknown = super().parse_known_args(words, namespace)
        if "" in words:
            self.error("an argument is empty, as from a variable that is not set: give a value, or leave it out")
        if unknown:
            option = unknown[0].partition("=")[0]
            hint = did_you_mean(option, self._option_string_actions) if option.startswith("-") else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return parsed, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a command that does not exist; argparse itself suggests one from Python 3.14 on."""
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            kind = str(action.metavar).lower()
            hint = did_you_mean(value, action.choices) or "."
            self.error(f"no {kind} '{value}'{hint} There are {', '.join(action.choices)}")
        super()._check_value(action, value)
