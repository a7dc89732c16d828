"""Search for moves that bring two vehicles together, or a vehicle and a zone.

A hill climb with restarts: it changes the best moves so far, and keeps a change that brings two
vehicles nearer to each other, or one nearer to a zone. Some changes target single packets of the
nearest two vehicles, shortly before they are nearest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fuzz.adversary.raid import (
    ASSUMED,
    HAS_STANDBY,
    LED,
    NETWORK,
    Approach,
    Move,
    MoveKind,
    Moves,
    Near,
    Packet,
    Raid,
    spare_m,
)
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.missions.derived import zones
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario.whole import Scenario

AIMED_NS = 10 * SECOND_NS
"""Targeted changes begin within this time before the nearest approach [ns]."""
FIRST = 2
"""Number of packets per vehicle that count as the beginning of a flight: HELLO and WELCOME."""
ONE_NS = MILLISECOND_NS
"""Length of a targeted move, which hits a single packet [ns]."""
APART, CLEAR = "apart", "clear"
"""What a climb may minimise beside what the theorem assumes, see `Climb.seeks`."""
MOVES_MAX = 64
DRAWN = 10
"""Number of random attacks before a climb, which starts from the best of them."""
PATIENCE = 40
"""Number of tries without improvement after which the climb starts again from random attacks."""
CLIMB = 100
"""Largest number of tries of one climb."""

AGED = frozenset({MoveKind.DELAYS, MoveKind.COPIES})
"""Moves whose amounts are times [s]."""
OF_ALL = (MoveKind.SERVER, MoveKind.STOPS, MoveKind.STANDBY, MoveKind.FREEZES)
"""Moves that concern no single vehicle."""
OF_SOME = frozenset({*NETWORK, MoveKind.RESTORES}) - {MoveKind.LEADS}
"""Moves that may concern vehicle 0."""
OPERATOR = (MoveKind.GOALS, MoveKind.ZONES)
LENGTHS_S = {
    MoveKind.CUTS: (0.2, 40.0),
    MoveKind.SERVER: (0.2, 20.0),
    MoveKind.STANDBY: (0.2, 20.0),
    MoveKind.FREEZES: (0.2, 20.0),
    MoveKind.PARTITIONS: (0.2, 40.0),
    MoveKind.STOPS: (0.05, 20.0),
    MoveKind.CLIENT: (0.2, 3.0),
    MoveKind.RESTORES: (0.2, 0.9),
    MoveKind.ENDS: (0.2, 30.0),
    MoveKind.STALLS: (0.05, 0.3),
    MoveKind.JOINS: (0.5, 30.0),
}
"""Shortest and longest move of a kind [s]."""
LENGTH_S = (1.0, 60.0)
"""Shortest and longest move of other kinds [s]."""
AGE_S = (0.03, 60.0)
"""Smallest and largest extra delay of a single packet, or age of a single copy [s]."""
AMOUNTS = {
    MoveKind.DELAYS: ((0.0, 1.2), (0.0, 1.2)),
    MoveKind.LOSSES: ((0.1, 1.0),),
    MoveKind.COPIES: ((0.0, 1.5),),
    MoveKind.STOPS: ((0.0, 1.0), (0.0, 1.0)),
    MoveKind.RESTORES: ((0.0, 90.0), (0.0, 1.0)),
    MoveKind.LEADS: ((0.0, 9.0), (0.0, 1.0)),
    MoveKind.FREEZES: ((0.0, 1.0),),
    MoveKind.PARTITIONS: ((0.0, 1.0),),
}
"""Smallest and largest value of each amount of a kind. Places are anywhere in the mission's box."""
SLOW = ("uplink", "downlink", "")
RADIUS_M = (0.4, 1.5)
"""Smallest and largest radius of a zone [m]."""


@dataclass(frozen=True)
class Climb:
    """One task of the search: a hill climb with restarts."""

    scenario: Scenario
    kinds: tuple[MoveKind, ...]
    number: int
    """Number of the climb; seeds its random numbers."""
    tries: int
    moves: int = MOVES_MAX
    patience: int = PATIENCE
    """Tries without improvement after which the climb restarts; 0: all moves are random."""

    @property
    def seeks(self) -> str:
        """What the climb minimises, by its number: the distance between vehicles or from zones, or
        what is left to the bound of something that the theorem assumes.
        """
        has_zones = bool(zones(self.scenario)) or MoveKind.ZONES in self.kinds
        goals = (APART, *([CLEAR] if has_zones else []), *ASSUMED)
        return goals[self.number % len(goals)]


class Climbed(NamedTuple):
    best: Approach
    spares_m: list[float]
    margins: dict[str, float]
    """Largest of all flights, see `Approach.margins`."""
    strays: int
    """Sum of all flights, see `Approach.strays`."""


def climb(task: Climb) -> Climbed:
    """Search for the moves that bring two vehicles, or a vehicle and a zone, nearest together."""
    scenario, rng = task.scenario, stream(task.scenario.seed, "climb", task.number)
    draws, spares_m = MoveSampler(task, rng), list[float]()
    margins, strays = dict.fromkeys(ASSUMED, 0.0), 0
    best: Approach | None = None
    current: Approach | None = None
    drawn, since, packets = 0, 0, list[Packet]()

    def value(tried: Approach) -> float:
        if task.seeks in ASSUMED:
            return 1.0 - tried.margins[task.seeks]
        return (tried.clear if task.seeks == CLEAR else tried.apart).away_m

    for _ in range(task.tries):
        if since >= task.patience:
            current, drawn, since = None, 0, 0
        if current is None or drawn < DRAWN:
            moves, drawn = draws.some(), drawn + 1
        else:
            near, since = current.clear if task.seeks == CLEAR else current.apart, since + 1
            moves = draws.changed(current.moves, near, packets)
        raid = Raid(scenario, moves)
        tried = raid.run()
        if current is None or value(tried) < value(current):
            current, packets, since = tried, list(raid.packets), 0
        if best is None or spare_m(scenario, tried) < spare_m(scenario, best):
            best = tried
        spares_m.append(spare_m(scenario, tried))
        margins = {each: max(near, tried.margins[each]) for each, near in margins.items()}
        strays += tried.strays
    assert best is not None
    return Climbed(best, spares_m, margins, strays)


class MoveSampler:
    def __init__(self, task: Climb, rng: np.random.Generator) -> None:
        reference = task.scenario.make_reference()
        assert isinstance(reference, Mission)
        self._rng, self._most = rng, task.moves
        self._kinds, self._vehicles = task.kinds, reference.vehicles
        self._low, self._high = reference.places.min(axis=0), reference.places.max(axis=0)
        self._last_ns = seconds_to_ns(task.scenario.duration)

    def some(self) -> Moves:
        rng, moves = self._rng, list[Move]()
        kinds = [kind for kind in self._kinds if kind is not MoveKind.DELAYS]
        if MoveKind.DELAYS in self._kinds:
            # Most vehicles have a long delay in one direction only, which round trips do not show.
            high_s = float(rng.uniform(*AMOUNTS[MoveKind.DELAYS][0]))
            ways = rng.choice(4, len(self._vehicles), p=(0.4, 0.4, 0.1, 0.1))
            moves += [
                Move(MoveKind.DELAYS, vehicle, SLOW[way], 0, self._last_ns, (high_s, high_s))
                for vehicle, way in zip(self._vehicles, ways.tolist(), strict=True)
                if way < len(SLOW)
            ]
        if MoveKind.PARTITIONS in self._kinds and rng.random() < 0.5:
            moves += self._split()
        if MoveKind.STOPS in self._kinds and rng.random() < 0.5:
            moves += self._stop()
        if kinds:
            moves += [self._one(kinds) for _ in range(1 + rng.poisson(2.0))]
        if LED & {*kinds} and rng.random() < 0.5:
            moves.append(HAS_STANDBY)
        return tuple(moves[-self._most :])

    def _split(self) -> Moves:
        """For some time some vehicles hear the one server only, and the others the other."""
        rng, kind = self._rng, MoveKind.PARTITIONS
        move = self._one([kind])
        lost = rng.choice((0.0, 1.0), len(self._vehicles)).tolist()
        return tuple(
            replace(move, vehicle=number, way="", amounts=(each,))
            for number, each in zip(self._vehicles, lost, strict=True)
        )

    def _stop(self) -> Moves:
        """The server closes its sessions, and some of its vehicles hear so, each at its time."""
        rng, stop = self._rng, self._one([MoveKind.STOPS])
        stop = replace(stop, amounts=(0.0, *stop.amounts[1:]))
        moves = [stop]
        for number in self._vehicles:
            cut = Move(MoveKind.CUTS, number, "uplink", stop.start_ns, ONE_NS)
            match rng.integers(3):
                case 1:
                    moves.append(cut)
                case 2:
                    late_s = self._age_s()
                    moves.append(replace(cut, kind=MoveKind.DELAYS, amounts=(late_s, late_s)))
        return tuple(moves)

    def _age_s(self) -> float:
        low_s, high_s = AGE_S
        return float(low_s * (high_s / low_s) ** self._rng.random())

    def _one(self, kinds: Sequence[MoveKind]) -> Move:
        rng, kind = self._rng, kinds[int(self._rng.integers(len(kinds)))]
        low_s, high_s = LENGTHS_S.get(kind, LENGTH_S)
        length_ns = seconds_to_ns(low_s * (high_s / low_s) ** rng.random())
        start_ns = int(rng.integers(self._last_ns))
        vehicle, way = int(rng.choice(self._vehicles)), ""
        if kind in OF_ALL or (kind in OF_SOME and rng.random() < 0.2):
            vehicle = 0
        if kind in NETWORK:
            way = ("uplink", "downlink", "")[rng.integers(3)]
        return Move(kind, vehicle, way, start_ns, length_ns, self._amounts(kind))

    def _amounts(self, kind: MoveKind) -> tuple[float, ...]:
        rng = self._rng
        if kind in OPERATOR:
            place = rng.uniform(self._low, self._high)
            if kind is MoveKind.ZONES:
                place = np.append(place[:2], rng.uniform(*RADIUS_M))
            return tuple(round(each, 3) for each in place.tolist())
        return tuple(float(rng.uniform(*each)) for each in AMOUNTS.get(kind, ()))

    def changed(self, moves: Moves, near: Near, packets: Sequence[Packet]) -> Moves:
        """Moves with one or more random changes.

        Args:
            moves: moves of the best flight so far.
            near: the nearest approach in this flight.
            packets: the packets of this flight.
        """
        rng, now = self._rng, list(moves)
        for _ in range(1 + rng.poisson(0.5)):
            i = int(rng.integers(len(now))) if now else -1
            match rng.choice(5, p=(0.4, 0.2, 0.1, 0.1, 0.2)):
                case 0 if now:
                    now[i] = self._tuned(now[i])
                case 2 if len(now) > 1:
                    del now[i]
                case 3 if now and now[i].vehicle:
                    now[i] = replace(now[i], vehicle=int(rng.choice(self._vehicles)))
                case 4:
                    now.extend(self._aimed(near, packets))
                case _:
                    now.append(self._one(self._kinds))
        # Keep the newest moves: otherwise an added move could be cut off at once.
        return tuple(now[-self._most :])

    def _tuned(self, move: Move) -> Move:
        rng = self._rng
        low_s, high_s = LENGTHS_S.get(move.kind, LENGTH_S)
        match rng.integers(3):
            case 0:
                start_ns = move.start_ns + seconds_to_ns(float(rng.normal(0.0, 1.0)))
                return replace(move, start_ns=min(max(start_ns, 0), self._last_ns))
            case 1 if low_s < high_s:
                length_s = move.length_ns / SECOND_NS * float(np.exp(rng.normal(0.0, 0.5)))
                length_ns = seconds_to_ns(min(max(length_s, low_s), high_s))
                return replace(move, length_ns=length_ns)
            case _:
                other = self._amounts(move.kind)
                share = rng.random() ** 2
                pairs = zip(move.amounts, other, strict=True)
                return replace(move, amounts=tuple(a + share * (b - a) for a, b in pairs))

    def _aimed(self, near: Near, packets: Sequence[Packet]) -> Moves:
        """Random move shortly before the nearest approach, against one of the nearest vehicles."""
        rng, at_ns = self._rng, seconds_to_ns(near.at_s)
        move, candidates = self._one(self._kinds), near.vehicles or self._vehicles
        start_ns = max(at_ns - int(rng.integers(AIMED_NS)), 0)
        vehicle = int(rng.choice(candidates)) if move.vehicle else 0
        mine = [
            each
            for each in packets
            if each.vehicle in candidates and at_ns - AIMED_NS <= each.time_ns <= at_ns
        ]
        if move.kind in NETWORK and mine and rng.random() < 0.7:
            if move.kind is MoveKind.COPIES and rng.random() < 0.5:
                return self._greeting(start_ns, candidates, packets)
            among = packets if move.kind is MoveKind.COPIES else mine
            time_ns, way, vehicle = among[int(rng.integers(len(among)))]
            if move.kind in AGED:
                move = replace(move, amounts=tuple(self._age_s() for _ in move.amounts))
            return (replace(move, vehicle=vehicle, way=way, start_ns=time_ns, length_ns=ONE_NS),)
        return (replace(move, vehicle=vehicle, start_ns=start_ns),)

    def _greeting(
        self, arrives_ns: int, vehicles: Sequence[int], packets: Sequence[Packet]
    ) -> Moves:
        """A vehicle's HELLO or WELCOME comes again; if servers may die, as one has restarted."""
        first = [
            each for each in packets[: FIRST * len(self._vehicles)] if each.vehicle in vehicles
        ]
        time_ns, way, vehicle = first[int(self._rng.integers(len(first)))]
        age_s = max(arrives_ns - time_ns, 0) / SECOND_NS
        copy = Move(MoveKind.COPIES, vehicle, way, time_ns, ONE_NS, (age_s,))
        if MoveKind.SERVER not in self._kinds:
            return (copy,)
        dies = self._one([MoveKind.SERVER])
        dies = replace(dies, length_ns=min(dies.length_ns, arrives_ns + 1))
        return replace(dies, start_ns=arrives_ns + 1 - dies.length_ns), copy
