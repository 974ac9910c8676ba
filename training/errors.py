# SPDX-License-Identifier: Apache-2.0
"""Errors of the trainer that a user can cause and mend; see `paul_ros.errors`."""

from __future__ import annotations

from paul_ros.errors import PaulError


class DataError(PaulError, ValueError):
    """Data cannot be trained on or judged by."""


class RecipeError(PaulError, ValueError):
    """A recipe has an unknown setting or a value that cannot be used."""


class TrainingError(PaulError, RuntimeError):
    """Training cannot start or cannot go on."""


class StartError(PaulError, RuntimeError):
    """A start cannot be found or cannot be read."""


class MocapError(PaulError, ValueError):
    """Motion capture cannot be read."""


class ViewsError(PaulError, ValueError):
    """The settings of synthetic views cannot be used."""
