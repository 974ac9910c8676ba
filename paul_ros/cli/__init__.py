# SPDX-License-Identifier: Apache-2.0
"""The command `paul`: one module a command, its parser beside its run.

A new command is a new module with `add_parser`, and a line in `launcher.COMMANDS`. A module is imported only if its
command runs. It imports what is heavy (NumPy, torch, the bag reader) inside the function that needs it.
"""

from paul_ros.cli.launcher import main

__all__ = ["main"]
