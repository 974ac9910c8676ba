#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Peak memory and time of ``paul train`` on thousands of points of a synthetic articulated mesh.

    python benchmarks/dense.py [--points 6890] [--frames 5000] [--epochs 3] [--set KEY=VALUE ...]

Memory is the largest resident set of the whole command, as the kernel counts it: from reading the file to writing the
model and the shapes of all frames.  An epoch has as many steps as show each frame once on average.  The processor time
of the whole command is printed too, for machines with other work.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path


def run(*arguments: object) -> resource.struct_rusage:
    """Run a Python module in a process of its own, and return its use of resources."""
    child = subprocess.Popen([sys.executable, "-m", *map(str, arguments)])
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"python -m {arguments[0]} failed; see its error above")
    return usage


def main() -> None:
    """Make the mesh, train on it, and print a line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=6890, help="points of the mesh (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=5000, help="frames (default: %(default)s)")
    parser.add_argument("--epochs", type=int, default=3, help="epochs to train (default: %(default)s)")
    parser.add_argument("--batch", type=int, default=128, help="frames a step (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="override a recipe setting")
    args = parser.parse_args()
    steps = -(-args.epochs * args.frames // args.batch)
    settings = [f"steps={steps}", f"batch={args.batch}", *args.set]
    with tempfile.TemporaryDirectory() as folder:
        mesh, model, report = (Path(folder) / name for name in ("mesh.npz", "model.npz", "report.json"))
        run("training.judge.synthetic", "-o", mesh, "--points", args.points, "--frames", args.frames)
        overrides = [word for setting in settings for word in ("--set", setting)]
        outputs = ("-o", model, "--shapes", Path(folder) / "shapes.npz", "--json", report)
        used = run("paul_ros.cli", "train", mesh, *outputs, "--quiet", "--threads", args.threads, *overrides)
        seconds, size = json.loads(report.read_text())["training"]["seconds"], model.stat().st_size
    print(
        f"{args.frames} frames of {args.points} points, {args.threads} thread(s), batch {args.batch}: "
        f"{seconds / args.epochs:.1f} s an epoch, {used.ru_utime + used.ru_stime:.0f} s of processor time in all, "
        f"peak memory {used.ru_maxrss * 1024 / 1e9:.2f} GB, model file {size / 2**20:.0f} MiB"
    )


if __name__ == "__main__":
    main()
