#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What each term of the training is worth: short runs with one of them left out, judged on the recordings in bags/.

    python benchmarks/training_terms.py human2d.npz -o out/terms [--steps 6000]

Prints a Markdown table; finished runs are not repeated.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from tqdm import tqdm

BAGS = Path(__file__).resolve().parent.parent / "bags"
RUNS = {
    "all, seed 0": ["seed=0"],
    "all, seed 1": ["seed=1"],
    "all, seed 2": ["seed=2"],
    "no handedness rule": ["seed=1", "handedness_weight=0"],
    "no bone lengths": ["seed=1", "bone_weight=0"],
    "no perspective": ["seed=1", "perspective=false"],
    "no fading of turned views": ["seed=1", "fade=[1, 1]"],
    "no turned or mirrored views": ["seed=1", "roll=0", "mirror_view=false"],
    "bottleneck 8": ["seed=1", "bottleneck=8"],
}
_KEYS = ("pa_mpjpe_mm", "n_mpjpe_mm", "ne_flip_frame_percent", "ne_flip_global_percent")


def paul(*words: object) -> None:
    """Run the command line of this very environment; raises where it fails."""
    subprocess.run([sys.executable, "-m", "paul_ros.cli", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


def figures(data: Path, folder: Path, name: str, overrides: list[str], steps: int) -> dict:
    """Train one variant and judge it on both bags: {bag: report}, with the final training loss."""
    model = folder / f"{name.replace(' ', '_').replace(',', '')}.npz"
    settings = [word for override in [f"steps={steps}", *overrides] for word in ("--set", override)]
    paul("train", data, "-o", model, "--recipe", "human", *settings, "--quiet", "--json", folder / "model.json")
    reports = {"loss": json.loads((folder / "model.json").read_text())["training"]["final"]["loss"]}
    for bag in sorted(BAGS.glob("*.mcap")):
        paul("replay", bag, "--model", model, "--json", folder / "report.json")
        reports[bag.stem] = json.loads((folder / "report.json").read_text())
    return reports


def row(name: str, reports: dict) -> str:
    """One line of the table: per bag PA-MPJPE (rigid), N-MPJPE, NE per-frame / global flip."""
    cells = [name, f"{reports['loss']:.3f}"]
    for bag in ("one_person", "two_persons_crossing"):
        pa, n, frame, one = (reports[bag][key] for key in _KEYS)
        rigid = reports[bag]["baseline"]["pa_mpjpe_mm"]
        cells += [f"{pa:.0f} ({rigid:.0f})", f"{n:.0f}", f"{frame:.1f} / {one:.1f}"]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, help="2D training file, as training/README.md says")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/terms"), help="folder for runs (%(default)s)")
    parser.add_argument("--steps", type=int, default=6000, help="of each run (%(default)s)")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    columns = ["PA-MPJPE (rigid) mm", "N-MPJPE mm", "NE % frame / global"]
    lines = ["| run | loss | " + " | ".join(columns * 2) + " |", "|" + "---|" * 8]
    for name, overrides in tqdm(RUNS.items()):
        lines.append(row(name, figures(args.data, args.output, name, overrides, args.steps)))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
