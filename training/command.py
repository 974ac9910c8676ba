# SPDX-License-Identifier: Apache-2.0
"""``paul train``: 2D keypoints in, a model file out, or the 3D shapes of the very frames."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from paul_ros.files import write_atomically
from paul_ros.layout import Layout, load_layout
from paul_ros.model import check_size
from paul_ros.offline.bag import check_outputs
from paul_ros.stream.parameters import DEFAULTS
from training.categories import load_files
from training.checkpoint import CHECKPOINT, LOG
from training.data import TrainingData, check_sizes
from training.distributed import from_first, is_first, joined
from training.encoder_fit import fit_encoder
from training.errors import DataError, MocapError, RecipeError, TrainingError
from training.export import architecture, export_model
from training.people.human_data import check_outside, make_file, motion_files, views_of
from training.people.mocap import human_layout
from training.people.view_settings import Views
from training.progress import Progress
from training.recipe import Recipe, recipe_names
from training.reconstruction import Run, reconstruction_of, restarts, run_folder, train_restarts
from training.start.kept_start import START
from training.tensorboard import FOLDER as BOARD
from training.tensorboard import Board, need_tensorboard
from training.trainer import Trainer

VIEWS = "views.npz"
"""What the run's folder keeps of a folder of motion capture."""

_EXAMPLES = """\
examples:
  paul train recording.mcap -o hand.npz --layout hand.yaml --set bottleneck=6
  paul train CMU_FOLDER -o human.npz --recipe human                 views of motion capture: .asf and .amc, .bvh, .npz
  paul train sequence.npz --recipe nrsfm --shapes shapes.npz        3D shapes of these very frames
  paul train views.npz -o model.npz --set restarts=4                the run of the lowest final loss is kept
  torchrun --nproc-per-node 4 --no-python paul train views.npz -o model.npz

The run is kept in MODEL.run (or SHAPES.run): checkpoint.pt, log.csv and, if the recipe looks for one, start.npz.
Stopped at any time, the same command continues it, to the bit. Several processes train as one does, but for rounding.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.epilog, parser.formatter_class = _EXAMPLES, argparse.RawDescriptionHelpFormatter
    _add_data(parser)
    parser.add_argument(
        "--recipe", default="default", help=f"one of {', '.join(recipe_names())}, or a YAML file (default: %(default)s)"
    )
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="override a setting of the recipe"
    )
    parser.add_argument("--fresh", action="store_true", help="start over instead of continuing the run beside MODEL")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="where the networks train; auto: on a GPU if torch finds one (default: %(default)s)",
    )
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="CPU threads; the networks are small: more gain little, and lose much on a busy machine (default: 1)",
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the model's header and the run's figures")
    parser.add_argument("--tensorboard", action="store_true", help="write logs for TensorBoard beside the checkpoint")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _add_data(parser: argparse.ArgumentParser) -> None:
    """What is read and what is written."""
    parser.add_argument(
        "data",
        metavar="DATA",
        nargs="+",
        help="npz with W (F,2,P) and optional visible (F,P), a bag of 2D keypoints, or a folder of motion capture of "
        "people; several files: recordings of one layout, or else categories of objects, each file one",
    )
    parser.add_argument("-o", "--output", metavar="MODEL", type=Path, help="model file to write (.npz)")
    parser.add_argument(
        "--shapes",
        metavar="SHAPES",
        type=Path,
        help="write the 3D shapes of the frames themselves (.npz); with it, no MODEL need be written",
    )
    parser.add_argument(
        "--layout",
        help="layout of the points: a shipped name, points41 for 41 points without names, or a YAML file "
        "(default: coco17 for 17 points and for bags, else points without names)",
    )
    parser.add_argument(
        "--topic", help="topic of a bag, where it has several with 2D keypoints; * matches any part of a name"
    )
    parser.add_argument(
        "--min-confidence",
        type=float,
        default=DEFAULTS["min_confidence"],
        metavar="C",
        help="keypoints of a bag below it count as hidden, as in the node (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Train, or continue, and export.

    Raises:
        PaulError: bad data, recipe or file.
        KeyboardInterrupt: with a text, what was stopped and how it goes on.
    """
    if args.threads < 1:
        raise TrainingError(f"--threads must be at least 1, it is {args.threads}")
    recipe = Recipe.load(args.recipe, args.set)
    folders = _run_folders(args, recipe)
    torch.set_num_threads(args.threads)
    device = _device(args.device)
    with joined(device):
        data, recipe = _load(args, recipe, device)
        data = replace(data, notes=(*data.notes, *check_sizes(data, recipe.scale), *_unused(data, recipe)))
        if args.fresh and is_first():
            _forget(folders)
        _introduce(data, args)
        runs = train_restarts(data, recipe, _folder(args), device, lambda trainer: _watch(trainer, args))
        if is_first():
            _write(runs, args)
    return 0


def _unused(data: TrainingData, recipe: Recipe) -> tuple[str, ...]:
    if data.detected is None or recipe.hold:
        return ()
    return (
        "its detected points are left unused: only where solutions are held (setting hold) does h learn to read them",
    )


def _load(args: argparse.Namespace, recipe: Recipe, device: torch.device) -> tuple[TrainingData, Recipe]:
    """The data, and the recipe, which keeps its views only where they are taken: of a folder of motion capture."""
    layout = load_layout(args.layout) if args.layout else None
    if capture := _motion_capture(args):
        return _load_people(capture, args, recipe, layout or human_layout(), device), recipe
    data = load_files(args.data, layout, args.topic, args.min_confidence)
    _check(args, recipe, data.layout)
    return data, replace(recipe, views=None)


def _load_people(
    capture: Path, args: argparse.Namespace, recipe: Recipe, layout: Layout, device: torch.device
) -> TrainingData:
    """Views of motion capture; they take minutes, so all that can be told before is."""
    views, path = views_of(recipe), _folder(args) / VIEWS
    given, named = len(human_layout().names), len(layout.names)
    if given != named:
        raise DataError(
            f"motion capture gives the {given} points of layout {human_layout().name}, not the {named} of "
            f"{layout.name}: leave out --layout {args.layout}"
        )
    _check(args, recipe, layout)
    if wrong := from_first(lambda: _make_views(capture, views, path, args), device):
        raise MocapError(wrong.decode())
    return load_files([path], layout)


def _make_views(capture: Path, views: Views, path: Path, args: argparse.Namespace) -> bytes | None:
    """What went wrong, for all processes: one that raised here would leave the others waiting."""
    try:
        if args.fresh:
            path.unlink(missing_ok=True)
        make_file(capture, views, path, quiet=args.quiet)
    except (MocapError, OSError) as error:
        return str(error).encode()
    return None


def _motion_capture(args: argparse.Namespace) -> Path | None:
    """The data, where it is a folder of motion capture, not a bag's."""
    path = Path(args.data[0])
    one = len(args.data) == 1 and path.is_dir() and not (path / "metadata.yaml").exists()
    return path if one and motion_files(path) else None


def _folder(args: argparse.Namespace) -> Path:
    return (args.output or args.shapes).with_suffix(".run")


def _run_folders(args: argparse.Namespace, recipe: Recipe) -> list[Path]:
    """Folders of the restarts, after a look at whether all that will be written can be."""
    if not args.output and not args.shapes:
        raise DataError("nothing to write: name a model file with -o, or a file of 3D shapes with --shapes")
    for path in filter(None, (args.output, args.shapes)):
        if path.suffix != ".npz":
            raise DataError(f"the file must end in .npz, not '{path.name}'")
    if capture := _motion_capture(args):
        check_outside(capture, (args.output, args.shapes, args.json))
    folders = [run_folder(_folder(args), recipe, one.seed) for one in restarts(recipe)]
    kept = [folder / name for folder in folders for name in (CHECKPOINT, LOG, START)]
    check_outputs([args.output, args.shapes, args.json, *kept], [*args.data, args.recipe, args.layout])
    return folders


def _check(args: argparse.Namespace, recipe: Recipe, layout: Layout) -> None:
    """What can be told before the first step."""
    try:
        recipe.check_points(layout)
    except RecipeError as error:
        if recipe.known_lengths != Recipe.load(args.recipe).known_lengths:
            raise
        raise RecipeError(f"recipe {args.recipe} is for layouts with the points that it names: {error}") from error
    if args.output and not recipe.steps and not recipe.regression_steps:
        raise RecipeError("no networks are trained with steps: 0, so there is no model: ask for --shapes instead of -o")
    if args.output:
        check_size(architecture(recipe), len(layout.names))
    if args.tensorboard:
        need_tensorboard()


def _device(name: str) -> torch.device:
    """The device, and torch told to compute the same there every time as far as it can."""
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise TrainingError("torch finds no GPU here: use --device cpu, or install a torch that is built for yours")
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(device)
    return device


def _forget(folders: list[Path]) -> None:
    for folder in folders:
        for name in (CHECKPOINT, LOG, START):
            (folder / name).unlink(missing_ok=True)
        shutil.rmtree(folder / BOARD, ignore_errors=True)


def _introduce(data: TrainingData, args: argparse.Namespace) -> None:
    if not is_first():
        return
    left_out = f", {data.left_out} left out (too few points, or all on one line)" if data.left_out else ""
    print(f"{len(data.W)} frames of layout {data.layout.name} from {data.source}{left_out}", file=sys.stderr)
    for note in data.notes:
        print(f"note: {note}", file=sys.stderr)


def _watch(trainer: Trainer, args: argparse.Namespace) -> None:
    """Train to the end, showing and logging how it goes."""
    begun, quiet = trainer.step, args.quiet or not is_first()
    if begun and is_first():
        print(f"seed {trainer.recipe.seed}: continuing at step {begun}", file=sys.stderr)
    board = Board(trainer.folder, begun) if args.tensorboard and is_first() else None
    try:
        _prepare(trainer, quiet)
        with _bar(quiet or not trainer.steps, total=trainer.steps, initial=begun, unit="step") as bar:
            for row in trainer.run():
                bar.update()
                if board:
                    board.write(row)
                if row["step"] % 20 == 0:
                    losses = {"loss": row["loss"], "ae": row["recon_ae"], "ad": row["recon_ad"]}
                    bar.set_postfix({name: f"{value:.4f}" for name, value in losses.items()}, refresh=False)
    except KeyboardInterrupt:
        told = f"stopped at step {trainer.step} of {trainer.steps}: the same command continues"
        if trainer.recipe.start != "random" and trainer.start is None:
            told = "stopped while searching for a start: the same command begins again"
        raise KeyboardInterrupt(told) from None
    finally:
        if board:
            board.close()


def _prepare(trainer: Trainer, quiet: bool) -> None:
    if trainer.recipe.start == "random":
        return
    with _share_bar(quiet, f"{trainer.recipe.start} start") as progress:
        trainer.prepare(progress)


@contextlib.contextmanager
def _share_bar(quiet: bool, what: str) -> Iterator[Progress]:
    """A bar that is told the share of the work that is done."""
    layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
    with _bar(quiet, total=1.0, desc=what, bar_format=layout) as bar:
        yield lambda done: bar.update(done - bar.n)


def _bar(quiet: bool, **settings: object) -> tqdm:
    # Into a log file, a line twice a minute.
    interval = 0.1 if sys.stderr.isatty() else 30.0
    return tqdm(disable=quiet, mininterval=interval, dynamic_ncols=True, **settings)


def _write(runs: list[Run], args: argparse.Namespace) -> None:
    """Model and shapes of the best run, and what is said of all of them."""
    best, header = runs[0].trainer, {}
    if args.shapes:
        reconstruction_of(runs).save(args.shapes)
    if args.output:
        if best.recipe.codes == "free":
            _fit_encoder(best, args.quiet)
        header = export_model(best, runs[0].loss, args.output, _command())
    _report(runs, header, args)


def _fit_encoder(trainer: Trainer, quiet: bool) -> None:
    try:
        with _share_bar(quiet, "2D encoder") as progress:
            left = fit_encoder(trainer, progress=progress)
    except KeyboardInterrupt:
        told = "stopped while fitting the 2D encoder to the codes: the same command fits it anew, the rest is done"
        raise KeyboardInterrupt(told) from None
    print(
        f"2D encoder fitted to the codes; its shapes are {100 * left:.1f} % of their size off theirs", file=sys.stderr
    )


def _command() -> str:
    """The command as typed, with bare file names: folders of one machine are no provenance."""
    return " ".join(["paul", *(Path(word).name if "/" in word else word for word in sys.argv[1:])])


def _report(runs: list[Run], header: dict, args: argparse.Namespace) -> None:
    if len(runs) > 1:
        print("restarts by final loss, the first is kept:")
        for run in runs:
            print(f"  seed {run.seed}  {_told(run)}  {run.trainer.seconds:.0f} s")
    if args.shapes:
        print(f"{args.shapes}: 3D shapes of {len(runs[0].trainer.data.W)} frames, {_told(runs[0])}")
    if args.output:
        _report_model(runs[0], header, args.output)
    if args.json:
        ranking = [
            {
                "seed": run.seed,
                "loss": run.loss if math.isfinite(run.loss) else None,
                "seconds": round(run.trainer.seconds, 1),
                "chosen": run is runs[0],
            }
            for run in runs
        ]
        write_atomically(args.json, json.dumps({**header, "restarts": ranking}, indent=1).encode())


def _told(run: Run) -> str:
    """A run's loss, by its right name."""
    if math.isinf(run.loss):
        return "diverged"
    if run.trainer.recipe.steps:
        return f"final loss {run.loss:.5f}"
    return f"score of the start {run.loss:.5g} (negative log likelihood a frame, lower is better)"


def _report_model(run: Run, header: dict, path: Path) -> None:
    training, metres = header["training"], header["metres_per_unit"]
    print(
        f"{path}: {training['frames']} frames, {training['steps']} steps, {training['seconds']:.0f} s, {_told(run)}\n"
        f"  scale: {f'{metres:.4f} m per model unit' if metres else 'unknown (no known_lengths in the recipe)'}\n"
        f"  chirality: {'known' if header['chirality']['known'] else 'UNKNOWN'}, {header['chirality']['source']}"
    )
