# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark nrsfm`: reconstructed sequences beside the figures of the paper."""

from __future__ import annotations

import argparse
from pathlib import Path

from paul_ros.cli.options import Commands, HelpFormatter, add_json, add_plot, add_runs, names, share
from paul_ros.cli.output import check_files, publish

_METHODS = "paul,adl,adl_low_rank,linear,rigid"
_EPILOG = """\
A sequence is an npz file of the folder with W (F,2,P) and the truth S (F,3,P) in the camera frame.
The trainer gets W and visible, with the frames shuffled by the seed. The truth judges the result.

methods:
  paul:         encoder and decoder
  adl:          its decoder alone
  adl_low_rank: its decoder alone, with a nuclear norm
  linear:       the linear model that the search starts from
  rigid:        one shape for all frames
  RECIPE:       name or YAML file of a recipe of your own

The work folder keeps every finished run. The same command continues an interrupted benchmark, and trains
only runs that are missing. Other settings, data or versions of this package are other runs. Use --fresh
after you change the program itself.

examples:
  paul benchmark nrsfm --data nrsfm_short --json nrsfm.json --plot nrsfm.png
  paul benchmark nrsfm --data nrsfm_short --sequences drink,yoga \\
      --methods paul,linear --seeds 20
  paul benchmark nrsfm --data nrsfm_short --methods paul --hide 0.3 \\
      --set bottleneck=8
"""


def add_parser(subjects: Commands) -> None:
    """Add the subject."""
    parser = subjects.add_parser(
        "nrsfm",
        help="non-rigid structure from motion: the paper's table beside ours",
        description="Reconstruct sequences by several methods and seeds. Print errors beside the published ones.",
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--data", metavar="FOLDER", type=Path, required=True, help="folder of npz files")
    parser.add_argument("--sequences", metavar="A,B", type=names, help="file names without suffix (default: all)")
    parser.add_argument("--methods", metavar="A,B", type=names, default=_METHODS, help="see below (default: all five)")
    parser.add_argument(
        "--hide",
        metavar="SHARE",
        type=share,
        default=0.0,
        help="share of every frame's points to hide at random (default: %(default)g)",
    )
    add_runs(parser)
    parser.add_argument(
        "--work",
        metavar="FOLDER",
        type=Path,
        default=Path("out/benchmark_nrsfm"),
        help="folder that keeps the runs (default: %(default)s)",
    )
    add_json(parser, "all rows")
    add_plot(parser, "all runs and the published figures")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Run the benchmark, or continue it, write the files, print the table."""
    from paul_ros.extras import require

    check_files([args.json, args.plot], args.data.glob("*.npz"))
    require("train", "torch", "tqdm", "rich")
    if args.plot:
        require("benchmark", "matplotlib")
    from training.judge import nrsfm
    from training.judge.experiments import SeriesOptions

    report = nrsfm.run(
        args.data,
        sequences=args.sequences,
        methods=args.methods,
        seeds=args.seeds,
        hide=args.hide,
        settings=args.set,
        options=SeriesOptions(args.work, args.fresh, args.threads, args.quiet),
    )
    publish(report, nrsfm.table, args.json, (lambda: nrsfm.write_picture(args.plot, report)) if args.plot else None)
