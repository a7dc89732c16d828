"""Missions: motions, the QP solver behind them, and flights over bad networks."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench import missions
from bench.missions import PublishedOptions, fly_with_deaths
from helpers import packaged, refusal
from skytether.__main__ import main
from skytether.client.compensator import Compensator
from skytether.client.reporting import Reporter
from skytether.server import sessions
from skytether.server.endpoint import Server
from skytether.server.missions import trajectory_qp, vehicle_motions, waypoints, yielding
from skytether.server.missions.compiled_motion import pieces_of
from skytether.server.missions.half_planes import HalfPlanes, half_planes
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.mission_state import LONGEST, MissionState
from skytether.server.missions.possible_motions import NEVER, PossibleMotion, PossibleMotions
from skytether.server.missions.routes import RoutesAroundZones
from skytether.server.missions.separation import too_near
from skytether.server.missions.trajectory_qp import TrajectoryQP
from skytether.server.missions.vehicle_motions import PROMPT_COUNT, SentMotion, VehicleMotions
from skytether.server.missions.waypoints import Waypoints
from skytether.server.planning.clock import ClockMap
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.flight import ChangeRefused, SessionEnded
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import INTERVALS, SAMPLES, SPACING, Motion, resting
from skytether.shared.law.spline import spline_at
from skytether.shared.missions import zone_texts
from skytether.shared.missions.derived import clearances, zones
from skytether.shared.missions.mission import Mission
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario import reading
from skytether.shared.scenario.reading import ConfigError
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows
from skytether.shared.telemetry.summary import least_separation
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import NO_HORIZON, NO_INPUT, Mode, Observation, Trajectory
from skytether.sim import batch, flight
from skytether.theorem.hypotheses import broken, hypotheses
from two_vehicles import (
    DT_S,
    alone,
    clear_m,
    drawn,
    each_of,
    exact,
    left_m,
    observation,
    planned,
    ready,
    scenario,
    separation_m,
    with_goals,
)

LOST = {"network.uplink.loss": 1.0, "network.downlink.loss": 1.0}


# -- motions and their QP -------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.integers(1, 15), st.integers(0, 2**31), st.integers(-5, 200))
def test_a_motion_is_the_spline_that_is_sent(knots: int, seed: int, step: int) -> None:
    rng = np.random.default_rng(seed)
    velocity = np.vstack([rng.uniform(-1, 1, (knots - 1, 1)), np.zeros((1, 1))])
    T = SPACING * DT_S
    moved = 0.5 * T * (velocity[1:] + velocity[:-1])
    position = np.vstack([np.zeros((1, 1)), np.cumsum(moved, axis=0)])
    motion = Motion(0, position, velocity)
    told = np.stack([position[:, 0], velocity[:, 0]], axis=1).ravel()
    p, v = motion.at(np.array([float(max(step, 0))]), DT_S)
    assert spline_at(told, SPACING, DT_S, max(step, 0)) == pytest.approx((p[0, 0], v[0, 0]))
    assert motion.last == (knots - 1) * SPACING
    if step >= motion.last:
        assert p[0, 0] == pytest.approx(position[-1, 0])


def beyond(least_m: float, at: Sequence[int]) -> HalfPlanes:
    """Constraints x + 0.5 y ≥ `least_m` on positions at some of the QP's times."""
    n = len(at)
    normal, other = np.tile([1.0, 0.5], (n, 1)), np.zeros(n, dtype=np.int64)
    return HalfPlanes(np.array(at, dtype=np.int64), normal, np.full(n, least_m), other)


@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_among_the_motions_that_keep_out_of_half_planes_the_best_is_found(seed: int) -> None:
    """No small step towards another of these motions, which are a convex set, costs less."""
    rng = np.random.default_rng(seed)
    plan, planes = TrajectoryQP(scenario(4).terms(), 0.6, 0.0), beyond(-0.4, range(8, 25))
    p, v = np.zeros((1, 2)), rng.uniform(-0.2, 0.2, (1, 2))

    def found(goal: Array) -> Array:
        solved = plan.solve(p, v, np.tile(goal, (INTERVALS, 1)), planes)
        assert solved is not None
        steps = plan.times[8:] * SPACING
        at, _ = Motion(0, *solved).at(steps, DT_S)
        assert (at @ planes.normal[0]).min() > -0.4 - 1e-8
        return np.array(solved)

    def cost(knots: Array) -> float:
        off, a = knots[0, 1:] - goal, np.diff(knots[1], axis=0) / (SPACING * DT_S)
        weights = np.append(np.ones(INTERVALS - 1), trajectory_qp.LAST_WEIGHT)
        moved = trajectory_qp.ACCELERATION_WEIGHT * (a**2).sum()
        return float(weights @ (off**2).sum(axis=1) + moved)

    goal = rng.uniform(-6, 2, 2)
    best = found(goal)
    for other in rng.uniform(-6, 6, (10, 2)):
        assert cost(best + 1e-4 * (found(other) - best)) >= cost(best) * (1.0 - 1e-12)


def test_what_cannot_be_has_no_solution() -> None:
    plan = TrajectoryQP(scenario(4).terms(), 0.6, 0.0)
    still = np.zeros((1, 2))
    assert plan.solve(still, still, np.zeros((INTERVALS, 2)), beyond(30.0, [20])) is None


@settings(max_examples=15)
@given(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
)
def test_a_plan_ends_at_rest_within_what_the_vehicle_can(
    velocity: tuple[float, float], goal: tuple[float, float]
) -> None:
    """Its inputs leave a tenth of the bound to the regulator aboard."""
    terms = scenario(4).terms()
    found = TrajectoryQP(terms, 0.6, 0.0).solve(
        np.zeros((1, 2)), np.array([velocity]), np.tile(goal, (INTERVALS, 1))
    )
    assert found is not None
    position, v = found
    assert len(position) == INTERVALS + 1
    assert v[-1] == pytest.approx(0.0)
    a = np.diff(v, axis=0) / (SPACING * DT_S)
    for ends in (v[1:], v[:-1]):
        assert np.abs(ends + terms.tau_s[0] * a).max() < 0.9 * terms.u_max[0] + 1e-6
    nearer = np.linalg.norm(position[-1] - goal) <= np.linalg.norm(position[0] - goal) + 1.0
    assert nearer


# -- distances of motions --------------------------------------------------------------------------


@settings(max_examples=25)
@given(st.integers(0, 2**31), st.integers(0, 60))
def test_motions_come_too_near_where_any_of_their_pieces_does(seed: int, begin: int) -> None:
    """Also if bounding boxes exclude them; vehicles already too near must not come nearer."""
    rng = np.random.default_rng(seed)
    scale, keep_m, off_m = np.array([1.0, 0.7]), 1.5, 0.02
    motion, base, *others = (drawn(rng) for _ in range(12))
    flown = PossibleMotions(scale, DT_S)
    for row, other in enumerate(others):
        flown.replace(row, [PossibleMotion(drawn(rng, knots=5))])  # replaced below
        flown.replace(row, [PossibleMotion(other)] * 2, 0.1 * row)
    flown.replace(3, [])

    def least_m(one: Motion, other: Motion) -> float:
        steps = np.arange(begin, max(one.last, other.last, begin) + 1.0, 0.25)
        away = scale * (one.at(steps, DT_S)[0] - other.at(steps, DT_S)[0])
        return float(np.linalg.norm(away, axis=1).min())

    hit = too_near(PossibleMotion(motion), base, begin, 1, flown, keep_m)
    assert sorted(flown.rows) == sorted([0, 1, 2, 4, 5, 6, 7, 8, 9] * 2)
    for row, is_hit in zip(flown.rows, hit[:-1], strict=True):
        least, already = least_m(motion, others[row]), least_m(base, others[row])
        keep = keep_m + 0.1 * row
        if row == 1 or least > keep + off_m or (already < keep - off_m and least > already + off_m):
            assert not is_hit
        elif least < keep and (already > keep or least < already - off_m):
            assert is_hit


def test_the_box_of_a_motion_is_just_around_it() -> None:
    """A motion may turn between two knots, outside of both: the box contains the turn."""
    out_and_back = Motion(0, np.array([[1.0, 5.0]] * 2), np.array([[0.8, 0.0], [-0.8, 0.0]]))
    flown = PossibleMotions(np.array([1.0, 0.5]), DT_S)
    flown.add(1, PossibleMotion(out_and_back))
    furthest = out_and_back.at(np.array([SPACING / 2.0]), DT_S)[0][0, 0]
    assert flown.arrays.high[0].tolist() == pytest.approx([furthest, 2.5])
    assert flown.arrays.low[0].tolist() == pytest.approx([2.0 - furthest, 2.5])
    steady = Motion(0, np.array([[0.0, 1.0], [0.4, 1.0]]), np.array([[0.8, 0.0], [0.8, 0.0]]))
    flown.add(2, PossibleMotion(steady))
    assert flown.arrays.low[1].tolist() == pytest.approx([0.0, 0.5])
    assert flown.arrays.high[1].tolist() == pytest.approx([0.4, 0.5])


def test_a_motion_that_lands_has_a_box_down_to_the_ground() -> None:
    """Unless it never lands, or is below the ground already."""
    flown = PossibleMotions(np.ones(3), DT_S)
    for lands, height, low in ((NEVER, 4.0, 4.0), (60, 4.0, 0.0), (60, -1.0, -1.0)):
        motion = resting(0, np.array([1.0, 2.0, height]))
        flown.replace(1, [PossibleMotion(motion, lands)])
        assert flown.arrays.low[0].tolist() == [1.0, 2.0, low]
        assert flown.arrays.high[0].tolist() == [1.0, 2.0, height]


@pytest.mark.parametrize(("begin", "end"), [(0, 20), (3, 20), (0, 21), (20, 20), (30, 20)])
def test_no_piece_begins_after_a_motion_has_come_to_rest(begin: int, end: int) -> None:
    steps = pieces_of(begin, end)
    assert steps[0] == begin
    assert steps[-1] >= end
    assert len(steps) == 2 or steps[-2] < end
    assert np.diff(steps) == pytest.approx(SPACING / SAMPLES)


@given(st.integers(0, 2**31), st.integers(0, 150), st.integers(0, 150))
def test_vehicles_that_may_land_come_too_near_below_their_motions(
    seed: int, lands: int, others_land: int
) -> None:
    rng, scale, keep_m = np.random.default_rng(seed), np.array([1.0, 1.0, 0.5]), 1.0
    up, each = np.array([0.0, 0.0, 9.0]), (drawn(rng, 3, knots=13), drawn(rng, 3, knots=13))
    motion, other = (low._replace(position=low.position + up) for low in each)
    flown = PossibleMotions(scale, DT_S)
    flown.add(1, PossibleMotion(other, others_land))
    far = resting(0, np.array([100.0, 0.0, 0.0]))
    hit = too_near(PossibleMotion(motion, lands), far, 0, 0, flown, keep_m)[0]

    def least_m(early: int) -> float:
        steps = np.append(np.arange(0.0, 240.0, 0.25), 1e6)
        away = motion.at(steps, DT_S)[0] - other.at(steps, DT_S)[0]
        down = (away[:, 2] > 0) & (steps >= lands - early)
        others_down = (away[:, 2] < 0) & (steps >= others_land - early)
        away[down | others_down, 2] = 0.0
        return float(np.linalg.norm(away * scale, axis=1).min())

    if least_m(0) < keep_m - 1e-3:
        assert hit
    if hit:
        # A piece is 2.5 steps long, in which one of them may have passed the other's height.
        assert least_m(3) < keep_m + 0.25


def test_half_planes_keep_a_vehicle_out_from_under_one_that_may_land() -> None:
    """The direct way passes 3 m below; the vehicle comes to rest beside the other one."""
    above, times = resting(0, np.array([0.0, 0.0, 4.0])), np.arange(0.0, 121.0, 5.0)
    held = np.tile([1.5, 0.0, 1.0], (len(times), 1))
    flown, reach_m = PossibleMotions(np.ones(3), DT_S), np.full(len(times), 9.0)

    def planes(lands: int, others_land: int) -> HalfPlanes:
        flown.replace(1, [PossibleMotion(above, others_land)])
        return half_planes(times, held, reach_m, 0, lands, flown, 0.9)

    assert np.abs(planes(NEVER, NEVER).normal[:, 2]).min() > 0.5
    found = planes(200, 60)
    level = np.abs(found.normal[:, 2]) < 1e-12
    assert times[found.time[level]].tolist() == [t for t in times.tolist() if t >= 60]
    found = planes(200, 200)
    assert times[found.time[np.abs(found.normal[:, 2]) < 1e-12]].tolist() == [120.0]


def test_what_is_kept_from_are_all_motions_that_may_be_flown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, looked_at = MissionState.update_possible, list[int]()

    def update_possible(self: MissionState) -> None:
        real(self)
        expected = sorted(
            (row, motion.first - self.ahead(row), len(motion.position), vehicle.outside_m)
            for row, vehicle in self.vehicles.items()
            for motion in vehicle.motions()
        )
        count, held = self.possible.count, self.possible.arrays
        found = zip(held.row, held.first, held.knots, held.extra, strict=True)
        assert sorted(list(found)[:count]) == expected
        looked_at.append(count)

    monkeypatch.setattr(MissionState, "update_possible", update_possible)
    flight.fly(scenario(6, 0.5, duration=20.0), vehicles=6)
    assert len(looked_at) > 10
    assert max(looked_at) > 6


# -- possible motions ------------------------------------------------------------------------------


def test_a_motion_may_be_flown_until_an_observation_says_otherwise() -> None:
    made, vehicle = alone().state, VehicleMotions()
    made.vehicles[0] = vehicle
    assert made.observe(0, observation(5, NO_HORIZON, (4.0, 0.0)))
    first, second = resting(10, np.array([4.0, 0.0])), resting(40, np.array([3.0, 0.0]))
    vehicle.sent.append(SentMotion(10, first))
    assert len(vehicle.motions()) == 2
    made.observe(0, observation(20, 10, (4.0, 0.0)))
    assert vehicle.motions() == [first]
    vehicle.sent.append(SentMotion(40, second))
    made.observe(0, observation(40 + made._join, 10, (4.0, 0.0)))
    assert len(vehicle.motions()) == 2  # it may be adopted at the very step of the observation
    made.observe(0, observation(41 + made._join, 10, (4.0, 0.0)))
    assert vehicle.motions() == [first]
    assert made.counts["horizons_lost"] == 1
    for old in (30, 41 + made._join):  # late, and a copy of the newest
        assert not made.observe(0, observation(old, 10, (4.0, 0.0)))


def test_another_life_does_not_wait_for_what_was_sent_to_the_one_before() -> None:
    """Its steps are smaller, so the step count would never tell."""
    made, place = alone().state, np.array([4.0, 0.0])
    for in_force, left in ((NO_HORIZON, 0), (900, 1)):
        vehicle = made.vehicles[0] = VehicleMotions()
        vehicle.in_force = SentMotion(900, resting(900, place))
        vehicle.sent.append(SentMotion(1000, resting(1000, place)))
        vehicle.progress_step, vehicle.goal = 990, place
        made.forget(0)
        assert vehicle.motions()
        made.observe(0, observation(3 if in_force < 0 else 1001, in_force, (4.0, 0.0)))
        assert len(vehicle.sent) == left
        assert not vehicle.is_stuck(3, place, 0.0)
        assert vehicle.progress_step == 3


@pytest.mark.parametrize(("beyond_m", "is_hit"), [(1e-4, False), (-1e-4, True)])
def test_a_motion_is_too_near_below_the_distance(beyond_m: float, is_hit: bool) -> None:
    """D = separation_m + 2 tube_m, plus the distance of a vehicle outside its tube."""
    made, flown = alone(), scenario(2)
    for row, x in ((0, 4.0), (1, -4.0)):
        made.hear(row, 100, NO_HORIZON, x)
    made.align(100)
    made.vehicles[1].outside_m = 0.1
    made.state.update_possible()
    keep_m = clearances(flown).apart_m + 0.1
    near = resting(100, np.array([-4.0 + keep_m + beyond_m, 0.0]))
    planned = made.state.possible_motion(0, near)
    assert made._conflicts(0, near, planned).tolist() == [False, is_hit, False]


@pytest.mark.parametrize("turned", [0.0, 0.5])
def test_a_vehicle_that_has_turned_goes_on_to_the_right_of_its_goal(turned: float) -> None:
    """Although the direct way is free, because it still passes another one; it turns back
    slowly.
    """
    made = ready()
    made.vehicles[0].turned_rad = turned
    end = planned(made).position[-1]
    assert end[0] < 3.0  # on its way from x = 4 m to -4 m
    assert (end[1] > 0.5) == (turned > 0.0)
    assert made.vehicles[0].turned_rad == max(0.0, turned - waypoints.TURN_BACK)


@pytest.mark.parametrize(("until", "yields"), [(0, True), (-1, False)])
def test_a_vehicle_yields_up_to_its_last_step(until: int, yields: bool) -> None:
    made = ready()
    place = np.array([4.0, 3.0])
    made.vehicles[0].yielding = yielding.Yielding(place, asker=1, until=until)
    end = planned(made).position[-1]
    assert (made.vehicles[0].yielding is not None) == yields
    assert (end[1] > 0.5, end[0] < 3.5) == (yields, not yields)


def test_a_motion_is_sent_again_before_it_is_too_old_to_be_flown() -> None:
    made = ready()
    vehicle, last = made.vehicles[0], 90 + made._resend_after
    assert made._may_plan(0, vehicle, last)
    assert vehicle.next is None
    assert not made._may_plan(0, vehicle, last + 1)
    assert vehicle.next is vehicle.in_force.motion  # type: ignore[union-attr]


def test_nobody_plans_while_a_vehicle_flies_what_another_server_sent() -> None:
    made = alone()
    made.hear(0, 100, NO_HORIZON, 4.0)
    made.hear(1, 100, 70, -4.0)
    made.vehicles[0].in_force = SentMotion(90, resting(100, np.array([4.0, 0.0])))
    over = 70 + LONGEST  # the last step of the longest motion
    for step, seen, plans in (
        (111, 111, False),
        (over + 1, over, False),
        (over + 11, over + 1, True),
    ):
        made.hear(0, step, 90, 4.0)
        made.hear(1, seen, 70, -4.0)
        made.decide(step)
        assert (made.vehicles[0].next is not None) == plans


def test_a_trajectory_is_taken_aboard_until_it_is_too_late() -> None:
    terms = scenario(2).terms()
    knots = np.zeros((2, 1, 2), np.float32)
    trajectory = Trajectory(1, 1, 100, 0, 10, SPACING, knots)
    assert Compensator(terms).offer(trajectory, 100 + terms.join, 90)
    with pytest.raises(ProtocolError) as refused:
        Compensator(terms).offer(trajectory, 101 + terms.join, 90)
    assert refused.value.reason is Drop.TOO_LATE


def test_a_motion_is_not_taken_aboard_before_its_first_knot() -> None:
    """The motion in force has not come that far yet. A copy arrives in time."""
    aboard, knots = Compensator(scenario(2).terms()), np.zeros((2, 1, 2), np.float32)
    trajectory = Trajectory(1, 1, 100, 0, 10, SPACING, knots)
    with pytest.raises(ProtocolError) as refused:
        aboard.offer(trajectory, 99, 90)
    assert refused.value.reason is Drop.TOO_EARLY
    assert aboard.offer(trajectory, 100, 90)


def test_motions_that_may_be_flown_include_the_one_to_be_sent_now() -> None:
    vehicle = VehicleMotions()
    first, sent, new = (resting(step, np.zeros(2)) for step in (100, 104, 108))
    vehicle.in_force, vehicle.next = SentMotion(100, first), new
    vehicle.sent.append(SentMotion(104, sent))
    pairs = zip(vehicle.motions(), (first, sent, new), strict=True)
    assert all(each is other for each, other in pairs)
    vehicle.next = first
    assert len(vehicle.motions()) == 2


def test_a_motion_is_sent_again_after_losses_until_it_is_acknowledged() -> None:
    """Not before the first loss; the same motion, within the time in which it may be adopted."""
    vehicle = VehicleMotions()
    vehicle.sent.append(SentMotion(100, resting(100, np.zeros(2))))
    assert not any(vehicle.repeat_at(step) for step in range(100, 140))
    vehicle.adapt_copies(prompt=False)
    assert [step for step in range(100, 140) if vehicle.repeat_at(step)] == [104]
    for _ in range(5):
        vehicle.adapt_copies(prompt=False)
    due = [step for step in range(100, 140) if vehicle.repeat_at(step)]
    assert due == [104, 108]
    assert due[-1] - 100 < scenario(2).terms().join
    assert vehicle.repeat_at(104) == vehicle.sent[-1]
    for _ in range(3 * PROMPT_COUNT):
        vehicle.adapt_copies(prompt=True)
    assert vehicle.copies == 1
    vehicle.adapt_copies(prompt=False)
    for _ in range(PROMPT_COUNT - 1):
        vehicle.adapt_copies(prompt=True)
    assert vehicle.copies == 2
    vehicle.adapt_copies(prompt=False)
    vehicle.sent.clear()
    assert vehicle.repeat_at(104) is None


def test_a_vehicle_that_creeps_is_stuck_after_its_patience() -> None:
    vehicle, goal = VehicleMotions(), np.array([4.0, 0.0])
    patience = vehicle_motions.PATIENCE_STEPS
    assert not vehicle.is_stuck(0, goal, 10.0)
    assert not vehicle.is_stuck(100, goal, 10.0 - 0.9 * vehicle_motions.NEARER_M)
    found = [step for step in range(101, 3 * patience) if vehicle.is_stuck(step, goal, 9.8)]
    assert found == [patience, 2 * patience]
    assert not vehicle.is_stuck(3 * patience, goal, 9.0)
    assert not vehicle.is_stuck(4 * patience - 1, goal, 9.0)
    assert not vehicle.is_stuck(4 * patience, -goal, 9.0)


def test_a_foreign_motion_is_over_after_the_last_step_it_may_have() -> None:
    """Until then the vehicle may be anywhere on it; from the next observation on, it rests."""
    until = 70 + LONGEST
    for steps in ((100, until, until + 1, until + 2), (100, until + 100, until + 101)):
        made, x = alone(), -4.0
        for step in steps:
            x += 0.5
            made.hear(1, step, 70, x)
            vehicle = made.vehicles[1]
            rests_x = x if step != steps[-1] else x - 0.5
            assert vehicle.in_force.motion.position[-1].tolist() == [rests_x, 0.0]
            assert vehicle.is_foreign == (step <= until)


def test_a_vehicle_without_a_motion_is_kept_from_as_far_as_it_brakes() -> None:
    """It comes to rest v (τ + v / 2b) beyond the observed place."""
    made, terms = alone().state, scenario(2).terms()
    made.absent.clear()
    moving = observation(100, NO_HORIZON, (4.0, 0.0))
    moving.state[0, 1] = 0.5
    made.observe(0, moving)
    expected = 0.5 * (max(terms.tau_s) + 0.5 / (2.0 * terms.brake_mps2))
    assert made.vehicles[0].outside_m == pytest.approx(expected)


def test_a_vehicle_rests_once_all_its_motions_are_over() -> None:
    """A sent motion that may still be adopted leads away from the place."""
    made = alone().state
    made.vehicles[1] = vehicle = VehicleMotions()
    vehicle.in_force = SentMotion(-100, resting(-100, np.array([1.0, 0.0])))
    assert len(made.resting_places(0)) == 1
    places = np.array([[1.0, 0.0], [1.2, 0.0]])
    vehicle.sent.append(SentMotion(-4, Motion(-4, places, np.zeros((2, 2)))))
    assert made.resting_places(0) == []


def test_who_gets_a_motion_again_says_so_again() -> None:
    """The second copy changes nothing aboard, but the first acknowledgement may be lost."""
    terms = scenario(2).terms()
    compensator = Compensator(terms)
    reporter = Reporter(terms, "deviation(9)", compensator)
    knots = np.zeros((2, 1, 2), np.float32)
    trajectory = Trajectory(1, 1, 100, 0, 10, SPACING, knots)
    still, flown = np.zeros((2, 2)), np.zeros(2)

    def is_due(step: int) -> bool:
        return reporter.is_due(1, step, Mode.TRACK, still, flown, 0)

    assert compensator.offer(trajectory, 102, 90)
    assert [is_due(step) for step in (102, 103)] == [True, False]
    assert not compensator.offer(trajectory, 104, 90)
    assert [is_due(step) for step in (104, 105)] == [True, False]


# -- flights ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_motions_that_are_sent_again_arrive_where_half_are_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Sent only once, most motions or their acknowledgements are lost, and vehicles are slow."""
    swaps = scenario(4, 0.5, duration=32.0)

    def left_over_m() -> float:
        flown = flight.fly(swaps, vehicles=4)
        assert separation_m(flown) > 0.5
        return max(left_m(flown, swaps))

    assert left_over_m() < 0.3
    monkeypatch.setattr(vehicle_motions, "COPIES_MAX", 1)
    assert left_over_m() > 3.0


def test_a_link_that_is_cut_leaves_them_apart() -> None:
    flown = flight.fly(scenario(6, duration=14.0), vehicles=6, changes=[(6.3, LOST)])
    assert separation_m(flown) > 0.5


@pytest.mark.parametrize("steps", [5, -25])
def test_steps_that_are_miscounted_do_not_bring_vehicles_together(
    steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server has wrong steps for half the vehicles, within the known bounds of their clocks.

    With an error of 0.25 s vehicles arrive. With more than `link.join_s` they adopt no motion,
    because each comes too early or too late and counts as lost.
    """
    real = ClockMap.steps

    def mistaken(clock: ClockMap, rows: Indices, now_ns: int) -> Indices:
        return real(clock, rows, now_ns) + steps * (rows % 2)

    monkeypatch.setattr(ClockMap, "steps", mistaken)
    swaps = scenario(6, duration=25.0 if steps == 5 else 15.0)
    flown = flight.fly(swaps, vehicles=6)
    counts = flown.figures["server"]["counts"]
    assert separation_m(flown) > 0.5
    assert not broken(hypotheses(flown, swaps))
    if abs(steps) == 5:
        assert max(left_m(flown, swaps)) < 0.3
    else:
        assert counts["horizons_lost"] > 20


@pytest.mark.long
@pytest.mark.parametrize("losses", ["loss(0.1)", "loss(0.5)", "gilbert_elliott(0.3, 2.0)"])
def test_sixteen_swap_places_over_the_worst_networks(losses: str) -> None:
    swaps = scenario(16, losses, duration=60.0)
    flown = flight.fly(swaps, vehicles=16)
    assert separation_m(flown) > 0.5
    assert not broken(hypotheses(flown, swaps))


@pytest.mark.long
@pytest.mark.parametrize("forgets", ["what was sent before", "what may be lost"])
def test_without_what_may_be_flown_they_meet(forgets: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: separation only from the newest motion, or only from acknowledged ones."""
    real = VehicleMotions.motions
    newest = forgets == "what was sent before"

    def some(vehicle: VehicleMotions) -> list[Motion]:
        motions = real(vehicle)
        return motions[-1:] if newest else motions[:1]

    monkeypatch.setattr(VehicleMotions, "motions", some)
    least = [
        separation_m(flight.fly(scenario(16, 0.5, duration=60.0, seed=seed), vehicles=16))
        for seed in (1, 2)
    ]
    assert min(least) < 0.4


@pytest.mark.long
def test_taken_late_a_motion_is_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: a vehicle that adopts trajectories at any time leaves its tube."""
    real = Compensator.__init__

    def careless(self: Compensator, *args: Any) -> None:
        real(self, *args)
        self._join = 0

    monkeypatch.setattr(Compensator, "__init__", careless)
    late = scenario(16, duration=60.0)
    ways = [f"gamma(0.2, {0.9:g}, 0.5) & loss(0.1)"] * 2
    table = reading.to_table(late)
    table["network"] |= dict(zip(("uplink", "downlink"), ways, strict=True))
    flown = flight.fly(reading.check(table, "late"), vehicles=16)
    assert flown.figures["server"]["counts"]["left_tube"] > 0


def impatient(swaps: Scenario) -> Scenario:
    """Scenario with a failsafe that brakes after 8 s of silence, and lands after a minute."""
    link = msgspec.structs.replace(swaps.link, timeout_s=8.0)
    vehicle = msgspec.structs.replace(swaps.vehicle, land_after_s=60.0)
    return msgspec.structs.replace(swaps, link=link, vehicle=vehicle)


@pytest.mark.long
def test_a_server_begins_anew_in_the_midst_of_a_mission() -> None:
    """It allows for unknown motions, and for vehicles that hover meanwhile."""
    swaps = impatient(scenario(8, duration=80.0))
    flown, _ = fly_with_deaths(swaps, 8, [(6.0, 7.5), (14.0, 30.0), (36.0, 38.0)])
    assert separation_m(flown) > 0.5
    assert max(left_m(flown, swaps)) < 0.3


class HardOfHearing(Server):
    """Server that at first hears vehicle 1 alone, and vehicle 3 only long after."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Times are those of the day at whose midnight the flight begins."""
        number, time_s = datagram.peer[1], now_ns / SECOND_NS % 86_400
        if (number == 1 and time_s > 5.0) or (number == 3 and time_s < 15.0):
            return
        super().receive(datagram, now_ns=now_ns)


@pytest.mark.parametrize("keeps", [True, False])
def test_who_is_silent_for_long_keeps_its_place_when_another_joins(
    keeps: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without its own row it is forgotten, and the joining vehicle flies into it.

    Found in 1 of 600 flights of sixteen vehicles with cut links.
    """
    monkeypatch.setattr(sessions, "SESSION_NS", 8 * SECOND_NS)
    if not keeps:
        monkeypatch.setattr("skytether.server.endpoint.Sessions", forgetful)
    swaps = scenario(4, duration=35.0)
    server = HardOfHearing(swaps, boot_id=1, entropy=stream(1, "entropy").bytes, capacity=4)
    flown = flight.fly(swaps, vehicles=4, server=server)
    ended = [event for *_, event in flown.events if isinstance(event, SessionEnded)]
    assert ended[0] == SessionEnded(vehicle=1)
    assert (separation_m(flown) > 0.5) == keeps


def forgetful(*args: Any, keeps_rows: bool) -> sessions.Sessions:
    """Sessions whose rows are free for reuse once they have ended."""
    assert keeps_rows
    return sessions.Sessions(*args)


def test_who_hovers_on_a_mission_holds_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise wind takes it out of its tube while the server is down."""
    swaps = impatient(scenario(2, duration=60.0))

    def drift_m() -> float:
        flown, _ = fly_with_deaths(swaps, 2, [(4.0, 58.0)])
        hovering = [rows[rows["mode"] == Mode.HOVER]["state"][:, :, 0] for rows in each_of(flown)]
        assert min(map(len, hovering)) > 700
        return max(float(np.linalg.norm(at - at[0], axis=1).max()) for at in hovering)

    assert drift_m() < swaps.mission.tube_m
    monkeypatch.setattr(Compensator, "rest", lambda *_: None)
    assert drift_m() > swaps.mission.tube_m


# -- zones -----------------------------------------------------------------------------------------


def test_in_space_they_keep_further_apart_one_above_the_other(tmp_path: Path) -> None:
    """Because of downwash; a zone is flown around only at its own heights."""
    rows = "1,0,-3,0,1\n1,2,3,0,1\n2,0,3,0,2.2\n2,2,-3,0,2.2\n"
    table = with_goals(tmp_path, rows, height_m=1.0, zones="box(-1, 1, -4, 1, 1.8, 3)")
    high = reading.check(table | {"duration": 30.0}, "high")
    flown = flight.fly(high, vehicles=2)
    one, other = (rows["state"][:, :, 0] for rows in each_of(flown))
    steps = min(len(one), len(other))
    off = np.abs(one[:steps] - other[:steps])
    assert np.linalg.norm(off * [1.0, 1.0, 0.5], axis=1).min() > 0.5
    assert clear_m(flown, zones(high)) > 0.0
    assert np.abs(one[-1] - [3.0, 0.0, 1.0]).max() < 0.3
    assert np.abs(other[-1] - [-3.0, 0.0, 2.2]).max() < 0.3
    assert np.abs(one[:, 1]).max() < 0.8  # below the box, straight except for the other vehicle
    assert np.abs(other[:, 1]).max() > 1.0


def test_vehicles_on_a_sphere_swap_places_through_its_centre() -> None:
    """Four vehicles; the distance is that of the ellipsoid of `mission.height_m`."""
    sphere = packaged("sphere", duration=25.0, reference={"shape": "sphere(4)"})
    goals = sphere.make_reference()
    assert isinstance(goals, Mission)
    centre = np.array([0.0, 0.0, sphere.reference.altitude_m])
    assert np.linalg.norm(goals.places - centre, axis=1) == pytest.approx(4.0)
    begins, ends = (np.stack([goals.goals(n)[at] for n in goals.vehicles]) for at in (0, 1))
    assert begins + ends == pytest.approx(np.tile(2.0 * centre, (4, 1)))
    flown = flight.fly(sphere, vehicles=4)
    assert separation_m(flown, sphere.mission.height_scale) > 0.5
    assert max(left_m(flown, sphere)) < 0.3
    assert "model.axes: got 2, expected 3" in refusal(lambda: packaged("sphere", model={"axes": 2}))


def test_the_least_distance_counts_heights_less() -> None:
    columns = [("step", "i8"), ("mode", "u1"), ("state", "f8", (3, 2))]
    one, other = (np.zeros(3, columns) for _ in range(2))
    for rows in (one, other):
        rows["step"], rows["mode"] = np.arange(3), Mode.TRACK
    other["state"][:, 2, 0] = 1.0
    assert least_separation([one, other], [0.0, 0.0], DT_S) == pytest.approx(1.0)
    assert least_separation([one, other], [0.0, 0.0], DT_S, 0.5) == pytest.approx(0.5)


@pytest.mark.long
def test_a_zone_that_is_drawn_in_flight() -> None:
    swaps, zone = scenario(2, duration=30.0), "box(-0.5, 0.5, -1.5, 1.5)"
    drawn = [(3.0, {"mission.zones": zone})]
    flown = flight.fly(swaps, vehicles=2, changes=drawn)
    assert clear_m(flown, zone_texts.parse(zone, 2)) > 0.0
    assert max(left_m(flown, swaps)) < 0.3
    over = [
        (1.0, {"mission.zones": zone}),
        (3.0, {"mission.zones": "cylinder(4, 0, 1)"}),
        (5.0, {"mission.zones": zone}),
        (29.0, {"mission.zones": "cylinder(-4, 0, 1)"}),
    ]
    flown = flight.fly(swaps, vehicles=2, changes=over)
    reasons = [each.event.reason for each in flown.events if isinstance(each.event, ChangeRefused)]
    got, whole = "mission.zones: got", "tube included; nothing was changed"
    unheard = "zones before it is known where vehicle 1 is; nothing was changed"
    assert reasons[0] == f"{got} {unheard}"
    assert reasons[1] == f"{got} cylinder(4, 0, 1), which vehicle 1 hovers in, {whole}"
    assert re.fullmatch(
        rf"{got} {re.escape(zone)}, which vehicle . may fly into for .* s more, {whole}", reasons[2]
    )
    assert reasons[3] == f"{got} cylinder(-4, 0, 1), which vehicle 1 hovers in, {whole}"


@pytest.mark.long
def test_without_routes_they_wait_before_a_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ablation: aimed straight at their goals, they stay where they are, and apart from it."""
    keys = scenario(2, duration=40.0)
    table = reading.to_table(keys)
    table["mission"]["zones"] = "box(-0.5, 0.5, -4, 4)"
    walled = reading.check(table, "walled")
    assert max(left_m(flight.fly(walled, vehicles=2), walled)) < 0.3
    monkeypatch.setattr(RoutesAroundZones, "way", lambda _, __, goal: goal[None])
    flown = flight.fly(walled, vehicles=2)
    assert max(left_m(flown, walled)) > 3.0
    assert clear_m(flown, zones(walled)) > 0.0


@pytest.mark.long
def test_a_vehicle_at_rest_in_a_gap_is_flown_around(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ablation: with routes around zones only, the vehicle waits for the gap for ever, unless the
    other yields, which none does here.
    """
    monkeypatch.setattr(MissionPlanner, "_ask_to_yield", lambda *_: None)
    goals = "1,0,0.2,0\n2,0,2.6,-2\n2,1,2.6,2\n3,0,-0.8,-0.9\n4,0,-0.8,0.9\n"
    swaps, zone = scenario(4, duration=40.0), "box(1, 5, -0.2, 0.2)"
    gap = reading.check(with_goals(tmp_path, goals, swaps, zones=zone), "gap")

    def left_over_m() -> float:
        flown = flight.fly(gap, vehicles=4)
        assert separation_m(flown) > 0.5
        return float(np.linalg.norm(each_of(flown)[1]["state"][-1, :, 0] - [2.6, 2.0]))

    assert left_over_m() < 0.3
    monkeypatch.setattr(Waypoints, "_detour", lambda self, *_: self.routes)
    assert left_over_m() > 1.0


@settings(max_examples=30)
@given(st.floats(0.0, 2.0 * np.pi), st.floats(0.05, 3.0), st.floats(0.05, 1.0))
def test_a_way_begins_where_an_octagon_faces_a_place(
    angle: float, radius_m: float, room_m: float
) -> None:
    """For any orientation, the place is as far from the octagon as from the inscribed circle."""
    at = np.array([1.0, -2.0])
    place = at + (radius_m + room_m) * np.array([np.cos(angle), np.sin(angle)])
    zone = waypoints._octagon("a vehicle", at, radius_m, place)
    assert Zones([zone]).clearance(place[None])[0, 0] == pytest.approx(room_m)
    around = np.stack([np.cos(turns := np.linspace(0.0, 6.28, 50)), np.sin(turns)], axis=1)
    assert Zones([zone]).clearance(at + radius_m * around).max() < 1e-9


def test_a_vehicle_at_its_goal_in_a_gap_yields(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It returns once the other has passed. Otherwise that one never gets through."""
    walls = "fence(-5, 5, -3, 3) & box(-0.5, 0.5, 0.6, 4) & box(-0.5, 0.5, -4, -0.6)"
    goals, swaps = "1,0,0,0\n2,0,-3,0\n2,1,3,0\n", scenario(2, duration=35.0)
    gap = reading.check(with_goals(tmp_path, goals, swaps, zones=walls), "gap")

    def fly() -> tuple[float, float, float]:
        flown = flight.fly(gap, vehicles=2)
        one, other = (rows["state"][:, :, 0] for rows in each_of(flown))
        assert separation_m(flown) > 0.5
        assert clear_m(flown, zones(gap)) > 0.0
        furthest_m = np.linalg.norm(one, axis=1).max()
        return furthest_m, float(np.linalg.norm(one[-1])), float(abs(other[-1, 0] - 3.0))

    furthest_m, home_m, left_over_m = fly()
    assert furthest_m > 1.0
    assert home_m < 0.3
    assert left_over_m < 0.3
    monkeypatch.setattr(MissionPlanner, "_ask_to_yield", lambda *_: None)
    furthest_m, _, left_over_m = fly()
    assert furthest_m < 0.3
    assert left_over_m > 3.0


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.integers(2, 3))
def test_a_place_to_yield_to_is_off_the_way(seed: int, axes: int) -> None:
    rng, apart_m, room_m = np.random.default_rng(seed), 0.9, 0.2
    home, way = rng.uniform(-3, 3, axes), rng.uniform(-3, 3, (3, axes))
    others, scale = rng.uniform(-3, 3, (5, axes)), np.array([1.0, 1.0, 0.5])[:axes]
    kept = zone_texts.parse("fence(-4, 4, -4, 4) & box(-1, 1, 1, 2)", axes)
    found = yielding.place_to_yield(
        home, way, others, apart_m, scale, kept, RoutesAroundZones(kept, room_m), room_m
    )
    if found is not None:
        assert yielding.distance_from_way(found[None] * scale, way * scale)[0] >= apart_m
        assert np.linalg.norm((others - found) * scale, axis=1).min() >= apart_m
        assert kept.clearance(found[None]).min() >= room_m


def test_the_first_vehicle_on_a_way_is_asked() -> None:
    way = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 9.0]])
    homes = np.array([[2.5, 1.0], [1.5, 0.5], [1.0, -1.5]])
    assert yielding.distance_from_way(homes, way) == pytest.approx([0.5, 0.5, 1.5])
    assert yielding.first_on(way, homes, 0.9) == 1
    both, moved = np.array([[0.5, 0.2], [1.5, 0.5]]), np.array([-7.0, 0.0])
    assert yielding.first_on(way + moved, both + moved, 0.9) == 0  # the nearer one to its start
    assert yielding.first_on(way, homes[[0, 2]], 0.9) == 0
    assert yielding.first_on(way, homes[2:], 0.9) is None
    assert yielding.first_on(way + np.array([9.0, 0.0]), homes, 0.9) is None
    assert yielding.first_on(way, homes[:0], 0.9) is None
    around = np.array([[-0.5, 0.5], [-0.5, -0.5], [0.6, 0.6]])
    assert yielding.first_on(way, around, 0.9) == 2


def test_nobody_is_asked_who_is_far_ahead_on_the_way() -> None:
    """Before it is reached, the route may have changed."""
    corner = 1.1 * yielding.AHEAD_M
    way = np.array([[0.0, 0.0], [corner, 0.0], [corner + 4.0, 0.0]])
    ahead = np.array([[corner + 2.0, 0.0]])
    assert yielding.first_on(way, ahead, 1.0) is None
    assert yielding.first_on(way[1:], ahead, 1.0) == 0
    assert yielding.first_on(way, np.array([[3.0, 0.0]]), 1.0) == 0


def test_one_that_is_too_near_already_yields_away_from_the_other() -> None:
    """Vehicles at rest may be nearer than plans keep; otherwise no place is found for one."""
    free = Zones([])
    home, way = np.array([0.91, 0.0]), np.array([[0.0, 0.0], [5.0, 0.0]])

    def place() -> Array | None:
        ones = np.ones(2)
        return yielding.place_to_yield(
            home, way, way[:1], 0.93, ones, free, RoutesAroundZones(free, 0.2), 0.2
        )

    found = place()
    assert yielding.distance_from_way(way[:1], np.stack([home, found]))[0] == pytest.approx(0.91)
    with mock.patch.object(
        yielding, "_kept_distance", lambda places, *_: np.full(len(places), 0.93)
    ):
        assert place() is None


# -- missions --------------------------------------------------------------------------------------


def test_goals_go_to_those_that_are_nearest(tmp_path: Path) -> None:
    goals = "1,0,0,0\n1,5,9,1\n2,0,9,0\n2,5,0,1\n"
    found = reading.check(with_goals(tmp_path, goals, allocate=True), "mission")
    ends = [found.make_reference(number)(np.array(9.0))[:, 0].tolist() for number in (1, 2)]
    assert ends == [[0.0, 1.0], [9.0, 1.0]]
    assert found.start_m(2).tolist() == [9.0, 0.0]
    fewer = with_goals(tmp_path, "1,0,0,0\n1,5,9,1\n2,0,9,0\n", allocate=True)
    with pytest.raises(ConfigError, match=r"mission\.allocate: .* goals of all vehicles at"):
        reading.check(fewer, "mission")


# -- landing ---------------------------------------------------------------------------------------


class CutOff(Server):
    """Server without contact to vehicle 1 after the first five seconds."""

    since_s = 0.0

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Times are those of the day at whose midnight the flight begins."""
        self.since_s = now_ns / SECOND_NS % 86_400
        if datagram.peer[1] != 1 or self.since_s < 5.0:
            super().receive(datagram, now_ns=now_ns)

    def outbox(self) -> list[Datagram]:
        sent = super().outbox()
        return [each for each in sent if each.peer[1] != 1 or self.since_s < 5.0]


def test_nobody_is_below_a_vehicle_that_lands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It loses the link and lands, while another one is to pass below. Otherwise they meet."""
    goals = "1,0,0,0,4\n2,0,-4,0,1\n2,43.2,4,0,1\n"
    passing = reading.check(with_goals(tmp_path, goals) | {"duration": 65.0}, "passing")

    def fly() -> tuple[float, Rows, Rows]:
        server = CutOff(passing, boot_id=1, entropy=stream(1, "entropy").bytes, capacity=2)
        flown = flight.fly(passing, vehicles=2, server=server)
        one, other = each_of(flown)
        assert (one["mode"] == Mode.LAND).any()
        assert one["state"][-1, 2, 0] < 0.1
        assert np.linalg.norm(other["state"][-1, :, 0] - [4.0, 0.0, 1.0]) < 0.3
        return separation_m(flown), one, other

    kept_m, _, other = fly()
    assert kept_m > 0.5
    assert np.abs(other["state"][:, 1, 0]).max() > 0.8
    monkeypatch.setattr(MissionState, "_expect_landing", lambda *_: None)
    kept_m, _, other = fly()
    assert kept_m < 0.4
    assert np.abs(other["state"][:, 1, 0]).max() < 0.2


@pytest.mark.parametrize(
    ("before", "mode", "lands"),
    [
        (None, Mode.TRACK, 700),
        (None, Mode.BRAKE, 700),
        (None, Mode.HOVER, 500),
        (Mode.TRACK, Mode.HOVER, 600),
        (Mode.TRACK, Mode.LAND, 500),
        (Mode.HOVER, Mode.MANUAL, 500),
    ],
)
def test_when_a_vehicle_may_begin_to_land(
    before: Mode | None, mode: Mode, lands: int, tmp_path: Path
) -> None:
    """After 10 s of hovering in silence since the last other mode; at once if it already hovers."""
    flown = reading.check(with_goals(tmp_path, "1,0,0,0,2\n"), "hover")
    goals = flown.make_reference()
    assert isinstance(goals, Mission)
    mission = MissionState(flown, flown.terms(), 2, 2, goals.of, lambda row: row + 1, exact(2))
    assert mission.lands(0) == NEVER
    state = np.zeros((3, 2))
    for k, does in ((400, before), (500, mode)):
        if does is not None:
            said = Observation(1, 1, k, NO_HORIZON, 0, 0, 0, does, 1, state, NO_INPUT)
            assert mission.observe(0, said)
    assert mission.lands(0) == lands
    mission.rows.ahead[0] = 40
    assert mission.lands(0) == lands - 40
    # Another life counts its own steps: of a hovering vehicle only the mode is known.
    mission.forget(0)
    hovers = Observation(1, 2, 60, NO_HORIZON, 0, 0, 0, Mode.HOVER, 1, state, NO_INPUT)
    assert mission.observe(0, hovers)
    assert mission.lands(0) == 60 - 40


@pytest.mark.parametrize(
    ("goals", "zones_text", "said"),
    [
        ("1,0,0,0,1\n2,0,0.5,0,9\n", "", "at 0 s side by side: both may land (vehicle.land_"),
        ("1,0,0,0,9\n", "box(-1, 1, -1, 1, 0, 2)", "expected none within 0.23 m of the goal"),
    ],
)
def test_nobody_may_rest_above_what_it_must_not_land_on(
    goals: str, zones_text: str, said: str, tmp_path: Path
) -> None:
    table = with_goals(tmp_path, goals, zones=zones_text)
    with pytest.raises(ConfigError, match=re.escape(said)):
        reading.check(table, "above")
    table["vehicle"]["land_after_s"] = 0.0
    reading.check(table, "above")


def test_a_zone_below_a_vehicle_that_may_land_is_refused_in_flight(tmp_path: Path) -> None:
    table = with_goals(tmp_path, "1,0,0,0,4\n") | {"duration": 12.0}
    changes = [(9.0, {"mission.zones": "box(-1, 1, -1, 1, 0, 2)"})]

    def refused() -> list[str]:
        flown = flight.fly(reading.check(table, "above"), changes=changes)
        return [event.reason for *_, event in flown.events if isinstance(event, ChangeRefused)]

    (reason,) = refused()
    assert "which vehicle 1 hovers in or above, tube included" in reason
    table["vehicle"]["land_after_s"] = 0.0
    assert refused() == []


def test_a_goal_above_another_is_refused_in_flight(tmp_path: Path) -> None:
    table = with_goals(tmp_path, "1,0,0,0,1\n2,0,5,0,1\n", goals="goal(2, 0.5, 0, 9)")
    said = "expected a place 0.93 m to the side from the goal of vehicle 1"
    with pytest.raises(ConfigError, match=re.escape(said)):
        reading.check(table, "above")
    table["vehicle"]["land_after_s"] = 0.0
    reading.check(table, "above")


# -- goals in flight -------------------------------------------------------------------------------


def test_a_vehicle_is_sent_elsewhere_in_flight() -> None:
    swaps, elsewhere = scenario(2, duration=24.0), "goal(1, 0, 3)"
    sent = [(0.5, {"mission.goals": elsewhere})]
    flown = flight.fly(swaps, vehicles=2, changes=sent)
    ends = [rows["state"][-1, :, 0] for rows in each_of(flown)]
    assert np.linalg.norm(ends[0] - [0.0, 3.0]) < 0.3
    assert max(left_m(flown, swaps)[1:]) < 0.3
    assert flown.server is not None
    of_one = flown.server[flown.server["vehicle"] == 1]
    assert of_one["reference"][-1, :, 0].tolist() == [0.0, 3.0]
    flown = flight.fly(swaps, vehicles=2, changes=[*sent, (10.0, {"mission.goals": ""})])
    assert max(left_m(flown, swaps)) < 0.3


@pytest.mark.parametrize(
    ("goals", "said"),
    [
        ("goal(3, 0, 1)", "mission.goals: got goal(3, 0, 1), expected vehicles 1, 2"),
        ("goal(1, 0)", "mission.goals: got 'goal(1, 0)', expected goal(vehicle, x, y)"),
        ("place(1, 0, 0)", "mission.goals: got 'place(1, 0, 0)', expected goal(vehicle, x, y)"),
        ("goal(1, nan, 0)", "mission.goals: got 'goal(1, nan, 0)', expected goal(vehicle, x, y)"),
        ("goal(1, 7, 7) & goal(2, 7, 7.5)", "got goal(2, 7, 7.5), expected a place 0.93 m from"),
        ("goal(1, 3.2, 0)", "expected a place 0.93 m from the goal of vehicle 2"),
        ("goal(1, 1.1, 0)", "expected a place 0.23 m from box(-1, 1, -1, 1)"),
    ],
)
def test_a_goal_that_cannot_be_is_refused(goals: str, said: str) -> None:
    table = reading.to_table(scenario(2))
    table["mission"] |= {"goals": goals, "zones": "box(-1, 1, -1, 1)"}
    assert said in refusal(lambda: reading.check(table, "mission"))


def test_goals_as_near_as_they_may_be_are_reached(tmp_path: Path) -> None:
    """Near to each other and to a zone, where motions curve much between knots."""
    swaps = scenario(4, duration=30.0)

    def made(goals: str, **mission: Any) -> Scenario:
        mission["acceleration_mps2"] = 2.0
        table = with_goals(tmp_path, goals, swaps, **mission)
        table["control"]["dt"] = 0.1
        table["link"] |= {"timeout_s": 20.0, "age_max_s": 20.0}
        return reading.check(table, "near")

    clear = clearances(made("1,0,0,0\n"))
    half_m, wall_m = 0.5 * clear.planned_apart_m, 0.5 * clear.planned_apart_m
    wall_m += clear.planned_clear_m + 1e-3
    goals = [(x, y) for x in (-half_m - 1e-3, half_m) for y in (-half_m - 1e-3, half_m)]
    starts = [(-3.0, 0.0), (-3.0, 2.0), (-3.0, -2.0), (3.0, 0.0)]
    rows = [
        f"{number},{t},{x},{y}\n"
        for number in range(1, 5)
        for t, (x, y) in ((0, starts[number - 1]), (1, goals[number - 1]))
    ]
    zone = f"box({-half_m}, {half_m}, {wall_m}, {wall_m + 1})"
    near = made("".join(rows), zones=zone)
    flown = flight.fly(near, vehicles=4)
    assert separation_m(flown) > near.mission.separation_m
    assert clear_m(flown, zones(near)) > 0.0
    assert max(left_m(flown, near)) < 0.1
    assert "asides" not in flown.figures["server"]["counts"]


def test_a_mission_is_a_table_of_goals(tmp_path: Path) -> None:
    table = with_goals(tmp_path, "1,0,0,0\n1,5,3,1\n2,0,4,0\n")
    mission = reading.check(table, "mission").make_reference(1)
    assert isinstance(mission, Mission)
    assert mission.vehicles == (1, 2)
    times_s = np.array([0.0, 4.9, 5.0, 99.0])
    assert mission(times_s)[:, 0, 0].tolist() == [0.0, 0.0, 3.0, 3.0]
    assert mission.of(2)(times_s)[:, 0, 0].tolist() == [4.0] * 4
    assert not mission.of(3)(times_s).any()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("vehicle,x,y\n1,0,0\n", "expected the columns t, x, y"),
        ("vehicle,t,x,y\n1,1,0,0\n", "line 2: expected t = 0 as the first time, got 1"),
        ("vehicle,t,x,y\n0,0,0,0\n", "line 2: vehicle: expected numbers from 1"),
        ("vehicle,t,x,y\n1,0,nan,0\n", "finite numbers"),
        ("vehicle,t,x,y\n1,0,1e9,0\n", "from the origin"),
    ],
)
def test_a_wrong_mission_is_told(text: str, said: str, tmp_path: Path) -> None:
    table = with_goals(tmp_path, "1,0,0,0\n")
    Path(table["reference"]["file"]).write_text(text)
    with pytest.raises(ConfigError, match=said):
        reading.check(table, "mission")


@pytest.mark.parametrize(
    ("section", "key", "value", "said"),
    [
        ("link", "join_s", 0.0, "link.join_s: got 0.0, expected more than 0"),
        ("mission", "height_m", 0.4, "expected 0, or at least mission.separation_m (0.5)"),
        ("link", "join_s", 2.0, "link.join_s: got 2.0, expected more than 0, and at most 1.5 s"),
        ("link", "timeout_s", 2.0, "link.timeout_s: got 2.0, expected at least 7.5 s"),
        ("control", "trigger", "always", "control.trigger: got 'always', expected 'expected_gap'"),
        ("vehicle", "exhausted", "hold", "vehicle.exhausted: got 'hold', expected 'brake'"),
    ],
)
def test_what_would_end_the_guarantee_is_refused(
    section: str, key: str, value: Any, said: str
) -> None:
    assert said in refusal(lambda: packaged("swap", {section: {key: value}}))


def test_the_fleet_tells_how_near_they_came(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "s.json"
    shape = ["--reference.shape", "swap(4)", "--duration", "8", "--settle", "1"]
    assert main(["fleet", "swap", "--virtual", *shape, "--json", str(file)]) == 0
    content = json.loads(file.read_text())
    assert content["vehicles"] == 4
    assert content["separation_m"] == 0.5
    assert 0.5 < content["least_separation_m"] < 8.0
    capsys.readouterr()
    assert main(["fleet", "swap", "--virtual", "--vehicles", "5", *shape]) == 2
    assert "--vehicles: got 5, expected 4 on this mission" in capsys.readouterr().err


def test_the_least_distance_is_of_one_time() -> None:
    """Vehicles that were at one place at different times were not near."""
    columns = [("step", "i8"), ("mode", "u1"), ("state", "f8", (2, 2))]
    one, other = (np.zeros(101, columns) for _ in range(2))
    for rows in (one, other):
        rows["step"], rows["mode"] = np.arange(101), Mode.TRACK
        rows["state"][:, 0, 0] = 0.1 * rows["step"]
    assert least_separation([one, other], [0.0, 0.0], DT_S) == pytest.approx(0.0)
    assert least_separation([one, other], [0.0, 1.0], DT_S) == pytest.approx(2.0)
    assert least_separation([one, other], [0.0, 100.0], DT_S) is None
    assert least_separation([one], [0.0], DT_S) is None


def test_a_batch_flies_each_mission_alone() -> None:
    """Runs of a batch share a server, and must not keep apart from each other."""
    swaps = scenario(2, duration=4.0)
    alone = flight.fly(msgspec.structs.replace(swaps, seed=2))
    assert batch.fly_batch(swaps, [1, 2])[1].trace_hash() == alone.trace_hash()


# -- published tasks ---------------------------------------------------------------------------


@pytest.mark.long
def test_places_of_published_tasks_are_as_their_authors_have_them(tmp_path: Path) -> None:
    """Far enough apart in the stretched distance, and the scenario can be flown."""
    for name, task in missions.TASKS.items():
        begins, ends = missions.places(task, np.random.default_rng(1))
        keep_m = task.separation_m + 2.0 * task.tube_m
        scale = np.array([1.0, 1.0, 1.0 / task.stretch])
        for at in (begins, ends):
            assert at.shape == (task.vehicles, 3), name
            away = np.linalg.norm((at[:, None] - at) * scale, axis=2)
            assert away[np.triu_indices(task.vehicles, 1)].min() > keep_m
        for network in missions.PUBLISHED_NETWORKS:
            made = missions.published_scenario(task, network, 30.0, 1, tmp_path)
            assert made.mission.height_m == task.separation_m * task.stretch


@pytest.mark.long
def test_four_cross_as_published() -> None:
    cell = (1, ("Luis 2020: four cross", "20 ms"))
    done = missions.fly_published(PublishedOptions(duration=25.0), cell)
    assert done.least_m > 0.2
    assert done.arrived_s < 20.0
