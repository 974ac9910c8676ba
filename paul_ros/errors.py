# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can cause and fix. The text of each is one line that says what to do.

Any other exception is a bug of this package and shows its traceback.
"""

from __future__ import annotations


class PaulError(Exception):
    """Base of all errors that this package raises for its users."""


class MissingPackageError(PaulError, ImportError):
    """An optional Python package is not installed."""


class InputError(PaulError, ValueError):
    """An argument of the Python API has a wrong shape, type or value."""


class ModelError(PaulError, ValueError):
    """A model cannot be used."""


class LayoutError(PaulError, ValueError):
    """A layout does not exist, is malformed, or does not fit another layout."""


class ParameterError(PaulError, ValueError):
    """A parameter is unknown or has a value outside its range."""


class NpzError(PaulError, ValueError):
    """An npz file cannot be used. The text continues a sentence that begins with the file's name."""


class KeypointFileError(PaulError, ValueError):
    """A file of 2D keypoints cannot be used."""


class OutputError(PaulError):
    """An output file cannot be written, or would overwrite an input."""


class BagError(PaulError):
    """A bag cannot be read or written.

    Attributes:
        messages_read: number of messages read before the damage.
    """

    def __init__(self, text: str, messages_read: int = 0) -> None:
        super().__init__(text)
        self.messages_read = messages_read


class WrongTopicError(BagError):
    """A requested topic has a type that cannot be used."""


class PictureError(PaulError):
    """A picture or film cannot be drawn."""


class DemoError(PaulError):
    """The demo cannot run, or the node gave a wrong answer or none."""


class NodeBenchmarkError(PaulError):
    """The benchmark of the node cannot run."""
