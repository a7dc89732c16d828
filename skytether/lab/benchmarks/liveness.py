"""Liveness of a link: false losses while it works, and how soon a dead link is noticed.

Both directions of a link are kept alive for the requested hours by the real code of both ends: the
vehicle's `Failsafe` and `Hearing`, the server's `Session` and `Hearing`, each on its own grid of
steps, and netem's fates of packets. There is no vehicle and no plan, so only heartbeats are sent,
each with the silence that its sender allows. Sessions last SESSION_S and are cut at their end. The
table also has the values computed by `shared.law.heartbeat`, and flights of the scenario `demo`
with the scheme "trajectory".

    python -m skytether.lab.benchmarks.liveness --hours 100 --flown-hours 10

With --write the table goes into docs/protocol.md.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from skytether.client.failsafe import TABLE, Failsafe
from skytether.lab.benchmarks.harness import TextTable, progress, refresh
from skytether.lab.benchmarks.heartbeats import computed
from skytether.netem.fate import Fates
from skytether.server.sessions import Session
from skytether.shared.base import files
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.core.events import ModeChanged
from skytether.shared.law.heartbeat import NUMBERS, Hearing
from skytether.shared.scenario import reading
from skytether.shared.scenario.air.draws import SLOT_NS
from skytether.shared.scenario.dotted import lay
from skytether.shared.scenario.schema import DirectionConfig, LinkConfig, Scenario
from skytether.shared.telemetry.record import Reason
from skytether.shell import options
from skytether.sim.flight import fly, fly_batch

DOCUMENT = Path(__file__).parents[3] / "docs" / "protocol.md"
LINK = LinkConfig()
"""Time-out and heartbeats of a scenario that says nothing of them."""
STEP_NS = 50 * MILLISECOND_NS
"""Length of a step of both ends [ns]; the server's steps begin half a step later."""
SESSION_S = 600
"""Length of a session [s]."""
LOSSES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Shares of packets lost independently."""
BURSTS = ((0.1, 0.5), (0.1, 2.0))
"""Shares of packets lost in bursts, and mean length of a burst [s]."""
FLOWN = (0.1, 0.3)
"""Losses with which the scenario is also flown."""
FLIGHT_S, COMPANY = 1800.0, 20
"""Length of these flights [s], and number flown at once."""
CUTS = 50
"""Number of flights with a cut, for each loss."""
CUT_S = (40.0, 50.0)
"""Time of the cut, and end of the flight [s]."""


class Alive(NamedTuple):
    """Results of a link."""

    hours: float
    """Time for which the link was kept alive [h]."""
    false: int
    """Number of times that the vehicle took the working link for lost."""
    noticed_s: list[float]
    """Times from the cut until the vehicle took the link for lost [s]."""


def keep(network: DirectionConfig, sessions: int) -> Alive:
    """Keep an idle link alive for a number of sessions, and cut it at the end of each."""
    kept = [_session(network, seed) for seed in range(1, sessions + 1)]
    hours = sessions * SESSION_S / 3600.0
    return Alive(hours, sum(false for false, _ in kept), [noticed_s for _, noticed_s in kept])


def _session(network: DirectionConfig, seed: int) -> tuple[int, float]:
    """Number of false losses in one session, and how soon its end was noticed [s]."""
    timeout_ns, end_ns = seconds_to_ns(LINK.timeout_s), SESSION_S * SECOND_NS
    up, down = (Fates(network, seed, name, 0) for name in ("uplink", "downlink"))
    ear = Hearing(timeout_ns, STEP_NS, None)
    failsafe = Failsafe(
        TABLE,
        armed=True,
        timeout_ns=timeout_ns,
        brake_ns=0,
        land_after_ns=end_ns,
        changed=lambda *_: None,
    )
    nowhere = ("nowhere", 0)
    hearing = Hearing(LINK.patience_ns, STEP_NS, None)
    server = Session(1, 1, 1, nowhere, nowhere, _Unsealed(), hearing)
    asked, said, told_ns, heard_ns = ear.silence, 0, -end_ns, 0
    false, is_lost, never_ns = 0, False, 2 * end_ns
    failsafe.heard(now_ns=0)
    under_way: list[tuple[int, bool, int, int]] = []
    """Heap: arrival time [ns], whether to the vehicle, number, requested silence [half steps]."""
    now_ns = 0
    while True:
        at_ns = under_way[0][0] if under_way else never_ns
        due_ns = _grid(max(told_ns + asked * STEP_NS // 2, now_ns), 0)
        owed_ns = _grid(max(server.sent_ns + server.asked_ns, now_ns), STEP_NS // 2)
        owed_ns = owed_ns if server.asked_ns else never_ns
        lost_ns = never_ns if is_lost else _grid(heard_ns + timeout_ns + 1, 0)
        now_ns = min(at_ns, due_ns, owed_ns, lost_ns)
        if now_ns >= end_ns:
            break
        if now_ns == at_ns:
            _, to_vehicle, number, silence = heappop(under_way)
            if to_vehicle:
                failsafe.heard(now_ns=now_ns)
                ear.hear(number % NUMBERS, number)
                heard_ns, asked, is_lost = now_ns, silence, False
            else:
                server.hearing.hear(number % NUMBERS, number)
                server.asked_ns = silence * STEP_NS // 2
        elif now_ns == lost_ns:
            assert failsafe.is_lost(now_ns)
            is_lost, false = True, false + 1
        elif now_ns == due_ns:
            _send(under_way, down, now_ns, said, ear.silence, to_vehicle=False)
            said, told_ns = said + 1, now_ns
        else:
            assert server.is_owed(now_ns)
            asks = server.hearing.silence
            _send(under_way, up, now_ns, server.said, asks, to_vehicle=True)
            server.said, server.sent_ns = server.said + 1, now_ns
    last_ns = max([heard_ns, *(at for at, to_vehicle, _, _ in under_way if to_vehicle)])
    return false, max(0, _grid(last_ns + timeout_ns + 1, 0) - end_ns) / SECOND_NS


class _Unsealed:
    """Way back of a session without encryption."""

    def seal(self, payload: bytes) -> bytes:
        """See `WayBack`."""
        return payload


def _grid(time_ns: int, phase_ns: int) -> int:
    """First beginning of a step at a time or later [ns]."""
    return -(-(time_ns - phase_ns) // STEP_NS) * STEP_NS + phase_ns


def _send(
    under_way: list[tuple[int, bool, int, int]],
    fates: Fates,
    now_ns: int,
    number: int,
    silence: int,
    *,
    to_vehicle: bool,
) -> None:
    fate = fates.at(now_ns // SLOT_NS)
    if not fate.lost:
        heappush(under_way, (now_ns + fate.delay_ns, to_vehicle, number, silence))


# -- flights ---------------------------------------------------------------------------------


def scenario_of(loss: float, duration_s: float) -> Scenario:
    """Scenario that is flown."""
    table = reading.to_table(reading.load("demo"))
    keys = {
        "duration": duration_s,
        "control.scheme": "trajectory",
        "control.trigger": "expected_gap(0.05) | silence(1)",
        "vehicle.report": "deviation(0.05) | silence(1)",
        "link.timeout_s": LINK.timeout_s,
        "link.heartbeat_s": LINK.heartbeat_s,
        "network.uplink.loss": loss,
        "network.downlink.loss": loss,
    }
    lay(keys, table)
    return reading.check(table, "liveness")


def flown(loss: float, hours: int) -> Alive:
    """Fly for a number of hours, and cut the link of some more flights."""
    false, flights = 0, math.ceil(hours * 3600.0 / FLIGHT_S)
    for first in range(0, flights, COMPANY):
        seeds = range(first, min(first + COMPANY, flights))
        for flight in fly_batch(scenario_of(loss, FLIGHT_S), seeds):
            is_lost = flight.client["reason"] == Reason.LOST
            false += int(np.count_nonzero(is_lost[1:] & ~is_lost[:-1]))
    return Alive(float(hours), false, [noticed_s(loss, seed) for seed in range(CUTS)])


def noticed_s(loss: float, seed: int) -> float:
    """Time from the cut of a flight's link until the vehicle takes it for lost [s]."""
    cut_s, end_s = CUT_S
    cut = {f"network.{direction}.loss": 1.0 for direction in ("uplink", "downlink")}
    scenario = msgspec.structs.replace(scenario_of(loss, end_s), seed=seed)
    flight = fly(scenario, changes=[(cut_s, cut)])
    return next(
        time_ns / SECOND_NS - cut_s
        for time_ns, _, event in flight.events
        if isinstance(event, ModeChanged)
        and event.reason == str(Reason.LOST)
        and time_ns > cut_s * SECOND_NS
    )


# -- the command -----------------------------------------------------------------------------

HEADINGS = [
    "lost packets",
    "computed [1/h]",
    "both ends alone [1/h]",
    "flown [1/h]",
    "noticed, mean and at most [s]",
    "flown: noticed [s]",
]


@dataclass(frozen=True)
class LivenessOptions:
    """Options of this command."""

    hours: float = 1.0
    """Time for which each link is kept [h]."""
    flown_hours: int = 0
    """Time for which each scenario is flown [h]."""
    write: bool = False
    """Put the table into docs/protocol.md."""


def _rate(alive: Alive) -> str:
    """False losses per hour, with the number seen and the hours."""
    return f"{alive.false / alive.hours:.2g} ({alive.false} in {alive.hours:g} h)"


def _noticed(alive: Alive) -> str:
    return f"{np.mean(alive.noticed_s):.2f}, {max(alive.noticed_s):.2f}"


def table_of(hours: float, flown_hours: int) -> TextTable:
    """Table with a row per network."""
    networks = [(f"{loss:g}", DirectionConfig(loss=loss)) for loss in LOSSES]
    networks += [
        (f"{loss:g} in bursts of {burst_s:g} s", DirectionConfig(loss=loss, burst_s=burst_s))
        for loss, burst_s in BURSTS
    ]
    rows = []
    for name, network in progress(networks, "keeping alive"):
        kept = keep(network, max(1, round(hours * 3600.0 / SESSION_S)))
        known = "" if network.burst_s else f"{computed(network.loss, LINK.timeout_s, None):.2g}"
        row = [name, known, _rate(kept), "", _noticed(kept), ""]
        if flown_hours and not network.burst_s and network.loss in FLOWN:
            seen = flown(network.loss, flown_hours)
            row[3], row[5] = _rate(seen), _noticed(seen)
        rows.append(row)
    return TextTable(HEADINGS, rows)


def main(argv: Sequence[str] | None = None) -> None:
    """Print false losses of working links, and detection times of dead ones."""
    argv = sys.argv[1:] if argv is None else argv
    given = options.read(LivenessOptions(), argv, "liveness", main.__doc__)
    table = table_of(given.hours, given.flown_hours)
    print(table.markdown())
    if given.write:
        files.write(DOCUMENT, refresh(DOCUMENT.read_text(), {"liveness": table}).encode())


if __name__ == "__main__":
    main()
