# SPDX-License-Identifier: Apache-2.0
"""A command that a signal ends leaves nothing half done, says one line, and has the signal's exit code."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ROOT

from paul_ros.signals import delayed_signals, raise_signals, stoppable

TWO = ROOT / "bags/two_persons_crossing.mcap"
PATIENCE = 60
KINDS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def replay(out: Path, hang_up=signal.SIG_DFL) -> subprocess.Popen:
    """Start a replay, and wait until it writes."""

    def usual() -> None:  # jobs in the background ignore SIGINT
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGHUP, hang_up)

    words = [sys.executable, "-m", "paul_ros.cli", "replay", str(TWO), "-o", str(out)]
    process = subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=usual
    )
    end = time.monotonic() + PATIENCE
    while not list(out.parent.glob(f"{out.name}.*.part")):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.001)
    return process


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_replay(tmp_path, kind):
    process = replay(tmp_path / "lifted.mcap")
    process.send_signal(kind)
    assert process.communicate(timeout=PATIENCE)[1] == "paul: stopped\n"
    assert process.returncode == 128 + kind and list(tmp_path.iterdir()) == []


def test_nohup_is_respected(tmp_path):
    process = replay(tmp_path / "lifted.mcap", signal.SIG_IGN)
    process.send_signal(signal.SIGHUP)
    assert process.communicate(timeout=PATIENCE)[1] == "" and process.returncode == 0
    assert [file.name for file in tmp_path.iterdir()] == ["lifted.mcap"]


@pytest.fixture
def handlers():
    before = [signal.getsignal(kind) for kind in KINDS]
    for kind, handler in zip(KINDS, (signal.default_int_handler, signal.SIG_DFL, signal.SIG_DFL)):
        signal.signal(kind, handler)
    yield
    for kind, handler in zip(KINDS, before):
        signal.signal(kind, handler)


def test_the_second_signal_of_a_service_manager_does_not_break_the_tidying(handlers):
    tidied = False
    with stoppable() as received:
        with pytest.raises(KeyboardInterrupt):
            try:
                signal.raise_signal(signal.SIGTERM)
            finally:
                signal.raise_signal(signal.SIGHUP)
                tidied = True
    assert tidied and received == [signal.SIGTERM]
    assert [signal.getsignal(kind) for kind in KINDS[1:]] == [signal.SIG_DFL] * 2


@pytest.mark.parametrize("kind", KINDS)
def test_work_that_must_be_whole_delays_a_signal(handlers, kind):
    whole = False
    with stoppable(), pytest.raises(KeyboardInterrupt):
        with delayed_signals() as received:
            signal.raise_signal(kind)
            whole = True
        raise_signals(received)
    assert whole and received == [kind]
