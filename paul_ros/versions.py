# SPDX-License-Identifier: Apache-2.0
"""Versions of the software that a report depends on."""

from __future__ import annotations

import platform
from importlib import metadata

from paul_ros import __version__

_PACKAGES = ("numpy", "mcap", "rosbags")


def versions(*more: str) -> dict[str, str | None]:
    """Return the versions of this package, of Python and of the packages that the figures depend on.

    Args:
        more: further packages to name.

    Returns:
        Name -> version; None for a package that is not installed.
    """
    found: dict[str, str | None] = {"paul_ros": __version__, "python": platform.python_version()}
    for package in (*_PACKAGES, *more):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found
