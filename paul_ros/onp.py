# SPDX-License-Identifier: Apache-2.0
"""Orthographic-N-point: the rotation (and scale) that best project a known shape onto its 2D points.

Minimise ``sum_j w_j |s R_xy S_j + t - W_j|^2`` over rotations R, translation t and, in the free-scale problem, s > 0.
Once both sets are centred on their weighted means, only the viewing direction ``n`` (third row of R) is left as an
unknown: translation, in-plane rotation and scale have closed forms given ``n``.  With

    A = S w S^T (3x3),  B = W w S^T (2x3) with rows b1, b2,  c = b1 x b2,  D = B^T B,
    T(n) = |B|^2 - n^T D n + 2 c.n            (the squared correlation reachable from direction n)

the cost is a constant minus

    unit scale:  g(n) = n^T A n + 2 sqrt(T(n))
    free scale:  g(n) = T(n) / (tr A - n^T A n)

so both problems are the maximisation of a smooth function on the sphere.  It is climbed by Newton steps from the
algebraic solution; the free-scale problem has a shorter way, taken first (``_lagrange_optimum``).  A quadratic in n
that touches g at the optimum and bounds it from above makes a certificate: a quadratic on the sphere has no other
maximum when its Hessian, shifted by the multiplier, is negative semidefinite (the trust-region theorem of More and
Sorensen, 1983).  In the free-scale problem the condition is also necessary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

MIN_POINTS = 3
"""Fewer weighted points than this leave the pose undetermined."""

_NEWTON_STEPS = 30
_LAGRANGE_STEPS = 12
_STEP_LIMIT = 0.5  # radians: keeps Newton inside the basin it started in
_SEARCH_DIRECTIONS = 256


@dataclass(frozen=True)
class OnP:
    """Optimal poses of N shapes, with the mirrored pose that competes with each.

    Attributes:
        R: (N,3,3) rotations, canonical frame to camera frame, det +1.
        scale: (N,) image units per shape unit (1 in the unit-scale problem).
        translation: (N,2) image units: ``W ~ scale * R[:, :2] @ S + translation``.
        residual: (N,) weighted root mean square distance to W, image units.
        certified: (N,) bool, the pose is proven globally optimal.
        determined: (N,) bool, False where the points fix no pose: too few, all on one line, or one of them not finite;
            R is then the identity.
        R_mirror, scale_mirror, residual_mirror: the rival pose, the Necker reversal of the optimum (reflected about the
            axis along which the shape is thinnest, best scale), and its residual.
    """

    R: np.ndarray
    scale: np.ndarray
    translation: np.ndarray
    residual: np.ndarray
    certified: np.ndarray
    determined: np.ndarray
    R_mirror: np.ndarray
    scale_mirror: np.ndarray
    residual_mirror: np.ndarray

    @property
    def ambiguity(self) -> np.ndarray:
        """(N,) in 0..1: residual over the mirrored pose's; 1 means that the image cannot tell the two apart.

        A lower bound where the reversal is not itself the best pose of its side, which matters for few points only.
        """
        tiny = np.finfo(float).tiny
        return np.where(self.residual_mirror > tiny, self.residual / np.maximum(self.residual_mirror, tiny), 1.0)


def onp(
    S: np.ndarray,
    W: np.ndarray,
    weights: np.ndarray | None = None,
    scale: Literal["free", "unit"] = "free",
) -> OnP:
    """Solve N orthographic-N-point problems.

    Args:
        S: (N,3,P) shapes in their canonical frame.
        W: (N,2,P) image points, any unit.
        weights: (N,P) non-negative; bool visibility works. Points of weight 0 are ignored, NaN or not.
        scale: ``"free"`` solves for the scale of weak perspective, ``"unit"`` fixes it to 1.

    Returns:
        The optimum of every problem; degenerate input is flagged in ``determined``, never NaN.

    Raises:
        ValueError: the shapes of the arrays do not fit together.
    """
    problem = _Problem.of(S, W, weights)
    goal = _GOALS[scale]
    n, certified = np.tile([0.0, 0.0, 1.0], (len(problem.A), 1)), np.zeros(len(problem.A), bool)
    if scale == "free":
        n, certified = _lagrange_optimum(problem)
    rest = problem.determined & ~certified
    if rest.any():
        n[rest], certified[rest] = _climbed_optimum(goal, problem.select(rest))
    mirror = _necker(problem, n)
    R, s, residual = (np.split(part, 2) for part in _pose(problem.twice(), np.concatenate([n, mirror]), scale))
    return OnP(
        R=R[0],
        scale=s[0],
        translation=problem.W_mean - s[0][:, None] * _times(R[0][:, :2], problem.S_mean),
        residual=residual[0],
        certified=certified & problem.determined,
        determined=problem.determined,
        R_mirror=R[1],
        scale_mirror=s[1],
        residual_mirror=np.maximum(residual[1], residual[0]),
    )


@dataclass
class _Problem:
    """N centred problems in units of the shape's own size, reduced to A, B and what follows from them."""

    S: np.ndarray
    W: np.ndarray
    w: np.ndarray
    S_mean: np.ndarray
    W_mean: np.ndarray
    size: np.ndarray
    A: np.ndarray
    b: np.ndarray  # (N,2,3) rows of B
    c: np.ndarray
    D: np.ndarray
    trace_A: np.ndarray
    trace_D: np.ndarray
    a: np.ndarray  # (N,3) eigenvalues of A, growing
    V: np.ndarray  # (N,3,3) eigenvectors of A, columns; the first is the axis along which the shape is thinnest
    d: np.ndarray  # (N,3) b1 + i b2 in that basis
    determined: np.ndarray

    @classmethod
    def of(cls, S: np.ndarray, W: np.ndarray, weights: np.ndarray | None) -> _Problem:
        S, W = np.asarray(S, float), np.asarray(W, float)
        if S.ndim != 3 or S.shape[1] != 3 or W.shape != (S.shape[0], 2, S.shape[2]):
            raise ValueError(f"onp needs S (N,3,P) and W (N,2,P), got {S.shape} and {W.shape}")
        w = np.ones((S.shape[0], S.shape[2])) if weights is None else np.asarray(weights, float)
        if w.shape != (S.shape[0], S.shape[2]):
            raise ValueError(f"onp needs weights (N,P) = {(S.shape[0], S.shape[2])}, got {w.shape}")
        used = w > 0
        finite = (np.isfinite(S).all(1) & np.isfinite(W).all(1) & np.isfinite(w) | ~used).all(1)
        used = used & finite[:, None]
        w = np.where(used, w, 0.0)
        S, W = np.where(used[:, None], S, 0.0), np.where(used[:, None], W, 0.0)
        w = w / np.maximum(w.sum(1, keepdims=True), np.finfo(float).tiny)
        S_mean, W_mean = np.einsum("nip,np->ni", S, w), np.einsum("nip,np->ni", W, w)
        largest = np.abs(W).max((1, 2), initial=0.0)
        S, W = (S - S_mean[..., None]) * used[:, None], (W - W_mean[..., None]) * used[:, None]
        size = np.sqrt(np.einsum("nip,nip,np->n", S, S, w))
        size = np.where(size > 0, size, 1.0)
        S, W = S / size[:, None, None], W / size[:, None, None]
        Sw = S * w[:, None]
        A, B = Sw @ S.transpose(0, 2, 1), W @ Sw.transpose(0, 2, 1)
        # The second eigenvalue of A vanishes when all points lie on one line: rotation about that line is then free.
        # And an image whose points differ by rounding alone says nothing.
        spread, axes = np.linalg.eigh(A)
        seen = np.abs(W).max((1, 2), initial=0.0) * size > 1e-12 * largest
        determined = (used.sum(1) >= MIN_POINTS) & (spread[:, 1] > 1e-10) & seen
        D = B.transpose(0, 2, 1) @ B
        return cls(
            S,
            W,
            w,
            S_mean,
            W_mean,
            size,
            A,
            B,
            _cross(B[:, 0], B[:, 1]),
            D,
            np.trace(A, axis1=1, axis2=2),
            np.trace(D, axis1=1, axis2=2),
            spread,
            axes,
            _times(axes.transpose(0, 2, 1), B[:, 0] + 1j * B[:, 1]),
            determined,
        )

    def select(self, rows: np.ndarray) -> _Problem:
        return _Problem(**{name: value[rows] for name, value in vars(self).items()})

    def twice(self) -> _Problem:
        """Every problem two times, for a climb from two starts."""
        return _Problem(**{name: np.concatenate([value, value]) for name, value in vars(self).items()})


Goal = Callable[["_Problem", np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(-1)


def _times(M: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Matrices (N,3,3) times vectors (N,3)."""
    return (M @ v[..., None])[..., 0]


def _outer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, :, None] * b[:, None, :]


def _correlation(p: _Problem, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T(n) (N,) and its gradient (N,3); the Hessian is -2 D."""
    Dn = _times(p.D, n)
    T = p.trace_D + _dot(n, 2 * p.c - Dn)
    return np.maximum(T, 1e-60), 2 * (p.c - Dn)


def _unit_goal(p: _Problem, n: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """g, gradient and Hessian of the unit-scale goal."""
    T, dT = _correlation(p, n)
    An, root = _times(p.A, n), np.sqrt(T)
    hessian = 2 * p.A - 2 * p.D / root[:, None, None] - _outer(dT, dT) / (2 * root * T)[:, None, None]
    return _dot(n, An) + 2 * root, 2 * An + dT / root[:, None], hessian


def _free_goal(p: _Problem, n: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """g, gradient and Hessian of the free-scale goal."""
    T, dT = _correlation(p, n)
    An = _times(p.A, n)
    across = np.maximum(p.trace_A - _dot(n, An), 1e-300)[:, None]
    g = T / across[:, 0]
    dg = (dT + 2 * g[:, None] * An) / across
    cross = _outer(dg, An)
    hessian = 2 * (g[:, None, None] * p.A - p.D + cross + cross.transpose(0, 2, 1)) / across[..., None]
    return g, dg, hessian


_GOALS: dict[str, Goal] = {"unit": _unit_goal, "free": _free_goal}


def _algebraic_direction(p: _Problem) -> np.ndarray:
    """Viewing direction (N,3) of the least-squares affine camera B A^-1, the paper's own start."""
    ridge = 1e-9 * np.eye(3)
    rows = np.linalg.solve(p.A + ridge, p.b.transpose(0, 2, 1)).transpose(0, 2, 1)
    n = _cross(rows[:, 0], rows[:, 1])
    length = np.linalg.norm(n, axis=1, keepdims=True)
    return np.where(length > 1e-12, n / np.maximum(length, 1e-12), np.array([0.0, 0.0, 1.0]))


def _facing(p: _Problem, n: np.ndarray) -> np.ndarray:
    """n or -n, whichever gives the larger T: the two see the same plane from its two sides."""
    return np.where(_dot(n, p.c)[:, None] < 0, -n, n)


def _necker(p: _Problem, n: np.ndarray) -> np.ndarray:
    """The Necker reversal of n: reflected about the axis along which the shape is thinnest."""
    return _facing(p, 2 * _dot(p.V[:, :, 0], n)[:, None] * p.V[:, :, 0] - n)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b (N,3); numpy's own takes ten times as long on single vectors."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _tangent(n: np.ndarray) -> np.ndarray:
    """(N,3,2) orthonormal basis (e1, e2) of the plane across n, e1 x e2 = n (Duff et al., JCGT 2017)."""
    x, y, z = n.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.stack([1 + sign * x * x * a, b, sign * b, sign + y * y * a, -sign * x, -y], axis=1).reshape(-1, 3, 2)


def _climbed_optimum(goal: Goal, p: _Problem) -> tuple[np.ndarray, np.ndarray]:
    """The best maximum found, and whether it is certified: from least squares, its Necker reversal, else by search."""
    n = _two_climbs(goal, p, _algebraic_direction(p))
    certified = _certify(goal, p, n)
    doubtful = p.determined & ~certified
    if doubtful.any():
        hard = p.select(doubtful)
        n[doubtful] = _two_climbs(goal, hard, _search(goal, hard, n[doubtful]))
        certified[doubtful] = _certify(goal, hard, n[doubtful])
    return n, certified


def _two_climbs(goal: Goal, p: _Problem, start: np.ndarray) -> np.ndarray:
    """The better of the maxima reached from a start and from its Necker reversal, in one climb."""
    both = p.twice()
    ends = _ascend(goal, both, np.concatenate([start, _necker(p, start)]))
    return _better_first(goal, p, *np.split(ends, 2))[0]


# --- the free-scale problem as three complex unknowns


def _lagrange_optimum(p: _Problem) -> tuple[np.ndarray, np.ndarray]:
    """Optimum of the free-scale problem (N,3) and whether it is certified.

    With q = s (r1 + i r2) the problem is: minimise q^H A q - 2 Re q^H d, d = b1 + i b2, under q^T q = 0.  In A's
    eigenbasis a stationary point has q_k = (a_k d_k - mu conj(d_k)) / (a_k^2 - |mu|^2) with one complex multiplier mu,
    found by Newton on q^T q = 0 from 0, which is least squares.  Where |mu| is at most the least a_k the Lagrangian is
    convex: a global optimum.
    """
    q, mu, converged = _lagrange(p)
    n = _cross(q.real, q.imag)
    length = np.sqrt(_dot(n, n))
    certified = converged & (np.abs(mu) <= p.a[:, 0]) & p.determined & (length > 0)
    ahead = np.array([0.0, 0.0, 1.0])
    return np.where(certified[:, None], n / np.where(certified, length, 1.0)[:, None], ahead), certified


def _lagrange(p: _Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Newton on q^T q = 0: q (N,3) in the shape's frame, the multiplier (N,), and whether it converged."""
    mu = np.zeros(len(p.a), complex)
    a, d = p.a, p.d
    conj_d, ad, aa = d.conj(), a * d, a * a
    with np.errstate(all="ignore"):
        for _ in range(_LAGRANGE_STEPS):
            m = mu[:, None]
            gap = aa - (m * m.conj()).real
            q = (ad - m * conj_d) / gap
            qq = q * q
            residue = qq.sum(1)
            converged = np.abs(residue) <= 1e-12 * (q.real**2 + q.imag**2).sum(1)
            if converged.all():
                break
            slope = 2 * (q * (q * m.conj() - conj_d) / gap).sum(1)
            twist = 2 * mu * (qq / gap).sum(1)
            step = (residue.conj() * twist - residue * slope.conj()) / (np.abs(slope) ** 2 - np.abs(twist) ** 2)
            mu = np.where(converged, mu, mu + step)
        q = np.where(converged[:, None], q, 0.0)  # infinite where an axis has no thickness
    return (p.V @ q[..., None])[..., 0], mu, converged


def _ascend(goal: Goal, p: _Problem, n: np.ndarray) -> np.ndarray:
    """Climb to the local maximum near n by Riemannian Newton steps that always point uphill."""
    n = _facing(p, n)
    now = goal(p, n)
    for _ in range(_NEWTON_STEPS):
        step = _newton_step(n, now[1], now[2])
        n, now, moved = _backtrack(goal, p, n, step, now)
        # Newton's error squares at every step: after one of 1e-7 nothing is left to gain.
        if not np.any(moved & (np.abs(step).max(1) > 1e-7)):
            break
    return n


def _newton_step(n: np.ndarray, dg: np.ndarray, hessian: np.ndarray) -> np.ndarray:
    """Tangent step (N,3); the Hessian is shifted to be negative definite where it is not, so that the step climbs."""
    E = _tangent(n)
    Et = E.transpose(0, 2, 1)
    slope = _times(Et, dg)
    bend = Et @ hessian @ E
    pull = _dot(n, dg)
    a, b, d = bend[:, 0, 0] - pull, bend[:, 0, 1], bend[:, 1, 1] - pull
    middle, radius = (a + d) / 2, np.hypot((a - d) / 2, b)
    shift = np.maximum(0.0, middle + radius + 0.1 * np.abs(middle - radius) + 1e-12)
    shift = np.where(middle + radius < 0, 0.0, shift)
    a, d = a - shift, d - shift
    determinant = np.maximum(a * d - b * b, 1e-300)
    along = np.stack([b * slope[:, 1] - d * slope[:, 0], b * slope[:, 0] - a * slope[:, 1]], axis=1)
    step = _times(E, along / determinant[:, None])
    return step * np.minimum(1.0, _STEP_LIMIT / np.maximum(np.abs(step).max(1), 1e-300))[:, None]


def _backtrack(goal: Goal, p: _Problem, n: np.ndarray, step: np.ndarray, now: tuple) -> tuple:
    """Take the largest of step, step/4, step/16 ... that does not lower the goal; stay where none does."""
    moved = np.zeros(len(n), bool)
    for shrink in (1.0, 0.25, 0.0625, 0.0156):
        trial = n + shrink * step
        trial = _facing(p, trial / np.sqrt(_dot(trial, trial))[:, None])
        values = goal(p, trial)
        take = ~moved & (values[0] >= now[0])
        if take.all():
            return trial, values, take
        n = np.where(take[:, None], trial, n)
        now = tuple(np.where(take.reshape(-1, *[1] * (new.ndim - 1)), new, old) for new, old in zip(values, now))
        moved |= take
        if moved.all():
            break
    return n, now, moved


def _better_first(goal: Goal, p: _Problem, n: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    swap = (goal(p, other)[0] > goal(p, n)[0])[:, None]
    return np.where(swap, other, n), np.where(swap, n, other)


def _certify(goal: Goal, p: _Problem, n: np.ndarray) -> np.ndarray:
    """(N,) bool: n is proven to be the global maximum (see the module; K and multiplier of a trust region)."""
    T, _ = _correlation(p, n)
    if goal is _unit_goal:  # sqrt(T) <= (T/tau + tau)/2 with equality at n
        tau = np.sqrt(T)[:, None]
        K, k = p.A - p.D / tau[..., None], p.c / tau
    else:  # T <= g* (tr A - n^T A n) everywhere if and only if g* is the maximum (Dinkelbach 1967)
        K, k = goal(p, n)[0][:, None, None] * p.A - p.D, p.c
    pull = _times(K, n) + k
    multiplier = _dot(n, pull)
    size = np.abs(K).max((1, 2)) + np.abs(k).max(1)
    stationary = np.abs(pull - multiplier[:, None] * n).max(1) <= 1e-6 * size
    return stationary & (np.linalg.eigvalsh(K)[:, -1] <= multiplier + 1e-9 * size)


def _search(goal: Goal, p: _Problem, n: np.ndarray) -> np.ndarray:
    """Best of n and a climb from the best directions of a grid over the sphere."""
    grid = _fibonacci_sphere(_SEARCH_DIRECTIONS)
    heights = np.stack([goal(p, np.broadcast_to(d, n.shape))[0] for d in grid], axis=1)
    for rank in range(1, 4):
        start = grid[np.argsort(heights, axis=1)[:, -rank]]
        n, _ = _better_first(goal, p, n, _ascend(goal, p, start))
    return n


def _fibonacci_sphere(count: int) -> np.ndarray:
    """(count,3) nearly even directions."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def _pose(p: _Problem, n: np.ndarray, scale: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation, scale and residual of the best pose that looks along n, in the caller's units."""
    E = _tangent(n)
    u = E[..., 0] + 1j * E[..., 1]
    correlation = np.einsum("ni,ni->n", u.conj(), p.b[:, 0] + 1j * p.b[:, 1])
    size = np.abs(correlation)
    phase = np.where(size > 0, correlation / np.where(size > 0, size, 1.0), 1.0)
    q = phase[:, None] * u
    R = np.stack([q.real, q.imag, n], axis=1)
    R[~p.determined] = np.eye(3)
    across = np.einsum("nij,nij->n", R[:, :2] @ p.A, R[:, :2])
    s = np.ones(len(n)) if scale == "unit" else np.where(across > 0, size / np.where(across > 0, across, 1.0), 0.0)
    error = s[:, None, None] * (R[:, :2] @ p.S) - p.W
    residual = np.sqrt(np.einsum("nip,nip,np->n", error, error, p.w)) * p.size
    return R, s, residual
