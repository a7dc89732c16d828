"""The server's tick: which step each vehicle is at, what to send it, and what is written down.

Ticks lie on a grid of Δt with absolute deadlines; one whose time has passed is skipped and counted,
never caught up with.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skytether.server.common.clock import ClockMap
from skytether.server.common.compiled import axes_of
from skytether.server.common.scheme import Packing
from skytether.server.controller import BLOCK, Controller, Decisions
from skytether.server.schemes.knots import inputs_along
from skytether.server.sessions import Session, Sessions
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS, SECOND_NS
from skytether.shared.core.endpoint import Datagram, Events
from skytether.shared.core.events import (
    Degraded,
    Fault,
    InZone,
    LeftTube,
    PlanningResumed,
    PlanningStopped,
)
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.law.model import Array
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.triggers import Compared
from skytether.shared.telemetry.histogram import Histogram
from skytether.shared.telemetry.record import FIGURES, Recorder
from skytether.shared.wire.protocol import (
    FEEDBACK,
    Heartbeat,
    Idle,
    Trajectory,
    committed_max,
    encode,
    encode_horizon,
    stamp_us,
)

MISSES_MAX = 5
"""Number of ticks that may be missed in a second before the server calls itself degraded."""
EXPECTED_GAP, OWN = str(Compared.EXPECTED_GAP), str(Compared.OWN)
"""Columns of the record that may be empty."""
NOTHING = memoryview(b"")
"""Bytes that go with a horizon without feedback."""
TICK_BIN_NS = MILLISECOND_NS // 20
"""Resolution at which the length of a tick is counted [ns]."""


class Grid:
    """Times of the ticks.

    Args:
        dt_ns: time from one tick to the next [ns].
        events: takes what the operator is told.
    """

    def __init__(self, dt_ns: int, events: Events) -> None:
        self._dt_ns = dt_ns
        self._events = events
        self.due_ns: int | None = None
        """Time of the next tick; None while there is no vehicle to plan for."""
        self.missed = 0
        """Number of ticks that were slept through."""
        self._missed_ns: deque[int] = deque(maxlen=MISSES_MAX + 1)
        """Times of the newest ticks that were missed."""
        self.degraded = False
        """Whether more ticks are missed than may be."""

    def arm(self, now_ns: int) -> None:
        """Schedule the next tick, for there is a vehicle to plan for."""
        dt_ns = self._dt_ns
        if self.due_ns is None or self.due_ns > now_ns + dt_ns:  # also where our clock went back
            self.due_ns = -(-now_ns // dt_ns) * dt_ns  # the next, or now

    def rest(self) -> None:
        """Cancel the next tick."""
        self.due_ns = None

    def take(self, now_ns: int) -> int | None:
        """Time of the tick that is due, if one is; those that were slept through are counted."""
        if self.due_ns is None or now_ns < self.due_ns:
            return None
        # Skipped and not made up for: plans for steps that are over are worth nothing, and a burst
        # of ticks would delay the next one too.
        late = (now_ns - self.due_ns) // self._dt_ns
        self.missed += late
        self._note_missed(late, now_ns)
        tick_ns = self.due_ns + late * self._dt_ns
        self.due_ns = tick_ns + self._dt_ns
        return tick_ns

    def _note_missed(self, count: int, now_ns: int) -> None:
        """Note the ticks that were missed, and whether these are too many in a second."""
        if not (count or self.degraded):
            return
        # An hour of sleep counts many ticks, of which the deque keeps the newest few in any case.
        self._missed_ns += [now_ns] * min(count, MISSES_MAX + 1)
        many = len(self._missed_ns) > MISSES_MAX and now_ns - self._missed_ns[0] <= SECOND_NS
        if many != self.degraded:
            self.degraded = many
            self._events.append(Degraded(degraded=many))


class Ticker:
    """Decides for all vehicles in session, sends them horizons and heartbeats, and records.

    Args:
        terms: what is agreed upon with every vehicle.
        sessions: who flies.
        clock: tells the step of each.
        controller: plans.
        grid: tells how many ticks were missed.
        stopwatch: measures the parts of a tick.
        out: takes what is sent.
        events: takes what the operator is told.
        recorder: takes one row a tick and vehicle.
        plans: takes one row for each horizon that is sent.
    """

    def __init__(
        self,
        terms: Terms,
        sessions: Sessions,
        clock: ClockMap,
        controller: Controller,
        grid: Grid,
        stopwatch: Stopwatch,
        *,
        out: list[Datagram],
        events: Events,
        recorder: Recorder | None,
        plans: Recorder | None,
    ) -> None:
        self._terms = terms
        self._model, self._bounds = axes_of(terms.model), np.array(terms.u_max)
        self._sessions = sessions
        self._clock = clock
        self._controller = controller
        self._grid = grid
        self._stopwatch = stopwatch
        self._out = out
        self._events = events
        self._recorder, self._plans = recorder, plans
        self._records = recorder is not None or plans is not None
        self._packing = Packing(terms.axes, committed_max(terms) + terms.planned, terms.planned)
        self._columns = [str(each) for each in FIGURES[terms.scheme]]
        """Columns of the record that figures of plans are written to."""
        self.durations = Histogram(TICK_BIN_NS)
        """Duration of each tick, while the stopwatch runs."""

    def tick(self, tick_ns: int, now_ns: int) -> None:
        """Run a tick: plan, send, and record.

        Args:
            tick_ns: time that it was due at.
            now_ns: time now.
        """
        controller = self._controller
        self._stopwatch.start()
        before_ns = self._stopwatch.total_ns
        rows = self._sessions.rows
        step = self._clock.steps(rows, tick_ns)
        controller.desired.tick(tick_ns)
        if controller.budget:
            controller.budget.fill(rows, now_ns)
        owed = self._sessions.owed(now_ns)
        if owed or controller.owes:
            controller.owe([each.row for each in owed])
        rows, step = controller.able(rows, step)
        for first in range(0, len(rows), BLOCK):
            block = slice(first, first + BLOCK)
            decisions = controller.decide(rows[block], step[block])
            if len(decisions.sent):
                self._send_horizons(decisions, now_ns)
            self._stopwatch.lap("encode")
            if self._records:
                self._record(decisions)
        # Bytes are compared in a sixth of the time of numbers, and seldom differ.
        if controller.idle.tobytes() != self._sessions.idle.tobytes():
            self._tell_idle()
        if controller.faults:
            self._events += [Fault(traceback=said) for said in controller.faults]
            controller.faults.clear()
        if left := controller.left_tube:
            self._events += [LeftTube(vehicle=each, off_m=off_m) for each, off_m in left]
            left.clear()
        if inside := controller.inside:
            self._events += [InZone(vehicle=each, zone=zone) for each, zone in inside]
            inside.clear()
        # Last, for a horizon that was sent at this tick stands in place of a heartbeat.
        if owed:
            self._send_heartbeats(owed, now_ns)
        self._stopwatch.lap("encode")
        self.durations.add(self._stopwatch.total_ns - before_ns)

    def _tell_idle(self) -> None:
        """Tell the operator for which vehicles planning has stopped, and for which it goes on."""
        idle = self._controller.idle
        for row in np.flatnonzero(idle != self._sessions.idle).tolist():
            self._sessions.idle[row] = idle[row]
            vehicle, why = self._sessions.at(row).vehicle, Idle(idle[row])
            if why == Idle.PLANS:
                self._events.append(PlanningResumed(vehicle=vehicle))
            else:
                self._events.append(PlanningStopped(vehicle=vehicle, why=str(why)))

    def _send_horizons(self, decisions: Decisions, now_ns: int) -> None:
        sent, found = decisions.sent, decisions.found
        if self._terms.splines:
            self._send_trajectories(decisions, now_ns)
            return
        # Bytes of one input on all axes, and of what goes with a horizon.
        width = 4 * self._terms.axes
        feedback, told = NOTHING, 0
        if self._terms.feedback:
            feedback, told = found.feedback.data.cast("B"), width * FEEDBACK
        observed_step = self._controller.observed_step
        heads, inputs = self._packing.pack(
            found, sent, decisions.rows, decisions.step, observed_step
        )
        # The time of sending and not the tick's due time: the vehicle measures the delay by this
        # stamp.
        begin, server_us = 0, stamp_us(now_ns)
        for i, row, k, o, d in heads:
            session, end = self._sessions.at(row), begin + width * (d + self._terms.planned)
            payload = encode_horizon(
                session.vehicle,
                session.number,
                k,
                server_us,
                o,
                inputs[begin:end],
                feedback[i * told : (i + 1) * told],
                session.number_next(now_ns),
                session.hearing.silence,
            )
            begin = end
            self._send(session, payload, is_plan=True)

    def _send_trajectories(self, decisions: Decisions, now_ns: int) -> None:
        sent, told, axes = decisions.sent, decisions.found.told, self._terms.axes
        rows, back = decisions.rows[sent], told.back[sent]
        step = decisions.step[sent] - back
        age = step - self._controller.observed_step[rows]
        # A motion that is sent again is older than the newest observation, which it was not made
        # from. Any other may be too, where the server's clock was set and the clock map lags: then
        # the age is below 0, as a horizon's is, for it has to name an observation that was made.
        age = np.where(back > 0, np.maximum(age, 0), age)
        columns = (sent, rows, step, age, told.spacing[sent], told.number[sent])
        server_us = stamp_us(now_ns)
        for i, row, k, o, spacing, n in zip(*(each.tolist() for each in columns), strict=True):
            session, knots = self._sessions.at(row), told.knots[i, :, : 2 * n].reshape(axes, n, 2)
            message = Trajectory(
                session.vehicle,
                session.number,
                k,
                server_us,
                o,
                spacing,
                knots,
                session.number_next(now_ns),
                session.hearing.silence,
            )
            self._send(session, encode(message), is_plan=True)

    def _send_heartbeats(self, owed: Sequence[Session], now_ns: int) -> None:
        """Send a heartbeat to each vehicle that is owed one and was sent nothing at this tick."""
        for session in owed:
            if session.is_owed(now_ns):
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
                self._send(session, encode(beat), is_plan=False)

    def _send(self, session: Session, payload: bytes, *, is_plan: bool) -> None:
        datagrams, budget = session.sealed(payload), self._controller.budget
        self._out += datagrams
        if budget:
            # The line carries the headers of IP and UDP as well: 28 bytes, more than a whole
            # heartbeat.
            size = sum(len(each.payload) + HEADER_BYTES for each in datagrams)
            budget.charge(session.row, size, is_plan=is_plan)

    def _record(self, decisions: Decisions) -> None:
        if self._plans is not None and len(decisions.sent):
            self._record_plans(self._plans, decisions)
        if self._recorder is None:
            return
        rows, found, figures = decisions.rows, decisions.found, decisions.figures
        n = len(rows)
        self._recorder.append(
            n,
            vehicle=self._sessions.vehicle[rows],
            step=decisions.step,
            reference=self._controller.desired.now(rows, decisions.step),
            estimate=found.estimate[:n],
            ahead=found.ahead[:n],
            planned=decisions.planned,
            input=found.horizons[:n, :, 0],
            observed_step=self._controller.observed_step[rows],
            **self._figures(decisions),
            threshold=decisions.verdict.threshold,
            compared=decisions.verdict.compared,
            event=decisions.event,
            solved=figures["solved"],
            solve_ns=decisions.solve_ns,
            stale=[self._sessions.at(row).stale for row in rows.tolist()],
            missed=self._grid.missed,
        )
        self._stopwatch.lap("record")

    def _figures(self, decisions: Decisions) -> dict[str, Array | float]:
        """Figures of plans for the record: NaN where there is none."""
        figures, verdict, nothing = decisions.figures, decisions.verdict, float("nan")
        told: dict[str, Array | float] = {column: figures[column] for column in self._columns}
        solved = figures["solved"]
        if not solved.all():
            told = {name: np.where(solved, figure, nothing) for name, figure in told.items()}
        if EXPECTED_GAP in told and not decisions.found.doubt.size:
            told[EXPECTED_GAP] = nothing
        told[OWN] = verdict.figure if verdict.compared is Compared.OWN else nothing
        return told

    def _record_plans(self, plans: Recorder, decisions: Decisions) -> None:
        sent, found = decisions.sent, decisions.found
        step, ahead = decisions.step[sent], found.ahead[sent]
        if self._terms.splines:
            step = step - found.told.back[sent]
            knots = found.told.knots[sent].astype(np.float64)
            state: Array = knots[:, :, :2]
            inputs: NDArray[Any] = np.empty((len(sent), *self._bounds.shape, self._terms.horizon))
            inputs_along(
                self._model,
                self._bounds,
                self._terms.dt_s,
                knots,
                found.told.number[sent],
                found.told.spacing[sent],
                inputs,
            )
        else:
            # Behind d committed inputs, another d of each vehicle.
            stages = ahead[:, None] + np.arange(self._terms.planned)
            state = found.start[sent]
            inputs = np.take_along_axis(found.horizons[sent], stages[:, None], axis=2)
        plans.append(
            len(sent),
            vehicle=self._sessions.vehicle[decisions.rows[sent]],
            step=step,
            begins=step + ahead,
            state=state,
            inputs=inputs,
            disturbance=found.disturbance[sent],
        )
