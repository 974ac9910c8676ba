# SPDX-License-Identifier: Apache-2.0
"""Start `paul`: build the parser, set the threads, run a command, and turn errors into lines and exit codes."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys

from paul_ros import __version__
from paul_ros.cli.options import Commands, HelpFormatter

COMMANDS = ("lift", "replay", "view", "inspect", "train", "evaluate", "study", "demo", "benchmark")
"""Modules of this package, in the order of `paul --help`; each has `add_parser(commands)`."""

_OWN_THREADS = "train"  # has --threads

_EPILOG = """\
`paul COMMAND --help` explains a command.

exit codes: 0 success; 1 an error that you can mend, explained in one line; 2 wrong usage;
130 interrupted by Ctrl-C; 141 the reader of standard output has gone
"""


def main(argv: list[str] | None = None) -> int:
    """Run `paul`.

    Args:
        argv: words after `paul`; None takes those of the process.

    Returns:
        The exit code. 0: success. 1: an error that the user can mend, one line on standard error. 130: interrupted.
        141: the reader of standard output has gone (`paul ... | head`), as a shell reports SIGPIPE.
    """
    try:
        try:
            return _run(sys.argv[1:] if argv is None else argv)
        finally:
            print(end="", flush=True)  # here, since nothing catches a closed pipe at exit
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE


def _run(argv: list[str]) -> int:
    if argv[:1] != [_OWN_THREADS]:
        _use_one_thread()
    try:
        args = _parser(argv).parse_args(argv)
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


def _parser(argv: list[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="paul",
        description="Lift the 2D keypoints of any object to 3D, with a model that is learned from 2D alone.",
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"paul_ros {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name in COMMANDS:
        if name == "train":
            _add_train(commands, wanted=argv[:1] == ["train"])
        else:
            importlib.import_module(f"paul_ros.cli.{name}").add_parser(commands)
    _check_command(parser, argv)
    return parser


def _add_train(commands: Commands, wanted: bool) -> None:
    parser = commands.add_parser(
        "train",
        help="learn a 3D model of any object from 2D keypoints alone",
        description="Learn a 3D shape model from 2D keypoints alone.",
    )
    if not wanted:
        return  # its options live beside torch, which takes seconds to import
    from paul_ros.extras import require

    require("train", "torch", "tqdm")
    from training import command

    command.add_arguments(parser)
    parser.set_defaults(run=command.run)


def _check_command(parser: argparse.ArgumentParser, argv: list[str]) -> None:
    """Exit with the nearest command, if the first word is none; argparse suggests one from Python 3.14 on."""
    word = argv[0] if argv else ""
    if not word or word.startswith("-") or word in COMMANDS:
        return
    import difflib

    close = difflib.get_close_matches(word.lower(), COMMANDS, n=1)
    hint = f", did you mean '{close[0]}'?" if close else "."
    parser.error(f"no command '{word}'{hint} The commands are {', '.join(COMMANDS)}")


def _use_one_thread() -> None:
    """Limit BLAS to one thread, as the node does, before NumPy starts.

    A replay then agrees with the live node to the last bit.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"


def _is_expected(error: Exception) -> bool:
    """Return whether the error has a text for the user; any other is a fault of the program and shows its traceback."""
    from paul_ros.errors import PaulError

    return isinstance(error, (PaulError, OSError))
