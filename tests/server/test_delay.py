"""Delay bound: above the recent delays, and constant while the network is."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.problems import from_python
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.server.schemes import delay_bound as delay
from skytether.server.schemes.delay_bound import DelayBound, delay_bound, forget
from skytether.shared.base.units import seconds_to_ns

quick = settings(max_examples=40)

set_first, raise_to = from_python(delay.set_first), from_python(delay.raise_to)
add_sample = from_python(delay.add_sample)

MOST = 39


def estimated(capacity: int = 1, most: int = MOST) -> DelayBound:
    return delay_bound(capacity, 0.05, most, None)


def known(delays: list[int], first: int = 1, most: int = MOST) -> list[int]:
    bound, steps = estimated(most=most), []
    set_first(bound, 0, first)
    for sample in delays:
        add_sample(bound, 0, sample)
        steps += bound.steps.tolist()
    return steps


# -- given bound ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fixed_s", "dt_s", "steps"),
    [
        (0.55, 0.05, 11),  # 0.55 / 0.05 is more than 11 in floating point
        (0.551, 0.05, 12),
        (0.001, 0.05, 1),
        (0.0, 0.05, 1),
        (1.99, 0.05, MOST),
    ],
)
def test_a_given_bound_is_rounded_up_to_steps(fixed_s: float, dt_s: float, steps: int) -> None:
    """From 1 to the largest possible, whatever is estimated."""
    bound = delay_bound(3, dt_s, MOST, fixed_s)
    for row, guess in enumerate((5, 20, 90)):
        set_first(bound, row, guess)
    assert bound.steps.tolist() == [steps] * 3
    for row, sample in enumerate((1, 30, 90)):
        for _ in range(50):
            add_sample(bound, row, sample)
    assert bound.steps.tolist() == [steps] * 3
    forget(bound, 1)
    set_first(bound, 1, 7)
    assert bound.steps.tolist() == [steps] * 3


# -- estimated bound ------------------------------------------------------------------------------


def test_before_any_sample_it_is_the_guess() -> None:
    bound = estimated(4)
    for row, guess in ((3, 11), (0, 0), (1, 90)):
        set_first(bound, row, guess)
    assert bound.steps.tolist() == [1, MOST, 0, 11]


def test_what_every_packet_takes_raises_it_at_once_and_never_lowers_it() -> None:
    bound, steps = estimated(), []
    set_first(bound, 0, 11)
    for delay_now in (-(2**40), 0, 10, 11, 12, 30, 12, 90):
        raise_to(bound, 0, delay_now)
        steps += bound.steps.tolist()
    assert steps == [11, 11, 11, 11, 12, 30, 30, MOST]


def test_what_was_raised_falls_step_by_step() -> None:
    bound, steps = estimated(), []
    set_first(bound, 0, 9)
    raise_to(bound, 0, 14)
    for _ in range(22):
        add_sample(bound, 0, 9)
        steps += bound.steps.tolist()
    assert steps == [14] * 15 + [13, 12, 11, 10] + [9] * 3


LONE = [11] * 128 + [30] + [11] * 40


def test_a_lone_late_horizon_is_left_behind_step_by_step() -> None:
    assert known(LONE)[128:] == [30] * 16 + list(range(29, 10, -1)) + [11] * 6


def test_a_few_of_a_hundred_are_no_lone_one() -> None:
    delays = [11] * 128 + [30] * 3 + [11] * 200
    steps = known(delays)[130:]
    assert steps[:127] == [30] * 127
    assert steps[127:147] == [*range(29, 10, -1), 11]


@pytest.mark.parametrize(
    ("name", "value", "delays"),
    [("RECENT", 1, LONE), ("LATE", 1.0, [11] * 128 + [30] * 3 + [11] * 200)],
)
def test_either_reason_to_stay_is_needed(
    name: str, value: float, delays: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise d falls soon after a late horizon, and the next one is late too."""
    guarded = known(delays)
    monkeypatch.setattr(sys.modules[__name__], "add_sample", delay.add_sample.py_func)
    assert known(delays) == guarded
    monkeypatch.setattr(delay, name, value)
    bare = known(delays)
    assert sum(guarded) > sum(bare) + 200
    assert all(slow >= fast for slow, fast in zip(guarded, bare, strict=True))


SAMPLES = st.lists(
    st.one_of(st.integers(8, 13), st.integers(-5, 60)) | st.just(2**40), min_size=1, max_size=400
)


@quick
@given(SAMPLES, st.integers(1, MOST))
def test_it_is_what_the_samples_say(delays: list[int], first: int) -> None:
    d, expected = first, []
    for count, sample in enumerate(delays, 1):
        d = max(d, min(sample, MOST))
        newest = np.array(delays[max(0, count - 128) : count])
        rare = np.mean(newest >= d) <= 0.01
        if d > 1 and count >= 16 and rare and max(newest[-16:]) < d:
            d -= 1
        expected.append(d)
    assert known(delays, first) == expected


def test_every_vehicle_has_a_bound_of_its_own() -> None:
    rng, vehicles = np.random.default_rng(2), 6
    bound, heard = estimated(vehicles), [list[int]() for _ in range(vehicles)]
    for row in range(vehicles):
        set_first(bound, row, 12)
    for _ in range(500):
        some = rng.permutation(vehicles)[: rng.integers(vehicles + 1)]
        delays = 8 + some + rng.poisson(0.5, len(some))
        for row, sample in zip(some.tolist(), delays.tolist(), strict=True):
            add_sample(bound, row, sample)
            heard[row].append(sample)
    expected = [known(delays, first=12)[-1] for delays in heard]
    assert bound.steps.tolist() == expected
    assert len(set(expected)) > 1


def test_a_vehicle_that_is_forgotten_begins_anew() -> None:
    bound = estimated(2)
    for row in (0, 1):
        for _ in range(200):
            add_sample(bound, row, 30)
    forget(bound, 0)
    assert bound.steps.tolist() == [0, 30]
    set_first(bound, 0, 14)
    for _ in range(20):
        add_sample(bound, 0, 9)
    assert bound.steps.tolist() == [9, 30]


# -- simulated network ----------------------------------------------------------------------------

SECONDS = 60.0


def flown(
    dt_s: float, period: int, seed: int, minima_s: tuple[float, ...] = (0.4,)
) -> tuple[list[int], float]:
    """Delay d at every step on the paper's uplink, and the share of horizons in force later than d.

    Args:
        period: steps from a horizon to the next.
        minima_s: smallest delay in each of as many equal parts of the flight [s].
    """
    dt_ns, steps = seconds_to_ns(dt_s), round(SECONDS / dt_s)
    parts = [
        Fates(impairments(f"paper({least_s}, 0.02, 2.0) & loss(0.1)"), seed, "uplink", 0)
        for least_s in minima_s
    ]
    arrivals: dict[int, list[int]] = {}
    for made in range(0, steps, period):
        fate = parts[made * len(minima_s) // steps].at(made)
        if not fate.lost:
            arrivals.setdefault(made - (-fate.delay_ns // dt_ns), []).append(made)
    bound = delay_bound(1, dt_s, round(2.0 / dt_s) - 1, None)
    set_first(bound, 0, round(0.4 / dt_s) + 2)
    in_force, bounds, late = -1, [], []
    for step in range(steps):
        made = max(arrivals.get(step, [-1]))
        if made > in_force:
            in_force = made
            late.append(step - made > bounds[made])
            add_sample(bound, 0, step - made)
        bounds += bound.steps.tolist()
    return bounds, float(np.mean(late))


FLIGHTS = {
    (0.05, 1): (10, 11, 8, 0.01),
    (0.05, 10): (10, 12, 4, 0.03),
    (0.02, 1): (22, 25, 30, 0.012),
    (0.02, 10): (24, 29, 12, 0.03),
}
"""By Δt [s] and period: smallest and largest d at the end, changes, share of late horizons."""


@pytest.mark.parametrize(("dt_s", "period"), FLIGHTS)
def test_on_the_papers_network_it_is_at_rest(dt_s: float, period: int) -> None:
    """From the mean delay, 0.44 s, to 0.6 s; lower if most late ones are overtaken."""
    steps, late = flown(dt_s, period, seed=0)
    least, most, changes, share = FLIGHTS[dt_s, period]
    half = steps[len(steps) // 2 :]
    assert least <= min(half) <= max(half) <= most
    assert np.count_nonzero(np.diff(steps)) <= changes
    assert late <= share


def test_without_its_memory_it_chatters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five times the changes, and five times the late horizons."""
    steps, late = flown(0.02, 1, seed=0)
    monkeypatch.setattr(sys.modules[__name__], "add_sample", delay.add_sample.py_func)
    monkeypatch.setattr(delay, "RECENT", 1)
    monkeypatch.setattr(delay, "LATE", 1.0)
    bare_steps, bare_late = flown(0.02, 1, seed=0)
    changes, bare = (np.count_nonzero(np.diff(d)) for d in (steps, bare_steps))
    assert bare > 5 * changes
    assert bare_late > 5 * late


@pytest.mark.parametrize(("dt_s", "settled_s"), [(0.05, 15.0), (0.02, 10.0)])
def test_it_follows_a_network_that_jumps_up_and_down(dt_s: float, settled_s: float) -> None:
    """Up with the first horizon that arrives; down within SAMPLES of them, in single steps."""
    steps, _ = flown(dt_s, 1, seed=1, minima_s=(0.4, 0.8, 0.4))
    third = len(steps) // 3
    d_s = np.array(steps) * dt_s
    after_s = np.arange(third) * dt_s
    assert (d_s[third - round(1 / dt_s) : third] < 0.61).all()
    assert (d_s[third : 2 * third][after_s > 1.0] >= 0.84).all()
    assert (d_s[third : 2 * third] <= 1.05).all()
    assert (d_s[2 * third :][after_s > settled_s] < 0.61).all()
    assert np.diff(steps).min() == -1
