# SPDX-License-Identifier: Apache-2.0
"""Summaries of model files, bags and layouts, for people and for JSON."""

from __future__ import annotations

from pathlib import Path

from paul_ros.errors import BagError, InputError
from paul_ros.layout import Layout, layout_names, load_layout
from paul_ros.model_file import load_model, model_names
from paul_ros.offline.bag_reader import read_records
from paul_ros.wording import nearest


def inspect(thing: str) -> tuple[dict, BagError | None]:
    """Summarise a model, a bag or a layout.

    Args:
        thing: name of a shipped model or layout, or a path: .npz model, .yaml layout, .mcap file or rosbag2 folder.
            A name that a model and a layout share, as `human`, gives the model's summary with the layout's in it.

    Returns:
        The summary, and the error of a damaged bag, of which the messages before the damage are counted.

    Raises:
        BagError, LayoutError, ModelError: it cannot be read.
        InputError: there is no such file, model or layout.
    """
    path = Path(thing)
    if path.is_dir() or path.suffix in (".mcap", ".part"):
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
    topics: dict[str, dict] = {}
    times: dict[str, list[int]] = {}
    damage = None
    try:
        for record in read_records(path):
            topics.setdefault(record.topic, {"type": record.type_name})
            times.setdefault(record.topic, []).append(record.log_time)
    except BagError as error:
        if not topics:
            raise
        damage = error
    for topic, stamps in times.items():
        seconds = (max(stamps) - min(stamps)) / 1e9
        topics[topic].update(messages=len(stamps), rate_hz=(len(stamps) - 1) / seconds if seconds else None)
    everything = [stamp for stamps in times.values() for stamp in stamps]
    seconds = (max(everything) - min(everything)) / 1e9 if everything else 0.0
    return {
        "kind": "bag",
        "path": str(path),
        "duration_s": seconds,
        "messages": len(everything),
        "topics": topics,
        "damage": str(damage) if damage else None,
    }, damage


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
    return "\n".join(_lines({key: value for key, value in summary.items() if key != "damage"}, ""))


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
