# SPDX-License-Identifier: Apache-2.0
"""Folders of motion capture: formats, skeletons, arrays of joints."""

from __future__ import annotations

import numpy as np
import pytest
from test_asf_amc import make_archive
from test_bvh import bvh

from training.errors import MocapError
from training.people.clips import motion_files, read_clips


@pytest.fixture
def archive(tmp_path):
    return make_archive(tmp_path)


def test_a_folder_is_searched_for_all_formats(archive):
    root, folder, body = archive
    (root / "deep" / "down").mkdir(parents=True)
    (root / "deep" / "down" / "09_01.bvh").write_text(bvh()[0])
    (root / "deep" / "07_03.bvh").write_text(bvh()[0])
    np.savez(root / "more.npz", S_root=np.tile(body.joints(0), (3, 1, 1)), seq_names=["walking_1"], seq_len=[3])
    clips = dict(read_clips(root))
    assert sorted(clips) == ["07_03", "09_01", "walking_1"] and len(motion_files(root)) == 4
    np.testing.assert_allclose(clips["07_03"][1], body.joints(1), atol=2e-5)  # the .amc, not the .bvh
    assert len(clips["walking_1"]) == 3


def test_a_skeleton_is_found_beside_its_motions(archive):
    root, folder, _ = archive
    (folder / "07.asf").rename(folder / "any.asf")
    assert [name for name, _ in read_clips(root)] == ["07_03"]
    (folder / "any.asf").unlink()
    with pytest.raises(MocapError, match="no 07.asf beside it"):
        read_clips(root)


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({"W": np.zeros(3)}, "no array S_root"),
        ({"S_world": np.zeros((3, 17, 3)), "trial_names": ["a"], "trial_len": [3]}, r"must be numbers \(F,31,3\)"),
        ({"S_world": np.ones((3, 31, 3)), "trial_names": ["a"], "trial_len": [4]}, "trial_len must be the frames"),
        ({"S_world": np.ones((3, 31, 3)), "trial_names": ["a"], "trial_len": [3]}, "a thigh is 0 m long"),
        ({"S_world": np.full((3, 31, 3), np.nan), "trial_names": ["a"], "trial_len": [3]}, "NaN"),
    ],
)
def test_wrong_arrays_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(MocapError, match=message):
        read_clips(tmp_path)


def test_the_error_of_an_empty_folder_names_the_formats(tmp_path):
    (tmp_path / "x.npz").write_bytes(b"no npz")
    with pytest.raises(MocapError, match="x.npz: .*is no npz"):
        read_clips(tmp_path)
    (tmp_path / "x.npz").unlink()
    with pytest.raises(MocapError, match="holds no motion capture: neither .amc"):
        read_clips(tmp_path)
