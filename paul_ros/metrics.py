# SPDX-License-Identifier: Apache-2.0
"""Error measures of the lifting and NRSfM literature, each under its exact name.

All take predictions and ground truth as points (N,P,3) in the camera frame, in equal units. They return errors (N,),
one a shape, in those units; NE is a ratio. Both sets are first centred on their mean, so no measure sees absolute
position.

>>> import numpy as np
>>> truth = np.random.default_rng(0).standard_normal((1, 17, 3))
>>> mpjpe(truth + 1.0, truth).round(6), n_mpjpe(2.0 * truth, truth).round(6)
(array([0.]), array([0.]))
"""

from __future__ import annotations

import numpy as np


def _centred(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, float)
    return points - points.mean(1, keepdims=True)


def _mean_distance(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(predicted - truth, axis=2).mean(1)


def flip_depth(points: np.ndarray) -> np.ndarray:
    """Mirror points (N,P,3) in depth; an orthographic camera cannot distinguish the result from the input."""
    return points * np.array([1.0, 1.0, -1.0])


def mpjpe(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the mean per-joint position error: centred, but neither scaled nor rotated nor flipped."""
    return _mean_distance(_centred(predicted), _centred(truth))


def mpjpe_flip_frame(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the MPJPE of C3DPO (Novotny et al., ICCV 2019): the better of the original and the depth-flipped shape.

    C3DPO removes the mean depth only. Here x and y are centred too, which changes nothing if all points are seen,
    because a fitted prediction is centred already.
    """
    return np.minimum(mpjpe(predicted, truth), mpjpe(flip_depth(predicted), truth))


def n_mpjpe(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the MPJPE after least-squares scaling of every prediction (Rhodin et al., CVPR 2018); no flip."""
    predicted, truth = _centred(predicted), _centred(truth)
    power = np.einsum("npi,npi->n", predicted, predicted)
    scale = np.einsum("npi,npi->n", predicted, truth) / np.maximum(power, np.finfo(float).tiny)
    return _mean_distance(scale[:, None, None] * predicted, truth)


def pa_mpjpe(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the MPJPE after similarity Procrustes alignment of every prediction; rotations only, no reflection."""
    predicted, truth = _centred(predicted), _centred(truth)
    R, scale = procrustes(predicted, truth)
    return _mean_distance(scale[:, None, None] * np.einsum("nij,npj->npi", R, predicted), truth)


def fill_absent(points: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Replace absent points by the mean of the present ones.

    If this is done to prediction and truth alike, an absent point moves no centre and has no error. A mean over P
    points must then be divided by ``present.mean(1)``.

    Args:
        points: (N,P,3), any value where absent.
        present: (N,P) bool.
    """
    inside = present[..., None]
    mean = np.where(inside, points, 0.0).sum(1, keepdims=True) / np.maximum(present.sum(1), 1)[:, None, None]
    return np.where(inside, points, mean)


def procrustes(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Align centred points (N,P,3) to a target by rotation and scale.

    Returns:
        Rotations (N,3,3) with det +1 and scales (N,) that minimise the squared distances to the target.
    """
    U, singular, Vt = np.linalg.svd(np.einsum("npi,npj->nij", target, source))
    sign = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= sign[:, None]
    singular[:, 2] *= sign
    power = np.einsum("npi,npi->n", source, source)
    return U @ Vt, singular.sum(1) / np.maximum(power, np.finfo(float).tiny)


def normalised_error(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return NE without any flip: |S_pred - S_gt|_F / |S_gt|_F of centred shapes (PND, Lee et al., CVPR 2013; PAUL)."""
    predicted, truth = _centred(predicted), _centred(truth)
    return np.linalg.norm(predicted - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))


def normalised_error_o3(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the error of Deep NRSfM (Kong and Lucey, ICCV 2019): NE after scaling and O(3) alignment.

    Predictions are scaled to the truth's norm. Reflections are allowed, so this error ignores mirrored frames and
    wrong cameras, and is far milder than NE.
    """
    predicted, truth = _centred(predicted), _centred(truth)
    size = np.linalg.norm(truth, axis=(1, 2), keepdims=True)
    norm = np.linalg.norm(predicted, axis=(1, 2), keepdims=True)
    predicted = predicted * size / np.maximum(norm, np.finfo(float).tiny)
    U, _, Vt = np.linalg.svd(np.einsum("npi,npj->nij", truth, predicted))
    aligned = np.einsum("nij,npj->npi", U @ Vt, predicted)
    return np.linalg.norm(aligned - truth, axis=(1, 2)) / size[:, 0, 0]


def normalised_error_of_signs(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return NE (N,2) of every prediction as it is and with its depth flipped."""
    return np.stack([normalised_error(points, truth) for points in (predicted, flip_depth(predicted))], axis=1)


def normalised_error_flip_frame(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return NE with the depth of every single prediction flipped if that lowers its error."""
    return normalised_error_of_signs(predicted, truth).min(1)


def normalised_error_flip_global(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return NE with one flip for the whole set, the one with the lower mean; it exposes mixed mirror signs."""
    signs = normalised_error_of_signs(predicted, truth)
    return signs[:, signs.mean(0).argmin()]


def flipped_share(signs: np.ndarray) -> float:
    """Return the share of frames that are mirrored against the rest, 0 to 0.5.

    An orthographic camera leaves open which of its two mirror images a whole set is, so the rarer sign counts.

    Args:
        signs: (N,2) NE of both signs, from ``normalised_error_of_signs``.
    """
    flipped = (signs[:, 1] < signs[:, 0]).mean()
    return float(min(flipped, 1 - flipped))
