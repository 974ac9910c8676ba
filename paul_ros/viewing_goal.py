# SPDX-License-Identifier: Apache-2.0
"""The goal of orthographic-N-point over viewing directions n, its derivatives, and Newton's climb to a maximum.

In the principal axes of the shape, with image points as complex numbers, everything is a sum over three components.
The page ``docs/explanation/onp.md`` has the derivation. With ``u = e1 + i e2`` a right-handed frame of the plane
across n and ``*`` for complex conjugates,

    E = sum a n^2        z = sum u* d        T = |z|^2
    unit scale: g = k E + 2 (1 - k) sqrt(T)
    free scale: g = T / (1 - E)

A tangent step is a complex number s, to ``n + Re(s* u)``. The slope of g is then complex. Its Hessian maps s to
``m s + w s*`` with m real and w complex (eigenvalues m - |w| and m + |w|).
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from paul_ros.arithmetic import (
    TINY,
    Arrays,
    Floats,
    Kind,
    Number,
    Vector,
    abs_square,
    dot,
    frame,
    map_tree,
    replace_rows,
    take_rows,
)

Scale = Literal["free", "unit"]

COS_APART = math.cos(0.05)
"""Cosine of 0.05 radians: two directions closer than this count as one."""

_STEPS = 40
_USUAL_STEPS = 6  # rows of arrays that need more steps continue without the others
_STEP_LIMIT = 0.8  # tangent of the largest step's angle: keeps Newton on the hill where it started
_GAIN = 1e-22  # share of g that one more step could gain at a direction that has arrived


class Problem(NamedTuple):
    """One problem, or N, in the principal axes of the shape.

    Attributes:
        a: eigenvalues of A = S w S^T over their sum, ascending: the shape is thinnest along the first axis.
        d: complex, S w (x + i y) over |S| |W|, in those axes.
        c: cross product of d's real and imaginary parts: T(n) - T(-n) = 4 c.n.
        k: |S| / (|S| + |W|), the weight of E in the unit-scale goal.
    """

    a: Vector
    d: Vector
    c: Vector
    k: Number


class View(NamedTuple):
    """The goal at one viewing direction.

    Attributes:
        n: the direction, of length 1.
        u: complex frame of the plane across n.
        z: complex correlation of shape and image; its angle is the best turn of the image.
        E: share of the shape's squared size along n.
        g: the goal.
        slope: complex derivative of g.
        m, w: the Hessian of g, real and complex.
    """

    n: Vector
    u: Vector
    z: Number
    E: Number
    g: Number
    slope: Number
    m: Number
    w: Number


def view_along(xp: Kind, problem: Problem, n: Vector, scale: Scale) -> View:
    """Return the goal and its derivatives at n.

    Nearly all time of the solver is spent here, so the sums are written out.
    """
    (a0, a1, a2), (d0, d1, d2), (n0, n1, n2) = problem.a, problem.d, n
    u = u0, u1, u2 = frame(xp, n)
    z = u0.conjugate() * d0 + u1.conjugate() * d1 + u2.conjugate() * d2
    y = n0 * d0 + n1 * d1 + n2 * d2
    zc = z.conjugate()
    T = (z * zc).real + TINY
    T_slope, T_m, T_w = -2 * zc * y, 2 * (y * y.conjugate()).real - T, -zc * (u0 * d0 + u1 * d1 + u2 * d2)
    # n.n = 1 and n.u = u.u = 0, so a0 may be subtracted from a everywhere except in E itself.
    b1, b2 = a1 - a0, a2 - a0
    bn1, bn2 = b1 * n1, b2 * n2
    E = a0 + bn1 * n1 + bn2 * n2
    E_slope, E_m, E_w = 2 * (bn1 * u1 + bn2 * u2), 1 - 3 * E, b1 * u1 * u1 + b2 * u2 * u2
    if scale == "unit":
        k = problem.k
        f = (1 - k) / xp.sqrt(T)
        bend = f / (4 * T) * T_slope
        g, slope = k * E + 2 * f * T, k * E_slope + f * T_slope
        m, w = k * E_m + f * T_m - (bend * T_slope.conjugate()).real, k * E_w + f * T_w - bend * T_slope
    else:
        over = 1 / (1 - E)
        g = T * over
        slope = (T_slope + g * E_slope) * over
        m, w = (T_m + g * E_m + (slope * E_slope.conjugate()).real) * over, (T_w + g * E_w + slope * E_slope) * over
    return View(n, u, z, E, g, slope, m, w)


# --- relations of directions


def facing(xp: Kind, problem: Problem, n: Vector) -> Vector:
    """Return n or -n, whichever has the larger T: both see the same plane, from its two sides."""
    sign = xp.where(dot(problem.c, n) < 0, -1.0, 1.0)
    return (sign * n[0], sign * n[1], sign * n[2])


def reversal(n: Vector) -> Vector:
    """Return the Necker reversal of n: its reflection about the axis along which the shape is thinnest."""
    return (n[0], -n[1], -n[2])


def apart(x: Vector, y: Vector) -> Number:
    """Return whether two directions are more than 0.05 radians apart."""
    return dot(x, y) < COS_APART


def _opposite(n: Vector) -> Vector:
    return (-n[0], -n[1], -n[2])


# --- the climb


def is_stationary(view: View) -> Number:
    """Return whether another step would gain nothing.

    The gain is about slope^2 over curvature, which is huge for needles seen end on.
    """
    return abs_square(view.slope) <= _GAIN * view.g * (view.g + abs(view.m))


def is_optimum(view: View) -> Number:
    """Return whether g has a strict maximum here."""
    return is_stationary(view) & (view.m < 0) & (view.m * view.m > abs_square(view.w))


def climb(xp: Kind, problem: Problem, n: Vector, scale: Scale, known: Vector | None = None) -> View:
    """Climb from n to a local maximum of g by Newton's steps.

    Args:
        xp: Floats or Arrays.
        problem: one problem or N.
        n: where the climb starts.
        scale: which of the two goals.
        known: a maximum that was found before; a climb that comes near it stops.

    Returns:
        The goal at the maximum, or at the last of 40 steps.
    """
    if xp is Floats:
        return newton(xp, problem, n, scale, _STEPS, known)
    view = newton(xp, problem, n, scale, _USUAL_STEPS, known)
    late = ~_arrived(problem, view, known)
    rest = (problem, view.n) if known is None else (problem, view.n, known)
    replace_rows(
        view, late, lambda xp, p, *directions: newton(xp, p, directions[0], scale, _STEPS, *directions[1:]), *rest
    )
    return view


def climb_from_each(xp: Kind, problem: Problem, starts: list[Vector], scale: Scale) -> list[View]:
    """Climb from every start; returns one View a start."""
    if xp is Floats:
        return [climb(xp, problem, n, scale) for n in starts]
    N = len(problem.k)
    x, y, z = (np.repeat(part, N) for part in np.array(starts).T)
    views = climb(Arrays, map_tree(lambda values: np.tile(values, len(starts)), problem), (x, y, z), scale)
    return [take_rows(views, slice(i * N, (i + 1) * N)) for i in range(len(starts))]


def newton(xp: Kind, problem: Problem, n: Vector, scale: Scale, steps: int, known: Vector | None = None) -> View:
    """Take up to so many Newton steps from n; stop at a maximum, or near a known one.

    The start may see the side with the smaller T, for turning it round could leave the hill of the second optimum.
    A maximum on that side is left for the opposite direction, which has a larger T.
    """
    view, limit = view_along(xp, problem, n, scale), _STEP_LIMIT
    for _ in range(steps):
        if xp.every(_arrived(problem, view, known)):
            break
        n, before = _newton_step(xp, view, limit), view.g
        behind = dot(problem.c, view.n) < 0
        if xp.any(behind):
            n = xp.where(behind & is_stationary(view), _opposite(view.n), n)
        view = view_along(xp, problem, n, scale)
        # Shorter after g fell: steps that stay too long can go in circles.
        limit = limit * (1.0 - 0.7 * (view.g < before))
    return view


def _arrived(problem: Problem, view: View, known: Vector | None) -> Number:
    """Return whether the climb is at a maximum on the side with the larger T, or near a known one."""
    done = is_stationary(view) & (dot(problem.c, view.n) >= 0)
    return done if known is None else done | (dot(view.n, known) >= COS_APART)


def _newton_step(xp: Kind, view: View, limit: Number) -> Vector:
    """Return the direction one Newton step away; an indefinite Hessian is shifted, so that the step leads uphill."""
    (n0, n1, n2), (u0, u1, u2), _, _, _, slope, m, w = view
    radius = abs(w)
    top = m + radius
    m = m - (top >= 0) * (top + 0.1 * abs(m - radius) + TINY)
    step = (w * slope.conjugate() - m * slope) / (m * m - radius * radius + TINY)
    length = abs(step)
    shrink = xp.minimum(1.0, limit / (length + TINY))
    length, back = shrink * length, shrink * step.conjugate()
    over = 1 / xp.sqrt(1 + length * length)
    return ((n0 + (back * u0).real) * over, (n1 + (back * u1).real) * over, (n2 + (back * u2).real) * over)
