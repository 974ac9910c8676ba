# SPDX-License-Identifier: Apache-2.0
"""A linear Gaussian Procrustean shape model of 2D frames: probabilistic principal components under unknown cameras.

Frame f is seen as ``W = R (V_0 + sum_k c_k V_k) + t + noise`` with codes c ~ N(0, I) and isotropic noise of deviation
sigma. The camera R is orthographic, of unit scale; the translation t is free. Codes and translations integrate out in
closed form. Expectation maximisation fits the bases V and the rotations R; L-BFGS polishes them. The family of models
is that of Lee et al., "Procrustean Normal Distribution for Non-Rigid Structure from Motion", 2013.

The caller anneals sigma. It is never learned: a learned sigma runs away from good solutions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from training.start.moments import RIDGE, Moments, Posterior, centred, image_plane_projections, with_one
from training.start.observations import Observations, centred_on_visible

_REFINEMENTS = 6
"""Alternations of codes and camera that refine a random camera."""


@dataclass(frozen=True)
class LinearModel:
    """Bases and cameras, fitted to frames.

    Attributes:
        V: (K+1,3,P) float64 mean shape and bases, canonical frame, units of W.
        R: (F,3,3) float64 cameras of these frames, det +1.
    """

    V: Tensor
    R: Tensor

    @classmethod
    def random(cls, frames: int, points: int, bases: int, generator: np.random.Generator) -> LinearModel:
        """Return a random non-rigid shape under random cameras, from which every basin can be reached."""
        V = generator.standard_normal((bases + 1, 3, points))
        V[1:] *= 0.3
        return cls(centred(torch.from_numpy(V)), random_rotations(frames, generator))

    def widened(self, bases: int, generator: np.random.Generator) -> LinearModel:
        """Add small random bases up to the number K."""
        extra = 0.02 * generator.standard_normal((bases + 1 - len(self.V), *self.V.shape[1:]))
        return replace(self, V=torch.cat([self.V, centred(torch.from_numpy(extra))]))

    def posterior(self, seen: Observations, sigma: float) -> Posterior:
        """Return codes and likelihoods of the frames."""
        return Moments.of(seen, self.V).posterior(self.R, sigma)

    def shapes(self, posterior: Posterior) -> Tensor:
        """Return expected shapes (F,3,P), canonical frame."""
        return torch.tensordot(with_one(posterior.mean), self.V, 1)

    def in_camera(self, seen: Observations, sigma: float) -> Tensor:
        """Return expected shapes (F,3,P) in camera frame, centred on the visible points."""
        return centred_on_visible(self.R @ self.shapes(self.posterior(seen, sigma)), seen.visible)

    def em_step(self, seen: Observations, sigma: float, penalty: float) -> LinearModel:
        """Run one step of expectation maximisation: bases, cameras, then whitening of the codes."""
        posterior = self.posterior(seen, sigma)
        model = replace(self, V=_best_bases(self, seen, posterior, sigma, penalty))
        moments = Moments.of(seen, model.V)
        model = replace(model, R=moments.best_rotations(moments.posterior(model.R, sigma)))
        return replace(model, V=_whitened(model.V, moments.posterior(model.R, sigma)))

    def searched(
        self, seen: Observations, sigma: float, generator: np.random.Generator, count: int = 200, best: int = 3
    ) -> LinearModel:
        """Search every camera globally: score random rotations by likelihood and refine the best few.

        Args:
            count: number of random rotations.
            best: number of rotations refined per frame.
        """
        moments = Moments.of(seen, self.V)
        candidates = random_rotations(count, generator)
        chosen = moments.scores(candidates, sigma).topk(best, dim=0, largest=False).indices
        R, nll = self.R, moments.posterior(self.R, sigma).nll
        for other in candidates[chosen]:
            for _ in range(_REFINEMENTS):
                other = moments.best_rotations(moments.posterior(other, sigma))
            other_nll = moments.posterior(other, sigma).nll
            R = torch.where((other_nll < nll)[:, None, None], other, R)
            nll = torch.minimum(nll, other_nll)
        return replace(self, R=R)

    def polished(self, seen: Observations, sigma: float, penalty: float, iterations: int) -> LinearModel:
        """Descend in bases and cameras together by L-BFGS, which is fast in valleys where EM is slow."""
        V = self.V.clone().requires_grad_()
        turn = torch.zeros(len(self.R), 3, dtype=torch.float64, requires_grad=True)
        optimizer = torch.optim.LBFGS(
            [V, turn],
            max_iter=iterations,
            history_size=20,
            line_search_fn="strong_wolfe",
            tolerance_grad=1e-9,
            tolerance_change=1e-12,
        )

        def evaluate() -> Tensor:
            optimizer.zero_grad()
            nll = Moments.of(seen, V).marginal_nll(rotations_of(turn) @ self.R, sigma)
            loss = nll.mean() + penalty * V.square().sum() / (3 * seen.points)
            loss.backward()
            return loss

        optimizer.step(evaluate)
        return LinearModel(centred(V.detach()), rotations_of(turn.detach()) @ self.R)

    def objective(self, seen: Observations, sigma: float, penalty: float) -> float:
        """Return the mean negative log likelihood of a frame, plus the penalty on the size of the bases."""
        nll = Moments.of(seen, self.V).marginal_nll(self.R, sigma).mean()
        return float(nll + penalty * self.V.square().sum() / (3 * seen.points))


def random_rotations(count: int, generator: np.random.Generator) -> Tensor:
    """Draw uniform rotations (N,3,3), as unit quaternions of four normal numbers (Shoemake 1992)."""
    q = torch.from_numpy(generator.standard_normal((4, count)))
    w, x, y, z = q / q.norm(dim=0)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, 1).view(-1, 3, 3)


def rotations_of(turn: Tensor) -> Tensor:
    """Return rotations (N,3,3) of rotation vectors (N,3) (Rodrigues), smooth at 0."""
    x, y, z = turn.unbind(1)
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    angle = turn.square().sum(1).add(1e-24).sqrt()[:, None, None]
    one = torch.eye(3, dtype=turn.dtype)
    return one + torch.sin(angle) / angle * K + (1 - torch.cos(angle)) / angle**2 * (K @ K)


def _best_bases(model: LinearModel, seen: Observations, posterior: Posterior, sigma: float, penalty: float) -> Tensor:
    """Return the bases (K+1,3,P) of highest expected likelihood minus penalty, by one linear system per point.

    The translation of a frame with hidden points depends on its code: t = -R (mean of the visible points of V) (1, c).
    """
    bases, _, points = model.V.shape
    size, R, E, Q = 3 * bases, model.R[:, :2], posterior.second, image_plane_projections(model.R)
    right = torch.einsum("fk,fip->kip", with_one(posterior.mean), R.transpose(1, 2) @ seen.W).reshape(size, points)
    ridge = (2 * penalty / (3 * points) * sigma**2 * len(seen) + RIDGE) * torch.eye(size, dtype=right.dtype)
    visible = seen.visible.double()
    if not seen.complete:
        middle = torch.einsum("fp,kip->fki", visible / seen.count[:, None], model.V)
        right = right + (E @ middle @ Q).reshape(-1, size).T @ visible
    weights = (visible[:, :1] if seen.complete else visible)[..., None] * Q.flatten(1)[:, None]
    left = (weights.flatten(1).T @ E.flatten(1)).view(-1, 3, 3, bases, bases)
    left = left.permute(0, 3, 1, 4, 2).reshape(-1, size, size) + ridge
    # Without hidden points all points share one system.
    flat = torch.linalg.solve(left[0], right) if seen.complete else torch.linalg.solve(left, right.T).T
    return centred(flat.reshape(bases, 3, points))


def _whitened(V: Tensor, posterior: Posterior) -> Tensor:
    """Return bases (K+1,3,P) under which the codes have mean 0 and covariance I."""
    mean = posterior.mean.mean(0)
    covariance = posterior.second[:, 1:, 1:].mean(0) - torch.outer(mean, mean)
    root = torch.linalg.cholesky(covariance + RIDGE * torch.eye(len(mean), dtype=mean.dtype))
    return torch.cat([V[:1] + torch.tensordot(mean, V[1:], 1), torch.tensordot(root.T, V[1:], 1)])
