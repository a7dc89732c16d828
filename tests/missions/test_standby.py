"""Missions with two servers: vehicles keep apart whoever hears whom."""

from functools import partial

import msgspec
import numpy as np
import pytest

from fuzz.adversary.climb import Climb, climb
from fuzz.adversary.lives import Lives
from fuzz.adversary.raid import AdversaryNetwork, Move, MoveKind, Raid, spare_m
from helpers import packaged
from skytether.client.endpoint import Client
from skytether.server.missions.led_vehicles import LedVehicles
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import SessionRefused
from skytether.shared.events.standby import LimitsDiffer
from skytether.shared.law.motion import SPACING, Motion, resting
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import nearest
from skytether.shared.wire.lead import Lead
from skytether.shared.wire.protocol import NO_HORIZON
from skytether.sim.flight import SERVER
from skytether.sim.standby import STANDBY
from two_vehicles import along, ready

SPLIT_S = 30


def swaps() -> Scenario:
    """Eight vehicles whose servers are given up after 7.5 s."""
    layer = {
        "seed": 1,
        "duration": 60.0,
        "reference": {"shape": "swap(8)"},
        "link": {"timeout_s": 7.5},
    }
    return packaged("swap", layer)


def moved(kind: MoveKind, vehicle: int, start_s: float, *amounts: float) -> Move:
    start_ns, length_ns = round(start_s * SECOND_NS), 30 * SECOND_NS
    return Move(kind, vehicle, "", start_ns, length_ns, amounts)


def split() -> Raid:
    """All have arrived; then half of them hear one server only, half the other; then the operator
    sends one of each half to the other side, against each other.
    """
    scenario = swaps()
    mission = scenario.make_reference()
    assert isinstance(mission, Mission)
    ends = {number: mission.of(number)(np.array(60.0))[:, 0] for number in (1, 5)}
    halves = [
        moved(MoveKind.PARTITIONS, number, SPLIT_S, float(number < 5)) for number in range(1, 9)
    ]
    crossing = [
        moved(MoveKind.GOALS, number, SPLIT_S + 15.0, *(0.5 * ends[6 - number]).tolist())
        for number in (1, 5)
    ]
    return Raid(scenario, (*halves, *crossing))


@pytest.mark.long
def test_two_servers_never_plan_for_halves_of_a_mission(monkeypatch: pytest.MonkeyPatch) -> None:
    assert split().run().apart.away_m > 0.8
    monkeypatch.setattr(LedVehicles, "_look", lambda _: None)
    assert split().run().apart.away_m < 0.5


def test_the_mission_goes_on_when_the_first_server_dies() -> None:
    """All arrive with the standby, though the first server dies in the middle and stays away."""
    dies = Move(MoveKind.SERVER, 0, "", 6 * SECOND_NS, 3600 * SECOND_NS)
    there = Move(MoveKind.STANDBY, 0, "", 3600 * SECOND_NS, 1)
    raid = Raid(msgspec.structs.replace(swaps(), duration=55.0), (dies, there))
    assert raid.run().apart.away_m > 0.8
    lives = raid._lives
    for number, body in lives.bodies.items():
        goal = lives.mission.of(number)(np.array(60.0))[:, 0]
        assert np.linalg.norm(body.plant.state()[:, 0] - goal) < 0.3


@pytest.mark.long
def test_an_adversary_of_two_servers_finds_nothing() -> None:
    kinds = (
        *(MoveKind.SERVER, MoveKind.STANDBY, MoveKind.FREEZES, MoveKind.PARTITIONS),
        *(MoveKind.DELAYS, MoveKind.LOSSES, MoveKind.GOALS),
    )
    task = Climb(swaps(), kinds, 1, 8)
    climbed = climb(task)
    assert min(climbed.spares_m) > 0.0
    assert spare_m(task.scenario, climbed.best) > 0.3


def told(row: int, step: int, number: int = 1, motion: Motion | None = None) -> Lead:
    if motion is None:
        return Lead(row + 1, 7, number, 1, step=step, knots=np.empty((2, 0, 2), np.float32))
    knots = np.stack([motion.position, motion.velocity], axis=-1).transpose(1, 0, 2)
    flown = np.ascontiguousarray(knots, np.float32)
    return Lead(row + 1, 7, number, 1, 0, step, motion.first, SPACING, flown)


def test_a_vehicle_is_sent_nothing_before_it_was_observed_under_the_new_leader() -> None:
    """What was known of it before may be long past: it was led by another server since."""
    made = ready()
    for row in (0, 1):
        made.follow(row, told(row, 200))
    made.align(201)
    made.decide(201)
    assert all(vehicle.next is None for vehicle in made.vehicles.values())
    assert made.vehicle_figures(0)["waits"] == "its first observation"
    made.hear(0, 205, NO_HORIZON, 2.0)
    made.align(211)
    made.decide(211)
    assert made.vehicles[1].next is None
    hovers = made.vehicles[0].next
    assert hovers is not None
    assert hovers.position[-1].tolist() == [2.0, 0.0]


def test_a_motion_that_was_told_is_known_once_all_were_observed() -> None:
    made = ready()
    flown = along([4.0, 0.0], [-0.8, 0.0], first=190)
    for row, motion in ((0, flown), (1, resting(200, np.array([-4.0, 0.0])))):
        made.follow(row, told(row, 200, motion=motion))
        assert made.state.led_vehicles.missing is not None
    for row, x in ((0, 3.9), (1, -4.0)):
        in_force = made.vehicles[row].in_force
        assert in_force is not None
        made.hear(row, 200, in_force.step, x)
    made.align(201)
    assert made.state.led_vehicles.missing is None
    (kept, *_) = made.vehicles[0].motions()
    assert np.allclose(kept.position, flown.position, atol=1e-6)
    assert np.allclose(kept.velocity, flown.velocity, atol=1e-6)
    assert not made.vehicles[0].is_foreign


def test_what_is_taken_over_is_what_was_told_and_no_motion_sent_before() -> None:
    """Nor is one sent that the server had planned when it led last."""
    made, earlier = ready(), along([4.0, 0.0], [-0.8, 0.0], first=110)
    made.state.note_sent(0, 101, earlier)
    made.vehicles[0].next = earlier
    made.follow(0, told(0, 200, motion=resting(200, np.array([2.0, 0.0]))))
    assert made.vehicles[0].next is None
    assert [motion.position.tolist() for motion in made.vehicles[0].motions()] == [[[2.0, 0.0]]]


def test_an_observation_of_before_a_vehicle_was_taken_over_does_not_count() -> None:
    made = ready()
    made.follow(0, told(0, 200, motion=resting(200, np.array([2.0, 0.0]))))
    made.hear(0, 199, 90, 4.0)
    assert made.vehicles[0].in_force.step == 200
    made.hear(0, 200, NO_HORIZON, 2.0)
    assert made.state.observed_step[0] == 200


def test_vehicles_of_two_numbers_are_not_planned_for() -> None:
    made = ready()
    for row, number in ((0, 1), (1, 3)):
        made.follow(row, told(row, 200, number))
        made.hear(row, 200, NO_HORIZON, 4.0 - 8.0 * row)
    made.align(201)
    assert made.state.led_vehicles.missing == 0
    made.follow(0, told(0, 210, 3))
    made.hear(0, 210, NO_HORIZON, 4.0)
    made.align(211)
    assert made.state.led_vehicles.missing is None
    made.follow(1, Lead(2, 7, 4, 0))
    assert made.state.led_vehicles.missing == 1


def test_a_vehicle_that_names_another_leader_stops_no_vehicle_that_has_none() -> None:
    """The other server never hears all of them, so it plans nothing for the first either."""
    made = ready()
    made.follow(1, None)
    for number, leads in ((1, 0), (4, 1), (5, 0)):
        made.follow(0, told(0, 200, number)._replace(leads=leads))
        assert made.state.led_vehicles.missing is None
    made.follow(1, told(1, 200, 0))
    assert made.state.led_vehicles.missing is not None


def test_a_stolen_vehicle_that_speaks_of_a_standby_costs_the_others_its_room_only() -> None:
    scenario = packaged("swap", duration=40.0, reference={"shape": "swap(4)"})
    lives = Lives(scenario)
    lives.run(4.0)
    client = lives._lives[1][-1].client
    session = client._servers.followed
    assert session.number is not None
    lead = Lead(1, session.number, 1, 0)
    lives.world.act("client 1", lambda *, now_ns: session.post(lead, now_ns))
    lives.run(40.0)
    for number in (2, 3, 4):
        goal = lives.mission.of(number)(np.array(40.0))[:, 0]
        assert np.linalg.norm(lives.bodies[number].plant.state()[:, 0] - goal) < 0.3
    times, apart_m = nearest(list(lives.tracks().values()), scenario.control.dt)
    assert np.nanmin(apart_m) > 0.7
    assert len(times)


def test_a_standby_that_would_keep_another_distance_is_refused_with_both() -> None:
    scenario = packaged("swap", duration=30.0, reference={"shape": "swap(4)"})
    lives = Lives(scenario, AdversaryNetwork((), 1), has_standby=True)
    lives.start_server({"mission.separation_m": 0.1}, name=STANDBY[0])
    lives.run(8.0)
    refused = [each for _, _, each in lives.events if isinstance(each, SessionRefused)]
    assert {each.vehicle for each in refused} == {1, 2, 3, 4}
    (differs,) = refused[0].differences
    assert differs.key == "mission.separation_m"
    assert {differs.here, differs.there} == {"0.1", "0.5"}
    assert lives.running


def with_standby(**others: object) -> Lives:
    """Four vehicles on a network without losses, which give up a leader after 0.75 · 8 s.

    Args:
        others: other values of the standby, by key.
    """
    mission = {"reference": {"shape": "swap(4)"}, "link": {"timeout_s": 8.0}}
    lives = Lives(
        packaged("swap", duration=30.0, **mission), AdversaryNetwork((), 1), has_standby=True
    )
    lives.start_server(others, name=STANDBY[0])
    return lives


def leaderships(lives: Lives) -> list[int]:
    return [client.vehicle_figures()["leadership"]["number"] for client in clients(lives)]


@pytest.mark.parametrize(
    "others",
    [
        {},
        {"mission.zones": "box(6, 7, 6, 7)"},
        {"mission.acceleration_mps2": 0.5},
        {"link.asymmetry_s": 0.3},
    ],
)
def test_a_standby_that_plans_within_other_limits_is_not_followed(
    others: dict[str, object],
) -> None:
    lives = with_standby(**others)
    lives.run(6.0)
    lives.servers[SERVER[0]].kill(lives.world)
    lives.run(15.0)
    assert leaderships(lives) == [int(not others)] * 4
    refused = [each for _, _, each in lives.events if isinstance(each, LimitsDiffer)]
    assert sorted(each.vehicle for each in refused) == ([1, 2, 3, 4] if others else [])
    for each in refused:
        (differs,) = each.differences
        assert [differs.key] == list(others)
        assert differs.here != differs.there


def test_zones_that_are_set_at_both_servers_are_followed_by_the_standby() -> None:
    """It leads nobody and does not know every motion, so it leaves objections to the leader."""
    lives = with_standby()
    for name, at_s in ((SERVER[0], 4.0), (STANDBY[0], 6.0)):
        lives.run(at_s)
        change = partial(lives._running[name].change, {"mission.zones": "box(6, 7, 6, 7)"})
        lives.world.act(name, change)
        lives.run(at_s + 1.9)
        differs = name == SERVER[0]
        may_lead = [client._servers.leadership.may_lead(1) for client in clients(lives)]
        assert may_lead == [not differs] * 4
    lives.servers[SERVER[0]].kill(lives.world)
    lives.run(17.0)
    assert leaderships(lives) == [1] * 4


def clients(lives: Lives) -> list[Client]:
    return [each[-1].client for each in lives._lives.values()]
