"""Jumps: the largest change of a vehicle's own state within a time, in numbers."""

import pytest

from skytether.shared.law.leap import position_leaps, velocity_leaps

LEAST = 1e-9


@pytest.mark.parametrize(
    ("time", "change"),
    [(0.0, 2.0), (0.05, 4.5), (0.5, 27.0), (2.0, 102.0)],
)
def test_a_velocity_changes_by_noise_and_50_m_s2_at_most(time: float, change: float) -> None:
    for v in (-30.0, 0.0, 8.0):
        for sign in (1.0, -1.0):
            assert not velocity_leaps(v, v + sign * (change - LEAST), time, 2.0)
            assert velocity_leaps(v, v + sign * (change + LEAST), time, 2.0)


@pytest.mark.parametrize(
    ("time", "travel", "off"),
    [(0.0, 0.0, 1.0), (0.05, 0.2, 1.0625), (0.5, 2.0, 7.25), (2.0, 8.0, 101.0)],
)
def test_a_position_goes_on_with_the_mean_velocity_but_for_noise_and_what_50_m_s2_bring(
    time: float, travel: float, off: float
) -> None:
    for p in (-100.0, 0.0, 7.0):
        for sign in (1.0, -1.0):
            reached = p + travel + sign * off
            assert not position_leaps(p, 3.0, reached - sign * LEAST, 5.0, time, 1.0)
            assert position_leaps(p, 3.0, reached + sign * LEAST, 5.0, time, 1.0)
