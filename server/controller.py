"""The server: sessions of many vehicles, ticking together; what it does at a tick is the paper.

A tick goes, for all vehicles in one batch, through

    which step is it aboard (`clock`) → x̂(k) (`estimator`) → event? (`trigger`)
    → X_p(k), U(k) (`planner`) → û(k) remembered → a packet where there is an event.

Ticks lie on the server's own grid of Δt with absolute deadlines; a tick whose time has passed is
skipped and counted, never caught up with.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from server.clock import ClockMap
from server.estimator import Estimator
from server.planner import Planner
from server.trigger import make_trigger
from shared.config import Scenario
from shared.endpoint import (
    MILLISECOND_NS,
    SECOND_NS,
    Address,
    Datagram,
    Endpoint,
    seconds_to_ns,
)
from shared.model import Flags, Indices, discretise
from shared.protocol import (
    Heartbeat,
    Hello,
    Horizon,
    Observation,
    ProtocolError,
    Welcome,
    decode,
    encode,
)
from shared.record import Recorder

VEHICLES_MAX = 64
"""Sessions at once; the server has no room for further vehicles."""
SESSION_NS = 30 * SECOND_NS
"""A vehicle unheard for so long is forgotten."""
REACH_S = 2.0
"""Observations older than this are no base for an estimate."""


@dataclass(slots=True)
class Session:
    """One life of one vehicle; its numbers live in row `row` of every batch."""

    vehicle: int
    session: int
    boot_id: int
    row: int
    address: Address
    """Where its newest observation came from."""
    heard_ns: int
    sent_ns: int
    epoch_ns: int = -1
    """Its step 0 [vehicle's clock]; -1 until the first observation."""
    observed_ns: int = -1
    """Stamp of its newest observation [vehicle's clock]."""


class Server(Endpoint):
    """Plans for every vehicle that asks.

    Args:
        scenario: what to fly, and how to plan.
        boot_id: a number that no other life of the server has had.
        recorder: takes one row a tick and vehicle.
        stopwatch_ns: a clock to measure solving with; the core has none of its own.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        boot_id: int,
        recorder: Recorder | None = None,
        stopwatch_ns: Callable[[], int] | None = None,
    ) -> None:
        super().__init__()
        control, model = scenario.control, discretise(scenario.tau_s, scenario.control.dt)
        self._terms = scenario.terms()
        self._dt_ns = scenario.dt_ns
        self._heartbeat_ns = seconds_to_ns(scenario.link.heartbeat_s)
        self._boot_id = boot_id
        self._recorder = recorder
        self._stopwatch_ns = stopwatch_ns
        self._clock = ClockMap(VEHICLES_MAX, self._dt_ns)
        self._estimator = Estimator(
            model,
            VEHICLES_MAX,
            reach=max(1, round(REACH_S / control.dt)),
            compensate=control.scheme == "paper",
        )
        self._planner = Planner(scenario, model, VEHICLES_MAX)
        self._trigger = make_trigger(control, VEHICLES_MAX)
        self._last_step = np.full(VEHICLES_MAX, -1, dtype=np.int64)
        self._stale = np.zeros(VEHICLES_MAX, dtype=np.int64)
        self._sessions: dict[int, Session] = {}
        """By vehicle."""
        self._welcomed: dict[int, Session] = {}
        """New lives of vehicles, until their first observation; by vehicle."""
        self._opened = 0
        self._due_ns: int | None = None
        self.missed = 0
        self.counts: Counter[str] = Counter()

    # -- datagrams ---------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """HELLO opens a session, OBSERVATION feeds it; anything else is dropped and counted."""
        try:
            match decode(datagram.payload, self._terms):
                case Hello() as hello:
                    self._hello(hello, datagram.peer, now_ns)
                case Observation() as observation:
                    self._observe(observation, datagram.peer, now_ns)
                case _:
                    raise ProtocolError("not for a server")
        except ProtocolError as error:
            self.counts[f"dropped: {error.reason}"] += 1

    def _hello(self, hello: Hello, address: Address, now_ns: int) -> None:
        if hello.terms != self._terms:
            difference = self._terms.against(hello.terms)
            self._news.append(f"vehicle {hello.vehicle} flies another scenario: {difference}")
            self._welcome(hello, 0, address, now_ns)
            return
        for known in (self._sessions, self._welcomed):
            session = known.get(hello.vehicle)
            if session is not None and session.boot_id == hello.boot_id:
                self._welcome(hello, session.session, address, now_ns)
                return
        taken = self._sessions.keys() | self._welcomed.keys()
        if hello.vehicle not in taken and len(taken) >= VEHICLES_MAX:
            if not self._welcomed:
                raise ProtocolError("no room for another vehicle")
            del self._welcomed[next(iter(self._welcomed))]  # the oldest that never came
        # The session of an earlier life goes on until this one proves to be heard.
        self._opened += 1
        number = (self._boot_id + self._opened) % 2**32
        self._welcomed[hello.vehicle] = Session(
            hello.vehicle, number, hello.boot_id, -1, address, now_ns, now_ns
        )
        self._welcome(hello, number, address, now_ns)

    def _welcome(self, hello: Hello, session: int, address: Address, now_ns: int) -> None:
        welcome = Welcome(hello.vehicle, session, hello.boot_id, self._boot_id, now_ns, self._terms)
        self._out.append(Datagram(encode(welcome), address))

    def _observe(self, observation: Observation, address: Address, now_ns: int) -> None:
        session = self._sessions.get(observation.vehicle)
        if session is None or session.session != observation.session:
            session = self._begin(observation)
        session.heard_ns = now_ns
        self._clock.observe(
            session.row,
            now_ns - observation.stamp_ns,
            observation.received_ns - observation.server_ns,
            now_ns=now_ns,
        )
        if not self._estimator.observe(session.row, observation.step, observation.state):
            self._stale[session.row] += 1
            return
        session.address = address
        session.epoch_ns = observation.stamp_ns - observation.step * self._dt_ns
        session.observed_ns = observation.stamp_ns
        if self._due_ns is None:
            self._due_ns = (now_ns // self._dt_ns + 1) * self._dt_ns

    def _begin(self, observation: Observation) -> Session:
        """The welcomed session of a first observation, now live."""
        session = self._welcomed.get(observation.vehicle)
        if session is None or session.session != observation.session:
            raise ProtocolError("unknown session")
        del self._welcomed[observation.vehicle]
        before = self._sessions.get(session.vehicle)
        taken = {other.row for other in self._sessions.values()}
        session.row = (
            next(row for row in range(VEHICLES_MAX) if row not in taken)
            if before is None
            else before.row
        )
        self._sessions[session.vehicle] = session
        self._clock.forget(session.row)
        self._estimator.forget(session.row)
        self._planner.forget(session.row)
        self._last_step[session.row] = -1
        self._stale[session.row] = 0
        host, port = session.address
        self._news.append(f"vehicle {session.vehicle} flies, from {host}:{port}")
        return session

    # -- time --------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        """The next tick, while there is anybody to tick for."""
        return self._due_ns

    def wake(self, *, now_ns: int) -> None:
        """The tick that is due; those that were slept through are only counted."""
        if self._due_ns is None or now_ns < self._due_ns:
            return
        late = (now_ns - self._due_ns) // self._dt_ns
        self.missed += late
        tick_ns = self._due_ns + late * self._dt_ns
        self._due_ns = tick_ns + self._dt_ns
        self._expire(now_ns)
        if self._sessions:
            self._tick(tick_ns, now_ns)
        else:
            self._due_ns = None

    def _expire(self, now_ns: int) -> None:
        for session in list(self._sessions.values()):
            if now_ns - session.heard_ns > SESSION_NS:
                del self._sessions[session.vehicle]
                self._news.append(f"vehicle {session.vehicle} is gone")

    def _tick(self, tick_ns: int, now_ns: int) -> None:
        sessions = list(self._sessions.values())
        rows = np.array([session.row for session in sessions], dtype=np.int64)
        epochs = np.array([session.epoch_ns for session in sessions], dtype=np.int64)
        step = (tick_ns + self._clock.offset_ns(rows) - epochs) // self._dt_ns
        able: Flags = (step > self._last_step[rows]) & self._estimator.within_reach(rows, step)
        flying = [session for session, yes in zip(sessions, able, strict=True) if yes]
        if flying:
            self._control(flying, rows[able], step[able], now_ns)
        for session in sessions:
            if now_ns - session.sent_ns >= self._heartbeat_ns:
                self._send(session, Heartbeat(session.vehicle, session.session, now_ns), now_ns)

    def _control(self, sessions: list[Session], rows: Indices, step: Indices, now_ns: int) -> None:
        """Algorithms 1 and 2 of the paper, for the vehicles in `rows` at their steps k."""
        self._last_step[rows] = step
        estimate = self._estimator.estimate(rows, step)  # (13)
        planned, fresh = self._planner.planned(rows, step, estimate)
        verdict = self._trigger.test(rows, step, estimate, planned, fresh)  # (16)
        began_ns = self._stopwatch_ns() if self._stopwatch_ns else 0
        plan = self._planner.plan(rows, step, estimate, planned, fresh)  # (14), (15)
        solve_ns = self._stopwatch_ns() - began_ns if self._stopwatch_ns else -1
        self._estimator.remember(rows, step, plan.inputs[:, :, 0])  # (12)
        event = verdict.event & plan.solved
        self._trigger.sent(rows[event], step[event], verdict.error[event])
        for i in np.flatnonzero(event):
            session = sessions[i]
            horizon = Horizon(
                session.vehicle,
                session.session,
                int(step[i]),
                now_ns,
                session.observed_ns,
                plan.inputs[i].astype(np.float32),
            )
            self._send(session, horizon, now_ns)
        self.counts["steps"] += len(rows)
        self.counts["events"] += int(event.sum())
        self.counts["unsolved"] += int((~plan.solved).sum())
        if self._recorder is None:
            return
        self._recorder.append(
            len(rows),
            vehicle=[session.vehicle for session in sessions],
            step=step,
            estimate=estimate,
            planned=planned,
            input=plan.inputs[:, :, 0],
            observed_step=self._estimator.observed_step[rows],
            error=verdict.error,
            threshold=verdict.threshold,
            event=event,
            solved=plan.solved,
            solve_ns=solve_ns,
            stale=self._stale[rows],
            missed=self.missed,
        )

    def _send(self, session: Session, message: Horizon | Heartbeat, now_ns: int) -> None:
        session.sent_ns = now_ns
        self._out.append(Datagram(encode(message), session.address))

    def report(self) -> str:
        """See `Endpoint`."""
        counts = ", ".join(f"{value} {name}" for name, value in sorted(self.counts.items()))
        here = f"{len(self._sessions)} in session, {self.missed} ticks missed"
        lines = [f"{here}, {counts or 'no steps'}"]
        for session in self._sessions.values():
            step = self._last_step[session.row]
            bound_ms = self._clock.bound_ns(np.array([session.row]))[0] / MILLISECOND_NS
            lines.append(f"vehicle {session.vehicle}: step {step}, clock within {bound_ms:.1f} ms")
        return "\n".join(lines)
