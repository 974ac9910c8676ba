# SPDX-License-Identifier: Apache-2.0
"""Second moments of bases and frames: likelihoods, codes and best cameras of the linear model follow from them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from paul_ros import viewing_sphere
from training.start.observations import Observations

RIDGE = 1e-9
"""Added to the diagonal of matrices that may be singular."""


@dataclass(frozen=True)
class Posterior:
    """Gaussian posterior of the codes of frames.

    Attributes:
        mean: (F,K) of the codes.
        covariance: (F,K,K) of the codes.
        nll: (F,) negative log likelihoods of the frames.
    """

    mean: Tensor
    covariance: Tensor
    nll: Tensor

    @cached_property
    def second(self) -> Tensor:
        """(F,K+1,K+1) expected products of the extended codes (1, c)."""
        c = with_one(self.mean)
        E = c[:, :, None] * c[:, None]
        E[:, 1:, 1:] += self.covariance
        return E


class Moments(ABC):
    """Products of the bases with each other and with the frames; cameras and codes depend on nothing else.

    There are two kinds. Without hidden points all frames share the products of the bases; else each has its own.
    """

    def __init__(self, seen: Observations, V: Tensor) -> None:
        self.seen, self.V, self.bases = seen, V, len(V)
        # (F,2,K+1,3): image axes by coordinates of the bases.
        self.cross = (seen.W.flatten(0, 1) @ V.flatten(0, 1).T).unflatten(0, (-1, 2)).unflatten(2, (-1, 3))

    @staticmethod
    def of(seen: Observations, V: Tensor) -> Moments:
        """Return the moments of bases V (K+1,3,P)."""
        return (_SharedMoments if seen.complete else _OwnMoments)(seen, V)

    @abstractmethod
    def gram(self, R: Tensor) -> Tensor:
        """Return products (F,K+1,K+1) of the bases as cameras R (F,3,3) see them."""

    @abstractmethod
    def scores(self, R: Tensor, sigma: float) -> Tensor:
        """Return negative log likelihoods (N,F) of all frames under each of the cameras R (N,3,3)."""

    @abstractmethod
    def spread(self, posterior: Posterior) -> Tensor:
        """Return expected products (F,3,3) of the coordinates of the shapes."""

    @abstractmethod
    def beside(self, code: Tensor) -> Tensor:
        """Return products (F,3,K+1,3) of the coordinates of bases (axes 1, 2) and of the shapes of codes (axis 3).

        Args:
            code: (F,K+1) extended codes.
        """

    def posterior(self, R: Tensor, sigma: float) -> Posterior:
        """Return codes and likelihoods of frames that cameras R (F,3,3) see."""
        H, h, rest = self._system(self.gram(R), R, sigma)
        inverse, log_det = _inverse(H)
        mean = (inverse @ h[..., None])[..., 0]
        return Posterior(mean, sigma**2 * inverse, self._nll(log_det, rest - (h * mean).sum(1), sigma))

    def marginal_nll(self, R: Tensor, sigma: float) -> Tensor:
        """Return negative log likelihoods (F,) with the cameras integrated out about R; for autograd.

        At the best camera alone the likelihood favours models that bend a body where it turns. Integrating over small
        turns (Laplace's method) adds half the log determinant of J, the curvature of the likelihood in the turn.

        Gradients of factorisations are slow and not needed. A quadratic form at its optimum has the gradient of the
        form with the optimum held fixed. One Newton step there carries the gradient of the optimum itself.
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
        # Points on one line leave the turn about it open: the ridge exceeds rounding at any noise.
        ridge = RIDGE * (1 + J.diagonal(dim1=1, dim2=2).sum(1))
        J = J + ridge[:, None, None] * torch.eye(3, dtype=J.dtype)
        return self._nll(log_det, misfit, sigma) + 0.5 * torch.logdet(J)

    def best_rotations(self, posterior: Posterior) -> Tensor:
        """Return the cameras (F,3,3) of highest expected likelihood: exact orthographic-N-point on expected moments."""
        A = self.spread(posterior)
        B = torch.einsum("fk,faki->fai", with_one(posterior.mean), self.cross)
        upper = torch.cat([(A + A.transpose(1, 2)) / 2, B.transpose(1, 2)], 2)
        moments = torch.cat([upper, torch.cat([B, self.seen.products], 2)], 1).numpy()
        poses = viewing_sphere.solve(moments, np.zeros((len(moments), 5)), "unit", rivals=False)
        return torch.from_numpy(poses.R[:, 0])

    def _system(self, G: Tensor, R: Tensor, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the system of the codes, H (F,K,K) and h (F,K), and the squared residual (F,) of the mean shape."""
        along = torch.einsum("fai,faki->fk", R[:, :2], self.cross)
        H = G[:, 1:, 1:] + sigma**2 * torch.eye(self.bases - 1, dtype=G.dtype)
        return H, along[:, 1:] - G[:, 0, 1:], self.seen.power - 2 * along[:, 0] + G[:, 0, 0]

    def _nll(self, log_det: Tensor, misfit: Tensor, sigma: float) -> Tensor:
        freedom = 2 * self.seen.count - 2 - (self.bases - 1)
        return 0.5 * (freedom * math.log(sigma**2) + log_det + misfit / sigma**2)

    def _turning(self, R: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
        """Return products of the image motions T (2P each) for turns of the camera about its axes.

        T_x = (0, -z), T_y = (z, 0), T_z = (-y, x). Products with each other are (F,3,3), with the bases (F,K,3).
        """
        c = with_one(code)
        # D (F,3,K+1,3): camera coordinates of the bases by those of the shape. C: of the shape by itself.
        half = (R @ self.beside(c).flatten(2)).unflatten(2, (-1, 3)).flatten(1, 2)
        D = (half @ R.transpose(1, 2)).unflatten(1, (3, -1))
        C = torch.einsum("fk,fakb->fab", c, D)
        zero = torch.zeros(len(c), dtype=C.dtype)
        xx, yy, zz, xz, yz = C[:, 0, 0], C[:, 1, 1], C[:, 2, 2], C[:, 0, 2], C[:, 1, 2]
        own = torch.stack([zz, zero, -xz, zero, zz, -yz, -xz, -yz, xx + yy], 1).view(-1, 3, 3)
        x, y = D[:, 0, 1:], D[:, 1, 1:]
        return own, torch.stack([-y[..., 2], x[..., 2], y[..., 0] - x[..., 1]], 2)


class _SharedMoments(Moments):
    """Moments of frames without hidden points; their size does not depend on the number of points."""

    def __init__(self, seen: Observations, V: Tensor) -> None:
        super().__init__(seen, V)
        flat = centred(V).flatten(0, 1)
        # (K+1,3,K+1,3)
        self._blocks = (flat @ flat.T).unflatten(1, (-1, 3)).unflatten(0, (-1, 3))

    @cached_property
    def _by_axes(self) -> Tensor:
        """(9,(K+1)^2) products of coordinates i and j of bases k and l, at [3 i + j, (K+1) k + l]."""
        return self._blocks.permute(1, 3, 0, 2).reshape(9, -1)

    def gram(self, R: Tensor) -> Tensor:
        return (image_plane_projections(R).flatten(1) @ self._by_axes).unflatten(1, (self.bases, self.bases))

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
    """Moments of frames with hidden points.

    Images of the bases are computed on every call: the products of each frame would need more memory.
    """

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
        """Return ``gram`` of all frames for one camera R (3,3)."""
        images, sums = R[:2] @ self.V, self._sums @ R[:2].T
        pairs = torch.einsum("kap,lap->klp", images, images).flatten(0, 1)
        G = (self._pattern @ pairs.T).unflatten(1, (self.bases, self.bases))
        return G - sums @ sums.transpose(1, 2) / self.seen.count[:, None, None]


def with_one(code: Tensor) -> Tensor:
    """Extend codes (F,K) to (1, c) (F,K+1)."""
    return torch.cat([torch.ones_like(code[:, :1]) if code.shape[1] else code.new_ones(len(code), 1), code], 1)


def image_plane_projections(R: Tensor) -> Tensor:
    """Return projections (N,3,3) onto the image planes of cameras (N,3,3)."""
    return R[:, :2].transpose(1, 2) @ R[:, :2]


def _inverse(H: Tensor) -> tuple[Tensor, Tensor]:
    """Return inverses and log determinants of positive definite matrices (N,K,K)."""
    L = torch.linalg.cholesky(H)
    return torch.cholesky_inverse(L), _log_det(L)


def _log_det(L: Tensor) -> Tensor:
    """Return log determinants (N,) of matrices from their Cholesky factors (N,K,K)."""
    return 2 * L.diagonal(dim1=1, dim2=2).log().sum(1)


def centred(V: Tensor) -> Tensor:
    """Return bases (K+1,3,P) minus the mean of their points."""
    return V - V.mean(2, keepdim=True)
