# SPDX-License-Identifier: Apache-2.0
"""Ids of persons: which of them can be trusted, and the numbers that stand for them in numeric fields."""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import replace

import numpy as np

from msg_adapters import Keypoints2D
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.reasons import REASONS
from paul_ros.stream.smoothing import FORGET_SECONDS

UNKNOWN = -1
"""Number of a person without an id."""

FIRST_ASSIGNED = 2**23
"""First number that is assigned to a text. Ids that are whole numbers below it keep their own number."""

_LAST_ASSIGNED = 2**24  # float32 holds every whole number up to this one
_TEXTS_KEPT = 2**15


class PersonIds:
    """The ids of a session. Memory is bounded: detectors count ids upwards for as long as they run."""

    def __init__(self) -> None:
        self._shared: dict[str, int] = {}  # id -> last stamp at which several persons had it
        self._numbers: OrderedDict[int, int] = OrderedDict()  # hash of a text -> its number, the last seen at the end
        self._next = FIRST_ASSIGNED

    def identified(self, keypoints: Keypoints2D, ledger: Ledger) -> Keypoints2D:
        """Return the persons of one image with '' for the ids that identify nobody.

        These are negative numbers, and ids that several persons have in this image or had in the last FORGET_SECONDS.
        An id that one of two persons keeps would move between them, and a filter would mix the two. The ledger notes
        the persons who lose a shared id.
        """
        ids = keypoints.ids
        if any(name.startswith("-") for name in ids):
            ids = tuple("" if _is_negative(name) else name for name in ids)
        trusted = self._unshared(ids, keypoints.stamp)
        if trusted == keypoints.ids:
            return keypoints
        ledger.note("duplicate_ids", REASONS["duplicate_ids"].advice, trusted.count("") - ids.count(""))
        return replace(keypoints, ids=trusted)

    def _unshared(self, ids: tuple[str, ...], stamp: int) -> tuple[str, ...]:
        if self._shared:
            longest = int(FORGET_SECONDS * 1e9)
            self._shared = {name: last for name, last in self._shared.items() if 0 < stamp - last <= longest}
        if len(set(ids)) < len(ids):
            self._shared |= {name: stamp for name, count in Counter(ids).items() if name and count > 1}
        return tuple("" if name in self._shared else name for name in ids) if self._shared else ids

    def numbers(self, ids: tuple[str, ...]) -> np.ndarray:
        """Return (N,) float32 numbers of ids; equal texts always have one number, and no two texts share one.

        A whole number below FIRST_ASSIGNED is its own number. Other texts get the next number from there on when they
        first appear. No number is assigned twice. A text that was not seen while 32768 others were is forgotten, and
        has a new number when it returns. Without an id the number is UNKNOWN, and when no number is left.
        """
        return np.array([self._number(name) for name in ids], np.float32)

    def _number(self, text: str) -> int:
        if not text:
            return UNKNOWN
        if _is_own_number(text):
            return int(text)
        # Texts have any length, hashes have not.
        key = hash(text)
        if key in self._numbers:
            self._numbers.move_to_end(key)
            return self._numbers[key]
        if self._next > _LAST_ASSIGNED:
            return UNKNOWN
        self._numbers[key] = number = self._next
        self._next += 1
        if len(self._numbers) > _TEXTS_KEPT:
            self._numbers.popitem(last=False)
        return number


def _is_own_number(text: str) -> bool:
    """Return whether a text is a number below FIRST_ASSIGNED in its shortest form: '7', but not '07'."""
    # Check the length first: Python refuses to convert thousands of digits.
    if len(text) > len(str(FIRST_ASSIGNED)) or not text.isdecimal():
        return False
    number = int(text)
    return number < FIRST_ASSIGNED and text == str(number)


def _is_negative(text: str) -> bool:
    return text.startswith("-") and text[1:].isdecimal()
