# SPDX-License-Identifier: Apache-2.0
"""One mirror image for all frames, from 2D alone.

An orthographic view fits a shape and its mirror image alike. If cameras and poses vary much, each region of pose space
is right up to a mirror image, and regions disagree. Two frames of similar poses show whether they agree: each is nearer
to the other, or to the other's mirror image. Frames are therefore clustered by similarity up to mirroring, and signs
made equal within each cluster. Then whole clusters are flipped if the shapes need fewer principal directions
afterwards. A linear model refitted to the views decides whether the flips were right.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from training.progress import Progress
from training.start.linear_model import LinearModel
from training.start.observations import Observations

_AGREEING = 0.995
"""Agreement of nearest neighbours above which nothing is done. Measured: 1.00 on sequences of one camera path, 0.98 if
a third of the frames is mirrored."""

_FLAT = 1e-4
_TINY = 1e-100  # smallest divisor; its cube is not yet rounded to zero
_ROUNDS = 4
_STAGES = ((5, 24), (6, 24), (6, 48), (8, 48))
"""Principal directions and clusters of each stage of a round. Few directions help far from the solution; many have room
for mixtures of shapes and mirror images."""
_SWEEPS = 3
_LEAST_CLUSTER = 8  # frames, on average
_NEIGHBOURS = 10
_BASES = 12
_REFIT = ((0.1, 40), (0.05, 40))  # sigma and L-BFGS iterations
_REBUILT = ((0.05, 40), (0.03, 40))
_MEAN_ROUNDS = 10


def mirrored(X: Tensor) -> Tensor:
    """Reverse the depths of shapes (F,3,P), which leaves their views as they are."""
    return X * X.new_tensor([1.0, 1.0, -1.0])[:, None]


def likeness(X: Tensor, Y: Tensor) -> tuple[Tensor, Tensor]:
    """Compare shapes (M,3,P) with shapes (N,3,P) under the best rotation.

    Let a >= b >= c be the singular values of X Y^T, divided by the norms of X and Y. The best rotation correlates two
    shapes by a + b +- c, + if the determinant is positive. It correlates one with the other's mirror image by
    a + b -+ c.

    Args:
        X: (M,3,P) shapes, centred on all their points.
        Y: (N,3,P) likewise.

    Returns:
        Similarity up to mirroring a + b + c (M,N), 1 for equal shapes and for mirror images; and agreement +- c (M,N),
        positive for shapes that show the same mirror image.
    """
    X, Y = (S / S.flatten(1).norm(dim=1).clamp_min(_TINY)[:, None, None] for S in (X, Y))
    M = torch.einsum("mip,njp->mnij", X, Y)
    squares = _eigenvalues(M.transpose(2, 3) @ M).clamp_min(0).sqrt()
    return squares.sum(2), torch.linalg.det(M).sign() * squares[..., 2]


def _eigenvalues(A: Tensor) -> Tensor:
    """Return eigenvalues (...,3) of symmetric 3x3 matrices, descending, in closed form (Smith, 1961)."""
    middle = A.diagonal(dim1=-2, dim2=-1).mean(-1)
    B = A - middle[..., None, None] * torch.eye(3, dtype=A.dtype)
    spread = (B.square().sum((-2, -1)) / 6).sqrt().clamp_min(_TINY)
    angle = (torch.linalg.det(B) / (2 * spread**3)).clamp(-1, 1).acos() / 3
    turns = torch.tensor([0.0, -2 * math.pi / 3, 2 * math.pi / 3], dtype=A.dtype)
    return (middle[..., None] + 2 * spread[..., None] * (angle[..., None] + turns).cos()).sort(-1, True).values


def aligned(X: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate shapes (F,3,P) onto their common mean (generalised Procrustes); return them and the rotations (F,3,3)."""
    mean = X[0]
    for _ in range(_MEAN_ROUNDS):
        R = _onto(X, mean)
        mean = (R @ X).mean(0)
    R = _onto(X, mean)
    return R @ X, R


def _onto(X: Tensor, mean: Tensor) -> Tensor:
    """Return the rotations (F,3,3) of shapes (F,3,P) onto one shape (3,P) (Kabsch)."""
    U, _, V = torch.linalg.svd(mean @ X.transpose(1, 2))
    sign = torch.linalg.det(U @ V)
    U = torch.cat([U[:, :, :2], U[:, :, 2:] * sign[:, None, None]], 2)
    return U @ V


def fitted(X: Tensor, seen: Observations, bases: int, stages: tuple) -> LinearModel:
    """Return the linear model of shapes (F,3,P) in camera frame, polished on the views.

    Args:
        X: (F,3,P) shapes, camera frame.
        seen: the views.
        bases: K of the model.
        stages: sigma and L-BFGS iterations of each.
    """
    canonical, A = aligned(X)
    mean = canonical.mean(0)
    _, size, V = torch.linalg.svd((canonical - mean).flatten(1), full_matrices=False)
    V = (V[:bases] * size[:bases, None] / len(X) ** 0.5).unflatten(1, (3, -1))
    model = LinearModel(torch.cat([mean[None], V]), A.transpose(1, 2))
    for sigma, iterations in stages:
        model = model.polished(seen, sigma, 0.0, iterations)
    return model


def agreeing_share(X: Tensor) -> float:
    """Return how far nearest neighbours of shapes (F,3,P) show one mirror image, 0 to 1; flat shapes hardly count."""
    close, sign = likeness(X, X)
    nearest = close.fill_diagonal_(-1.0).topk(min(3, len(X) - 1), dim=1).indices
    sign = torch.gather(sign, 1, nearest)
    total = sign.abs().sum()
    return float(sign.clamp_min(0).sum() / total) if total > _FLAT * sign.numel() else 1.0


def synchronised(
    model: LinearModel, seen: Observations, generator: np.random.Generator, progress: Progress
) -> LinearModel:
    """Return a model whose frames show one mirror image; a model that already has that is returned as it is.

    After every round of flips the model is refitted to the views. With few frames or extreme poses neighbours say
    little, even at the truth. A round that makes the views less likely is therefore taken back.
    """
    X = _shapes(model, seen)
    if agreeing_share(X) >= _AGREEING:
        return model
    bases, (sigma, _) = len(model.V) - 1, _REBUILT[-1]
    least = _settled(model, seen).objective(seen, sigma, 0.0)
    for number in range(_ROUNDS):
        advance = partial(_advance_round, progress, number)
        for stage, (directions, clusters) in enumerate(_STAGES):
            X = flipped(X, directions, clusters, generator)
            advance((stage + 1) / (len(_STAGES) + 1))
        other = _rebuilt(X, seen, min(_BASES, bases), bases, generator)
        if (found := other.objective(seen, sigma, 0.0)) < least:
            model, least = other, found
        X = _shapes(model, seen)
    return model


def _advance_round(progress: Progress, number: int, done: float) -> None:
    progress((number + done) / _ROUNDS)


def _rebuilt(X: Tensor, seen: Observations, few: int, bases: int, generator: np.random.Generator) -> LinearModel:
    """Return the model of shapes (F,3,P) in camera frame; a search with few bases first finds its cameras."""
    model = fitted(X, seen, few, _REFIT).searched(seen, _REFIT[-1][0], generator).widened(bases, generator)
    return _settled(model, seen)


def _settled(model: LinearModel, seen: Observations) -> LinearModel:
    for sigma, iterations in _REBUILT:
        model = model.polished(seen, sigma, 0.0, iterations)
    return model


def _shapes(model: LinearModel, seen: Observations) -> Tensor:
    """Return shapes (F,3,P) in camera frame with observed x and y.

    They are centred on all points: shapes centred on different visible points could not be compared.
    """
    X = seen.completed(model.in_camera(seen, _REBUILT[-1][0]))
    return X - X.mean(2, keepdim=True)


def flipped(X: Tensor, directions: int, clusters: int, generator: np.random.Generator) -> Tensor:
    """Mirror clusters of shapes if that lowers their energy (``energy_outside``).

    Args:
        X: (F,3,P) shapes, camera frame.
        directions: number of principal directions whose content is no energy.
        clusters: largest number of clusters.
        generator: of the order in which clusters are tried.

    Returns:
        Shapes (F,3,P).
    """
    clusters = min(clusters, max(2, len(X) // _LEAST_CLUSTER))
    close, sign = likeness(X, X)
    labels = _clusters(close, clusters, generator)
    X = _agreeing(X, close, sign, labels)
    least = energy_outside(X, directions)
    for _ in range(_SWEEPS):
        before = least
        for cluster in generator.permutation(labels.unique().numpy()):
            other = torch.where((labels == cluster)[:, None, None], mirrored(X), X)
            if (found := energy_outside(other, directions)) < least:
                X, least = other, found
        if least == before:
            break
    return X


def energy_outside(X: Tensor, directions: int) -> float:
    """Return the mean squared size of shapes (F,3,P), rotated onto their mean, outside some principal directions.

    A mixture of shapes and mirror images needs more directions than the shapes alone.
    """
    canonical, _ = aligned(X)
    D = (canonical - canonical.mean(0)).flatten(1)
    gram = D.T @ D if D.shape[1] < len(D) else D @ D.T
    return float(torch.linalg.eigvalsh(gram / len(D))[: -directions or None].sum())


def _clusters(close: Tensor, count: int, generator: np.random.Generator) -> Tensor:
    """Return cluster numbers (F,) by similarity (F,F): spectral embedding of nearest neighbours, then k-means."""
    frames = len(close)
    near = close.topk(min(_NEIGHBOURS + 1, frames), dim=1)
    distance = (1 - near.values).clamp_min(0)  # rounding makes it negative for points on one line
    scale = distance[:, -1].median().clamp_min(1e-12)
    W = torch.zeros_like(close).scatter_(1, near.indices, (-distance / scale).exp())
    W = W + W.T
    root = W.sum(1).rsqrt()
    _, vectors = torch.linalg.eigh(root[:, None] * W * root)
    embedding = torch.nn.functional.normalize(vectors[:, -count:], dim=1)
    return _k_means(embedding, count, generator)


def _k_means(points: Tensor, count: int, generator: np.random.Generator) -> Tensor:
    centres = points[_spread_out(points, count, generator)]
    for _ in range(50):
        labels = torch.cdist(points, centres).argmin(1)
        member = torch.nn.functional.one_hot(labels, count).to(points)
        centres = member.T @ points / member.sum(0)[:, None].clamp_min(1)
    return labels


def _spread_out(points: Tensor, count: int, generator: np.random.Generator) -> list[int]:
    """Choose starts of k-means, each the farthest from those before."""
    chosen = [int(generator.integers(len(points)))]
    distance = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[chosen[-1]]).norm(dim=1))
    return chosen


def _agreeing(X: Tensor, close: Tensor, sign: Tensor, labels: Tensor) -> Tensor:
    """Give each cluster one mirror image, by the leading eigenvector of its weighted agreements."""
    X = X.clone()
    for cluster in range(int(labels.max()) + 1):
        rows = (labels == cluster).nonzero()[:, 0]
        if len(rows) < 2:
            continue
        _, vectors = torch.linalg.eigh(sign[rows][:, rows] * close[rows][:, rows] ** 8)
        wrong = rows[vectors[:, -1] * vectors[:, -1].sum() < 0]
        X[wrong] = mirrored(X[wrong])
    return X
