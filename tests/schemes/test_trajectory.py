"""Scheme "trajectory": splines, the rule of flight, the decision to send, and flights."""

import itertools
import math
from collections.abc import Sequence
from statistics import mean
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import skytether
from bench.problems import from_python
from skytether.client.compensator import Compensator
from skytether.client.navigation import Navigation
from skytether.lab.engine.sweep import summaries
from skytether.server.mpc.nominal import make_nominal, plan_nominal
from skytether.server.planning.clock import ClockMap
from skytether.server.planning.desired import Desired, Window
from skytether.server.planning.scheme import Fleet, Foresight, empty_foresight
from skytether.server.schemes import trajectory
from skytether.server.schemes.knots import fewest_knots
from skytether.server.schemes.sent import FIRST_LOSS
from skytether.server.schemes.trajectory import Guidance
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.model import Array, Indices, advance
from skytether.shared.law.spline import AxisSpline, along, follow, guided_to, regulated, spline_at
from skytether.shared.scenario import reading
from skytether.shared.scenario.gain import regulator
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import UPLINK, Record
from skytether.shared.telemetry.summary import position_error
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.protocol import (
    KNOTS_MAX,
    NO_HORIZON,
    VERSION,
    Mode,
    Observation,
    Trajectory,
    decode,
    encode,
)
from skytether.sim.flight import fly

Floats = NDArray[np.float32]

SECONDS = 20.0
LINE = {"shape": "waypoints", "points_m": [[0.0, 0.0], [80.0, 60.0]], "speed_mps": 1.0}
"""Target of constant velocity, 0.8 and 0.6 m/s."""
STILL: dict[str, Any] = ""


def scenario(**sections: Any) -> Scenario:
    """Steps of 0.1 s without wind, along LINE without preview, over a network without delay."""
    table: dict[str, Any] = {
        "duration": SECONDS,
        "settle": 12.0,
        "control": {"dt": 0.1, "scheme": "trajectory", "trigger": "expected_gap(0.01)"},
        "reference": {**LINE, "preview": "none"},
        "network": {"uplink": STILL, "downlink": STILL},
        "link": {"age_max_s": 60.0},
    }
    for section, keys in sections.items():
        table[section] = (
            table[section] | keys if section in table and isinstance(keys, dict) else keys
        )
    return reading.check(table, "test")


def sent_steps(flight: Record) -> list[int]:
    steps: list[int] = flight.server["step"][flight.server["event"]].tolist()
    return steps


def rmse_m(flown: Scenario, flight: Record) -> float:
    late = flight.client["step"] * flown.control.dt >= flown.settle
    squares = (position_error(flown, flight.client)[late] ** 2).sum(axis=1)
    return float(np.sqrt(squares.mean()))


# -- the spline ------------------------------------------------------------------------------

numbers = st.floats(-10.0, 10.0)


@settings(max_examples=15)
@given(st.tuples(*[numbers] * 4), st.integers(1, 40), st.integers(2, KNOTS_MAX))
def test_a_spline_is_exact_along_a_cubic(
    cubic: tuple[float, ...], spacing: int, count: int
) -> None:
    """In position and velocity, at every stage from its first knot to its last."""
    p, dt_s = np.polynomial.Polynomial(cubic), 0.001
    v = p.deriv()
    times = np.arange(count) * spacing * dt_s
    knots = np.stack([p(times), v(times)], axis=1).ravel()
    for stage in range((count - 1) * spacing + 1):
        found = spline_at(knots, spacing, dt_s, stage)
        assert found == pytest.approx((p(stage * dt_s), v(stage * dt_s)), abs=1e-7, rel=1e-7)


@settings(max_examples=30)
@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=KNOTS_MAX), st.integers(2, 40))
def test_pieces_join_with_the_velocity_of_the_knot(
    knots: list[tuple[float, float]], spacing: int
) -> None:
    """From either side, and at both ends, where the spline continues straight."""
    flat, dt_s = np.array(knots).ravel(), 1e-6
    for number, (p, v) in enumerate(knots):
        at = number * spacing
        assert spline_at(flat, spacing, dt_s, at) == pytest.approx((p, v))
    assert spline_at(flat, spacing, 0.1, -3)[0] == pytest.approx(knots[0][0] - 0.3 * knots[0][1])
    end = (len(knots) - 1) * spacing
    assert spline_at(flat, spacing, 0.1, end + 7) == pytest.approx(
        (knots[-1][0] + 0.7 * knots[-1][1], knots[-1][1])
    )
    # Near a knot the slope of the position is the knot's velocity on both sides.
    long = 10_000
    for number, (p, v) in enumerate(knots):
        for side in (-1, 1):
            near, _ = spline_at(flat, long, 1e-4, number * long + side)
            assert (near - p) / (side * 1e-4) == pytest.approx(v, abs=0.02)


@settings(max_examples=30)
@given(numbers, numbers, st.integers(-1000, 1000), st.integers(1, 50))
def test_one_knot_is_a_state_that_goes_on_by_itself(
    p: float, v: float, stage: int, spacing: int
) -> None:
    assert spline_at((p, v), spacing, 0.1, stage) == pytest.approx((p + stage * 0.1 * v, v))


# -- the rule of flight ----------------------------------------------------------------------


def guide(flown: Scenario, knots: Sequence[float], **other: Any) -> AxisSpline:
    """Spline on the first axis, flown for 100 stages."""
    terms = flown.terms()
    numbers = {
        "spacing": 10,
        "dt_s": terms.dt_s,
        "length": 100,
        "last": 0.0,
        "speed": 0.0,
        "brake": terms.brake,
        "bound": terms.u_max[0],
        "gain_p": 2.0,
        "gain_v": 0.5,
        "lag": 0.0,
    }
    return AxisSpline(terms.model.axes()[0], knots, **{**numbers, **other})


def test_along_a_spline_the_models_velocity_is_the_splines() -> None:
    """From v̄(i+1) = a v̄(i) + b ū(i), with the gain in b."""
    flown = scenario(model={"gain": 0.8})
    model, knots = flown.terms().model.axes()[0], (0.0, 0.2, 0.5, 0.9, 1.7, 0.4)
    _, v = spline_at(knots, 10, 0.1, 0)
    for stage in range(25):
        v = model.a11 * v + model.b1 * along(model, knots, 10, 0.1, stage)
        assert v == pytest.approx(spline_at(knots, 10, 0.1, stage + 1)[1], abs=1e-12)


def test_input_is_that_of_the_spline_and_feedback_less_the_disturbance() -> None:
    """The sum is clamped to the bound."""
    held = guide(scenario(), (1.0, 0.5))
    u, without_feedback = follow(held, 4, 1.2, 0.5, 1.1, 0.4, 0.03, 0.0)
    assert without_feedback == pytest.approx(0.5)
    assert u == pytest.approx(0.5 + 2.0 * 0.1 + 0.5 * 0.1 - 0.03)
    u, _ = follow(held, 4, 9.0, 0.5, 1.1, 0.4, 0.0, 0.0)
    assert u == held.bound


def test_input_moves_from_the_one_before_by_the_regulator_s_share() -> None:
    """By the same share of the difference at each step: 1 - λ."""
    held = guide(scenario(), (1.0, 0.5), lag=0.75)
    state = (1.2, 0.5, 1.1, 0.4, 0.03)
    wanted, without_feedback = regulated(held, 4, *state)
    assert wanted == pytest.approx(0.5 + 2.0 * 0.1 + 0.5 * 0.1 - 0.03)
    u, same = follow(held, 4, *state, -0.4)
    assert same == without_feedback
    assert u == pytest.approx(-0.4 + 0.25 * (wanted + 0.4))
    assert follow(held, 4, *state, wanted)[0] == pytest.approx(wanted)


@pytest.mark.long
def test_weight_of_changes_buys_a_smaller_error_at_the_same_effort() -> None:
    """Behind a target that only the server sees; without λ the same effort costs 0.05 m more."""

    def flown(**weights: float) -> tuple[float, float]:
        table = reading.to_table(reading.load("compare/trajectory-every-step-target"))
        table["control"] |= weights
        runs = summaries("smooth", reading.check(table, "smooth"), range(5000, 5004))
        return mean(run.rmse_xy or 0.0 for run in runs), mean(run.effort_mps for run in runs)

    rough, effort = flown(input_weight=1.58, change_weight=0.0)
    smooth, as_much = flown(input_weight=0.1, change_weight=0.6)
    assert as_much < 1.05 * effort
    assert smooth < rough - 0.03


def test_behind_its_last_stage_it_is_braked_along_and_comes_to_rest() -> None:
    """The prescribed input falls by `brake` a step, and the followed point comes to rest."""
    held = guide(
        scenario(), (0.0, 1.0), length=20, last=1.0, speed=1.0, brake=0.1, gain_p=0.0, gain_v=0.0
    )
    inputs = [follow(held, stage, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)[1] for stage in range(18, 33)]
    np.testing.assert_allclose(inputs[:2], 1.0)
    np.testing.assert_allclose(
        inputs[2:], np.maximum(1.0 - 0.1 * np.arange(1, 14), 0.0), atol=1e-12
    )
    lead, before = (0.0, 0.0), 0
    for stage in (5, 20, 21, 200, 201):
        lead, before = guided_to(held, before, stage, *lead), stage
    assert lead == pytest.approx(guided_to(held, 0, 201, 0.0, 0.0))
    assert lead[1] == pytest.approx(0.0, abs=1e-6)


def test_what_is_held_goes_on_for_ever() -> None:
    held = guide(scenario(), (0.0, 1.0), length=20, brake=0.0)
    assert guided_to(held, 0, 500, 0.0, 0.0) == pytest.approx((50.0, 1.0))


# -- decision to send ------------------------------------------------------------------------


class Moved(Desired):
    """Targets set by the test, as the server knows them."""

    moved = np.zeros((1, 2, 1, 2))

    def window(self, rows: Indices, steps: Indices, ahead: Indices) -> Window:  # noqa: ARG002
        """Positions of the targets, without a preview."""
        n = len(rows)
        states = np.repeat(self.moved, n, axis=0)
        return Window(states, np.arange(n), np.zeros(n, dtype=np.int64))


class Server:
    """Scheme with one vehicle, driven by the test."""

    def __init__(self, flown: Scenario, capacity: int = 1) -> None:
        self.terms = flown.terms()
        self.desired = Moved(flown, self.terms, capacity, capacity)
        self.clock = ClockMap(capacity, self.terms.dt_ns)
        fleet = Fleet(
            flown,
            self.terms,
            capacity,
            capacity,
            self.clock,
            self.desired,
            None,
            Stopwatch(),
            print,
        )
        self.scheme = Guidance(fleet)
        self.found: Foresight = empty_foresight(capacity, 2, 1, 1, splines=True)

    def observe(
        self, step: int, *, in_force: int = NO_HORIZON, since: int = 0, takes: int = 1
    ) -> None:
        at = (step, in_force, since, 0, 0, Mode.TRACK, takes)
        self.scheme.observe(0, Observation(1, 1, *at, np.zeros((2, 2)), np.zeros(2)))

    def at(self, step: int, *states: Sequence[float], send: bool = False) -> Any:
        """Figures for the vehicle with its target at this state of each axis."""
        if states:
            self.desired.moved = np.array(states, dtype=np.float64)[None, :, None]
        rows, steps = np.array([0]), np.array([step])
        self.scheme.foresee(rows, steps, self.found)
        self.scheme.plan(rows, steps, self.found)
        self.scheme.remember(rows, steps, self.found, np.array([send]))
        return self.scheme.figures[0]

    @property
    def d(self) -> int:
        return int(self.scheme._memory.sent.bound.steps[0])


def known(flown: Scenario, server: Server, off_m: float, off_mps: float) -> float:
    """Gap of a trajectory with these errors on one axis, as in the documents."""
    (gain_p, gain_v, _), *_ = regulator(flown).tolist()
    h, weight = (1.0 + gain_v) / gain_p, flown.control.state_weight[0]
    times = server.d * 0.1 * np.arange(1, 4)
    gap: float = weight * np.mean((off_m + times * off_mps + h * off_mps) ** 2)
    return gap


def test_target_is_sent_as_one_knot() -> None:
    server = Server(scenario())
    server.observe(7)
    server.at(8, (1.0, 0.5), (-2.0, -0.25), send=True)
    splines = server.found.splines
    assert splines.number.tolist() == [1]
    np.testing.assert_array_equal(splines.knots[0, :, :2], [[1.0, 0.5], [-2.0, -0.25]])


def test_a_target_faster_than_the_bound_is_sent_at_the_bound() -> None:
    """Both ends limit it to the vehicle's speed; the server sees the growing distance."""
    server = Server(scenario(model={"u_max": [1.5]}))
    server.observe(0)
    server.at(1, (0.0, 2.0), (0.0, -3.0), send=True)
    assert server.found.splines.knots[0, :, 1].tolist() == [1.5, -1.5]
    away = server.at(11, (2.0, 2.0), (-3.0, -3.0))
    assert away["deviation_m"] == pytest.approx(np.hypot(0.5, 1.5))


def test_gap_is_the_mean_over_what_may_be_followed() -> None:
    """A trajectory under way counts with its probability of arrival; otherwise hovering does."""
    flown = scenario()
    server = Server(flown)
    server.observe(0)
    fresh = server.at(1, (0.0, 1.0), (0.0, 0.0), send=True)
    assert fresh["fresh"]
    held = server.at(2, (0.1, 1.0), (0.0, 0.0))
    assert not held["fresh"]
    assert held["cost_gap"] == pytest.approx(0.0, abs=1e-9)
    hovering = known(flown, server, 0.1, 1.0)
    assert held["expected_gap"] == pytest.approx(FIRST_LOSS * hovering, rel=1e-6)


def test_gap_of_what_is_in_force_is_certain() -> None:
    flown = scenario()
    server = Server(flown)
    server.observe(0)
    server.at(1, (0.0, 1.0), (0.0, 0.0), send=True)
    server.observe(3, in_force=1, since=2)
    same = server.at(4, (0.3, 1.0), (0.0, 0.0))
    assert same["expected_gap"] == pytest.approx(0.0, abs=1e-9)
    turned = server.at(4, (0.3, 0.5), (0.0, 0.0))
    assert turned["expected_gap"] == pytest.approx(known(flown, server, 0.0, 0.5), rel=1e-6)
    assert turned["expected_gap"] == turned["cost_gap"]
    assert turned["deviation_m"] == pytest.approx(server.d * 0.05)


def test_what_is_known_to_be_lost_is_followed_by_nobody() -> None:
    """Once a delay bound has passed, the gap is that of the trajectory in force."""
    flown = scenario()
    server = Server(flown)
    server.observe(0)
    server.at(1, (0.0, 1.0), (0.0, 0.0), send=True)
    server.observe(3, in_force=1, since=2)
    server.at(4, (0.3, 0.5), (0.0, 0.0), send=True)
    due = 4 + server.d
    server.observe(due - 1, in_force=1, since=2)
    waiting = server.at(due, (0.3 + 0.05 * (due - 4), 0.5), (0.0, 0.0)).copy()
    server.observe(due, in_force=1, since=2)
    lost = server.at(due + 1, (0.3 + 0.05 * (due - 3), 0.5), (0.0, 0.0))
    assert server.scheme.counts["horizons_lost"] == 1
    assert waiting["cost_gap"] == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < waiting["expected_gap"] < lost["expected_gap"]
    off_m = 0.5 * 0.1 * (due - 3)
    assert lost["expected_gap"] == pytest.approx(known(flown, server, off_m, 0.5), rel=1e-5)


def test_the_longer_an_observation_knows_nothing_of_it_the_less_likely_it_comes() -> None:
    """The probability follows from Bayes' rule, the measured delays and the loss."""
    server = Server(scenario(control={"delay_bound": 1.0}))
    made, delays = 0, [2, 2, 4, 8]
    server.observe(0)
    for delay in delays:
        server.at(made + 1, (0.0, 0.0), (0.0, 0.0), send=True)
        server.observe(made + 1 + delay, in_force=made + 1, since=made + 1 + delay)
        made += 1 + delay
    server.at(made + 1)
    loss = float(server.scheme._memory.sent.delivery["loss"][0])
    bound = server.scheme._memory.sent.bound
    for since, later in ((0, 4), (1, 4), (2, 2), (4, 1), (8, 0)):
        share = (1.0 - loss) * ((later + 1) / 5 if since else 1.0)
        found = from_python(trajectory._arrives)(bound, 0, loss, since)
        assert found == pytest.approx(share / (share + loss))


def test_a_vehicle_has_nothing_to_fly_until_it_is_sent_something_and_once_that_is_too_old() -> None:
    """Observed at step 10, the packet of step 12 is flown up to step 30."""
    server = Server(scenario(link={"age_max_s": 2.0}, control={"delay_bound": 0.5}))
    server.observe(10)
    assert server.at(11)["fresh"]
    assert server.at(12, send=True)["fresh"]
    last = 30 - server.d
    assert not any(server.at(step)["fresh"] for step in (13, last))
    server.observe(15)
    assert server.at(last + 1)["fresh"]


def test_a_vehicle_that_is_not_heard_is_not_flooded() -> None:
    """A trajectory that would arrive too old is not sent anew at every step."""
    server = Server(scenario(link={"age_max_s": 2.0}, control={"delay_bound": 0.5}))
    server.observe(10)
    server.at(12, send=True)
    assert not any(server.at(step)["fresh"] for step in range(13, 40))


def test_a_vehicle_that_takes_nothing_holds_nothing() -> None:
    """It has dropped its trajectory, and gets a new one as soon as it accepts packets again."""
    server = Server(scenario())
    server.observe(0)
    server.at(1, send=True)
    assert not server.at(2)["fresh"]
    server.observe(2, takes=0)
    server.observe(3)
    server.observe(1)  # older, and overtaken
    assert server.scheme.observed_step.tolist() == [3]
    assert server.at(4)["fresh"]


def test_a_new_life_forgets_what_the_old_one_was_sent() -> None:
    server = Server(scenario(), capacity=2)
    server.observe(1000)
    server.at(1001, send=True)
    server.scheme.forget(0)
    assert server.scheme.observed_step.tolist() == [-1, -1]
    server.observe(0)
    assert server.at(1)["fresh"]


def fitted(path: Any, error_m: float) -> tuple[int, int, float]:
    """Number of knots, spacing, and largest distance from a path over time."""
    times = np.arange(61) * 0.1
    states = np.stack([path(times), np.gradient(path(times), 0.1)], axis=-1)
    knots = np.zeros((2, 2 * KNOTS_MAX), dtype=np.float32)
    count, spacing = from_python(fewest_knots)(np.stack([states, states]), 0.1, error_m, knots)
    some = knots[0, : 2 * count]
    found = np.array([spline_at(some, spacing, 0.1, stage)[0] for stage in range(61)])
    return count, spacing, float(np.abs(found - states[:, 0]).max())


def test_as_few_knots_are_sent_as_keep_near_enough() -> None:
    """A line has one; a wave has more, the more the smaller the allowed error."""
    assert fitted(lambda t: 0.5 * t, 0.02)[0] == 1
    few, many = (fitted(np.sin, error) for error in (0.03, 0.003))
    assert 1 < few[0] < many[0] < KNOTS_MAX
    assert few[2] <= 0.03
    assert many[2] <= 0.003


def test_what_no_spline_follows_has_as_many_knots_as_there_may_be() -> None:
    count, spacing, _ = fitted(lambda t: np.sign(np.sin(9 * t)), 0.02)
    assert (count, spacing) == (KNOTS_MAX, 4)


# -- preview -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("seed", range(9))
def test_what_a_vehicle_is_told_can_be_flown(seed: int) -> None:
    """Any reference gives motions that continue smoothly, with inputs within bounds."""
    rng = np.random.default_rng(seed)
    start, places = (rng.uniform(-5.0, 5.0), rng.uniform(-1.0, 1.0)), rng.uniform(-9.0, 9.0, 21)
    flown = scenario(control={"horizon": 20}, reference={"preview": "all"})
    terms = flown.terms()
    nominal = make_nominal(terms, flown.control, capacity=1)
    desired = np.zeros((2, 21, 2))
    desired[:, :, 0] = places
    states = np.zeros((2, 21, 2))
    states[:, 0] = start
    assert from_python(plan_nominal)(nominal, 0, 7, desired, states)
    assert states[:, 0].tolist() == [list(start)] * 2
    for axis, model in enumerate(terms.model.axes()):
        for (p, v), (q, w) in itertools.pairwise(states[axis].tolist()):
            u = (w - model.a11 * v) / model.b1
            assert abs(u) <= terms.u_max[axis] * (1 + 1e-9)
            assert advance(model, p, v, u) == pytest.approx((q, w), abs=1e-9)


FAST = {
    "duration": 30.0,
    "reference.preview": 4.0,
    "reference.agility": 0.6,
    "reference.speed_mps": 1.5,
    "vehicle.report": "always",
    "control.state_weight": [7.1, 0.07],
    "control.input_weight": 0.05,
}
"""Target nearly as fast as the vehicle, which the server sees 4 s ahead."""


@pytest.mark.long
def test_bounds_shape_what_is_told() -> None:
    plans, unplanned = (
        [
            flight.summary
            for flight in skytether.fly_batch(
                "target", range(3), **FAST, **{"control.scheme": scheme, "control.trigger": trigger}
            )
        ]
        for scheme, trigger in (("committed", "cost_gap(2)"), ("trajectory", "expected_gap(0.05)"))
    )
    error, error_unplanned = (np.mean([run.rmse_xy for run in runs]) for runs in (plans, unplanned))
    assert error_unplanned < 1.1 * error
    assert sum(run.uplink_packets for run in unplanned) < sum(run.uplink_packets for run in plans)


@pytest.mark.parametrize("horizon", [1, 8])
def test_a_horizon_too_short_for_a_plan_still_leads_along_the_trajectory(horizon: int) -> None:
    """The server then sends the reference itself; with planned motions errors are 0.3 to 2.7 m."""
    flown = skytether.fly("demo", **{"control.horizon": horizon, "duration": 20.0})
    assert flown.summary.error_max < 0.28


# -- the wire --------------------------------------------------------------------------------


def message(step: int, knots: Floats, *, age: int = 9, spacing: int = 5) -> Trajectory:
    return Trajectory(65535, 2**32 - 1, step, 2**32 - 1, age, spacing, knots)


@pytest.mark.parametrize(("axes", "count"), [(2, 1), (3, KNOTS_MAX)])
def test_a_packet_is_small(axes: int, count: int) -> None:
    """23 bytes typically, 36 at most, and 8 for each knot and axis."""
    knots = np.zeros((axes, count, 2), np.float32)
    longest = message(2**32 - 1, knots, age=2**32 - 1, spacing=2**16 - 1)
    longest = longest._replace(number=127, silence=2**16 - 1)
    assert len(encode(longest)) <= 36 + 8 * axes * count
    usual = Trajectory(1, 2**32 - 1, 1200, 2**32 - 1, 12, 8, knots, 100, 25)
    assert len(encode(usual)) == 23 + 8 * axes * count + (axes * count >= 32)


def test_what_is_sent_is_what_is_read() -> None:
    flown = scenario()
    knots = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    read = decode(encode(message(77, knots)), flown.terms())
    assert isinstance(read, Trajectory)
    np.testing.assert_array_equal(read.knots, knots)
    assert read[:6] == message(77, knots)[:6]


def wire(**fields: Any) -> bytes:
    """Datagram of a TRAJECTORY of two knots with other fields."""
    usual = {"spacing": 5, "age": 3, "knots": np.ones(8, np.float32)} | fields
    knots = bytes(usual["knots"].data)
    packed = [VERSION, 7, 1, 2, 5, 9, usual["age"], usual["spacing"], knots, 4, 300]
    datagram: bytes = msgpack.packb(packed)
    return datagram


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"spacing": 0}, "field"),
        ({"spacing": -1}, "field"),
        ({"spacing": 2**16}, "field"),
        ({"spacing": 1.0}, "field"),
        ({"age": 2**32}, "field"),
        ({"knots": np.zeros(0, np.float32)}, "shape"),
        ({"knots": np.zeros(2, np.float32)}, "shape"),
        ({"knots": np.zeros(6, np.float32)}, "shape"),
        ({"knots": np.zeros(4 * KNOTS_MAX + 4, np.float32)}, "shape"),
        ({"knots": np.full(8, np.nan, np.float32)}, "not finite"),
        ({"knots": np.full(8, np.inf, np.float32)}, "not finite"),
    ],
)
def test_hostile_fields_are_refused(fields: dict[str, Any], reason: str) -> None:
    terms = scenario().terms()
    assert isinstance(decode(wire(), terms), Trajectory)
    with pytest.raises(ProtocolError, match=rf"^{reason}$"):
        decode(wire(**fields), terms)


def test_each_scheme_takes_its_own_messages_alone() -> None:
    splines, plans = scenario().terms(), scenario().terms()._replace(scheme="committed")
    inputs = bytes(8 * plans.horizon)
    plan = msgpack.packb([VERSION, 4, 1, 2, 5, 9, 9, inputs, b"", 4, 300])
    decode(plan, plans)
    for datagram, terms in ((plan, splines), (wire(), plans)):
        with pytest.raises(ProtocolError, match=r"^type$"):
            decode(datagram, terms)


huge = st.floats(-(2.0**99), 2.0**99, width=32)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(*[huge] * 2), min_size=1, max_size=KNOTS_MAX),
    st.integers(1, 2**16 - 1),
    st.integers(0, 100_000),
)
def test_whatever_finite_knots_say_what_is_flown_is_within_the_bound(
    knots: list[tuple[float, float]], spacing: int, stage: int
) -> None:
    flown = scenario()
    terms = flown.terms()
    compensator = Compensator(terms, regulator(flown))
    trajectory = message(10, np.array([knots, knots], np.float32), age=1, spacing=spacing)
    compensator.offer(trajectory, 10, 9)
    state = np.array([[0.0, 0.0], [1.0, -1.0]])
    inputs, _ = compensator.choose(10 + stage, state, np.zeros(2), np.array(terms.u_max))
    assert all(math.isfinite(u) for u in inputs)
    for u, bound in zip(inputs, terms.u_max, strict=True):
        assert abs(u) <= bound


# -- flights ---------------------------------------------------------------------------------


def test_a_target_of_constant_velocity_takes_one_packet() -> None:
    flown = scenario(control={"trigger": "cost_gap(0.01)"})
    flight = fly(flown)
    assert len(sent_steps(flight)) == 1
    assert rmse_m(flown, flight) < 1e-3
    assert flight.server["deviation_m"].max() < 1e-4
    sizes = flight.netem["bytes"][flight.netem["direction"] == UPLINK]
    assert 36 < sizes[sizes != sizes.max()].max() < 48  # beside WELCOME and heartbeats


Kept = dict[int, tuple[int, Array]]
"""Spacing and knots in the server's memory, by the step that they were made for."""


def flown_and_kept(flown: Scenario) -> tuple[Record, Kept]:
    """Flight, and the trajectories that the server kept."""
    kept: Kept = {}
    inner = Guidance.remember

    def spy(self: Guidance, rows: Indices, step: Indices, found: Foresight, event: Any) -> None:
        inner(self, rows, step, found, event)
        for i in np.flatnonzero(event):
            slot = (self._memory.sent.delivery["sent"][rows[i]] - 1) % trajectory.RING
            sent = self._memory.trajectories[rows[i], slot]
            knots = self._memory.knots[rows[i], slot, :, : 2 * sent["count"]].copy()
            kept[int(step[i])] = (int(sent["spacing"]), knots)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Guidance, "remember", spy)
        return fly(flown), kept


POISSON = "paper(0.4, 0.02, 2.0) & loss(0.2)"


def test_the_server_knows_what_the_vehicle_follows() -> None:
    """The server's state equals the vehicle's x̄ while the newest trajectory is in force aboard."""
    flown = scenario(
        reference={"shape": "figure-eight", "preview": "all"},
        network={"uplink": POISSON, "downlink": POISSON},
        control={"trigger": "expected_gap(0.01) | silence(2)", "horizon": 40},
        vehicle={"report": "always"},
    )
    flight, kept = flown_and_kept(flown)
    server = {int(row["step"]): row for row in flight.server}
    compared = 0
    for row in flight.client:
        step, made = int(row["step"]), int(row["in_force"])
        if made < 0 or step not in server or made != max(s for s in kept if s < step):
            continue  # the newest is under way, or lost
        spacing, knots = kept[made]
        followed = [spline_at(each, spacing, 0.1, step - made) for each in knots]
        np.testing.assert_allclose(server[step]["planned"], followed, rtol=0.0, atol=1e-12)
        compared += 1
    assert compared > 50


def test_inputs_flown_are_those_of_the_spline_that_the_server_keeps() -> None:
    """Every input that was flown follows from the server's knots by the rule."""
    flown = scenario(
        reference={"shape": "circle", "preview": "all"},
        control={"trigger": "periodic(7)", "horizon": 40},
        network={"uplink": POISSON, "downlink": POISSON},
    )
    flight, kept = flown_and_kept(flown)
    terms, gain, checked = flown.terms(), regulator(flown)[:, :2], 0
    for row in flight.client[flight.client["covered"]]:
        spacing, knots = kept[int(row["in_force"])]
        stage = int(row["step"] - row["in_force"])
        for axis, model in enumerate(terms.model.axes()):
            p, v = spline_at(knots[axis], spacing, 0.1, stage)
            u = along(model, knots[axis], spacing, 0.1, stage)
            u = np.clip(u, -terms.u_max[axis], terms.u_max[axis])
            u += gain[axis] @ (np.array([p, v]) - row["estimate"][axis])
            u = np.clip(u, -terms.u_max[axis], terms.u_max[axis])
            assert row["input"][axis] == pytest.approx(u, abs=1e-12)
            checked += 1
    assert checked > 100


def test_silence_is_as_long_as_is_said() -> None:
    flown = scenario(control={"trigger": "cost_gap(0.01) | silence(3)", "horizon": 4})
    assert set(np.diff(sent_steps(fly(flown)))) == {30}


@pytest.mark.parametrize("renewed", [True, False])
def test_a_packet_that_has_become_too_old_is_replaced(
    renewed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although the target is where it is expected; otherwise the vehicle stands still."""
    flown = scenario(control={"trigger": "cost_gap(0.01)"}, link={"age_max_s": 2.0})
    if not renewed:
        forgetful = Guidance.__init__

        def init(self: Guidance, *args: Any) -> None:
            forgetful(self, *args)
            self._settings = self._settings._replace(age_max=10**6)

        monkeypatch.setattr(Guidance, "__init__", init)
    flight = fly(flown)
    assert (len(sent_steps(flight)) > 8) == renewed
    assert (flight.client["mode"][-1] == Mode.HOVER) == (not renewed)
    assert (rmse_m(flown, flight) < 0.5) == renewed


def test_before_a_trajectory_ends_as_many_are_sent_as_make_the_next_one_sure() -> None:
    """At 30 % loss and one trajectory every 2 s; without the rule, 19 of 20 such flights brake."""
    slow = {
        "control.trigger": "expected_gap(1000) | silence(2)",
        "network.uplink.loss": 0.3,
        "reference.agility": 0.02,
        "reference.speed_mps": 0.3,
    }
    flights = skytether.fly_batch("target", range(1, 3), duration=40.0, **slow)
    assert not any("brake" in flight.summary.modes for flight in flights)


def test_only_with_feedback() -> None:
    flown = reading.to_table(scenario())
    flown["control"]["feedback"] = False
    with pytest.raises(
        ConfigError, match=r"control.feedback: got false, expected true with control\.scheme"
    ):
        reading.check(flown, "test")


@pytest.mark.parametrize("known_aboard", [True, False])
def test_steady_wind_is_taken_off_by_the_vehicle_itself(
    known_aboard: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its filter estimates the wind; without that, K alone leaves an offset."""
    if not known_aboard:
        monkeypatch.setattr(Navigation, "disturbance", property(lambda _: np.zeros(2)))
    flown = scenario(
        control={"input_weight": 20.0},
        vehicle={"steady_wind_mps": [0.3, 0.0]},
        sensor={"position_noise_m": 0.01, "velocity_noise_mps": 0.02},
    )
    assert (rmse_m(flown, fly(flown)) < 0.1) == known_aboard


def test_a_vehicle_along_a_spline_reports_where_it_leaves_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In still air the server predicts the vehicle, so reports are few."""
    silent = {"wind": 0.0, "report": "deviation(0.01) | silence(1)"}
    table = reading.to_table(reading.load("demo")) | {"duration": 20.0}
    table["control"]["scheme"] = "trajectory"
    table["vehicle"] |= silent
    flown = reading.check(table, "test")

    def reports_per_s() -> float:
        packets = fly(flown).netem
        return float((packets["direction"] != UPLINK).sum()) / flown.duration

    seldom = reports_per_s()
    monkeypatch.setattr(Compensator, "foresee", lambda _, states, __=None: states)
    assert seldom < 6.0
    assert reports_per_s() > 2.0 * seldom
