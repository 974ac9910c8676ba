# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark onp`: optimality, residuals and times of five orthographic-N-point solvers."""

from __future__ import annotations

import argparse

from paul_ros.cli.options import Commands, HelpFormatter, add_json, add_plot, natural, positive
from paul_ros.cli.output import check_files, publish

_DESCRIPTION = """\
Solve random orthographic-N-point problems by five methods, on one thread, and compare them with the
optimum that a naive search finds. Then measure the 3D error if the shape is known up to 20 % noise.
"""
_EPILOG = """\
columns, a line for each scenario and method:
  cases:    problems solved; lm_search is slow and solves only the first 200
            of a scenario
  cert. %:  share that is proven to be the global optimum (ours only)
  wrong:    number of proven ones that the naive search beats: must be 0
  missed:   number of poses with more than the best known residual
  better:   number of poses with less residual than ours
  angle:    degrees to the optimum: median, then 95th percentile
  ratio:    residual over that of the optimum: median, then the largest
  µs:       time of one pose, called alone: best of several calls, median of
            several problems; polar and majorise solve only batches, so this is
            mostly the price of NumPy's calls
  µs batch: time of a pose in one call with --batch of them
  x lsq:    µs batch over that of lsq_svd

Residuals are mean squared distances; differences below 1e-9 of the image's mean square count as equal.
Noise is the standard deviation of each image coordinate over the shape's rms radius / sqrt(3), both in the
unit of the image.

methods:
  ours:      paul_ros.onp
  lsq_svd:   least squares, then SVD (Wang and Lucey, CVPR 2021)
  polar:     viewing direction of the affine fit, then Procrustes (polar
             factor) in the plane across it
  majorise:  200 steps of majorisation (Kiers; ten Berge) from lsq_svd
  lm_search: Levenberg-Marquardt from 8 spread rotations

examples:
  paul benchmark onp
  paul benchmark onp --cases 200 --batch 1000 --json onp.json --plot onp.png
"""


def add_parser(subjects: Commands) -> None:
    """Add the subject."""
    parser = subjects.add_parser(
        "onp",
        help="orthographic-N-point: optimality, residuals and times of five solvers",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "--cases", metavar="N", type=positive, default=4400, help="problems in a scenario (default: %(default)s)"
    )
    parser.add_argument(
        "--batch", metavar="N", type=positive, default=10_000, help="poses in one call (default: %(default)s)"
    )
    parser.add_argument("--seed", type=natural, default=0, help="seed of the random problems (default: %(default)s)")
    add_json(parser, "all rows")
    add_plot(parser, "angles, residuals, times and 3D errors")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Run the benchmark, write the files, print the table."""
    from paul_ros.extras import require

    require("benchmark", "scipy", "tqdm", "rich", *(["matplotlib"] if args.plot else []))
    from paul_ros.benchmarks.onp import run as benchmark
    from paul_ros.benchmarks.onp_report import table, write_picture

    check_files([args.json, args.plot], [])
    report = benchmark(args.cases, args.batch, args.seed)
    publish(report, table, args.json, (lambda: write_picture(args.plot, report)) if args.plot else None)
