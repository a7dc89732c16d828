"""One scenario flown in virtual time: scenario + seed → World → record."""

import hashlib
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from client.plant import FirstOrderPlant
from client.vehicle import Client
from netem.proxy import Proxy
from server.controller import Server
from shared.chance import stream
from shared.config import Scenario
from shared.endpoint import SECOND_NS, seconds_to_ns
from shared.record import (
    PACKET_COLUMNS,
    Recorder,
    Rows,
    client_columns,
    parse,
    server_columns,
)
from shared.stopwatch import Stopwatch
from sim.world import Clock, World

MIDNIGHT_NS = 86_400 * SECOND_NS
"""What the server's clock shows at the start, about: no stamp may become negative."""


@dataclass(frozen=True, slots=True)
class Flight:
    """The record of a flight, in its three parts (see `shared.record`)."""

    client: Rows
    server: Rows
    netem: Rows
    failure: str | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)
    """Of the endpoints "server" and "netem" (see `Endpoint.figures`)."""

    def trace_hash(self) -> str:
        """Equal for two flights that went the same to the last bit."""
        parts = (self.client, self.server, self.netem)
        return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def fly(
    scenario: Scenario,
    *,
    vehicles: int = 1,
    stopwatch: Stopwatch | None = None,
    on_second: Callable[[int], None] = lambda _: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Flight:
    """Fly a scenario in virtual time.

    The server's clock starts at a time of day given by the seed, so that its ticks fall anywhere
    within the vehicle's steps, as they do in life.

    Args:
        vehicles: how many, numbered from 1, all with the same plan and winds of their own.
        stopwatch: measures the server; its clock makes the record one of a kind.
        on_second: called with the time flown [s], once a second of it.
        stopped: asked often; once it says so, the flight is broken off.
    """
    axes, simulation = scenario.model.axes, scenario.simulation
    sinks = [io.BytesIO() for _ in range(3)]
    columns = (client_columns(axes), server_columns(axes), PACKET_COLUMNS)
    recorders = [Recorder(column, sink) for column, sink in zip(columns, sinks, strict=True)]

    world = World()
    phase_ns = int(stream(scenario.seed, "phase").integers(scenario.dt_ns))
    server = Server(scenario, boot_id=1, room=vehicles, recorder=recorders[1], stopwatch=stopwatch)
    server_at = world.add(
        *("server", server),
        clock=Clock(offset_ns=MIDNIGHT_NS + phase_ns),
        compute_ns=seconds_to_ns(simulation.compute_s),
    )
    netem = Proxy(scenario, server=server_at, flows=vehicles, recorder=recorders[2])
    netem_at = world.add("netem", netem)
    clients = []
    for number in range(1, vehicles + 1):
        client = Client(
            scenario,
            FirstOrderPlant(scenario, stream(scenario.seed, "wind", number)),
            server=netem_at,
            vehicle=number,
            boot_id=1,
            recorder=recorders[0],
        )
        offset_ns = MIDNIGHT_NS + seconds_to_ns(simulation.clock_offset_s)
        drift_ppb = round(simulation.clock_drift_ppm * 1000)
        world.add(f"client {number}", client, clock=Clock(offset_ns, drift_ppb))
        clients.append(client)

    flown_s, flying = 0, clients.copy()

    def over() -> bool:
        nonlocal flown_s
        if world.now_ns // SECOND_NS != flown_s:
            flown_s = world.now_ns // SECOND_NS
            on_second(flown_s)
        while flying and flying[-1].finished:
            flying.pop()
        return not flying or stopped()

    longest_s = scenario.link.connect_s + 2.0 * scenario.duration + 10.0
    world.run(over, limit_ns=seconds_to_ns(longest_s))
    failure = next((client.failure for client in clients if client.failure), None)
    client_rows, server_rows, netem_rows = (parse(sink.getvalue()) for sink in sinks)
    figures = {"server": server.figures(), "netem": netem.figures()}
    return Flight(client_rows, server_rows, netem_rows, failure, figures)
