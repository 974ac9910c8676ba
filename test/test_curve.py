# SPDX-License-Identifier: Apache-2.0
"""``benchmarks/curve.py``: errors during training, the start from the truth, and resuming."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_data import sequence

SCRIPT = Path(__file__).resolve().parent.parent / "benchmarks" / "curve.py"
SETTINGS = {
    **{"bottleneck": 3, "hidden": "[8, 16]", "width": 16, "blocks": 1, "batch": 8, "hold": 5, "generations": 1},
    **{"regression_steps": 10, "steps": 10},
}


@pytest.fixture
def curve():
    torch.set_num_threads(1)
    spec = importlib.util.spec_from_file_location("curve", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_true_start_explains_the_views(curve):
    _, camera, _ = sequence(bend=0.0)
    start = curve.true_start(camera, 10.0)
    np.testing.assert_allclose(10 * start.rotations @ start.shapes, camera - camera.mean(2, keepdims=True), atol=1e-3)
    np.testing.assert_allclose(start.shapes, start.shapes[:1].repeat(40, 0), atol=1e-4)


def test_errors_on_the_way_from_the_truth(curve, tmp_path, monkeypatch, capsys):
    data, camera, _ = sequence()
    np.savez(tmp_path / "d.npz", W=data.W, S=camera)
    overrides = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    words = ["curve.py", str(tmp_path / "d.npz"), "--unseen", str(tmp_path / "d.npz"), "-o", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", [*words, "--starts", "truth", "--every", "8", *overrides])
    curve.main()
    rows = json.loads((tmp_path / "out" / "curve.json").read_text())["truth"]
    assert [row["step"] for row in rows] == [8, 16, 20] and "as predicted" in capsys.readouterr().out
    for part in ("train", "unseen"):
        assert all(row[part]["observed_flip_frame"] <= row[part]["observed_flip_global"] < 100 for row in rows)
        assert all(row[part]["observed_flip_frame"] < row[part]["predicted_flip_frame"] for row in rows)
    assert (tmp_path / "out" / "curve.png").read_bytes().startswith(b"\x89PNG")
    curve.main()
    assert json.loads((tmp_path / "out" / "curve.json").read_text())["truth"] == rows
