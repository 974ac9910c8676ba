# SPDX-License-Identifier: Apache-2.0
"""Error measures of the lifting and NRSfM literature, each under its exact name.

All take predictions and ground truth as points (N,P,3) in the camera frame, equal units, and give (N,) errors, one a
shape, in those units (NE: a ratio).  Both sets are centred on their mean first; none of them sees absolute position.
"""

from __future__ import annotations

import numpy as np


def _centred(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, float)
    return points - points.mean(1, keepdims=True)


def _mean_distance(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(predicted - truth, axis=2).mean(1)


def flip_depth(points: np.ndarray) -> np.ndarray:
    """The points (N,P,3) mirrored in depth: what an orthographic camera cannot tell apart from them."""
    return points * np.array([1.0, 1.0, -1.0])


def mpjpe(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Mean per-joint position error: centred, neither scaled nor rotated nor flipped."""
    return _mean_distance(_centred(predicted), _centred(truth))


def mpjpe_flip_frame(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """MPJPE as in C3DPO (Novotny et al., ICCV 2019): mean depth removed, the better of original and depth-flipped.

    x and y are centred too; where all points are seen a fitted prediction is already, and nothing changes.
    """
    return np.minimum(mpjpe(predicted, truth), mpjpe(flip_depth(predicted), truth))


def n_mpjpe(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """MPJPE after the least-squares scale of every prediction (Rhodin et al., CVPR 2018); no flip."""
    predicted, truth = _centred(predicted), _centred(truth)
    power = np.einsum("npi,npi->n", predicted, predicted)
    scale = np.einsum("npi,npi->n", predicted, truth) / np.maximum(power, np.finfo(float).tiny)
    return _mean_distance(scale[:, None, None] * predicted, truth)


def pa_mpjpe(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """MPJPE after similarity Procrustes alignment of every prediction; rotations only, no reflection."""
    predicted, truth = _centred(predicted), _centred(truth)
    R, scale = procrustes(predicted, truth)
    return _mean_distance(scale[:, None, None] * np.einsum("nij,npj->npi", R, predicted), truth)


def fill_absent(points: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Points (N,P,3) with the mean of a shape's present ones (N,P) in place of the others.

    Done to prediction and truth alike, a point that the truth lacks counts for nothing: it moves no centre and has no
    error. A mean over P points must then be divided by ``present.mean(1)``.
    """
    inside = present[..., None]
    mean = np.where(inside, points, 0.0).sum(1, keepdims=True) / np.maximum(present.sum(1), 1)[:, None, None]
    return np.where(inside, points, mean)


def procrustes(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (N,3,3), det +1, and scale (N,) that best take centred source points (N,P,3) onto the target's."""
    U, singular, Vt = np.linalg.svd(np.einsum("npi,npj->nij", target, source))
    sign = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= sign[:, None]
    singular[:, 2] *= sign
    power = np.einsum("npi,npi->n", source, source)
    return U @ Vt, singular.sum(1) / np.maximum(power, np.finfo(float).tiny)


def normalised_error(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """NE without any flip: |S_pred - S_gt|_F / |S_gt|_F of the centred shapes (PND, Lee et al., CVPR 2013; PAUL)."""
    predicted, truth = _centred(predicted), _centred(truth)
    return np.linalg.norm(predicted - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))


def normalised_error_o3(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Deep NRSfM's error (Kong and Lucey, ICCV 2019): NE after scaling to the truth's norm and O(3) alignment.

    Reflections are allowed, so mirrored frames are forgiven, and so is every wrong camera: far milder than NE.
    """
    predicted, truth = _centred(predicted), _centred(truth)
    size = np.linalg.norm(truth, axis=(1, 2), keepdims=True)
    norm = np.linalg.norm(predicted, axis=(1, 2), keepdims=True)
    predicted = predicted * size / np.maximum(norm, np.finfo(float).tiny)
    U, _, Vt = np.linalg.svd(np.einsum("npi,npj->nij", truth, predicted))
    aligned = np.einsum("nij,npj->npi", U @ Vt, predicted)
    return np.linalg.norm(aligned - truth, axis=(1, 2)) / size[:, 0, 0]


def normalised_error_of_signs(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N,2) NE of every prediction as it is and with its depth flipped."""
    return np.stack([normalised_error(points, truth) for points in (predicted, flip_depth(predicted))], axis=1)


def normalised_error_flip_frame(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """NE, the depth of every single prediction flipped where that lowers its error."""
    return normalised_error_of_signs(predicted, truth).min(1)


def normalised_error_flip_global(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """NE with one flip for the whole set, the one that gives the lower mean: mixed mirror signs show here."""
    signs = normalised_error_of_signs(predicted, truth)
    return signs[:, signs.mean(0).argmin()]


def flipped_share(signs: np.ndarray) -> float:
    """Share of frames mirrored against the rest, 0 to 0.5, from their NE of both signs (N,2).

    Which of the two mirror images a whole set is, is open under an orthographic camera; the rarer sign counts.
    """
    flipped = (signs[:, 1] < signs[:, 0]).mean()
    return float(min(flipped, 1 - flipped))
