# SPDX-License-Identifier: Apache-2.0
"""Types of arguments, and options that several commands share."""

from __future__ import annotations

import argparse
import itertools
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from paul_ros.cli.output import output_path

if TYPE_CHECKING:
    Commands: TypeAlias = argparse._SubParsersAction[argparse.ArgumentParser]
else:
    Commands = argparse._SubParsersAction

IMAGES = ("auto", "rectified", "raw")
"""Values of the parameter `image`; its table needs PyYAML, which no command may import before it runs."""

PICTURES = (".png", ".svg", ".pdf")
"""Suffixes of a picture."""


class HelpFormatter(argparse.HelpFormatter):
    """Wraps the prose of descriptions and epilogs to the terminal; keeps indented lines, such as examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        blocks = itertools.groupby(text.strip("\n").splitlines(), lambda line: bool(line) and not line[0].isspace())
        return "\n".join(
            textwrap.fill(" ".join(lines), width) if is_prose else "\n".join(lines) for is_prose, lines in blocks
        )


def add_json(parser: argparse.ArgumentParser, what: str = "the report") -> None:
    """Add --json, which `output.publish` takes."""
    parser.add_argument(
        "--json",
        metavar="FILE",
        type=output_path,
        help=f"write {what} as JSON; - prints it to standard output in place of the table",
    )


def add_plot(parser: argparse.ArgumentParser, what: str) -> None:
    """Add --plot, a picture of `what`."""
    parser.add_argument("--plot", metavar="FILE.png", type=picture_path, help=f"draw {what} (.png, .svg or .pdf)")


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add --model, the model that lifts."""
    parser.add_argument("--model", help="name of a shipped model, or a .npz file (default: the shipped human model)")


def add_person_height(parser: argparse.ArgumentParser) -> None:
    """Add --person-height."""
    parser.add_argument(
        "--person-height",
        type=float,
        metavar="METRES",
        help="height of the people in metres (default: the model's mean adult)",
    )


def add_filters(parser: argparse.ArgumentParser) -> None:
    """Add --min-confidence and --max-persons, as the node's parameters."""
    from paul_ros.stream.parameters import DEFAULTS

    add_min_confidence(parser)
    parser.add_argument(
        "--max-persons",
        metavar="N",
        type=positive,
        default=DEFAULTS["max_persons"],
        help="messages with more persons are dropped, as in the node (default: %(default)s)",
    )


def add_min_confidence(parser: argparse.ArgumentParser) -> None:
    """Add --min-confidence."""
    from paul_ros.stream.parameters import DEFAULTS

    parser.add_argument(
        "--min-confidence",
        metavar="C",
        type=confidence,
        default=DEFAULTS["min_confidence"],
        help="keypoints with a lower confidence count as hidden, as in the node (default: %(default)s)",
    )


def add_image(parser: argparse.ArgumentParser) -> None:
    """Add --image, the image of the keypoints."""
    parser.add_argument(
        "--image",
        choices=IMAGES,
        help="the image that the detector saw: rectified (the camera's P), raw (K and D), or auto, which decides by P "
        "and D (default: auto)",
    )


def add_output_layout(parser: argparse.ArgumentParser) -> None:
    """Add --output-layout."""
    parser.add_argument(
        "--output-layout",
        metavar="LAYOUT",
        help="layout of the output: a name, a .yaml file, or `model` for all of its points "
        "(default: the input's, or the model's if that lacks a point of it)",
    )


def add_topics(parser: argparse.ArgumentParser) -> None:
    """Add the topics of keypoints and camera in a bag."""
    parser.add_argument(
        "--topic",
        help="topic of the 2D keypoints; * matches any one part of a name, as in '/humans/bodies/*/skeleton2d' "
        "(default: /keypoints, else the only topic of a type made for keypoints)",
    )
    add_camera_info_topic(parser)


def add_camera_info_topic(parser: argparse.ArgumentParser) -> None:
    """Add --camera-info-topic, the camera of the keypoints."""
    parser.add_argument(
        "--camera-info-topic",
        metavar="TOPIC",
        help="topic of the camera of the keypoints (default: the only CameraInfo of the bag)",
    )


def add_runs(parser: argparse.ArgumentParser) -> None:
    """Add the options of commands that train many times."""
    parser.add_argument(
        "--seeds", metavar="N", type=positive, default=3, help="number of runs of each case (default: %(default)s)"
    )
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="override a setting of the recipe"
    )
    parser.add_argument("--fresh", action="store_true", help="train again what the work folder holds")
    parser.add_argument(
        "--threads", metavar="N", type=positive, default=1, help="number of CPU threads (default: %(default)s)"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")


def positive(text: str) -> int:
    """Parse a whole number above 0."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number above 0")
    return int(text)


def natural(text: str) -> int:
    """Parse a whole number from 0 on."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 on")
    return int(text)


def positives(text: str) -> list[int]:
    """Parse different whole numbers above 0, as in 1,10,50."""
    numbers = [positive(word.strip()) for word in text.split(",")]
    if len(set(numbers)) < len(numbers):
        raise argparse.ArgumentTypeError(f"'{text}' names a number twice")
    return numbers


def numbers(text: str) -> tuple[float, ...]:
    """Parse different numbers from 0 on, as in 0,0.3."""
    values = tuple(_number(word) for word in text.split(","))
    if not all(0 <= value < math.inf for value in values) or len(set(values)) < len(values):
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of different numbers from 0 on, as in 0,0.3")
    return values


def names(text: str) -> list[str]:
    """Parse different names, as in a,b."""
    words = [name.strip() for name in text.split(",") if name.strip()]
    if not words or len(set(words)) < len(words):
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of different names, as in a,b")
    return words


def share(text: str) -> float:
    """Parse a share from 0 to below 1."""
    value = _number(text)
    if not 0 <= value < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a share from 0 to below 1")
    return value


def confidence(text: str) -> float:
    """Parse a confidence from 0 to 1."""
    value = _number(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a confidence from 0 to 1")
    return value


def seconds(text: str) -> float:
    """Parse a number of seconds from 0 on."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of seconds from 0 on")
    return value


def minutes(text: str) -> float:
    """Parse a number of minutes above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of minutes above 0")
    return value


def picture_path(text: str) -> Path:
    """Parse the path of a picture."""
    path = Path(text)
    if text == "-":
        raise argparse.ArgumentTypeError("a picture cannot go to standard output: name a file, as in FILE.png")
    if path.suffix not in PICTURES:
        raise argparse.ArgumentTypeError(f"'{text}' ends neither in .png nor in .svg or .pdf")
    return path


def _number(text: str) -> float:
    """Parse a number; NaN, which is in no range, if the text is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan
