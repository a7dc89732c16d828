"""Flights of a mission in virtual time in which the processes of vehicles die and start again.

The vehicle itself flies on meanwhile, as with an autopilot: at the velocity that it was told last,
and after HOLDS_NS without a new one to rest, where it stays until it is flown again. All lives of
all vehicles are put side by side by the time of the world.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from skytether.client.endpoint import Client
from skytether.client.memory import recall
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.sensor import Sensor
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.client.simulated.weather import Weather
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.core.change import Running, with_values
from skytether.shared.core.endpoint import Address
from skytether.shared.core.events import Event
from skytether.shared.law.model import Array
from skytether.shared.scenario.schema import Scenario
from skytether.shared.scenario.zones import Zones
from skytether.shared.telemetry.record import Recorder, client_columns, parse
from skytether.sim.world import Clock, World

SERVER: Address = ("server", 0)
NETEM: Address = ("netem", 0)
CLOCK_NS = 10**6 * SECOND_NS
"""Time on all clocks at the start [ns]."""
HOLDS_NS = SECOND_NS
"""Time without a command after which an autopilot lets its vehicle rest [ns]."""
LOOK_NS = 10 * MILLISECOND_NS
"""Time between two looks at how near vehicles are [ns]."""


class Restart(NamedTuple):
    """A process of a vehicle that dies and starts again."""

    vehicle: int
    at_s: float
    """Time of the world at which it dies [s]."""
    down_s: float = 0.2
    """Time until the next life begins [s]."""
    remembers: bool = True
    """Whether that finds what the life before has kept."""


class Death(NamedTuple):
    """A server that dies, and begins anew without its memory."""

    at_s: float
    """Time of the world [s]."""
    down_s: float
    """Time until the next life begins [s]."""
    remembers: bool = True
    """Whether that takes up what was set in flight before."""
    zones: str = ""
    """Zones of the scenario that it begins with, where these are others."""


class Track(NamedTuple):
    """A vehicle through all its lives."""

    time_s: Array
    """Times of the world, rising [s]; shape (n,)."""
    position: Array
    """True position then [m]; shape (n, axes)."""


class _Life(NamedTuple):
    client: Client
    sink: io.BytesIO
    """Rows that it has recorded."""
    from_s: float
    """Time of the world at which its process has started [s]."""
    place: Array
    """Place of its vehicle then [m], where that stays until it is flown; shape (axes,)."""


class Lives:
    """A mission, and the lives of the clients that fly it.

    Args:
        scenario: what is flown; a mission.
        restarts: which processes of vehicles die, and when.
        deaths: when the server dies.
        settings: what an operator sets at the server: times [s], and values by key.
    """

    def __init__(
        self,
        scenario: Scenario,
        restarts: Sequence[Restart] = (),
        deaths: Sequence[Death] = (),
        settings: Sequence[tuple[float, Mapping[str, Any]]] = (),
    ) -> None:
        self.scenario, self.events = scenario, list[tuple[float, str, Event]]()
        self.world = World(self._hear)
        goals = scenario.make_reference()
        self.count = len(goals.vehicles)  # type: ignore[attr-defined]
        self._columns = client_columns(scenario.model.axes)
        self._lives: dict[int, list[_Life]] = {}
        self._bodies: dict[int, SimulatedVehicle] = {}
        self.world.add(NETEM[0], Proxy(scenario, server=SERVER, flows=2 * self.count))
        for number in range(1, self.count + 1):
            weather = Weather(scenario, stream(scenario.seed, "wind", number))
            self._bodies[number] = self._body(number, FirstOrderPlant(scenario, weather, number))
            start_ns = int(stream(scenario.seed, "phase", number).integers(scenario.dt_ns))
            self.world.add(
                f"client {number}",
                self._client(number, remembers=False),
                clock=Clock(CLOCK_NS),
                start_ns=start_ns,
            )
        self._servers = 0
        self.server = self._server(scenario)
        self._running = Running(self.server, scenario)
        self.world.add(SERVER[0], self.server, clock=Clock(CLOCK_NS))
        for each in restarts:
            self._plan(each)
        for death in deaths:
            self._plan_death(death)
        for at_s, values in settings:
            self.world.at(seconds_to_ns(at_s), partial(self._set, values))

    def _server(self, scenario: Scenario) -> Server:
        self._servers += 1
        entropy = stream(scenario.seed, "entropy", self._servers).bytes
        return Server(scenario, boot_id=self._servers, entropy=entropy, capacity=self.count)

    def _set(self, values: Mapping[str, Any]) -> None:
        with suppress(ConfigError):  # the refusal is an event
            self.world.act(SERVER[0], partial(self._running.change, values))

    def _plan_death(self, death: Death) -> None:
        """Schedule a death of the server, and its next life."""

        def live() -> None:
            scenario, settings = self.scenario, self._running.settings
            if death.zones:
                scenario = with_values(scenario, {"mission.zones": death.zones})
            if death.remembers:
                scenario = with_values(scenario, settings)
            self.server = self._server(scenario)
            self._running = Running(self.server, scenario, settings if death.remembers else {})
            self.world.restart(SERVER[0], self.server)

        begins_ns = seconds_to_ns(death.at_s)
        self.world.at(begins_ns, lambda: self.world.stop(SERVER[0]))
        self.world.at(begins_ns + seconds_to_ns(death.down_s), live)

    def _hear(self, time_ns: int, host: str, event: Event) -> None:
        self.events.append((time_ns / SECOND_NS, host, event))

    def _body(self, number: int, plant: FirstOrderPlant) -> SimulatedVehicle:
        lives = len(self._lives.get(number, ()))
        sensor = Sensor(self.scenario, stream(self.scenario.seed, "sensor", number, lives))
        return SimulatedVehicle(self.scenario.dt_ns, plant, sensor)

    def _client(self, number: int, *, remembers: bool) -> Client:
        sink = io.BytesIO()
        lives = self._lives.setdefault(number, [])
        before = None
        if remembers and (kept := self.world.memory(f"client {number}")):
            now_ns = CLOCK_NS + self.world.now_ns
            before = recall(*kept, now_ns, self.scenario.terms())
        client = Client(
            self.scenario,
            self._bodies[number],
            server=NETEM,
            vehicle=number,
            boot_id=number * 1000 + len(lives),
            recorder=Recorder(self._columns, sink),
            keeps=True,
            before=before,
        )
        place = self._bodies[number].plant.state()[:, 0]
        lives.append(_Life(client, sink, self.world.now_ns / SECOND_NS, place))
        return client

    def _plan(self, restart: Restart) -> None:
        number, name, world = restart.vehicle, f"client {restart.vehicle}", self.world
        begins_ns = seconds_to_ns(restart.at_s)
        ends_ns = begins_ns + seconds_to_ns(restart.down_s)

        def rest() -> None:
            body = self._bodies[number]
            body.measurements(now_ns=CLOCK_NS + world.now_ns)
            body.fly(np.zeros(self.scenario.model.axes))

        def live() -> None:
            body = self._bodies[number]
            body.measurements(now_ns=CLOCK_NS + world.now_ns)
            if not restart.remembers:  # steps of its own
                assert isinstance(body.plant, FirstOrderPlant)
                self._bodies[number] = self._body(number, body.plant)
            world.restart(name, self._client(number, remembers=restart.remembers))

        world.at(begins_ns, lambda: world.stop(name))
        if seconds_to_ns(restart.down_s) > HOLDS_NS:
            world.at(begins_ns + HOLDS_NS, rest)
        world.at(ends_ns, live)

    def fly(self, until_s: float | None = None) -> None:
        limit_s = self.scenario.duration + 10.0 if until_s is None else until_s
        self.world.run(lambda: False, limit_ns=seconds_to_ns(limit_s))

    def track(self, number: int) -> Track:
        times, places = list[Array](), list[Array]()
        for life in self._lives[number]:
            rows = parse(life.sink.getvalue())
            began_s = (life.client.began_ns - CLOCK_NS) / SECOND_NS
            times += [np.array([life.from_s]), began_s + rows["step"] * self.scenario.control.dt]
            places += [life.place[None], rows["state"][:, :, 0]]
        times.append(np.array([self.world.now_ns / SECOND_NS]))
        places.append(np.concatenate(places)[-1:])
        return Track(np.concatenate(times), np.concatenate(places))

    def inside_s(self, zones: Zones, since_s: float = 0.0) -> float:
        """Time that vehicles were within zones, all together [s].

        Args:
            zones: where nobody is to be.
            since_s: time of the world from which on it counts [s].
        """
        at_s = np.arange(since_s, self.world.now_ns / SECOND_NS, LOOK_NS / SECOND_NS)
        inside = 0
        for number in self._lives:
            t, place = self.track(number)
            places = np.stack([np.interp(at_s, t, x) for x in place.T], axis=1)
            inside += int((zones.clearance(places).min(axis=1) < 0.0).sum())
        return inside * LOOK_NS / SECOND_NS

    def least_m(self) -> float:
        """Smallest distance between two vehicles at any time [m]."""
        tracks = [self.track(number) for number in self._lives]
        at_s = np.arange(0.0, self.world.now_ns / SECOND_NS, LOOK_NS / SECOND_NS)
        scale = np.ones(self.scenario.model.axes)
        scale[2:] = self.scenario.mission.height_scale
        places = [
            np.stack([np.interp(at_s, t, x) for x in place.T], axis=1) * scale
            for t, place in tracks
        ]
        return min(
            float(np.linalg.norm(one - other, axis=1).min())
            for one, other in combinations(places, 2)
        )
