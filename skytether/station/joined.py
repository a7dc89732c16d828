"""Record of a ground station's flight, joined from the parts of its three processes.

    station    data received and sent at each step
    autopilot  true state of the vehicle, at each of its ticks (`record.TRUTH_COLUMNS`)
    netem      fate of every packet

The result has the form of any flight's record: its client rows have the vehicle's true state, and
its server rows the steps at which the station has sent.
"""

from collections.abc import Sequence

import numpy as np

from skytether.shared.events.flight import Failure
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import (
    FlightEvent,
    Reason,
    Record,
    Rows,
    client_columns,
    server_columns,
)
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.shared.wire.protocol import NO_HORIZON, Mode


def station_columns(axes: int) -> np.dtype[np.void]:
    """Columns of the ground station's part: one row per step."""
    return np.dtype(
        [
            ("time_ns", "<i8"),  # clock of the station
            ("step", "<i8"),
            ("input", "<f8", (axes,)),  # velocity of the set-point [m/s]
            ("measured", "<f8", (axes,)),  # newest position received [m]; NaN before the first
            ("age_ns", "<i8"),  # age of that position; -1 before the first
            # whether the station was in control of the autopilot, and so sent a set-point
            ("obeyed", "?"),
            ("late", "<i8"),  # number of positions so far that arrived after newer ones
            ("missed", "<i8"),  # number of steps so far that were missed by waking too late
        ]
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
        truth: rows of `record.TRUTH_COLUMNS`, on the station's clock.
        netem: rows of netem's part, on the station's clock.
        failure: event after which the vehicle could not be flown.
    """
    axes = scenario.model.axes
    client = np.zeros(len(station), client_columns(axes))
    client["vehicle"] = 1
    for name in ("step", "input", "age_ns", "missed"):
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


def summary_of(scenario: Scenario, name: str, flown: Record) -> Summary:
    """Summary of a ground station's flight, which has no plans."""
    return summarise(scenario, name, flown.client, None, flown.netem)
