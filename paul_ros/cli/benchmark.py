# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark`: this package measured against others, one module a subject."""

from __future__ import annotations

from paul_ros.cli import benchmark_node, benchmark_nrsfm, benchmark_onp
from paul_ros.cli.options import Commands


def add_parser(commands: Commands) -> None:
    """Add the command with its subjects."""
    parser = commands.add_parser("benchmark", description="Measure this package against others.")
    subjects = parser.add_subparsers(metavar="SUBJECT", required=True)
    for subject in (benchmark_onp, benchmark_nrsfm, benchmark_node):
        subject.add_parser(subjects)
