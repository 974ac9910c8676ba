# SPDX-License-Identifier: Apache-2.0
"""`paul demo`: the real node over DDS, fed with the shipped bags and checked."""

from __future__ import annotations

import argparse
from pathlib import Path

from paul_ros.cli.options import Commands, add_model


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "demo",
        description="Start the ROS 2 node and play the shipped bags to it over DDS in real time. Record what it "
        "publishes, and check that against the ground truth and against `paul replay`.",
    )
    parser.add_argument(
        "--out",
        metavar="FOLDER",
        type=Path,
        default=Path("out/demo"),
        help="folder of recordings, pictures and report.json (default: %(default)s)",
    )
    add_model(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Run the demo."""
    from paul_ros.extras import require
    from paul_ros.offline.demo import demo

    require("bags", "rich")
    demo(args.out, args.model)
