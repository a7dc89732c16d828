"""Adversary: chooses what network, server and operator do, to bring two vehicles together.

    clients ── air ── server          on a mission, in virtual time

A flight follows from its scenario and the adversary's moves: delays, losses, cuts and copies of
packets, restarts of the server and of clients, goals and zones that are set in flight. The search
climbs: it changes the best moves so far, keeps the change where it brings two vehicles nearer to
each other, or one nearer to a zone, and begins anew where changes no longer help. Some changes aim
at single packets of the nearest two, shortly before they are nearest. Moves are data: flown again,
they give the same distance to the last bit.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from heapq import heappop, heappush
from itertools import combinations
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from skytether.lab.faults import shrink
from skytether.lab.lives import CLOCK, Lives, world_s
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.core.endpoint import Datagram, Endpoint
from skytether.shared.scenario import mission
from skytether.shared.scenario.mission import Mission
from skytether.shared.scenario.schema import Scenario
from skytether.shared.scenario.zones import Zones
from skytether.shared.telemetry.summary import Track, nearest
from skytether.sim.flight import SERVER

BASE_NS = 50 * MILLISECOND_NS
"""Delay of every packet before any move [ns]."""
ARRIVED_M, RESTS_MPS = 0.3, 0.1
"""Distance from its goal, and speed, below which a vehicle has arrived [m, m/s]."""
AIMED_NS = 10 * SECOND_NS
"""Time before two vehicles are nearest that changes aim at [ns]."""
ONE_NS = MILLISECOND_NS
"""Length of a move against a single packet [ns]."""
MOVES_MAX = 64
"""Largest number of moves by default."""
DRAWN = 10
"""Tries drawn at random, with the best of which a climb begins."""
PATIENCE = 40
"""Tries without gain after which the search begins anew."""
CLIMB = 100
"""Most tries of one climb."""


class Kind(StrEnum):
    """Kind of a move."""

    DELAYS = "delays"
    """Packets take longer: by the first amount at the begin, by the second at the end [s]."""
    LOSSES = "losses"
    """A share of the packets is lost."""
    CUTS = "cuts"
    """All packets are lost."""
    COPIES = "copies"
    """Each packet comes once more, later by the amount [s]."""
    SERVER = "server"
    """The server is down, and begins anew with nothing but what the operator has set."""
    CLIENT = "client"
    """The client of a vehicle is down, and begins anew with what it has kept; with
    `vehicle.memory = "none"` that is nothing."""
    GOALS = "goals"
    """The vehicle is sent to the place of the amounts [m], and at the end to its own goal again."""
    ZONES = "zones"
    """There is a cylinder more, of x, y and a radius [m]."""


NETWORK = (Kind.DELAYS, Kind.LOSSES, Kind.CUTS, Kind.COPIES)
OPERATOR = (Kind.GOALS, Kind.ZONES)
LENGTHS_S = {
    Kind.CUTS: (0.2, 40.0),
    Kind.SERVER: (0.2, 20.0),
    Kind.CLIENT: (0.2, 3.0),
}
"""Shortest and longest move of a kind [s]."""
LENGTH_S = (1.0, 60.0)
"""Shortest and longest move of other kinds [s]."""
AMOUNTS = {
    Kind.DELAYS: ((0.0, 1.2), (0.0, 1.2)),
    Kind.LOSSES: ((0.1, 1.0),),
    Kind.COPIES: ((0.0, 1.5),),
}
"""Least and greatest of each amount of a kind; places are anywhere on the mission."""
SLOW = ("uplink", "downlink", "")
"""Ways in which a vehicle may be slow at first."""
RADIUS_M = (0.4, 1.5)
"""Least and greatest radius of a zone [m]."""


@dataclass(frozen=True)
class Move:
    """Move of the adversary, for a while."""

    kind: Kind
    vehicle: Annotated[int, msgspec.Meta(ge=0)]
    """Number of the vehicle; 0 for all of them."""
    way: str
    """`uplink` or `downlink` of packets; empty for both ways, and for other kinds."""
    start_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Time of the world at which it begins [ns]."""
    length_ns: Annotated[int, msgspec.Meta(ge=1)]
    """Duration [ns]."""
    amounts: tuple[float, ...] = ()
    """Amounts, see `Kind`."""

    @property
    def end_ns(self) -> int:
        """Time of the world at which it ends [ns]."""
        return self.start_ns + self.length_ns

    def is_on(self, now_ns: int) -> bool:
        """Whether it is done at a time of the world."""
        return self.start_ns <= now_ns < self.end_ns


Moves = tuple[Move, ...]


class Packet(NamedTuple):
    """A packet that entered the air."""

    time_ns: int
    way: str
    vehicle: int


class Near(msgspec.Struct, frozen=True):
    """Smallest distance in a flight."""

    distance_m: float | None = None
    """None where there is none."""
    at_s: float = 0.0
    """Time of the world [s]."""
    vehicles: tuple[int, ...] = ()
    """Numbers of those that were so near."""

    @property
    def away_m(self) -> float:
        """Distance, infinite where there is none [m]."""
        return math.inf if self.distance_m is None else self.distance_m


NOWHERE = Near()


class Approach(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a flight."""

    moves: Moves
    apart: Near
    """Distance of two vehicles from each other."""
    clear: Near
    """Distance of a vehicle from a zone that the operator has set; negative inside."""
    left: int
    """Observations outside a tube, as far as the server that lives at the end knows."""


class Air(Endpoint):
    """Network that does what the adversary wants.

    Args:
        moves: what the adversary does.
        seed: seed of losses.
    """

    def __init__(self, moves: Moves, seed: int) -> None:
        super().__init__()
        self._moves = [move for move in moves if move.kind in NETWORK]
        self._seed, self._chance = seed, dict[tuple[str, int], np.random.Generator]()
        self._held: list[tuple[int, int, Datagram]] = []
        """Heap of the packets under way: time of arrival, order, and packet."""
        self.packets: list[Packet] = []
        """All packets that have entered."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Decide on a packet; vehicle n is socket n to the server."""
        payload, (host, _), socket = datagram
        way, vehicle = ("uplink", socket) if socket else ("downlink", int(host.split()[1]))
        onward = Datagram(payload, (f"client {vehicle}", 0) if socket else SERVER, vehicle - socket)
        self.packets.append(Packet(now_ns, way, vehicle))
        # Drawn for every packet, so that a packet's luck does not depend on other moves.
        drawn = self._draw(way, vehicle)
        late_s, copies_s = 0.0, []
        for move in self._moves:
            if move.vehicle not in (0, vehicle) or move.way not in ("", way):
                continue
            if not move.is_on(now_ns):
                continue
            match move.kind:
                case Kind.DELAYS:
                    at = (now_ns - move.start_ns) / move.length_ns
                    late_s += move.amounts[0] + at * (move.amounts[1] - move.amounts[0])
                case Kind.COPIES:
                    copies_s.append(move.amounts[0])
                case Kind.CUTS:
                    return
                case Kind.LOSSES if drawn < move.amounts[0]:
                    return
        for each_s in (0.0, *copies_s):
            due_ns = now_ns + BASE_NS + seconds_to_ns(late_s + each_s)
            heappush(self._held, (due_ns, len(self.packets), onward))

    def _draw(self, way: str, vehicle: int) -> float:
        """Random number of the next packet of a vehicle."""
        if (way, vehicle) not in self._chance:
            self._chance[way, vehicle] = stream(self._seed, "adversary", way, vehicle)
        return float(self._chance[way, vehicle].random())

    def wake(self, *, now_ns: int) -> None:
        """Send the packets that are due."""
        while self._held and self._held[0][0] <= now_ns:
            self._out.append(heappop(self._held)[2])

    def next_wake_ns(self) -> int | None:
        """Time at which the next packet is due."""
        return self._held[0][0] if self._held else None


class Raid:
    """Flight of a mission against the adversary.

    Args:
        scenario: what is flown; the network is the adversary's.
        moves: what the adversary does.
    """

    def __init__(self, scenario: Scenario, moves: Moves) -> None:
        self._scenario, self._moves, self._air = scenario, moves, Air(moves, scenario.seed)
        mortal = {move.vehicle for move in moves if move.kind is Kind.CLIENT}
        self._lives = Lives(scenario, self._air, None if 0 in mortal else mortal)
        self._world, self._vehicles = self._lives.world, self._lives.mission.vehicles
        self._zones: list[tuple[float, Zones]] = [(0.0, scenario.zones)]
        """Zones that the operator has set, and since when [s; the hosts' clocks]."""
        for move in moves:
            if move.kind not in NETWORK:
                self._plan(move)

    def _plan(self, move: Move) -> None:
        """Schedule a move that is not of the network."""
        lives = self._lives
        hit = [number for number in self._vehicles if move.vehicle in (0, number)]
        begin: list[Callable[[], None]] = [self._set]
        end: list[Callable[[], None]] = [self._set]
        match move.kind:
            case Kind.SERVER:
                begin, end = [lives.stop_server], [partial(lives.start_server, {})]
            case Kind.CLIENT:
                begin = [partial(lives.stop_client, number) for number in hit]
                end = [partial(lives.start_client, number) for number in hit]
        for time_ns, actions in ((move.start_ns, begin), (move.end_ns, end)):
            for action in actions:
                self._world.at(time_ns, action)

    def _set(self) -> None:
        """Set goals and zones as the moves of now say; the server may refuse them."""
        lives, now_ns, given = self._lives, self._world.now_ns, self._scenario.mission
        if lives.running is None:
            return
        now = [move for move in self._moves if move.is_on(now_ns)]
        goals = {move.vehicle: np.array(move.amounts) for move in now if move.kind is Kind.GOALS}
        more = [
            f"cylinder({', '.join(map(str, move.amounts))})"
            for move in now
            if move.kind is Kind.ZONES
        ]
        texts = {
            "mission.goals": " & ".join(filter(None, [given.goals, mission.written(goals)])),
            "mission.zones": " & ".join(filter(None, [given.zones, *more])),
        }
        for key, text in texts.items():
            lives.set({key: text})
        self._zones.append((CLOCK.local(now_ns) / SECOND_NS, lives.running.scenario.zones))

    # -- what is flown -----------------------------------------------------------------------------

    def run(self) -> Approach:
        """Fly until all have arrived and only the network may still change, or to the end."""
        scenario, later = self._scenario, [m for m in self._moves if m.kind not in NETWORK]
        look_ns = max((move.end_ns for move in later), default=0)

        def over() -> bool:
            nonlocal look_ns
            if self._world.now_ns <= look_ns:
                return False
            look_ns = self._world.now_ns + SECOND_NS
            return self._has_arrived()

        self._world.run(over, limit_ns=seconds_to_ns(scenario.duration + scenario.link.connect_s))
        tracks = self._lives.tracks()
        left = self._lives.server.figures()["counts"].get("left_tube", 0)
        apart, clear = self._apart(tracks), self._clear(tracks)
        return Approach(moves=self._moves, apart=apart, clear=clear, left=left)

    @property
    def packets(self) -> Sequence[Packet]:
        """Packets that have entered the air."""
        return self._air.packets

    def _has_arrived(self) -> bool:
        """Whether all vehicles are at rest at their last goals."""
        for number, body in self._lives.bodies.items():
            goal = self._lives.mission.of(number)(np.array(self._scenario.duration))[:, 0]
            p, v = body.plant.state().T
            if math.dist(p, goal) > ARRIVED_M or math.hypot(*v) > RESTS_MPS:
                return False
        return True

    def _apart(self, tracks: Mapping[int, Track]) -> Near:
        """Smallest distance between two vehicles."""
        flown = {number: each for number, each in tracks.items() if len(each[0])}
        times, apart_m = nearest(list(flown.values()), self._scenario.control.dt)
        if not np.isfinite(apart_m).any():
            return NOWHERE
        least = int(np.nanargmin(apart_m))
        places = {
            number: [np.interp(times[least], at_s, x, np.nan, np.nan) for x in at.T]
            for number, (at_s, at) in flown.items()
        }
        by_m = {pair: math.dist(*map(places.__getitem__, pair)) for pair in combinations(places, 2)}
        pair = min(by_m, key=lambda each: (math.isnan(by_m[each]), by_m[each]))
        return Near(float(apart_m[least]), world_s(times[least]), pair)

    def _clear(self, tracks: Mapping[int, Track]) -> Near:
        """Smallest distance of a vehicle from a zone, while there was that zone."""
        scale, found = self._scenario.mission.height_scale, NOWHERE
        ends = [since for since, _ in self._zones[1:]] + [math.inf]
        for (since, zones), end in zip(self._zones, ends, strict=True):
            for number, (times, at) in tracks.items():
                here = np.flatnonzero((times >= since) & (times < end))
                if zones and len(here):
                    points = at[here] / np.array([1.0, 1.0, scale])[: at.shape[1]]
                    clear_m = zones.clearance(points).min(axis=1)
                    i = int(clear_m.argmin())
                    if clear_m[i] < found.away_m:
                        found = Near(float(clear_m[i]), world_s(times[here[i]]), (number,))
        return found


# -- search --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Climb:
    """A climb of the search."""

    scenario: Scenario
    kinds: tuple[Kind, ...]
    """Kinds of moves that the adversary may do."""
    number: int
    """Number of the climb, from which all its chance follows."""
    tries: int
    """Number of flights."""
    moves: int = MOVES_MAX
    """Largest number of moves."""
    patience: int = PATIENCE
    """Tries without gain after which it begins anew; 0: all moves are drawn at random."""

    @property
    def seeks_zones(self) -> bool:
        """Whether it brings vehicles near to zones: every other one, where there are any."""
        may = bool(self.scenario.zones) or Kind.ZONES in self.kinds
        return may and bool(self.number % 2)


class Climbed(NamedTuple):
    """Result of a climb."""

    best: Approach
    spares_m: list[float]
    """Spare distance of each try, see `spare_m` [m]."""


def fly(scenario: Scenario, moves: Moves) -> Approach:
    """Fly a mission against the adversary."""
    return Raid(scenario, moves).run()


def spare_m(scenario: Scenario, found: Approach) -> float:
    """Distance beyond what is asked for, between vehicles or from zones [m]; negative: not kept."""
    return min(found.apart.away_m - scenario.mission.separation_m, found.clear.away_m)


def climb(task: Climb) -> Climbed:
    """Search for the moves that bring vehicles nearest."""
    scenario, rng = task.scenario, stream(task.scenario.seed, "climb", task.number)
    draws, spares_m = Draws(task, rng), list[float]()
    best: Approach | None = None
    here: Approach | None = None
    drawn, since, packets = 0, 0, list[Packet]()

    def value(found: Approach) -> float:
        return (found.clear if task.seeks_zones else found.apart).away_m

    for _ in range(task.tries):
        if since >= task.patience:
            here, drawn, since = None, 0, 0
        if here is None or drawn < DRAWN:
            moves, drawn = draws.some(), drawn + 1
        else:
            near, since = here.clear if task.seeks_zones else here.apart, since + 1
            moves = draws.changed(here.moves, near, packets)
        raid = Raid(scenario, moves)
        found = raid.run()
        if here is None or value(found) < value(here):
            here, packets, since = found, list(raid.packets), 0
        if best is None or spare_m(scenario, found) < spare_m(scenario, best):
            best = found
        spares_m.append(spare_m(scenario, found))
    assert best is not None
    return Climbed(best, spares_m)


class Draws:
    """Moves that are drawn at random.

    Args:
        task: climb that they are for.
        rng: random generator.
    """

    def __init__(self, task: Climb, rng: np.random.Generator) -> None:
        made = task.scenario.make_reference()
        assert isinstance(made, Mission)
        self._rng, self._most = rng, task.moves
        self._kinds, self._vehicles = task.kinds, made.vehicles
        self._low, self._high = made.places.min(axis=0), made.places.max(axis=0)
        self._last_ns = seconds_to_ns(task.scenario.duration)

    def some(self) -> Moves:
        """Moves to begin with."""
        rng, moves = self._rng, list[Move]()
        kinds = [kind for kind in self._kinds if kind is not Kind.DELAYS]
        if Kind.DELAYS in self._kinds:
            # Most vehicles slow in one direction alone: that is what no round trip shows.
            high_s = float(rng.uniform(*AMOUNTS[Kind.DELAYS][0]))
            ways = rng.choice(4, len(self._vehicles), p=(0.4, 0.4, 0.1, 0.1))
            moves += [
                Move(Kind.DELAYS, vehicle, SLOW[way], 0, self._last_ns, (high_s, high_s))
                for vehicle, way in zip(self._vehicles, ways.tolist(), strict=True)
                if way < len(SLOW)
            ]
        if kinds:
            moves += [self._one(kinds) for _ in range(1 + rng.poisson(2.0))]
        return tuple(moves[-self._most :])

    def _one(self, kinds: Sequence[Kind]) -> Move:
        """One move of some kinds."""
        rng, kind = self._rng, kinds[int(self._rng.integers(len(kinds)))]
        low_s, high_s = LENGTHS_S.get(kind, LENGTH_S)
        length_ns = seconds_to_ns(low_s * (high_s / low_s) ** rng.random())
        start_ns = int(rng.integers(self._last_ns))
        vehicle, way = int(rng.choice(self._vehicles)), ""
        if kind is Kind.SERVER or (kind in NETWORK and rng.random() < 0.2):
            vehicle = 0
        if kind in NETWORK:
            way = ("uplink", "downlink", "")[rng.integers(3)]
        return Move(kind, vehicle, way, start_ns, length_ns, self._amounts(kind))

    def _amounts(self, kind: Kind) -> tuple[float, ...]:
        """Amounts of a move."""
        rng = self._rng
        if kind in OPERATOR:
            place = rng.uniform(self._low, self._high)
            if kind is Kind.ZONES:
                place = np.append(place[:2], rng.uniform(*RADIUS_M))
            return tuple(round(each, 3) for each in place.tolist())
        return tuple(float(rng.uniform(*each)) for each in AMOUNTS.get(kind, ()))

    def changed(self, moves: Moves, near: Near, packets: Sequence[Packet]) -> Moves:
        """Moves with a change or two.

        Args:
            moves: moves of the best flight so far.
            near: what was nearest in it.
            packets: packets of it.
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
                    now.append(self._aimed(near, packets))
                case _:
                    now.append(self._one(self._kinds))
        # The newest stay: a change must change something.
        return tuple(now[-self._most :])

    def _tuned(self, move: Move) -> Move:
        """A move a little earlier, later, longer, shorter, stronger or weaker."""
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

    def _aimed(self, near: Near, packets: Sequence[Packet]) -> Move:
        """A move shortly before what was nearest, against one of those that were."""
        rng, at_ns = self._rng, seconds_to_ns(near.at_s)
        move, those = self._one(self._kinds), near.vehicles or self._vehicles
        start_ns = max(at_ns - int(rng.integers(AIMED_NS)), 0)
        vehicle = int(rng.choice(those)) if move.vehicle else 0
        mine = [
            each
            for each in packets
            if each.vehicle in those and at_ns - AIMED_NS <= each.time_ns <= at_ns
        ]
        if move.kind in NETWORK and mine and rng.random() < 0.7:
            time_ns, way, vehicle = mine[int(rng.integers(len(mine)))]
            return replace(move, vehicle=vehicle, way=way, start_ns=time_ns, length_ns=ONE_NS)
        return replace(move, vehicle=vehicle, start_ns=start_ns)


def shrunk(scenario: Scenario, found: Approach) -> Approach:
    """The fewest and shortest moves with which a distance is still not kept."""
    moves = shrink(found.moves, lambda moves: spare_m(scenario, fly(scenario, moves)) < 0.0)
    return fly(scenario, moves)


def dumps(moves: Moves) -> str:
    """Line of JSON for moves."""
    return msgspec.json.encode(moves).decode()


def loads(line: str) -> Moves:
    """Moves in a line of JSON.

    Raises:
        ConfigError: the line has no moves.
    """
    try:
        return msgspec.json.decode(line, type=Moves)
    except msgspec.DecodeError as error:
        raise ConfigError(f"moves: {error}") from None
