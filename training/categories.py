# SPDX-License-Identifier: Apache-2.0
"""Several files as one: recordings of one layout follow each other, categories of objects lie side by side.

One model may cover several categories, as in C3DPO (Novotny et al., ICCV 2019) and PAUL on Pascal3D+. The points of all
categories lie side by side in one layout. A frame shows the points of its own category; the others are hidden, and cost
nothing. The networks recognise the category by the visibility mask.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.layout import Layout
from training.data import DEFAULT_LAYOUT, TrainingData
from training.errors import DataError
from training.loading import MIN_CONFIDENCE, load_training_data


def load_files(
    paths: Sequence[str | Path],
    layout: Layout | None = None,
    topic: str | None = None,
    min_confidence: float = MIN_CONFIDENCE,
    camera_info_topic: str | None = None,
    image: str = "auto",
) -> TrainingData:
    """Load one or several files, each as ``load_training_data`` does.

    Several files are recordings of the same points if a layout is given, or if all have the 17 points of coco17. Else
    each file is a category of its own, named by the file.

    Raises:
        DataError, BagError: see ``load_training_data``; or files that cannot be trained on together.
    """
    parts = [load_training_data(path, layout, topic, min_confidence, camera_info_topic, image) for path in paths]
    if len({part.calibrated for part in parts}) > 1:
        raise DataError(
            "some files hold rays and others pixels (`calibrated`, or a bag's CameraInfo): train them apart"
        )
    if len(parts) == 1:
        return parts[0]
    if any(part.detected is not None for part in parts):
        raise DataError("`detected` is for a file that is trained on alone: join the arrays in one npz")
    if layout is not None or all(part.layout.name == DEFAULT_LAYOUT for part in parts):
        return one_after_another(parts)
    names = [Path(path).stem for path in paths]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DataError(
            f"each file is a category, named by its file, and {', '.join(twice)} is there twice: rename one; "
            f"recordings of one layout are joined with --layout (points41, say, for 41 points)"
        )
    data = side_by_side(names, parts)
    points = {len(part.layout.names) for part in parts}
    if len(points) > 1:
        return data
    note = f"taken as categories of objects; recordings of one object are joined with --layout points{points.pop()}"
    return replace(data, notes=(*data.notes, note))


def one_after_another(parts: list[TrainingData]) -> TrainingData:
    """Join the frames of recordings of one layout."""
    W = np.concatenate([part.W for part in parts])
    visible = np.concatenate([part.visible for part in parts])
    return _joined(parts, W, visible, parts[0].layout)


def side_by_side(names: list[str], parts: list[TrainingData]) -> TrainingData:
    """Join the frames of several categories in the joint layout of all their points; foreign points are hidden."""
    layout = joint_layout(names, [part.layout for part in parts])
    total, points = sum(len(part.W) for part in parts), len(layout.names)
    W, visible = np.zeros((total, 2, points), np.float32), np.zeros((total, points), bool)
    row = 0
    for part, (first, *_, last) in zip(parts, layout.categories.values()):
        frames = slice(row, row + len(part.W))
        W[frames, :, first : last + 1], visible[frames, first : last + 1] = part.W, part.visible
        row += len(part.W)
    return _joined(parts, W, visible, layout)


def joint_layout(names: list[str], layouts: list[Layout]) -> Layout:
    """Return the points of several layouts side by side, each named ``category.point``.

    Args:
        names: of the categories.
        layouts: of the categories.

    Raises:
        LayoutError: more points than a layout can have.
    """
    joint: dict[str, list] = {"names": [], "edges": [], "left_right": [], "handedness": []}
    categories = {}
    for category, layout in zip(names, layouts):
        own = _prefixed({key: layout.to_dict()[key] for key in joint}, f"{category}.")
        for key, items in own.items():
            joint[key] += items
        categories[category] = own["names"]
    return Layout.from_dict({"name": "+".join(names), **joint, "root": joint["names"], "categories": categories})


def _prefixed(item: Any, prefix: str) -> Any:
    """Return a layout's lists with a prefix before every point's name."""
    if isinstance(item, str):
        return prefix + item
    if isinstance(item, dict):
        return {key: _prefixed(value, prefix) for key, value in item.items()}
    return [_prefixed(value, prefix) for value in item]


def _joined(parts: list[TrainingData], W: np.ndarray, visible: np.ndarray, layout: Layout) -> TrainingData:
    return TrainingData(
        W,
        visible,
        layout,
        parts[0].calibrated,
        source=", ".join(part.source for part in parts),
        used=np.concatenate([part.used for part in parts]),
        notes=tuple(f"{part.source}: {note}" for part in parts for note in part.notes),
    )
