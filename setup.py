# SPDX-License-Identifier: Apache-2.0
"""The files that ROS looks for outside Python packages; all else about the package is in setup.cfg."""

from pathlib import Path

from setuptools import setup

NAME = "paul_ros"
BAGS = ("one_person", "two_persons_crossing")  # what `paul demo` plays


def shared(folder: str) -> tuple[str, list[str]]:
    """The files of one top-level folder, to be put under share/paul_ros."""
    return f"share/{NAME}/{folder}", sorted(str(path) for path in Path(folder).iterdir() if path.is_file())


setup(
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"lib/{NAME}", [f"lib/{NAME}/lifter", f"lib/{NAME}/paul"]),
        *(shared(folder) for folder in ("launch", "config", "rviz", "foxglove", "sros2")),
        (f"share/{NAME}/bags", ["bags/ACKNOWLEDGEMENT.md", *(f"bags/{name}.mcap" for name in BAGS)]),
    ],
)
