# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark node`: latency, CPU time and memory of the ROS 2 node, beside a node that does not lift."""

from __future__ import annotations

import argparse

from paul_ros.cli.options import Commands, HelpFormatter, add_json, add_plot, minutes, positive, positives
from paul_ros.cli.output import check_files, publish

_EPILOG = """\
Publisher, node and listener are three processes that talk over DDS on this machine. The publisher sends the
poses of a shipped bag, spread over the image, as organised PointCloud2, and a CameraInfo. The echo node is
the baseline: it makes a PoseArray of as many poses from the same message, and lifts nothing. The two nodes
take turns of about two seconds.

columns, a line for each number of persons, rate and node; times in µs:
  received: messages that a PoseArray answered, of those sent
  median:   from the publisher's stamp to the arrival of the answer at the
            listener, which takes serialised messages; then the 99th percentile
  CPU:      time that all threads of the node's process used, per frame
  MB:       resident memory after the last frame
  x echo:   the median over the echo node's; then the same for the 99th
            percentiles
  + CPU:    CPU time minus that of the echo node

Start to first output counts from the start of the process, with a detector already running: median of three.

Other work on the machine spoils the figures: compare the load in the report.

examples:
  paul benchmark node
  paul benchmark node --persons 1,10 --rates 100 --seconds 30 \\
      --json node.json --plot node.png
  paul benchmark node --soak 30 --persons 10 --rates 100
                         memory over half an hour
"""


def add_parser(subjects: Commands) -> None:
    """Add the subject."""
    parser = subjects.add_parser(
        "node",
        help="the ROS 2 node: latency, CPU time and memory, beside a node that does not lift",
        description="Measure latency, CPU time and memory of the ROS 2 node, and of a baseline that does not lift.",
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "--persons", metavar="A,B", type=positives, default=[1, 10, 50], help="persons in an image (default: 1,10,50)"
    )
    parser.add_argument(
        "--rates", metavar="A,B", type=positives, default=[30, 100], help="images per second (default: 30,100)"
    )
    parser.add_argument(
        "--seconds", metavar="S", type=positive, default=10, help="seconds for each line (default: %(default)s)"
    )
    parser.add_argument(
        "--soak",
        metavar="MINUTES",
        type=minutes,
        help="instead run the lifter alone for this long, with the most persons and the highest rate; memory over time",
    )
    add_json(parser, "all rows")
    add_plot(parser, "latencies and CPU times, or memory")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Run the benchmark, write the files, print the table."""
    from paul_ros.extras import require

    require("benchmark", "tqdm", "rich", *(["matplotlib"] if args.plot else []))
    from paul_ros.benchmarks.node import run as benchmark
    from paul_ros.benchmarks.node import soak
    from paul_ros.benchmarks.node_report import table, write_picture

    check_files([args.json, args.plot], [])
    if args.soak:
        report = soak(max(args.persons), max(args.rates), args.soak)
    else:
        report = benchmark(args.persons, args.rates, args.seconds)
    publish(report, table, args.json, (lambda: write_picture(args.plot, report)) if args.plot else None)
