# SPDX-License-Identifier: Apache-2.0
"""`paul train`: 2D keypoints in, a model file out, or the 3D shapes of the given frames."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

from paul_ros.cli.options import Commands, HelpFormatter, add_camera_info_topic, add_image, add_json, add_min_confidence
from paul_ros.cli.output import STDOUT, publish
from paul_ros.extras import require

_EXAMPLES = """\
examples:
  paul train recording.mcap -o hand.npz --layout hand.yaml --set bottleneck=6
  paul train CMU_FOLDER -o human.npz --recipe human
                         views of motion capture: .asf and .amc, .bvh, .npz
  paul train sequence.npz --recipe nrsfm --shapes shapes.npz
                         3D shapes of the given frames
  paul train views.npz -o model.npz --set restarts=4
                         the run of the lowest final loss is kept
  torchrun --nproc-per-node 4 --no-python paul train views.npz -o model.npz

The run is kept in MODEL.run (or SHAPES.run): checkpoint.pt, log.csv and, if the recipe
searches for a start, start.npz. The same command continues a stopped run, to the bit.
Several processes train as one does, up to rounding.
"""


def add_parser(commands: Commands) -> None:
    """Add the command to `paul`."""
    parser = commands.add_parser(
        "train",
        description="Learn a 3D shape model from 2D keypoints alone.",
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    add_arguments(parser)
    parser.set_defaults(run=run)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    _add_data_arguments(parser)
    _add_output_arguments(parser)
    _add_training_arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Train, or continue, and write what was asked for.

    Raises:
        PaulError: bad data, recipe or file, or a missing package.
        KeyboardInterrupt: its text says what was stopped and how to go on.
    """
    from training.options import TrainingOptions
    from training.preflight import prepare

    job = prepare(
        TrainingOptions(
            data=tuple(args.data),
            model=args.output,
            shapes=args.shapes,
            json=None if args.json == STDOUT else args.json,
            layout=args.layout,
            topic=args.topic,
            camera_info_topic=args.camera_info_topic,
            image=args.image or "auto",
            min_confidence=args.min_confidence,
            recipe=args.recipe,
            overrides=tuple(args.set),
            fresh=args.fresh,
            device=args.device,
            threads=args.threads,
            tensorboard=args.tensorboard,
            quiet=args.quiet,
            command=_command(),
        )
    )
    # After all checks, since the import takes seconds.
    require("train", "torch", "tqdm")
    from training.session import train

    results = train(job)
    if results:
        publish(results.report, lambda _: results.text, args.json)


def _add_data_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "data",
        metavar="DATA",
        type=Path,
        nargs="+",
        help="npz with W (F,2,P) and optional visible (F,P); a bag of 2D keypoints; or a folder of motion capture of "
        "people. Several files are recordings of one layout, or else categories of objects, one per file",
    )
    parser.add_argument(
        "--layout",
        help="layout of the points: a shipped name, points41 for 41 points without names, or a YAML file "
        "(default: coco17 for 17 points and for bags, else points without names)",
    )
    parser.add_argument("--topic", help="topic of the 2D keypoints, if a bag has several; * matches any part of a name")
    add_camera_info_topic(parser)
    add_image(parser)
    add_min_confidence(parser)


def _add_output_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", metavar="MODEL", type=Path, help="model file to write (.npz)")
    parser.add_argument(
        "--shapes",
        metavar="SHAPES",
        type=Path,
        help="write the 3D shapes of the given frames (.npz); MODEL may then be left out",
    )
    add_json(parser, "the model's header and the run's figures")
    parser.add_argument("--tensorboard", action="store_true", help="write logs for TensorBoard beside the checkpoint")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _add_training_arguments(parser: argparse.ArgumentParser) -> None:
    names = ", ".join(_recipe_names())
    parser.add_argument("--recipe", default="default", help=f"one of {names}, or a YAML file (default: %(default)s)")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="override a setting of the recipe"
    )
    parser.add_argument("--fresh", action="store_true", help="start over instead of continuing the run beside MODEL")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="device of the networks; auto uses a GPU if torch finds one (default: %(default)s)",
    )
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="CPU threads; the networks are small, so more gain little, and lose much on a busy machine (default: 1)",
    )


def _recipe_names() -> list[str]:
    """Return the names of the shipped recipes, by their files: `paul` builds this parser for every command."""
    spec = importlib.util.find_spec("training")
    folders = spec.submodule_search_locations if spec else None
    return sorted(path.stem for folder in folders or () for path in Path(folder, "recipes").glob("*.yaml"))


def _command() -> str:
    """Return the command as typed, with bare file names: folders of one machine are no provenance."""
    return " ".join(["paul", *(Path(word).name if "/" in word else word for word in sys.argv[1:])])
