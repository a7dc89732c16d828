"""Safeguards of missions, one by one: each test fails if its safeguard is removed."""

from itertools import islice

import numpy as np
import pytest

from bench.problems import from_python
from skytether.server.missions.half_planes import half_planes
from skytether.server.missions.mission_state import LONGEST
from skytether.server.missions.possible_motions import (
    NEVER,
    PossibleMotion,
    PossibleMotions,
    shifts,
)
from skytether.server.missions.separation import _distance_from_parallelogram, too_near
from skytether.server.missions.vehicle_motions import SentMotion, VehicleMotions
from skytether.server.missions.waypoints import Waypoints
from skytether.server.missions.zone_clearance import comes_near
from skytether.server.planning.clock import EXACT, ClockMap, Contradiction, StepError
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.law.motion import SAMPLES, SPACING, Motion, bend_m, resting
from skytether.shared.missions import zone_texts
from skytether.shared.missions.derived import clearances
from skytether.shared.missions.events import InZone
from skytether.shared.missions.zones import Zones
from skytether.shared.wire.protocol import NO_HORIZON
from two_vehicles import DT_S, KEY, alone, along, planned, ready, scenario, with_zones

FAR = 100.0


def is_too_near(
    one: Motion,
    other: Motion,
    keep_m: float,
    *,
    begin: int = 0,
    lands: int = NEVER,
    error: StepError = EXACT,
) -> bool:
    """Whether a motion comes too near to another one with an uncertain step.

    Args:
        keep_m: distance to keep [m].
        begin: step from which the motions are compared.
        lands: first step at which the first vehicle may begin to land.
        error: error of the other's step.
    """
    axes = one.position.shape[1]
    possible = PossibleMotions(np.ones(axes), DT_S)
    possible.add(1, PossibleMotion(other, error=error))
    far, planned = resting(0, np.full(axes, FAR)), PossibleMotion(one, lands)
    return bool(too_near(planned, far, begin, 0, possible, keep_m)[0])


# -- distances -----------------------------------------------------------------------------------


def test_clocks_that_drift_over_the_time_looked_ahead_count() -> None:
    """Two vehicles fly 1 m behind each other, 100 s from now; a step of error is 1.6 cm."""
    one = along([0.0, 0.0], [0.8, 0.0], first=2000)
    other = along([1.0, 0.0], [0.8, 0.0], first=2000)
    assert is_too_near(one, other, 0.92)


def test_another_is_ahead_by_its_own_earliness_and_by_how_late_the_first_is() -> None:
    one, other = StepError(early=1.0, late=2.0), StepError(early=10.0, late=20.0)
    assert from_python(shifts)(one, other, 0.5) == (-21.5, 12.5)


def test_one_that_may_be_down_is_kept_away_from_by_one_that_is_late() -> None:
    """A vehicle at rest may land while a late one still passes below."""
    above, passes = resting(0, np.array([0.0, 0.0, 6.0])), along([-2.0, 0.0, 2.0], [0.8, 0.0, 0.0])
    assert is_too_near(above, passes, 0.9, lands=130, error=StepError(0.0, 100.0))


def test_the_bend_of_a_motion_is_taken_off_its_distances() -> None:
    """A motion that reverses between its knots comes 1 m near to a place at rest."""
    turns = Motion(
        0,
        np.array([[0.0, 0.0], [0.0, 0.0], [-0.2, 0.0]]),
        np.array([[0.8, 0.0], [-0.8, 0.0], [0.0, 0.0]]),
    )
    assert is_too_near(turns, resting(0, np.array([1.1, 0.0])), 1.002, begin=1)


def test_a_motion_that_is_too_near_already_comes_no_nearer_within_the_error_of_its_pieces() -> None:
    """By 5 mm; pieces are off by up to 6 mm."""
    turns, there = (
        Motion(
            0,
            np.array([[0.0, 0.0], [0.0, 0.0], [-0.2, 0.0]]),
            np.array([[0.8, 0.0], [-0.8, 0.0], [0.0, 0.0]]),
        ),
        PossibleMotions(np.ones(2), DT_S),
    )
    there.add(1, PossibleMotion(resting(0, np.array([1.1, 0.0]))))
    nearer = turns._replace(position=turns.position + np.array([0.005, 0.0]))
    for motion, is_hit in ((turns, False), (nearer, True)):
        assert too_near(PossibleMotion(motion), turns, 1, 0, there, 1.2)[0] == is_hit


def test_vehicles_that_pass_where_two_pieces_meet_are_seen() -> None:
    """At 12 m/s against each other they are 0.85 m apart then, and 1.1 m in the pieces' middles."""
    one = along([-13.5, 0.85], [6.0, 0.0])
    other = along([13.5, 0.0], [-6.0, 0.0])
    assert is_too_near(one, other, 0.9)


def test_a_motion_of_which_only_the_bound_is_near_passes_under_none_that_begins_to_land() -> None:
    """It is below as the other begins to land; 0.1 s later, when that counts, 0.75 m further on."""
    under, there = along([-13.5, 0.0, 2.0], [6.0, 0.0, 0.0]), PossibleMotions(np.ones(3), DT_S)
    there.add(1, PossibleMotion(resting(0, np.array([0.0, 0.0, 6.0])), 51))
    assert too_near(PossibleMotion(under), under, 0, 0, there, 0.9)[0]


@pytest.mark.parametrize(
    ("middle", "twist", "distance_m"),
    [
        ((0.3, -0.2), 0.0, 0.0),
        ((2.0, 0.0), 0.0, 1.0),
        ((-2.0, 0.0), 0.0, 1.0),
        ((0.0, 2.0), 0.0, 1.0),
        ((0.0, -2.0), 0.0, 1.0),
        ((2.0, 2.0), 0.0, 2.0**0.5),
        ((-2.0, 0.0), 0.4, 0.9),
    ],
)
def test_a_swept_piece_is_as_near_as_its_nearest_side_or_point_less_its_twist(
    middle: tuple[float, float], twist: float, distance_m: float
) -> None:
    """A square of 2 m."""
    square = np.array([middle, (2.0, 0.0), (0.0, 2.0), (twist, 0.0)])
    assert from_python(_distance_from_parallelogram)(square) == pytest.approx(distance_m)


def test_straight_pieces_are_off_a_motion_by_no_more_than_its_bend() -> None:
    """In the middle of a piece by just as much, at 1.6 m/s²."""
    motion = Motion(0, np.array([[0.0], [0.2]]), np.array([[0.8], [0.0]]))
    (begin, middle, end), _ = motion.at(SPACING / SAMPLES * np.array([0.0, 0.5, 1.0]), DT_S)
    assert bend_m(1.6, DT_S) == pytest.approx(middle[0] - 0.5 * (begin[0] + end[0]))


def test_half_planes_keep_away_from_one_outside_its_tube() -> None:
    """The distance grows by that between vehicle and tube, 0.3 m."""
    possible = PossibleMotions(np.ones(2), DT_S)
    possible.add(1, PossibleMotion(resting(0, np.zeros(2))), 0.3)
    times = np.arange(0.0, 121.0, 5.0)
    held, reach = np.tile([3.0, 0.0], (len(times), 1)), np.full(len(times), 9.0)
    assert half_planes(times, held, reach, 0, NEVER, possible, 0.9).bound == pytest.approx(1.2)


def test_a_motion_that_takes_the_place_of_another_keeps_its_own_landing() -> None:
    """One vehicle is gone; the one that lands from 6 m descends onto whoever is below."""
    possible = PossibleMotions(np.ones(3), DT_S)
    possible.add(1, PossibleMotion(resting(0, np.array([9.0, 9.0, 9.0]))))
    possible.add(2, PossibleMotion(resting(0, np.array([0.0, 0.0, 6.0])), 60))
    possible.replace(1, [])
    below, far = resting(0, np.array([0.0, 0.0, 1.0])), resting(0, np.full(3, FAR))
    assert too_near(PossibleMotion(below), far, 0, 0, possible, 0.9)[0]


# -- sending motions -----------------------------------------------------------------------------


def test_a_plan_that_still_comes_too_near_is_not_sent() -> None:
    made = ready()
    vehicle = made.vehicles[0]
    vehicle.turned_rad = 0.5
    made._conflicts = lambda *_: np.ones(made.state.possible.count + 1, dtype=bool)
    made.decide(101)
    assert vehicle.next is None


def test_a_vehicle_inside_a_zone_does_not_leave_it_through_another() -> None:
    made = ready()
    made.change(with_zones("cylinder(4, 0, 1) & cylinder(0, 0, 1)"), KEY)
    way = np.stack([np.linspace(4.0, 0.0, 41), np.zeros(41)], axis=1)
    assert made._enters_zone(way)
    assert not made._enters_zone(way * [-1.0, 1.0] + [8.0, 0.0])


def test_a_vehicle_that_moves_is_not_told_to_rest_where_it_passes() -> None:
    """It flies at 0.5 m/s without a motion."""
    made = alone()
    for step in (100, 101):
        for row, x in ((0, 4.0), (1, -4.0)):
            made.hear(row, step, NO_HORIZON, x, 0.5)
    made.decide(101)
    assert made.vehicles[0].next is None
    assert made.vehicle_figures(0)["waits"] == "coming to rest"


def test_how_far_a_vehicle_is_outside_its_tube_is_kept_by_itself_and_for_its_next_motion() -> None:
    """Against motions of others, and against those planned at the same step."""
    made = ready()
    made.align(101)
    made.state.update_possible()
    made.vehicles[0].outside_m = 0.1
    near = resting(101, np.array([-4.0 + clearances(scenario(2)).apart_m + 0.05, 0.0]))
    possible = made.state.possible_motion(0, near)
    assert made._conflicts(0, near, possible).tolist() == [False, True, False]
    made.vehicles[0].outside_m, made.vehicles[0].turned_rad = 0.4, 0.5
    made.state._changed.add(0)
    planned(made)
    motions = made.state.possible
    mine = [motions.arrays.extra[m] for m in range(motions.count) if motions.rows[m] == 0]
    assert mine == pytest.approx([0.4] * len(mine))


def test_a_new_motion_is_the_old_one_as_long_as_it_may_be_taken() -> None:
    """Adopted late, within `link.join_s`, it causes no jump."""
    made = ready()
    motion, before = planned(made), made.vehicles[0].in_force.motion
    steps = np.arange(101.0, 102.0 + scenario(2).terms().join)
    assert motion.at(steps, DT_S)[0] == pytest.approx(before.at(steps, DT_S)[0], abs=1e-9)


def test_a_motion_is_sent_again_before_it_ends_aboard() -> None:
    """Otherwise a vehicle at rest drifts; twice within `link.age_max_s`, as one may be lost."""
    terms = scenario(2).terms()
    assert 2 * ready()._resend_after + terms.join < terms.age_max


def test_every_motion_that_was_sent_may_be_flown() -> None:
    vehicle, motions = VehicleMotions(), [resting(step, np.zeros(2)) for step in (0, 10, 20)]
    vehicle.in_force = SentMotion(0, motions[0])
    vehicle.sent.extend(SentMotion(motion.first, motion) for motion in motions[1:])
    assert [motion.first for motion in vehicle.motions()] == [0, 10, 20]


def test_the_newest_motion_is_the_one_that_is_repeated() -> None:
    vehicle = VehicleMotions()
    vehicle.copies = 2
    vehicle.sent.extend(SentMotion(step, resting(step, np.zeros(2))) for step in (100, 110))
    assert vehicle.repeat_at(114) is vehicle.sent[1]


def test_only_eight_prompt_acknowledgements_in_a_row_make_motions_be_sent_less_often() -> None:
    vehicle = VehicleMotions()
    for prompt in [False, *[True] * 7, False, *[True] * 7]:
        vehicle.adapt_copies(prompt)
    assert vehicle.copies == 3
    vehicle.adapt_copies(True)
    assert vehicle.copies == 2


# -- restarted clients ---------------------------------------------------------------------------


def test_nothing_is_planned_for_a_vehicle_whose_client_has_begun_anew() -> None:
    """Its place along its motions is unknown."""
    made = ready()
    made.align(100)
    made.state.restart(0)
    made.decide(101)
    assert made.vehicles[0].next is None
    assert made.vehicle_figures(0)["waits"] == "its restarted client"


def test_others_keep_away_from_all_of_its_motions() -> None:
    made = ready()
    made.align(101)
    made.state.restart(0)
    made.align(102)
    assert made.state.error(0).late >= LONGEST


def test_an_observation_of_its_earlier_life_does_not_end_that() -> None:
    made = ready()
    made.align(101)
    assert made.state.restart(0)
    made.hear(0, 110, 90, 4.0)
    assert 0 in made.state.restarted
    made.hear(0, 122, 90, 4.0)
    assert 0 not in made.state.restarted


# -- zones ---------------------------------------------------------------------------------------


def test_a_line_that_climbs_or_sinks_into_a_zone_comes_near_it() -> None:
    """The zone is from 2 m to 3 m high."""
    above, line = zone_texts.parse("cylinder(0, 0, 1, 2, 3)", 3), np.zeros((2, 3))
    for ends_m, is_near in (((0.0, 1.0), False), ((0.0, 2.5), True), ((2.5, 0.0), True)):
        line[:, 2] = ends_m
        assert comes_near(above, line, 0.5) == is_near


def test_no_zone_is_taken_while_a_vehicle_flies_a_motion_of_an_earlier_server() -> None:
    made = alone()
    made.hear(0, 100, NO_HORIZON, 4.0)
    made.hear(1, 100, 70, -4.0)
    made.align(101)
    assert "vehicle 2" in made.objection(with_zones("cylinder(20, 20, 1)"), KEY)


def test_a_zone_is_refused_where_a_late_vehicle_still_passes() -> None:
    """It may be 60 steps behind its counted step."""
    made = ready()
    made.vehicles[0].in_force = SentMotion(90, along([4.0, 0.0], [-0.8, 0.0], first=101))
    made.align(165)
    zone = with_zones("cylinder(3.4, 0, 0.3)")
    made.state.rows.late[0] = 0.0
    assert not made.objection(zone, KEY)
    made.state.rows.late[0] = 60.0
    assert "vehicle 1" in made.objection(zone, KEY)


def test_no_zone_is_taken_before_it_is_known_where_all_vehicles_are() -> None:
    made = alone()
    made.hear(0, 100, NO_HORIZON, 4.0)
    made.align(101)
    objection = made.objection(with_zones("cylinder(20, 20, 1)"), KEY)
    assert "zones before it is known where vehicle 2 is" in objection
    assert not made.objection(with_zones(""), KEY)


def test_a_vehicle_that_rests_in_a_zone_leaves_it_the_shortest_way() -> None:
    """It has been there since the server started; the goal counts once it is out."""
    made, zone = ready(), zone_texts.parse("box(3, 4.2, -9, 9)", 2)
    made.change(with_zones("box(3, 4.2, -9, 9)"), KEY)
    end = planned(made).position[-1]
    assert zone.clearance(end[None]).min() >= clearances(scenario(2)).tube_m
    assert 4.2 < end[0] < 5.5
    (event,) = made.events
    assert isinstance(event, InZone)
    number, name = event.vehicle, event.zone
    assert (number, name.startswith("box")) == (1, True)


def test_a_way_that_is_closed_is_left_for_another_as_long_as_there_is_one() -> None:
    """A wall between a vehicle and its goal ends to both sides; beyond them there is a fence."""
    place, goal, vehicle = np.array([2.0, 0.0]), np.array([-2.0, 0.0]), VehicleMotions()
    walls = zone_texts.parse("fence(-5, 5, -5, 5) & box(-0.3, 0.3, -4, 3.5)", 2)
    ways = Waypoints(walls, 0.2, 0.9, 400, stream(1, "test"))
    above = ways.routes.way(place, goal)
    assert above[:, 1].max() > 3.0
    assert ways.close_way(vehicle, 101, place, goal)
    assert len(vehicle.closed) == 1
    assert np.abs(vehicle.detour.way(place, goal)[0] - above[0]).max() > 0.1
    corridor = zone_texts.parse("fence(-5, 5, -0.5, 0.5)", 2)
    ways, vehicle = Waypoints(corridor, 0.2, 0.9, 400, stream(1, "test")), VehicleMotions()
    assert not ways.close_way(vehicle, 101, place, goal)
    assert not vehicle.closed


# -- clocks --------------------------------------------------------------------------------------


def heard(count: int, *, asymmetry_ns: int = 0) -> ClockMap:
    """Clock map of a vehicle that is heard once a second, with 0.1 s of delay."""
    clocks = ClockMap(
        1, 50 * MILLISECOND_NS, **({"asymmetry_ns": asymmetry_ns} if asymmetry_ns else {})
    )
    for at in range(count):
        delay_ns = 100 * MILLISECOND_NS
        clocks.observe(0, delay_ns, delay_ns, heard=at, now_ns=at * SECOND_NS)
    return clocks


def test_clocks_may_have_drifted_over_all_the_time_that_is_looked_back() -> None:
    """Also where the operator's bounds on delays leave little else."""
    clocks = heard(25, asymmetry_ns=10 * MILLISECOND_NS)
    assert clocks.middle_ns(0, 24 * SECOND_NS)[1] >= 25 * MILLISECOND_NS


def test_what_the_time_of_day_said_before_a_clock_was_set_does_not_count() -> None:
    """Set by 5 s; afterwards the time of day shows the new clock, without contradiction."""
    clocks, delay_ns = heard(10), 100 * MILLISECOND_NS
    clocks.tell(0, 0, MILLISECOND_NS, now_ns=10 * SECOND_NS)
    set_ns = 5 * SECOND_NS
    clocks.observe(0, delay_ns - set_ns, delay_ns + set_ns, heard=11, now_ns=11 * SECOND_NS)
    assert clocks.middle_ns(0, 11 * SECOND_NS)[0] == pytest.approx(set_ns, abs=0.15 * SECOND_NS)
    told = clocks.tell(0, set_ns, MILLISECOND_NS, now_ns=12 * SECOND_NS)
    assert told is Contradiction.NOTHING


def test_a_time_of_day_that_delays_contradict_moves_no_step() -> None:
    """0.4 s off, where delays allow 0.1 s."""
    clocks = heard(5)
    told = clocks.tell(0, 400 * MILLISECOND_NS, 5 * MILLISECOND_NS, now_ns=5 * SECOND_NS)
    assert told is Contradiction.TIME_OF_DAY
    now_ns = 5 * SECOND_NS + 25 * MILLISECOND_NS
    assert clocks.steps(np.array([0]), now_ns).tolist() == [100]


# -- goals ---------------------------------------------------------------------------------------


def test_a_new_goal_opens_what_was_closed_on_the_way_to_the_old_one() -> None:
    vehicle = VehicleMotions()
    vehicle.is_stuck(0, np.array([4.0, 0.0]), 9.0)
    vehicle.closed.append(np.zeros(2))
    vehicle.detour, vehicle.detour_until = object(), 999
    vehicle.is_stuck(1, np.array([-4.0, 0.0]), 9.0)
    assert not vehicle.closed
    assert vehicle.detour is None


@pytest.mark.parametrize(("rests_x", "is_around"), [(2.0, True), (-4.0, False)])
def test_who_is_stuck_flies_for_a_while_around_one_that_rests_on_its_way(
    rests_x: float, is_around: bool
) -> None:
    """But not around one that rests at its goal."""
    place, goal = np.array([4.0, 0.0]), np.array([-4.0, 0.0])
    vehicle, around = VehicleMotions(), Waypoints(Zones([]), 0.2, 0.9, 400, stream(1, "test"))

    def first(k: int, count: int) -> list[list[float]]:
        found = around.candidates(vehicle, k, place, goal, lambda: [np.array([rests_x, 0.0])])
        return [waypoint.tolist() for waypoint in islice(found, count)]

    assert first(101, 2)[0] == goal.tolist()  # the direct way is tried first
    vehicle.turned_rad = 0.0
    assert (first(500, 1) != [goal.tolist()]) == is_around
    vehicle.turned_rad = 0.0
    assert first(501, 1) == [goal.tolist()]


@pytest.mark.parametrize("late", [0.0, 1e11, np.inf])
def test_zones_are_checked_whatever_is_known_of_a_clock(late: float) -> None:
    made = ready()
    made.state.rows.late[0] = late
    assert not made.objection(with_zones("cylinder(0, 9, 0.5)"), KEY)
    assert "vehicle 1 hovers in" in made.objection(with_zones("cylinder(4, 0, 0.5)"), KEY)


@pytest.mark.parametrize("late", [0.0, 1e11])
def test_a_vehicle_moves_away_from_one_of_whose_clock_nothing_is_known(late: float) -> None:
    """Already too near; the computation must not grow with the uncertainty of the clock."""
    made = ready()
    for row, x in ((0, 0.3), (1, 0.0)):
        made.vehicles[row].in_force = SentMotion(90, resting(100, np.array([x, 0.0])))
        made.state.possible.replace(
            row, [made.state.possible_motion(row, made.vehicles[row].in_force.motion)], 0.0
        )
    made.state.possible.set_errors(np.zeros(2), np.array([0.0, late]))
    away = Motion(100, np.array([[0.3, 0.0], [0.4, 0.0], [0.4, 0.0]]), np.zeros((3, 2)))
    planned_ = made.state.possible_motion(0, away)
    in_force = made.vehicles[0].in_force.motion
    assert not too_near(planned_, in_force, 101, 0, made.state.possible, 0.9).any()
