# SPDX-License-Identifier: Apache-2.0
"""Published normalised errors, printed beside measured ones."""

from __future__ import annotations

_PAUL_TABLE_1 = """
              drink pickup  yoga stretch dance shark    S1    S5   S64   S70  S123
CNS            3.04   9.18 11.15    7.97  7.59  8.32 37.62 40.02 29.00 26.26 26.46
PND            0.37   3.72  1.40    1.56 14.54  1.35     -     -     -     -     -
BMM            2.66  17.31 11.50   10.34 18.64 23.11 16.45 14.07 18.13 18.91 19.32
BMM-v2         1.19   1.98  1.29    1.44 10.60  5.51     -     -     -     -     -
Deep_NRSfM    17.38   0.53 12.54   21.63 20.95 21.83 10.74 13.40  4.38  2.17  2.23
PAUL           0.47   2.03  1.71    1.62 10.22  0.37  4.97  4.38  0.39  0.77  0.59
"""

SOURCE = "Wang and Lucey, PAUL: Procrustean Autoencoder for Unsupervised Lifting, CVPR 2021, table 1"

REMARK = "CNS and BMM-v2 use the order of the frames; the cameras of the long sequences are random and not public"


def _parse(text: str) -> dict[str, dict[str, float]]:
    """Parse a table with a column a sequence and a row a method to sequence -> method -> figure."""
    head, *lines = text.strip().splitlines()
    cells = [line.split() for line in lines]
    return {
        sequence: {name.replace("_", " "): float(row[i]) for name, *row in cells if row[i] != "-"}
        for i, sequence in enumerate(head.split())
    }


NORMALISED_ERROR_PERCENT = _parse(_PAUL_TABLE_1)
"""Sequence -> method -> normalised error in %."""


def published(sequence: str) -> dict[str, float]:
    """Return method -> normalised error in % of a sequence; empty if none is published.

    Args:
        sequence: its name, with or without the suffix ``_train``: ``drink``, ``S5_train``.
    """
    name = sequence.removesuffix("_train").lower()
    known = {key.lower(): figures for key, figures in NORMALISED_ERROR_PERCENT.items()}
    return known.get(name, {})
