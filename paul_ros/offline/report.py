# SPDX-License-Identifier: Apache-2.0
"""The report of a replay as a table of plain text."""

from __future__ import annotations

from collections.abc import Sequence

from paul_ros.offline.tables import Cell, Row, cell, figure, render
from paul_ros.stream.reason import DROP, PERSON
from paul_ros.stream.reasons import reason_of
from paul_ros.wording import quantity

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
        f"  keypoints {report['keypoints_topic']}, camera {_camera(report)}",
    ]
    if report["units"] == "mixed":
        without = quantity(report["frames_without_metres"], "frame")
        lines.append(
            f"  {without} without metres, before the first usable CameraInfo: left out of NE, root and distance errors"
        )
    lines += _advice(report)
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


def _camera(report: dict) -> str:
    topic, image = report["camera_info_topic"] or "none in the bag", report["image"]
    return f"{topic} ({image} image; its distortion: {report['distortion']})" if image else topic


def _advice(report: dict) -> list[str]:
    """Return a line for each drop of messages and each note with advice. A few persons left out are normal."""
    advice = report["advice"]
    messages = {what: count for what, count in report["dropped"].items() if reason_of(what, DROP).kind != PERSON}
    return [
        f"  {done}: {count} {what}: {advice[what]}"
        for done, counts in (("dropped", messages), ("noted", report["noted"]))
        for what, count in counts.items()
        if what in advice
    ]


def _errors(report: dict, name: str, key: str) -> tuple[Cell, Cell]:
    """Return an error of the lifted persons and of the rigid mean shape."""
    why = report["unavailable"].get(key, "the rigid mean shape could not be lifted")
    return figure(report[key], name, why), figure(report["baseline"][key], name, why)


def _figures(report: dict) -> list[Row]:
    """Return the rows that need no truth: name, figure, "", unit."""
    rows = (
        ("reprojection, median", "reprojection_median_px", 1, "px"),
        ("proven optimal", "certified_share", 100, "%"),
        ("mirror ambiguous", "ambiguous_share", 100, "%"),
        ("flips in depth", "flips_per_1000_frames", 1, "per 1000 pairs of frames"),
        ("lift, median", "lift_us_median", 1, f"µs per frame (99 %: {cell(report['lift_us_p99'])})"),
    )
    return [
        (
            name,
            figure(None, name, report["unavailable"][key]) if report[key] is None else factor * report[key],
            "",
            unit,
        )
        for name, key, factor, unit in rows
    ]


def _who_is_judged(report: dict) -> str:
    judged, persons, share = (report[key] for key in ("persons_with_truth", "persons", "points_with_truth_share"))
    points = "" if share == 1 else f", over {100 * share:.0f} % of their points"
    return f"errors of {judged} of {persons} persons, {100 * (1 - judged / persons):.1f} % left out{points}"
