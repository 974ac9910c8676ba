# SPDX-License-Identifier: Apache-2.0
"""The kinds of cases, and how a session of one kind is run."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable

from benchmarks.fuzz.bench import Bench
from benchmarks.fuzz.identities import ids_session
from benchmarks.fuzz.recordings import recording_session
from benchmarks.fuzz.requests import request_session
from benchmarks.fuzz.scenes import scene_session
from benchmarks.fuzz.services import service_session
from benchmarks.fuzz.sessions import (
    bag_session,
    cdr_session,
    fields_session,
    junk_session,
    layout_session,
    model_session,
)
from benchmarks.fuzz.tally import Tally

SESSION = 25  # cases

Session = Callable[[Bench, random.Random, Tally, int, str], None]
"""Runs so many cases and counts them; the text names the session in failures."""

SESSIONS: dict[str, Session] = {
    "fields": fields_session,
    "junk": junk_session,
    "cdr": cdr_session,
    "scenes": scene_session,
    "ids": ids_session,
    "bags": bag_session,
    "recordings": recording_session,
    "models": model_session,
    "layouts": layout_session,
    "services": service_session,
    "requests": request_session,
}
"""Kind -> session."""

SHARES = {
    "fields": 0.20,
    "junk": 0.10,
    "cdr": 0.15,
    "scenes": 0.22,
    "ids": 0.08,
    "bags": 0.04,
    "recordings": 0.05,
    "models": 0.04,
    "layouts": 0.02,
    "services": 0.06,
    "requests": 0.04,
}
"""Kind -> share of the cases."""


def run_session(bench: Bench, kind: str, number: int, tally: Tally, seed: int = 0, cases: int = SESSION) -> None:
    """Run one session; equal numbers and seeds make equal cases."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning of NumPy would be a cryptic line in the robot's log
        SESSIONS[kind](bench, random.Random(f"{seed} {kind} {number}"), tally, cases, f"{kind} {number}")
