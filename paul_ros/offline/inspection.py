# SPDX-License-Identifier: Apache-2.0
"""Summaries of model files, bags and layouts, for people and for JSON."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

from paul_ros.errors import BagError, InputError
from paul_ros.layout import Layout, layout_names, load_layout
from paul_ros.model_file import load_model, model_names
from paul_ros.offline.bag_file import BagFile
from paul_ros.offline.bag_folder import is_bag
from paul_ros.offline.bag_reader import Recording
from paul_ros.wording import nearest, quantity


def inspect(thing: str) -> tuple[dict, BagError | None]:
    """Summarise a model, a bag or a layout.

    Args:
        thing: name of a shipped model or layout, or a path: .npz model, .yaml layout, or a recording.
            A name that a model and a layout share, as `human`, gives the model's summary with the layout's in it.

    Returns:
        The summary, and the error of a damaged bag, whose whole messages are counted.

    Raises:
        BagError, LayoutError, ModelError: it cannot be read.
        InputError: there is no such file, model or layout.
    """
    path = Path(thing)
    if is_bag(path):
        return _bag(path)
    if thing in model_names():
        same_name = {"layout_of_this_name": _layout(load_layout(thing))} if thing in layout_names() else {}
        return {**_model(thing), **same_name}, None
    if thing in layout_names() or path.suffix in (".yaml", ".yml"):
        return _layout(load_layout(thing)), None
    if not path.exists() and path.name == thing and not path.suffix:
        raise InputError(_unknown(thing))
    return _model(thing), None


def _unknown(name: str) -> str:
    near = nearest(name, (*model_names(), *layout_names()))
    kind = "model" if near in model_names() else "layout"
    hint = f", did you mean {kind} '{near}'?" if near else "."
    return (
        f"no model or layout '{name}'{hint} Shipped models: {', '.join(model_names())}; shipped layouts: "
        f"{', '.join(layout_names())}; for a file or a bag give its path"
    )


def _bag(path: Path) -> tuple[dict, BagError | None]:
    recording = Recording(path)
    topics: dict[str, dict] = {}
    spans: dict[str, tuple[int, int]] = {}
    for record in recording.whole_records():
        topic = topics.setdefault(record.topic, {"type": record.type_name, "messages": 0})
        topic["messages"] += 1
        spans[record.topic] = (spans.get(record.topic, (record.log_time,))[0], record.log_time)
    damage = recording.damage
    if damage and not topics:
        raise damage
    for name, topic in topics.items():
        seconds = (spans[name][1] - spans[name][0]) / 1e9
        topic["rate_hz"] = (topic["messages"] - 1) / seconds if seconds else None
    first = min((begin for begin, _ in spans.values()), default=0)
    last = max((end for _, end in spans.values()), default=0)
    return {
        "kind": "bag",
        "path": str(path),
        "start": _date(first) if topics else None,
        "duration_s": (last - first) / 1e9,
        "messages": sum(topic["messages"] for topic in topics.values()),
        "topics": topics,
        "files": [_file(file, first) for file in recording.files],
        "missing": [file.name for file in recording.missing],
        "damage": str(damage) if damage else None,
    }, damage


def _file(file: BagFile, beginning: int) -> dict:
    """Summarise a file of a recording that began at a log time, in nanoseconds."""
    first, last = file.span or (None, None)
    return {
        "file": file.path.name,
        "storage": file.storage,
        "compression": file.compression or None,
        "start_s": None if first is None else (first - beginning) / 1e9,
        "end_s": None if last is None else (last - beginning) / 1e9,
        "messages": file.messages,
        "damage": file.damage or None,
    }


def _date(log_time: int) -> str:
    """Return a log time in nanoseconds as an ISO date in UTC."""
    try:
        return datetime.fromtimestamp(log_time // 10**9, timezone.utc).isoformat()
    except (OverflowError, ValueError, OSError):  # beyond the year 9999
        return f"{log_time} ns"


def _layout(layout: Layout) -> dict:
    return {"kind": "layout", "points": len(layout.names), **layout.to_dict()}


def _model(thing: str) -> dict:
    model = load_model(thing)
    header = {key: value for key, value in model.header.items() if key != "layout"}
    return {
        "kind": "model",
        "name": model.name,
        "layout": model.layout.name,
        "points": len(model.layout.names),
        "least_points_to_lift": model.min_visible,
        "sha256": model.sha256,
        **header,
    }


_UNKNOWN = {
    "rate_hz": "unknown: it needs messages of two times",
    "metres_per_unit": "unknown: points are in model units",
}
"""Key -> text for people in place of null."""


def as_text(summary: dict) -> str:
    """Return a summary as `key  value` lines, nested parts indented; the terminal wraps long lists.

    The damage of a bag is left out, as the command ends with it as its error.
    """
    shown = {key: value for key, value in summary.items() if key != "damage"}
    if summary.get("kind") == "bag":
        shown["files"] = {file["file"]: _file_text(file) for file in summary["files"]}
    return "\n".join(_lines(shown, ""))


def _file_text(file: dict) -> str:
    times = "no times" if file["start_s"] is None else f"{file['start_s']:.1f} to {file['end_s']:.1f} s"
    told = [times, quantity(file["messages"], "message"), file["storage"] or "unknown storage", file["compression"]]
    if file["damage"]:
        told.append("damaged")
    return ", ".join(filter(None, told))


def _lines(value: dict, indent: str) -> list[str]:
    width = max((len(str(key)) for key in value), default=0) + 2
    lines = []
    for key, item in value.items():
        if isinstance(item, dict) and item:
            lines += [f"{indent}{key}", *_lines(item, indent + "  ")]
        elif isinstance(item, (list, tuple)) and any(isinstance(part, dict) for part in item):
            lines.append(f"{indent}{key}")
            for number, part in enumerate(item, 1):
                lines += [f"{indent}  {number}", *_lines(part, indent + "    ")]
        else:
            lines.append(f"{indent}{key:<{width}}{_UNKNOWN[key] if item is None and key in _UNKNOWN else _brief(item)}")
    return lines


def _brief(item: object) -> str:
    if item is None or item in ({}, [], ()):
        return "none"
    if isinstance(item, float):
        return f"{item:.6g}"
    if isinstance(item, (list, tuple)):
        return ", ".join("-".join(map(str, part)) if isinstance(part, (list, tuple)) else str(part) for part in item)
    return " ".join(str(item).split())
