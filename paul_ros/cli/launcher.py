# SPDX-License-Identifier: Apache-2.0
"""Start `paul`: build the parser, set the threads, run a command, and turn errors into lines and exit codes."""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import io
import os
import signal
import sys
from collections.abc import Collection

from paul_ros import __version__
from paul_ros.cli.options import HelpFormatter
from paul_ros.cli.parser import Parser
from paul_ros.signals import stoppable
from paul_ros.stream.option_advice import in_options

COMMANDS = {
    "lift": "lift arrays of 2D keypoints (.npz, .csv, .json), without ROS",
    "replay": "lift a recorded bag and judge it",
    "view": "draw a film of a bag, lifted, or of a model's shapes",
    "inspect": "summarise a model, a bag or a layout",
    "train": "learn a 3D model of any object from 2D keypoints alone",
    "evaluate": "judge a model on unseen frames, or a reconstruction, against the 3D truth",
    "study": "answer one question about the method with a table and a picture",
    "demo": "run the real node on the shipped bags and check it",
    "benchmark": "measure this package against others",
}
"""Modules of this package, each with `add_parser(commands)`, and their lines in `paul --help`."""

_OWN_THREADS = "train"  # has --threads

_EPILOG = """\
`paul COMMAND --help` explains a command.

exit codes:
  0:   success
  1:   an error that you can mend, explained in one line on standard error
  2:   wrong usage
  129: the terminal was closed (SIGHUP)
  130: interrupted by Ctrl-C
  141: the reader of standard output has gone
  143: ended by SIGTERM
"""


def main(argv: list[str] | None = None) -> int:
    """Run `paul`.

    Args:
        argv: words after `paul`; None takes those of the process.

    Returns:
        The exit code. 0: success. 1: an error that the user can mend, one line on standard error. 128 and a signal's
        number: 129, 130 and 143 as stopped by it; 141 if the reader of standard output has gone (`paul ... | head`).
    """
    _print_any_text()
    with stoppable() as received:
        code = _run_and_flush(sys.argv[1:] if argv is None else argv)
    return 128 + received[0] if received else code


def _print_any_text() -> None:
    """Escape characters that the terminal's encoding, such as ASCII, lacks; printing them would be an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _run_and_flush(argv: list[str]) -> int:
    code = 0
    try:
        try:
            code = _run(argv)
            return code
        finally:
            print(end="", flush=True)  # here, since nothing catches a closed pipe or a full disk at exit
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 128 + signal.SIGPIPE
        if not code:
            _say(f"standard output: {error.strerror}")
        return 1


def _run(argv: list[str]) -> int:
    if argv[:1] != [_OWN_THREADS]:
        _use_one_thread()
    args = argparse.Namespace()
    try:
        parser = build_parser(argv)
        args = parser.parse_args(argv)
        args.run(args)
    except KeyboardInterrupt as stop:
        _say(str(stop) or "stopped")
        return 128 + signal.SIGINT
    except Exception as error:
        if not _is_expected(error) or _is_of_stdout(error):
            raise
        _say(" ".join(in_options(_text(error), vars(args)).split()))
        return 1
    return 0


def _say(line: str) -> None:
    """Print a line on standard error, if it is still there: the terminal may be closed."""
    with contextlib.suppress(OSError):
        print(f"paul: {line}", file=sys.stderr)


def build_parser(wanted: Collection[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """Build the parser of `paul`.

    Args:
        wanted: words that include the commands to be parsed. The others get no arguments, and their modules are not
            imported, which saves time.
    """
    parser = Parser(
        prog="paul",
        description="Lift the 2D keypoints of any object to 3D, with a model that is learned from 2D alone.",
        epilog=_EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"paul_ros {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, line in COMMANDS.items():
        if name not in wanted:
            commands.add_parser(name, help=line)
        else:
            importlib.import_module(f"paul_ros.cli.{name}").add_parser(commands)
    return parser


def _use_one_thread() -> None:
    """Limit BLAS to one thread, as the node does, before NumPy starts.

    A replay then agrees with the live node to the last bit.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"


def _text(error: Exception) -> str:
    """Return an error's text; that of a file begins with its name, as the package's own errors do."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


def _is_of_stdout(error: Exception) -> bool:
    """Return whether printing failed; errors of files name the file."""
    return isinstance(error, OSError) and error.errno in (errno.EPIPE, errno.ENOSPC) and error.filename is None


def _is_expected(error: Exception) -> bool:
    """Return whether the error has a text for the user; any other is a fault of the program and shows its traceback."""
    from paul_ros.errors import PaulError

    return isinstance(error, (PaulError, OSError))
