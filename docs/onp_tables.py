# SPDX-License-Identifier: Apache-2.0
"""Print the tables that the explanation of OnP quotes, and define the problems and quantities of its pictures.

    python docs/onp_tables.py

Random numbers have fixed seeds: every run prints the same tables.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from paul_ros import OnP, onp
from paul_ros import viewing_goal as vg
from paul_ros import viewing_sphere as vs
from paul_ros.arithmetic import Arrays, map_tree
from paul_ros.viewing_goal import Scale

SCALES: tuple[Scale, ...] = ("free", "unit")
POINTS, NOISES, THICKNESSES = (3, 4, 6, 17, 100), (0.0, 0.1, 0.3, 1.0), (1.0, 0.3, 0.05)
_STARTS = 60
_MOST_OPTIMA = 8
_ROUNDING = 1e-6  # share of the image's size; smaller residuals are rounding errors, and their ratios mean nothing


def random_problems(
    count: int, points: int, noise: float, thickness: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw Gaussian shapes of width 1, and views of them with Gaussian noise.

    Args:
        count: number of problems N.
        points: number of points P.
        noise: standard deviation of the views' noise.
        thickness: depth of the shapes over their width.
        seed: of the random numbers.

    Returns:
        Shapes (N,3,P), views (N,2,P), true rotations (N,3,3).
    """
    rng = np.random.default_rng(seed)
    S = rng.standard_normal((count, 3, points)) * np.array([1.0, 1.0, thickness])[:, None]
    Q, U = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    Q = Q * np.sign(np.diagonal(U, axis1=1, axis2=2))[:, None]
    R = Q * np.linalg.det(Q)[:, None, None]
    return S, R[:, :2] @ S + noise * rng.standard_normal((count, 2, points)), R


def reduced(S: np.ndarray, W: np.ndarray) -> tuple[vg.Problem, np.ndarray]:
    """Return the normalised problems in the principal axes of their shapes, and these axes (N,3,3) as columns."""
    S, W = S - S.mean(2, keepdims=True), W - W.mean(2, keepdims=True)
    size_S, size_W = np.linalg.norm(S, axis=(1, 2)), np.linalg.norm(W, axis=(1, 2))
    a, V = np.linalg.eigh(S @ S.transpose(0, 2, 1))
    V = V * np.linalg.det(V)[:, None, None]
    d = ((W[:, 0] + 1j * W[:, 1])[:, None] @ S.transpose(0, 2, 1) @ V)[:, 0] / (size_S * size_W)[:, None]
    c = np.cross(d.real, d.imag)
    return vg.Problem(tuple((a / size_S[:, None] ** 2).T), tuple(d.T), tuple(c.T), size_S / (size_S + size_W)), V


def energies(problem: vg.Problem, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return E and T of one problem for the directions n (...,3)."""
    a, d, c = (np.array(part) for part in problem[:3])
    return (n * n) @ a, (abs(d) ** 2).sum() - abs(n @ d) ** 2 + 2 * n @ c


def goal(problem: vg.Problem, E: np.ndarray, T: np.ndarray, scale: Scale) -> np.ndarray:
    """Return the goal g that the optimum maximises, from E and T."""
    if scale == "free":
        return T / (1 - E)
    return problem.k * E + 2 * (1 - problem.k) * np.sqrt(np.maximum(T, 0))


def relative_residual(k: np.ndarray | float, g: np.ndarray, scale: Scale) -> np.ndarray:
    """Return the residual over the size of the image, from the goal."""
    square = 1 - g if scale == "free" else (k / (1 - k)) ** 2 + 1 - k / (1 - k) ** 2 * g
    return np.sqrt(np.maximum(square, 0))


def single(problem: vg.Problem) -> vg.Problem:
    """Return the first of N problems, as floats."""
    return map_tree(lambda values: values[0].item(), problem)


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def percent(share: float) -> str:
    """Format a share in per cent."""
    return f"{100 * share:.1f}"


def _cells(
    count: int,
    points: tuple[int, ...],
    noises: tuple[float, ...] = NOISES,
    thicknesses: tuple[float, ...] = THICKNESSES,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield shapes and views of every combination of points, noise and thickness."""
    for P in points:
        for noise in noises:
            for thickness in thicknesses:
                yield random_problems(count, P, noise, thickness, seed=P)[:2]


def lagrangian_holds(S: np.ndarray, W: np.ndarray, found: OnP, scale: Scale) -> np.ndarray:
    """Return whether the Lagrangian is convex at the answers, (N,) bool.

    Its multipliers hold the constraint q^T q = 0 and, for unit scale, |q|^2 = 2.
    """
    S, W = S - S.mean(2, keepdims=True), W - W.mean(2, keepdims=True)
    A = S @ S.transpose(0, 2, 1)
    d = ((W[:, 0] + 1j * W[:, 1])[:, None] @ S.transpose(0, 2, 1))[:, 0]
    q = found.scale[:, None] * (found.R[:, 0] + 1j * found.R[:, 1])
    rest, square = d - (A @ q[..., None])[..., 0], (abs(q) ** 2).sum(1)
    mu = abs((q * rest).sum(1)) / square
    multiplier = (q.conj() * rest).sum(1).real / square if scale == "unit" else 0.0
    a = np.linalg.eigvalsh(A)
    return mu <= a[:, 0] + multiplier + 1e-8 * a[:, 2]


def certificate_table(count: int = 1000) -> list[str]:
    """Tabulate the share of certified answers, beside the share for which the Lagrangian is convex."""
    rows = []
    for P in POINTS:
        shares = {}
        for scale in SCALES:
            cells = [(S, W, onp(S, W, scale=scale)) for S, W in _cells(count, (P,))]
            shares[scale, "ours"] = np.mean([found.certified.mean() for *_, found in cells])
            shares[scale, "Lagrangian"] = np.mean(
                [lagrangian_holds(S, W, found, scale).mean() for S, W, found in cells]
            )
        rows.append([str(P)] + [f"{100 * shares[scale, of]:.2f}" for scale in SCALES for of in ("ours", "Lagrangian")])
    return table(["points", "free scale: trust region", "Lagrangian", "unit scale: trust region", "Lagrangian"], rows)


def failures_table(count: int = 3000) -> list[str]:
    """Tabulate the share of unit-scale answers without a certificate, by noise (rows) and thickness."""
    rows = []
    for noise in NOISES:
        shares = [
            np.mean(
                [(~onp(S, W, scale="unit").certified).mean() for S, W in _cells(count, (4, 6, 17), (noise,), (thick,))]
            )
            for thick in THICKNESSES
        ]
        rows.append([f"{noise:g}", *(f"{100 * share:.2f}" for share in shares)])
    return table(["noise", *(f"thickness {thickness:g}" for thickness in THICKNESSES)], rows)


def uncertified_table(count: int = 20000) -> list[str]:
    """Tabulate unit-scale answers without a certificate, for noise 0.3 and thickness 0.3.

    The columns say whether more climbs find better answers, and how loose the bound is.
    """
    rows = []
    for points in (4, 6, 17):
        S, W, _ = random_problems(count, points, 0.3, 0.3, seed=2)
        left = ~onp(S, W, scale="unit").certified
        S, W = S[left], W[left]
        problem = reduced(S, W)[0]
        found = onp(S, W, scale="unit").residual / np.sqrt(W.var(2).sum(1))
        best = relative_residual(problem.k, optima(problem, "unit")[:, 0], "unit")
        loose = [100 * bound_looseness(S[i : i + 1], W[i : i + 1]) for i in range(len(S))]
        row = [points, count, len(S), (best < found - _ROUNDING).sum(), f"{np.median(loose):.2f}", f"{max(loose):.2f}"]
        rows.append([str(cell) for cell in row])
    head = ["points", "problems", "not certified", "a better one exists", "bound too high by, median %", "most, %"]
    return table(head, rows)


def optima(problem: vg.Problem, scale: Scale) -> np.ndarray:
    """Return the goal at all local optima (N, ``_MOST_OPTIMA``), best first, padded with -1.

    Optima are those that climbs from points all over the sphere find.
    """
    N = len(problem.k)
    known, goals, count = np.zeros((N, _MOST_OPTIMA, 3)), np.full((N, _MOST_OPTIMA), -1.0), np.zeros(N, int)
    for view in vg.climb_from_each(Arrays, problem, vs.fibonacci_sphere(_STARTS), scale):
        n = np.stack(view.n, axis=1)
        new = vg.is_optimum(view) & ((known @ n[..., None])[..., 0].max(1) < vg.COS_APART) & (count < _MOST_OPTIMA)
        row = np.flatnonzero(new)
        known[row, count[row]], goals[row, count[row]] = n[row], view.g[row]
        count += new
    return -np.sort(-goals, axis=1)


def optima_table(count: int = 300) -> list[str]:
    """Tabulate the number of optima, and the share of second optima that ``onp`` misses, for 4 points and more."""
    rows = []
    for scale in SCALES:
        for thickness in THICKNESSES:
            number, missed, rivals, missed_close, close = np.zeros(_MOST_OPTIMA + 1, int), 0, 0, 0, 0
            for S, W in _cells(count, POINTS[1:], thicknesses=(thickness,)):
                problem, found = reduced(S, W)[0], onp(S, W, scale=scale)
                g = optima(problem, scale)
                number += np.bincount((g >= 0).sum(1), minlength=_MOST_OPTIMA + 1)
                first, second = (relative_residual(problem.k, g[:, i], scale) for i in (0, 1))
                rival, miss = g[:, 1] >= 0, (g[:, 1] >= 0) & ~found.two_fold
                near = rival & (first > 0.9 * second) & (second > _ROUNDING)
                rivals, missed = rivals + rival.sum(), missed + miss.sum()
                close, missed_close = close + near.sum(), missed_close + (near & miss).sum()
            shares = number / number.sum()
            cells = [
                percent(shares[1]),
                percent(shares[2]),
                f"{100 * shares[3:].sum():.2f}",
                str(number.nonzero()[0][-1]),
            ]
            rows.append([scale, f"{thickness:g}", *cells, percent(missed / rivals), percent(missed_close / close)])
    head = [
        "scale",
        "thickness",
        "one optimum, %",
        "two, %",
        "more, %",
        "most",
        "second missed, %",
        "missed of the close, %",
    ]
    return table(head, rows)


def least_squares_svd(S: np.ndarray, W: np.ndarray) -> np.ndarray:
    """Return the usual approximation (N,3,3): the affine camera, its rows made orthonormal, their cross product."""
    S, W = S - S.mean(2, keepdims=True), W - W.mean(2, keepdims=True)
    affine = W @ S.transpose(0, 2, 1) @ np.linalg.inv(S @ S.transpose(0, 2, 1))
    U, _, V = np.linalg.svd(affine, full_matrices=False)
    rows = U @ V
    return np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], axis=1)


def approximation_table(count: int = 4000) -> list[str]:
    """Tabulate angles in degrees and ratios of residuals between approximation and unit-scale optimum, noise 0.3."""
    rows = []
    for points, thickness in ((100, 1.0), (17, 1.0), (6, 1.0), (17, 0.3), (17, 0.05)):
        S, W, _ = random_problems(count, points, 0.3, thickness, seed=points)
        found, R = onp(S, W, scale="unit"), least_squares_svd(S, W)
        cosine = ((R * found.R).sum((1, 2)) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        error = R[:, :2] @ (S - S.mean(2, keepdims=True)) - (W - W.mean(2, keepdims=True))
        ratio = np.sqrt((error**2).sum(1).mean(1)) / found.residual
        row = [f"{np.median(angle):.1f}", f"{np.percentile(angle, 95):.0f}", f"{np.median(ratio):.3f}"]
        rows.append([str(points), f"{thickness:g}", *row])
    return table(["points", "thickness", "median angle, °", "95 %, °", "residual over the optimum's, median"], rows)


def bound(problem: vg.Problem, E: np.ndarray, T: np.ndarray, tau: float) -> np.ndarray:
    """Return the quadratic that touches the unit-scale goal where sqrt(T) is tau, and is nowhere below it."""
    return problem.k * E + (1 - problem.k) * (T / tau + tau)


def bound_looseness(S: np.ndarray, W: np.ndarray) -> float:
    """Return how far the bound rises above the best goal, over that goal."""
    problem, best = with_best(S, W, "unit")
    E, T = energies(problem, np.array(vs.fibonacci_sphere(5000)))
    tau = np.sqrt(energies(problem, best)[1])
    return float(bound(problem, E, T, tau).max() / goal(problem, *energies(problem, best), "unit") - 1)


def with_best(S: np.ndarray, W: np.ndarray, scale: Scale) -> tuple[vg.Problem, np.ndarray]:
    """Return one problem and its best direction (3,), in the principal axes of the shape."""
    problems, V = reduced(S, W)
    return single(problems), onp(S, W, scale=scale).R[0, 2] @ V[0]


def tables() -> dict[str, list[str]]:
    """Return all tables by their titles."""
    return {
        "Certified, %": certificate_table(),
        "Unit scale, 4 to 17 points: not certified, %": failures_table(),
        "Those not certified": uncertified_table(),
        "Local optima": optima_table(),
        "Least squares + SVD": approximation_table(),
    }


def main() -> None:
    """Print all tables."""
    for title, lines in tables().items():
        print(title, "", *lines, "", sep="\n")


if __name__ == "__main__":
    main()
