# SPDX-License-Identifier: Apache-2.0
"""The shipped recipes, as YAML files beside this module."""

from __future__ import annotations

from importlib import resources


def recipe_names() -> list[str]:
    """Return the names of the shipped recipes."""
    return sorted(item.name[:-5] for item in resources.files(__package__).iterdir() if item.name.endswith(".yaml"))
