# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the explanation of OnP: maps of the viewing hemisphere, and the certificate.

    python docs/onp_pictures.py

Pictures are written next to this file.  Random numbers have fixed seeds: every run draws the same pictures.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from onp_tables import (
    SCALES,
    bound,
    bound_looseness,
    energies,
    goal,
    random_problems,
    reduced,
    relative_residual,
    single,
    with_best,
)

from paul_ros import OnP, onp
from paul_ros import viewing_goal as vg
from paul_ros import viewing_sphere as vs
from paul_ros.arithmetic import Floats, Vector
from paul_ros.extras import require
from paul_ros.viewing_goal import Scale

HERE = Path(__file__).resolve().parent
_LEVELS = np.arange(0.25, 1.05, 0.05)

_MAPS: tuple[tuple[str, int, float, float, int], ...] = (
    ("deep shape", 8, 0.5, 1.0, 233),
    ("flat shape, a third as deep as wide", 10, 0.45, 0.35, 336),
    ("planar shape", 10, 0.4, 0.0, 12),
)
"""Title, points, noise, thickness and seed of the drawn problems; noise is large, so that marks lie apart."""

_BLUE, _ORANGE, _GREEN, _PINK, _GREY = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#c8c8c8"  # Okabe and Ito


# --- the map of the viewing hemisphere


def disc_frame(problem: vg.Problem, n: np.ndarray) -> np.ndarray:
    """Return the map's frame, rows right, up and centre c, in which n and its Necker reversal lie level."""
    centre = np.array(problem.c) / np.linalg.norm(problem.c)
    across = n - np.array(vg.reversal(tuple(n)))
    across = across - (across @ centre) * centre
    across /= np.linalg.norm(across)
    return np.array([across, np.cross(centre, across), centre])


def to_disc(frame: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Map directions (...,3) of the hemisphere c.n >= 0 to the unit disc (...,2): Lambert's equal-area projection."""
    x = n @ frame.T
    x = x * np.where(x[..., 2:] < 0, -1, 1)
    return x[..., :2] / np.sqrt(1 + x[..., 2:])


def disc_grid(frame: np.ndarray, size: int = 301) -> tuple[np.ndarray, np.ndarray]:
    """Return points (size,size,2) of the disc's square, and their directions (size,size,3); NaN off the disc."""
    p = np.stack(np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size)), axis=-1)
    square = (p**2).sum(-1, keepdims=True)
    x = np.concatenate([p * np.sqrt(np.maximum(2 - square, 0)), 1 - square], axis=-1)
    return p, np.where(square <= 1, x, np.nan) @ frame


def climb_path(problem: vg.Problem, n: Vector, scale: Scale) -> np.ndarray:
    """Return the directions (steps,3) that the solver passes on its way up."""
    return np.array([vg.newton(Floats, problem, n, scale, steps).n for steps in range(12)])


def draw_maps(path: Path) -> None:
    """Draw maps of the viewing hemisphere for both scales."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 3, figsize=(8.8, 7.0), layout="constrained")
    for column, (title, points, noise, thickness, seed) in enumerate(_MAPS):
        S, W, R = random_problems(1, points, noise, thickness, seed)
        problems, V = reduced(S, W)
        problem = single(problems)
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


def _save(figure: Any, path: Path) -> None:
    """Write the figure at 120 dpi in 256 colours, a third of the size of true colour."""
    import matplotlib.pyplot as plt
    from PIL import Image

    true_colour = io.BytesIO()
    figure.savefig(true_colour, dpi=120)
    plt.close(figure)
    Image.open(true_colour).convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE).save(path, optimize=True)


def _caption(found: OnP) -> str:
    """Return the number of optima in words."""
    if not found.two_fold[0]:
        return "one optimum"
    return f"two optima, ambiguity {found.ambiguity[0]:.2f}"


def _draw_map(
    axes: Any, problem: vg.Problem, V: np.ndarray, frame: np.ndarray, found: OnP, scale: Scale, R: np.ndarray
) -> Any:
    """Draw residuals, climbs and marks on one map; returns the filled contours."""
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
        far = np.linalg.norm(np.diff(way, axis=0), axis=1) > 1.2  # past the rim, to the other side of the map
        way = np.insert(way, np.flatnonzero(far) + 1, np.nan, axis=0)
        axes.plot(*way.T, ".-", color=_ORANGE, linewidth=1.2, markersize=4)
    best = found.R[0, 2] @ V
    second = found.R_mirror[0, 2] @ V if found.two_fold[0] else None
    for direction, marker, size, face, edge, label in (
        (best, "o", 15, "none", "white", "optimum"),
        (second, "s", 14, "none", "white", "second optimum"),
        (np.array(vg.reversal(tuple(best))), "x", 8, "white", "white", "its Necker reversal, and the way up"),
        (R[2] @ V, "*", 12, _PINK, "black", "true direction, before the noise"),
        (start, "^", 7, _ORANGE, "black", "start, and the way up"),
    ):
        if direction is not None:
            mark = {"markersize": size, "markerfacecolor": face, "markeredgecolor": edge, "label": label}
            width = 1.8 if edge == "white" else 0.8
            axes.plot(*to_disc(frame, np.array(direction)), marker, markeredgewidth=width, **mark)
    axes.set(aspect="equal", xlim=(-1.03, 1.03), ylim=(-1.03, 1.03))
    axes.axis("off")
    return filled


def _circle() -> Any:
    """Return the rim of a map."""
    from matplotlib.patches import Circle

    return Circle((0, 0), 1, fill=False, color="black", linewidth=1)


# --- the certificate


def uncertified_problem() -> tuple[np.ndarray, np.ndarray]:
    """Return the unit-scale problem of a batch that has no certificate and the loosest bound."""
    S, W, _ = random_problems(20000, 4, 0.3, 0.3, seed=2)
    rows = np.flatnonzero(~onp(S, W, scale="unit").certified)
    row = max(rows, key=lambda row: bound_looseness(S[row : row + 1], W[row : row + 1]))
    return S[row : row + 1], W[row : row + 1]


def draw_certificate(path: Path) -> None:
    """Draw the goal with the bound that touches it, and all directions by the height of their bound."""
    import matplotlib.pyplot as plt

    S, W, _ = random_problems(1, *_MAPS[1][1:])
    figure, panels = plt.subplots(2, 2, figsize=(9.6, 7.6), layout="constrained")
    _draw_great_circle(panels[0, 0], S, W)
    _draw_image(panels[0, 1], S, W, "free", "free scale: always certified", 20, 8)
    _draw_image(panels[1, 0], S, W, "unit", "unit scale, the same problem: certified", 20, 8)
    _draw_image(panels[1, 1], *uncertified_problem(), "unit", "unit scale, another problem: not certified", 2, 0.8)
    _save(figure, path)


def _draw_great_circle(axes: Any, S: np.ndarray, W: np.ndarray) -> None:
    """Draw goal and bound along the great circle through both optima."""
    problem, best = with_best(S, W, "unit")
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


def _draw_image(axes: Any, S: np.ndarray, W: np.ndarray, scale: Scale, title: str, below: float, above: float) -> None:
    """Draw all directions by E and the height of the bound above the optimum, with the goal's level line there."""
    problem, best = with_best(S, W, scale)
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


def _one_colour() -> Any:
    """Return a colour map of grey alone."""
    from matplotlib.colors import ListedColormap

    return ListedColormap([_GREY])


def main() -> None:
    """Draw both pictures."""
    require("docs", "matplotlib", "PIL")
    import matplotlib

    matplotlib.use("Agg")
    draw_maps(HERE / "onp_hemisphere.png")
    draw_certificate(HERE / "onp_certificate.png")


if __name__ == "__main__":
    main()
