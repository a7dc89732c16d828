"""Adversary: a search for events in a mission that bring two vehicles together, in virtual time.

A flight is determined by its scenario and the adversary's moves: delays, losses, cuts and copies of
packets, forged claims of leadership, restarts of servers and of clients, and goals and zones set in
flight. The search is a hill climb with restarts: it changes the best moves so far, and keeps a
change that brings two vehicles nearer to each other, or one nearer to a zone. Some changes target
single packets of the nearest two vehicles, shortly before they are nearest. A flight with the same
moves gives the same distances, bit for bit.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from itertools import combinations
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from skytether.lab.engine import HeldPackets, shrink
from skytether.lab.lives import CLOCK, STANDBY_FLOWS, Lives, Saved, world_s
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import STANDBY_SOCKETS, Datagram
from skytether.shared.law.terms import Terms
from skytether.shared.missions import mission
from skytether.shared.missions.derived import zones
from skytether.shared.missions.mission import Mission
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import Track, nearest
from skytether.shared.wire.lead import Lead
from skytether.shared.wire.protocol import Observation, decode, encode
from skytether.sim.flight import SERVER, STANDBY

BASE_NS = 50 * MILLISECOND_NS
"""Delay of every packet before any move [ns]."""
ARRIVED_M, RESTS_MPS = 0.3, 0.1
"""Distance from its goal, and speed, below which a vehicle has arrived [m, m/s]."""
AIMED_NS = 10 * SECOND_NS
"""Targeted changes begin within this time before the nearest approach [ns]."""
FIRST = 2
"""Number of packets per vehicle that count as the beginning of a flight: HELLO and WELCOME."""
ONE_NS = MILLISECOND_NS
"""Length of a targeted move, which hits a single packet [ns]."""
APART, CLEAR, ASSUMED = "apart", "clear", ("tube", "join")
"""What a climb may minimise, see `Climb.seeks`."""
MOVES_MAX = 64
DRAWN = 10
"""Number of random attacks before a climb, which starts from the best of them."""
PATIENCE = 40
"""Number of tries without improvement after which the climb starts again from random attacks."""
CLIMB = 100
"""Largest number of tries of one climb."""


class MoveKind(StrEnum):
    DELAYS = "delays"
    """Extra delay of packets, changing linearly from the first amount to the second [s]."""
    LOSSES = "losses"
    CUTS = "cuts"
    """Loss of all packets."""
    COPIES = "copies"
    """A copy of each packet arrives later by the amount [s]."""
    SERVER = "server"
    """The server is down, and restarts with only the keys that the operator has set."""
    STANDBY = "standby"
    """There is a standby server, which is down and restarts."""
    FREEZES = "freezes"
    """There is a standby server; it is frozen, or the first one if the amount is below 0.5, and
    then goes on with the packets that it has missed."""
    PARTITIONS = "partitions"
    """There is a standby server; all packets between the vehicle and it are lost, or the first one
    if the amount is below 0.5."""
    STOPS = "stops"
    """A server ends in order, and restarts: at once, sending CLOSE, if the first amount is below
    0.5, otherwise once its vehicles rest. It is the first server unless the second amount is above
    0.5."""
    CLIENT = "client"
    """The client of a vehicle is down, and restarts with its saved state; with
    `vehicle.memory = "none"` it has none."""
    RESTORES = "restores"
    """The client of a vehicle is down, and restarts with the state that it had saved the first
    amount before [s]; of vehicle 0 a server with the keys of then, the first one unless the second
    amount is above 0.5."""
    ENDS = "ends"
    """The client of a vehicle ends once the vehicle rests, and restarts with its saved state."""
    STALLS = "stalls"
    """The client's process stands still, and then goes on with the packets that it has missed."""
    JOINS = "joins"
    """The client of a vehicle is only started at the end of the move, whenever that begins."""
    LEADS = "leads"
    """With each packet goes a forged claim of leadership: the first amount is its number, the
    second, rounded, whether the server leads. Over the downlink it is the vehicle that lies, so
    its own distances do not count."""
    GOALS = "goals"
    """The vehicle's goal is moved to the place in the amounts [m], and back at the end."""
    ZONES = "zones"
    """Additional zone, a cylinder with x, y and radius in the amounts [m]."""


NETWORK = (
    *(MoveKind.DELAYS, MoveKind.LOSSES, MoveKind.CUTS, MoveKind.COPIES),
    *(MoveKind.PARTITIONS, MoveKind.LEADS),
)
AGED = frozenset({MoveKind.DELAYS, MoveKind.COPIES})
"""Moves whose amounts are times [s]."""
MORTAL = frozenset({MoveKind.CLIENT, MoveKind.RESTORES, MoveKind.ENDS})
"""Moves after which a client finds its saved state."""
LED = frozenset({MoveKind.STANDBY, MoveKind.FREEZES, MoveKind.PARTITIONS})
"""Moves for which there is a standby server."""
OF_ALL = (MoveKind.SERVER, MoveKind.STOPS, MoveKind.STANDBY, MoveKind.FREEZES)
"""Moves that concern no single vehicle."""
OF_SOME = frozenset({*NETWORK, MoveKind.RESTORES}) - {MoveKind.LEADS}
"""Moves that may concern vehicle 0."""
COVERED = tuple(each for each in MoveKind if each not in (MoveKind.CLIENT, MoveKind.RESTORES))
"""Moves against which distances must hold, see docs/together.md."""
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
class Move:
    kind: MoveKind
    vehicle: Annotated[int, msgspec.Meta(ge=0)]
    """Number of the vehicle from 1; 0 for all vehicles."""
    way: str
    """`uplink` or `downlink`; empty for both directions, and for moves that concern no packets."""
    start_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Time in the virtual world [ns]."""
    length_ns: Annotated[int, msgspec.Meta(ge=1)]
    amounts: tuple[float, ...] = ()
    """Amounts; `MoveKind` gives their meaning and units."""

    @property
    def end_ns(self) -> int:
        return self.start_ns + self.length_ns

    def is_on(self, now_ns: int) -> bool:
        return self.start_ns <= now_ns < self.end_ns


Moves = tuple[Move, ...]
HAS_STANDBY = Move(MoveKind.PARTITIONS, 0, "", 0, 1, (1.0,))
"""No packet is lost, but there is a standby server."""


class Packet(NamedTuple):
    time_ns: int
    way: str
    vehicle: int


class Near(msgspec.Struct, frozen=True):
    """Smallest distance in a flight, and when and where it occurred."""

    distance_m: float | None = None
    """Distance [m]; None if there was nothing to measure."""
    at_s: float = 0.0
    """Time in the virtual world [s]."""
    vehicles: tuple[int, ...] = ()

    @property
    def away_m(self) -> float:
        """Distance [m]; infinite if there was nothing to measure."""
        return math.inf if self.distance_m is None else self.distance_m


NOWHERE = Near()


class Approach(msgspec.Struct, frozen=True, kw_only=True):
    moves: Moves
    apart: Near
    """Smallest distance between two vehicles."""
    clear: Near
    """Smallest distance of a vehicle from a zone; negative inside."""
    left: int
    """Number of observations outside a tube."""
    strays: int = 0
    """Number of motions left before their end, or accepted too late."""
    margins: dict[str, float] = {}
    """How near vehicles came to what the theorem assumes, see `Scheme.fleet_figures`."""


class AdversaryNetwork(HeldPackets):
    def __init__(self, moves: Moves, seed: int, terms: Terms | None = None) -> None:
        super().__init__()
        self._moves = [move for move in moves if move.kind in NETWORK]
        self._terms = terms
        """Terms of the flight, needed for `MoveKind.LEADS`."""
        self._seed, self._chance = seed, dict[tuple[str, int], np.random.Generator]()
        self.packets: list[Packet] = []

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Delay, lose or copy a packet. Towards the server, vehicle n uses socket n; socket 0 is
        the server's. For the standby server it is STANDBY_FLOWS more.
        """
        payload, (host, _), socket = datagram
        standby, flow = divmod(socket, STANDBY_FLOWS)
        way, vehicle = ("uplink", flow) if flow else ("downlink", int(host.split()[1]))
        server = STANDBY if standby else SERVER
        to = (f"client {vehicle}", STANDBY_SOCKETS[0] if standby else 0) if flow else server
        onward = Datagram(payload, to, vehicle - flow + standby * STANDBY_FLOWS)
        self.packets.append(Packet(now_ns, way, vehicle))
        # Drawn for every packet: a packet's number does not depend on the other moves.
        drawn = self._draw(way, vehicle)
        late_s, copies_s, more = 0.0, list[float](), list[Datagram]()
        for move in self._moves:
            if move.vehicle not in (0, vehicle) or move.way not in ("", way):
                continue
            if not move.is_on(now_ns):
                continue
            match move.kind:
                case MoveKind.DELAYS:
                    at = (now_ns - move.start_ns) / move.length_ns
                    late_s += move.amounts[0] + at * (move.amounts[1] - move.amounts[0])
                case MoveKind.COPIES:
                    copies_s.append(move.amounts[0])
                case MoveKind.CUTS:
                    return
                case MoveKind.PARTITIONS if round(move.amounts[0]) == standby:
                    return
                case MoveKind.LOSSES if drawn < move.amounts[0]:
                    return
                case MoveKind.LEADS if lead := self._forged(payload, *move.amounts):
                    more.append(onward._replace(payload=lead))
        due_ns = now_ns + BASE_NS + seconds_to_ns(late_s)
        for each in (onward, *more):
            self.hold(due_ns, each)
        for each_s in copies_s:
            self.hold(due_ns + seconds_to_ns(each_s), onward)

    def _forged(self, payload: bytes, number: float, leads: float) -> bytes | None:
        """Claim of leadership in the session of a packet; None if the packet has none."""
        assert self._terms is not None
        packet = decode(payload, self._terms)
        if (session := getattr(packet, "session", None)) is None:
            return None
        step = packet.step if isinstance(packet, Observation) else 0
        claimed = int(number)
        return encode(Lead(packet.vehicle, session, claimed, round(leads), claimed, step))

    def _draw(self, way: str, vehicle: int) -> float:
        if (way, vehicle) not in self._chance:
            self._chance[way, vehicle] = stream(self._seed, "adversary", way, vehicle)
        return float(self._chance[way, vehicle].random())


class Raid:
    """Flight of a mission with the adversary's moves; the scenario's network is not used."""

    def __init__(self, scenario: Scenario, moves: Moves) -> None:
        self._scenario, self._moves = scenario, moves
        self._air = AdversaryNetwork(moves, scenario.seed, scenario.terms())
        mortal = {move.vehicle for move in moves if move.kind in MORTAL}
        self._has_standby = any(move.kind in LED for move in moves)
        self._lives = Lives(
            scenario,
            self._air,
            None if 0 in mortal else mortal,
            has_standby=self._has_standby,
        )
        self._world, self._vehicles = self._lives.world, self._lives.mission.vehicles
        self._zones: list[tuple[float, Zones]] = [(0.0, zones(scenario))]
        """Zones set by the operator, and the time of each change on the hosts' clocks [s]."""
        for move in moves:
            if move.kind not in NETWORK:
                self._plan(move)

    def _plan(self, move: Move) -> None:
        lives = self._lives
        hit = [number for number in self._vehicles if move.vehicle in (0, number)]
        begin: list[Callable[[], None]] = [self._set]
        end: list[Callable[[], None]] = [self._set]
        match move.kind:
            case MoveKind.SERVER | MoveKind.STANDBY:
                name, _ = SERVER if move.kind is MoveKind.SERVER else STANDBY
                begin = [partial(lives.stop_server, name)]
                end = [partial(lives.start_server, {}, name=name), self._note_zones]
            case MoveKind.FREEZES:
                name = self._server(move.amounts)
                begin, end = [partial(self._world.freeze, name)], [partial(self._world.thaw, name)]
            case MoveKind.STOPS:
                name = self._server(move.amounts[1:])
                stop = lives.end_server if round(move.amounts[0]) else lives.close_server
                begin = [partial(stop, name)]
                end = [partial(lives.start_server, {}, name=name), self._note_zones]
            case MoveKind.RESTORES if move.vehicle == 0:
                name, settings = self._server(move.amounts[1:]), dict[str, Any]()
                self._before(move, lambda: settings.update(lives.settings(name)))
                begin = [partial(lives.stop_server, name)]
                start = partial(lives.start_server, {}, settings=settings, name=name)
                end = [start, self._note_zones]
            case MoveKind.RESTORES:
                saved = list[Saved]()
                self._before(move, lambda: saved.extend(lives.saved(move.vehicle)))
                begin = [partial(lives.stop_client, move.vehicle)]
                end = [partial(lives.start_client, move.vehicle, saved=saved)]
            case MoveKind.ENDS:
                begin = [partial(lives.end_client, number) for number in hit]
                end = [partial(lives.start_client, number) for number in hit]
            case MoveKind.STALLS:
                begin = [partial(self._world.freeze, f"client {number}") for number in hit]
                end = [partial(self._world.thaw, f"client {number}") for number in hit]
            case MoveKind.JOINS:
                for number in hit:
                    lives.stop_client(number)
                begin = []
                end = [partial(lives.join_client, number) for number in hit]
            case MoveKind.CLIENT:
                begin = [partial(lives.stop_client, number) for number in hit]
                end = [partial(lives.start_client, number) for number in hit]
        for time_ns, actions in ((move.start_ns, begin), (move.end_ns, end)):
            for action in actions:
                self._world.at(time_ns, action)

    def _server(self, amounts: Sequence[float]) -> str:
        """Name of the server that an amount chooses: the standby, if there is one, above 0.5."""
        is_standby = self._has_standby and any(each > 0.5 for each in amounts[:1])
        return (STANDBY if is_standby else SERVER)[0]

    def _before(self, move: Move, action: Callable[[], None]) -> None:
        """Act the first amount before a move, at the earliest at the beginning."""
        at_ns = move.start_ns - seconds_to_ns(move.amounts[0])
        self._world.at(max(at_ns, self._world.now_ns), action)

    def _set(self) -> None:
        """Set goals and zones of the active moves; the server may refuse them."""
        lives, now_ns, own = self._lives, self._world.now_ns, self._scenario.mission
        if lives.running is None:
            return
        now = [move for move in self._moves if move.is_on(now_ns)]
        goals = {
            move.vehicle: np.array(move.amounts) for move in now if move.kind is MoveKind.GOALS
        }
        more = [
            f"cylinder({', '.join(map(str, move.amounts))})"
            for move in now
            if move.kind is MoveKind.ZONES
        ]
        texts = {
            "mission.goals": " & ".join(filter(None, [own.goals, mission.format_goals(goals)])),
            "mission.zones": " & ".join(filter(None, [own.zones, *more])),
        }
        for key, text in texts.items():
            lives.set({key: text})
        self._note_zones()

    def _note_zones(self) -> None:
        """Note the zones in force: one that a server has refused need not hold once it leads."""
        if up := self._lives.scenarios:
            agree = len({each.mission.zones for each in up}) == 1
            since_s = CLOCK.local(self._world.now_ns) / SECOND_NS
            self._zones.append((since_s, zones(up[0] if agree else self._scenario)))

    # -- flight ------------------------------------------------------------------------------------

    def run(self) -> Approach:
        """Fly to the end, or until all vehicles have arrived and no other moves are left."""
        scenario, later = self._scenario, [m for m in self._moves if m.kind not in NETWORK]
        look_ns = max((move.end_ns for move in later), default=0)

        def over() -> bool:
            nonlocal look_ns
            if self._world.now_ns <= look_ns:
                return False
            look_ns = self._world.now_ns + SECOND_NS
            return self._has_arrived()

        begins_ns = max((m.end_ns for m in later if m.kind is MoveKind.JOINS), default=0)
        limit_ns = begins_ns + seconds_to_ns(scenario.duration + scenario.link.connect_s)
        self._world.run(over, limit_ns=limit_ns)
        tracks = self._lives.tracks()
        counts, margins = Counter[str](), dict.fromkeys(ASSUMED, 0.0)
        for server in self._lives.servers:
            told = server.figures()
            counts.update(told["counts"])
            margins = {each: max(near, told["margins"][each]) for each, near in margins.items()}
        return Approach(
            moves=self._moves,
            apart=self._apart(tracks),
            clear=self._clear(tracks),
            left=counts["left_tube"],
            strays=counts["left_motion"] + counts["joined_late"],
            margins=margins,
        )

    @property
    def packets(self) -> Sequence[Packet]:
        return self._air.packets

    def _has_arrived(self) -> bool:
        if self._world.now_ns < seconds_to_ns(self._lives.mission.lasts_s):
            return False
        for number, body in self._lives.bodies.items():
            goal = self._lives.mission.of(number)(np.array(self._scenario.duration))[:, 0]
            p, v = body.plant.state().T
            if math.dist(p, goal) > ARRIVED_M or math.hypot(*v) > RESTS_MPS:
                return False
        return True

    def _apart(self, tracks: Mapping[int, Track]) -> Near:
        liars = {m.vehicle for m in self._moves if m.kind is MoveKind.LEADS and m.way != "uplink"}
        flown = {
            number: each for number, each in tracks.items() if len(each[0]) and number not in liars
        }
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
        """Smallest distance of a vehicle from a zone, over the times at which the zone was in
        force.
        """
        scale, found = self._scenario.mission.height_scale, NOWHERE
        ends = [since for since, _ in self._zones[1:]] + [math.inf]
        for (since, around), end in zip(self._zones, ends, strict=True):
            for number, (times, at) in tracks.items():
                in_force = np.flatnonzero((times >= since) & (times < end))
                if around and len(in_force):
                    points = at[in_force] / np.array([1.0, 1.0, scale])[: at.shape[1]]
                    clear_m = around.clearance(points).min(axis=1)
                    i = int(clear_m.argmin())
                    if clear_m[i] < found.away_m:
                        found = Near(float(clear_m[i]), world_s(times[in_force[i]]), (number,))
        return found


# -- search --------------------------------------------------------------------------------------


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


def fly(scenario: Scenario, moves: Moves) -> Approach:
    return Raid(scenario, moves).run()


def spare_m(scenario: Scenario, found: Approach) -> float:
    """Smallest distance minus the required distance, between vehicles or from zones [m]."""
    return min(found.apart.away_m - scenario.mission.separation_m, found.clear.away_m)


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
            told = Move(MoveKind.CUTS, number, "uplink", stop.start_ns, ONE_NS)
            match rng.integers(3):
                case 1:
                    moves.append(told)
                case 2:
                    late_s = self._age_s()
                    moves.append(replace(told, kind=MoveKind.DELAYS, amounts=(late_s, late_s)))
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


def shrunk(scenario: Scenario, found: Approach) -> Approach:
    """Flight of fewer and shorter moves that still violates a required distance."""
    moves = shrink(found.moves, lambda moves: spare_m(scenario, fly(scenario, moves)) < 0.0)
    return fly(scenario, moves)
