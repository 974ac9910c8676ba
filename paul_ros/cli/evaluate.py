# SPDX-License-Identifier: Apache-2.0
"""`paul evaluate`: a model on unseen frames, or a reconstruction, against the 3D truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from paul_ros.cli.options import Commands, HelpFormatter, add_json, add_plot
from paul_ros.cli.output import STDOUT, check_files, publish
from paul_ros.cli.progress import progress

_DESCRIPTION = "Judge a model on frames it never saw, each lifted alone, or judge a saved reconstruction."
_EPILOG = """\
DATA is an npz with
  W:        (F,2,P) image points, y down; S and W share one scale
  S:        (F,3,P) the truth in the camera frame; NaN where it is unknown,
            with K or calibrated also (0, 0, 0)
  visible:  (F,P) optional; the model sees visible points only, but errors
            cover all points
  K:        (3,3) optional; then W are pixels of this camera, and S is in its
            units from the camera
  calibrated: optional; if true, W are rays (x/z, y/z), as with K
  edges:    (E,2) optional, for the picture
  metres:   optional; if true, distances are given in mm, otherwise in the
            units of W

examples:
  paul evaluate person.npz unseen.npz --json errors.json --plot errors.png
                         lifts every frame alone: encoder, decoder,
                         orthographic-N-point
  paul evaluate shapes.npz --truth drink.npz
                         judges the shapes that `paul train --shapes
                         shapes.npz` reconstructed; frames and their order must
                         be those of the truth

NE is |S - truth| / |truth| of the centred shapes, without alignment. Mirror images look alike under an
orthographic camera: "flip per frame" may mirror each frame, "one flip for all" only the whole set.
"Rotated and scaled to fit" is the error of Deep NRSfM (Kong and Lucey, ICCV 2019). It is milder than the other two:
the prediction is first scaled and rotated or reflected onto the truth. The baseline is the rigid mean shape.
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "evaluate",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("model", metavar="MODEL", help="model file or shipped model; with --truth saved shapes (.npz)")
    parser.add_argument("data", metavar="DATA", type=Path, nargs="?", help="npz with W and the truth S, see below")
    parser.add_argument(
        "--truth",
        metavar="DATA",
        type=Path,
        help="npz with the truth S; MODEL is then a file of shapes that `paul train --shapes` wrote",
    )
    add_json(parser)
    add_plot(parser, "frames over their truth, and all errors")
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> None:
    """Judge the model or the shapes, write the files, print the table."""
    from paul_ros.extras import require

    if (args.data is None) == (args.truth is None):
        args.usage_error("name DATA for a model, or --truth DATA for saved shapes")
    check_files([args.json, args.plot], [args.model, args.data, args.truth])
    if args.plot:
        require("benchmark", "matplotlib")
    if args.json != STDOUT:
        require("train", "rich")
    from training.judge import evaluation

    if args.truth:
        require("train", "torch")
        report, compared = evaluation.evaluate_shapes(args.model, args.truth)
    else:
        with progress("evaluate") as count:
            report, compared = evaluation.evaluate_model(args.model, args.data, count)

    def draw() -> None:
        from training.judge.evaluation_picture import write_picture

        write_picture(args.plot, compared, f"{Path(args.model).stem} on {compared.truth.name}")

    publish(report, evaluation.table, args.json, draw if args.plot else None)
