# SPDX-License-Identifier: Apache-2.0
"""Optional Python packages: they are imported late, and an error names the missing one and its installation."""

from __future__ import annotations

import importlib

from paul_ros.errors import MissingPackageError


def require(extra: str, *modules: str) -> None:
    """Import the modules of an optional extra of this package.

    Args:
        extra: name of the extra in setup.cfg, such as ``bags``.
        modules: import names that the caller is about to use.

    Raises:
        MissingPackageError: a package is not installed. The text names it and the command that installs it.
    """
    for module in modules:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            if error.name and not module.startswith(error.name):
                raise  # the module itself is installed, but one of its own imports is not
            raise MissingPackageError(f"the Python package '{module}' is missing: {installation(extra)}") from error


def installation(extra: str) -> str:
    """Return how an extra of this package is installed, as the end of a sentence."""
    return f"pip install '.[{extra}]' in a clone of paul_ros"


def needs_ros(who: str) -> str:
    """Return the text of an error: `who` needs ROS 2, which is not installed, and how to get it."""
    return f"{who} needs ROS 2: source /opt/ros/jazzy/setup.bash, or {installation('ros')}"
