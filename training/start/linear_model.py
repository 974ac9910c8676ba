# SPDX-License-Identifier: Apache-2.0
"""A linear Gaussian Procrustean shape model of 2D frames: probabilistic principal components under unknown cameras.

Frame f is seen as ``W = R (V_0 + sum_k c_k V_k) + t + noise`` with codes c ~ N(0, I), isotropic noise of deviation
sigma, an orthographic camera R of unit scale and a free translation t. Codes and translations integrate out in closed
form; what is left, the bases V and the rotations R, is fitted by expectation maximisation and polished by L-BFGS. (The
family of models is that of Lee et al., "Procrustean Normal Distribution for Non-Rigid Structure from Motion", 2013.)

Sigma is annealed by the caller and never learned: learned, it runs away from good solutions.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from paul_ros import viewing_sphere

Array = TypeVar("Array", np.ndarray, Tensor)

_RIDGE = 1e-9
_REFINEMENTS = 6


@dataclass(frozen=True)
class Observations:
    """2D frames as the model sees them.

    Attributes:
        W: (F,2,P) float64, each frame centred on its visible points, 0 where hidden; one scale for all frames.
        visible: (F,P) bool.
    """

    W: Tensor
    visible: Tensor

    @classmethod
    def of(cls, W: np.ndarray, visible: np.ndarray) -> Observations:
        """Centre image points (F,2,P); anything where hidden."""
        visible = torch.as_tensor(visible)
        seen = visible[:, None]
        W = torch.where(seen, torch.as_tensor(W).double(), 0.0)
        centre = W.sum(2, keepdim=True) / seen.sum(2, keepdim=True)
        return cls(torch.where(seen, W - centre, 0.0), visible)

    def __len__(self) -> int:
        return len(self.W)

    def __getitem__(self, rows: np.ndarray) -> Observations:
        return Observations(self.W[rows], self.visible[rows])

    @property
    def points(self) -> int:
        """P."""
        return self.W.shape[2]

    def completed(self, S: Tensor) -> Tensor:
        """Shapes (F,3,P) in camera frame with x and y of the visible points as they were observed."""
        return torch.cat([torch.where(self.visible[:, None], self.W, S[:, :2]), S[:, 2:]], 1)

    @cached_property
    def complete(self) -> bool:
        """Nothing is hidden: then all frames share the second moments of the bases."""
        return bool(self.visible.all())

    @cached_property
    def count(self) -> Tensor:
        """(F,) number of visible points, float64."""
        return self.visible.sum(1).double()

    @cached_property
    def products(self) -> Tensor:
        """(F,2,2) second moments of the image points."""
        return self.W @ self.W.transpose(1, 2)

    @cached_property
    def power(self) -> Tensor:
        """(F,) squared norms of the frames."""
        return self.W.square().sum((1, 2))


@dataclass(frozen=True)
class Posterior:
    """What the frames say of their codes.

    Attributes:
        mean, covariance: (F,K) and (F,K,K) of the codes.
        nll: (F,) negative log likelihoods of the frames.
    """

    mean: Tensor
    covariance: Tensor
    nll: Tensor

    @cached_property
    def second(self) -> Tensor:
        """(F,K+1,K+1) expected products of the codes (1, c)."""
        c = with_one(self.mean)
        E = c[:, :, None] * c[:, None]
        E[:, 1:, 1:] += self.covariance
        return E


class Moments(ABC):
    """Products of the bases with each other and with the frames: all that cameras and codes depend on.

    Two kinds: where nothing is hidden the frames share the products of the bases; else each has its own.
    """

    def __init__(self, seen: Observations, V: Tensor) -> None:
        self.seen, self.V, self.bases = seen, V, len(V)
        # (F,2,K+1,3): image axes against the coordinates of the bases.
        self.cross = (seen.W.flatten(0, 1) @ V.flatten(0, 1).T).unflatten(0, (-1, 2)).unflatten(2, (-1, 3))

    @staticmethod
    def of(seen: Observations, V: Tensor) -> Moments:
        """Those of bases V (K+1,3,P)."""
        return (_SharedMoments if seen.complete else _OwnMoments)(seen, V)

    @abstractmethod
    def gram(self, R: Tensor) -> Tensor:
        """Products (F,K+1,K+1) of the bases as seen by cameras R (F,3,3)."""

    @abstractmethod
    def scores(self, R: Tensor, sigma: float) -> Tensor:
        """Negative log likelihoods (N,F) of every frame under every one of the cameras R (N,3,3)."""

    @abstractmethod
    def spread(self, posterior: Posterior) -> Tensor:
        """Expected products (F,3,3) of the coordinates of the shapes."""

    @abstractmethod
    def beside(self, code: Tensor) -> Tensor:
        """Products (F,3,K+1,3) of the bases' coordinates (first) with those of the shape of codes (F,K+1) (last)."""

    def posterior(self, R: Tensor, sigma: float) -> Posterior:
        """Codes and likelihoods of frames seen by cameras R (F,3,3)."""
        H, h, rest = self._system(self.gram(R), R, sigma)
        inverse, log_det = _inverse(H)
        mean = (inverse @ h[..., None])[..., 0]
        return Posterior(mean, sigma**2 * inverse, self._nll(log_det, rest - (h * mean).sum(1), sigma))

    def marginal_nll(self, R: Tensor, sigma: float) -> Tensor:
        """Negative log likelihoods (F,) with the cameras integrated out about R; for autograd.

        At the best camera alone the likelihood favours models that bend a body where it turns. Integrating over small
        turns (Laplace's method) adds half the log determinant of J, how sharply the frame tells the turn.

        Gradients of factorisations are slow, and none are needed: a quadratic form at its optimum has the gradient of
        the form with the optimum held, and one Newton step there carries the gradient of the optimum itself.
        """
        H, h, rest = self._system(self.gram(R), R, sigma)
        with torch.no_grad():
            inverse, log_det = _inverse(H)
            held = inverse @ h[..., None]
        log_det = log_det + (inverse * (H - H.detach())).sum((1, 2))
        code = (held + inverse @ (h[..., None] - H @ held))[..., 0]
        misfit = rest - (held * (2 * h[..., None] - H @ held)).sum((1, 2))
        own, others = self._turning(R, code)
        Y = inverse @ others.detach()
        J = own - 2 * Y.transpose(1, 2) @ others + Y.transpose(1, 2) @ H @ Y
        J = (J + J.transpose(1, 2)) / (2 * sigma**2)
        # Points on one line tell no turn about it: a ridge above rounding, whatever the noise.
        ridge = _RIDGE * (1 + J.diagonal(dim1=1, dim2=2).sum(1))
        J = J + ridge[:, None, None] * torch.eye(3, dtype=J.dtype)
        return self._nll(log_det, misfit, sigma) + 0.5 * torch.logdet(J)

    def best_rotations(self, posterior: Posterior) -> Tensor:
        """Cameras (F,3,3) of the highest expected likelihood: exact orthographic-N-point on expected moments."""
        A = self.spread(posterior)
        B = torch.einsum("fk,faki->fai", with_one(posterior.mean), self.cross)
        upper = torch.cat([(A + A.transpose(1, 2)) / 2, B.transpose(1, 2)], 2)
        moments = torch.cat([upper, torch.cat([B, self.seen.products], 2)], 1).numpy()
        poses = viewing_sphere.solve(moments, np.zeros((len(moments), 5)), "unit", rivals=False)
        return torch.from_numpy(poses.R[:, 0])

    def _system(self, G: Tensor, R: Tensor, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
        """Of the codes: matrix H (F,K,K), right side h (F,K); and the squared norm (F,) of what the mean leaves."""
        along = torch.einsum("fai,faki->fk", R[:, :2], self.cross)
        H = G[:, 1:, 1:] + sigma**2 * torch.eye(self.bases - 1, dtype=G.dtype)
        return H, along[:, 1:] - G[:, 0, 1:], self.seen.power - 2 * along[:, 0] + G[:, 0, 0]

    def _nll(self, log_det: Tensor, misfit: Tensor, sigma: float) -> Tensor:
        freedom = 2 * self.seen.count - 2 - (self.bases - 1)
        return 0.5 * (freedom * math.log(sigma**2) + log_det + misfit / sigma**2)

    def _turning(self, R: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
        """Products of the three ways T (2P each) in which the image moves when the camera turns about its axes.

        T_x = (0, -z), T_y = (z, 0), T_z = (-y, x): among each other (F,3,3), and with the bases (F,K,3).
        """
        c = with_one(code)
        # (F,3,K+1,3): camera coordinates of the bases against those of the shape; and of the shape against itself.
        half = (R @ self.beside(c).flatten(2)).unflatten(2, (-1, 3)).flatten(1, 2)
        D = (half @ R.transpose(1, 2)).unflatten(1, (3, -1))
        C = torch.einsum("fk,fakb->fab", c, D)
        zero = torch.zeros(len(c), dtype=C.dtype)
        xx, yy, zz, xz, yz = C[:, 0, 0], C[:, 1, 1], C[:, 2, 2], C[:, 0, 2], C[:, 1, 2]
        own = torch.stack([zz, zero, -xz, zero, zz, -yz, -xz, -yz, xx + yy], 1).view(-1, 3, 3)
        x, y = D[:, 0, 1:], D[:, 1, 1:]
        return own, torch.stack([-y[..., 2], x[..., 2], y[..., 0] - x[..., 1]], 2)


class _SharedMoments(Moments):
    """Nothing is hidden. The products' size does not depend on the number of points."""

    def __init__(self, seen: Observations, V: Tensor) -> None:
        super().__init__(seen, V)
        flat = _centred(V).flatten(0, 1)
        # (K+1,3,K+1,3)
        self._blocks = (flat @ flat.T).unflatten(1, (-1, 3)).unflatten(0, (-1, 3))

    @cached_property
    def _by_axes(self) -> Tensor:
        """(9,(K+1)^2): the products of coordinates i and j of bases k and l at [3 i + j, (K+1) k + l]."""
        return self._blocks.permute(1, 3, 0, 2).reshape(9, -1)

    def gram(self, R: Tensor) -> Tensor:
        return (_planes(R).flatten(1) @ self._by_axes).unflatten(1, (self.bases, self.bases))

    def scores(self, R: Tensor, sigma: float) -> Tensor:
        G = self.gram(R)
        along = torch.einsum("nai,faki->nfk", R[:, :2], self.cross)
        inverse, log_det = _inverse(G[:, 1:, 1:] + sigma**2 * torch.eye(self.bases - 1, dtype=G.dtype))
        h = along[:, :, 1:] - G[:, None, 0, 1:]
        rest = self.seen.power - 2 * along[:, :, 0] + G[:, :1, 0]
        return self._nll(log_det[:, None], rest - (h * (h @ inverse)).sum(2), sigma)

    def spread(self, posterior: Posterior) -> Tensor:
        return (posterior.second.flatten(1) @ self._by_axes.T).unflatten(1, (3, 3))

    def beside(self, code: Tensor) -> Tensor:
        by_last = self._blocks.permute(2, 1, 0, 3)
        return (code @ by_last.flatten(1)).unflatten(1, by_last.shape[1:])


class _OwnMoments(Moments):
    """Each frame has its own visible points. Images are made anew each time: products a frame would be larger."""

    def __init__(self, seen: Observations, V: Tensor) -> None:
        super().__init__(seen, V)
        self._pattern = seen.visible.double()
        # (F,K+1,3) sums over the visible points.
        self._sums = torch.einsum("fp,kip->fki", self._pattern, V)

    def gram(self, R: Tensor) -> Tensor:
        images = (R[:, :2].flatten(0, 1) @ self.V.transpose(0, 1).flatten(1)).view(len(R), 2, self.bases, -1)
        images = (images * self._pattern[:, None, None]).transpose(1, 2).flatten(2)
        sums = self._sums @ R[:, :2].transpose(1, 2)
        return images @ images.transpose(1, 2) - sums @ sums.transpose(1, 2) / self.seen.count[:, None, None]

    def scores(self, R: Tensor, sigma: float) -> Tensor:
        found = []
        for one in R:
            H, h, rest = self._system(self._gram_of_one(one), one.expand(len(self.seen), 3, 3), sigma)
            L = torch.linalg.cholesky(H)
            explained = torch.linalg.solve_triangular(L, h[..., None], upper=False).square().sum((1, 2))
            found.append(self._nll(_log_det(L), rest - explained, sigma))
        return torch.stack(found)

    def spread(self, posterior: Posterior) -> Tensor:
        E = posterior.second
        pairs = torch.einsum("kip,ljp->klpij", self.V, self.V)
        local = (E.flatten(1) @ pairs.flatten(2).flatten(0, 1)).view(len(E), -1, 9)
        A = (self._pattern[:, None] @ local).unflatten(2, (3, 3))[:, 0]
        return A - self._sums.transpose(1, 2) @ E @ self._sums / self.seen.count[:, None, None]

    def beside(self, code: Tensor) -> Tensor:
        S = (code @ self.V.flatten(1)).view(len(code), 3, -1)
        S = S - torch.einsum("fk,fki->fi", code, self._sums)[..., None] / self.seen.count[:, None, None]
        S = S * self._pattern[:, None]
        products = S.flatten(0, 1) @ self.V.transpose(0, 1).flatten(0, 1).T
        return products.view(len(code), 3, 3, self.bases).permute(0, 2, 3, 1)

    def _gram_of_one(self, R: Tensor) -> Tensor:
        """As ``gram``, of all frames by one camera R (3,3)."""
        images, sums = R[:2] @ self.V, self._sums @ R[:2].T
        pairs = torch.einsum("kap,lap->klp", images, images).flatten(0, 1)
        G = (self._pattern @ pairs.T).unflatten(1, (self.bases, self.bases))
        return G - sums @ sums.transpose(1, 2) / self.seen.count[:, None, None]


@dataclass(frozen=True)
class LinearModel:
    """Bases and cameras.

    Attributes:
        V: (K+1,3,P) float64 mean shape and bases, canonical frame, units of W.
        R: (F,3,3) float64 cameras of the frames it was fitted to, det +1.
    """

    V: Tensor
    R: Tensor

    @classmethod
    def random(cls, frames: int, points: int, bases: int, generator: np.random.Generator) -> LinearModel:
        """A random non-rigid shape under random cameras: from there every basin can be reached."""
        V = generator.standard_normal((bases + 1, 3, points))
        V[1:] *= 0.3
        return cls(_centred(torch.from_numpy(V)), random_rotations(frames, generator))

    def widened(self, bases: int, generator: np.random.Generator) -> LinearModel:
        """With new, small random bases up to the number K."""
        extra = 0.02 * generator.standard_normal((bases + 1 - len(self.V), *self.V.shape[1:]))
        return replace(self, V=torch.cat([self.V, _centred(torch.from_numpy(extra))]))

    def posterior(self, seen: Observations, sigma: float) -> Posterior:
        """Codes and likelihoods of the frames."""
        return Moments.of(seen, self.V).posterior(self.R, sigma)

    def shapes(self, posterior: Posterior) -> Tensor:
        """Expected shapes (F,3,P), canonical frame."""
        return torch.tensordot(with_one(posterior.mean), self.V, 1)

    def in_camera(self, seen: Observations, sigma: float) -> Tensor:
        """Expected shapes (F,3,P) in camera frame, centred on the visible points."""
        return centred_on_visible(self.R @ self.shapes(self.posterior(seen, sigma)), seen.visible)

    def em_step(self, seen: Observations, sigma: float, penalty: float) -> LinearModel:
        """One step of expectation maximisation: bases, cameras, and codes made white again."""
        posterior = self.posterior(seen, sigma)
        model = replace(self, V=_best_bases(self, seen, posterior, sigma, penalty))
        moments = Moments.of(seen, model.V)
        model = replace(model, R=moments.best_rotations(moments.posterior(model.R, sigma)))
        return replace(model, V=_whitened(model.V, moments.posterior(model.R, sigma)))

    def searched(
        self, seen: Observations, sigma: float, generator: np.random.Generator, count: int = 200, best: int = 3
    ) -> LinearModel:
        """With every camera searched for globally: random rotations scored by likelihood, the best few refined."""
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
        """With bases and cameras descended together by L-BFGS, which gets along the valleys that EM crawls in."""
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
        return LinearModel(_centred(V.detach()), rotations_of(turn.detach()) @ self.R)

    def objective(self, seen: Observations, sigma: float, penalty: float) -> float:
        """Mean negative log likelihood of a frame, plus the penalty on the size of the bases."""
        nll = Moments.of(seen, self.V).marginal_nll(self.R, sigma).mean()
        return float(nll + penalty * self.V.square().sum() / (3 * seen.points))


def centred_on_visible(S: Array, visible: Array) -> Array:
    """Shapes (F,3,P), tensor or array, about the means of their visible (F,P) points."""
    shown = visible[:, None]
    return S - (S * shown).sum(2, keepdims=True) / shown.sum(2, keepdims=True)


def random_rotations(count: int, generator: np.random.Generator) -> Tensor:
    """(N,3,3) rotations, uniform: unit quaternions of four normal numbers (Shoemake 1992)."""
    q = torch.from_numpy(generator.standard_normal((4, count)))
    w, x, y, z = q / q.norm(dim=0)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, 1).view(-1, 3, 3)


def rotations_of(turn: Tensor) -> Tensor:
    """Rotations (N,3,3) by rotation vectors (N,3) (Rodrigues), smooth at 0."""
    x, y, z = turn.unbind(1)
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    angle = turn.square().sum(1).add(1e-24).sqrt()[:, None, None]
    one = torch.eye(3, dtype=turn.dtype)
    return one + torch.sin(angle) / angle * K + (1 - torch.cos(angle)) / angle**2 * (K @ K)


def with_one(code: Tensor) -> Tensor:
    """(F,K+1) codes (1, c) of codes (F,K)."""
    return torch.cat([torch.ones_like(code[:, :1]) if code.shape[1] else code.new_ones(len(code), 1), code], 1)


def _planes(R: Tensor) -> Tensor:
    """(N,3,3) projections onto the image planes of cameras (N,3,3)."""
    return R[:, :2].transpose(1, 2) @ R[:, :2]


def _inverse(H: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses and log determinants of positive definite matrices (N,K,K)."""
    L = torch.linalg.cholesky(H)
    return torch.cholesky_inverse(L), _log_det(L)


def _log_det(L: Tensor) -> Tensor:
    """Log determinants (N,) of matrices by their Cholesky factors (N,K,K)."""
    return 2 * L.diagonal(dim1=1, dim2=2).log().sum(1)


def _centred(V: Tensor) -> Tensor:
    return V - V.mean(2, keepdim=True)


def _best_bases(model: LinearModel, seen: Observations, posterior: Posterior, sigma: float, penalty: float) -> Tensor:
    """The bases (K+1,3,P) of the highest expected likelihood minus penalty, one linear system a point.

    The translation of a frame with hidden points moves with its code: t = -R (mean of the visible points of V) (1, c).
    """
    bases, _, points = model.V.shape
    size, R, E, Q = 3 * bases, model.R[:, :2], posterior.second, _planes(model.R)
    right = torch.einsum("fk,fip->kip", with_one(posterior.mean), R.transpose(1, 2) @ seen.W).reshape(size, points)
    ridge = (2 * penalty / (3 * points) * sigma**2 * len(seen) + _RIDGE) * torch.eye(size, dtype=right.dtype)
    visible = seen.visible.double()
    if not seen.complete:
        middle = torch.einsum("fp,kip->fki", visible / seen.count[:, None], model.V)
        right = right + (E @ middle @ Q).reshape(-1, size).T @ visible
    weights = (visible[:, :1] if seen.complete else visible)[..., None] * Q.flatten(1)[:, None]
    left = (weights.flatten(1).T @ E.flatten(1)).view(-1, 3, 3, bases, bases)
    left = left.permute(0, 3, 1, 4, 2).reshape(-1, size, size) + ridge
    # One system for all points, or one a point.
    flat = torch.linalg.solve(left[0], right) if seen.complete else torch.linalg.solve(left, right.T).T
    return _centred(flat.reshape(bases, 3, points))


def _whitened(V: Tensor, posterior: Posterior) -> Tensor:
    """Bases (K+1,3,P) under which the codes have mean 0 and covariance I."""
    mean = posterior.mean.mean(0)
    covariance = posterior.second[:, 1:, 1:].mean(0) - torch.outer(mean, mean)
    root = torch.linalg.cholesky(covariance + _RIDGE * torch.eye(len(mean), dtype=mean.dtype))
    return torch.cat([V[:1] + torch.tensordot(mean, V[1:], 1), torch.tensordot(root.T, V[1:], 1)])
