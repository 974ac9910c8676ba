# SPDX-License-Identifier: Apache-2.0
"""The synthetic dense body: it moves, its bones do not bend, cameras are rotations, seeds fix all."""

import subprocess
import sys

import numpy as np
import pytest

from training.judge.synthetic import _BONES, _skin, _surface, articulated_mesh, mesh_edges
from training.loading import load_training_data


def test_the_same_seed_gives_the_same_body():
    S = articulated_mesh(300, 20, seed=1)
    assert S.shape == (20, 3, 300) and S.dtype == np.float32
    np.testing.assert_array_equal(S, articulated_mesh(300, 20, seed=1))
    assert np.abs(S - articulated_mesh(300, 20, seed=2)).max() > 0.1
    np.testing.assert_allclose(S.mean(2), 0, atol=1e-6)


@pytest.mark.parametrize("points", [10, 299, 1000])
def test_there_are_as_many_points_as_asked_for(points):
    assert articulated_mesh(points, 2).shape == (2, 3, points)


def test_bones_keep_their_shape_and_joints_bend():
    S = articulated_mesh(1500, 12).astype(float)
    weight = _skin(1500).reshape(1500, len(_BONES), 4)[:, :, 3]
    np.testing.assert_allclose(weight.sum(1), 1, atol=1e-6)
    stiff = [np.flatnonzero(weight[:, bone] > 0.999) for bone in range(len(_BONES))]
    assert sum(len(points) > 20 for points in stiff) >= 5
    rest = _surface(1500).T
    for points in filter(len, stiff):
        gap = np.linalg.norm(S[:, :, points[:1]] - S[:, :, points], axis=1)
        still = np.linalg.norm(rest[:, points[:1]] - rest[:, points], axis=0)
        np.testing.assert_allclose(gap, np.broadcast_to(still, gap.shape), atol=5e-3)
    hands = np.linalg.norm(S[:, :, stiff[3][-1]] - S[:, :, stiff[5][-1]], axis=1)
    assert np.ptp(hands) > 0.1


def test_no_view_is_a_mirror_image():
    """A rotation takes the trunk of every frame to the trunk at rest; none takes it to the mirror image."""
    trunk = np.flatnonzero(_skin(1500).reshape(1500, len(_BONES), 4)[:, 0, 3] > 0.999)
    rest = _surface(1500).T[:, trunk]
    S = articulated_mesh(1500, 50)[:, :, trunk].astype(float)
    turned = (S - S.mean(2, keepdims=True)) @ (rest - rest.mean(1, keepdims=True)).T
    assert (np.linalg.det(turned) > 0).all()


def test_cameras_look_from_everywhere():
    trunk = articulated_mesh(400, 2000)[:, :, :30].astype(float)
    up = np.linalg.svd(trunk - trunk.mean(2, keepdims=True))[0][:, :, 0]
    second = np.einsum("fi,fj->ij", up, up) / len(up)
    np.testing.assert_allclose(second, np.eye(3) / 3, atol=0.04)


def test_edges_join_near_points_once():
    edges = mesh_edges(600)
    assert (edges[:, 0] < edges[:, 1]).all() and len(np.unique(edges, axis=0)) == len(edges)
    rest = _surface(600)
    lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    assert lengths.max() < 0.2 and set(edges.ravel()) == set(range(600))
    distance = np.linalg.norm(rest[:, None] - rest[None], axis=2) + 9 * np.eye(600)
    found = {tuple(edge) for edge in edges.tolist()}
    assert all(tuple(sorted((a, int(b)))) in found for a, b in enumerate(distance.argmin(1)))


def test_the_file_can_be_trained_on_and_holds_truth_only_if_asked(tmp_path):
    command = [
        sys.executable,
        "-m",
        "training.judge.synthetic",
        "-o",
        str(tmp_path / "m.npz"),
        "--points",
        "90",
        "--frames",
        "7",
    ]
    subprocess.run(command, check=True)
    assert set(np.load(tmp_path / "m.npz").files) == {"W", "edges"}
    data = load_training_data(tmp_path / "m.npz")
    assert data.W.shape == (7, 2, 90) and len(data.layout.edges) == len(mesh_edges(90))
    np.testing.assert_array_equal(data.W, articulated_mesh(90, 7)[:, :2])
