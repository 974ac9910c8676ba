# SPDX-License-Identifier: Apache-2.0
"""What `paul benchmark` measures: one module a benchmark, one table and one JSON object each."""

from __future__ import annotations


def need(*modules: str) -> None:
    """Raises ImportError, with a text for the user, where a Python package is missing; before any work is done."""
    for module in modules:
        try:
            __import__(module)
        except ImportError as error:
            text = f"the benchmark needs the Python package '{module}': pip install 'paul_ros[benchmark]'"
            raise ImportError(text) from error
