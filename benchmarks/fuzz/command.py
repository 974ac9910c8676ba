# SPDX-License-Identifier: Apache-2.0
"""The command: many sessions of all kinds, a report and a table."""

from __future__ import annotations

import argparse
import json
import logging
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import benchmarks.fuzz
from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.sessions import SESSION, SESSIONS, run_session
from benchmarks.fuzz.tally import Tally
from paul_ros.files import write_atomically

#: Kind -> share of the cases.
KINDS = {"fields": 0.40, "junk": 0.15, "cdr": 0.22, "ids": 0.10, "bags": 0.05, "models": 0.05, "layouts": 0.03}


def fuzz(
    cases: int,
    seed: int = 0,
    kinds: tuple[str, ...] = tuple(KINDS),
    progress: Callable[[int], object] = lambda count: None,
) -> dict[str, Any]:
    """Run so many cases, and return the report.

    Args:
        cases: their number, spread over the kinds by ``KINDS``.
        seed: of all cases.
        kinds: to run.
        progress: called with the number of cases after each session.
    """
    # A stream logs the traceback of its first internal error.
    logging.getLogger("paul_ros.stream.stream").setLevel(logging.CRITICAL)
    share = sum(KINDS[kind] for kind in kinds)
    tallies = {kind: Tally() for kind in kinds}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for kind, tally in tallies.items():
            for number in range(max(1, round(cases * KINDS[kind] / share / SESSION))):
                run_session(bench, kind, number, tally, seed)
                progress(SESSION)
    total = {
        name: sum(getattr(tally, name) for tally in tallies.values()) for name in ("cases", "crashes", "uncounted")
    }
    return {
        **total,
        "seed": seed,
        "seconds": time.perf_counter() - start,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "kinds": {kind: tally.to_dict() for kind, tally in tallies.items()},
    }


def table(report: dict[str, Any]) -> str:
    """Format the report: failures first."""
    head = f"{'kind':8}{'cases':>9}{'accepted':>10}{'refused':>9}{'crashes':>9}{'lost uncounted':>16}{'slowest ms':>12}"
    lines = [head]
    for kind, row in report["kinds"].items():
        lines.append(
            f"{kind:8}{row['cases']:9}{row['accepted']:10}{row['refused']:9}{row['crashes']:9}{row['uncounted']:16}"
            f"{row['slowest_ms']:12.1f}"
        )
    lines.append(
        f"{report['cases']} cases, {report['crashes']} crashes, {report['uncounted']} frames lost uncounted; "
        f"{report['seconds']:.0f} s, {report['peak_rss_mb']:.0f} MB at most"
    )
    return "\n".join([*(text for row in report["kinds"].values() for text in row["failures"]), *lines])


def main() -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fuzz",
        description=benchmarks.fuzz.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--cases", type=int, default=100_000, help="number of cases (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all cases (default: %(default)s)")
    parser.add_argument("--only", choices=SESSIONS, help="run one kind of cases (default: all)")
    parser.add_argument("--session", type=int, metavar="NUMBER", help="repeat one session of the kind of --only")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report as JSON")
    args = parser.parse_args()
    if args.session is not None:
        if args.only is None:
            parser.error("--session needs --only KIND")
        tally = Tally()
        with tempfile.TemporaryDirectory() as folder:
            run_session(Bench(Path(folder)), args.only, args.session, tally, args.seed)
        print(*tally.failures, sep="\n")
        return int(bool(tally.failures))
    report = fuzz(args.cases, args.seed, (args.only,) if args.only else tuple(KINDS))
    print(table(report))
    if args.json:
        write_atomically(args.json, json.dumps(report, indent=1).encode())
    return int(bool(report["crashes"] or report["uncounted"]))
