"""Map of the vehicle's clock at the server: exact where possible, otherwise with a bound."""

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bench.problems import from_python
from skytether.server.planning import clock as clocks
from skytether.server.planning.clock import ECHOES, ClockMap, shortest_ns
from skytether.shared.base.units import MILLISECOND_NS as MS
from skytether.shared.base.units import SECOND_NS as S

half_trip_ns = from_python(clocks.half_trip_ns)

quick = settings(max_examples=25)

DT_NS = 50 * MS
HOUR = 3600 * S
ROW = np.array([0])


def observe(
    clock: ClockMap, now_ns: int, offset_ns: int, *, down_ns: int, up_ns: int, row: int = 0
) -> int:
    """One observation and its echo, over a network of these delays; returns the adopted offset."""
    clock.observe(row, down_ns - offset_ns, up_ns + offset_ns, heard=now_ns // MS, now_ns=now_ns)
    return int(clock.offset_ns(np.array([row]))[0])


def listen(
    clock: ClockMap,
    times_ns: Iterable[int],
    offset_ns: Callable[[int], int],
    *,
    down_ns: int = 400 * MS,
    up_ns: int = 400 * MS,
) -> list[int]:
    return [
        observe(clock, now, offset_ns(now), down_ns=down_ns, up_ns=up_ns) - offset_ns(now)
        for now in times_ns
    ]


def times(start_s: float, end_s: float) -> range:
    return range(round(start_s * S), round(end_s * S), DT_NS)


@quick
@example(2**55, S, S)
@example(-(2**55), 0, S)
@given(st.integers(-(2**55), 2**55), st.integers(0, S), st.integers(0, S))
def test_an_offset_errs_by_half_the_difference_of_its_delays(
    offset_ns: int, down_ns: int, up_ns: int
) -> None:
    """The smallest possible error; it stays within the published bound."""
    clock = ClockMap(1, DT_NS)
    error = observe(clock, 5 * S, offset_ns, down_ns=down_ns, up_ns=up_ns) - offset_ns
    assert error == (up_ns - down_ns) // 2
    assert half_trip_ns(clock.seen, 0) == (up_ns + down_ns) // 2
    assert abs(error) <= (up_ns + down_ns + 1) // 2


def test_smallest_delay_of_each_direction_counts() -> None:
    clock = ClockMap(1, DT_NS)
    observe(clock, 0, HOUR, down_ns=400 * MS, up_ns=900 * MS)
    observe(clock, 1 * S, HOUR, down_ns=800 * MS, up_ns=400 * MS)
    assert clock.offset_ns(ROW).tolist() == [HOUR]
    assert half_trip_ns(clock.seen, 0) == 400 * MS


def test_small_movements_do_not_change_the_offset() -> None:
    """Up to half a step, 25 ms, it stays; beyond, it follows completely."""
    clock = ClockMap(1, DT_NS)
    observe(clock, 0, 0, down_ns=400 * MS, up_ns=400 * MS)
    adopted = [
        observe(clock, 1 * S, 0, down_ns=down_ns, up_ns=400 * MS)
        for down_ns in (390 * MS, 360 * MS, 350 * MS, 349 * MS)
    ]
    assert adopted == [0, 0, 0, 25 * MS + MS // 2]


def test_old_minima_are_forgotten_after_twenty_seconds() -> None:
    clock = ClockMap(1, DT_NS)
    observe(clock, 0, HOUR, down_ns=100 * MS, up_ns=300 * MS)
    listen(clock, times(0.5, 20), lambda _: HOUR)
    assert half_trip_ns(clock.seen, 0) == 200 * MS
    listen(clock, times(20, 20.5), lambda _: HOUR)
    assert half_trip_ns(clock.seen, 0) == 400 * MS
    assert clock.offset_ns(ROW).tolist() == [HOUR]


@pytest.mark.parametrize("silence_s", [20, 1000])
def test_nothing_is_left_of_before_a_long_silence(silence_s: int) -> None:
    clock = ClockMap(1, DT_NS)
    listen(clock, times(100, 110), lambda _: 0)
    listen(clock, times(110 + silence_s, 111 + silence_s), lambda _: HOUR)
    assert clock.offset_ns(ROW).tolist() == [HOUR]


@pytest.mark.parametrize(("at_s", "most"), [(10.0, 20), (10.1, 30)])
@pytest.mark.parametrize("jump_ns", [HOUR, -100 * MS])
def test_offset_follows_a_stepped_clock_within_a_second_and_a_half(
    jump_ns: int, at_s: float, most: int
) -> None:
    """A clock step counts after three consecutive half seconds with only newer measurements.

    If it falls within a half second, half a second later.
    """
    clock = ClockMap(1, DT_NS)
    assert set(listen(clock, times(0, at_s), lambda _: 0)) == {0}
    errors = listen(clock, times(at_s, 30), lambda _: jump_ns)
    assert 0 not in errors[:20]
    assert set(errors[most:]) == {0}


def test_without_the_step_rule_the_offset_does_not_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise half of the step is missing until the window of 20 s has passed."""
    monkeypatch.setattr(clocks, "_steps", clocks._steps.py_func)
    monkeypatch.setattr(clocks, "_drop_stepped", lambda *_: None)
    clock = ClockMap(1, DT_NS)
    listen(clock, times(0, 10), lambda _: 0)
    errors = listen(clock, times(10, 31), lambda _: HOUR)
    assert set(errors[20 * 2 : 20 * 19]) == {-HOUR // 2}
    assert errors[-1] == 0


@pytest.mark.parametrize("behind_ns", [0, 1, DT_NS - 1])
def test_steps_are_counted_on_the_vehicle_s_clock(behind_ns: int) -> None:
    clock, rows = ClockMap(3, DT_NS), np.array([2, 0])
    for row, began_ns in ((2, 7 * S), (0, -3 * S)):
        observe(clock, 0, -began_ns, down_ns=0, up_ns=0, row=row)
    now_ns = 10 * S + behind_ns
    assert clock.steps(rows, now_ns).tolist() == [3 * 20, 13 * 20]
    assert clock.steps(rows[1:], now_ns - S).tolist() == [12 * 20]


@quick
@given(st.integers(0, 300), st.integers(0, 300))
def test_slower_network_is_no_stepped_clock(down_ms: int, up_ms: int) -> None:
    clock = ClockMap(1, DT_NS)
    listen(clock, times(0, 10), lambda _: 0)
    slower = {"down_ns": (400 + down_ms) * MS, "up_ns": (400 + up_ms) * MS}
    assert set(listen(clock, times(10, 14), lambda _: 0, **slower)) == {0}
    assert half_trip_ns(clock.seen, 0) == 400 * MS


def after_change(down_ns: int, up_ns: int, *, before: range, since: int) -> int:
    """Bound [ns] once both delays changed after 400 ms each, and `since` packets arrived."""
    clock = ClockMap(1, DT_NS)
    listen(clock, before, lambda _: 0)
    start_s = 4 + before[-1] / S
    listen(
        clock,
        list(times(start_s, start_s + 1.2))[-since:],
        lambda _: 0,
        down_ns=down_ns,
        up_ns=up_ns,
    )
    return half_trip_ns(clock.seen, 0)


@pytest.mark.parametrize(("jump_ms", "bound_ms"), [(40, 380), (41, 400)])
def test_step_is_a_change_by_more_than_40_ms(jump_ms: int, bound_ms: int) -> None:
    """Smaller changes wait for the window; here both delays are constant and the clock steps."""
    clock = ClockMap(1, DT_NS)
    listen(clock, times(0, 10), lambda _: 0)
    listen(clock, times(10, 13), lambda _: jump_ms * MS)
    assert half_trip_ns(clock.seen, 0) == bound_ms * MS


def test_change_that_differs_between_directions_is_no_stepped_clock() -> None:
    """A step changes both directions equally, to within 40 ms or a fifth."""
    before = times(0, 10)
    assert after_change(300 * MS, 700 * MS, before=before, since=20) == 350 * MS
    assert after_change(300 * MS, 510 * MS, before=before, since=20) == 405 * MS
    assert after_change(100 * MS, 750 * MS, before=before, since=20) == 425 * MS
    assert after_change(100 * MS, 780 * MS, before=before, since=20) == 250 * MS


@pytest.mark.parametrize("every", [7, 10])
def test_the_step_of_a_clock_is_found_of_a_quiet_vehicle(every: int) -> None:
    """At two or three packets a second, the recent past extends until it has five."""
    clock = ClockMap(1, DT_NS)
    quiet = list(times(0, 10))[::every]
    listen(clock, quiet, lambda _: 0)
    errors = listen(clock, list(times(10, 20))[::every], lambda _: HOUR)
    assert set(errors[30 * 2 // every * 2 :]) == {0}


FEW = ((4, 300), (5, 400))
"""Number of packets, and the resulting bound [ms]."""


@pytest.mark.parametrize(
    ("before", "since", "bound_ms"),
    [
        *((times(0, before_s), since, ms) for before_s in (10, 30) for since, ms in FEW),
        *((range(0, count * DT_NS, DT_NS), 20, ms) for count, ms in FEW),
    ],
)
def test_four_packets_are_too_few_to_tell_a_stepped_clock(
    before: range, since: int, bound_ms: int
) -> None:
    """Before or after the step: the minimum of four is unreliable; also where the ring wraps."""
    assert after_change(200 * MS, 600 * MS, before=before, since=since) == bound_ms * MS


def test_drifting_clock_is_followed() -> None:
    """At 200 ppm the window adds 2 ms, and hysteresis half a step."""
    clock = ClockMap(1, DT_NS)
    errors = listen(clock, times(0, 300), lambda now: HOUR + now * 200 // 1_000_000)
    assert max(np.abs(errors)) <= DT_NS // 2 + 2 * MS + 1


@pytest.mark.parametrize("offset_ns", [-HOUR, HOUR + 10 * MS])
def test_forgotten_vehicle_is_measured_anew(offset_ns: int) -> None:
    clock = ClockMap(1, DT_NS)
    listen(clock, times(0, 10), lambda _: HOUR, down_ns=10 * MS, up_ns=10 * MS)
    clock.forget(0)
    assert observe(clock, 10 * S, offset_ns, down_ns=300 * MS, up_ns=300 * MS) == offset_ns
    assert half_trip_ns(clock.seen, 0) == 300 * MS


def test_vehicles_have_clocks_of_their_own() -> None:
    clock, rows = ClockMap(4, DT_NS), np.array([3, 0, 2])
    for now in times(0, 20):
        stepped = HOUR if now >= 10 * S else 0
        for row, offset_ns in ((3, stepped), (0, -7 * HOUR), (2, 5 * MS)):
            delay_ns = (100 + 50 * row) * MS
            observe(clock, now, offset_ns, down_ns=delay_ns, up_ns=delay_ns, row=row)
        together = clock.offset_ns(rows)
    clock.forget(1)
    assert together.tolist() == [HOUR, -7 * HOUR, 5 * MS]
    assert [half_trip_ns(clock.seen, row) for row in (3, 0, 2)] == [250 * MS, 100 * MS, 200 * MS]


def shortest_ms(clock: ClockMap, row: int = 0) -> float:
    """Shortest delay of the newest packets to a vehicle [ms], or -1 if unknown."""
    clock.offset_ns(np.array([row]))
    shortest = int(shortest_ns.py_func(clock.seen, row))
    return shortest / MS if shortest >= 0 else -1.0


def test_the_shortest_of_the_newest_echoes_tells_the_delay_of_now() -> None:
    """It follows once all have grown; the clock map itself keeps the smallest of 20 s."""
    clock, known = ClockMap(1, DT_NS), []
    delays_ms = [400] * 6 + [700, 900, 800, 750, 900, 900, 410, 900]
    for now, up_ms in zip(times(1, 10), delays_ms, strict=False):
        observe(clock, now, HOUR, down_ns=400 * MS, up_ns=up_ms * MS)
        known.append(shortest_ms(clock))
    assert known[:ECHOES] == [-1.0] * (ECHOES - 1) + [400.0]
    assert known[ECHOES:] == [400.0] * 5 + [700.0, 750.0, 750.0, 410.0, 410.0]
    assert half_trip_ns(clock.seen, 0) == 400 * MS


def test_a_word_of_ours_that_is_echoed_again_is_no_new_echo() -> None:
    """While no packet reaches the vehicle, the present uplink delay is unknown."""
    clock = ClockMap(1, DT_NS)
    for _ in range(10 * ECHOES):
        clock.observe(0, 400 * MS, 400 * MS, heard=7, now_ns=8 * S)
    assert shortest_ms(clock) == -1.0
    for heard in range(ECHOES):
        clock.observe(0, 400 * MS, 400 * MS, heard=8 + heard, now_ns=9 * S)
    assert shortest_ms(clock) == 400.0
    clock.forget(0)
    clock.observe(0, 400 * MS, 400 * MS, heard=9, now_ns=9 * S)
    assert shortest_ms(clock) == -1.0


def test_an_echo_that_is_overtaken_bounds_nothing() -> None:
    """It may be as old as the silence before it, during which the clocks drift."""
    clocks = [ClockMap(1, DT_NS) for _ in range(2)]
    for clock, in_order in zip(clocks, (True, False), strict=True):
        clock.observe(0, 400 * MS, 400 * MS, heard=1, now_ns=10 * S)
        clock.observe(0, 400 * MS, 400 * MS, heard=3, now_ns=40 * S)
        high_ns = int(clock.seen.vehicles["high"][0])
        clock.observe(0, 400 * MS, 380 * MS, heard=2, now_ns=41 * S, is_newest=in_order)
        assert (int(clock.seen.vehicles["high"][0]) < high_ns) == in_order


@pytest.mark.parametrize("seed", range(2))
def test_offset_is_right_to_half_a_step_on_the_papers_network(seed: int) -> None:
    """(17) each way, one packet in ten lost, for a minute: below 25 ms after the first second."""
    rng, clock = np.random.default_rng(seed), ClockMap(1, DT_NS)
    errors = []
    for now in times(0, 60):
        down_ns, up_ns = 400 * MS + 20 * MS * rng.poisson(2.0, size=2)
        if rng.random() > 0.1:
            adopted = observe(clock, now, HOUR, down_ns=int(down_ns), up_ns=int(up_ns))
            errors.append(adopted - HOUR)
            assert half_trip_ns(clock.seen, 0) >= 400 * MS
    assert max(np.abs(errors[20:])) < 25 * MS
