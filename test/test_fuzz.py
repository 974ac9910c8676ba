# SPDX-License-Identifier: Apache-2.0
"""The short form of ``benchmarks/fuzz.py``, and that it would notice what it looks for."""

from __future__ import annotations

import importlib.util
import io
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

import msg_adapters
from msg_adapters import MessageError
from msg_adapters.plugins import Adapter, Adapters
from paul_ros.errors import ModelError
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.stream.stream import LiftStream

SCRIPT = Path(__file__).resolve().parent.parent / "benchmarks/fuzz.py"
_spec = importlib.util.spec_from_file_location("fuzz", SCRIPT)
fuzz = sys.modules["fuzz"] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(fuzz)
CASES = {"fields": 200, "junk": 100, "cdr": 200, "bags": 25, "models": 50, "layouts": 50}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return fuzz.Bench(tmp_path_factory.mktemp("fuzz"))


@pytest.fixture(autouse=True)
def quiet():
    """Every first internal error of a stream is logged with its traceback."""
    log = logging.getLogger("paul_ros.stream.stream")
    log.setLevel(logging.CRITICAL)
    yield
    log.setLevel(logging.NOTSET)


@pytest.mark.parametrize("kind", CASES)
def test_nothing_crashes_and_no_frame_is_lost_uncounted(kind):
    report = fuzz.fuzz(CASES[kind], seed=11, kinds=(kind,))
    assert report["cases"] == CASES[kind]
    row = report["kinds"][kind]
    assert row["failures"] == [] and (report["crashes"], report["uncounted"]) == (0, 0)
    # Broken enough, and not too much.
    assert row["accepted"] > CASES[kind] // 20 and row["refused"] > CASES[kind] // 20


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(rng=st.randoms(), kind=st.sampled_from(["fields", "junk", "cdr"]))
def test_hypothesis_finds_nothing_either(bench, rng, kind):
    """It chooses the same breakages, and makes a failure as small as it can."""
    tally = fuzz.Tally()
    fuzz.SESSIONS[kind](bench, rng, tally, 2, kind)
    assert not tally.failures


def failing(read):
    """All types are read by this."""
    return Adapters({name: Adapter(read) for name in msg_adapters.SUPPORTED})


def raises(error):
    def read(*_):
        raise error

    return read


def test_an_adapter_that_fails_would_be_noticed(monkeypatch):
    monkeypatch.setattr(msg_adapters, "SUPPORTED", failing(raises(KeyError("x"))))
    assert fuzz.fuzz(50, kinds=("fields",))["crashes"]
    # What no message can be may be counted as any drop.
    assert not fuzz.fuzz(50, kinds=("junk",))["crashes"]
    monkeypatch.setattr(msg_adapters, "SUPPORTED", failing(raises(MessageError("no", "advice"))))
    assert not fuzz.fuzz(50, kinds=("fields",))["crashes"]


def test_a_message_that_vanishes_would_be_noticed(monkeypatch):
    monkeypatch.setattr(LiftStream, "keypoints", lambda *_: None)
    assert fuzz.fuzz(50, kinds=("fields",))["uncounted"]
    assert fuzz.fuzz(50, kinds=("cdr",))["uncounted"]


def test_numbers_that_are_none_would_be_noticed(monkeypatch):
    lift = Lifter.lift
    monkeypatch.setattr(Lifter, "lift", lambda *a: replace(lift(*a), root=np.full((len(a[1]), 3), np.nan)))
    assert fuzz.fuzz(50, kinds=("fields",))["crashes"]


def test_another_reading_than_rosbags_would_be_noticed(monkeypatch):
    read = fuzz.CloudReader.__call__
    monkeypatch.setattr(fuzz.CloudReader, "__call__", lambda *a: replace(read(*a), height=9))
    assert fuzz.fuzz(50, kinds=("cdr",))["crashes"]


@pytest.mark.parametrize("kind, name", [("bags", "replay"), ("models", "load_model")])
def test_another_error_than_promised_would_be_noticed(monkeypatch, bench, kind, name):
    tally = fuzz.Tally()
    monkeypatch.setattr(fuzz, name, raises(ZeroDivisionError()))
    fuzz.session(bench, kind, 0, tally, cases=3)
    assert tally.crashes == 3


@pytest.mark.parametrize("place, value", [(10, 77), (8, 1)], ids=["odd compression", "encrypted"])
def test_a_model_that_zip_cannot_unpack_is_refused(bench, tmp_path, place, value):
    """Faults that were found: other errors than zipfile's own."""
    header, arrays = bench.tiny
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    data = bytearray(buffer.getvalue())
    data[data.index(b"PK\1\2") + place] = value
    path = tmp_path / "odd.npz"
    path.write_bytes(fuzz.sealed(bytes(data)))
    with pytest.raises(ModelError, match="is no model file"):
        load_model(path)


@pytest.mark.filterwarnings("error")
def test_signalling_nan_is_missing_without_a_warning(bench):
    """A fault that was found: numpy's own words in the robot's log."""
    make, rng = bench.live, random.Random(0)
    message = fuzz.cloud(make, fuzz.header(make, rng, 1), [fuzz.pose(rng)], rng)
    data = np.array(message.data, np.uint8).reshape(17, -1)
    data[3] = np.tile(np.frombuffer(np.uint32(0x7F800001).tobytes(), np.uint8), data.shape[1] // 4)
    message.data = make.octets(data.tobytes())
    found = msg_adapters.read(fuzz.foreign.CLOUD, message, 17)
    assert not found.visible[0, 3] and found.visible.sum() == 16


def test_the_command(tmp_path, capsys, monkeypatch):
    out = tmp_path / "fuzz.json"
    monkeypatch.setattr(sys, "argv", ["fuzz.py", "--cases", "25", "--only", "cdr", "--json", str(out)])
    assert fuzz.main() == 0
    report = json.loads(out.read_text())
    assert (report["cases"], report["crashes"], report["uncounted"]) == (25, 0, 0)
    assert "25 cases, 0 crashes, 0 frames lost uncounted" in capsys.readouterr().out
