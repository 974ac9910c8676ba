# SPDX-License-Identifier: Apache-2.0
"""Arithmetic of one problem on floats, or of N problems on arrays (N,), by the same formulas.

NumPy spends ten times longer on its calls than on the sums of a single problem, so single problems use floats.
A vector is a tuple of three numbers. A tree is a tuple of numbers or of trees, for instance a NamedTuple of vectors.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Number = Any
"""A float, complex or bool, or an array (N,) of them."""
Vector = tuple[Number, Number, Number]

FEW = 16
"""The most problems that are solved one by one on floats; more are faster as arrays."""

TINY = 1e-150
"""Added to denominators; its square is still a number."""


class Floats:
    """The operations that floats and arrays spell differently, for floats."""

    sqrt, complex_sqrt, minimum, every, any = math.sqrt, cmath.sqrt, min, bool, bool

    @staticmethod
    def where(condition: Number, yes: Any, no: Any) -> Any:
        """Return one of two trees."""
        return yes if condition else no


class Arrays:
    """The operations that floats and arrays spell differently, for arrays."""

    sqrt, complex_sqrt, minimum, every, any = np.sqrt, np.sqrt, np.minimum, np.all, np.any

    @staticmethod
    def where(condition: Number, yes: Any, no: Any) -> Any:
        """Return a tree whose rows are those of the first tree where the condition (N,) holds, else of the second."""
        return map_tree(lambda y, n: np.where(condition, y, n), yes, no)


Kind = type[Floats] | type[Arrays]


# --- trees of arrays


def map_tree(function: Callable[..., Any], *trees: Any) -> Any:
    """Apply a function to the corresponding arrays of trees of equal structure."""
    if not isinstance(trees[0], tuple):
        return function(*trees)
    parts = [map_tree(function, *values) for values in zip(*trees)]
    return type(trees[0])(*parts) if hasattr(trees[0], "_fields") else tuple(parts)


def take_rows(tree: Any, rows: Any) -> Any:
    """Select rows of every array of a tree."""
    return map_tree(lambda values: values[rows], tree)


def replace_rows(tree: Any, rows: np.ndarray, method: Callable[..., Any], *inputs: Any, few: int = FEW) -> None:
    """Overwrite rows of a tree, in place, with a method's results for these rows.

    Args:
        tree: arrays (N,).
        rows: (N,) bool.
        method: takes Floats or Arrays and the inputs; returns a tree of the same structure.
        inputs: trees of arrays (N,).
        few: up to so many rows go through the method one by one, on floats; a call on arrays has a higher fixed cost.
    """
    if np.count_nonzero(rows) > few:
        map_tree(lambda values, new: values.__setitem__(rows, new), tree, method(Arrays, *take_rows(inputs, rows)))
        return
    for row in np.flatnonzero(rows):
        new = method(Floats, *map_tree(lambda values: values[row].item(), inputs))
        map_tree(lambda values, value: values.__setitem__(row, value), tree, new)


# --- vectors


def dot(x: Sequence[Number], y: Sequence[Number]) -> Number:
    """Return the dot product of the first three components, without conjugation."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def cross(x: Vector, y: Vector) -> Vector:
    """Return the cross product."""
    return (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])


def cross_of_parts(q: Vector) -> Vector:
    """Return Re q x Im q of a complex vector."""
    x, y, z = (part.conjugate() for part in q)
    return ((y * q[2]).imag, (z * q[0]).imag, (x * q[1]).imag)


def abs_square(z: Number) -> Number:
    """Return |z|^2 of a complex number."""
    return z.real * z.real + z.imag * z.imag


def unit(xp: Kind, v: Vector) -> Vector:
    """Return v over its length, or the first axis if v has no length."""
    length = xp.sqrt(dot(v, v))
    some = length > TINY
    over = 1.0 / xp.where(some, length, 1.0)
    return (xp.where(some, v[0] * over, 1.0), v[1] * over, v[2] * over)


def frame(xp: Kind, n: Vector) -> Vector:
    """Return u = e1 + i e2 with e1, e2, n orthonormal and right-handed (Duff et al., JCGT 2017)."""
    x, y, z = n
    sign = xp.where(z < 0, -1.0, 1.0)
    over = -1.0 / (sign + z)
    a, b, c = x * over, y * over, sign * x
    d = a * y
    return (1.0 + c * a + 1j * d, sign * d + 1j * (sign + y * b), -1j * y - c)
