# SPDX-License-Identifier: Apache-2.0
"""Install the files that ROS needs outside Python packages; setup.cfg has all other metadata."""

from pathlib import Path

from setuptools import setup

NAME = "paul_ros"
BAGS = ("one_person", "two_persons_crossing")  # played by `paul demo`


def shared(folder: str) -> tuple[str, list[str]]:
    """Return the target under share/paul_ros and the files of one top-level folder."""
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
