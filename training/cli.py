# SPDX-License-Identifier: Apache-2.0
"""``paul train``: 2D keypoints in, a model file out."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch
from tqdm import tqdm

from paul_ros.bag import BagError, check_outputs
from paul_ros.files import write_atomically
from paul_ros.model import ModelError, check_size
from paul_ros.parameters import DEFAULTS
from paul_ros.skeleton import LayoutError, load_layout
from training.data import DataError, load_training_data
from training.export import architecture, export_model
from training.recipe import Recipe, RecipeError, recipe_names
from training.trainer import CHECKPOINT, LOG, Trainer, TrainingError

ERRORS = (BagError, DataError, RecipeError, TrainingError, ModelError, LayoutError)
"""What a user can cause and mend; the text of each is one clear line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "data", metavar="DATA", help="npz with W (F,2,P) and optional visible (F,P), or a bag of 2D keypoints"
    )
    parser.add_argument("-o", "--output", metavar="MODEL", required=True, type=Path, help="model file to write (.npz)")
    parser.add_argument(
        "--layout", default="coco17", help="layout of the points: a shipped name or a YAML file (default: %(default)s)"
    )
    parser.add_argument("--topic", help="topic of a bag, where it has several with 2D keypoints")
    parser.add_argument(
        "--min-confidence",
        type=float,
        default=DEFAULTS["min_confidence"],
        metavar="C",
        help="keypoints of a bag below it count as hidden, as in the node (default: %(default)s)",
    )
    parser.add_argument(
        "--recipe", default="default", help=f"one of {', '.join(recipe_names())}, or a YAML file (default: %(default)s)"
    )
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="override a setting of the recipe"
    )
    parser.add_argument("--fresh", action="store_true", help="start over instead of continuing the run beside MODEL")
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="CPU threads; the networks are small: more gain little, and lose much on a busy machine (default: 1)",
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the model's header and the run's figures")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    """Train, or continue, and export. Raises one of ERRORS."""
    if args.output.suffix != ".npz":
        raise DataError(f"the model file must end in .npz, not '{args.output.name}'")
    folder = args.output.with_suffix(".run")
    check_outputs([args.output, args.json, folder / CHECKPOINT, folder / LOG], [args.data, args.recipe, args.layout])
    recipe = Recipe.load(args.recipe, args.set)
    data = load_training_data(args.data, load_layout(args.layout), args.topic, args.min_confidence)
    recipe.check_points(data.layout)
    check_size(architecture(recipe), len(data.layout.names))
    if args.fresh:
        for name in (CHECKPOINT, LOG):
            (folder / name).unlink(missing_ok=True)
    torch.set_num_threads(max(1, args.threads))
    trainer = Trainer(data, recipe, folder)
    resumed = trainer.resume()
    left_out = f", {data.left_out} left out (too few points)" if data.left_out else ""
    print(
        f"{len(data.W)} frames of layout {data.layout.name} from {data.source}{left_out}"
        + (f"; continuing at step {trainer.step}" if resumed else ""),
        file=sys.stderr,
    )
    try:
        _watch(trainer, args.quiet)
    except KeyboardInterrupt:
        raise TrainingError(f"stopped at step {trainer.step} of {recipe.steps}: the same command continues") from None
    header = export_model(trainer, args.output, _command())
    _report(header, args)
    return 0


def _watch(trainer: Trainer, quiet: bool) -> None:
    # Into a log file, a line twice a minute.
    interval = 0.1 if sys.stderr.isatty() else 30.0
    steps, begun = trainer.recipe.steps, trainer.step
    with tqdm(total=steps, initial=begun, unit="step", disable=quiet, mininterval=interval, dynamic_ncols=True) as bar:
        for row in trainer.run():
            bar.update()
            if row["step"] % 20 == 0:
                losses = {"loss": row["loss"], "ae": row["recon_ae"], "ad": row["recon_ad"]}
                bar.set_postfix({name: f"{value:.4f}" for name, value in losses.items()}, refresh=False)


def _command() -> str:
    """The command as typed, with bare file names: folders of one machine are no provenance."""
    return " ".join(["paul", *(Path(word).name if "/" in word else word for word in sys.argv[1:])])


def _report(header: dict, args: argparse.Namespace) -> None:
    training, metres = header["training"], header["metres_per_unit"]
    print(
        f"{args.output}: {training['frames']} frames, {training['steps']} steps, {training['seconds']:.0f} s, "
        f"reconstruction loss {training['final']['recon_ad']:.4f}\n"
        f"  scale: {f'{metres:.4f} m per model unit' if metres else 'unknown (no known_lengths in the recipe)'}\n"
        f"  chirality: {'known' if header['chirality']['known'] else 'UNKNOWN'}, {header['chirality']['source']}"
    )
    if args.json:
        write_atomically(args.json, json.dumps(header, indent=1).encode())
