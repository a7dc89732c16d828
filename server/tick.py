"""The server's tick: the present step of each vehicle, its plan, packets and records.

Ticks are due at the multiples of Δt of the server's clock; a missed tick is skipped and counted.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from skytether.server.controller import BLOCK, Controller, Decisions
from skytether.server.planning.clock import ClockMap
from skytether.server.planning.scheme import Batch, Header, make_header
from skytether.server.sessions import Session, Sessions
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram, Events
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.flight import (
    Degraded,
    Fault,
    PlanningResumed,
    PlanningStopped,
)
from skytether.shared.law.model import Array
from skytether.shared.telemetry.histogram import Histogram
from skytether.shared.telemetry.record import Compared, Recorder
from skytether.shared.wire.protocol import Heartbeat, Idle, encode, stamp_us

MISSES_MAX = 5
"""Number of ticks that may be missed in a second before the server reports itself as degraded."""
EXPECTED_GAP, OWN = str(Compared.EXPECTED_GAP), str(Compared.OWN)
"""Names of the record's columns that may be empty."""
TICK_BIN_NS = MILLISECOND_NS // 20
"""Bin width of the histogram of tick durations [ns]."""


class Grid:
    def __init__(self, dt_ns: int, events: Events) -> None:
        self._dt_ns = dt_ns
        self._events = events
        self.due_ns: int | None = None
        """Time of the next tick [ns]; None while there is no vehicle to plan for."""
        self.missed = 0
        self._missed_ns: deque[int] = deque(maxlen=MISSES_MAX + 1)
        self.degraded = False
        """Whether the server is degraded because it misses too many ticks."""

    def arm(self, now_ns: int) -> None:
        dt_ns = self._dt_ns
        if (
            self.due_ns is None or self.due_ns > now_ns + dt_ns
        ):  # also if the server's clock was set back
            self.due_ns = -(-now_ns // dt_ns) * dt_ns  # next multiple of Δt, or now

    def rest(self) -> None:
        self.due_ns = None

    def next_tick(self, now_ns: int) -> int | None:
        """Time of the tick that is due, or None; missed ticks are counted."""
        if self.due_ns is None or now_ns < self.due_ns:
            return None
        # Missed ticks are not repeated: plans for past steps are useless, and a burst of ticks
        # would delay the next tick too.
        late = (now_ns - self.due_ns) // self._dt_ns
        self.missed += late
        if late or self.degraded:
            self._note_missed(late, now_ns)
        tick_ns = self.due_ns + late * self._dt_ns
        self.due_ns = tick_ns + self._dt_ns
        return tick_ns

    def _note_missed(self, count: int, now_ns: int) -> None:
        # After an hour of suspension `count` is large; the deque keeps the newest few only.
        self._missed_ns += [now_ns] * min(count, MISSES_MAX + 1)
        many = len(self._missed_ns) > MISSES_MAX and now_ns - self._missed_ns[0] <= SECOND_NS
        if many != self.degraded:
            self.degraded = many
            self._events.append(Degraded(degraded=many))


class Ticker:
    """At each tick, plans for all vehicles in session, sends plans and heartbeats, and records."""

    def __init__(
        self,
        sessions: Sessions,
        clock: ClockMap,
        controller: Controller,
        grid: Grid,
        stopwatch: Stopwatch,
        *,
        out: list[Datagram],
        events: Events,
        recorder: Recorder | None,
        plan_recorder: Recorder | None,
    ) -> None:
        self._sessions = sessions
        self._clock = clock
        self._controller = controller
        self._grid = grid
        self._stopwatch = stopwatch
        self._out = out
        self._events = events
        self._recorder, self._plan_recorder = recorder, plan_recorder
        self._records = recorder is not None or plan_recorder is not None
        self.durations = Histogram(TICK_BIN_NS)
        """Durations of ticks; empty if the stopwatch measures nothing."""

    def tick(self, tick_ns: int, now_ns: int) -> None:
        """Run the tick that was due at `tick_ns`: plan, send, and record."""
        controller = self._controller
        self._stopwatch.start()
        before_ns = self._stopwatch.total_ns
        rows = self._sessions.rows
        step = self._clock.steps(rows, tick_ns)
        heartbeats = self._sessions.heartbeats_due(now_ns)
        controller.begin_tick(tick_ns, now_ns, [each.row for each in heartbeats])
        rows, step = controller.able(rows, step)
        for first in range(0, len(rows), BLOCK):
            block = slice(first, first + BLOCK)
            decisions = controller.decide(rows[block], step[block])
            if len(decisions.batch.sent):
                self._send_plans(decisions, now_ns)
            self._stopwatch.lap("encode")
            if self._records:
                self._record(decisions)
        # `idle` seldom changes, and comparing bytes is six times as fast as comparing numbers.
        if controller.idle.tobytes() != self._sessions.idle.tobytes():
            self._report_idle()
        if controller.faults:
            self._events += [Fault(traceback=fault) for fault in controller.faults]
            controller.faults.clear()
        if events := controller.scheme.events:
            self._events += events
            events.clear()
        # Heartbeats come last, because a plan sent at this tick replaces a heartbeat.
        if heartbeats:
            self._send_heartbeats(heartbeats, now_ns)
        self._sessions.routes.watch(self._put, self._events, now_ns)
        self._stopwatch.lap("encode")
        self.durations.add(self._stopwatch.total_ns - before_ns)

    def _report_idle(self) -> None:
        idle = self._controller.idle
        for row in np.flatnonzero(idle != self._sessions.idle).tolist():
            self._sessions.idle[row] = idle[row]
            vehicle, why = self._sessions.at(row).vehicle, Idle(idle[row])
            if why == Idle.PLANS:
                self._events.append(PlanningResumed(vehicle=vehicle))
            else:
                self._events.append(PlanningStopped(vehicle=vehicle, why=str(why)))

    def _send_plans(self, decisions: Decisions, now_ns: int) -> None:
        # The stamp has the time of sending, not of the tick: the vehicle measures delays with it.
        batch, sessions, sent_us = decisions.batch, self._sessions, stamp_us(now_ns)
        sessions.routes.appraise(decisions)

        def header(row: int) -> Header:
            session = sessions.at(row)
            number, silence = session.number_next(now_ns), session.hearing.silence
            return make_header((session.vehicle, session.number, sent_us, number, silence))

        for row, payload in self._controller.scheme.encode(batch, header):
            session = sessions.at(row)
            plan = sessions.assignment.signed(session, payload)
            self._put(row, session.sealed(plan, now_ns), is_plan=True)

    def _send_heartbeats(self, due: Sequence[Session], now_ns: int) -> None:
        for session in due:
            if session.is_heartbeat_due(now_ns):
                idle = int(self._sessions.idle[session.row])
                beat = Heartbeat(
                    session.vehicle,
                    session.number,
                    stamp_us(now_ns),
                    idle,
                    int(self._grid.degraded),
                    session.number_next(now_ns),
                    session.hearing.silence,
                )
                self._put(session.row, session.sealed(encode(beat), now_ns))

    def _put(self, row: int, datagrams: Sequence[Datagram], *, is_plan: bool = False) -> None:
        self._out += datagrams
        if charge := self._controller.charge:
            charge(row, datagrams, is_plan=is_plan)

    def _record(self, decisions: Decisions) -> None:
        batch, figures = decisions.batch, decisions.figures
        if self._plan_recorder is not None and len(batch.sent):
            self._record_plans(self._plan_recorder, batch)
        if self._recorder is None:
            return
        rows, predicted = batch.rows, batch.foresight
        n = len(rows)
        self._recorder.append(
            n,
            vehicle=self._sessions.vehicle[rows],
            step=batch.step,
            reference=self._controller.desired.now(rows, batch.step),
            estimate=predicted.estimate[:n],
            ahead=predicted.ahead[:n],
            planned=decisions.planned,
            input=predicted.horizons[:n, :, 0],
            observed_step=self._controller.observed_step[rows],
            **self._figures(decisions),
            threshold=decisions.verdict.threshold,
            compared=decisions.verdict.compared,
            event=decisions.event,
            solved=figures["solved"],
            solve_ns=decisions.solve_ns,
            stale=self._sessions.stale[rows],
            missed=self._grid.missed,
        )
        self._stopwatch.lap("record")

    def _figures(self, decisions: Decisions) -> dict[str, Array | float]:
        """Figures of the plans for the record; NaN where a plan or a figure is missing."""
        figures, verdict, missing = decisions.figures, decisions.verdict, float("nan")
        names = self._controller.columns
        columns: dict[str, Array | float] = {}
        solved, are_solved = figures["solved"], False not in figures["solved"]
        for name in names:
            figure = figures[name]
            columns[name] = figure if are_solved else np.where(solved, figure, missing)
        if EXPECTED_GAP in columns and not self._controller.doubts:
            columns[EXPECTED_GAP] = missing
        columns[OWN] = verdict.figure if verdict.compared is Compared.OWN else missing
        return columns

    def _record_plans(self, recorder: Recorder, batch: Batch) -> None:
        sent_plans = self._controller.scheme.sent_plans(batch)
        recorder.append(
            len(batch.sent),
            vehicle=self._sessions.vehicle[batch.rows[batch.sent]],
            **sent_plans._asdict(),
            disturbance=batch.foresight.disturbance[batch.sent],
        )
