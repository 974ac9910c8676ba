# SPDX-License-Identifier: Apache-2.0
"""Orthographic-N-point, reduced to the viewing direction n and solved on the sphere of directions.

The module ``paul_ros.viewing_goal`` has the goal g(n) and the climb. The best pose that looks along n is
``r1 + i r2 = u z/|z|``, and the best n has the largest g. The page ``docs/explanation/onp.md`` derives this
and proves the certificate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from paul_ros.arithmetic import (
    FEW,
    TINY,
    Arrays,
    Floats,
    Kind,
    Number,
    Vector,
    abs_square,
    cross,
    cross_of_parts,
    dot,
    replace_rows,
    unit,
)
from paul_ros.errors import InputError
from paul_ros.viewing_goal import (
    Problem,
    Scale,
    View,
    apart,
    climb,
    climb_from_each,
    facing,
    is_optimum,
    is_stationary,
    reversal,
    view_along,
)

_COLLINEAR = 1e-10  # share of the shape's squared size; less beside the longest axis counts as no width
_ROUNDING = 1e-12  # share of a distance from the origin, or of the sizes in a correlation; less counts as zero
_SLACK = 1e-11  # share of g that a proof may miss
_SEARCH_CLIMBS = 12
_LEAST = 1e-140  # smallest squared size of points that have an extent


class Poses(NamedTuple):
    """The best poses of N problems and their rivals.

    Attributes:
        R: (N,2,3,3) rotations of best and rival, det +1; identities where the points fix no pose.
        scale: (N,2) image units per shape unit; 1 in the unit-scale problem, 0 where the points fix no pose.
        translation: (N,2,2) image units.
        certified: (N,) bool, the best pose is proven to be the global optimum.
        two_fold: (N,) bool, the rival is an optimum of its own, not only the reversal of the best.
        determined: (N,) bool, the points fix a pose.
        extent: (N,) root mean square distance of the image points from their mean, image units.
    """

    R: np.ndarray
    scale: np.ndarray
    translation: np.ndarray
    certified: np.ndarray
    two_fold: np.ndarray
    determined: np.ndarray
    extent: np.ndarray


def solve(moments: np.ndarray, mean: np.ndarray, scale: Scale, rivals: bool = True) -> Poses:
    """Find the best poses of N problems.

    Args:
        moments: (N,5,5) finite weighted second moments of (shape x, y, z, image x, y) about the mean.
        mean: (N,5) weighted means of the same.
        scale: ``"free"`` or ``"unit"``, which of the two goals.
        rivals: whether to look for second optima, which is half of the work; otherwise the rival is the best itself.

    Raises:
        InputError: there is no such scale.
    """
    if scale not in ("free", "unit"):
        raise InputError(f"scale is 'free' or 'unit', not {scale!r}")
    N, method = len(moments), _solve if rivals else _solve_without_rival
    a, axes = np.linalg.eigh(moments[:, :3, :3])
    inputs = (moments.reshape(N, 25), mean, a, axes.reshape(N, 9))
    if N <= FEW:
        rows = zip(*(part.tolist() for part in inputs))
        table: np.ndarray = np.array([_answer(Floats, row, scale, method) for row in rows], dtype=float).reshape(N, 28)
    else:
        columns = tuple(list(part.T.copy()) for part in inputs)
        with np.errstate(over="ignore"):  # of absurdly large means, which fix no pose
            table = np.stack(_answer(Arrays, columns, scale, method), axis=1)
    poses = table[:, :24].reshape(N, 2, 12)
    certified, two_fold, determined = table[:, 24:27].T > 0
    return Poses(
        R=poses[:, :, :9].reshape(N, 2, 3, 3),
        scale=poses[:, :, 9],
        translation=poses[:, :, 10:],
        certified=certified,
        two_fold=two_fold,
        determined=determined,
        extent=table[:, 27],
    )


# --- from moments to a problem, and from a solution to poses


class Solution(NamedTuple):
    """The best direction and its rival.

    Attributes:
        best: the goal at the best direction.
        rival: the goal at the second optimum, or at the reversal of the best.
        certified: bool, the best is proven to be the global optimum.
        two_fold: bool, the rival is an optimum of its own.
    """

    best: View
    rival: View
    certified: Number
    two_fold: Number


_HARMLESS = Problem((0.2, 0.3, 0.5), (0.3 + 0j, 0.4j, 0.1 + 0.1j), (0.04, -0.03, 0.12), 0.5)
"""Solved in place of problems whose points fix no pose."""


def _answer(xp: Kind, inputs: Sequence[Any], scale: Scale, method: Callable[..., Solution]) -> list[Number]:
    """Return best and rival as ``_pose`` gives them, three flags and the extent: 28 numbers.

    Args:
        xp: Floats or Arrays.
        inputs: 25 second moments, 5 means, 3 eigenvalues of the shape's moments and its 9 entries of axes.
        scale: which of the two goals.
        method: takes xp, a Problem and the scale; returns a Solution.
    """
    M, mean, a, V = inputs
    S_square, W_square = M[0] + M[6] + M[12], M[18] + M[24]
    over_S, over_W = 1 / (S_square + TINY), 1 / (W_square + TINY)
    over_both = xp.sqrt(over_S) * xp.sqrt(over_W)
    v1, v2 = (V[1], V[4], V[7]), (V[2], V[5], V[8])
    axes = (cross(v1, v2), v1, v2)
    b = ((M[15] + 1j * M[20]) * over_both, (M[16] + 1j * M[21]) * over_both, (M[17] + 1j * M[22]) * over_both)
    d = (dot(b, axes[0]), dot(b, v1), dot(b, v2))
    extent = xp.sqrt(W_square)
    zoom = extent * xp.sqrt(over_S)
    problem = Problem((a[0] * over_S, a[1] * over_S, a[2] * over_S), d, cross_of_parts(d), 1 / (1 + zoom))
    # If the second eigenvalue vanishes, all points lie on one line, and turns about that line cannot be seen.
    determined = (
        (problem.a[1] > _COLLINEAR)
        & (S_square > _ROUNDING**2 * dot(mean, mean) + _LEAST)
        & (W_square > _ROUNDING**2 * (mean[3] * mean[3] + mean[4] * mean[4]) + _LEAST)
        & (abs_square(d[0]) + abs_square(d[1]) + abs_square(d[2]) > _ROUNDING**2)
    )
    if xp.every(determined):
        return [*_poses(xp, method(xp, problem, scale), axes, mean, zoom, scale), determined, extent]
    found = method(xp, xp.where(determined, problem, _HARMLESS), scale)
    answer = [*_poses(xp, found, axes, mean, zoom, scale), determined]
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    shift = [1.0, mean[3] - mean[0], mean[4] - mean[1]] if scale == "unit" else [0.0, mean[3], mean[4]]
    nothing = [*identity, *shift, *identity, *shift, False, False, False]
    return [*(xp.where(determined, x, y) for x, y in zip(answer, nothing)), extent]


def _poses(xp: Kind, found: Solution, *rest: Any) -> list[Number]:
    best = _pose(xp, found.best, *rest)
    rival = best if found.rival is found.best else _pose(xp, found.rival, *rest)
    return [*best, *rival, found.certified, found.two_fold]


def _pose(
    xp: Kind, view: View, axes: tuple[Vector, Vector, Vector], mean: Sequence[Number], zoom: Number, scale: Scale
) -> list[Number]:
    """Return the nine entries of R, row by row, the scale and the two entries of the translation."""
    length = abs(view.z)
    turn = xp.where(length > TINY, view.z, 1.0) / xp.where(length > TINY, length, 1.0)
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2) = axes
    n0, n1, n2 = view.n
    q0, q1, q2 = view.u[0] * turn, view.u[1] * turn, view.u[2] * turn
    r0, r1, r2 = q0 * x0 + q1 * y0 + q2 * z0, q0 * x1 + q1 * y1 + q2 * z1, q0 * x2 + q1 * y2 + q2 * z2
    s = zoom * length / (1 - view.E) if scale == "free" else 1.0 + 0 * zoom
    shift = s * (r0 * mean[0] + r1 * mean[1] + r2 * mean[2])
    return [
        *(r0.real, r1.real, r2.real),
        *(r0.imag, r1.imag, r2.imag),
        *(n0 * x0 + n1 * y0 + n2 * z0, n0 * x1 + n1 * y1 + n2 * z1, n0 * x2 + n1 * y2 + n2 * z2),
        *(s, mean[3] - shift.real, mean[4] - shift.imag),
    ]


# --- the solver


def _solve(xp: Kind, problem: Problem, scale: Scale) -> Solution:
    """Find the better of the optima near the start and near its reversal; the other one is the rival."""
    # Climb from the least-squares start.
    one = climb(xp, problem, start_direction(xp, problem), scale)
    return _solve_from(xp, problem, one, scale)


def _solve_from(xp: Kind, problem: Problem, one: View, scale: Scale) -> Solution:
    """Complete a solution whose first climb is done."""
    # Climb from the Necker reversal of the first optimum, where a second one is likely.
    two = climb(xp, problem, reversal(one.n), scale, one.n)
    # The larger goal wins.
    swap = (two.g > one.g) & apart(two.n, one.n)
    if xp.any(swap):
        one, two = xp.where(swap, two, one), xp.where(swap, one, two)
    # Try to prove the winner optimal; without a proof, search the whole sphere.
    found = _with_rival(xp, problem, one, two, scale)
    return found if xp.every(found.certified) else _retry(xp, _search, problem, found, scale, _SEARCH_CLIMBS)


def _solve_without_rival(xp: Kind, problem: Problem, scale: Scale) -> Solution:
    """Find the best alone: one climb, and everything else only if that climb ends without a proof."""
    one = climb(xp, problem, start_direction(xp, problem), scale)
    found = Solution(one, one, is_certified(xp, problem, one, scale), one.g < 0)
    return found if xp.every(found.certified) else _retry(xp, _solve_again, problem, found, scale, 1)


def _solve_again(xp: Kind, problem: Problem, found: Solution, scale: Scale) -> Solution:
    whole = _solve_from(xp, problem, found.best, scale)
    return whole._replace(rival=whole.best)


def _retry(
    xp: Kind, method: Callable[..., Solution], problem: Problem, found: Solution, scale: Scale, climbs: int
) -> Solution:
    """Solve the problems without a proof by another method, which climbs so many times at once."""
    if xp is Floats:
        return method(xp, problem, found, scale)
    few = FEW // climbs
    replace_rows(found, ~found.certified, lambda xp, *rest: method(xp, *rest, scale), problem, found, few=few)
    return found


def _with_rival(xp: Kind, problem: Problem, best: View, other: View, scale: Scale) -> Solution:
    """Complete a solution; the rival is the other optimum, or else the reversal of the best."""
    two_fold = apart(best.n, other.n) & is_optimum(other)
    rival = other
    if not xp.every(two_fold):
        reversed_best = view_along(xp, problem, facing(xp, problem, reversal(best.n)), scale)
        rival = xp.where(two_fold, other, reversed_best)
    return Solution(best, rival, is_certified(xp, problem, best, scale), two_fold)


def start_direction(xp: Kind, problem: Problem) -> Vector:
    """Return a cheap estimate of the best direction, where the climb starts.

    Along the two thick axes of the shape it is the least-squares solution. Along the thin axis it satisfies the
    constraint of a rotation.

    Rotations have q^T q = 0 for q = s (r1 + i r2). This leaves two roots for q_0, Necker reversals of each other.
    Least squares gives d_0 / a_0, which is all noise if a_0 is small and then only chooses the root. The thinner the
    shape, the more the start relies on the root.
    """
    (a0, a1, a2), (d0, d1, d2) = problem.a, problem.d
    q1, q2 = d1 / a1, d2 / a2
    root = xp.complex_sqrt(-(q1 * q1 + q2 * q2))
    weight = 1 - a0 / a1
    q0 = d0 / a1 + xp.where((root * d0.conjugate()).real < 0, -weight, weight) * root
    return unit(xp, cross_of_parts((q0, q1, q2)))


def is_certified(xp: Kind, problem: Problem, view: View, scale: Scale) -> Number:
    """Return whether a direction is proven to be the best of all, up to ``_SLACK`` of g.

    A quadratic n^T K n + 2 h.n bounds g from above and touches it here. It has no higher point on the sphere if
    lambda - K is positive semidefinite, with lambda = n^T K n + h.n (More and Sorensen, 1983). This holds if no
    coefficient of the characteristic polynomial is negative.
    """
    of_A, of_T = 1.0, 1 / (view.g + TINY)
    if scale == "unit":
        of_A, of_T = problem.k * of_T, (1 - problem.k) * of_T / (xp.sqrt(abs_square(view.z)) + TINY)
    n, a, d = view.n, problem.a, problem.d
    K00, K11, K22 = [of_A * a[i] - of_T * abs_square(d[i]) for i in range(3)]
    K12, K02, K01 = [-of_T * (d[i] * d[j].conjugate()).real for i, j in ((1, 2), (0, 2), (0, 1))]
    mixed = K12 * n[1] * n[2] + K02 * n[0] * n[2] + K01 * n[0] * n[1]
    squares = (n[0] * n[0], n[1] * n[1], n[2] * n[2])
    multiplier = dot((K00, K11, K22), squares) + 2 * mixed + of_T * dot(problem.c, n) + _SLACK
    x, y, z = multiplier - K00, multiplier - K11, multiplier - K22
    minors = y * z - K12 * K12 + x * z - K02 * K02 + x * y - K01 * K01
    determinant = x * y * z - x * K12 * K12 - y * K02 * K02 - z * K01 * K01 - 2 * K12 * K02 * K01
    return (xp.minimum(xp.minimum(x + y + z, minors), determinant) >= 0) & is_stationary(view)


# --- the search after a failed proof


def _search(xp: Kind, problem: Problem, found: Solution, scale: Scale) -> Solution:
    """Climb from all over the sphere; keep the best and the second best that is apart from it."""
    best, rival = found.best, found.rival
    for new in climb_from_each(xp, problem, fibonacci_sphere(_SEARCH_CLIMBS), scale):
        higher, distinct = new.g > best.g, apart(new.n, best.n)
        second = distinct & is_optimum(new) & (new.g > rival.g)
        rival = xp.where(higher & distinct, best, xp.where(second, new, rival))
        best = xp.where(higher, new, best)
    return _with_rival(xp, problem, best, rival, scale)


def fibonacci_sphere(count: int) -> list[Vector]:
    """Return nearly evenly spread directions."""
    heights = [1 - (2 * i + 1) / count for i in range(count)]
    turns = [math.pi * (1 + 5**0.5) * i for i in range(count)]
    return [(math.cos(t) * math.sqrt(1 - z * z), math.sin(t) * math.sqrt(1 - z * z), z) for t, z in zip(turns, heights)]
