# SPDX-License-Identifier: Apache-2.0
"""`paul inspect`: a summary of a model, a bag or a layout."""

from __future__ import annotations

import argparse

from paul_ros.cli.options import Commands, HelpFormatter, add_json
from paul_ros.cli.output import check_files, publish

_EPILOG = """\
examples:
  paul inspect human
  paul inspect coco17
  paul inspect bags/one_person.mcap --json -
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "inspect",
        description="Summarise a model, a bag or a keypoint layout.",
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "thing",
        metavar="THING",
        help="name of a shipped model or layout, or a path: .npz model, .yaml layout, or a recording "
        "(.mcap, .db3 or rosbag2 folder)",
    )
    add_json(parser, "the summary")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Print the summary.

    Raises:
        BagError: the bag is damaged; the summary is of the whole messages.
    """
    from paul_ros.offline.inspection import as_text, inspect

    check_files([args.json], [args.thing])
    summary, damage = inspect(args.thing)
    publish(summary, as_text, args.json)
    if damage:
        raise damage
