"""Flights in virtual time by set-points that a ground station sends to an autopilot.

Station, netem and autopilot take the places of server, netem and client, so both meet the same
network as a flight of Skytether with the same seed.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from skytether.autopilot.endpoint import Autopilot
from skytether.autopilot.flavours import FlavourName
from skytether.netem.proxy import Proxy
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.change import Running
from skytether.shared.events.flight import Event
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import (
    PACKET_COLUMNS,
    TRUTH_COLUMNS,
    FlightEvent,
    Record,
    Recorder,
    parse,
)
from skytether.sim.flight import plan_changes
from skytether.sim.world import Clock, World
from skytether.station.endpoint import Station
from skytether.station.joined import joined, station_columns
from skytether.station.laws import Law

READY_S = 1.0
"""Time from the autopilot's start until it may be armed [s]; short, because simulated filters need
not settle.
"""
AROUND_S = 180.0


def fly(
    scenario: Scenario,
    law: Law,
    flavour: FlavourName = "ardupilot",
    *,
    changes: Sequence[tuple[float, Mapping[str, Any]]] = (),
    on_second: Callable[[int], None] = lambda _: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Record:
    """Fly a scenario by set-points that a ground station sends directly to an autopilot.

    Args:
        law: law that chooses set-points.
        flavour: flavour of the autopilot.
        changes, on_second, stopped: see `sim.flight.fly`.
    """
    events: list[FlightEvent] = []

    def on_event(time_ns: int, host: str, event: Event) -> None:
        events.append(FlightEvent(time_ns, host, event))

    sinks = io.BytesIO(), io.BytesIO(), io.BytesIO()
    columns = station_columns(scenario.model.axes), TRUTH_COLUMNS, PACKET_COLUMNS
    to_station, to_truth, to_netem = map(Recorder, columns, sinks)
    station = Station(scenario, law, to_station)
    netem = Proxy(scenario, server=("station", 0), flows=1, recorder=to_netem)
    autopilot = Autopilot(
        scenario, flavour, peers=[("netem", 0)], ready_s=READY_S, recorder=to_truth
    )
    simulation = scenario.simulation
    clock = Clock(
        seconds_to_ns(max(simulation.clock_offset_s, 0.0)),
        round(simulation.clock_drift_ppm * 1000),
    )
    world = World(on_event)
    world.add("netem", netem)
    start_ns = int(stream(scenario.seed, "phase").integers(scenario.dt_ns))
    world.add("autopilot", autopilot, clock=clock, start_ns=start_ns)
    world.add("station", station)
    running = {"netem": Running(netem, scenario), "autopilot": Running(autopilot, scenario)}
    plan_changes(world, running, changes)
    told_s = 0

    def over() -> bool:
        nonlocal told_s
        if world.now_ns // SECOND_NS != told_s:
            told_s = world.now_ns // SECOND_NS
            on_second(told_s)
        return station.finished or stopped()

    world.run(over, limit_ns=seconds_to_ns(scenario.duration + AROUND_S))
    parts = [parse(sink.getvalue()) for sink in sinks]
    truth = parts[1].copy()
    truth["time_ns"] = [clock.world(time_ns) for time_ns in truth["time_ns"].tolist()]
    return joined(scenario, parts[0], truth, parts[2], failure=station.failure, events=events)
