# SPDX-License-Identifier: Apache-2.0
"""Words of messages for people: the nearest of some names, and counts with their nouns."""

from __future__ import annotations

from collections.abc import Iterable


def nearest(word: str, names: Iterable[str]) -> str | None:
    """Return the name that is most like a mistyped word, in any case of letters; None if none is."""
    import difflib  # costs time that only errors are worth

    close = difflib.get_close_matches(word.lower(), list(names), n=1)
    return close[0] if close else None


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """Return ", did you mean '...'?" with the nearest name; "" if none is like the word."""
    near = nearest(word, names)
    return f", did you mean '{near}'?" if near else ""


def quantity(number: int, noun: str) -> str:
    """Return a number and its noun, as in "1 person" and "2 persons"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
