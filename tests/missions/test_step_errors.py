"""Vehicles whose present steps are uncertain to the server, and the distances kept for that.

Different delays in the two directions cause an error of the clock offset that no packet reveals. So
every motion is compared with all possible places of another vehicle at each time.
"""

from collections.abc import Callable
from typing import Literal

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fuzz.adversary.lives import Lives
from helpers import packaged
from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.proxy import Proxy
from skytether.server.missions.half_planes import half_planes
from skytether.server.missions.possible_motions import NEVER, PossibleMotion, PossibleMotions
from skytether.server.missions.separation import too_near
from skytether.server.planning.clock import EXACT, ClockMap, Contradiction, StepError
from skytether.shared.base.units import MILLISECOND_NS as MS
from skytether.shared.base.units import SECOND_NS as S
from skytether.shared.endpoints.time_of_day import DRIFT
from skytether.shared.events.flight import ClockContradicted
from skytether.shared.law.model import Array
from skytether.shared.law.motion import SPACING, Motion, resting
from skytether.shared.missions.derived import zones
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.sim import flight
from skytether.theorem.hypotheses import broken, hypotheses
from two_vehicles import clear_m, drawn, left_m, separation_m

DT_S, DT_NS = 0.05, 50 * MS
SCALE, ROWS = np.array([1.0, 0.7]), np.array([0])

errors = st.builds(
    lambda late, width: StepError(width - late, late), st.floats(-20.0, 20.0), st.floats(0.0, 30.0)
)
"""Errors of steps; a vehicle may with certainty be ahead of its counted step, or behind."""


def least_m(
    one: Motion, other: Motion, begin: int, mine: StepError, its: StepError, scale: Array = SCALE
) -> float:
    """Least distance over all steps and all errors of both, by enumeration [m]."""
    steps = np.arange(begin, max(one.last, other.last) + 80.0, 0.5)
    here = one.at(steps, DT_S)[0]
    shifts = np.append(
        np.arange(-its.late - mine.early, its.early + mine.late, 0.5), its.early + mine.late
    )
    nearest = [
        np.linalg.norm(scale * (here - other.at(steps + d, DT_S)[0]), axis=1).min() for d in shifts
    ]
    return float(min(nearest))


@settings(max_examples=10)
@given(st.integers(0, 2**31), st.integers(0, 60), errors, errors, st.integers(2, 3))
def test_a_motion_is_compared_with_all_that_another_may_be_at_each_time(
    seed: int, begin: int, mine: StepError, its: StepError, axes: int
) -> None:
    """A motion that comes too near for any pair of errors is refused, and few others are."""
    rng, keep_m = np.random.default_rng(seed), 1.5
    scale = np.array([1.0, 0.7, 0.5])[:axes]
    motion, *others = (drawn(rng, axes) for _ in range(9))
    flown, far = PossibleMotions(scale, DT_S), resting(0, np.full(axes, 100.0))
    for row, other in enumerate(others, start=1):
        flown.add(row, PossibleMotion(other, error=its))
    hit = too_near(PossibleMotion(motion, error=mine), far, begin, 0, flown, keep_m)
    for other, is_hit in zip(others, hit, strict=False):
        least = least_m(motion, other, begin, mine, its, scale)
        # Between the steps tried here they may be nearer by 3 cm at 1.2 m/s.
        assert is_hit >= (least < keep_m)
        assert is_hit <= (least < keep_m + 0.06)


@settings(max_examples=15)
@given(st.integers(0, 2**31), errors)
def test_errors_of_one_vehicle_count_as_much_as_those_of_the_other(
    seed: int, error: StepError
) -> None:
    rng, keep_m = np.random.default_rng(seed), 1.5
    one, other, far = (
        drawn(rng),
        drawn(rng),
        resting(0, np.array([100.0, 0.0])),
    )
    there = resting(0, other.position[-1])
    for second, mine, its in ((other, error, EXACT), (other, EXACT, error), (there, error, error)):
        flown = PossibleMotions(SCALE, DT_S)
        flown.add(1, PossibleMotion(second, error=its))
        hit = too_near(PossibleMotion(one, error=mine), far, 0, 0, flown, keep_m)[0]
        least = least_m(one, second, 0, mine, its)
        assert (least < keep_m) <= hit <= (least < keep_m + 0.06)
    flown = PossibleMotions(SCALE, DT_S)
    flown.add(1, PossibleMotion(there, error=StepError(1e4, 1e4)))
    known = least_m(resting(0, one.position[-1]), there, 0, EXACT, EXACT)
    at_rest = PossibleMotion(resting(0, one.position[-1]))
    hit = too_near(at_rest, far, 0, 0, flown, known - 1e-6)
    assert not hit[0]


@settings(max_examples=25)
@given(st.integers(0, 2**31), errors, errors)
def test_half_planes_are_in_front_of_all_that_another_may_be_at_a_time(
    seed: int, mine: StepError, its: StepError
) -> None:
    """The motion in force, which is the way out, is never behind one."""
    rng, times, apart_m = np.random.default_rng(seed), np.arange(0.0, 121.0, 5.0), 0.9
    other, base = drawn(rng), drawn(rng)
    flown, held = PossibleMotions(np.ones(2), DT_S), base.at(times, DT_S)[0]
    flown.add(1, PossibleMotion(other, error=its))
    reach_m = np.full(len(times), 9.0)
    found = half_planes(times, held, reach_m, 0, NEVER, flown, apart_m, mine)
    assert len(found.time) > 0
    for at, normal, least in zip(found.time, found.normal, found.bound, strict=True):
        shifts = np.arange(-its.late - mine.early, its.early + mine.late, 0.25)
        ways = other.at(times[at] + shifts, DT_S)[0] if len(shifts) else np.zeros((0, 2))
        own = float(normal @ held[at])
        assert own > least
        furthest = float((ways @ normal).max(initial=-np.inf))
        assert least > min(furthest + apart_m - 0.01, own - 1e-3)


def test_what_is_on_its_way_when_it_lands_is_so_at_its_own_time() -> None:
    """A vehicle that lands two seconds earlier than counted is below its motion then."""
    above = resting(0, np.array([0.0, 0.0, 6.0]))
    T = SPACING * DT_S
    velocity = np.array([[0.0], *[[0.8]] * 9, [0.0]]) * np.array([1.0, 0.0, 0.0])
    moved = np.cumsum(0.5 * T * (velocity[1:] + velocity[:-1]), axis=0)
    passes = Motion(0, np.array([-2.0, 0.0, 2.0]) + np.vstack([np.zeros((1, 3)), moved]), velocity)
    far = resting(0, np.full(3, 100.0))
    for error, is_hit in (
        (EXACT, False),
        (StepError(60.0, 0.0), True),
        (StepError(0.0, 60.0), False),
    ):
        flown = PossibleMotions(np.ones(3), DT_S)
        flown.add(1, PossibleMotion(above, 100, error))
        assert too_near(PossibleMotion(passes), far, 0, 0, flown, 0.9)[0] == is_hit


def test_two_that_keep_the_distance_come_no_nearer_by_what_pieces_are_off() -> None:
    """The tolerance of the motion in force differs at another step; that is not too near."""
    rng, far = np.random.default_rng(5), resting(0, np.array([100.0, 0.0]))
    for _ in range(60):
        base, other = drawn(rng), drawn(rng)
        flown = PossibleMotions(np.ones(2), DT_S)
        flown.add(1, PossibleMotion(other))
        low, high = 0.0, 20.0
        for _ in range(40):  # the largest distance that is kept
            keep_m = 0.5 * (low + high)
            is_hit = too_near(PossibleMotion(base), far, 0, 0, flown, keep_m)[0]
            low, high = (low, keep_m) if is_hit else (keep_m, high)
        nearer = base._replace(
            position=base.position + 0.02 * np.sign(other.position[-1] - base.position[-1])
        )
        for begin in range(0, 10, 3):
            least = least_m(nearer, other, begin, EXACT, EXACT, np.ones(2))
            if least < low - 1e-3:
                assert too_near(PossibleMotion(nearer), base, begin, 0, flown, low)[0]


def above_ground(motion: Motion) -> Motion:
    return motion._replace(position=motion.position + np.array([0.0, 0.0, 20.0]))


def landing_m(
    one: Motion, other: Motion, begin: int, mine: StepError, its: StepError, lands: list[int]
) -> float:
    """Least distance as in `least_m`, where each vehicle may land from its own step on [m]."""
    steps = np.append(np.arange(begin, max(one.last, other.last) + 80.0, 0.5), 1e3)
    here, nearest = one.at(steps, DT_S)[0], np.inf
    for shift in np.arange(-its.late - mine.early, its.early + mine.late + 0.5, 0.5):
        away = here - other.at(steps + shift, DT_S)[0]
        above, below = away[:, 2] > 0.0, away[:, 2] < 0.0
        passes = above & (steps >= lands[0]) | below & (steps + shift >= lands[1])
        away[passes, 2] = 0.0
        nearest = min(nearest, float(np.linalg.norm(away, axis=1).min()))
    return nearest


def test_who_keeps_the_distance_goes_on_to_keep_it() -> None:
    """For any landing; only vehicles that are already too near may stay as near."""
    keep_m, accepted = 1.2, 0
    for seed in range(1000, 1100):
        rng = np.random.default_rng(seed)
        motion, other = (above_ground(drawn(rng, 3)) for _ in range(2))
        mine, its = (StepError(*rng.uniform(0.0, 8.0, 2)) for _ in range(2))
        lands = [NEVER if rng.random() < 0.3 else int(rng.integers(250)) for _ in range(2)]
        # At rest above the other's way, and from there to some place.
        place = other.position[len(other.position) // 2] + rng.uniform([-1, -1, 1], [1, 1, 4])
        base = resting(0, place)
        motion = Motion(0, motion.position - motion.position[0] + place, motion.velocity)
        flown = PossibleMotions(np.ones(3), DT_S)
        flown.add(1, PossibleMotion(other, lands[1], its))
        if too_near(PossibleMotion(motion, lands[0], mine), base, 0, 0, flown, keep_m)[0]:
            continue
        accepted += 1
        # Between the steps tried here they may be nearer by 3 cm at 1.2 m/s.
        least = landing_m(motion, other, 0, mine, its, lands) + 0.06
        if least < keep_m:
            assert least > landing_m(base, other, 0, mine, its, lands)
    assert accepted > 50


# -- bounds of clock offsets -----------------------------------------------------------------------


@settings(max_examples=50)
@example(  # an echo that came just after an observation that was under way for a second
    0, 0, 0.0006185726470246367, [(1.0, 0.0, 0.0)] * 4 + [(1.0, 1.0, 0.0), (1.0, 0.125, 0.0)]
)
@given(
    st.integers(0, 2**31),
    st.integers(-(10**15), 10**15),
    st.floats(-0.999e-3, 0.999e-3),
    st.lists(st.tuples(st.floats(0.01, 4.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0)), min_size=1),
)
def test_no_delay_makes_the_bounds_of_an_offset_false(
    seed: int, offset_ns: int, drift: float, packets: list[tuple[float, float, float]]
) -> None:
    rng, known = np.random.default_rng(seed), ClockMap(1, DT_NS)
    now_ns, rows = 1000 * S, np.array([0])
    known.forget(0, 7)
    early, late = np.zeros((2, 1))

    def true_ns(at_ns: int) -> int:
        return offset_ns + round(drift * (at_ns - 1000 * S))

    came_ns, heard, backward_ns = now_ns, 0, 0
    for after_s, down_s, up_s in packets:
        sent_ns = now_ns + round(after_s * S)
        if rng.random() < 0.7 or not heard:  # an echo arrived since the last observation
            heard, came_ns = heard + 1, now_ns + round(rng.random() * (sent_ns - now_ns))
            backward_ns = true_ns(came_ns) + round(up_s * S)
        arrived_ns = sent_ns + round(down_s * S)
        known.observe(
            0, round(down_s * S) - true_ns(sent_ns), backward_ns, heard=heard, now_ns=arrived_ns
        )
        now_ns = arrived_ns
        tick_ns = now_ns // DT_NS * DT_NS + DT_NS
        steps = known.steps(rows, tick_ns)
        known.step_errors(rows, steps, early, late)
        step = (tick_ns + true_ns(tick_ns)) / DT_NS
        assert -late[0] - 1e-6 <= step - steps[0] <= early[0] + 1e-6
        assert known.seen.vehicles["steps"][0] == 0
        if rng.random() < 0.1:
            known.forget(0, 7)


def test_a_bound_that_was_found_is_kept_but_for_the_drift_of_clocks() -> None:
    """The estimate forgets after 20 s; a single short delay stays valid for long."""
    known, rows, width = ClockMap(1, DT_NS), np.array([0]), []
    for at_s in range(100):
        delay_ns = (10 if at_s == 3 else 400) * MS
        known.observe(0, delay_ns, delay_ns, heard=at_s, now_ns=at_s * S)
        early, late = np.zeros((2, 1))
        known.step_errors(rows, known.steps(rows, at_s * S), early, late)
        width.append(float(early[0] + late[0]) * DT_S)
    assert width[2] == pytest.approx(0.8, abs=0.01)
    assert width[3] == pytest.approx(0.02, abs=0.01)
    assert width[99] == pytest.approx(0.02 + 2 * 96 / DRIFT, abs=0.01)


def test_another_life_of_a_vehicle_has_another_clock() -> None:
    """Another session of the same life has the same clock."""
    known, rows = ClockMap(1, DT_NS), np.array([0])
    known.forget(0, (1, 1))
    known.observe(0, 10 * MS, 10 * MS, heard=0, now_ns=S)
    for boot_id, width_s in ((1, 0.02), (2, 0.8)):
        known.forget(0, (1, boot_id))
        known.observe(0, 400 * MS, 400 * MS, heard=1, now_ns=2 * S)
        early, late = np.zeros((2, 1))
        known.step_errors(rows, known.steps(rows, 2 * S), early, late)
        assert float(early[0] + late[0]) * DT_S == pytest.approx(width_s, abs=0.04)


def test_a_clock_that_was_set_is_noticed_and_known_anew() -> None:
    """A step by less than a round trip is not detected: setting clocks voids the guarantee."""
    known, rows = ClockMap(1, DT_NS), np.array([0])
    for at_s in range(20):
        offset_ns = 5 * S if at_s > 9 else 0
        known.observe(0, 100 * MS - offset_ns, 100 * MS + offset_ns, heard=at_s, now_ns=at_s * S)
    assert known.seen.vehicles["steps"][0] == 1
    early, late = np.zeros((2, 1))
    known.step_errors(rows, known.steps(rows, 19 * S), early, late)
    assert float(early[0] + late[0]) * DT_S == pytest.approx(0.2, abs=0.01)


def width_s(known: ClockMap, now_ns: int) -> float:
    early, late = np.zeros((2, 1))
    known.step_errors(ROWS, known.steps(ROWS, now_ns), early, late)
    return float(early[0] + late[0]) * DT_S


def listen(
    known: ClockMap, begin_s: int, end_s: int, up_s: float, down_s: float
) -> set[Contradiction]:
    """Contradictions found by observations, one a second over these delays, with equal clocks."""
    found = set()
    for at_s in range(begin_s, end_s):
        sample = round(down_s * S), round(up_s * S)
        found.add(known.observe(0, *sample, heard=at_s, now_ns=at_s * S))
    return found


def test_an_operator_s_word_on_the_delays_bounds_the_clock() -> None:
    """After enough packets for minima, plus the clocks' drift over 20 s."""
    known = ClockMap(1, DT_NS, asymmetry_ns=100 * MS)
    for end_s, expected_s in ((4, 0.85), (30, 0.14)):
        assert listen(known, max(end_s - 26, 0), end_s, 0.43, 0.4) == {Contradiction.NOTHING}
        assert width_s(known, end_s * S) == pytest.approx(expected_s, abs=0.04)


def test_an_operator_s_word_is_dropped_when_delays_contradict_it() -> None:
    known = ClockMap(1, DT_NS, asymmetry_ns=100 * MS)
    listen(known, 0, 30, 0.1, 0.1)
    assert width_s(known, 30 * S) < 0.15
    assert Contradiction.ASYMMETRY in listen(known, 30, 60, 0.1, 1.1)
    assert width_s(known, 60 * S) == pytest.approx(0.2 + 2 * 30 / DRIFT, abs=0.03)
    listen(known, 60, 120, 0.4, 0.4)
    assert width_s(known, 120 * S) > 0.2


def test_the_time_of_day_bounds_the_clock_and_the_step() -> None:
    """Delays that differ by 0.8 s become visible; the counted step is the true one."""
    known = ClockMap(1, DT_NS)
    for at_s in range(0, 20, 2):
        assert listen(known, at_s, at_s + 2, 0.05, 0.85) == {Contradiction.NOTHING}
        assert known.tell(0, 2 * MS, 5 * MS, now_ns=(at_s + 2) * S) is Contradiction.NOTHING
    assert width_s(known, 20 * S) == pytest.approx(0.01, abs=0.001)
    assert known.steps(ROWS, 20 * S + DT_NS // 2).tolist() == [20 * 20]


def test_a_time_of_day_that_cannot_be_is_told_and_all_counts_that_may_be() -> None:
    """Neither bound is used alone, even after the time of day is right again."""
    known = ClockMap(1, DT_NS)
    listen(known, 0, 5, 0.1, 0.1)
    assert known.tell(0, 400 * MS, 5 * MS, now_ns=5 * S) is Contradiction.TIME_OF_DAY
    assert width_s(known, 5 * S) == pytest.approx(0.505, abs=0.02)
    assert known.tell(0, 0, 5 * MS, now_ns=5 * S) is Contradiction.NOTHING
    assert width_s(known, 5 * S) == pytest.approx(0.505, abs=0.02)


def test_a_word_that_the_time_of_day_contradicts_is_dropped() -> None:
    """The constant difference that no packet shows."""
    known = ClockMap(1, DT_NS, asymmetry_ns=100 * MS)
    listen(known, 0, 10, 0.05, 0.85)
    assert width_s(known, 10 * S) < 0.15
    assert known.tell(0, 0, 5 * MS, now_ns=10 * S) is Contradiction.ASYMMETRY
    assert width_s(known, 10 * S) == pytest.approx(0.01, abs=0.001)


def test_the_figures_tell_what_a_clock_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """In flight the uncertainty of the place; at rest 0, for any clock."""
    delay(monkeypatch, turns(0.05, 0.85))
    lives = Lives(mission("swap", "swap(2)", 30.0))
    for at_s, at_least_m, at_most_m in ((2.0, 0.0, 0.01), (7.0, 0.2, 0.7)):
        lives.run(at_s)
        figures = lives.server_runs[-1].figures()["by_vehicle"]["1"]
        assert 440.0 < figures["clock_bound_ms"] < 500.0
        assert at_least_m <= figures["clock_m"] <= at_most_m
    assert "clock_steps" not in lives.server_runs[-1].figures()["counts"]


# -- flights with asymmetric delays ----------------------------------------------------------------

Delays = Callable[[int], tuple[float, float]]
"""Delay of a vehicle up and down [s], by the number of its flow."""


def turns(up_s: float, down_s: float) -> Delays:
    """Alternating vehicles: one delay up and the other down, or the reverse."""
    return lambda flow: (up_s, down_s) if flow % 2 else (down_s, up_s)


def odd(up_s: float, down_s: float) -> Delays:
    """One vehicle with other delays than all others."""
    return lambda flow: (up_s, down_s) if flow == 3 else (down_s, up_s)


def delay(monkeypatch: pytest.MonkeyPatch, delays: Delays) -> None:
    def fates(_: Proxy, name: Literal["uplink", "downlink"], flow: int) -> Fates:
        delay_s = delays(flow)[name == "downlink"]
        return Fates(impairments(f"constant({delay_s})"), 1, name, flow)

    monkeypatch.setattr(Proxy, "fates", fates)


def mission(name: str, shape: str = "", duration: float = 30.0) -> Scenario:
    reference = {"shape": shape} if shape else {}
    return packaged(name, duration=duration, seed=1, reference=reference)


SWAP = mission("swap", "swap(8)", 14.0)


def test_delays_that_differ_do_not_bring_vehicles_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the bounds, eight swapping vehicles came as near as 6 cm, with no packet lost and
    none outside a tube.
    """
    delay(monkeypatch, turns(0.05, 0.85))
    flown = flight.fly(SWAP, vehicles=8)
    assert separation_m(flown) > 0.5
    assert not broken(hypotheses(flown, SWAP))


def test_with_steps_taken_for_exact_delays_bring_vehicles_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    delay(monkeypatch, turns(0.05, 0.85))

    monkeypatch.setattr(ClockMap, "step_errors", lambda *_: None)  # errors stay 0
    flown = flight.fly(SWAP, vehicles=8)
    assert separation_m(flown) < 0.4
    assert broken(hypotheses(flown, SWAP)) == ["they keep apart"]


def test_with_the_time_of_day_at_both_ends_clocks_are_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To within the stated accuracy of both, with delays that differ by 0.8 s."""
    delay(monkeypatch, turns(0.05, 0.85))
    simulation = msgspec.structs.replace(SWAP.simulation, time_error_s=0.01)
    # Long enough for all to rest, and to end together: the bounds of one that has left widen.
    known = msgspec.structs.replace(SWAP, duration=40.0, simulation=simulation)
    flown = flight.fly(known, vehicles=8)
    assert separation_m(flown) > 0.5
    figures = flown.figures["server"]["by_vehicle"]
    assert max(each["clock_bound_ms"] for each in figures.values()) < 25.0
    assert not [each for each in flown.events if isinstance(each.event, ClockContradicted)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "shape", "delays"),
    [
        ("swap", "swap(8)", turns(0.05, 1.25)),
        ("swap", "swap(8)", odd(0.05, 0.85)),
        ("rings", "", turns(0.05, 0.65)),
        ("corridor", "", turns(0.05, 0.85)),
        ("warehouse", "", turns(0.05, 0.85)),
    ],
)
def test_missions_over_delays_that_differ(
    name: str, shape: str, delays: Delays, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the bounds, vehicles came as near as 5 cm in each of these."""
    scenario = mission(name, shape, 60.0)
    delay(monkeypatch, delays)
    goals = scenario.make_reference()
    assert isinstance(goals, Mission)
    flown = flight.fly(scenario, vehicles=len(goals.vehicles))
    assert separation_m(flown) >= scenario.mission.separation_m
    if scenario.mission.zones:
        assert clear_m(flown, zones(scenario)) > 0.0
    assert "left_tube" not in flown.figures["server"]["counts"]
    if name != "warehouse":  # goals change there until 150 s
        assert max(left_m(flown, scenario)) < 0.3


@pytest.mark.long
def test_the_flight_of_seed_9114_keeps_its_distance() -> None:
    """Random delays that last a minute: 0.132 m without bounds of the clocks."""
    scenario = mission("swap", "swap(8)", 60.0)
    table = reading.to_table(msgspec.structs.replace(scenario, seed=9114))
    for way in ("uplink", "downlink"):
        table["network"][way] = "uniform(0.05, 0.9, correlation_s=60)"
    flown = flight.fly(reading.check(table, "swap"), vehicles=8)
    assert separation_m(flown) > 0.5
