# SPDX-License-Identifier: Apache-2.0
"""Lost messages are counted, whoever published them."""

from __future__ import annotations

import random

import pytest

from paul_ros.ros.lost_messages import PublicationNumbers


def counted(numbers, publishers=1) -> int:
    known = PublicationNumbers()
    return sum(known.missed(number, lambda: publishers) for number in numbers)


def test_one_publisher():
    assert counted([1, 2, 3]) == counted([500, 501]) == 0
    assert counted([1, 2, 5, 6, 10]) == 5


def test_a_publisher_that_starts_again_has_lost_nothing():
    assert counted([98, 99, 100, 1, 2, 3]) == 0
    assert counted([98, 100, 3, 4, 6]) == 2


def test_publishers_are_counted_only_at_a_possible_gap():
    known, asked = PublicationNumbers(), []

    def publishers():
        asked.append(1)
        return 1

    for number in (1, 2, 3, 4, 6, 7):
        known.missed(number, publishers)
    assert len(asked) == 2  # the first, and the gap


@pytest.mark.parametrize("publishers", [1, 2, 5])
@pytest.mark.parametrize("seed", range(20))
def test_gaps_of_several_publishers_add_up(publishers, seed):
    rng = random.Random(seed)
    numbers = [rng.randrange(1000) for _ in range(publishers)]
    came = list(numbers)  # one message of each publisher comes first
    lost = [0] * publishers
    pending = [0] * publishers
    for _ in range(3000):
        who = rng.randrange(publishers)
        numbers[who] += 1
        if rng.random() < 0.2:
            pending[who] += 1
        else:
            lost[who] += pending[who]
            pending[who] = 0
            came.append(numbers[who])
    assert counted(came, publishers) == sum(lost) > 100


def test_a_publisher_that_is_silent_hides_one_gap_only():
    numbers = [number for number in range(1, 1001) if number % 10]
    assert counted(numbers, publishers=2) == counted(numbers) - 1 == 98


def test_a_long_running_publisher_that_is_found_late_makes_no_loss_up():
    assert counted([1, 2, 90_000, 3, 90_001, 4], publishers=2) == 0
