# SPDX-License-Identifier: Apache-2.0
"""`paul study`: one question about the method, answered by a table and a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from paul_ros.cli.options import Commands, HelpFormatter, add_runs, natural, numbers
from paul_ros.cli.output import check_files

STUDIES = {
    "bottleneck": "error against the size of the bottleneck, K = 2 to 12",
    "noise": "error against Gaussian noise of the points, as a share of their rms",
    "hidden": "error against the share of hidden points",
    "auto_decoder": "PAUL against its decoder alone (ADL) and ADL + low rank, as bars",
    "latent": "latent spaces of two dimensions, coloured by frame: PAUL against ADL, own and random cameras",
}
"""Studies that train: name -> question."""

_INTERPOLATION = "shapes on the line between two codes of a model"
_WITHOUT_VALUES = ("auto_decoder", "latent")
_EPILOG = """\
FILE is an npz with W and the truth S, as for `paul evaluate`. The trainer gets W and visible only, with
the frames shuffled. The study `interpolation` needs no S. The folder receives STUDY.png and STUDY.json.
Its subfolder work/ keeps the runs, so that the same command continues an interrupted study.

examples:
  paul study bottleneck --data drink.npz yoga.npz --seeds 10 -o out/studies
  paul study hidden --data S5_train.npz --values 0,0.3,0.6 -o out/studies \\
      --set codes=encoder
  paul study latent --data drink.npz pickup.npz -o out/studies
  paul study interpolation --model person.npz --data person2d.npz \\
      --frames 10,250 -o out/studies
"""


def add_parser(commands: Commands) -> None:
    """Add the command with its studies."""
    parser = commands.add_parser(
        "study",
        description="Answer one question about the method with a table and a picture.",
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    studies = parser.add_subparsers(metavar="STUDY", required=True)
    for name, question in STUDIES.items():
        study = _add_study(studies, name, question)
        if name not in _WITHOUT_VALUES:
            study.add_argument(
                "--values", metavar="A,B", type=numbers, default=(), help="values to try (default: the study's own)"
            )
        add_runs(study)
        study.set_defaults(run=run, study=name, values=())
    interpolation = _add_study(studies, "interpolation", _INTERPOLATION)
    interpolation.add_argument("--model", required=True, help="model file, or the name of a shipped model")
    interpolation.add_argument(
        "--frames",
        metavar="A,B",
        type=_two_frames,
        help="frames whose codes are the ends of the line (default: the two whose codes differ most)",
    )
    interpolation.set_defaults(run=run_interpolation)


def _add_study(studies: Commands, name: str, question: str) -> argparse.ArgumentParser:
    description = f"{question[0].upper()}{question[1:]}."
    parser = studies.add_parser(
        name, help=question, description=description, epilog=_EPILOG, formatter_class=HelpFormatter
    )
    parser.add_argument("--data", metavar="FILE", type=Path, nargs="+", required=True, help="npz files, see below")
    parser.add_argument(
        "-o", "--output", metavar="FOLDER", type=Path, required=True, help="folder of table, picture and runs"
    )
    return parser


def _two_frames(text: str) -> tuple[int, int]:
    """Parse two different frames, as in 10,250."""
    words = text.split(",")
    if len(words) != 2 or words[0] == words[1]:
        raise argparse.ArgumentTypeError(f"'{text}' is not two different frames, as in 10,250")
    return natural(words[0]), natural(words[1])


def run(args: argparse.Namespace) -> None:
    """Train the study's runs, or continue, and print its table."""
    from paul_ros.extras import require

    check_files([args.output / f"{args.study}.{kind}" for kind in ("json", "png")], args.data)
    require("benchmark", "matplotlib")
    require("train", "torch", "tqdm", "rich")
    from training.judge.experiments import SeriesOptions
    from training.judge.studies import registry, study

    options = SeriesOptions(args.output / "work", args.fresh, args.threads, args.quiet)
    chosen = registry.STUDIES[args.study]
    print(study.run(chosen, args.data, args.output, args.seeds, tuple(args.values), args.set, options))


def run_interpolation(args: argparse.Namespace) -> None:
    """Draw the shapes and print their table."""
    from paul_ros.extras import require

    check_files([args.output / f"interpolation.{kind}" for kind in ("json", "png")], [args.model, *args.data])
    require("benchmark", "matplotlib", "rich")
    from training.judge.studies import interpolation

    print(interpolation.run(args.model, args.data, args.output, args.frames))
