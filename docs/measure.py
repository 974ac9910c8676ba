# SPDX-License-Identifier: Apache-2.0
"""Write ``docs/numbers.json``, the figures of README and pages; then ``python docs/generate.py`` copies them there.

    python docs/measure.py [--human HUMAN.json] [--nrsfm NRSFM.json] [--node NODE.json]

The shipped recordings are replayed and the human model is read, which takes seconds. Figures that take longer come from
the JSON files of their commands, and stay as they are without one:

    python benchmarks/human_model.py CMU_FOLDER --models human,ceiling.npz --json HUMAN.json
    paul benchmark nrsfm --data FOLDER --methods paul --json NRSFM.json
    paul benchmark node --json NODE.json
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NUMBERS = ROOT / "docs/numbers.json"
BAGS = {"one_person": "one_person.mcap", "two_persons": "two_persons_crossing.mcap"}
KEYS = (
    *("persons", "lifted", "pa_mpjpe_mm", "n_mpjpe_mm", "ne_flip_frame_percent", "ne_flip_global_percent"),
    *("root_error_median_mm", "root_error_median_percent", "reprojection_median_px", "flips_per_1000_frames"),
)
SHARES = ("certified", "ambiguous", "distance_within_1_sigma", "distance_within_2_sigma")
RIGID = "rigid mean shape"


def main() -> None:
    """Measure what is quick, take the rest from the given files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in SLOW:
        parser.add_argument(f"--{name}", metavar="FILE.json", type=Path, help=f"report of {SLOW[name][0]}")
    args = parser.parse_args()
    groups = json.loads(NUMBERS.read_text()) if NUMBERS.exists() else {}
    groups["recordings"] = group("paul replay bags/BAG.mcap --json report.json", recordings())
    groups["model"] = group("paul inspect human", model())
    for name, (command, read) in SLOW.items():
        if path := getattr(args, name):
            groups[name] = group(command, read(json.loads(path.read_text())["rows"]))
    NUMBERS.write_text(json.dumps(groups, indent=1) + "\n")


def group(command: str, values: dict[str, float]) -> dict:
    """Return figures with the command, the date and the machine that gave them."""
    return {
        "command": command,
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "values": {key: round(value, 4) for key, value in values.items()},
    }


def recordings() -> dict[str, float]:
    """Replay the shipped recordings, the noisy one also with a filter over time; shares become per cent."""
    found: dict[str, float] = {}
    for name, bag in BAGS.items():
        report = _json_of("replay", str(ROOT / "bags" / bag))
        found |= {f"{name}.{key}": report[key] for key in KEYS}
        found |= {f"{name}.{key}_percent": 100 * report[f"{key}_share"] for key in SHARES}
        found |= {f"{name}.baseline.{key}": report["baseline"][key] for key in KEYS if key in report["baseline"]}
    smoothed = _json_of("replay", str(ROOT / "bags" / BAGS["two_persons"]), "--smoothing", "1.0")
    return found | {f"two_persons.smoothed.{key}": smoothed[key] for key in ("n_mpjpe_mm", "root_error_median_mm")}


def model() -> dict[str, float]:
    """Read the header of the shipped human model."""
    header = _json_of("inspect", "human")
    training = header["training"]
    return {
        "model.frames": training["frames"],
        "model.training_minutes": training["seconds"] / 60,
        "model.bottleneck": header["bottleneck"],
        "model.metres_per_unit": header["metres_per_unit"],
        "model.stature": header["stature"],
        "model.misfit_mm": 1000 * header["misfit"] * header["metres_per_unit"],
        "model.min_visible": header["least_points_to_lift"],
        "model.megabytes": (ROOT / "paul_ros/models/human.npz").stat().st_size / 1e6,
    }


def _json_of(*words: str) -> dict:
    """Return the JSON report of a `paul` command."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "paul_ros.cli", *words, "--json", str(report)]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        return json.loads(report.read_text())


def human(rows: list[dict]) -> dict[str, float]:
    """Take the first and the noisy row of COCO-17 from `benchmarks/human_model.py`."""
    found: dict[str, float] = {}
    for name, what in {"coco17_true": "coco17, true 2D", "coco17_noise": "coco17, noise profile"}.items():
        by_model = {row["model"]: row for row in rows if row["what"] == what}
        ours, rigid = by_model.pop("human"), by_model.pop(RIGID)
        found |= {f"human.{name}.{key}": ours[key] for key in ("pa_mpjpe_mm", "n_mpjpe_mm")}
        found[f"human.{name}.root_mm"] = ours["root_error_median_mm"]
        found[f"human.{name}.root_percent"] = ours["root_error_median_percent"]
        found[f"human.{name}.rigid_pa_mpjpe_mm"] = rigid["pa_mpjpe_mm"]
        for labelled in by_model.values():
            found[f"human.{name}.labels_pa_mpjpe_mm"] = labelled["pa_mpjpe_mm"]
    return found


def nrsfm(rows: list[dict]) -> dict[str, float]:
    """Take the median error of each sequence over the seeds."""
    errors: dict[str, list[float]] = {}
    for row in rows:
        if row["method"] == "paul":
            errors.setdefault(row["sequence"], []).append(row["ne_flip_frame_percent"])
    return {f"nrsfm.{name}.median": statistics.median(values) for name, values in errors.items()}


def node(rows: list[dict]) -> dict[str, float]:
    """Take latency and memory of each number of persons and rate."""
    found: dict[str, float] = {}
    for row in rows:
        cell = f"node.{row['persons']}_{row['rate_hz']}"
        echo = "echo_" if row["node"] == "echo" else ""
        found[f"{cell}.{echo}median_ms"] = row["latency_median_us"] / 1000
        found[f"{cell}.{echo}memory_mb"] = row["rss_mb"]
    return found


SLOW: dict[str, tuple[str, Callable[[list[dict]], dict[str, float]]]] = {
    "human": ("python benchmarks/human_model.py CMU_FOLDER --models human,ceiling.npz --json HUMAN.json", human),
    "nrsfm": ("paul benchmark nrsfm --data FOLDER --methods paul,linear --seeds 3 --json NRSFM.json", nrsfm),
    "node": ("paul benchmark node --json NODE.json", node),
}
"""Group of figures -> the command that gives its JSON, and the function that reads its rows."""

if __name__ == "__main__":
    main()
