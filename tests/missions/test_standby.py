"""Missions with two servers: vehicles keep apart whoever hears whom."""

import msgspec
import numpy as np
import pytest

from helpers import packaged
from skytether.lab.adversary import Climb, Move, MoveKind, Raid, climb, spare_m
from skytether.server.missions.mission_state import MissionState
from skytether.shared.base.units import SECOND_NS
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.schema import Scenario

SPLIT_S = 30


def swaps(seed: int = 1) -> Scenario:
    """Eight vehicles whose servers are given up after 7.5 s."""
    layer = {
        "seed": seed,
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


def test_two_servers_never_plan_for_halves_of_a_mission(monkeypatch: pytest.MonkeyPatch) -> None:
    assert split().run().apart.away_m > 0.8
    monkeypatch.setattr(MissionState, "_find_unled", lambda self: setattr(self, "unled", None))
    assert split().run().apart.away_m < 0.5


def test_the_mission_goes_on_when_the_first_server_dies() -> None:
    """All arrive with the standby, though the first server dies in the middle and stays away."""
    dies = Move(MoveKind.SERVER, 0, "", 6 * SECOND_NS, 3600 * SECOND_NS)
    there = Move(MoveKind.STANDBY, 0, "", 3600 * SECOND_NS, 1)
    raid = Raid(msgspec.structs.replace(swaps(), duration=70.0), (dies, there))
    assert raid.run().apart.away_m > 0.8
    lives = raid._lives
    for number, body in lives.bodies.items():
        goal = lives.mission.of(number)(np.array(60.0))[:, 0]
        assert np.linalg.norm(body.plant.state()[:, 0] - goal) < 0.3


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_an_adversary_of_two_servers_finds_nothing(seed: int) -> None:
    kinds = (
        *(MoveKind.SERVER, MoveKind.STANDBY, MoveKind.FREEZES, MoveKind.PARTITIONS),
        *(MoveKind.DELAYS, MoveKind.LOSSES, MoveKind.GOALS),
    )
    task = Climb(swaps(seed), kinds, seed, 8)
    assert min(climb(task).spares_m) > 0.0
    assert spare_m(task.scenario, climb(task).best) > 0.3
