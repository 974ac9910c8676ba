# SPDX-License-Identifier: Apache-2.0
"""``benchmarks.fuzz`` in short, and faults that it must notice."""

from __future__ import annotations

import json
import logging
import random
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import foreign_messages as foreign

import msg_adapters
from benchmarks.fuzz import command, sessions
from benchmarks.fuzz.bench import Bench, model_file, sealed
from benchmarks.fuzz.messages import cloud, header, random_pose
from benchmarks.fuzz.tally import Tally
from msg_adapters import MessageError
from msg_adapters.plugins import Adapter, Adapters
from paul_ros.errors import ModelError
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.stream.stream import LiftStream

CASES = {"fields": 200, "junk": 100, "cdr": 200, "bags": 25, "recordings": 50, "models": 50, "layouts": 50}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return Bench(tmp_path_factory.mktemp("fuzz"))


@pytest.fixture(autouse=True)
def quiet():
    """Silence the traceback that a stream logs for its first internal error."""
    log = logging.getLogger("paul_ros.stream.stream")
    log.setLevel(logging.CRITICAL)
    yield
    log.setLevel(logging.NOTSET)


@pytest.mark.parametrize("kind", CASES)
def test_nothing_crashes_and_no_frame_is_lost_uncounted(kind):
    report = command.fuzz(CASES[kind], seed=11, kinds=(kind,))
    assert report["cases"] == CASES[kind]
    row = report["kinds"][kind]
    assert row["failures"] == [] and (report["crashes"], report["uncounted"]) == (0, 0)
    # Cases must be broken, but not all of them beyond use.
    assert row["accepted"] > CASES[kind] // 20 and row["refused"] > CASES[kind] // 20


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(rng=st.randoms(), kind=st.sampled_from(["fields", "junk", "cdr"]))
def test_hypothesis_finds_nothing_either(bench, rng, kind):
    """Hypothesis draws the same breakages, and shrinks failures."""
    tally = Tally()
    sessions.SESSIONS[kind](bench, rng, tally, 2, kind)
    assert not tally.failures


def failing(read):
    """Return adapters that read all types with this function."""
    return Adapters({name: Adapter(read) for name in msg_adapters.SUPPORTED})


def raises(error):
    def read(*_):
        raise error

    return read


def test_an_adapter_that_fails_would_be_noticed(monkeypatch):
    monkeypatch.setattr(msg_adapters, "SUPPORTED", failing(raises(KeyError("x"))))
    assert command.fuzz(50, kinds=("fields",))["crashes"]
    # Messages that cannot exist may be counted as any drop.
    assert not command.fuzz(50, kinds=("junk",))["crashes"]
    monkeypatch.setattr(msg_adapters, "SUPPORTED", failing(raises(MessageError("no", "advice"))))
    assert not command.fuzz(50, kinds=("fields",))["crashes"]


def test_a_message_that_vanishes_would_be_noticed(monkeypatch):
    monkeypatch.setattr(LiftStream, "keypoints", lambda *_: None)
    assert command.fuzz(50, kinds=("fields",))["uncounted"]
    assert command.fuzz(50, kinds=("cdr",))["uncounted"]


def test_numbers_that_are_not_finite_would_be_noticed(monkeypatch):
    lift = Lifter.lift_in_model_layout
    monkeypatch.setattr(
        Lifter, "lift_in_model_layout", lambda *a: replace(lift(*a), root=np.full((len(a[1]), 3), np.nan))
    )
    assert command.fuzz(50, kinds=("fields",))["crashes"]


def test_a_reading_that_differs_from_rosbags_would_be_noticed(monkeypatch):
    read = sessions.CloudReader.__call__
    monkeypatch.setattr(sessions.CloudReader, "__call__", lambda *a: replace(read(*a), height=9))
    assert command.fuzz(50, kinds=("cdr",))["crashes"]


@pytest.mark.parametrize("kind, name", [("bags", "replay"), ("models", "load_model")])
def test_an_error_that_is_not_promised_would_be_noticed(monkeypatch, bench, kind, name):
    tally = Tally()
    monkeypatch.setattr(sessions, name, raises(ZeroDivisionError()))
    sessions.run_session(bench, kind, 0, tally, cases=3)
    assert tally.crashes == 3


@pytest.mark.parametrize("place, value", [(10, 77), (8, 1)], ids=["odd compression", "encrypted"])
def test_a_model_that_zip_cannot_unpack_is_refused(bench, tmp_path, place, value):
    """Faults found by fuzzing: zipfile raises errors of other packages."""
    data = bytearray(model_file(*bench.tiny))
    data[data.index(b"PK\1\2") + place] = value
    path = tmp_path / "odd.npz"
    path.write_bytes(sealed(bytes(data)))
    with pytest.raises(ModelError, match="is not a model file"):
        load_model(path)


@pytest.mark.filterwarnings("error")
def test_signalling_nan_is_missing_without_a_warning(bench):
    """A fault found by fuzzing: a warning of NumPy in the robot's log."""
    make, rng = bench.live, random.Random(0)
    message = cloud(make, header(make, rng, 1), [random_pose(rng)], rng)
    data = np.array(message.data, np.uint8).reshape(17, -1)
    data[3] = np.tile(np.frombuffer(np.uint32(0x7F800001).tobytes(), np.uint8), data.shape[1] // 4)
    message.data = make.octets(data.tobytes())
    found = msg_adapters.read(foreign.CLOUD, message, 17)
    assert not found.visible[0, 3] and found.visible.sum() == 16


def test_the_command(tmp_path, capsys, monkeypatch):
    out = tmp_path / "fuzz.json"
    monkeypatch.setattr(sys, "argv", ["fuzz", "--cases", "25", "--only", "cdr", "--json", str(out)])
    assert command.main() == 0
    report = json.loads(out.read_text())
    assert (report["cases"], report["crashes"], report["uncounted"]) == (25, 0, 0)
    assert "25 cases, 0 crashes, 0 frames lost uncounted" in capsys.readouterr().out
