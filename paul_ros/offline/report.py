# SPDX-License-Identifier: Apache-2.0
"""The report of a replay as a table of plain text."""

from __future__ import annotations

_ERROR_ROWS = (
    ("N-MPJPE", "n_mpjpe_mm", "mm"),
    ("PA-MPJPE", "pa_mpjpe_mm", "mm"),
    ("NE, flip per frame", "ne_flip_frame_percent", "%"),
    ("NE, one flip for all", "ne_flip_global_percent", "%"),
    ("root error, median", "root_error_median_mm", "mm"),
    ("root error, median", "root_error_median_percent", "% of distance"),
)


def table(report: dict) -> str:
    """Return a report of `evaluate` as a few aligned lines."""
    dropped = ", ".join(f"{count} {reason}" for reason, count in report["dropped"].items()) or "nothing"
    lines = [
        f"{report['bag']}",
        f"  {report['frames']} frames, {report['persons']} persons, {report['lifted']} lifted; dropped: {dropped}",
        f"  model {report['model']} ({report['model_sha256'][:12]}), layout {report['layout']}, "
        f"units {report['units']}",
    ]
    advice = report["advice"]
    lines += [f"  noted: {count} {what}: {advice[what]}" for what, count in report["noted"].items() if what in advice]
    if report["persons_with_truth"]:
        lines += ["", f"  {_who_is_judged(report)}", f"  {'':<22}{'lifted':>9}{'rigid':>9}"]
        lines += [
            f"  {name:<22}{cell(report[key])}{cell(report['baseline'][key])}  {unit}" for name, key, unit in _ERROR_ROWS
        ]
    lines += [
        "",
        f"  {'reprojection, median':<22}{cell(report['reprojection_median_px'])}{'':>9}  px",
        f"  {'proven optimal':<22}{cell(_percent(report['certified_share']))}{'':>9}  %",
        f"  {'mirror ambiguous':<22}{cell(_percent(report['ambiguous_share']))}{'':>9}  %",
        f"  {'flips in depth':<22}{cell(report['flips_per_1000_frames'])}{'':>9}  per 1000 pairs of frames",
        f"  {'lift, median':<22}{cell(report['lift_us_median'])}{'':>9}  µs a frame "
        f"(99 %: {cell(report['lift_us_p99']).strip()})",
    ]
    return "\n".join(lines)


def _who_is_judged(report: dict) -> str:
    judged, persons, share = (report[key] for key in ("persons_with_truth", "persons", "points_with_truth_share"))
    points = "" if share == 1 else f", over {100 * share:.0f} % of their points"
    return f"errors of {judged} of {persons} persons, {100 * (1 - judged / persons):.1f} % left out{points}"


def cell(value: float | None, width: int = 9, digits: int = 1) -> str:
    """Return a number as a table's cell, aligned right; '-' for None."""
    return f"{'-':>{width}}" if value is None else f"{value:>{width}.{digits}f}"


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
