# SPDX-License-Identifier: Apache-2.0
"""The ledger counts and explains; its table has every reason that the sources use, and no other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

from paul_ros.lifted import BEHIND_CAMERA, DEGENERATE_POINTS, TOO_FAR, TOO_FEW_POINTS
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.reason import AT_ONCE, DROP, MOST, NEVER, NOTE, PERSON
from paul_ros.stream.reasons import REASONS, reason_of

#: Calls whose first argument is a reason.
CALLS = {"MessageError", "Note", "drop", "note"}


def test_drops_and_notes_are_counted_with_the_latest_advice():
    ledger = Ledger()
    ledger.drop("not_2d", "first")
    ledger.drop("not_2d", "second", 2)
    ledger.note("depth_used", count=3)
    assert ledger.drops == {"not_2d": 3} and ledger.notes == {"depth_used": 3}
    assert ledger.advice == {"not_2d": "second"}
    assert ledger.drops["never"] == ledger.notes["never"] == 0 and len(ledger.drops) == 1


def test_a_count_of_nothing_leaves_no_trace():
    ledger = Ledger()
    ledger.drop("missed", "lost", 0)
    ledger.note("depth_used", count=0)
    assert not ledger.drops and not ledger.notes and not ledger.advice


def test_only_the_ledger_writes_its_counts():
    ledger = Ledger()
    for counts in (ledger.drops, ledger.notes, ledger.advice):
        with pytest.raises(TypeError):
            counts["not_2d"] = 1


def sources() -> Iterator[Path]:
    for package in ("msg_adapters", "paul_ros"):
        yield from sorted((ROOT / package).rglob("*.py"))


def called(node: ast.Call) -> str:
    """Return the name of the called function or method."""
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def used_reasons() -> Iterator[tuple[str, Path, str]]:
    """Every reason in the sources, its file and the call: the literal first argument of a call that counts it."""
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not node.args or not isinstance(node.args[0], ast.Constant):
                continue
            name = called(node)
            is_super = name == "__init__" and path.name == "keypoints.py"
            if (name in CALLS or is_super) and isinstance(node.args[0].value, str):
                yield node.args[0].value, path, name


#: The lifter's own reasons become those of persons.
OF_PERSONS = {f"person_{reason}" for reason in (TOO_FEW_POINTS, DEGENERATE_POINTS, TOO_FAR, BEHIND_CAMERA)}


def test_the_table_has_every_reason_that_is_used_and_no_other():
    used = {reason: path for reason, path, _ in used_reasons()}
    missing = {reason: str(path) for reason, path in used.items() if reason not in REASONS}
    assert not missing, f"add rows to paul_ros/stream/drop_reasons.py or note_reasons.py: {missing}"
    unused = REASONS.keys() - used.keys() - OF_PERSONS
    assert not unused and OF_PERSONS <= REASONS.keys()


def test_kinds_follow_the_use():
    noted = {reason for reason, _, call in used_reasons() if call in ("Note", "note")}
    assert noted == {slug for slug, reason in REASONS.items() if reason.kind == NOTE}
    assert OF_PERSONS == {slug for slug, reason in REASONS.items() if reason.kind == PERSON}
    assert {reason.kind for reason in REASONS.values()} == {DROP, PERSON, NOTE}


@pytest.mark.parametrize("slug", REASONS)
def test_every_row_is_two_clear_sentences(slug):
    reason = REASONS[slug]
    assert reason.slug == slug and slug == slug.lower() and " " not in slug
    assert not reason.what.endswith(".") and reason.fix.endswith(".")
    assert all(len(sentence.split()) <= 30 for sentence in (reason.what, *reason.fix.split(". ")))


def test_only_what_is_normal_in_small_numbers_waits_for_a_share():
    """Persons at the image's edge are normal; a message that cannot be read never is."""
    limits = {slug: reason.limit for slug, reason in REASONS.items()}
    for slug, reason in REASONS.items():
        if reason.kind == DROP:
            assert limits[slug] == (0.1 if slug == "missed" else AT_ONCE)
        elif reason.kind == PERSON:
            assert limits[slug] == MOST and reason.warns == "above 50 % of persons"
    assert limits["unlike_the_model"] == limits["depth_disagrees"] == MOST
    assert limits["another_frame"] == limits["depth_in_millimetres"] == AT_ONCE
    assert limits["stamp_backwards"] == limits["clock_set_back"] == limits["depth_used"] == NEVER


def test_reasons_of_other_packages_have_the_limits_of_their_kind():
    assert reason_of("acme_is_empty", DROP).limit == AT_ONCE
    assert reason_of("acme_is_odd", NOTE).limit == NEVER
    assert (reason_of("person_acme", DROP).kind, reason_of("person_acme", DROP).limit) == (PERSON, MOST)
