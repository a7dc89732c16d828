"""Flights in virtual time by set-points that a ground station sends to an autopilot.

Station, netem and autopilot take the places of server, netem and client, so both meet the same
network as a flight of Skytether with the same seed. The record has the form of any flight's record:
its client rows have the vehicle's true state, and its server rows the steps at which the station
has sent.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bench.laws import Law
from bench.station import Station, station_columns
from skytether.autopilot.endpoint import TRUTH_COLUMNS, Autopilot
from skytether.autopilot.flavours import FlavourName
from skytether.netem.proxy import Proxy
from skytether.shared.base.chance import stream
from skytether.shared.base.units import seconds_to_ns
from skytether.shared.events.flight import Event, Failure
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import (
    PACKET_COLUMNS,
    FlightEvent,
    MemoryRecorder,
    Reason,
    Record,
    Rows,
    client_columns,
    server_columns,
)
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.shared.wire.protocol import NO_HORIZON, Mode
from skytether.sim.changes import plan
from skytether.sim.hosts import Clock
from skytether.sim.world import World

READY_S = 1.0
"""Time from the autopilot's start until it may be armed [s]; short, because simulated filters need
not settle.
"""
AROUND_S = 180.0


def fly(
    scenario: Scenario,
    law: Law,
    flavour: FlavourName = "ardupilot",
    changes: Sequence[tuple[float, Mapping[str, Any]]] = (),
) -> Record:
    """Fly a scenario by set-points that a ground station sends directly to an autopilot.

    Args:
        law: law that chooses set-points.
        flavour: flavour of the autopilot.
        changes: see `sim.flight.fly`.
    """
    events: list[FlightEvent] = []

    def on_event(time_ns: int, host: str, event: Event) -> None:
        events.append(FlightEvent(time_ns, host, event))

    columns = station_columns(scenario.model.axes), TRUTH_COLUMNS, PACKET_COLUMNS
    steps, truths, packets = map(MemoryRecorder, columns)
    station = Station(scenario, law, steps)
    netem = Proxy(scenario, server=("station", 0), flows=1, recorder=packets)
    autopilot = Autopilot(scenario, flavour, peers=[("netem", 0)], ready_s=READY_S, recorder=truths)
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
    plan(world, {"netem": (netem, scenario), "autopilot": (autopilot, scenario)}, changes)
    world.run(lambda: station.finished, limit_ns=seconds_to_ns(scenario.duration + AROUND_S))
    truth = truths.rows().copy()
    truth["time_ns"] = [clock.world(time_ns) for time_ns in truth["time_ns"].tolist()]
    return joined(
        scenario, steps.rows(), truth, packets.rows(), failure=station.failure, events=events
    )


def joined(
    scenario: Scenario,
    station: Rows,
    truth: Rows,
    netem: Rows,
    *,
    failure: Failure | None = None,
    events: Sequence[FlightEvent] = (),
) -> Record:
    """Record of a flight; packets are counted from its first step to its last.

    Args:
        station: rows of `station_columns`.
        truth: rows of `autopilot.endpoint.TRUTH_COLUMNS`, on the station's clock.
        netem: rows of netem's part, on the station's clock.
        failure: event after which the vehicle could not be flown.
    """
    axes = scenario.model.axes
    client = np.zeros(len(station), client_columns(axes))
    client["vehicle"] = 1
    for name in ("step", "input", "age_ns"):
        client[name] = station[name]
    client["state"] = state_at(truth, station["time_ns"])[:, :axes]
    client["measured"] = client["estimate"] = np.nan
    client["measured"][..., 0] = station["measured"]
    client["covered"] = obeyed = station["obeyed"]
    client["in_force"] = NO_HORIZON
    client["stale"] = station["late"]
    client["mode"] = np.where(obeyed, Mode.TRACK, Mode.MANUAL)
    client["reason"] = np.where(obeyed, Reason.HORIZON, Reason.TAKEN)
    server = np.zeros(len(station), server_columns(axes, scenario.control.scheme))
    server["vehicle"], server["step"], server["event"] = 1, station["step"], obeyed
    return Record(
        client=client,
        server=server,
        netem=within(netem, station["time_ns"], scenario.dt_ns),
        failure=failure,
        events=tuple(events),
    )


def state_at(truth: Rows, times_ns: np.ndarray) -> np.ndarray:
    """True position [m] and velocity [m/s] at given times, NaN where unknown; shape (n, 3, 2)."""
    if not len(truth):
        return np.full((len(times_ns), 3, 2), np.nan)
    flat = truth["state"].reshape(len(truth), -1)
    columns = [
        np.interp(times_ns, truth["time_ns"], column, left=np.nan, right=np.nan)
        for column in flat.T
    ]
    return np.stack(columns, axis=1).reshape(-1, 3, 2)


def within(netem: Rows, times_ns: np.ndarray, dt_ns: int) -> Rows:
    """Rows of packets that entered the network in steps that began at these times."""
    if not len(times_ns):
        return netem[:0]
    entered = netem["arrived_ns"]
    return netem[(times_ns[0] <= entered) & (entered < times_ns[-1] + dt_ns)]


def summary_of(scenario: Scenario, flown: Record) -> Summary:
    """Summary of a ground station's flight, which has no plans."""
    return summarise(scenario, "autopilot", flown.client, None, flown.netem)
