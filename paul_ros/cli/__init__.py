# SPDX-License-Identifier: Apache-2.0
"""`paul`: one command for what is done off the robot. Everything heavy is imported by the subcommand that needs it."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from paul_ros import __version__


class Ticker:
    """A line on stderr that counts, where someone is watching."""

    def __init__(self, what: str):
        self.what, self.count, self._shown = what, 0, 0.0

    def __enter__(self) -> Ticker:
        return self

    def __call__(self, count: int = 1) -> None:
        self.count += count
        if sys.stderr.isatty() and time.monotonic() - self._shown > 0.1:
            self._shown = time.monotonic()
            print(f"\r{self.what}: {self.count} frames", end="", file=sys.stderr, flush=True)

    def __exit__(self, *error: object) -> None:
        if self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _add_replay(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "replay",
        help="lift a recorded bag in code and judge it",
        description="Lift every 2D keypoint message of a bag, deterministically, through the code of the node. "
        "Prints a table of errors where the bag has a ground truth. A damaged bag is lifted up to the damage; the exit "
        "code is then 1, as where nobody could be lifted.",
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help=".mcap file or rosbag2 folder")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT.mcap",
        type=Path,
        help="write the lifted bag: /lifter/poses, bodies, keypoints3d, markers, layout and the input topics",
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the report as JSON")
    parser.add_argument(
        "--plot", metavar="FILE.png", type=Path, help="draw frames over their truth, and errors over time"
    )
    parser.add_argument("--model", help="name of a shipped model, or a .npz (default: the shipped human model)")
    parser.add_argument("--layout", help="layout of the bag's keypoints: a name or a .yaml (default: found from them)")
    parser.add_argument(
        "--output-layout",
        metavar="LAYOUT",
        help="layout of what is written and judged: a name, a .yaml, or model (default: as of the node's parameter)",
    )
    parser.add_argument(
        "--person-height", type=float, metavar="METRES", help="of the people in the bag (default: the model's adults)"
    )
    parser.add_argument(
        "--smoothing", type=float, metavar="HZ", help="as the node's parameter: a filter over time (default: off)"
    )
    parser.add_argument(
        "--topic",
        default="/keypoints",
        help="2D keypoints (default: %(default)s); * is any part of a name, as in '/humans/bodies/*/skeleton2d'",
    )
    parser.add_argument(
        "--camera-info-topic",
        default="/camera_info",
        metavar="TOPIC",
        help="without it the output is in model units (default: %(default)s)",
    )
    parser.add_argument(
        "--depth-topic",
        default="/depth",
        metavar="TOPIC",
        help="depth images aligned to the image of the keypoints, if the bag has any (default: %(default)s)",
    )
    parser.add_argument(
        "--ground-truth-topic",
        default="/ground_truth/poses",
        metavar="TOPIC",
        help="PoseArray in metres, in the camera frame, person by person (default: %(default)s)",
    )
    parser.set_defaults(run=_replay)


def _replay(args: argparse.Namespace) -> None:
    from paul_ros.errors import BagError
    from paul_ros.offline.bag import check_outputs
    from paul_ros.offline.replay import Topics, evaluate, replay
    from paul_ros.offline.report import table, write_json, write_picture
    from paul_ros.stream.stream import open_stream

    check_outputs([args.output, args.json, args.plot], [args.bag, args.model, args.layout, args.output_layout])
    topics = Topics(args.topic, args.camera_info_topic, args.ground_truth_topic, args.depth_topic)
    with Ticker("replay") as tick:
        more = {name: getattr(args, name) for name in ("output_layout", "person_height", "smoothing")}
        stream = open_stream(args.model, args.layout, **more)
        done = replay(args.bag, stream, args.output, topics, tick)
    report = evaluate(done)
    if args.json:
        write_json(args.json, report)
    try:
        if args.plot:
            write_picture(args.plot, done)
    finally:
        print(table(report))  # after the files, for who reads it may stop reading
    if not report["lifted"] and done.why_not:
        raise BagError(f"{args.bag}: nobody could be lifted: {'; '.join(done.why_not)}")
    if done.damage:
        raise done.damage


_VIEW_EXAMPLES = """\
The film of a bag: the 2D input, the persons from above, and a turntable. What the camera did not see is pale; a person
whose mirror image fits nearly as well has a rim of amber, and so has the title. A film has at most 200 pictures, ten a
second: a longer bag is shown in larger steps, or choose a part of it. The film of a model: its mean shape, and shapes
whose codes swing along their first modes.

examples:
  paul view bags/one_person.mcap                       one_person.gif
  paul view lifted.mcap --start 60 --seconds 15 -o walk.mp4
  paul view hand.npz -o hand.png                       a few pictures below each other
"""


def _add_view(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "view",
        help="a film of a bag, lifted, or of a model's shapes",
        description="Draw a bag, lifted through the code of the node, or a model's shapes, as a film to look at.",
        epilog=_VIEW_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("thing", metavar="THING", help=".mcap file or rosbag2 folder, model file or shipped model")
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        type=Path,
        help=".gif, .mp4 (needs ffmpeg) or .png (default: THING's name.gif)",
    )
    parser.add_argument(
        "--start", metavar="S", type=_seconds, default=0.0, help="of a bag, from its first keypoints on"
    )
    parser.add_argument("--seconds", metavar="S", type=_seconds, help="of a bag (default: to its end)")
    parser.add_argument("--model", help="to lift a bag: a shipped model, or a .npz (default: the shipped human model)")
    parser.add_argument("--layout", help="of a bag's keypoints: a name or a .yaml (default: found from the messages)")
    parser.add_argument("--topic", default="/keypoints", help="2D keypoints of a bag (default: %(default)s)")
    parser.add_argument(
        "--camera-info-topic", default="/camera_info", metavar="TOPIC", help="of a bag (default: %(default)s)"
    )
    parser.set_defaults(run=_view)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is no number of seconds")
    return seconds


def _view(args: argparse.Namespace) -> None:
    from paul_ros.model import load_model
    from paul_ros.offline.bag import check_outputs
    from paul_ros.offline.film import view_bag, view_model
    from paul_ros.offline.replay import Topics
    from paul_ros.stream.stream import open_stream

    thing, damage = Path(args.thing), None
    output = args.output or Path(f"{thing.stem}.gif")
    check_outputs([output], [thing, args.model, args.layout])
    if thing.is_dir() or thing.suffix in (".mcap", ".part"):
        topics = Topics(args.topic, args.camera_info_topic)
        stream = open_stream(args.model, args.layout)
        film, damage = view_bag(thing, stream, output, topics, args.start, args.seconds, _ticked)
    else:
        film = view_model(load_model(args.thing), output, _ticked)
    print(f"{film.path}: {film.said}")
    if damage:
        raise damage


def _ticked(pictures: Iterable, total: int) -> Iterator:
    with Ticker(f"drawing {total}") as tick:
        for picture in pictures:
            yield picture
            tick()


def _add_inspect(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "inspect",
        help="say what a model, a bag or a layout holds",
        description="Summarise a model, a bag or a keypoint layout.",
    )
    parser.add_argument(
        "thing",
        metavar="THING",
        help="a shipped model or layout by name, or a path: .npz model, .yaml layout, .mcap bag",
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the summary as JSON")
    parser.set_defaults(run=_inspect)


def _inspect(args: argparse.Namespace) -> None:
    from paul_ros.offline.bag import check_outputs
    from paul_ros.offline.inspection import as_text, inspect
    from paul_ros.offline.report import write_json

    check_outputs([args.json], [args.thing])
    summary, damage = inspect(args.thing)
    if args.json:
        write_json(args.json, summary)
    print(as_text(summary))
    if damage:
        raise damage


def _add_demo(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "demo",
        help="run the real node on the recorded bags and check it",
        description="Start the ROS 2 node, play the recordings to it over DDS in real time, record what it publishes, "
        "and check that against the ground truth and against `paul replay`.",
    )
    parser.add_argument("--out", metavar="FOLDER", type=Path, default=Path("out/demo"), help="default: %(default)s")
    parser.add_argument("--model", help="name of a shipped model, or a .npz (default: the shipped human model)")
    parser.set_defaults(run=_demo)


def _demo(args: argparse.Namespace) -> None:
    from paul_ros.offline.demo import demo

    demo(args.out, args.model)


_ONP_COLUMNS = """\
columns, a line for each scenario and method:
  cases     problems solved; lm_search, which is slow, solves only the first 200 of a scenario
  cert. %   share that is proven to be the global optimum (ours only)
  wrong     of these, how many the naive search beats: must be 0
  missed    how many leave more than the best known residual
  better    how many leave less than ours
  angle     degrees to the optimum, median; then the 95th percentile
  ratio     residual over that of the optimum, median; then the largest
  µs        of one pose, called alone: best of several calls, median of several problems; for polar and majorise,
            which have no way of their own for single poses, mostly the price of numpy's calls
  µs batch  a pose, in one call with --batch of them
  x lsq     the time before it over that of lsq_svd
"More" and "less" are by 1e-9 of the image's mean square, in means of squared distances. Noise is the standard
deviation of each image coordinate, over the shape's rms radius / sqrt(3), both in the image's unit.

methods:
  ours       paul_ros.onp
  lsq_svd    least squares, then SVD (Wang and Lucey, CVPR 2021)
  polar      viewing direction of the affine fit, then Procrustes (polar factor) in its plane
  majorise   200 steps of majorisation (Kiers; ten Berge) from lsq_svd
  lm_search  Levenberg-Marquardt from 8 spread rotations
"""


def _add_benchmark(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "benchmark", help="measure this package against others", description="Measure this package against others."
    )
    subjects = parser.add_subparsers(metavar="SUBJECT", required=True)
    _add_benchmark_onp(subjects)
    _add_benchmark_nrsfm(subjects)
    _add_benchmark_node(subjects)


def _add_benchmark_onp(subjects: argparse._SubParsersAction) -> None:
    parser = subjects.add_parser(
        "onp",
        help="orthographic-N-point: optimality, residuals and times of five solvers",
        description="Solve random orthographic-N-point problems by five methods and compare them with the optimum\n"
        "that a naive search finds. One thread. Then the 3D error where the shape is known up to 20 % noise.",
        epilog=_ONP_COLUMNS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--cases", metavar="N", type=_positive, default=4400, help="problems a scenario (default: %(default)s)"
    )
    parser.add_argument(
        "--batch", metavar="N", type=_positive, default=10_000, help="poses in one call (default: %(default)s)"
    )
    parser.add_argument("--seed", type=_natural, default=0, help="of the random problems (default: %(default)s)")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write all rows as JSON")
    parser.add_argument("--plot", metavar="FILE.png", type=_picture, help="draw angles, residuals, times and 3D errors")
    parser.set_defaults(run=_benchmark_onp)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number above 0")
    return int(text)


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix not in (".png", ".svg", ".pdf"):
        raise argparse.ArgumentTypeError(f"'{text}' ends neither in .png nor in .svg or .pdf")
    return path


def _natural(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number from 0 on")
    return int(text)


def _benchmark_onp(args: argparse.Namespace) -> None:
    from paul_ros.benchmarks import need
    from paul_ros.offline.bag import check_outputs
    from paul_ros.offline.report import write_json

    need("scipy", "tqdm", *(["matplotlib"] if args.plot else []))
    from paul_ros.benchmarks.onp import run
    from paul_ros.benchmarks.onp_report import table, write_picture

    check_outputs([args.json, args.plot], [])
    report = run(args.cases, args.batch, args.seed)
    try:
        if args.json:
            write_json(args.json, report)
        if args.plot:
            write_picture(args.plot, report)
    finally:
        print(table(report))


_NRSFM_EXAMPLES = """\
Every npz file of the folder with W (F,2,P) and the truth S (F,3,P) in the camera frame is a sequence. The trainer is
given W and visible, the frames shuffled by the seed; the truth judges what it reconstructed.

methods: paul, adl (its decoder alone), adl_low_rank (and a nuclear norm), linear (the model that the search begins
with), rigid; or the name or YAML file of a recipe of your own.

Runs are kept in the work folder as they finish: the same command goes on where it was interrupted, and trains only
what it has not yet. Another setting, other data or another version of this package is another run; after a change of
the program's own code use --fresh.

examples:
  paul benchmark nrsfm --data nrsfm_short --json nrsfm.json --plot nrsfm.png
  paul benchmark nrsfm --data nrsfm_short --sequences drink,yoga --methods paul,linear --seeds 20
  paul benchmark nrsfm --data nrsfm_short --methods paul --hide 0.3 --set bottleneck=8
"""


def _add_benchmark_nrsfm(subjects: argparse._SubParsersAction) -> None:
    parser = subjects.add_parser(
        "nrsfm",
        help="non-rigid structure from motion: the paper's table beside ours",
        description="Reconstruct sequences by several methods and seeds; errors beside the published ones.",
        epilog=_NRSFM_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--data", metavar="DIR", type=Path, required=True, help="folder of npz files")
    parser.add_argument("--sequences", metavar="A,B", type=_names, help="file names without suffix (default: all)")
    methods = "paul,adl,adl_low_rank,linear,rigid"
    parser.add_argument("--methods", metavar="A,B", type=_names, default=methods, help="default: %(default)s")
    parser.add_argument("--hide", metavar="SHARE", type=_share, default=0.0, help="of every frame's points, at random")
    _add_runs(parser, Path("out/benchmark_nrsfm"))
    parser.add_argument("--json", metavar="FILE", type=Path, help="write all rows as JSON")
    parser.add_argument("--plot", metavar="FILE.png", type=_picture, help="draw all runs and the published figures")
    parser.set_defaults(run=_benchmark_nrsfm)


def _add_runs(parser: argparse.ArgumentParser, work: Path | None) -> None:
    """Options of commands that train many times."""
    parser.add_argument("--seeds", metavar="N", type=_positive, default=3, help="runs of each (default: %(default)s)")
    if work:
        parser.add_argument("--work", metavar="DIR", type=Path, default=work, help="keeps runs (default: %(default)s)")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="override a recipe's setting")
    parser.add_argument("--fresh", action="store_true", help="train again what the work folder has")
    parser.add_argument("--threads", metavar="N", type=_positive, default=1, help="CPU threads (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _keeping(args: argparse.Namespace, work: Path) -> object:
    """How runs are done and kept."""
    from training.judge.experiments import Keeping

    return Keeping(work, args.fresh, args.threads, args.quiet)


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"'{text}' is no list of different names, as in a,b")
    return names


def _share(text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0 <= share < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is no share from 0 to below 1")
    return share


def _benchmark_nrsfm(args: argparse.Namespace) -> None:
    from paul_ros.benchmarks import need
    from paul_ros.offline.bag import check_outputs
    from paul_ros.offline.report import write_json

    check_outputs([args.json, args.plot], args.data.glob("*.npz"))
    need("tqdm", *(["matplotlib"] if args.plot else []))
    with _training_packages():
        from training.judge import nrsfm as benchmark
    report = benchmark.run(
        args.data,
        sequences=args.sequences,
        methods=args.methods,
        seeds=args.seeds,
        hide=args.hide,
        settings=args.set,
        keeping=_keeping(args, args.work),
    )
    try:
        if args.json:
            write_json(args.json, report)
        if args.plot:
            benchmark.write_picture(args.plot, report)
    finally:
        print(benchmark.table(report))


_NODE_COLUMNS = """\
Publisher, node and listener are three processes that speak over DDS, on this machine only. The lifter is sent the poses
of a shipped recording, spread over the image, as organised PointCloud2, and knows the camera. The echo node is what a
tutorial would have: it makes a PoseArray of as many poses out of the same message and lifts nothing. Both take turns of
about two seconds.

columns, a line for each number of persons, rate and node; times in µs:
  received  messages that were answered by a PoseArray, of those sent
  median    from the publisher's stamp to the answer's arrival at the listener, which takes serialised messages;
            then the 99th percentile
  CPU       time that all threads of the node's process used, a frame
  MB        resident memory after the last frame
  x echo    the median over the echo node's; then the same of the 99th percentiles
  + CPU     CPU time over that of the echo node
Start to first output: from the start of the process, a detector already running; median of three.

A machine that does other work besides tells more about that work: see the load.

examples:
  paul benchmark node
  paul benchmark node --persons 1,10 --rates 100 --seconds 30 --json node.json --plot node.png
  paul benchmark node --soak 30 --persons 10 --rates 100     is the memory flat after half an hour?
"""


def _add_benchmark_node(subjects: argparse._SubParsersAction) -> None:
    parser = subjects.add_parser(
        "node",
        help="the ROS 2 node: latency, CPU time and memory, beside a node that does not lift",
        description="Latency, CPU time and memory of the ROS 2 node, beside those of a node that does not lift.",
        epilog=_NODE_COLUMNS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--persons", metavar="A,B", type=_positives, default=[1, 10, 50], help="in an image (default: 1,10,50)"
    )
    parser.add_argument("--rates", metavar="A,B", type=_positives, default=[30, 100], help="in Hz (default: 30,100)")
    parser.add_argument(
        "--seconds", metavar="S", type=_positive, default=10, help="for each line (default: %(default)s)"
    )
    parser.add_argument(
        "--soak",
        metavar="MINUTES",
        type=_minutes,
        help="instead: the lifter alone for so long, with the most persons and the highest rate, memory over time",
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write all rows as JSON")
    parser.add_argument("--plot", metavar="FILE.png", type=_picture, help="draw latencies and CPU times, or memory")
    parser.set_defaults(run=_benchmark_node)


def _positives(text: str) -> list[int]:
    numbers = [_positive(word.strip()) for word in text.split(",")]
    if len(set(numbers)) < len(numbers):
        raise argparse.ArgumentTypeError(f"'{text}' names a number twice")
    return numbers


def _minutes(text: str) -> float:
    try:
        minutes = float(text)
    except ValueError:
        minutes = 0.0
    if not 0 < minutes < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is no number of minutes above 0")
    return minutes


def _benchmark_node(args: argparse.Namespace) -> None:
    from paul_ros.benchmarks import need
    from paul_ros.offline.bag import check_outputs
    from paul_ros.offline.report import write_json

    need("tqdm", *(["matplotlib"] if args.plot else []))
    from paul_ros.benchmarks.node import run, soak
    from paul_ros.benchmarks.node_report import table, write_picture

    check_outputs([args.json, args.plot], [])
    if args.soak:
        report = soak(max(args.persons), max(args.rates), args.soak)
    else:
        report = run(args.persons, args.rates, args.seconds)
    try:
        if args.json:
            write_json(args.json, report)
        if args.plot:
            write_picture(args.plot, report)
    finally:
        print(table(report))


_STUDIES = {
    "bottleneck": "error against the size of the bottleneck, K = 2 to 12",
    "noise": "error against Gaussian noise of the points, as a share of their rms",
    "hidden": "error against the share of hidden points",
    "auto_decoder": "PAUL against its decoder alone (ADL) and ADL + low rank, as bars",
    "latent": "latent spaces of two dimensions, coloured by frame: PAUL against ADL, own and random cameras",
}
_STUDY_EXAMPLES = """\
FILE is an npz with W and the truth S, as for `paul evaluate`; only W and visible reach the trainer, frames shuffled.
Interpolation needs no S. The folder gets NAME.png and NAME.json; work/ in it keeps the runs, so that an interrupted
study goes on.

examples:
  paul study bottleneck --data drink.npz yoga.npz --seeds 10 -o out/studies
  paul study hidden --data S5_train.npz --values 0,0.3,0.6 --set codes=encoder -o out/studies
  paul study latent --data drink.npz pickup.npz -o out/studies
  paul study interpolation --model person.npz --data person2d.npz --frames 10,250 -o out/studies
"""


def _add_study(commands: argparse._SubParsersAction) -> None:
    text = dict(epilog=_STUDY_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser = commands.add_parser(
        "study",
        help="one question about the method, answered by a table and a picture",
        description="One question about the method, answered by a table and a picture.",
        **text,
    )
    studies = parser.add_subparsers(metavar="NAME", required=True)
    for name, question in _STUDIES.items():
        study = studies.add_parser(name, help=question, description=f"{question[0].upper()}{question[1:]}.", **text)
        _add_study_files(study)
        if name not in ("auto_decoder", "latent"):
            study.add_argument("--values", metavar="A,B", type=_numbers, default=(), help="to try instead of its own")
        _add_runs(study, None)
        study.set_defaults(run=_study, study=name, values=())
    question = "shapes on the line between two codes of a model"
    strip = studies.add_parser("interpolation", help=question, description=f"{question.capitalize()}.", **text)
    _add_study_files(strip)
    strip.add_argument("--model", required=True, help="model file, or the name of a shipped model")
    strip.add_argument("--frames", metavar="A,B", type=_two_frames, help="default: those whose codes differ most")
    strip.set_defaults(run=_interpolation)


def _add_study_files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", metavar="FILE", type=Path, nargs="+", required=True, help="npz, see below")
    parser.add_argument("-o", "--output", metavar="FOLDER", type=Path, required=True, help="for table, picture, runs")


def _numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or min(values) < 0 or len(set(values)) < len(values):
        raise argparse.ArgumentTypeError(f"'{text}' is no list of different numbers, as in 0,0.3")
    return values


def _two_frames(text: str) -> tuple[int, int]:
    words = text.split(",")
    if len(words) != 2 or words[0] == words[1]:
        raise argparse.ArgumentTypeError(f"'{text}' is not two frames, as in 10,250")
    return _natural(words[0]), _natural(words[1])


def _study(args: argparse.Namespace) -> None:
    from paul_ros.benchmarks import need
    from paul_ros.offline.bag import check_outputs

    check_outputs([args.output / f"{args.study}.{kind}" for kind in ("json", "png")], args.data)
    need("tqdm", "matplotlib")
    with _training_packages():
        from training.judge.studies import study
    keeping = _keeping(args, args.output / "work")
    print(
        study.run(
            study.studies()[args.study], args.data, args.output, args.seeds, tuple(args.values), args.set, keeping
        )
    )


def _interpolation(args: argparse.Namespace) -> None:
    from paul_ros.offline.bag import check_outputs
    from training.judge.studies import interpolation

    check_outputs([args.output / f"interpolation.{kind}" for kind in ("json", "png")], [args.model, *args.data])
    print(interpolation.run(args.model, args.data, args.output, args.frames))


_EVALUATE_EXAMPLES = """\
DATA is an npz with
  W (F,2,P)        image points, y down; one scale for S and W
  S (F,3,P)        the truth in the camera frame; NaN where it is not known
  visible (F,P)    optional; the model sees visible points only, errors are over all of them
  edges (E,2)      optional, for the picture
  metres           optional, true: distances are then given in mm, else in units of W

examples:
  paul evaluate person.npz unseen.npz --json errors.json --plot errors.png
                         every frame lifted alone: encoder, decoder, orthographic-N-point
  paul evaluate shapes.npz --truth drink.npz
                         what `paul train --shapes shapes.npz` reconstructed, same frames, same order

NE is |S - truth| / |truth| of the centred shapes, no alignment. Mirror images look alike under an orthographic camera:
"flip per frame" forgives each frame, "one flip for all" only the whole set. The baseline is the rigid mean shape.
"""


def _add_evaluate(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="judge a model on unseen frames, or a reconstruction, against the 3D truth",
        description="Judge a model on frames it never saw, each lifted alone, or a saved reconstruction.",
        epilog=_EVALUATE_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", metavar="MODEL", help="model file or shipped model; with --truth saved shapes (.npz)")
    parser.add_argument("data", metavar="DATA", type=Path, nargs="?", help="npz with W and the truth S, see below")
    parser.add_argument("--truth", metavar="DATA", type=Path, help="MODEL holds shapes: judge them by this npz")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the report as JSON")
    parser.add_argument(
        "--plot", metavar="FILE.png", type=_picture, help="draw frames over their truth, and all errors"
    )
    parser.set_defaults(run=_evaluate, usage_error=parser.error)


def _evaluate(args: argparse.Namespace) -> None:
    from paul_ros.benchmarks import need
    from paul_ros.offline.bag import check_outputs
    from paul_ros.offline.report import write_json

    if (args.data is None) == (args.truth is None):
        args.usage_error("name DATA for a model, or --truth DATA for saved shapes")
    check_outputs([args.json, args.plot], [args.model, args.data, args.truth])
    if args.plot:
        need("matplotlib")
    with _training_packages():
        from training.judge import evaluation
    if args.truth:
        with _training_packages():
            report, compared = evaluation.evaluate_shapes(args.model, args.truth)
    else:
        with Ticker("evaluate") as tick:
            report, compared = evaluation.evaluate_model(args.model, args.data, tick)
    if args.json:
        write_json(args.json, report)
    try:
        if args.plot:
            from training.judge.evaluation_picture import write_picture

            write_picture(args.plot, compared, f"{Path(args.model).stem} on {compared.truth.name}")
    finally:
        print(evaluation.table(report))


@contextlib.contextmanager
def _training_packages() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ImportError(f"this needs the Python package '{error.name}': pip install 'paul_ros[train]'") from error


def _add_train(commands: argparse._SubParsersAction) -> None:
    from paul_ros.cli import train

    train.add_parser(commands)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="paul",
        description="3D from the 2D keypoints of any object, learned from 2D alone.",
        epilog="`paul COMMAND --help` explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"paul_ros {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_replay(commands)
    _add_view(commands)
    _add_inspect(commands)
    _add_train(commands)
    _add_evaluate(commands)
    _add_study(commands)
    _add_demo(commands)
    _add_benchmark(commands)
    return parser


def _use_one_thread() -> None:
    """As the node does, and before numpy starts: then a replay agrees with the live node to the last bit."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"


def main(argv: list[str] | None = None) -> int:
    """Exit code 0 only on success; what a user can cause is one line on stderr and exit code 1.

    Where the reader of stdout is gone (`paul ... | head`) it is 141, what a shell says of a process that SIGPIPE ended.
    """
    try:
        try:
            return _run(sys.argv[1:] if argv is None else argv)
        finally:
            print(end="", flush=True)  # here, not at exit, where a closed pipe could no longer be caught
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE


def _run(argv: list[str]) -> int:
    train = argv[:1] == ["train"]
    if not train:  # training has --threads for it
        _use_one_thread()
    try:
        args = _parser().parse_args(argv)
        args.run(args)
    except KeyboardInterrupt as stop:
        print(f"paul: {str(stop) or 'stopped'}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except Exception as error:
        if not _is_expected(error):
            raise
        print(f"paul: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


def _is_expected(error: Exception) -> bool:
    """Errors with a text for the user. Anything else is a fault of the program and shows where it is."""
    from paul_ros.errors import PaulError

    return isinstance(error, (PaulError, OSError, ImportError))


if __name__ == "__main__":
    sys.exit(main())
