# SPDX-License-Identifier: Apache-2.0
"""`paul lift`: arrays of 2D keypoints to 3D, without ROS."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from paul_ros.cli.options import (
    Commands,
    HelpFormatter,
    add_image,
    add_min_confidence,
    add_model,
    add_output_layout,
    add_person_height,
)
from paul_ros.cli.output import STDOUT, check_files, open_output, output_path
from paul_ros.cli.progress import progress
from paul_ros.stream.option_advice import in_options
from paul_ros.wording import quantity

if TYPE_CHECKING:
    from msg_adapters import Intrinsics
    from paul_ros.lifter import Lifter
    from paul_ros.offline.lifted_files import Batches
    from paul_ros.stream.session import Session

FORMATS = ("npz", "csv", "json")

_LIFTED = ""  # the reason of a lifted person
_DESCRIPTION = """\
Lift arrays of 2D keypoints to 3D, each person alone, as the ROS 2 node does. No ROS is needed.
The points are in metres from the camera if a camera is given, otherwise in model units from each person's root.
"""
_EPILOG = """\
input, N persons of P keypoints in pixels (x right, y down), NaN where hidden:
  npz:   keypoints (N,P,2), or (N,P,3) with the confidences, or W (F,2,P) as
         for `paul train`; optional visible (N,P), confidence (N,P), frame (N,)
         and person (N,). Without confidence, score, visibility and the like
         are read, also in csv and json.
  csv:   a row for each keypoint, with the columns frame,keypoint,x,y and
         optional person,confidence. A keypoint is a name or, with --layout, a
         number from 0 on. It is hidden if it has no row, or no x and y.
         Sort the rows by frame.
  json:  a list of frames; a frame is a list of persons.
         A person is a list of keypoints, or {"id": "7", "keypoints": [...]}.
         A keypoint is [x, y], [x, y, confidence] or null. The keypoints may
         also be one flat list x, y, confidence, x, y, ... as in COCO.

output, in the optical frame of the camera (x right, y down, z forward; without
a camera, z is the line of sight to each person):
  points:          (N,P,3), and root: (N,3)
  distance_sigma:  (N,) standard deviation of the root's distance in metres
  ambiguity:       (N,) 0..1; near 1 the depth-reversed pose fits as well
  certified:       (N,) whether the pose is proven to be the optimum
  reason:          (N,) why a person was not lifted; empty if it was
  units:           `m` or `model`
  also:            frame, person, layout, keypoints (their names),
                   coordinate_frame, model, model_sha256
A csv has a row for each keypoint, with root_x, root_y, root_z. In json, `persons` is a list of
objects.

--image says whether the keypoints lie in the raw or in the rectified image. FILE is a YAML file
that camera_calibration wrote, a CameraInfo message as YAML, or JSON such as:
  {"K": [[900, 0, 640], [0, 900, 360], [0, 0, 1]], "width": 1280, "height": 720}

examples:
  paul lift keypoints.npz -o lifted.npz --camera camera.yaml
  paul lift keypoints.csv -o lifted.csv --intrinsics 900 900 640 360
  paul lift keypoints.json -o lifted.json --layout h36m17 --output-layout model
  detector | paul lift - -o - --format csv --layout coco17 > lifted.csv
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "lift",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("input", metavar="IN", type=Path, help="2D keypoints: .npz, .csv, .json, or - (standard input)")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=output_path,
        required=True,
        help="3D points: .npz, .csv, .json, or - (standard output)",
    )
    parser.add_argument("--format", choices=FORMATS, help="format of files whose names do not say it, such as -")
    parser.add_argument(
        "--layout",
        help="layout of the keypoints: a name or a .yaml file "
        "(default: found from their number, or from their names in .csv)",
    )
    add_output_layout(parser)
    camera = parser.add_mutually_exclusive_group()
    camera.add_argument("--camera", metavar="FILE", type=Path, help="calibration of the camera (.yaml or .json)")
    camera.add_argument(
        "--intrinsics",
        metavar=("FX", "FY", "CX", "CY"),
        type=float,
        nargs=4,
        help="focal lengths and principal point in pixels",
    )
    add_image(parser)
    add_model(parser)
    add_person_height(parser)
    add_min_confidence(parser)
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> None:
    """Lift the file, write the output, print one line about it.

    Raises:
        PaulError: a file or a parameter cannot be used, or nobody could be lifted.
    """
    if args.image == "raw" and not args.camera:
        args.usage_error("--image raw needs --camera, whose distortion is corrected; --intrinsics have none")
    kinds = [_kind(args, path, name) for path, name in ((args.input, "IN"), (args.output, "OUT"))]
    from paul_ros.errors import KeypointFileError
    from paul_ros.lifter import Lifter
    from paul_ros.model_file import load_model
    from paul_ros.stream.parameters import checked

    check_files([args.output], [args.input, args.model, args.layout, args.output_layout, args.camera])
    given = {name: getattr(args, name) for name in ("model", "person_height", "min_confidence")}
    parameters = checked({name: value for name, value in given.items() if value is not None})
    lifter = Lifter(load_model(parameters["model"]), parameters["person_height"])
    tally = _Tally()
    summary = _lift(args, kinds, lifter, parameters["min_confidence"], tally)
    if not tally.reasons[_LIFTED]:
        name = "standard input" if args.input == STDOUT else args.input
        advice = "; ".join(text for text, _ in tally.notes.values()) or "check --layout and the keypoints"
        raise KeypointFileError(f"{name}: nobody could be lifted ({_reasons(tally)}): {advice}")
    print(summary, file=sys.stderr if args.output == STDOUT else sys.stdout)


def _lift(args: argparse.Namespace, kinds: list[str], lifter: Lifter, min_confidence: float, tally: _Tally) -> str:
    """Lift from file to file and keep the tally. Return the lines for the user."""
    from paul_ros.layout import load_layout
    from paul_ros.lifted import IMAGE_AXES, OPTICAL_FRAME
    from paul_ros.offline.arrays import lift_persons
    from paul_ros.offline.keypoint_files import open_keypoints
    from paul_ros.offline.lifted_files import LiftedFile
    from paul_ros.route import Route, find_output_layout
    from paul_ros.stream.session import Session

    camera, model, session = _camera(args), lifter.model, Session()
    if camera:
        session.take_camera(camera)
    units, axes = "m" if camera and lifter.metres_per_unit else "model", OPTICAL_FRAME if camera else IMAGE_AXES
    with _open_input(args.input) as file:
        layout = load_layout(args.layout) if args.layout else None
        name = "standard input" if args.input == STDOUT else str(args.input)
        keypoints = open_keypoints(file, name, kinds[0], layout, model.layout)
        output = find_output_layout(args.output_layout, model.layout)
        route = Route.between(keypoints.layout, model.layout, output)
        lifted = lift_persons(keypoints.batches, lifter, route, session, min_confidence)
        with open_output(args.output) as out, progress("lift", "person", keypoints.persons) as count:
            LiftedFile(route.output, model, units, axes).write(out, kinds[1], _counted(lifted, tally, count))
    return "\n".join([_summary(args, tally, route.output.name, units), *_notes(args, tally, session, route.given.name)])


class _Tally:
    """Counts of a file.

    Attributes:
        reasons: number of persons by the reason why they were not lifted; _LIFTED for the others.
        unlike: number of persons whom no shape of the model fits well.
        notes: reason -> a sentence about something irregular, and the number of points.
    """

    def __init__(self) -> None:
        self.reasons: Counter[str] = Counter()
        self.unlike = 0
        self.notes: dict[str, tuple[str, int]] = {}


def _counted(batches: Batches, tally: _Tally, count: Callable[[int], None]) -> Batches:
    """Yield the batches while the tally is kept."""
    from paul_ros.lifted import UNLIKE_MODEL

    for persons, lifted in batches:
        tally.reasons.update(lifted.reason)
        tally.unlike += int((lifted.unexplained > UNLIKE_MODEL).sum())
        for reason, (text, number) in persons.notes.items():
            tally.notes[reason] = text, number + tally.notes.get(reason, ("", 0))[1]
        yield persons, lifted
        count(len(lifted.reason))


def _summary(args: argparse.Namespace, tally: _Tally, layout: str, units: str) -> str:
    persons = tally.reasons.total()
    reasons = _reasons(tally)
    output = "standard output" if args.output == STDOUT else args.output
    return (
        f"{output}: {tally.reasons[_LIFTED]} of {quantity(persons, 'person')} lifted, layout {layout}, "
        f"units {units}{f'; not lifted: {reasons}' if reasons else ''}"
    )


def _reasons(tally: _Tally) -> str:
    left_out = sorted((reason, number) for reason, number in tally.reasons.items() if reason != _LIFTED)
    return ", ".join(f"{number} {reason}" for reason, number in left_out)


def _notes(args: argparse.Namespace, tally: _Tally, session: Session, layout: str) -> list[str]:
    notes = [f"note: {text} ({number} points)" for text, number in tally.notes.values()]
    if session.intrinsics is None:
        notes.append("note: no camera, so lengths are in model units; give --camera or --intrinsics for metres")
    notes += [f"note: {in_options(advice, vars(args))}" for advice in session.ledger.advice.values()]
    if tally.unlike:
        notes.append(
            f"note: no shape of the model fits {tally.unlike} of the persons well; if the keypoints are not in the "
            f"order of layout {layout}, set --layout"
        )
    return notes


def _kind(args: argparse.Namespace, path: Path, name: str) -> str:
    """Return the format of a file by its suffix, else by --format; exit on wrong usage."""
    if path.suffix.lstrip(".") in FORMATS:
        return path.suffix.lstrip(".")
    if not args.format:
        what = "-:" if path == STDOUT else f"'{path}': it must end in .npz, .csv or .json; otherwise"
        args.usage_error(f"{name} is {what} choose its format with --format npz, csv or json")
    return args.format


def _camera(args: argparse.Namespace) -> Intrinsics | None:
    from paul_ros.offline.camera_file import camera_of, read_camera

    if args.camera:
        return read_camera(args.camera, args.image or "auto")
    return camera_of(*args.intrinsics) if args.intrinsics else None


@contextlib.contextmanager
def _open_input(path: Path) -> Iterator[BinaryIO]:
    """Open a file, or standard input, which stays open."""
    from paul_ros.errors import KeypointFileError

    if path != STDOUT:
        if not path.exists():
            raise KeypointFileError(f"{path}: no such file")
        with path.open("rb") as file:
            yield file
    elif sys.stdin is None:
        raise OSError("standard input is closed: name a file")
    else:
        yield sys.stdin.buffer
