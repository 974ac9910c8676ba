# SPDX-License-Identifier: Apache-2.0
"""Optional Python packages: they are imported late, and an error names the missing one and its installation."""

from __future__ import annotations

import importlib

from paul_ros.errors import MissingPackageError


def require(extra: str, *modules: str) -> None:
    """Import the modules of an optional extra of this package.

    Args:
        extra: name of the extra in setup.cfg, as in ``pip install 'paul_ros[bags]'``.
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
            raise MissingPackageError(
                f"the Python package '{module}' is missing: pip install 'paul_ros[{extra}]'"
            ) from error
