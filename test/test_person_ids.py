# SPDX-License-Identifier: Apache-2.0
"""Who is who: ids that several persons share identify nobody, and every text has one number."""

from __future__ import annotations

import numpy as np
import pytest

from msg_adapters import Keypoints2D
from paul_ros.stream import person_ids as module
from paul_ros.stream.ledger import Ledger
from paul_ros.stream.person_ids import FIRST_ASSIGNED, UNKNOWN, PersonIds
from paul_ros.stream.smoothing import FORGET_SECONDS

MS = 1_000_000  # ns


def identified(who: PersonIds, ids: tuple[str, ...], milliseconds: int = 0, ledger: Ledger | None = None):
    nothing = np.zeros((len(ids), 0))
    keypoints = Keypoints2D(nothing[..., None], nothing, nothing > 0, ids, milliseconds * MS, "camera")
    return who.identified(keypoints, ledger or Ledger()).ids


# --- ids


@pytest.mark.parametrize(
    "ids, expected",
    [
        ((), ()),
        (("1", "2"), ("1", "2")),
        (("", ""), ("", "")),
        (("0", "0"), ("", "")),
        (("0", "0", "0"), ("", "", "")),
        (("1", "2", "1"), ("", "2", "")),
        (("", "anna", "anna", "b"), ("", "", "", "b")),
        (("-1", "3"), ("", "3")),
        (("-1", "-1"), ("", "")),
        (("-", "-a"), ("-", "-a")),
    ],
)
def test_an_id_of_several_persons_identifies_none(ids, expected):
    ledger = Ledger()
    assert identified(PersonIds(), ids, ledger=ledger) == expected
    shared = sum(ids.count(name) > 1 for name in ids if name and name != "-1")
    assert ledger.notes == ({"duplicate_ids": shared} if shared else {})


def test_keypoints_whose_ids_are_good_are_the_same_object():
    keypoints = Keypoints2D(np.zeros((1, 1, 2)), np.ones((1, 1)), np.ones((1, 1), bool), ("7",), 5, "camera")
    assert PersonIds().identified(keypoints, Ledger()) is keypoints


def test_a_shared_id_is_not_trusted_until_all_filters_have_forgotten_it():
    """All persons have id 0 and one of two leaves: nobody can tell which. A tracker that fails once recovers."""
    who, ledger = PersonIds(), Ledger()
    assert identified(who, ("0",), 1000) == ("0",)
    assert identified(who, ("0", "0", "5"), 1033) == ("", "", "5")
    assert identified(who, ("0", "5"), 1066, ledger) == ("", "5") and ledger.notes == {"duplicate_ids": 1}
    back = 1033 + int(1000 * FORGET_SECONDS)
    assert identified(who, ("0",), back) == ("",)
    assert identified(who, ("0",), back + 1) == ("0",)


@pytest.mark.parametrize("milliseconds", [900, 1000])
def test_shared_ids_are_forgotten_if_time_runs_backwards_or_stands_still(milliseconds):
    who = PersonIds()
    identified(who, ("0", "0"), 1000)
    assert identified(who, ("0",), milliseconds) == ("0",)


@pytest.mark.parametrize("step", [33, 0])
def test_shared_ids_that_count_upwards_use_no_memory(step):
    who = PersonIds()
    for n in range(500):
        identified(who, (str(n), str(n)), n * step)
    assert len(who._shared) < 20


# --- numbers


def test_every_text_has_one_number_for_its_life():
    who = PersonIds()
    first = who.numbers(("anna", "7", "", "ben"))
    assert first.dtype == np.float32 and first.tolist() == [FIRST_ASSIGNED, 7, UNKNOWN, FIRST_ASSIGNED + 1]
    for ids in (("ben", "anna"), ("carla",), ("anna", "ben")):
        found = dict(zip(ids, who.numbers(ids).tolist()))
    assert found == {"anna": first[0], "ben": first[3]}


@pytest.mark.parametrize(
    "text, own",
    [
        ("0", True),
        (str(FIRST_ASSIGNED - 1), True),
        (str(FIRST_ASSIGNED), False),
        (str(2**24), False),
        ("07", False),
        ("00", False),
        (" 7", False),
        ("7.0", False),
        ("+7", False),
        ("1e3", False),
        ("\u0667", False),
        ("\u00b2", False),
        ("9" * 5000, False),
        ("0" * 5000, False),
        ("abcde", False),
        ("e2f1c0de-0000-4000-8000-000000000000", False),
        ("\udcff", False),
    ],
    ids=lambda value: ascii(value)[:20],
)
def test_numbers_keep_their_own_and_never_meet_those_of_texts(text, own):
    who = PersonIds()
    plain = who.numbers(tuple(map(str, range(20)))).tolist()
    (number,) = who.numbers((text,)).tolist()
    assert (number == int(text) < FIRST_ASSIGNED) if own else number >= FIRST_ASSIGNED
    assert own or number not in plain and who.numbers((text, "x")).tolist() == [number, number + 1]


def test_no_number_is_used_twice_and_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(module, "_TEXTS_KEPT", 50)
    who = PersonIds()
    found = [who.numbers(("stays", f"guest {n}")).tolist() for n in range(500)]
    guests = [guest for _, guest in found]
    assert {stays for stays, _ in found} == {FIRST_ASSIGNED} and len(set(guests)) == 500
    assert len(who._numbers) == 50
    assert who.numbers(("guest 499", "guest 0")).tolist() == [guests[499], max(guests) + 1]


def test_all_numbers_are_exact_and_none_is_reused_at_the_end():
    who = PersonIds()
    who._next = 2**24 - 1
    assert [int(number) for number in who.numbers(("a", "b", "c", "a"))] == [2**24 - 1, 2**24, UNKNOWN, 2**24 - 1]
