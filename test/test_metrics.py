# SPDX-License-Identifier: Apache-2.0
"""Error measures against cases whose value is known by construction."""

import numpy as np
from scipy.spatial.transform import Rotation

from paul_ros import metrics


def shapes(count=5, points=9, seed=0):
    return np.random.default_rng(seed).standard_normal((count, points, 3))


def test_position_never_matters():
    truth = shapes()
    for measure in (metrics.mpjpe, metrics.n_mpjpe, metrics.pa_mpjpe, metrics.normalised_error):
        np.testing.assert_allclose(measure(truth + [5.0, -3.0, 100.0], truth), 0, atol=1e-9)


def test_n_mpjpe_forgives_scale_and_nothing_else():
    truth = shapes()
    turned = truth @ Rotation.from_euler("y", 20, degrees=True).as_matrix().T
    np.testing.assert_allclose(metrics.n_mpjpe(7 * truth, truth), 0, atol=1e-9)
    assert (metrics.n_mpjpe(turned, truth) > 0.05).all()
    assert (metrics.mpjpe(7 * truth, truth) > 1).all()


def test_pa_mpjpe_forgives_similarity_but_no_reflection():
    truth = shapes()
    turned = 0.3 * truth @ Rotation.random(random_state=1).as_matrix().T + 4
    np.testing.assert_allclose(metrics.pa_mpjpe(turned, truth), 0, atol=1e-9)
    assert (metrics.pa_mpjpe(metrics.flip_depth(truth), truth) > 0.1).all()


def test_normalised_error_of_a_known_offset():
    truth = shapes()
    truth -= truth.mean(1, keepdims=True)
    np.testing.assert_allclose(metrics.normalised_error(1.1 * truth, truth), 0.1)


def test_flip_per_frame_and_flip_for_all_tell_mixed_signs_apart():
    truth = shapes(count=10)
    mixed = truth.copy()
    mixed[:4] = metrics.flip_depth(truth[:4])
    np.testing.assert_allclose(metrics.normalised_error_flip_frame(mixed, truth), 0, atol=1e-12)
    wrong = metrics.normalised_error_flip_global(mixed, truth) > 0.1
    np.testing.assert_array_equal(wrong, np.arange(10) < 4)
    np.testing.assert_allclose(metrics.normalised_error_flip_global(metrics.flip_depth(truth), truth), 0, atol=1e-12)
