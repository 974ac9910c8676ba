# SPDX-License-Identifier: Apache-2.0
"""The recordings that come with the package."""

from __future__ import annotations

from pathlib import Path

from paul_ros.errors import BagError


def find_bag(name: str) -> Path:
    """Return the path of a recording: beside the source, or in share/paul_ros/bags of the installation.

    Raises:
        BagError: the recording is not installed.
    """
    for parent in Path(__file__).resolve().parents:
        for folder in (parent / "bags", parent / "share" / "paul_ros" / "bags"):
            if (folder / f"{name}.mcap").is_file():
                return folder / f"{name}.mcap"
    raise BagError(f"the recording '{name}' is not installed; run `python bags/make_bags.py` in the source")
