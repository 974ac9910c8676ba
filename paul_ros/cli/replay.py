# SPDX-License-Identifier: Apache-2.0
"""`paul replay`: lift a recorded bag and judge it against its ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from paul_ros.cli.options import (
    PICTURES,
    Commands,
    HelpFormatter,
    add_filters,
    add_image,
    add_json,
    add_model,
    add_output_layout,
    add_person_height,
    add_topics,
)
from paul_ros.cli.output import STDOUT, check_files, check_suffix, publish
from paul_ros.cli.progress import progress
from paul_ros.stream.option_advice import in_options

_DESCRIPTION = """\
Lift every 2D keypoint message of a bag through the code of the node. Equal input gives equal output.
The command prints a table of errors if the bag has a ground truth.
"""
_EPILOG = """\
All whole messages of a damaged bag are lifted. The exit code is then 1, and also if nobody could be lifted.

examples:
  paul replay recording.mcap -o lifted.mcap
  paul replay recording.mcap --layout h36m17 --plot errors.png
  paul replay recording.mcap --json - | python3 -m json.tool
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "replay",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="recording: .mcap or .db3 file, or rosbag2 folder")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT.mcap",
        type=Path,
        help="write the lifted bag: /lifter/poses, bodies, persons, keypoints3d, markers, layout, and the input topics",
    )
    add_json(parser)
    parser.add_argument(
        "--plot", metavar="FILE.png", type=Path, help="draw frames over their truth, and errors over time"
    )
    add_model(parser)
    parser.add_argument(
        "--layout", help="layout of the bag's keypoints: a name or a .yaml file (default: found from the messages)"
    )
    add_output_layout(parser)
    add_person_height(parser)
    parser.add_argument(
        "--smoothing",
        type=float,
        metavar="HZ",
        help="cut-off frequency of the smoothing over time, as the node's parameter `smoothing` (default: off)",
    )
    add_filters(parser)
    add_topics(parser)
    add_image(parser)
    parser.add_argument(
        "--depth-topic",
        metavar="TOPIC",
        help="topic of depth images aligned to the image of the keypoints (default: /depth)",
    )
    parser.add_argument(
        "--ground-truth-topic",
        metavar="TOPIC",
        help="topic of the truth: PoseArray, metres, camera frame, person by person (default: /ground_truth/poses)",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Lift the bag, write the files, print the table.

    Raises:
        BagError: the bag is damaged (after all was written), or nobody could be lifted.
    """
    from paul_ros.errors import BagError
    from paul_ros.extras import require
    from paul_ros.offline.bag_topics import Topics
    from paul_ros.offline.judge import Judge
    from paul_ros.offline.picture import MOST_FRAMES, write_picture
    from paul_ros.offline.replay import replay
    from paul_ros.offline.report import table
    from paul_ros.stream.stream import open_stream

    check_files([args.output, args.json, args.plot], [args.bag, args.model, args.layout, args.output_layout])
    check_suffix(args.output, [".mcap"])
    check_suffix(args.plot, PICTURES)
    if args.json != STDOUT:
        require("bags", "rich")
    names = ("output_layout", "person_height", "smoothing", "min_confidence", "max_persons", "image")
    parameters = {name: getattr(args, name) for name in names}
    stream = open_stream(args.model, args.layout, **parameters)
    wanted = Topics(args.topic, args.camera_info_topic, args.ground_truth_topic, args.depth_topic)
    topics = wanted.found_in(args.bag)
    judge = Judge(stream, expects_truth=topics.truth is not None)
    with progress("replay") as count:
        kept = MOST_FRAMES if args.plot else 0
        done = replay(args.bag, stream, args.output, topics, lambda: count(1), judge, kept)
    report = judge.report(done)
    report["advice"] = {reason: in_options(text, vars(args)) for reason, text in report["advice"].items()}
    publish(report, table, args.json, (lambda: write_picture(args.plot, done)) if args.plot else None)
    written = [str(path) for path in (args.output, args.json, args.plot) if path]
    if written and args.json != STDOUT:
        print(f"written: {', '.join(written)}")
    if not report["lifted"] and done.drop_advice:
        raise BagError(f"{args.bag}: nobody could be lifted: {' '.join(done.drop_advice)}")
    if done.damage:
        raise done.damage
