"""The server as an endpoint: it receives and sends datagrams, and has a tick every Δt.

The endpoint combines `reception` (messages of vehicles), `sessions`, and `tick`, which calls
`controller` (decisions for all vehicles).
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from skytether.server.assignment import Assignment
from skytether.server.controller import Controller
from skytether.server.gate import Gate, PlainGate
from skytether.server.planning.clock import ClockMap
from skytether.server.planning.scheme import Planning
from skytether.server.reception import Reception
from skytether.server.schemes import table
from skytether.server.sessions import Session, Sessions
from skytether.server.tick import Grid, Ticker
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import VEHICLES_SHOWN_MAX, Datagram, Endpoint, by_name
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.endpoints.time_of_day import TimeOfDay
from skytether.shared.events.flight import Leaving, ReferenceTooFast, SessionEnded
from skytether.shared.law.heartbeat import Hearing
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.pace import first_too_fast
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder
from skytether.shared.wire.protocol import CLOSES, Close, Refusal, encode

VEHICLES_MAX = 64
"""Default largest number of vehicles at once."""
LATEST_NS = 2 * SECOND_NS
"""Time that a server which has to end waits, after the last motion has ended, for observations
which show that the vehicles are at rest [ns]."""
TICK_EDGES_MS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
"""Bin edges of the histogram of tick durations [ms]."""

TRIGGER = keys_of(InFlight.TRIGGER)
POINT = keys_of(InFlight.POINT)


class Server(Endpoint):
    """Plans for every vehicle that requests a session.

    Args:
        boot_id: number that only this run of the server has.
        entropy: returns this many random bytes.
        recorder: receives one row per tick and vehicle.
        plan_recorder: receives one row per horizon sent, see `record.plan_columns`.
        stopwatch: measures the parts of a tick; the server itself reads no clock.
        references: function from a vehicle's number to its reference; by default all vehicles have
            the scenario's reference.
        planning: function that calls planners of plug-ins.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        boot_id: int,
        entropy: Callable[[int], bytes],
        gate: Gate | None = None,
        capacity: int = VEHICLES_MAX,
        recorder: Recorder | None = None,
        plan_recorder: Recorder | None = None,
        stopwatch: Stopwatch | None = None,
        references: Callable[[int], Reference] | None = None,
        planning: Planning | None = None,
    ) -> None:
        super().__init__()
        if too_fast := first_too_fast(scenario):
            self._events.append(ReferenceTooFast(**too_fast._asdict()))
        self.changeable = TRIGGER
        if scenario.reference.shape == "live":
            self.changeable |= POINT
        terms = scenario.terms()
        self.patience_ns = terms.dt_ns // 4
        references = table.references(scenario, references, capacity)
        self.stopwatch = stopwatch or Stopwatch()
        self._clock = ClockMap(capacity, terms.dt_ns, seconds_to_ns(scenario.link.asymmetry_s))
        self.controller = Controller(
            scenario, terms, capacity, self._clock, self.stopwatch, references, planning
        )
        scheme = self.controller.scheme
        self.changeable |= scheme.changeable
        silence_ns = scenario.link.patience_ns
        self.sessions = Sessions(
            capacity,
            entropy,
            silence_ns,
            partial(Hearing, silence_ns, terms.dt_ns, scenario.link.fixed_ns),
            Assignment(self.controller, scheme.limits),
            keeps_rows=scheme.keeps_rows,
        )
        self._grid = Grid(terms.dt_ns, self._events)
        self._reception = Reception(
            terms,
            scenario.link,
            boot_id,
            gate or PlainGate(),
            self.sessions,
            self._clock,
            self.controller,
            self._grid,
            self.stopwatch,
            out=self._out,
            events=self._events,
        )
        self._ticker = Ticker(
            self.sessions,
            self._clock,
            self.controller,
            self._grid,
            self.stopwatch,
            out=self._out,
            events=self._events,
            recorder=recorder,
            plan_recorder=plan_recorder,
        )
        self._leaves = False
        """Whether an operator has asked the server to end."""
        self._dt_ns = terms.dt_ns
        self._ticked_ns = 0
        self._expire_ns = 0
        """Time of the next check for silent vehicles [ns]."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self._reception.hear(datagram, now_ns=now_ns)

    def next_wake_ns(self) -> int | None:
        """Time of the next tick; None without a vehicle in session."""
        return self._grid.due_ns

    def wake(self, *, now_ns: int) -> None:
        tick_ns = self._grid.next_tick(now_ns)
        if tick_ns is None:
            return
        if now_ns >= self._expire_ns:
            # Only at full seconds of the clock, so that the time at which a vehicle is forgotten
            # does not depend on other vehicles.
            self._expire_ns = (now_ns // SECOND_NS + 1) * SECOND_NS
            for session in self.sessions.expire(now_ns):
                self._events.append(SessionEnded(vehicle=session.vehicle))
            self._out += self.sessions.assignment.spread(self.sessions, now_ns)
        if self.sessions.rows.size:
            self._ticked_ns = now_ns
            self._ticker.tick(tick_ns, now_ns)
        else:
            self._grid.rest()

    def leave(self, *, now_ns: int) -> int:
        """See `Endpoint`; on a mission, waits until all vehicles rest or follow another server."""
        self._leaves = True
        steps = self.controller.scheme.leave()
        moving = tuple(each.vehicle for each in self.sessions if not self._rests(each))
        if not moving:
            return now_ns
        most_ns = steps * self._dt_ns + LATEST_NS
        self._events.append(Leaving(vehicles=moving, most_s=most_ns / SECOND_NS))
        return now_ns + most_ns

    def _rests(self, session: Session) -> bool:
        return self.controller.scheme.rests(session.row)

    @property
    def finished(self) -> bool:
        return self._leaves and all(map(self._rests, self.sessions))

    def close(self, *, now_ns: int) -> None:
        for _ in range(CLOSES):
            for session in self.sessions:
                close = Close(session.vehicle, session.number)
                self._out += session.sealed(encode(close), now_ns)

    def learn_time(self, utc_ns: int, error_ns: int, *, now_ns: int) -> None:
        """See `Endpoint`; narrows clock bounds of vehicles that report the time of day."""
        self._reception.time = TimeOfDay(utc_ns - now_ns, error_ns, now_ns)

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        """See `Endpoint`; the terms of the flight do not change."""
        if keys & TRIGGER:
            self.controller.change_trigger(scenario.control)
        scheme = self.controller.scheme
        scheme.change(scenario, keys)
        self.sessions.assignment.change(scheme.limits, now_ns)
        if keys & POINT:
            moved = "reference.points_m" in keys
            position = scenario.make_reference()(np.zeros(()))[:, 0] if moved else None
            velocity = np.array(scenario.reference.velocity_mps)
            self.controller.desired.move(position, velocity if velocity.size else None, now_ns)

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:
        """See `Endpoint`."""
        return self.controller.scheme.objection(scenario, keys)

    @property
    def missed(self) -> int:
        return self._grid.missed

    @property
    def dropped(self) -> Counter[str]:
        return self._reception.dropped

    @property
    def refused(self) -> Counter[Refusal]:
        return self._reception.refused

    def _of_vehicle(self, session: Session) -> dict[str, Any]:
        row = session.row
        bound_ms = self._clock.bound_ns(row) / MILLISECOND_NS
        vehicle_figures: dict[str, Any] = {
            "step": int(self.controller.last_step[row]),
            "clock_bound_ms": round(bound_ms, 3),
        }
        vehicle_figures |= self.sessions.routes.figures(session, self._ticked_ns)
        return vehicle_figures | self.controller.scheme.vehicle_figures(row)

    def figures(self) -> dict[str, Any]:
        ticks = self._ticker.durations
        shown = self.sessions.first(VEHICLES_SHOWN_MAX)
        vehicle_figures = {str(session.vehicle): self._of_vehicle(session) for session in shown}
        return {
            "vehicles": len(self.sessions),
            "degraded": self._grid.degraded,
            "missed": self.missed,
            "observations": self._reception.observations,
            "tick_ms_p50": ticks.quantile_ms(0.5),
            "tick_ms_p99": ticks.quantile_ms(0.99),
            "ticks_within_ms": ticks.within(TICK_EDGES_MS),
            "spent_ns": dict(self.stopwatch.spent_ns),
            "counts": dict(self.controller.counts) | self._clock.counts,
            "dropped": by_name(self.dropped),
            "refused": by_name(self.refused),
            "by_vehicle": vehicle_figures,
            **self.controller.figures(),
        }
