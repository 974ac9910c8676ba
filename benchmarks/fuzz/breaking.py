# SPDX-License-Identifier: Apache-2.0
"""Ways to break messages, bytes, JSON values and arrays."""

from __future__ import annotations

import array
import json
import random
from typing import Any

import numpy as np

from benchmarks.fuzz.messages import LiveMake

#: Sequences of a length that the message definition fixes, by (name of the field, length).
_FIXED = {("skeleton", 18), ("keypoints", 70), ("kp", 2), ("k", 9), ("r", 9), ("p", 12)}
#: Fields of unsigned integers in the message definitions.
_UNSIGNED = {"nanosec", "height", "width", "offset", "count", "point_step", "row_step", "track_id", "step", "datatype"}
FLOATS = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-9, 1e6, 1.0001e6, -1e30, 1e38, 1.7e308)
_INTEGERS = (0, 1, -1, 2, 7, 17, 18, 127, 255, 65535, 2**31 - 1, -(2**31), 2**32 - 1)
_TEXTS = ("", "x", "body_kps", "nose", "16UC1", "32FC1", "-1", "ä\u2028\0\n", "7" * 400, "/", "{}", "%s")

Slot = tuple[Any, Any, str]
"""Place of a value in a message: its holder, its key there, and the name of the field."""


def _slots(thing: Any, found: list[Slot] | None = None, name: str = "") -> list[Slot]:
    """Return every place of a message that can hold another value."""
    found = [] if found is None else found
    if isinstance(thing, list):
        for index, value in enumerate(thing):
            found.append((thing, index, name))
            _slots(value, found, name)
    elif hasattr(thing, "__dict__"):
        for key, value in vars(thing).items():
            if key != "__msgtype__":
                found.append((thing, key, key))
                _slots(value, found, key)
    return found


def _put(holder: Any, key: Any, value: Any) -> None:
    if isinstance(holder, list):
        holder[key] = value
    else:
        object.__setattr__(holder, key, value)  # messages of bags are frozen


def _get(holder: Any, key: Any) -> Any:
    return holder[key] if isinstance(holder, list) else getattr(holder, key)


def break_fields(msg: Any, rng: random.Random) -> None:
    """Give some fields other values of the same type, in place."""
    places = _slots(msg)
    for _ in range(rng.choice((0, 1, 1, 2, 5, 40))):
        holder, key, name = rng.choice(places)
        if not isinstance(holder, list) or key < len(holder):
            _put(holder, key, _other(_get(holder, key), name, rng))


def _other(value: Any, name: str, rng: random.Random) -> Any:
    """Return a value of the same type and, if the definition fixes it, of the same length."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, np.integer)):
        return abs(rng.choice(_INTEGERS)) if name in _UNSIGNED else rng.choice(_INTEGERS[:-1])
    if isinstance(value, (float, np.floating)):
        return rng.choice((*FLOATS, rng.uniform(-1e4, 1e4)))
    if isinstance(value, str):
        return rng.choice(_TEXTS)
    if isinstance(value, (np.ndarray, array.array)):
        return _other_numbers(value, name, rng)
    if isinstance(value, list) and (name, len(value)) not in _FIXED:
        return _other_list(value, rng)
    return value


def _other_list(values: list[Any], rng: random.Random) -> list[Any]:
    """Return a list of other length or order."""
    short = rng.randrange(len(values) + 1)
    return rng.choice((values[:short], values[short:], values * 2, [], values[::-1], values[:1] * rng.randrange(200)))


def _other_numbers(values: Any, name: str, rng: random.Random) -> Any:
    """Return an array with other numbers and, unless the definition fixes it, another length."""
    numbers = np.array(values)
    if numbers.size:
        for _ in range(rng.choice((1, 3, numbers.size))):
            index = rng.randrange(numbers.size)
            byte = numbers.dtype.kind == "u"
            numbers.flat[index] = rng.randrange(256) if byte else np.float32(rng.choice(FLOATS[:-1]))
    if (name, numbers.size) not in _FIXED and rng.random() < 0.5:
        numbers = np.resize(numbers, rng.randrange(2 * numbers.size + 2))
    return array.array(values.typecode, numbers.tolist()) if isinstance(values, array.array) else numbers


def break_types(msg: Any, rng: random.Random) -> None:
    """Remove some fields or give them values that no message can have, in place."""
    places = _slots(msg)
    for _ in range(rng.choice((1, 1, 2, 4))):
        holder, key, _ = rng.choice(places)
        if isinstance(holder, list) and key >= len(holder):
            continue
        if rng.random() < 0.1 and not isinstance(holder, list) and key in vars(holder):
            delattr(holder, key)
        else:
            _put(holder, key, _junk(rng))


def _junk(rng: random.Random) -> Any:
    nested: list[Any] = [[None, [{}]], "x"]
    plain: tuple[Any, ...] = (
        None,
        "text",
        b"bytes",
        3,
        -1,
        1.5,
        np.nan,
        True,
        10**400,
        1j,
        [],
        {},
        (),
        object(),
        object,
        nested,
    )
    arrays = (np.zeros((2, 3)), np.array(["a"]), np.array(None))
    return rng.choice((*plain, [None] * 17, *arrays, LiveMake()("x/msg/Y")))


def break_bytes(whole: bytes, rng: random.Random) -> bytes:
    """Return bytes with flipped bits, or parts cut, inserted, removed, overwritten or exchanged."""
    data = bytearray(whole)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(6)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = rng.randbytes(rng.choice((1, 4, 64)))
        elif kind == 3:
            del data[at : at + rng.choice((1, 4, 8, 100))]
        elif kind == 4 and len(data) >= 8:
            at = rng.randrange(len(data) - 7)
            values = (b"\0" * 8, b"\xff" * 8, b"\xff\xff\xff\x7f" * 2, rng.randbytes(8))
            data[at : at + 8] = rng.choice(values)[: rng.choice((1, 4, 8))].ljust(8, b"\0")
        else:
            start, size = rng.randrange(len(data) + 1), rng.randrange(200)
            data[at : at + size] = data[start : start + size]
    return bytes(data) if rng.random() < 0.97 else rng.randbytes(rng.randrange(300))


def break_array(values: np.ndarray, rng: random.Random) -> Any:
    """Return an array with another number, shape or type."""
    flat = values.copy()
    flat.flat[rng.randrange(flat.size)] = np.float32(rng.choice(FLOATS[:-1]))
    shapes = (values.T, values[:0], values[None], values.ravel(), np.float32(1))
    kinds = (values.astype(np.float64), values.astype(int), values.astype(complex), values.astype("S4"))
    return rng.choice((flat, flat, flat, values * np.float32(1e5), *shapes, *kinds))


def break_json(whole: dict[str, Any], rng: random.Random) -> Any:
    """Return a JSON object with other, missing or additional values."""
    head = json.loads(json.dumps(whole))
    for _ in range(rng.choice((1, 1, 2, 5))):
        places = _json_places(head)
        holder, key = rng.choice(places)
        if rng.random() < 0.2:
            del holder[key]
        elif rng.random() < 0.1 and isinstance(holder, dict):
            holder[rng.choice(("upright", "scale", "image_unit", "x", ""))] = _json_junk(rng)
        else:
            holder[key] = _json_junk(rng)
    return head if rng.random() < 0.97 else _json_junk(rng)


def _json_places(thing: Any, found: list[tuple[Any, Any]] | None = None) -> list[tuple[Any, Any]]:
    """Return every place of a JSON value: (holder, key)."""
    found = [] if found is None else found
    items: Any = thing.items() if isinstance(thing, dict) else enumerate(thing) if isinstance(thing, list) else ()
    for key, value in items:
        found.append((thing, key))
        _json_places(value, found)
    return found


def _json_junk(rng: random.Random) -> Any:
    nested: Any = []
    for _ in range(rng.choice((1, 200))):
        nested = [nested]
    numbers = (0, 1, -1, 3, 17, 2**14, 2**14 + 1, 2**40, 10**300, 0.5, 1e-300, float("nan"), float("inf"))
    return rng.choice((*numbers, None, True, False, "", "nose", "left_hip", "residual", {}, [], nested, {"a": [1]}))
