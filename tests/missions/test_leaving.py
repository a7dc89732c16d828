"""Missions that somebody leaves: servers and clients that are asked to end, late joiners, and
flights whose time is up. Vehicles keep apart, and each stays on its motion.
"""

from functools import partial

import msgspec
import numpy as np
import pytest

from fuzz.adversary.lives import Lives
from fuzz.adversary.raid import Move, MoveKind, Raid, spare_m
from helpers import packaged
from skytether.client import failsafe
from skytether.client.failsafe import FOLLOWING
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.events.flight import Leaving, SteppedLate
from skytether.shared.missions.events import LeftMotion
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason

FOUR = packaged("swap", duration=40.0, reference={"shape": "swap(4)"})
EIGHT = packaged("swap", duration=40.0, reference={"shape": "swap(8)"})


def move(
    kind: MoveKind, vehicle: int, way: str, start_s: float, length_s: float, *amounts: float
) -> Move:
    return Move(kind, vehicle, way, seconds_to_ns(start_s), seconds_to_ns(length_s), amounts)


def attacked(scenario: Scenario, *moves: Move) -> float:
    """Spare distance between vehicles [m], without the scenario's network."""
    return spare_m(scenario, Raid(scenario, moves).run())


def test_a_server_that_is_asked_to_end_waits_until_its_vehicles_rest() -> None:
    """It plans nothing meanwhile; after its restart all fly on."""
    lives = Lives(FOUR)
    lives.run(7.0)
    before = [int(lives.track(number)[1].shape[0]) for number in lives.bodies]
    assert all(before)
    lives.end_server()
    (event,) = (each for _, _, each in lives.events if isinstance(each, Leaving))
    assert set(event.vehicles) == {1, 2, 3, 4}
    while lives.running and lives.world.now_ns < 30 * SECOND_NS:
        lives.run(lives.world.now_ns / SECOND_NS + 0.05)
    assert lives.world.now_ns < (7.0 + event.most_s) * SECOND_NS
    for each in lives.bodies.values():
        assert np.hypot(*each.plant.state()[:, 1]) < 0.3  # wind
    for (client, steps), *_ in lives._lives.values():
        rows = steps.rows()
        assert rows["in_force"].max() * 0.05 <= 7.0 + FOUR.link.join_s
        assert client.finished is False
    lives.start_server({})
    lives.run(45.0)
    for number, body in lives.bodies.items():
        goal = lives.mission.of(number)(np.array(40.0))[:, 0]
        assert np.linalg.norm(body.plant.state()[:, 0] - goal) < 0.3


def test_a_server_whose_vehicles_rest_ends_at_once() -> None:
    lives = Lives(FOUR)
    lives.run(35.0)
    lives.end_server()
    assert not lives.running


@pytest.mark.parametrize("vehicle", [2, 6])
@pytest.mark.parametrize("at_s", [5.0, 6.2])
def test_a_close_that_reaches_one_vehicle_only_takes_it_off_no_motion(
    vehicle: int, at_s: float
) -> None:
    stop = move(MoveKind.STOPS, 0, "", at_s, 20.0, 0.0)
    deaf = [
        move(MoveKind.CUTS, number, "uplink", at_s, 1e-3)
        for number in range(1, 9)
        if number != vehicle
    ]
    assert attacked(EIGHT, stop, *deaf) > 0.3


def test_without_the_rule_the_others_meet_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failsafe, "AT_ONCE", frozenset(Reason))
    stop = move(MoveKind.STOPS, 0, "", 6.2, 20.0, 0.0)
    deaf = [move(MoveKind.CUTS, each, "uplink", 6.2, 1e-3) for each in range(1, 9) if each != 2]
    assert attacked(EIGHT, stop, *deaf) < 0.0


@pytest.mark.parametrize("at_s", [5.5, 7.0])
def test_a_stall_of_one_step_takes_a_vehicle_off_no_motion(at_s: float) -> None:
    stalls = (move(MoveKind.STALLS, number, "", at_s, 0.12) for number in (1, 5))
    assert attacked(EIGHT, *stalls) > 0.3


def test_a_step_that_begins_too_late_is_told_and_the_latest_is_a_figure() -> None:
    lives = Lives(FOUR)
    stalls_s = {5.0: 0.08, 6.0: 0.32, 8.0: 0.2}
    for at_s, length_s in stalls_s.items():
        lives.world.at(seconds_to_ns(at_s), partial(lives.world.freeze, "client 2"))
        lives.world.at(seconds_to_ns(at_s + length_s), partial(lives.world.thaw, "client 2"))
    lives.run(10.0)
    (event,) = (each for _, _, each in lives.events if isinstance(each, SteppedLate))
    assert event.vehicle == 2
    assert stalls_s[6.0] - FOUR.control.dt < event.late_s <= stalls_s[6.0]
    late_ms = {
        number: life[-1].client.vehicle_figures()["late_ms"]
        for number, life in lives._lives.items()
    }
    assert late_ms == {1: 0.0, 2: 1000.0 * event.late_s, 3: 0.0, 4: 0.0}


def test_the_server_tells_how_near_a_flight_came_to_what_the_theorem_assumes() -> None:
    lives = Lives(FOUR)
    lives.run(40.0)
    figures = lives.server_runs[-1].figures()
    assert 0.05 < figures["margins"]["tube"] < 1.0
    assert 0.1 < figures["margins"]["join"] <= 1.0
    assert not {"left_motion", "joined_late", "left_tube"} & figures["counts"].keys()


@pytest.mark.parametrize("at_s", [5.0, 6.0])
def test_a_vehicle_that_a_person_takes_off_its_motion_is_counted_and_named(at_s: float) -> None:
    lives = Lives(FOUR)
    lives.run(at_s)
    client = lives._lives[2][-1].client
    disarmed = msgspec.structs.replace(FOUR, armed=False)
    lives.world.act("client 2", partial(client.change, disarmed, frozenset({"armed"})))
    lives.run(at_s + 2.0)
    (left,) = (each for _, _, each in lives.events if isinstance(each, LeftMotion))
    assert left.vehicle == 2
    assert left.left_s > 0.5
    assert lives.server_runs[-1].figures()["counts"]["left_motion"] == 1


def test_vehicles_that_start_apart_end_at_rest_and_keep_apart() -> None:
    """The first ones' time is up while they are still on their way."""
    scenario = packaged("swap", duration=26.0, reference={"shape": "swap(4)"})
    joins = [move(MoveKind.JOINS, number, "", 0.0, 6.0 * number - 5.9) for number in range(1, 5)]
    raid = Raid(scenario, tuple(joins))
    found = raid.run()
    assert spare_m(scenario, found) > 0.3
    for number, lives in raid._lives._lives.items():
        rows = lives[-1].steps.rows()
        flown = rows[rows["in_force"] >= 0]
        assert len(flown), number
        assert set(flown["mode"]) <= {int(each) for each in FOLLOWING} | {rows["mode"][-1]}
        assert np.hypot(*rows["state"][-1, :, 1]) < 0.3  # wind


def test_a_client_that_is_asked_to_end_rests_and_comes_back() -> None:
    ends = move(MoveKind.ENDS, 3, "", 6.0, 12.0)
    raid = Raid(FOUR, (ends,))
    assert spare_m(FOUR, raid.run()) > 0.3
    first, second = raid._lives._lives[3]
    rows = first.steps.rows()
    assert np.hypot(*rows["state"][-1, :, 1]) < 0.3
    assert len(second.steps.rows())
    assert raid._lives.world.now_ns > 18 * SECOND_NS + MILLISECOND_NS
