# SPDX-License-Identifier: Apache-2.0
"""Orthographic-N-point reduced to its one true unknown, the viewing direction n, and solved on the sphere.

In the principal axes of the shape, with image points as complex numbers, everything is a sum over three components
(``docs/onp.md`` derives it).  With ``u = e1 + i e2`` a right-handed frame of the plane across n and ``*`` for complex
conjugates,

    E = sum a n^2        z = sum u* d        T = |z|^2
    unit scale: g = k E + 2 (1 - k) sqrt(T)
    free scale: g = T / (1 - E)

the best pose that looks along n is ``r1 + i r2 = u z/|z|``, and the best n has the largest g.  A tangent step is a
complex number s, to ``n + Re(s* u)``; the slope of g is complex then, and its Hessian maps s to ``m s + w s*`` with m
real and w complex (eigenvalues m - |w| and m + |w|).

A vector is a tuple of three numbers, and every function takes a number to be a float, for one problem, or an array
(N,), for N: on single floats numpy would spend ten times longer on its calls than on the sums.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

Number = Any
"""A float or complex, or an array (N,) of them."""
Vector = tuple[Number, Number, Number]
Scale = Literal["free", "unit"]

_FEW = 16
"""Up to here problems are solved one by one on floats; more go faster as arrays."""

_COLLINEAR = 1e-10  # of the shape's squared size: less beside the longest axis is no width
_ROUNDING = 1e-12  # of a distance from the origin, or of the sizes that a correlation is of: less is none
_STEPS = 40
_USUAL_STEPS = 6  # rows of arrays that need more go on without the others
_STEP_LIMIT = 0.8  # radians: keeps Newton in sight of the hill it started on
_GAIN = 1e-22  # of g, what another step from a direction that has arrived could gain
_SLACK = 1e-11  # of g, what a proof may miss
_COS_APART = math.cos(0.05)  # radians: two directions closer than this are one
_SEARCH_CLIMBS = 12
_LEAST = 1e-140  # squared size of points that have any
_TINY = 1e-150


class Poses(NamedTuple):
    """The best poses of N problems and their rivals.

    Attributes:
        R: (N,2,3,3) det +1, best and rival; identities where nothing is determined.
        scale: (N,2); 1 in the unit-scale problem, 0 where nothing is determined.
        translation: (N,2,2).
        certified: (N,) bool, the best is proven to be the best of all.
        two_fold: (N,) bool, the rival is an optimum, not only the reversal of the best.
        determined: (N,) bool, the points fix a pose.
        extent: (N,) root mean square distance of the image points from their mean.
    """

    R: np.ndarray
    scale: np.ndarray
    translation: np.ndarray
    certified: np.ndarray
    two_fold: np.ndarray
    determined: np.ndarray
    extent: np.ndarray


def solve(moments: np.ndarray, mean: np.ndarray, scale: Scale, rivals: bool = True) -> Poses:
    """Best poses of N problems.

    Args:
        moments: (N,5,5) finite weighted second moments of (shape x, y, z, image x, y) about
        mean: (N,5) their weighted means.
        scale: which of the two goals.
        rivals: whether to look for second optima, half of the work; without, the best stands in for its rival.

    Raises:
        ValueError: there is no such scale.
    """
    if scale not in ("free", "unit"):
        raise ValueError(f"scale is 'free' or 'unit', not {scale!r}")
    N, method = len(moments), _solve if rivals else _solve_alone
    a, axes = np.linalg.eigh(moments[:, :3, :3])
    inputs = (moments.reshape(N, 25), mean, a, axes.reshape(N, 9))
    if N <= _FEW:
        answers = [_answer(_Floats, *row, scale, method) for row in zip(*(part.tolist() for part in inputs))]
        table = np.array(answers, dtype=float).reshape(N, 28)
    else:
        with np.errstate(over="ignore"):  # of means beyond all reason, which fix no pose
            table = np.stack(_answer(_Arrays, *(list(part.T.copy()) for part in inputs), scale, method), axis=1)
    poses = table[:, :24].reshape(N, 2, 12)
    flags = table[:, 24:27].T > 0
    return Poses(poses[:, :, :9].reshape(N, 2, 3, 3), poses[:, :, 9], poses[:, :, 10:], *flags, table[:, 27])


class _Floats:
    """What floats and arrays do not write alike, for floats."""

    sqrt, complex_sqrt, minimum, every, any = math.sqrt, cmath.sqrt, min, bool, bool

    @staticmethod
    def where(condition: bool, yes: Any, no: Any) -> Any:
        return yes if condition else no

    @staticmethod
    def climb(problem: Problem, n: Vector, scale: Scale, known: Vector | None = None) -> View:
        return _climb(_Floats, problem, n, scale, _STEPS, known)

    @staticmethod
    def climbs(problem: Problem, starts: list[Vector], scale: Scale) -> list[View]:
        return [_Floats.climb(problem, n, scale) for n in starts]

    @staticmethod
    def retry(method: Callable, problem: Problem, found: Solution, scale: Scale, climbs: int) -> Solution:
        return method(_Floats, problem, found, scale)


class _Arrays:
    """The same for arrays; ``where`` works through trees of tuples."""

    sqrt, complex_sqrt, minimum, every, any = np.sqrt, np.sqrt, np.minimum, np.all, np.any

    @staticmethod
    def where(condition: np.ndarray, yes: Any, no: Any) -> Any:
        return _map(lambda y, n: np.where(condition, y, n), yes, no)

    @staticmethod
    def climb(problem: Problem, n: Vector, scale: Scale, known: Vector | None = None) -> View:
        """After the usual number of steps the rows that are late go on without the others."""
        view = _climb(_Arrays, problem, n, scale, _USUAL_STEPS, known)
        rest = (problem, view.n) if known is None else (problem, view.n, known)
        _redo(
            view, ~_arrived(problem, view, known), lambda xp, p, *n: _climb(xp, p, n[0], scale, _STEPS, *n[1:]), *rest
        )
        return view

    @staticmethod
    def climbs(problem: Problem, starts: list[Vector], scale: Scale) -> list[View]:
        N = len(problem.k)
        n = tuple(np.repeat(x, N) for x in np.array(starts).T)
        views = _Arrays.climb(_map(lambda x: np.tile(x, len(starts)), problem), n, scale)
        return [_take(views, slice(i * N, (i + 1) * N)) for i in range(len(starts))]

    @staticmethod
    def retry(method: Callable, problem: Problem, found: Solution, scale: Scale, climbs: int) -> Solution:
        """Another method, of so many climbs at once, where there is no proof."""
        few = _FEW // climbs
        _redo(found, ~found.certified, lambda xp, *rest: method(xp, *rest, scale), problem, found, few=few)
        return found


Kind = type[_Floats] | type[_Arrays]


def _map(function: Callable[..., Any], *trees: Any) -> Any:
    """Apply a function to the arrays of equal trees of tuples."""
    if not isinstance(trees[0], tuple):
        return function(*trees)
    parts = [_map(function, *values) for values in zip(*trees)]
    return type(trees[0])(*parts) if hasattr(trees[0], "_fields") else tuple(parts)


def _take(tree: Any, rows: Any) -> Any:
    return _map(lambda values: values[rows], tree)


def _redo(tree: Any, rows: np.ndarray, method: Callable, *inputs: Any, few: int = _FEW) -> None:
    """Overwrite some rows of a tree with what a method makes of those rows of its inputs.

    More than a few go as arrays, the others one by one on floats, where the method's fixed price as arrays is higher.
    """
    if np.count_nonzero(rows) > few:
        _map(lambda values, new: values.__setitem__(rows, new), tree, method(_Arrays, *_take(inputs, rows)))
        return
    for row in np.flatnonzero(rows):
        new = method(_Floats, *_map(lambda values: values[row].item(), inputs))
        _map(lambda values, value: values.__setitem__(row, value), tree, new)


# --- from moments to a problem, and from a solution to poses


class Problem(NamedTuple):
    """One problem, or N, in the principal axes of the shape.

    Attributes:
        a: eigenvalues of A = S w S^T over their sum, growing: along the first axis the shape is thinnest.
        d: complex, S w (x + i y) over |S| |W|, in those axes.
        c: cross product of d's real and imaginary parts: T(n) - T(-n) = 4 c.n.
        k: |S| / (|S| + |W|), the weight of E in the unit-scale goal.
    """

    a: Vector
    d: Vector
    c: Vector
    k: Number


class View(NamedTuple):
    """The goal at a direction n: g, its slope, its Hessian m and w, and what the pose is made of."""

    n: Vector
    u: Vector
    z: Number
    E: Number
    g: Number
    slope: Number
    m: Number
    w: Number


class Solution(NamedTuple):
    """The best direction and its rival; whether the first is proven best, and the second an optimum of its own."""

    best: View
    rival: View
    certified: Number
    two_fold: Number


_HARMLESS = Problem((0.2, 0.3, 0.5), (0.3 + 0j, 0.4j, 0.1 + 0.1j), (0.04, -0.03, 0.12), 0.5)


def _answer(
    xp: Kind,
    M: Sequence[Number],
    mean: Sequence[Number],
    a: Vector,
    V: Sequence[Number],
    scale: Scale,
    method: Callable,
) -> list[Number]:
    """Best and rival as ``_pose`` gives them, three flags, extent; from 25 moments, 5 means, and the shape's axes."""
    S_square, W_square = M[0] + M[6] + M[12], M[18] + M[24]
    over_S, over_W = 1 / (S_square + _TINY), 1 / (W_square + _TINY)
    over_both = xp.sqrt(over_S) * xp.sqrt(over_W)
    v1, v2 = (V[1], V[4], V[7]), (V[2], V[5], V[8])
    axes = (_cross(v1, v2), v1, v2)
    b = ((M[15] + 1j * M[20]) * over_both, (M[16] + 1j * M[21]) * over_both, (M[17] + 1j * M[22]) * over_both)
    d = (_dot(b, axes[0]), _dot(b, v1), _dot(b, v2))
    extent = xp.sqrt(W_square)
    zoom = extent * xp.sqrt(over_S)
    problem = Problem((a[0] * over_S, a[1] * over_S, a[2] * over_S), d, _cross_of_parts(d), 1 / (1 + zoom))
    # Where the second eigenvalue vanishes all points lie on one line, and turns about that line show nowhere.
    determined = (
        (problem.a[1] > _COLLINEAR)
        & (S_square > _ROUNDING**2 * _dot(mean, mean) + _LEAST)
        & (W_square > _ROUNDING**2 * (mean[3] * mean[3] + mean[4] * mean[4]) + _LEAST)
        & (_square(d[0]) + _square(d[1]) + _square(d[2]) > _ROUNDING**2)
    )
    if xp.every(determined):
        return [*_poses(xp, method(xp, problem, scale), axes, mean, zoom, scale), determined, extent]
    found = method(xp, xp.where(determined, problem, _HARMLESS), scale)
    answer = [*_poses(xp, found, axes, mean, zoom, scale), determined]
    nothing = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    nothing += [1.0, mean[3] - mean[0], mean[4] - mean[1]] if scale == "unit" else [0.0, mean[3], mean[4]]
    return [*(xp.where(determined, x, y) for x, y in zip(answer, 2 * nothing + 3 * [False])), extent]


def _poses(xp: Kind, found: Solution, *rest: Any) -> list[Number]:
    best = _pose(xp, found.best, *rest)
    rival = best if found.rival is found.best else _pose(xp, found.rival, *rest)
    return [*best, *rival, found.certified, found.two_fold]


def _pose(
    xp: Kind, view: View, axes: tuple[Vector, Vector, Vector], mean: Sequence[Number], zoom: Number, scale: Scale
) -> list[Number]:
    """Nine entries of R, row by row, the scale and the two of the translation."""
    length = abs(view.z)
    turn = xp.where(length > _TINY, view.z, 1.0) / xp.where(length > _TINY, length, 1.0)
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


# --- vectors


def _dot(x: Vector, y: Vector) -> Number:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def _cross(x: Vector, y: Vector) -> Vector:
    return (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])


def _square(z: Number) -> Number:
    return z.real * z.real + z.imag * z.imag


def _cross_of_parts(q: Vector) -> Vector:
    """Re q x Im q."""
    x, y, z = (part.conjugate() for part in q)
    return ((y * q[2]).imag, (z * q[0]).imag, (x * q[1]).imag)


def _unit(xp: Kind, v: Vector) -> Vector:
    """v over its length; the first axis where there is no length."""
    length = xp.sqrt(_dot(v, v))
    some = length > _TINY
    over = 1.0 / xp.where(some, length, 1.0)
    return (xp.where(some, v[0] * over, 1.0), v[1] * over, v[2] * over)


def _apart(x: Vector, y: Vector) -> Number:
    return _dot(x, y) < _COS_APART


def _frame(xp: Kind, n: Vector) -> Vector:
    """u = e1 + i e2 with e1, e2, n orthonormal and right-handed (Duff et al., JCGT 2017)."""
    x, y, z = n
    sign = xp.where(z < 0, -1.0, 1.0)
    over = -1.0 / (sign + z)
    a, b, c = x * over, y * over, sign * x
    d = a * y
    return (1.0 + c * a + 1j * d, sign * d + 1j * (sign + y * b), -1j * y - c)


# --- the goal on the sphere, and the way up


def _view(xp: Kind, problem: Problem, n: Vector, scale: Scale) -> View:
    """The goal and its derivatives at n; the one place that all time goes to, hence written out."""
    (a0, a1, a2), (d0, d1, d2), (n0, n1, n2) = problem.a, problem.d, n
    u = u0, u1, u2 = _frame(xp, n)
    z = u0.conjugate() * d0 + u1.conjugate() * d1 + u2.conjugate() * d2
    y = n0 * d0 + n1 * d1 + n2 * d2
    zc = z.conjugate()
    T = (z * zc).real + _TINY
    T_slope, T_m, T_w = -2 * zc * y, 2 * (y * y.conjugate()).real - T, -zc * (u0 * d0 + u1 * d1 + u2 * d2)
    # As n.n = 1 and n.u = u.u = 0, a may be less by a0 all over but for E itself.
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


def _facing(xp: Kind, problem: Problem, n: Vector) -> Vector:
    """n or -n, whichever has the larger T: the two see the same plane from its two sides."""
    sign = xp.where(_dot(problem.c, n) < 0, -1.0, 1.0)
    return (sign * n[0], sign * n[1], sign * n[2])


def _opposite(n: Vector) -> Vector:
    return (-n[0], -n[1], -n[2])


def _reversal(n: Vector) -> Vector:
    """The Necker reversal of n: reflected about the axis along which the shape is thinnest."""
    return (n[0], -n[1], -n[2])


def _stationary(view: View) -> Number:
    """Another step would gain nothing: its gain is about slope^2 over curvature, which is huge for needles end on."""
    return _square(view.slope) <= _GAIN * view.g * (view.g + abs(view.m))


def _arrived(problem: Problem, view: View, known: Vector | None) -> Number:
    """At a maximum on the side of the larger T, or at one that is known."""
    done = _stationary(view) & (_dot(problem.c, view.n) >= 0)
    return done if known is None else done | (_dot(view.n, known) >= _COS_APART)


def _is_optimum(view: View) -> Number:
    return _stationary(view) & (view.m < 0) & (view.m * view.m > _square(view.w))


def _stepped(xp: Kind, view: View, limit: Number) -> Vector:
    """The direction a Newton step away; the Hessian is shifted to be negative definite where it is not: uphill."""
    (n0, n1, n2), (u0, u1, u2), _, _, _, slope, m, w = view
    radius = abs(w)
    top = m + radius
    m = m - (top >= 0) * (top + 0.1 * abs(m - radius) + _TINY)
    step = (w * slope.conjugate() - m * slope) / (m * m - radius * radius + _TINY)
    length = abs(step)
    shrink = xp.minimum(1.0, limit / (length + _TINY))
    length, back = shrink * length, shrink * step.conjugate()
    over = 1 / xp.sqrt(1 + length * length)
    return ((n0 + (back * u0).real) * over, (n1 + (back * u1).real) * over, (n2 + (back * u2).real) * over)


def _climb(xp: Kind, problem: Problem, n: Vector, scale: Scale, steps: int, known: Vector | None = None) -> View:
    """The local maximum near n, or how far so many Newton steps came; less far where they come to a known maximum.

    Not n's facing side first: that would take some climbs off the hill of the second optimum. But a maximum where the
    other side has a larger T is none to stay on.
    """
    view, limit = _view(xp, problem, n, scale), _STEP_LIMIT
    for _ in range(steps):
        if xp.every(_arrived(problem, view, known)):
            break
        n, before = _stepped(xp, view, limit), view.g
        behind = _dot(problem.c, view.n) < 0
        if xp.any(behind):
            n = xp.where(behind & _stationary(view), _opposite(view.n), n)
        view = _view(xp, problem, n, scale)
        limit = limit * (1.0 - 0.7 * (view.g < before))  # or steps too long could go in circles
    return view


def _start(xp: Kind, problem: Problem) -> Vector:
    """Least squares along the two thick axes; along the thin one, the thinner the more, what makes a rotation of it.

    q = s (r1 + i r2) has q^T q = 0, which leaves two roots for q_0, Necker reversals of each other; least squares,
    d_0 / a_0, is all noise where a_0 is small, and tells no more than which.
    """
    (a0, a1, a2), (d0, d1, d2) = problem.a, problem.d
    q1, q2 = d1 / a1, d2 / a2
    root = xp.complex_sqrt(-(q1 * q1 + q2 * q2))
    weight = 1 - a0 / a1
    q0 = d0 / a1 + xp.where((root * d0.conjugate()).real < 0, -weight, weight) * root
    return _unit(xp, _cross_of_parts((q0, q1, q2)))


def _solve(xp: Kind, problem: Problem, scale: Scale) -> Solution:
    """The better of the optima near the start and near the reversal of the first; the other is its rival."""
    return _solve_from(xp, problem, xp.climb(problem, _start(xp, problem), scale), scale)


def _solve_from(xp: Kind, problem: Problem, one: View, scale: Scale) -> Solution:
    """The same with the first climb done."""
    two = xp.climb(problem, _reversal(one.n), scale, one.n)
    swap = (two.g > one.g) & _apart(two.n, one.n)
    if xp.any(swap):
        one, two = xp.where(swap, two, one), xp.where(swap, one, two)
    found = _with_rival(xp, problem, one, two, scale)
    return found if xp.every(found.certified) else xp.retry(_search, problem, found, scale, _SEARCH_CLIMBS)


def _solve_alone(xp: Kind, problem: Problem, scale: Scale) -> Solution:
    """The best without a rival: one climb, and all the rest only where that ends without a proof."""
    one = xp.climb(problem, _start(xp, problem), scale)
    found = Solution(one, one, _certified(xp, problem, one, scale), one.g < 0)
    return found if xp.every(found.certified) else xp.retry(_solve_again, problem, found, scale, 1)


def _solve_again(xp: Kind, problem: Problem, found: Solution, scale: Scale) -> Solution:
    whole = _solve_from(xp, problem, found.best, scale)
    return whole._replace(rival=whole.best)


def _with_rival(xp: Kind, problem: Problem, best: View, other: View, scale: Scale) -> Solution:
    """The rival is the other optimum; where there is none, the reversal of the best."""
    two_fold = _apart(best.n, other.n) & _is_optimum(other)
    rival = other
    if not xp.every(two_fold):
        reversal = _view(xp, problem, _facing(xp, problem, _reversal(best.n)), scale)
        rival = xp.where(two_fold, other, reversal)
    return Solution(best, rival, _certified(xp, problem, best, scale), two_fold)


def _certified(xp: Kind, problem: Problem, view: View, scale: Scale) -> Number:
    """The direction is proven to be the best of all, up to ``_SLACK`` of g.

    A quadratic n^T K n + 2 k.n that touches g there and is nowhere below it has no higher point on the sphere if
    lambda - K is positive semidefinite, lambda = n^T K n + k.n (More and Sorensen, 1983); that is, if no coefficient
    of its characteristic polynomial is negative.
    """
    of_A, of_T = 1.0, 1 / (view.g + _TINY)
    if scale == "unit":
        of_A, of_T = problem.k * of_T, (1 - problem.k) * of_T / (xp.sqrt(_square(view.z)) + _TINY)
    n, a, d = view.n, problem.a, problem.d
    K = [of_A * a[i] - of_T * _square(d[i]) for i in range(3)]
    K12, K02, K01 = (-of_T * (d[i] * d[j].conjugate()).real for i, j in ((1, 2), (0, 2), (0, 1)))
    mixed = K12 * n[1] * n[2] + K02 * n[0] * n[2] + K01 * n[0] * n[1]
    squares = (n[0] * n[0], n[1] * n[1], n[2] * n[2])
    multiplier = _dot(K, squares) + 2 * mixed + of_T * _dot(problem.c, n) + _SLACK
    x, y, z = multiplier - K[0], multiplier - K[1], multiplier - K[2]
    minors = y * z - K12 * K12 + x * z - K02 * K02 + x * y - K01 * K01
    determinant = x * y * z - x * K12 * K12 - y * K02 * K02 - z * K01 * K01 - 2 * K12 * K02 * K01
    return (xp.minimum(xp.minimum(x + y + z, minors), determinant) >= 0) & _stationary(view)


# --- where that leaves no proof


def _search(xp: Kind, problem: Problem, found: Solution, scale: Scale) -> Solution:
    """The best of climbs from all over the sphere as well, and the second best that is not the same."""
    best, rival = found.best, found.rival
    for new in xp.climbs(problem, _fibonacci_sphere(_SEARCH_CLIMBS), scale):
        higher, apart = new.g > best.g, _apart(new.n, best.n)
        second = apart & _is_optimum(new) & (new.g > rival.g)
        rival = xp.where(higher & apart, best, xp.where(second, new, rival))
        best = xp.where(higher, new, best)
    return _with_rival(xp, problem, best, rival, scale)


def _fibonacci_sphere(count: int) -> list[Vector]:
    """Nearly even directions."""
    heights = [1 - (2 * i + 1) / count for i in range(count)]
    turns = [math.pi * (1 + 5**0.5) * i for i in range(count)]
    return [(math.cos(t) * math.sqrt(1 - z * z), math.sin(t) * math.sqrt(1 - z * z), z) for t, z in zip(turns, heights)]
