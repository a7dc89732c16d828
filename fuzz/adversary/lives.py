"""Missions in virtual time in which server and clients stop and restart.

A life is one run of a process. Without its client a vehicle keeps its last velocity for HOLD_NS and
then drifts with the wind; one whose client has ended in order holds its place, as with an
autopilot. Keys set by the operator survive a restart of the server.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from skytether.client.endpoint import Client
from skytether.client.memory import SavingClient, recall
from skytether.client.several import Several
from skytether.client.simulated.plant import FirstOrderPlant
from skytether.client.simulated.sensor import Sensor
from skytether.client.simulated.vehicle import SimulatedVehicle
from skytether.client.simulated.weather import Weather
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.server.missions.mission_planner import MissionPlanner
from skytether.shared.base.chance import stream
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.change import Running, with_values
from skytether.shared.endpoints.endpoint import Address, Endpoint
from skytether.shared.events.flight import Event
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import MemoryRecorder, client_columns
from skytether.shared.telemetry.summary import Track, track
from skytether.shared.wire.protocol import Mode
from skytether.sim.flight import SERVER
from skytether.sim.hosts import Clock
from skytether.sim.process import VirtualProcess
from skytether.sim.standby import STANDBY
from skytether.sim.world import World

Saved = tuple[bytes, int]
"""State that a client has saved, and when [ns; host's clock]."""
NETWORK: Address = ("netem", 0)
STANDBY_FLOWS = 1000
"""Number of the network's socket to which vehicles send for the standby server; vehicle n is heard
there from socket STANDBY_FLOWS + n."""
CLOCK = Clock(10**6 * SECOND_NS)
"""Clock of all hosts. Its offset has no effect, because the server estimates clock offsets."""
HOLD_NS = SECOND_NS
"""Time for which a vehicle without a client keeps its last velocity before it stops [ns]."""


class Body(SimulatedVehicle):
    """Simulated vehicle that flies on without its client."""

    def __init__(self, scenario: Scenario, number: int) -> None:
        weather = Weather(scenario, stream(scenario.seed, "wind", number))
        plant = FirstOrderPlant(scenario, weather, number)
        super().__init__(scenario.dt_ns, plant, _sensor(scenario, number, 0))
        self.holds = False
        """Whether it holds its place without a client, as one that was left at rest."""
        self.unflown: list[tuple[float, list[float]]] = []
        """Times [s; client's clock] and positions [m] of steps without a client."""

    def fly_alone(self, now_ns: int) -> None:
        lost, velocity = self._step, self._velocity
        while lost >= 0 and self._began_ns + (self._step + 1) * self._dt_ns <= now_ns:
            is_held = (self._step - lost) * self._dt_ns < HOLD_NS
            if not self.holds:
                self.plant.advance(velocity if is_held else 0.0 * velocity)
            self._step, self._state = self._step + 1, self.plant.state()
            self.sensor.measure(self._state, began_ns=self._began_ns)
            time_s = (self._began_ns + self._step * self._dt_ns) / SECOND_NS
            self.unflown.append((time_s, self._state[:, 0].tolist()))
        self.holds = False

    def reset(self, sensor: Sensor) -> None:
        """Rest until the next client, which counts its steps from 0."""
        self.sensor, self._step, self._velocity = sensor, -1, 0.0 * self._velocity


def _sensor(scenario: Scenario, number: int, life: int) -> Sensor:
    return Sensor(scenario, stream(scenario.seed, "sensor", number, life))


class Life(NamedTuple):
    client: Client
    steps: MemoryRecorder


class Lives:
    """Mission whose server and clients can be stopped and restarted.

    Args:
        network: endpoint between clients and server; the scenario's network unless given.
        mortal: numbers of vehicles whose clients may stop; only these save their state.
        has_standby: whether there is a second server, which `network` has to reach.
    """

    def __init__(
        self,
        scenario: Scenario,
        network: Endpoint | None = None,
        mortal: Collection[int] | None = None,
        *,
        has_standby: bool = False,
    ) -> None:
        mission = scenario.make_reference()
        assert isinstance(mission, Mission)
        self.scenario, self.mission = scenario, mission
        self.events: list[tuple[float, str, Event]] = []
        """Virtual time [s], host and event."""
        self.world = World(self._on_event)
        flows = 2 * len(mission.vehicles)
        self.world.add(NETWORK[0], network or Proxy(scenario, server=SERVER, flows=flows))
        self._mortal = mission.vehicles if mortal is None else mortal
        self._standby = [(NETWORK[0], STANDBY_FLOWS)] if has_standby else []
        self._lives: dict[int, list[Life]] = {number: [] for number in mission.vehicles}
        self.bodies = {number: Body(scenario, number) for number in mission.vehicles}
        self.clients = {
            number: VirtualProcess(f"client {number}", partial(self._client, number))
            for number in mission.vehicles
        }
        for number, client in self.clients.items():
            start_ns = int(stream(scenario.seed, "phase", number).integers(scenario.dt_ns))
            self.world.add(client.host, client.endpoint, clock=CLOCK, start_ns=start_ns)
        self.server_runs: list[Server] = []
        """All runs of all servers."""
        self._running: dict[str, Running] = {}
        """Newest run of each server, and its scenario."""
        self.servers = {
            name: VirtualProcess(name, partial(self._server, name))
            for name, _ in (SERVER, STANDBY)[: 1 + has_standby]
        }
        for name, server in self.servers.items():
            self.world.add(name, server.endpoint, clock=CLOCK)

    def _on_event(self, time_ns: int, host: str, event: Event) -> None:
        self.events.append((time_ns / SECOND_NS, host, event))

    @property
    def running(self) -> list[Running]:
        """Servers that are up, and their scenarios, with the keys set in flight."""
        return [self._running[name] for name, server in self.servers.items() if server.is_up]

    @property
    def scenarios(self) -> list[Scenario]:
        """Scenario of each server that leads."""
        return [each.scenario for each in self.running if _leads(each)]

    def _server(
        self,
        name: str,
        _: int,
        scenario: Scenario | None = None,
        settings: Mapping[str, Any] = MappingProxyType({}),
    ) -> Server:
        scenario, number = scenario or self.scenario, len(self.server_runs) + 1
        entropy = stream(scenario.seed, "entropy", number).bytes
        count = len(self.mission.vehicles)
        server = Server(scenario, boot_id=number, entropy=entropy, capacity=count)
        self.server_runs.append(server)
        self._running[name] = Running(server, scenario, settings)
        return server

    def _client(self, number: int, runs: int, kept: Saved | None = None) -> Client:
        make: Callable[..., Client] = Client
        if self._keeps(number):
            now_ns, terms = CLOCK.local(self.world.now_ns), self.scenario.terms()
            make = partial(SavingClient, before=recall(*kept, now_ns, terms) if kept else None)
        steps = MemoryRecorder(client_columns(self.scenario.model.axes))
        client = make(
            self.scenario,
            self.bodies[number],
            server=Several([NETWORK], standby=self._standby),
            vehicle=number,
            boot_id=number * 1000 + runs,
            recorder=steps,
        )
        self._lives[number].append(Life(client, steps))
        return client

    def _keeps(self, number: int) -> bool:
        return number in self._mortal and self.scenario.vehicle.memory != "none"

    # -- stops and restarts ------------------------------------------------------------------------

    def start_client(
        self, number: int, *, remembers: bool = True, saved: Sequence[Saved] | None = None
    ) -> None:
        """Start the next run of a vehicle's client.

        Args:
            remembers: whether it finds a saved state.
            saved: the state that it finds, if any, in place of the newest.
        """
        body, remembers = self.bodies[number], remembers and self._keeps(number)
        body.fly_alone(CLOCK.local(self.world.now_ns))
        found = (self.saved(number) if saved is None else saved) if remembers else ()
        client = self.clients[number]
        if not found:
            body.reset(_sensor(self.scenario, number, client.runs))
        client.start(self.world, *found)

    def join_client(self, number: int) -> None:
        """Start a vehicle's client, unless one has flown already."""
        if not self.clients[number].endpoint.began_ns:
            self.start_client(number, remembers=False)

    def saved(self, number: int) -> Sequence[Saved]:
        """The state that a vehicle's client has saved last, if any."""
        saved = self.world.memory(f"client {number}")
        return () if saved is None else (saved,)

    def end_client(self, number: int) -> None:
        """Let a client end in order; its vehicle then holds its place."""
        hold = partial(setattr, self.bodies[number], "holds", True)
        self.clients[number].end(self.world, self.scenario.dt_ns, hold)

    def end_server(self, name: str = SERVER[0]) -> None:
        self.servers[name].end(self.world, self.scenario.dt_ns)

    def settings(self, name: str) -> Mapping[str, Any]:
        """Keys set in flight, as the journal of a server has them."""
        return self._running[name].settings

    def start_server(
        self,
        changes: Mapping[str, Any],
        *,
        remembers: bool = True,
        settings: Mapping[str, Any] | None = None,
        name: str = SERVER[0],
    ) -> None:
        """Start the next run of a server.

        Args:
            changes: keys that differ from the scenario, and their values.
            remembers: whether keys that were set in flight are kept.
            settings: the keys that it finds in place of those.
        """
        if settings is None:
            settings = self.settings(name) if remembers else {}
        scenario = with_values(with_values(self.scenario, changes), settings)
        self.servers[name].start(self.world, scenario, settings)

    def set(self, values: Mapping[str, Any]) -> None:
        """Set keys at each server, as an operator; it may refuse them."""
        for name, server in self.servers.items():
            if server.is_up:
                with suppress(ConfigError):  # a refusal is logged as an event
                    self.world.act(name, partial(self._running[name].change, values))

    # -- the flight --------------------------------------------------------------------------------

    def track(self, number: int) -> Track:
        """Flown path of a vehicle through all runs of its client, from its first step on the
        mission.
        """
        dt_s, scale = self.scenario.control.dt, self.scenario.mission.height_scale
        tracks: list[Track] = []
        for client, steps in self._lives[number]:
            rows = steps.rows()
            if tracks or (rows["mode"] == Mode.TRACK).any():
                began_s = client.began_ns / SECOND_NS
                tracks.append(track(rows, began_s, dt_s, scale, whole=bool(tracks)))
        if not tracks:
            return np.zeros(0), np.zeros((0, self.scenario.model.axes))
        body = self.bodies[number]
        # A vehicle without a client, or with a refused one, stays at its last position.
        now = CLOCK.local(self.world.now_ns) / SECOND_NS, body.plant.state()[:, 0].tolist()
        times, at = (np.array(each) for each in zip(*body.unflown, now, strict=True))
        at[:, 2:] *= scale
        since = times > tracks[0][0][0]
        tracks.append((times[since], at[since]))
        times, at = (np.concatenate(each) for each in zip(*tracks, strict=True))
        order = np.argsort(times, kind="stable")
        return times[order], at[order]

    def tracks(self) -> dict[int, Track]:
        return {number: self.track(number) for number in self._lives}

    def run(self, until_s: float) -> None:
        self.world.run(lambda: False, limit_ns=seconds_to_ns(until_s))


def world_s(time_s: float) -> float:
    """Virtual time for a time on the hosts' clock [s]."""
    return float(time_s) - CLOCK.offset_ns / SECOND_NS


def _leads(running: Running) -> bool:
    """Whether a server may lead a vehicle: none follows a standby with other zones."""
    server = running.endpoint
    assert isinstance(server, Server)
    scheme = server.controller.scheme
    return not (isinstance(scheme, MissionPlanner) and scheme.is_standby)
