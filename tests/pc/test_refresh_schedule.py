"""How long a train is kept."""

from __future__ import annotations

import math

from pctt.pc.refresh_schedule import GAIN, LONGEST, RefreshSchedule


def trials(schedule: RefreshSchedule, setups: int, kept: float, new: float) -> list[int]:
    """The set-ups, from 1, at which a new train was tried, that leaves ``new`` where the kept one leaves ``kept``."""
    found = []
    for number in range(1, setups + 1):
        if schedule.over():
            schedule.decide(kept, new)
            found.append(number)
    return found


def test_trials_without_gain_become_rare():
    assert trials(RefreshSchedule(), 20, 0.5, 0.5) == [2, 5, 10, 19]
    long = trials(RefreshSchedule(), 1000, 0.5, 0.4999)
    assert long[-1] - long[-2] == LONGEST + 1


def test_trials_with_gain_go_on():
    assert trials(RefreshSchedule(), 7, 0.5, 0.4) == [2, 4, 6]


def test_the_gain_must_be_worth_it():
    schedule = RefreshSchedule()
    assert not schedule.decide(1.0, 1.01 / GAIN)
    assert schedule.decide(1.0, 0.99 / GAIN)
    assert not schedule.decide(1.0, math.inf)  # a new train that is not positive
    assert schedule.decide(math.nan, 1.0)


def test_after_a_failure_the_next_set_up_is_a_trial():
    schedule = RefreshSchedule(wait=32)
    schedule.lose()
    assert trials(schedule, 10, 0.5, 0.5) == [1, 3, 6]  # and the waits grow again
