"""Flight of a mission against an adversary, in virtual time.

It is determined by its scenario and the adversary's moves: delays, losses, cuts and copies of
packets, forged claims of leadership, restarts of servers and of clients, and goals and zones set in
flight. A flight with the same moves gives the same distances, bit for bit.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import combinations
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from fuzz.adversary.lives import CLOCK, STANDBY_FLOWS, Lives, Saved, world_s
from fuzz.engine import HeldPackets, shrink
from skytether.client.several import STANDBY_SOCKETS
from skytether.shared.base.chance import stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.law.terms import Terms
from skytether.shared.missions import mission
from skytether.shared.missions.derived import zones
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.summary import Track, nearest
from skytether.shared.wire.lead import Lead, decode_led
from skytether.shared.wire.protocol import Observation, encode
from skytether.sim.flight import SERVER
from skytether.sim.standby import STANDBY

BASE_NS = 50 * MILLISECOND_NS
"""Delay of every packet before any move [ns]."""
ARRIVED_M, RESTS_MPS = 0.3, 0.1
"""Distance from its goal, and speed, below which a vehicle has arrived [m, m/s]."""
ASSUMED = ("tube", "join")
"""What the theorem assumes, by the names of `Approach.margins`."""


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
MORTAL = frozenset({MoveKind.CLIENT, MoveKind.RESTORES, MoveKind.ENDS})
"""Moves after which a client finds its saved state."""
LED = frozenset({MoveKind.STANDBY, MoveKind.FREEZES, MoveKind.PARTITIONS})
"""Moves for which there is a standby server."""
COVERED = tuple(each for each in MoveKind if each not in (MoveKind.CLIENT, MoveKind.RESTORES))
"""Moves against which distances must hold, see docs/together.md."""


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
        packet, _ = decode_led(payload, self._terms)
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
                begin = [partial(lives.servers[name].kill, self._world)]
                end = [partial(lives.start_server, {}, name=name), self._note_zones]
            case MoveKind.FREEZES:
                name = self._server(move.amounts)
                begin, end = [partial(self._world.freeze, name)], [partial(self._world.thaw, name)]
            case MoveKind.STOPS:
                name = self._server(move.amounts[1:])
                close = partial(lives.servers[name].close, self._world)
                begin = [partial(lives.end_server, name) if round(move.amounts[0]) else close]
                end = [partial(lives.start_server, {}, name=name), self._note_zones]
            case MoveKind.RESTORES if move.vehicle == 0:
                name, settings = self._server(move.amounts[1:]), dict[str, Any]()
                self._before(move, lambda: settings.update(lives.settings(name)))
                begin = [partial(lives.servers[name].kill, self._world)]
                start = partial(lives.start_server, {}, settings=settings, name=name)
                end = [start, self._note_zones]
            case MoveKind.RESTORES:
                saved = list[Saved]()
                self._before(move, lambda: saved.extend(lives.saved(move.vehicle)))
                begin = [partial(lives.clients[move.vehicle].kill, self._world)]
                end = [partial(lives.start_client, move.vehicle, saved=saved)]
            case MoveKind.ENDS:
                begin = [partial(lives.end_client, number) for number in hit]
                end = [partial(lives.start_client, number) for number in hit]
            case MoveKind.STALLS:
                begin = [partial(self._world.freeze, f"client {number}") for number in hit]
                end = [partial(self._world.thaw, f"client {number}") for number in hit]
            case MoveKind.JOINS:
                for number in hit:
                    lives.clients[number].kill(self._world)
                begin = []
                end = [partial(lives.join_client, number) for number in hit]
            case MoveKind.CLIENT:
                begin = [partial(lives.clients[number].kill, self._world) for number in hit]
                end = [partial(lives.start_client, number) for number in hit]
        for time_ns, actions in ((move.start_ns, begin), (move.end_ns, end)):
            for action in actions:
                self._world.at(time_ns, action)

    def _server(self, amounts: Sequence[float]) -> str:
        """Name of the server that a move acts on: the standby, if there is one and the move's first
        amount is above 0.5; else the first server.
        """
        is_standby = self._has_standby and any(each > 0.5 for each in amounts[:1])
        return (STANDBY if is_standby else SERVER)[0]

    def _before(self, move: Move, action: Callable[[], None]) -> None:
        """Act the first amount before a move, at the earliest at the beginning."""
        at_ns = move.start_ns - seconds_to_ns(move.amounts[0])
        self._world.at(max(at_ns, self._world.now_ns), action)

    def _set(self) -> None:
        """Set goals and zones of the active moves; the server may refuse them."""
        lives, now_ns, own = self._lives, self._world.now_ns, self._scenario.mission
        if not lives.running:
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
        for server in self._lives.server_runs:
            figures = server.figures()
            counts.update(figures["counts"])
            margins = {each: max(near, figures["margins"][each]) for each, near in margins.items()}
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


def fly(scenario: Scenario, moves: Moves) -> Approach:
    return Raid(scenario, moves).run()


def spare_m(scenario: Scenario, found: Approach) -> float:
    """Smallest distance minus the required distance, between vehicles or from zones [m]."""
    return min(found.apart.away_m - scenario.mission.separation_m, found.clear.away_m)


def shrunk(scenario: Scenario, found: Approach) -> Approach:
    """Flight of fewer and shorter moves that still violates a required distance."""
    moves = shrink(found.moves, lambda moves: spare_m(scenario, fly(scenario, moves)) < 0.0)
    return fly(scenario, moves)
