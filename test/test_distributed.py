# SPDX-License-Identifier: Apache-2.0
"""Two processes train as one: torchrun on this machine, over gloo."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_data import sequence, true_start

from paul_ros.layout import load_layout
from training.checkpoint import LOG_COLUMNS
from training.distributed import WHOLE, from_first, is_first, share_of
from training.loading import load_training_data
from training.recipe import Recipe
from training.start import search as starting
from training.trainer import Trainer

COCO = load_layout("coco17")
ROOT = Path(__file__).resolve().parent.parent
RECIPE = {
    **{"bottleneck": 3, "hidden": [8, 16], "width": 16, "blocks": 1, "batch": 9, "mirror_object": True},
    "learning_rate": 0.02,
    **{"start": "linear", "regression_steps": 10, "steps": 20, "nuclear_weight": 0.01, "decay_weight": 0.1},
}
TORCHRUN = [
    *("-m", "torch.distributed.run", "--nproc-per-node", "2", "--rdzv-backend", "c10d"),
    *("--rdzv-endpoint", "127.0.0.1:0", "--local-addr", "127.0.0.1"),
]


HELD = {**RECIPE, "hold": 8, "generations": 2}


def train_together(data, model, layout, recipe=RECIPE):
    """``torchrun -m paul_ros.cli train`` with two processes."""
    settings = [word for key, value in recipe.items() for word in ("--set", f"{key}={value}")]
    command = [sys.executable, *TORCHRUN, "-m", "paul_ros.cli", "train", data, "-o", model, "--layout", layout]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    words = [*map(str, command), *settings, "--quiet"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=environment, cwd=data.parent)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("settings, logged", [(RECIPE, [10, 30]), (HELD, [10, 30, 45, 60])], ids=["joint", "held"])
def test_two_processes_train_as_one(tmp_path, monkeypatch, settings, logged):
    """They take up a run of one process, with its start, in the first phase; nine frames a step, so shares differ.

    Bones, handedness and nuclear norm are of the whole batch.
    """
    torch.set_num_threads(1)
    np.savez(tmp_path / "views.npz", W=sequence(layout=COCO)[0].W)
    data, recipe = load_training_data(tmp_path / "views.npz", COCO), Recipe.from_dict(settings)
    monkeypatch.setattr(starting, "search", lambda *given: true_start(*sequence(layout=COCO)))
    one = Trainer(data, recipe, tmp_path / "one.run")
    for row in one.run():
        if row["step"] == 5:
            shutil.copytree(tmp_path / "one.run", tmp_path / "two.run")
            one.folder = tmp_path / "two.run"
            one.save()
            one.folder = tmp_path / "one.run"
    done = train_together(tmp_path / "views.npz", tmp_path / "two.npz", "coco17", settings)
    assert "continuing at step 5" in done.stderr and done.stdout.count("two.npz") == 1  # one of them talks
    two = Trainer(data, recipe, tmp_path / "two.run")
    assert two.resume() and two.finished
    assert [row[0] for row in two.rows] == [row[0] for row in one.rows] == logged
    for a, b in zip(one.rows, two.rows):
        first, second = (dict(zip(LOG_COLUMNS, row)) for row in (a, b))
        for name in LOG_COLUMNS[2:9]:
            assert second[name] == pytest.approx(first[name], rel=1e-4, abs=1e-6), name
        assert first["bones"] > 0.01 and first["nuclear"] > 0.1
    for a, b in zip(one.networks.parameters(), two.networks.parameters()):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)


def test_alone_nothing_is_shared():
    assert is_first() and share_of(7) is WHOLE and WHOLE.part == slice(None)
    x = torch.ones(3, requires_grad=True)
    assert WHOLE.whole(x) is x
    assert from_first(lambda: b"bytes", torch.device("cpu")) == b"bytes"
    assert from_first(lambda: None, torch.device("cpu")) is None
