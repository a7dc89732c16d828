"""Ticks of the server in a record, and the packets that left at them."""

import re
from collections import Counter

import numpy as np

from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.events.flight import FlowOpened
from skytether.shared.law.model import Flags, Indices
from skytether.shared.telemetry.record import UPLINK, Record, Rows

CLIENT = re.compile(r"client \d+\.(\d+)")
"""Name of a client's host in virtual time, with seed and vehicle. Over UDP it is an address."""
PACKETS, PLANS = 400, 50
"""Largest number of a vehicle's packets, and of its plans, that `begin_ns` compares to find tick 0.
Both are counted from the first."""


def ticks(server: Rows) -> Indices:
    """Tick number of each of the server's rows, from 0; a vehicle has one row per tick."""
    tick, seen, number = np.zeros(len(server), dtype=np.int64), set[int](), 0
    for at, vehicle in enumerate(server["vehicle"].tolist()):
        if vehicle in seen:
            number += 1
            seen.clear()
        seen.add(vehicle)
        tick[at] = number
    return tick + server["missed"]


def flows(record: Record) -> dict[int, int]:
    """Vehicle of each flow; empty for flights over UDP, whose records do not name the vehicles."""
    opened = [each.event for each in record.events if isinstance(each.event, FlowOpened)]
    named = [(each.flow, CLIENT.fullmatch(each.host)) for each in opened]
    return {flow: int(client[1]) for flow, client in named if client}


def begin_ns(record: Record, dt_ns: int) -> int | None:
    """Time at which the packets of tick 0 leave, in virtual time [ns]: the time for which most
    plans leave within a millisecond of a packet. None if no plan does.
    """
    own, server = flows(record), record.server
    sent, times = server[server["event"]], Counter[int]()
    tick, uplink = ticks(server)[server["event"]], record.netem[record.netem["direction"] == UPLINK]
    for flow, vehicle in own.items():
        left_ns = uplink["arrived_ns"][uplink["flow"] == flow][:PACKETS]
        since_ns = left_ns[:, None] - tick[sent["vehicle"] == vehicle][:PLANS] * dt_ns
        times.update(since_ns.ravel().tolist())
    near = Counter[int]()
    for time_ns, count in times.items():
        near[time_ns // MILLISECOND_NS] += count
    most = max(near, key=near.__getitem__, default=0)
    return max(times, key=lambda each: (each // MILLISECOND_NS == most, times[each]), default=None)


def are_plans(record: Record, packets: Rows, dt_ns: int) -> Flags:
    """Whether each packet has a plan: it left at a tick at which the server sent a plan."""
    began_ns, own = begin_ns(record, dt_ns), flows(record)
    if began_ns is None:
        return np.zeros(len(packets), dtype=np.bool_)
    event = record.server["event"]
    vehicles, tick = record.server["vehicle"][event].tolist(), ticks(record.server)[event].tolist()
    plans = set(zip(vehicles, tick, strict=True))
    at = np.round((packets["arrived_ns"] - began_ns) / dt_ns).astype(np.int64)
    off_ns = np.abs(packets["arrived_ns"] - began_ns - at * dt_ns)
    sent = zip(packets["flow"].tolist(), at.tolist(), strict=True)
    is_at: Flags = np.array([(own.get(flow, 0), tick) in plans for flow, tick in sent], dtype=bool)
    is_up = packets["direction"] == UPLINK
    result: Flags = is_at & is_up & (off_ns < dt_ns // 4)
    return result
