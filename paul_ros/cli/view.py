# SPDX-License-Identifier: Apache-2.0
"""`paul view`: a film of a bag, lifted, or of a model's shapes."""

from __future__ import annotations

import argparse
from pathlib import Path

from paul_ros.cli.options import Commands, HelpFormatter, add_filters, add_image, add_model, add_topics, seconds
from paul_ros.cli.output import check_files
from paul_ros.cli.progress import drawing

_EPILOG = """\
The film of a bag shows the 2D input, the persons from above, and a turntable. Points that the camera did
not see are pale. A person whose mirror image fits nearly as well has an amber rim, and so has the title.
A film has at most 200 pictures, ten a second. The steps of a longer bag are larger: choose a part of it
with --start and --seconds. The film of a model shows its mean shape, then shapes whose codes swing along
their first modes.

examples:
  paul view bags/one_person.mcap
                         writes one_person.gif
  paul view lifted.mcap --start 60 --seconds 15 -o walk.mp4
  paul view hand.npz -o hand.png
                         a few pictures below each other
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "view",
        description="Draw a film of a bag, lifted through the code of the node, or of a model's shapes.",
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "thing", metavar="THING", help="recording (.mcap, .db3 or rosbag2 folder), model file, or shipped model"
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        type=Path,
        help=".gif, .mp4 (needs ffmpeg) or .png (default: the name of THING with .gif)",
    )
    parser.add_argument(
        "--start",
        metavar="S",
        type=seconds,
        default=0.0,
        help="seconds from the bag's first keypoints to the film's start (default: %(default)g)",
    )
    parser.add_argument(
        "--seconds", metavar="S", type=seconds, help="length of the part of the bag (default: to its end)"
    )
    add_model(parser)
    parser.add_argument(
        "--layout", help="layout of the bag's keypoints: a name or a .yaml file (default: found from the messages)"
    )
    add_filters(parser)
    add_topics(parser)
    add_image(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Draw the film.

    Raises:
        BagError: the bag is damaged; the film shows the whole messages.
    """
    from paul_ros.model_file import load_model
    from paul_ros.offline.bag_folder import is_bag
    from paul_ros.offline.bag_topics import Topics
    from paul_ros.offline.film import view_bag
    from paul_ros.offline.film_model import view_model
    from paul_ros.stream.stream import open_stream

    thing, damage = Path(args.thing), None
    output = args.output or Path(f"{thing.stem}.gif")
    check_files([output], [thing, args.model, args.layout])
    if is_bag(thing):
        topics = Topics(args.topic, args.camera_info_topic)
        parameters = {name: getattr(args, name) for name in ("min_confidence", "max_persons", "image")}
        stream = open_stream(args.model, args.layout, **parameters)
        film, damage = view_bag(thing, stream, output, topics, args.start, args.seconds, drawing)
    else:
        film = view_model(load_model(args.thing), output, drawing)
    print(f"{film.path}: {film.summary}")
    if damage:
        raise damage
