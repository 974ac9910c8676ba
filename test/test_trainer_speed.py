# SPDX-License-Identifier: Apache-2.0
"""benchmarks/trainer_speed.py: trainer and plain twin compute the same, without which the ratio means nothing."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

from training.objective import paul_terms
from training.recipe import Recipe
from training.trainer import Trainer

SCRIPT = Path(__file__).resolve().parent.parent / "benchmarks" / "trainer_speed.py"


@pytest.fixture(scope="module")
def speed():
    spec = importlib.util.spec_from_file_location("trainer_speed", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.FRAMES = 64
    return module


@pytest.mark.parametrize("codes", ["free", "encoder"])
def test_the_twin_has_the_trainers_loss_and_gradients(speed, tmp_path, codes):
    settings = ["start=random", "regression_steps=0", "solver=algebraic", f"codes={codes}", "batch=32"]
    recipe, data = Recipe.load("nrsfm", settings), speed.views()
    twin, trainer = speed.Twin(data, recipe), Trainer(data, recipe, tmp_path)
    twin.networks.load_state_dict(trainer.networks.state_dict())
    rows = torch.arange(0, 64, 2)
    ours = paul_terms(trainer.networks, data.layout, recipe, trainer.views(rows), rows).loss
    plain = twin.loss(rows)
    assert plain.item() == pytest.approx(ours.item(), rel=1e-3)
    plain.backward(), ours.backward()
    for a, b in zip(twin.networks.decoder.parameters(), trainer.networks.decoder.parameters()):
        torch.testing.assert_close(a.grad, b.grad, rtol=0.05, atol=0.02 * b.grad.abs().max().item())


def test_rows_and_table(speed, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["trainer_speed.py", "--rounds", "1", "--json", str(tmp_path / "s.json")])
    speed.main()
    rows = json.loads((tmp_path / "s.json").read_text())["rows"]
    cases = [(mode, solver, n) for mode in speed.MODES for solver in speed.SOLVERS for n in (128, 256)]
    assert [(row["mode"], row["solver"], row["batch"]) for row in rows] == cases
    assert all(row["frames_per_second"] > 0 < row["speed_ratio"] for row in rows)
    assert capsys.readouterr().out.count("\n") == 10
