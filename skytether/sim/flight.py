"""Flights in virtual time: a scenario and a seed determine a record and events.

**A run in a batch equals the same run alone, bit for bit.** The runs of a batch share only a
server, which plans for all of them at once. Each run has its own network, winds and clocks, from
its seed. Three rules make the records equal. The server's ticks have no random phase; a random
phase from the seed shifts the start of the vehicles instead. The server's computing time delays the
packets that it sends, not those that it receives, and at one instant the server is woken after all
other hosts (`sim.hosts`). The numbers of vehicles and sessions, which differ between runs, always
take the same number of bytes on the wire. Events are equal as well, once the vehicles of each run
are numbered from 1.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from types import MappingProxyType
from typing import Any

import msgspec

from skytether.client import vehicles as kinds
from skytether.client.alone import Reach
from skytether.client.endpoint import Client
from skytether.client.link import ClientLink
from skytether.netem.proxy import Proxy, merged
from skytether.server.endpoint import Server
from skytether.server.gate import Gate
from skytether.shared.base.chance import stream
from skytether.shared.base.kernel import compile_all
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Endpoint
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.flight import Event, VehicleEvent
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import (
    PACKET_COLUMNS,
    FlightEvent,
    MemoryRecorder,
    Record,
    Recorder,
    Rows,
    client_columns,
    plan_columns,
    server_columns,
)
from skytether.sim.hosts import Clock, Hosts

# On a vehicle the client runs as plain Python; thousands of clients in one process need compiled
# code. The simulated vehicle is loaded here, so that its functions are compiled before a flight.
load("skytether.client.simulated.vehicle", "simulated")
compile_all()
Flown = tuple[Endpoint, Scenario]
MIDNIGHT_NS = 86_400 * SECOND_NS
"""Time on the server's clock at the start [ns]; so large that no timestamp is negative."""
BOOT_ID = 2**63 + 2**31
"""Boot id of every endpoint: large, so that it takes as many bytes as a random boot id."""
SERVER: Address = ("server", 0)
ASK_NS = 100 * MILLISECOND_NS
"""Virtual time between two calls of `stopped` [ns]."""
EVENTS_MAX = 65_536
"""Number of newest events of a flight that are kept."""


class Plain:
    """Ends of links without encryption; `sealed.Sealed` makes encrypted ones."""

    def link(self, seed: int, vehicle: int, purpose: str = "") -> ClientLink | None:  # noqa: ARG002
        """Link of a client: None, without encryption."""
        return None

    def gate(self, entropy: Callable[[int], bytes]) -> Gate | None:  # noqa: ARG002
        """Gate of a server: None, without encryption."""
        return None


PLAIN = Plain()


class Alone:
    """The server of a flight; `standby.WithStandby` adds a second server, which takes over."""

    def networks(self, scenario: Scenario) -> list[tuple[Address, Scenario]]:
        """Address of the server behind each network of a vehicle, and the network's scenario."""
        return [(SERVER, each) for each in scenario.networks]

    def reach(self, addresses: list[Address], link: Callable[..., ClientLink | None]) -> Reach:
        """Connection of a vehicle to its servers, through the netems at `addresses`."""
        if len(addresses) == 1:
            return Reach(addresses[0], link())
        several = load("skytether.client.several", "several paths")
        reach: Reach = several.Several(addresses, link())
        return reach

    def others(self, seed: int, started: Callable[..., Server]) -> dict[str, Endpoint]:  # noqa: ARG002
        """Further servers of the flight, by host name; `started` makes a server."""
        return {}


ALONE = Alone()


def fly(
    scenario: Scenario,
    *,
    vehicles: int = 1,
    secure: bool = False,
    server: Endpoint | None = None,
    standby: Endpoint | bool = False,
    beside: Mapping[str, Endpoint] = MappingProxyType({}),
    changes: Sequence[tuple[float, Mapping[str, Any]]] = (),
    actions: Sequence[tuple[float, Callable[[Any], None]]] = (),
    stopwatch: Stopwatch | None = None,
    on_second: Callable[[int], None] = lambda _: None,
    stopped: Callable[[], bool] | None = None,
) -> Record:
    """Fly a scenario in virtual time.

    The vehicles start between two ticks of the server, at a time drawn from the seed, because in a
    real flight the server's ticks are not aligned with the vehicles' steps either.

    Args:
        vehicles: number of vehicles, at least 1; all have the same reference, each has its own
            winds.
        secure: whether the link is encrypted, with keys from the seed.
        server: endpoint that replaces `Server`; the endpoint's steps are not recorded.
        standby: whether there is a second server, on the host `standby`, behind a network of its
            own; or an endpoint that replaces the second server, and is not recorded.
        beside: endpoints of further hosts by name, such as an autopilot at `vehicle.address`.
        changes: times [s, as in `Record.events`], and the changed keys and values, as in
            `shared.endpoints.change`; a refused change is an event, and the flight continues.
        actions: times [s], and functions that then act on the `World`, for example stop a host.
        stopwatch: stopwatch for the server's stages; its times differ from flight to flight.
        on_second: called with the time flown [s], once per second of flight.
        stopped: called every ASK_NS; the flight ends once the result is true.
    """
    ends = PLAIN
    if secure:
        ends = load("skytether.sim.sealed", "keys").Sealed(scenario.seed, vehicles)
    servers = ALONE
    if standby:
        servers = load("skytether.sim.standby", "a standby server").WithStandby(standby)
    plan_recorder = MemoryRecorder(plan_columns(scenario.model.axes, scenario.control.horizon))
    (flight,) = fly_runs(
        scenario,
        (scenario.seed,),
        on_second,
        stopped,
        vehicles,
        stopwatch,
        ends,
        changes,
        plan_recorder,
        server,
        beside,
        actions,
        servers=servers,
    )
    return replace(flight, plan=plan_recorder.rows())


class Run:
    """Vehicles of one seed and their network, in a world shared with other runs.

    Args:
        scenario: scenario to fly, with the run's seed.
        server_rows: returns the number of rows that the server has recorded so far.
        server_figures: returns the server's figures so far about the datagrams of given hosts.
        number: number of the run, from 0; its vehicles are numbered after those of earlier runs.
        vehicles: number of vehicles.
        ends: makes the ends of links.
        servers: servers of the vehicles.
    """

    def __init__(
        self,
        world: Hosts,
        scenario: Scenario,
        server_rows: Callable[[], int],
        server_figures: Callable[[Sequence[str]], Mapping[str, Any]],
        number: int,
        vehicles: int,
        ends: Plain,
        servers: Alone = ALONE,
    ) -> None:
        self._server_rows, self._server_figures = server_rows, server_figures
        self._before = number * vehicles
        self.steps = MemoryRecorder(client_columns(scenario.model.axes))
        """Rows of the vehicles, in the order of their steps."""
        self._packets = MemoryRecorder(PACKET_COLUMNS)
        self._netems: dict[str, Proxy] = {}
        self.flown: dict[str, Flown] = {}
        """Endpoint and scenario of each host."""
        for i, (server, own) in enumerate(servers.networks(scenario)):
            host = f"netem {scenario.seed}/{i + 1}" if i else f"netem {scenario.seed}"
            netem = Proxy(own, server=server, flows=vehicles, recorder=self._packets, path=i)
            self._netems[host], self.flown[host] = netem, (netem, own)
            world.add(host, netem)
        addresses: list[Address] = [(host, 0) for host in self._netems]
        self.hosts: dict[str, Endpoint] = dict([*self._netems.items()][:1])
        """Endpoints of the first path's netem and of the vehicles, in this order, by host name."""
        self._events: deque[FlightEvent] = deque(maxlen=EVENTS_MAX)
        simulation = scenario.simulation
        clock = Clock(
            MIDNIGHT_NS + seconds_to_ns(simulation.clock_offset_s),
            round(simulation.clock_drift_ppm * 1000),
        )
        start_ns = int(stream(scenario.seed, "phase").integers(scenario.dt_ns))

        self._clients = [
            Client(
                scenario,
                kinds.make(scenario, vehicle),
                vehicle=self._before + vehicle,
                server=servers.reach(
                    addresses, partial(ends.link, scenario.seed, self._before + vehicle)
                ),
                boot_id=BOOT_ID,
                recorder=self.steps,
            )
            for vehicle in range(1, vehicles + 1)
        ]
        for vehicle, client in enumerate(self._clients, start=1):
            host, _ = world.add(
                f"client {scenario.seed}.{vehicle}",
                client,
                clock=clock,
                start_ns=start_ns + (vehicle - 1) * kinds.apart_ns(vehicles, scenario.dt_ns),
                on_finished=self._one_has_finished,
            )
            self.hosts[host] = client
            self.flown[host] = client, scenario
        self.flying = vehicles
        self._ends: tuple[int | None, int | None] = None, None
        """Numbers of rows that server and netem had recorded when the last vehicle finished."""
        self._figures: dict[str, Any] | None = None
        """Figures of each process when the last vehicle finished."""

    def hear(self, time_ns: int, host: str, event: Event) -> None:
        """Store an event with its vehicle's number in the run, from 1, unless the last vehicle of
        the run has finished.
        """
        if not self.flying:
            return
        if isinstance(event, VehicleEvent):
            event = msgspec.structs.replace(event, vehicle=event.vehicle - self._before)
        self._events.append(FlightEvent(time_ns, host, event))

    def _one_has_finished(self) -> None:
        self.flying -= 1
        if not self.flying:
            self._ends = self._server_rows(), self._packets.count
            self._figures = self._figures_now()

    def _figures_now(self) -> dict[str, Any]:
        each = {str(one.vehicle - self._before): one.vehicle_figures() for one in self._clients}
        return {
            "server": self._server_figures([*self._netems]),
            "netem": merged([netem.figures() for netem in self._netems.values()]),
            "client": {"by_vehicle": each},
        }

    def flight(self, server_rows: Rows) -> Record:
        """Record of the run, vehicles numbered from 1; `server_rows` has the rows of all runs."""
        server_end, netem_end = self._ends
        client, netem = self.steps.rows().copy(), self._packets.rows()[:netem_end]
        server = server_rows[:server_end]
        last = self._before + len(self._clients)
        server = server[(server["vehicle"] > self._before) & (server["vehicle"] <= last)]
        for rows in (client, server):
            rows["vehicle"] -= self._before
        failure = next((client.failure for client in self._clients if client.failure), None)
        if failure:
            failure = msgspec.structs.replace(failure, vehicle=failure.vehicle - self._before)
        figures = self._figures or self._figures_now()
        return Record(client, server, netem, failure, figures, tuple(self._events))


def fly_runs(
    scenario: Scenario,
    seeds: Sequence[int],
    on_second: Callable[[int], None],
    stopped: Callable[[], bool] | None,
    vehicles: int = 1,
    stopwatch: Stopwatch | None = None,
    ends: Plain = PLAIN,
    changes: Sequence[tuple[float, Mapping[str, Any]]] = (),
    plan_recorder: Recorder | None = None,
    own_server: Endpoint | None = None,
    beside: Mapping[str, Endpoint] = MappingProxyType({}),
    actions: Sequence[tuple[float, Callable[[Any], None]]] = (),
    *,
    servers: Alone = ALONE,
    make_server: Callable[..., Server] = Server,
    figures_of: Callable[[Any, Sequence[str]], Mapping[str, Any]] = lambda server, _: (
        server.figures()
    ),
) -> list[Record]:
    """Fly the runs of several seeds side by side; see `fly` for the other arguments.

    Args:
        make_server: makes the server of all runs.
        figures_of: returns the server's figures about the datagrams of some hosts.
    """

    def on_event(time_ns: int, host: str, event: Event) -> None:
        if host in by_host:
            if not isinstance(event, VehicleEvent):
                for run in runs:
                    run.hear(time_ns, host, event)
                return
            runs[(event.vehicle - 1) // vehicles].hear(time_ns, host, event)
        else:
            run_of[host].hear(time_ns, host, event)

    world = Hosts(on_event)
    # Actions may stop hosts, and other endpoints may save state: only a `World` supports both.
    if actions or own_server or beside or servers is not ALONE:
        world = load("skytether.sim.world", "actions").World(on_event)
    entropy = stream(scenario.seed, "entropy").bytes
    each = [msgspec.structs.replace(scenario, seed=seed) for seed in seeds]
    error_ns = seconds_to_ns(scenario.simulation.time_error_s)

    @cache
    def target(vehicle: int) -> Reference:
        run, number = divmod(vehicle - 1, vehicles)
        return each[run].measured_reference(number + 1)

    has_own = scenario.keeps_apart or scenario.reference.shape == "target"
    recorder = MemoryRecorder(server_columns(scenario.model.axes, scenario.control.scheme))

    def started(entropy: Callable[[int], bytes]) -> Server:
        return make_server(
            scenario,
            boot_id=BOOT_ID,
            entropy=entropy,
            gate=ends.gate(entropy),
            capacity=len(seeds) * vehicles,
            recorder=recorder,
            plan_recorder=plan_recorder,
            stopwatch=stopwatch,
            references=target if has_own else None,
        )

    server = own_server or started(entropy)
    by_host = {SERVER[0]: server, **servers.others(scenario.seed, started)}
    runs = [
        Run(
            world,
            run,
            lambda: recorder.count,
            partial(figures_of, server),
            number,
            vehicles,
            ends,
            servers,
        )
        for number, run in enumerate(each)
    ]
    run_of = {host: run for run in runs for host in run.flown} | dict.fromkeys(beside, runs[0])
    for name, endpoint in beside.items():
        world.add(name, endpoint)
    # The server is added last, so that at one instant it is woken last, after all arrivals.
    compute_ns = seconds_to_ns(scenario.simulation.compute_s)
    for number, (name, endpoint) in enumerate(by_host.items(), start=1):
        world.add(name, endpoint, clock=Clock(number * MIDNIGHT_NS), compute_ns=compute_ns)
    if changes:
        own = {host: each for run in runs for host, each in run.flown.items()}
        others = {name: (each, scenario) for name, each in (by_host | {**beside}).items()}
        load("skytether.sim.changes", "changes in flight").plan(world, others | own, changes)
    for time_s, act in actions:
        world.at(seconds_to_ns(time_s), partial(act, world))
    second_ns, flying = SECOND_NS, runs.copy()

    def over() -> bool:
        nonlocal second_ns
        if world.now_ns >= second_ns:
            flown_s = world.now_ns // SECOND_NS
            second_ns = (flown_s + 1) * SECOND_NS
            on_second(flown_s)
            _tell_time(world, {SERVER[0]: server, **runs[0].hosts}, error_ns)
        while flying and not flying[-1].flying:
            flying.pop()
        return not flying or (stopped is not None and stopped())

    longest_s = scenario.link.connect_s + 2.0 * scenario.duration + 10.0
    world.run(over, limit_ns=seconds_to_ns(longest_s), every_ns=ASK_NS)
    recorded = recorder.rows()
    return [run.flight(recorded) for run in runs]


def _tell_time(world: Hosts, hosts: Mapping[str, Endpoint], error_ns: int) -> None:
    """Give the hosts a time of day, wrong by -`error_ns` and +`error_ns` in turn; none if 0."""
    for number, (host, each) in enumerate(hosts.items() if error_ns else ()):
        wrong_ns = error_ns if number % 2 else -error_ns
        world.act(host, partial(each.learn_time, world.now_ns + wrong_ns, error_ns))
