# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/PointCloud2 as 2D keypoints: the native message type.

A cloud is organised (height = persons, width = keypoints) or flat (height 1, one person after the other). Fields: x, y
in pixels, optional confidence (0 to 1), optional person_id. NaN, (0, 0) and (-1, -1) mean missing. Without a field
confidence, another usual name is read: score, visibility and the like. Fields that are not used are noted. Offsets,
types, steps and byte order are read from the message.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from msg_adapters.keypoints import (
    CONFIDENCE_NAMES,
    Keypoints2D,
    MessageError,
    Note,
    Source,
    WrongPointCount,
    as_float64,
    no_persons,
    record,
    split_persons,
)

#: sensor_msgs/PointField datatype -> numpy type without byte order.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_FLOATS = (7, 8)


def read(msg: Any, points: int, source: Source) -> Keypoints2D:
    """Read a cloud of 2D keypoints; an empty cloud is an image without persons.

    Raises:
        MessageError: wrong_fields, not_2d, wrong_steps, truncated_data, wrong_point_count, layout_unknown.
    """
    if msg.height == 0 or msg.width == 0:
        return no_persons(points, msg.header)
    # Check sizes first: numpy cannot make a structured type with an absurd point_step.
    row_step = _row_step(msg)
    fields = {field.name: field for field in msg.fields}
    confidence_name = next((name for name in CONFIDENCE_NAMES if _may_be_confidence(fields.get(name))), None)
    dtype = _point_type(msg, fields, confidence_name)
    cloud: np.ndarray = np.ndarray((msg.height, msg.width), dtype, buffer=msg.data, strides=(row_step, msg.point_step))
    cloud = _persons_first(cloud, points, source)
    names = dtype.names or ()
    xy = np.stack([cloud["x"], cloud["y"]], axis=-1)
    confidence = cloud[confidence_name] if confidence_name else None
    ids = _ids(cloud["person_id"]) if "person_id" in names else ("",) * len(cloud)
    keypoints = record(xy, confidence, ids, msg.header)
    if len(msg.fields) == len(names):
        return keypoints
    return replace(keypoints, notes=(*keypoints.notes, _unused(msg, names)))


def _may_be_confidence(field: Any) -> bool:
    """Return whether a field has confidences. Under another name than the contract's, whole numbers have a meaning of
    their own, such as the number of a class.
    """
    return field is not None and (field.name == "confidence" or (field.datatype in _FLOATS and field.count <= 1))


def _unused(msg: Any, used: tuple[str, ...]) -> Note:
    unused = [field.name for field in msg.fields if field.name not in used]
    return Note(
        "unused_fields",
        f"the fields {', '.join(unused)} of the cloud are not used, only {', '.join(used)} are; send one confidence "
        "(0 to 1) as confidence and ids as person_id, and leave others out",
    )


def _point_type(msg: Any, fields: dict[str, Any], confidence_name: str | None) -> np.dtype:
    """Return the structured type of one point with the needed fields only, at the message's offsets."""
    if "x" not in fields or "y" not in fields:
        raise MessageError(
            "wrong_fields",
            f"the cloud has the fields {', '.join(fields) or 'none'}; send x and y in pixels, optionally confidence "
            "and person_id",
        )
    if "z" in fields:
        raise MessageError(
            "not_2d", "the cloud has a field z, so it is a 3D cloud; send 2D keypoints, x and y in pixels without z"
        )
    wanted = [fields[name] for name in ("x", "y", confidence_name, "person_id") if name in fields]
    order = ">" if msg.is_bigendian else "<"
    formats = [order + _format(field, confidence_name) for field in wanted]
    for field, form in zip(wanted, formats):
        if field.offset + np.dtype(form).itemsize > msg.point_step:
            raise MessageError(
                "wrong_steps",
                f"field {field.name} at offset {field.offset} reaches beyond "
                f"point_step {msg.point_step}; correct offsets or point_step",
            )
    return np.dtype(
        {
            "names": [field.name for field in wanted],
            "formats": formats,
            "offsets": [field.offset for field in wanted],
            "itemsize": msg.point_step,
        }
    )


def _format(field: Any, confidence_name: str | None) -> str:
    """Return the numpy type of one field. A count of 0 is read as 1: some publishers leave it unset."""
    form = _DATATYPES.get(field.datatype)
    if form is None or field.count > 1:
        raise MessageError(
            "wrong_fields",
            f"field {field.name} has datatype {field.datatype} and count {field.count}; send one number of a "
            "PointField datatype 1..8",
        )
    if field.name == confidence_name and form[0] != "f":
        raise MessageError("wrong_fields", f"field {field.name} is an integer; send confidence as float32 in 0..1")
    return form


def _row_step(msg: Any) -> int:
    """Return the number of bytes from row to row, after a check that all rows lie within the data."""
    row_bytes = msg.width * msg.point_step
    # Many publishers of flat clouds leave row_step 0, and a single row does not need it.
    row_step = row_bytes if msg.height == 1 else msg.row_step
    if row_step < row_bytes:
        raise MessageError(
            "wrong_steps",
            f"row_step {row_step} is less than width {msg.width} x point_step "
            f"{msg.point_step}; set row_step to at least {row_bytes}",
        )
    needed = (msg.height - 1) * row_step + row_bytes
    if len(msg.data) < needed:
        raise MessageError(
            "truncated_data",
            f"{msg.height} x {msg.width} points need {needed} bytes, "
            f"the message has {len(msg.data)}; correct height, width or data",
        )
    return row_step


def _persons_first(cloud: np.ndarray, points: int, source: Source) -> np.ndarray:
    """Return the (height, width) cloud as (persons, points)."""
    height, width = cloud.shape
    if height == 1:
        # While the layout is unknown, ids may show the number of persons.
        persons = _persons_by_id(cloud[0]) if source.candidates else 1
        if persons > 1 and persons * points != width:
            raise WrongPointCount(
                f"the cloud has {width} keypoints of {persons} persons, the layout {points} for each",
                lambda other: other * persons == width,
            )
        return cloud.reshape(persons if persons > 1 else split_persons(width, points, source), points)
    if width != points:
        raise WrongPointCount(
            f"the cloud has {width} keypoints per person (its width), the layout {points}", lambda other: other == width
        )
    return cloud


def _persons_by_id(points: np.ndarray) -> int:
    """Return the number of persons in a list of points, if their ids divide it into equal parts, else 1."""
    if "person_id" not in (points.dtype.names or ()):
        return 1
    column = as_float64(points["person_id"])
    parts = np.split(column, np.flatnonzero(column[1:] != column[:-1]) + 1)
    named = np.isfinite(column).all() and len({float(part[0]) for part in parts}) == len(parts)
    return len(parts) if named and len({*map(len, parts)}) == 1 else 1


def _ids(column: np.ndarray) -> tuple[str, ...]:
    """Return one id per person from the (N, P) field person_id: the first finite number that is not negative."""
    # Detectors fill the whole row, so the first column alone answers nearly always.
    first_column = as_float64(column[:, 0]).tolist()
    if all(0 <= value < math.inf for value in first_column):
        return tuple(f"{value:.0f}" for value in first_column)
    column = as_float64(column)
    known = np.isfinite(column) & (column >= 0)
    first = np.take_along_axis(column, known.argmax(axis=1)[:, None], axis=1)[:, 0]
    return tuple(f"{value:.0f}" if is_known else "" for value, is_known in zip(first, known.any(axis=1)))
