"""Adversary: effects of its moves, planted faults that it must find, and reproducibility."""

import math
import re
import shlex
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from fuzz.adversary import __main__ as commands
from fuzz.adversary.climb import Climb, Climbed, MoveSampler, climb
from fuzz.adversary.lives import Body, world_s
from fuzz.adversary.raid import (
    COVERED,
    HAS_STANDBY,
    AdversaryNetwork,
    Move,
    MoveKind,
    Moves,
    Near,
    Packet,
    Raid,
    fly,
    shrunk,
    spare_m,
)
from fuzz.engine import dumps, loads
from skytether.lab.commands import pool
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.server.missions.mission_state import MissionState
from skytether.server.missions.vehicle_motions import VehicleMotions
from skytether.server.planning.clock import ClockMap
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.standby import LeaderChanged
from skytether.shared.law.model import Array, Indices
from skytether.shared.law.motion import Motion
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command
from skytether.shell.commandline.command import CommandError
from skytether.sim.flight import SERVER
from skytether.sim.standby import STANDBY
from skytether.sim.world import World

Patch = Callable[[pytest.MonkeyPatch], None]
replaced = msgspec.structs.replace


def scenario(shape: str, duration: float = 30.0) -> Scenario:
    loaded = reading.load(shape.partition("(")[0])
    if "(" in shape:
        reference = replaced(loaded.reference, shape=shape)
        loaded = replaced(loaded, reference=reference)
    return replaced(loaded, duration=duration)


def move(
    kind: MoveKind, vehicle: int, way: str, start_s: float, length_s: float, *amounts: float
) -> Move:
    start_ns, length_ns = seconds_to_ns(start_s), seconds_to_ns(length_s)
    return Move(kind, vehicle, way, start_ns, length_ns, amounts)


FOUR = scenario("swap(4)")


# -- moves ---------------------------------------------------------------------------------------


def arrivals(*moves: Move, at_s: float, way: str = "downlink", count: int = 1) -> list[float]:
    """Delays of packets of vehicle 2 that enter the network at one time [s]."""
    air, entered_ns = AdversaryNetwork(moves, seed=1), seconds_to_ns(at_s)
    for _ in range(count):
        if way == "downlink":
            air.receive(Datagram(b"", ("client 2", 0), 0), now_ns=entered_ns)
        else:
            air.receive(Datagram(b"", ("server", 0), 2), now_ns=entered_ns)
    found = []
    while (due_ns := air.next_wake_ns()) is not None:
        air.wake(now_ns=due_ns)
        to = ("server", 0) if way == "downlink" else ("client 2", 0)
        found += [(due_ns - entered_ns) / SECOND_NS for each in air.outbox() if each.peer == to]
    return found


def test_a_delay_is_of_one_vehicle_and_one_way_and_grows_as_it_says() -> None:
    """Other packets take the base delay, delays add up, and a long delay changes slowly."""
    grows = move(MoveKind.DELAYS, 2, "downlink", 10.0, 10.0, 0.2, 0.4)
    assert arrivals(grows, at_s=9.9) == [0.05]
    assert arrivals(grows, at_s=10.0) == pytest.approx([0.25])
    assert arrivals(grows, at_s=15.0) == pytest.approx([0.35])
    assert arrivals(grows, grows, at_s=15.0) == pytest.approx([0.65])
    assert arrivals(grows, at_s=20.0) == [0.05]
    assert arrivals(grows, at_s=15.0, way="uplink") == [0.05]
    assert arrivals(replace(grows, vehicle=1), at_s=15.0) == [0.05]
    assert arrivals(replace(grows, vehicle=0, way=""), at_s=15.0, way="uplink") == [0.35]


def test_packets_are_cut_lost_and_copied() -> None:
    assert arrivals(move(MoveKind.CUTS, 2, "", 1.0, 1.0), at_s=1.5) == []
    lost = move(MoveKind.LOSSES, 2, "", 0.0, 9.0, 0.3)
    assert 600 < len(arrivals(lost, at_s=1.0, count=1000)) < 800
    copied = move(MoveKind.COPIES, 2, "", 0.0, 9.0, 0.7)
    assert arrivals(copied, at_s=1.0) == pytest.approx([0.05, 0.75])


def test_a_vehicle_without_a_client_flies_on_and_is_seen() -> None:
    """With its last velocity, for a second; its path is recorded meanwhile."""
    body = Body(FOUR, 1)
    body.measurements(now_ns=0)
    body.fly(np.array([0.5, 0.0]))
    body.measurements(now_ns=4 * SECOND_NS)
    began = body.plant.state()[0, 0]
    body.fly_alone(14 * SECOND_NS)
    assert len(body.unflown) == 200
    times = np.array([at_s for at_s, _ in body.unflown])
    x = np.array([place[0] for _, place in body.unflown])
    assert times[0] == pytest.approx(4.05)
    assert x[19] - began == pytest.approx(0.5, abs=0.2)
    assert abs(x[99] - x[60]) < 0.3  # stopped, except for wind
    np.testing.assert_array_equal(body.truth(), body.plant.state())


EARLY_S, LATE_S = 5.0, 7.0
"""Times at which vehicles are on their way."""


def test_a_client_is_restarted_with_the_state_that_it_had_some_time_before() -> None:
    """It flies the motion of then; in time the whole flight is known."""
    raid = Raid(FOUR, (move(MoveKind.RESTORES, 2, "", LATE_S, 0.2, LATE_S - EARLY_S, 0.0),))
    raid.run()
    first, second = (life.steps.rows() for life in raid._lives._lives[2])
    before = first["in_force"][first["step"] == round(EARLY_S / FOUR.control.dt)]
    assert second["in_force"][0] <= before[0] < first["in_force"][-1]


@pytest.mark.parametrize("is_standby", [False, True])
def test_a_server_is_restarted_with_the_keys_that_it_had_some_time_before(
    is_standby: bool,
) -> None:
    moves = (
        move(MoveKind.GOALS, 1, "", EARLY_S, 60.0, 0.0, 3.0),
        move(MoveKind.RESTORES, 0, "", LATE_S, 0.2, 1.9, float(is_standby)),
        move(MoveKind.RESTORES, 0, "", LATE_S + 1.0, 0.2, 5.0, float(is_standby)),
        HAS_STANDBY,
    )
    raid, goals = Raid(FOUR, moves), []
    for until_s in (LATE_S + 0.5, LATE_S + 1.5):
        raid._lives.run(until_s)
        own, other = SERVER[0], STANDBY[0]
        restored = raid._lives._running[other if is_standby else own]
        goals.append(restored.scenario.mission.goals)
        assert (
            "goal(1," in raid._lives._running[own if is_standby else other].scenario.mission.goals
        )
    assert "goal(1," in goals[0]
    assert not goals[1]


def test_a_vehicle_joins_once() -> None:
    joins = (move(MoveKind.JOINS, 2, "", 0.0, 2.0), move(MoveKind.JOINS, 2, "", 4.0, 3.0))
    raid = Raid(FOUR, joins)
    raid._lives.run(8.0)
    (_, client) = (life.client for life in raid._lives._lives[2])
    assert world_s(client.began_ns / SECOND_NS) == pytest.approx(2.1, abs=0.1)


def test_a_zone_that_one_of_two_servers_has_refused_does_not_count() -> None:
    """The other keeps to it only while it leads."""
    zones = move(MoveKind.ZONES, 0, "", LATE_S, 20.0, 3.5, 3.5, 0.4)
    for dies, counts in (((), True), ((move(MoveKind.STANDBY, 0, "", LATE_S - 0.5, 0.4),), False)):
        raid = Raid(FOUR, (HAS_STANDBY, zones, *dies))
        raid._lives.run(LATE_S + 1.0)
        assert "cylinder" in raid._lives._running[SERVER[0]].scenario.mission.zones
        assert bool(raid._zones[-1][1]) == counts


def test_a_standby_server_is_stopped_too() -> None:
    raid = Raid(FOUR, (HAS_STANDBY, move(MoveKind.STOPS, 0, "", EARLY_S, 60.0, 0.0, 1.0)))
    raid._lives.run(EARLY_S + 1.0)
    assert [name for name, each in raid._lives.servers.items() if each.is_up] == [SERVER[0]]


def test_a_server_that_claims_to_lead_is_followed_and_all_arrive() -> None:
    """Vehicle 3 tells both servers of the larger number, and all others follow."""
    claims = move(MoveKind.LEADS, 3, "uplink", EARLY_S, 0.5, 5.0, 1.0)
    raid = Raid(FOUR, (HAS_STANDBY, claims))
    assert spare_m(FOUR, raid.run()) > 0.3
    changed = [each for _, _, each in raid._lives.events if isinstance(each, LeaderChanged)]
    assert {each.vehicle for each in changed} == {1, 2, 3, 4}
    assert raid._has_arrived()


@pytest.mark.parametrize("leads", [0.0, 1.0])
def test_a_stolen_vehicle_that_names_a_leader_brings_no_others_together(leads: float) -> None:
    """Its own distances are not asked for."""
    claims = move(MoveKind.LEADS, 3, "downlink", EARLY_S, 20.0, 5.0, leads)
    for servers in ((), (HAS_STANDBY,)):
        found = fly(FOUR, (*servers, claims))
        assert 3 not in found.apart.vehicles
        assert spare_m(FOUR, found) > 0.3


def test_with_moves_of_two_servers_flights_of_other_moves_have_two_as_well() -> None:
    sampler = MoveSampler(Climb(FOUR, COVERED, 1, 1), np.random.default_rng(1))
    drawn = [sampler.some() for _ in range(50)]
    assert 10 < sum(HAS_STANDBY in moves for moves in drawn) < 40
    assert {each.kind for moves in drawn for each in moves} == {*COVERED}


def test_a_copy_of_a_hello_arrives_when_the_server_has_restarted() -> None:
    task = Climb(FOUR, (MoveKind.COPIES, MoveKind.SERVER), 1, 1)
    sampler, near = MoveSampler(task, np.random.default_rng(1)), Near(0.6, 20.0, (1, 3))
    packets = [Packet(seconds_to_ns(0.1 * n), "downlink", 1 + n % 4) for n in range(400)]
    drawn = [sampler.changed((), near, packets) for _ in range(400)]
    found = [
        (server, copy)
        for server, copy in (moves for moves in drawn if len(moves) == 2)
        if copy.kind is MoveKind.COPIES
        and copy.start_ns + seconds_to_ns(copy.amounts[0]) + 1 == server.end_ns
    ]
    assert len(found) > 10
    for server, copy in found:
        assert server.kind is MoveKind.SERVER
        assert copy.vehicle in near.vehicles
        assert copy.start_ns < SECOND_NS
        assert 10 * SECOND_NS < server.end_ns <= 20 * SECOND_NS + 1


def test_every_move_that_is_drawn_can_be_changed() -> None:
    sampler = MoveSampler(Climb(FOUR, tuple(MoveKind), 1, 1), np.random.default_rng(1))
    for _ in range(50):
        moves = sampler.some()
        for _ in range(5):
            moves = tuple(map(sampler._tuned, moves))
        assert [len(each.amounts) for each in moves] == [
            len(sampler._amounts(each.kind)) for each in moves
        ]


# -- planted faults ------------------------------------------------------------------------------


def newest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: the server separates vehicles only from the newest motion."""
    motions = VehicleMotions.motions

    def last(self: VehicleMotions) -> list[Motion]:
        return motions(self)[-1:]

    monkeypatch.setattr(VehicleMotions, "motions", last)


def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: a restarted server plans before it has heard all vehicles."""
    init = MissionState.__init__

    def begin(self: MissionState, *args: Any) -> None:
        init(self, *args)
        self.absent.clear()

    monkeypatch.setattr(MissionState, "__init__", begin)


def certain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: the server takes its estimate of vehicles' clocks as exact."""

    def known(_: ClockMap, rows: Indices, __: Indices, early: Array, late: Array) -> None:
        early[rows] = late[rows] = 0.0

    monkeypatch.setattr(ClockMap, "step_errors", known)


def forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: restarted clients find no saved state."""
    monkeypatch.setattr(World, "memory", lambda *_: None)


def heedless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: the server accepts zones that vehicles may fly into."""
    monkeypatch.setattr(MissionPlanner, "objection", lambda *_: "")


@pytest.mark.parametrize(
    ("kinds", "first", "flights", "ablation"),
    [
        pytest.param("losses", 4, 7, newest, marks=pytest.mark.long),
        pytest.param("cuts", 2, 7, newest, marks=pytest.mark.long),
        ("delays", 2, 2, certain),
        pytest.param("client", 1, 7, forgetful, marks=pytest.mark.long),
        pytest.param("goals,losses", 5, 7, newest, marks=pytest.mark.long),
        pytest.param("server,cuts", 33, 7, hasty, marks=pytest.mark.long),
        ("zones", 0, 2, heedless),
    ],
)
def test_each_kind_of_move_finds_a_planted_fault(
    kinds: str, first: int, flights: int, ablation: Patch, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = replaced(FOUR, duration=80.0) if "server" in kinds else FOUR
    named = tuple(map(MoveKind, kinds.split(",")))
    with monkeypatch.context() as without:
        ablation(without)
        climbs = (climb(Climb(flown, named, first + n, flights)).best for n in range(20))
        best = next(each for each in climbs if spare_m(flown, each) < 0.0)
    assert spare_m(flown, fly(flown, best.moves)) > 0.0


def test_a_server_that_begins_anew_takes_no_zone_before_it_has_heard_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moves = (
        move(MoveKind.SERVER, 0, "", 20.0, 0.5),
        move(MoveKind.ZONES, 0, "", 22.0, 4.0, -4.0, 0.0, 0.5),
    )
    assert spare_m(FOUR, fly(FOUR, moves)) > 0.0
    monkeypatch.setattr(MissionState, "unknown", lambda _: None)
    assert spare_m(FOUR, fly(FOUR, moves)) < 0.0


# -- recorded attacks --------------------------------------------------------------------------

ATTACKS = Path(__file__).parents[1] / "adversary_attacks.txt"
LONG_ATTACKS = ("sphere", "rings", "corridor", "warehouse")
"""Missions whose flight takes more than 1.5 s of CPU time."""


def recorded() -> list[str]:
    return [line for line in ATTACKS.read_text().splitlines() if not line.startswith("#")]


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=[pytest.mark.long] if line.split()[1] in LONG_ATTACKS else [])
        for line in recorded()
    ],
)
def test_attacks_that_succeeded_once_succeed_no_more(line: str) -> None:
    """The command fails if a required distance is violated."""
    name, *argv = shlex.split(line)
    assert name == "adversary"
    commands.main(argv)


# -- reproducibility -----------------------------------------------------------------------------

DIES = move(MoveKind.CUTS, 0, "", 3.0, 2.0)
IN_THE_WAY = move(MoveKind.ZONES, 0, "", 5.0, 4.0, 0.0, 0.0, 1.0)


def test_a_flight_comes_again_to_the_last_bit() -> None:
    moves = (
        DIES,
        move(MoveKind.DELAYS, 1, "uplink", 0.0, 30.0, 0.1, 0.7),
        move(MoveKind.LOSSES, 3, "", 0.0, 30.0, 0.4),
        move(MoveKind.COPIES, 4, "downlink", 0.0, 30.0, 0.3),
        move(MoveKind.GOALS, 2, "", 4.0, 3.0, 1.0, -3.0),
        move(MoveKind.CLIENT, 3, "", 6.0, 0.2),
        move(MoveKind.SERVER, 0, "", 7.0, 1.0),
    )
    found = fly(FOUR, moves)
    assert math.isfinite(found.apart.distance_m)
    assert fly(FOUR, loads(dumps(moves), Moves)) == found


def test_the_fewest_moves_are_those_that_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    heedless(monkeypatch)
    brief = replaced(FOUR, duration=10.0)
    found = fly(brief, (DIES, IN_THE_WAY, move(MoveKind.GOALS, 2, "", 8.0, 2.0, 1.0, -3.0)))
    assert found.clear.distance_m < 0.0
    fewest = shrunk(brief, found)
    assert [each.kind for each in fewest.moves] == [MoveKind.ZONES]
    assert fewest.moves[0].length_ns < IN_THE_WAY.length_ns
    assert spare_m(brief, fewest) < 0.0


def test_a_search_begins_elsewhere_with_another_number_and_comes_again() -> None:
    tasks = [
        Climb(replaced(FOUR, duration=6.0), (MoveKind.DELAYS,), number, 2) for number in (1, 2)
    ]
    one, other = map(climb, tasks)
    assert one.best.moves != other.best.moves
    assert climb(tasks[0]) == one


def test_what_is_no_list_of_moves_is_refused() -> None:
    for line in ("[", '[{"kind":"rain"}]', dumps((replace(DIES, start_ns=-1),))):
        with pytest.raises(ConfigError, match="expected a schedule"):
            loads(line, Moves)


SHORT = ("swap", "--reference.shape", "swap(4)", "--duration", "12")


@pytest.mark.usefixtures("here")
def test_the_command_prints_what_flies_it_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    heedless(monkeypatch)
    monkeypatch.setattr(commands, "shrunk", lambda _, found: found)
    with pytest.raises(CommandError, match="a required distance was violated"):
        commands.main([*SHORT, "--with", "zones", "--runs", "2"])
    printed = capsys.readouterr().out
    (again,) = (line for line in printed.splitlines() if line.startswith("    python "))
    (least_m,) = re.findall(r"fewest moves, (.*) m:", printed)
    python, module, name, *argv = shlex.split(again)
    assert (python, module, name) == ("python", "-m", "fuzz.adversary")
    with pytest.raises(CommandError, match="a required distance was violated"):
        commands.main(argv)
    printed = capsys.readouterr().out
    assert "zones" in printed
    assert least_m in printed


@pytest.mark.usefixtures("here")
def test_the_command_ends_well_where_all_distances_are_kept(
    capsys: pytest.CaptureFixture[str],
) -> None:
    commands.main([*SHORT, "--with", "losses,copies", "--runs", "2", "--random"])
    assert "2, with losses,copies" in capsys.readouterr().out


@pytest.mark.usefixtures("here")
def test_a_search_that_is_interrupted_shows_what_was_flown_and_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(commands, "CLIMB", 1)
    monkeypatch.setattr(pool, "UNDER_WAY_MAX", 1)
    climbed = list[int]()

    def interrupt(task: Climb) -> Climbed:
        climbed.append(task.number)
        if climbed == [0]:
            signal.raise_signal(signal.SIGINT)
        return climb(task)

    monkeypatch.setattr(commands, "climb", interrupt)
    search = (*SHORT, "--with", "losses", "--runs", "2", "--out", str(tmp_path / "climbs"))
    with pytest.raises(CommandError, match="interrupted with 1 of 2 flights done") as early:
        commands.main(search)
    assert early.value.code == command.INTERRUPTED
    assert "1, with losses" in capsys.readouterr().out
    commands.main(search)
    assert climbed == [0, 1]
    assert "2, with losses" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("demo",), "demo: expected a mission, such as swap"),
        (
            ("swap", "--with", "rain"),
            "--with: got rain, expected covered, or some of delays,losses",
        ),
        (("swap", "--runs", "0"), "--runs: got 0, expected 1 to"),
    ],
)
def test_what_cannot_be_searched_is_refused(options: tuple[str, ...], said: str) -> None:
    with pytest.raises(CommandError, match=said) as refused:
        commands.main(options)
    assert refused.value.code == command.CONFIGURATION


@pytest.mark.long
@pytest.mark.parametrize("name", ["sphere", "rings", "corridor", "warehouse"])
def test_each_mission_can_be_searched(name: str) -> None:
    found = climb(Climb(replaced(reading.load(name), duration=30.0), tuple(MoveKind), 1, 2))
    assert math.isfinite(found.best.apart.distance_m)
    assert len(found.spares_m) == 2


def test_a_show_that_ends_where_it_began_is_flown_to_its_end(tmp_path: Path) -> None:
    file = tmp_path / "loop.csv"
    file.write_text("vehicle,t,x,y\n1,0,0,0\n1,8,0,0\n1,14,3,0\n1,20,0,0\n2,0,0,4\n")
    base = reading.to_table(scenario("swap"))
    base["reference"] |= {"shape": "show", "file": str(file)}
    raid = Raid(reading.check(base, "loop"), ())
    assert raid.run().apart.distance_m is not None
    assert max(packet.time_ns for packet in raid.packets) > 19 * SECOND_NS
