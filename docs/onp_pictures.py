# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of ``docs/onp.md`` next to this file, and print the tables that it quotes.

    python docs/onp_pictures.py

Needs matplotlib.  Everything is random with fixed seeds; the same run gives the same pictures and tables.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from paul_ros import OnP, onp
from paul_ros import viewing_goal as vg
from paul_ros import viewing_sphere as vs
from paul_ros.arithmetic import Arrays, Floats, Vector, map_tree

HERE = Path(__file__).resolve().parent
SCALES = ("free", "unit")
POINTS, NOISES, THICKNESSES = (3, 4, 6, 17, 100), (0.0, 0.1, 0.3, 1.0), (1.0, 0.3, 0.05)
_STARTS = 60
_LEVELS = np.arange(0.25, 1.05, 0.05)
_MOST_OPTIMA = 8
_NOTHING = 1e-6  # of the image's size: residuals below are rounding, and their ratios mean nothing

_MAPS = (
    ("deep shape", 8, 0.5, 1.0, 233),
    ("flat shape, a third as deep as wide", 10, 0.45, 0.35, 336),
    ("planar shape", 10, 0.4, 0.0, 12),
)
"""Title, points, noise, thickness and seed of the problems drawn: much noise, or all marks would fall together."""

_BLUE, _ORANGE, _GREEN, _PINK, _GREY = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#c8c8c8"  # Okabe and Ito


# --- random problems, and the quantities of the page


def random_problems(
    count: int, points: int, noise: float, thickness: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal shapes (N,3,P) of width 1, their views (N,2,P) with normal noise, and the true rotations (N,3,3)."""
    rng = np.random.default_rng(seed)
    S = rng.standard_normal((count, 3, points)) * np.array([1.0, 1.0, thickness])[:, None]
    Q, U = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    Q = Q * np.sign(np.diagonal(U, axis1=1, axis2=2))[:, None]
    R = Q * np.linalg.det(Q)[:, None, None]
    return S, R[:, :2] @ S + noise * rng.standard_normal((count, 2, points)), R


def reduced(S: np.ndarray, W: np.ndarray) -> tuple[vg.Problem, np.ndarray]:
    """The problems in the principal axes of their shapes, normalised, and those axes (N,3,3) as columns."""
    S, W = S - S.mean(2, keepdims=True), W - W.mean(2, keepdims=True)
    size_S, size_W = np.linalg.norm(S, axis=(1, 2)), np.linalg.norm(W, axis=(1, 2))
    a, V = np.linalg.eigh(S @ S.transpose(0, 2, 1))
    V = V * np.linalg.det(V)[:, None, None]
    d = ((W[:, 0] + 1j * W[:, 1])[:, None] @ S.transpose(0, 2, 1) @ V)[:, 0] / (size_S * size_W)[:, None]
    c = np.cross(d.real, d.imag)
    return vg.Problem(tuple((a / size_S[:, None] ** 2).T), tuple(d.T), tuple(c.T), size_S / (size_S + size_W)), V


def energies(problem: vg.Problem, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """E and T of one problem in the directions n (...,3)."""
    a, d, c = (np.array(part) for part in problem[:3])
    return (n * n) @ a, (abs(d) ** 2).sum() - abs(n @ d) ** 2 + 2 * n @ c


def goal(problem: vg.Problem, E: np.ndarray, T: np.ndarray, scale: str) -> np.ndarray:
    if scale == "free":
        return T / (1 - E)
    return problem.k * E + 2 * (1 - problem.k) * np.sqrt(np.maximum(T, 0))


def relative_residual(k: np.ndarray | float, g: np.ndarray, scale: str) -> np.ndarray:
    """Residual over the size of the image, from the goal."""
    square = 1 - g if scale == "free" else (k / (1 - k)) ** 2 + 1 - k / (1 - k) ** 2 * g
    return np.sqrt(np.maximum(square, 0))


def one(problem: vg.Problem) -> vg.Problem:
    """The first of N problems, as floats."""
    return map_tree(lambda values: values[0].item(), problem)


# --- the tables


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _cells(count: int, points: tuple[int, ...], noises=NOISES, thicknesses=THICKNESSES) -> Iterator[tuple]:
    for P in points:
        for noise in noises:
            for thickness in thicknesses:
                yield random_problems(count, P, noise, thickness, seed=P)[:2]


def lagrangian_holds(S: np.ndarray, W: np.ndarray, found: OnP, scale: str) -> np.ndarray:
    """(N,) whether the Lagrangian that keeps q^T q = 0 (and |q|^2 = 2) by multipliers is convex at the answers."""
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
    """Share of unit-scale answers without a certificate, by noise (rows) and thickness."""
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
    """What the unit-scale answers without a certificate are worth: whether more climbs find a better one, how loose
    the bound is; noise 0.3, thickness 0.3."""
    rows = []
    for points in (4, 6, 17):
        S, W, _ = random_problems(count, points, 0.3, 0.3, seed=2)
        left = ~onp(S, W, scale="unit").certified
        S, W = S[left], W[left]
        problem = reduced(S, W)[0]
        found = onp(S, W, scale="unit").residual / np.sqrt(W.var(2).sum(1))
        best = relative_residual(problem.k, optima(problem, "unit")[:, 0], "unit")
        loose = [100 * _looseness(S[i : i + 1], W[i : i + 1]) for i in range(len(S))]
        row = [points, count, len(S), (best < found - _NOTHING).sum(), f"{np.median(loose):.2f}", f"{max(loose):.2f}"]
        rows.append([str(cell) for cell in row])
    head = ["points", "problems", "not certified", "a better one exists", "bound too high by, median %", "most, %"]
    return table(head, rows)


def optima(problem: vg.Problem, scale: str) -> np.ndarray:
    """(N, ``_MOST_OPTIMA``) the goal at all local optima that climbs from all over the sphere find, best first; -1
    where there are no more."""
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
    """How many optima, and how many of the second ones ``onp`` finds, by thickness; 4 points and more."""
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
                near = rival & (first > 0.9 * second) & (second > _NOTHING)
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
    """(N,3,3) the usual approximation: the affine camera, its two rows made orthonormal, the third by cross product."""
    S, W = S - S.mean(2, keepdims=True), W - W.mean(2, keepdims=True)
    affine = W @ S.transpose(0, 2, 1) @ np.linalg.inv(S @ S.transpose(0, 2, 1))
    U, _, V = np.linalg.svd(affine, full_matrices=False)
    rows = U @ V
    return np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], axis=1)


def approximation_table(count: int = 4000) -> list[str]:
    """Angle of the approximation to the unit-scale optimum in degrees, and ratio of their residuals; noise 0.3."""
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


def tables() -> dict[str, list[str]]:
    return {
        "Certified, %": certificate_table(),
        "Unit scale, 4 to 17 points: not certified, %": failures_table(),
        "Those not certified": uncertified_table(),
        "Local optima": optima_table(),
        "Least squares + SVD": approximation_table(),
    }


# --- the map of the viewing hemisphere


def disc_frame(problem: vg.Problem, n: np.ndarray) -> np.ndarray:
    """Rows: right and up on the map and its centre c; n and its Necker reversal lie level."""
    centre = np.array(problem.c) / np.linalg.norm(problem.c)
    across = n - np.array(vg.reversal(tuple(n)))
    across = across - (across @ centre) * centre
    across /= np.linalg.norm(across)
    return np.array([across, np.cross(centre, across), centre])


def to_disc(frame: np.ndarray, n: np.ndarray) -> np.ndarray:
    """(...,2) Lambert's azimuthal equal-area map of directions (...,3) of the hemisphere c.n >= 0 to the unit disc."""
    x = n @ frame.T
    x = x * np.where(x[..., 2:] < 0, -1, 1)
    return x[..., :2] / np.sqrt(1 + x[..., 2:])


def disc_grid(frame: np.ndarray, size: int = 301) -> tuple[np.ndarray, np.ndarray]:
    """Points (size,size,2) of the disc's square, and the directions they show; NaN off the disc."""
    p = np.stack(np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size)), axis=-1)
    square = (p**2).sum(-1, keepdims=True)
    x = np.concatenate([p * np.sqrt(np.maximum(2 - square, 0)), 1 - square], axis=-1)
    return p, np.where(square <= 1, x, np.nan) @ frame


def climb_path(problem: vg.Problem, n: Vector, scale: str) -> np.ndarray:
    """(steps,3) directions that the solver passes on its way up."""
    return np.array([vg.newton(Floats, problem, n, scale, steps).n for steps in range(12)])


def draw_maps(path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 3, figsize=(8.8, 7.0), layout="constrained")
    for column, (title, *what) in enumerate(_MAPS):
        S, W, R = random_problems(1, *what)
        problems, V = reduced(S, W)
        problem = one(problems)
        frame = disc_frame(problem, onp(S, W).R[0, 2] @ V[0])
        for row, scale in enumerate(SCALES):
            found = onp(S, W, scale=scale)
            axes = panels[row, column]
            filled = _draw_map(axes, problem, V[0], frame, found, scale, R[0])
            axes.set_title(f"{title}\n" * (row == 0) + _caption(found), fontsize=9)
            if column == 2:
                bar = figure.colorbar(filled, ax=panels[row], shrink=0.8, pad=0.02)
                bar.set_label(f"{scale} scale: residual / size of the image")
    handles, labels = panels[0, 1].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=3, fontsize=9, facecolor="#6b6d70", labelcolor="white"
    )
    _save(figure, path)


def _save(figure, path: Path) -> None:
    """At 120 dpi in 256 colours, a third of the size of true colour."""
    import matplotlib.pyplot as plt
    from PIL import Image

    true_colour = io.BytesIO()
    figure.savefig(true_colour, dpi=120)
    plt.close(figure)
    Image.open(true_colour).convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE).save(path, optimize=True)


def _caption(found: OnP) -> str:
    if not found.two_fold[0]:
        return "one optimum"
    return f"two optima, ambiguity {found.ambiguity[0]:.2f}"


def _draw_map(axes, problem: vg.Problem, V: np.ndarray, frame: np.ndarray, found: OnP, scale: str, R: np.ndarray):
    p, n = disc_grid(frame)
    cost = relative_residual(problem.k, goal(problem, *energies(problem, n), scale), scale)
    low = 0.1 * np.floor(10 * np.nanmin(cost))
    filled = axes.contourf(*p.T, cost.T, _LEVELS, cmap="cividis", extend="both")
    axes.contour(*p.T, cost.T, np.arange(low, low + 0.3, 0.02), colors="white", linewidths=0.4, alpha=0.6)
    axes.add_patch(_circle())
    start = vs.start_direction(Floats, problem)
    first = climb_path(problem, start, scale)
    for directions in (first, climb_path(problem, vg.reversal(tuple(first[-1])), scale)):
        way = to_disc(frame, directions)
        far = np.linalg.norm(np.diff(way, axis=0), axis=1) > 1.2  # round the rim, to the other side of the map
        way = np.insert(way, np.flatnonzero(far) + 1, np.nan, axis=0)
        axes.plot(*way.T, ".-", color=_ORANGE, linewidth=1.2, markersize=4)
    best = found.R[0, 2] @ V
    second = found.R_mirror[0, 2] @ V if found.two_fold[0] else None
    for n, marker, size, face, edge, label in (
        (best, "o", 15, "none", "white", "optimum"),
        (second, "s", 14, "none", "white", "second optimum"),
        (np.array(vg.reversal(tuple(best))), "x", 8, "white", "white", "its Necker reversal, and the way up"),
        (R[2] @ V, "*", 12, _PINK, "black", "true direction, before the noise"),
        (start, "^", 7, _ORANGE, "black", "start, and the way up"),
    ):
        if n is not None:
            mark = {"markersize": size, "markerfacecolor": face, "markeredgecolor": edge, "label": label}
            axes.plot(*to_disc(frame, np.array(n)), marker, markeredgewidth=1.8 if edge == "white" else 0.8, **mark)
    axes.set(aspect="equal", xlim=(-1.03, 1.03), ylim=(-1.03, 1.03))
    axes.axis("off")
    return filled


def _circle():
    from matplotlib.patches import Circle

    return Circle((0, 0), 1, fill=False, color="black", linewidth=1)


# --- the certificate


def bound(problem: vg.Problem, E: np.ndarray, T: np.ndarray, tau: float) -> np.ndarray:
    """The quadratic that touches the unit-scale goal where sqrt(T) is tau, and is nowhere below it."""
    return problem.k * E + (1 - problem.k) * (T / tau + tau)


def uncertified_problem() -> tuple[np.ndarray, np.ndarray]:
    """The unit-scale problem of a batch that is left without a certificate and has the loosest bound."""
    S, W, _ = random_problems(20000, 4, 0.3, 0.3, seed=2)
    rows = np.flatnonzero(~onp(S, W, scale="unit").certified)
    row = max(rows, key=lambda row: _looseness(S[row : row + 1], W[row : row + 1]))
    return S[row : row + 1], W[row : row + 1]


def _looseness(S: np.ndarray, W: np.ndarray) -> float:
    """How far the bound rises above the best goal, over that goal."""
    problem, best = _with_best(S, W, "unit")
    E, T = energies(problem, np.array(vs.fibonacci_sphere(5000)))
    tau = np.sqrt(energies(problem, best)[1])
    return bound(problem, E, T, tau).max() / goal(problem, *energies(problem, best), "unit") - 1


def _with_best(S: np.ndarray, W: np.ndarray, scale: str) -> tuple[vg.Problem, np.ndarray]:
    problems, V = reduced(S, W)
    return one(problems), onp(S, W, scale=scale).R[0, 2] @ V[0]


def draw_certificate(path: Path) -> None:
    import matplotlib.pyplot as plt

    S, W, _ = random_problems(1, *_MAPS[1][1:])
    figure, panels = plt.subplots(2, 2, figsize=(9.6, 7.6), layout="constrained")
    _draw_great_circle(panels[0, 0], S, W)
    _draw_image(panels[0, 1], S, W, "free", "free scale: always certified", 20, 8)
    _draw_image(panels[1, 0], S, W, "unit", "unit scale, the same problem: certified", 20, 8)
    _draw_image(panels[1, 1], *uncertified_problem(), "unit", "unit scale, another problem: not certified", 2, 0.8)
    _save(figure, path)


def _draw_great_circle(axes, S: np.ndarray, W: np.ndarray) -> None:
    problem, best = _with_best(S, W, "unit")
    rival = onp(S, W, scale="unit").R_mirror[0, 2] @ reduced(S, W)[1][0]
    across = rival - (rival @ best) * best
    across /= np.linalg.norm(across)
    angle = np.radians(np.linspace(-180, 180, 721))
    E, T = energies(problem, np.cos(angle)[:, None] * best + np.sin(angle)[:, None] * across)
    tau = np.sqrt(energies(problem, best)[1])
    top = goal(problem, *energies(problem, best), "unit")
    degrees = np.degrees(angle)
    axes.plot(degrees, bound(problem, E, T, tau), color=_ORANGE, linestyle="--", label="bound: the touching quadratic")
    axes.plot(degrees, goal(problem, E, T, "unit"), color=_BLUE, label="goal g")
    axes.axhline(top, color="black", linewidth=0.6)
    axes.plot(0, top, "o", color="white", markeredgecolor="black", label="optimum")
    to_rival = np.degrees(np.arccos(rival @ best))
    height = goal(problem, *energies(problem, rival), "unit")
    axes.plot(to_rival, height, "s", color="white", markeredgecolor="black", label="second optimum")
    axes.set(xlabel="degrees from the optimum, towards the second one", ylabel="g")
    axes.set_title("unit scale: g, and the bound that touches it", fontsize=10)
    axes.set_xticks(range(-180, 181, 60))
    axes.legend(fontsize=8, loc="lower right")


def _draw_image(axes, S: np.ndarray, W: np.ndarray, scale: str, title: str, below: float, above: float) -> None:
    """All directions by E and the height of the bound above the optimum, and the level line of the goal there."""
    problem, best = _with_best(S, W, scale)
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 1441), np.linspace(0, np.pi, 721))
    E, T = energies(problem, np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1))
    best_E, best_T = energies(problem, best)
    top, tau = goal(problem, best_E, best_T, scale), np.sqrt(best_T)
    excess = T / top + E - 1 if scale == "free" else bound(problem, E, T, tau) / top - 1
    axes.pcolormesh(E, 100 * excess, np.zeros_like(E)[1:, 1:], cmap=_one_colour(), rasterized=True)
    x = np.linspace(E.min(), E.max(), 400)
    if scale == "unit":
        level = (top - problem.k * x) / (2 * (1 - problem.k))
        axes.plot(
            x,
            100 * (bound(problem, x, level**2, tau) / top - 1),
            color=_BLUE,
            label="directions as good as the optimum: g = g*",
        )
    axes.axhline(0, color=_ORANGE, linestyle="--", label="bound = g*" if scale == "unit" else "bound = g*, and g = g*")
    axes.plot(best_E, 0, "o", color="white", markeredgecolor="black", label="optimum")
    axes.plot([], [], "s", color=_GREY, label="all viewing directions")
    axes.set(xlabel="E", ylabel="bound above g*, % of g*", ylim=(-below, above))
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=8, loc="lower left")


def _one_colour():
    from matplotlib.colors import ListedColormap

    return ListedColormap([_GREY])


def main() -> None:
    import matplotlib

    matplotlib.use("Agg")
    draw_maps(HERE / "onp_hemisphere.png")
    draw_certificate(HERE / "onp_certificate.png")
    for title, lines in tables().items():
        print(title, "", *lines, "", sep="\n")


if __name__ == "__main__":
    main()
