# SPDX-License-Identifier: Apache-2.0
"""The report of a replay as a table of plain text."""

from __future__ import annotations

from collections.abc import Sequence

from paul_ros.offline.tables import Cell, Row, cell, figure, render

_ERROR_ROWS = (
    ("N-MPJPE", "n_mpjpe_mm", "mm"),
    ("PA-MPJPE", "pa_mpjpe_mm", "mm"),
    ("NE, flip per frame", "ne_flip_frame_percent", "%"),
    ("NE, one flip for all", "ne_flip_global_percent", "%"),
    ("root error, median", "root_error_median_mm", "mm"),
    ("root error, median", "root_error_median_percent", "% of distance"),
)


def table(report: dict, further: Sequence[Row] = ()) -> str:
    """Return a report of `evaluate` as text.

    Args:
        report: of `paul_ros.offline.judge.evaluate`.
        further: rows below those of the report: name, figure, "", unit.

    Raises:
        MissingPackageError: rich is not installed.
    """
    dropped = ", ".join(f"{count} {reason}" for reason, count in report["dropped"].items()) or "nothing"
    lines = [
        f"{report['bag']}",
        f"  {report['frames']} frames, {report['persons']} persons, {report['lifted']} lifted; dropped: {dropped}",
        f"  model {report['model']} ({report['model_sha256'][:12]}), layout {report['layout']}, "
        f"units {report['units']}",
    ]
    advice = report["advice"]
    lines += [f"  noted: {count} {what}: {advice[what]}" for what, count in report["noted"].items() if what in advice]
    lines.append("")
    lifted, rigid = "", ""
    rows: list[Row] = []
    if report["persons_with_truth"]:
        lines.append(f"  {_who_is_judged(report)}")
        lifted, rigid = "lifted", "rigid"
        rows = [(name, *_errors(report, name, key), unit) for name, key, unit in _ERROR_ROWS]
        rows.append(())
    else:
        lines.append("  no errors: no lifted person has a ground truth")
    columns = (("", "text"), (lifted, ".1f"), (rigid, ".1f"), ("", "unit"))
    return "\n".join([*lines, render(columns, [*rows, *_figures(report), *further])])


def _errors(report: dict, name: str, key: str) -> tuple[Cell, Cell]:
    """Return an error of the lifted persons and of the rigid mean shape."""
    if report["units"] == "m":
        why = "the ground truth has no root, or persons were lifted before the first CameraInfo"
    else:
        why = f"metres are needed; {report['scale_source'].removeprefix('none: ')}"
    return figure(report[key], name, why), figure(report["baseline"][key], name, why)


def _figures(report: dict) -> list[Row]:
    """Return the rows that need no truth: name, figure, "", unit."""
    nobody = "nobody was lifted"
    flips = "no person with an id was lifted in two successive frames; use tracked keypoints"
    times = (report[key] for key in ("lift_us_median", "lift_us_p99"))
    lift, lift_p99 = (figure(time, "lift, median", "no message shows a person") for time in times)
    rows = (
        ("reprojection, median", report["reprojection_median_px"], nobody, "px"),
        ("proven optimal", _percent(report["certified_share"]), nobody, "%"),
        ("mirror ambiguous", _percent(report["ambiguous_share"]), nobody, "%"),
        (
            "flips in depth",
            report["flips_per_1000_frames"],
            flips if report["lifted"] else nobody,
            "per 1000 pairs of frames",
        ),
    )
    return [
        *((name, figure(value, name, why), "", unit) for name, value, why, unit in rows),
        ("lift, median", lift, "", f"µs per frame (99 %: {cell(lift_p99)})"),
    ]


def _who_is_judged(report: dict) -> str:
    judged, persons, share = (report[key] for key in ("persons_with_truth", "persons", "points_with_truth_share"))
    points = "" if share == 1 else f", over {100 * share:.0f} % of their points"
    return f"errors of {judged} of {persons} persons, {100 * (1 - judged / persons):.1f} % left out{points}"


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
