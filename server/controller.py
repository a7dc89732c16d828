"""The server: sessions of many vehicles, ticking together; what it does at a tick is the paper.

A tick goes, for all vehicles in one batch, through

    which step is it aboard (`clock`) → x̂(k), x̂(k+d) (`replay` or `estimator`) → event? (`trigger`)
    → X_p(k+d), U(k+d) (`planner`) → event? → a packet where there is one, remembered.

The trigger is asked twice: nothing is planned for a vehicle that it would send nothing in any case,
and what depends on the new plan is asked once there is one. With the paper's schemes d is 0, and
every vehicle is planned for at every step.

Ticks lie on the server's own grid of Δt with absolute deadlines; a tick whose time has passed is
skipped and counted, never caught up with.
"""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cache
from heapq import heappop, heappush
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.clock import ClockMap
from server.estimator import Estimator
from server.planner import Planner
from server.replay import Replay
from server.scheme import Foresight, Scheme
from server.trigger import Situation, Verdict, make_trigger
from shared.config import Scenario
from shared.endpoint import (
    MILLISECOND_NS,
    SECOND_NS,
    VEHICLES_TOLD_MAX,
    Address,
    Datagram,
    Endpoint,
    seconds_to_ns,
)
from shared.events import SessionEnded, SessionOpened, SessionRefused
from shared.histogram import Histogram
from shared.model import Array, Flags, Indices, discretise
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
from shared.stopwatch import Stopwatch

VEHICLES_MAX = 64
"""Sessions at once, unless room is made for more."""
SESSION_NS = 30 * SECOND_NS
"""A vehicle unheard for so long is forgotten."""
REACH_S = 2.0
"""Observations older than this are no base for an estimate."""
BLOCK = 128
"""Vehicles that are planned for at a time: what belongs to them stays in the cache, and no array is
so large (128 KiB) that the C library would ask the kernel for its memory, and fault it in, anew."""
TICK_BIN_NS = MILLISECOND_NS // 20


@dataclass(slots=True)
class Session:
    """One life of one vehicle; its numbers live in row `row` of every batch."""

    vehicle: int
    session: int
    boot_id: int
    address: Address
    """Where its newest observation came from."""
    row: int = -1
    """-1 until the first observation."""
    observed_ns: int = -1
    """Stamp of its newest observation [vehicle's clock]."""


class Server(Endpoint):
    """Plans for every vehicle that asks.

    Args:
        scenario: what to fly, and how to plan.
        boot_id: a number that no other life of the server has had.
        room: for how many vehicles at once.
        recorder: takes one row a tick and vehicle.
        stopwatch: measures the parts of a tick; the core has no clock of its own.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        boot_id: int,
        room: int = VEHICLES_MAX,
        recorder: Recorder | None = None,
        stopwatch: Stopwatch | None = None,
    ) -> None:
        super().__init__()
        control, model = scenario.control, discretise(scenario.tau_s, scenario.control.dt)
        self._terms = scenario.terms()
        self._dt_ns = scenario.dt_ns
        self._heartbeat_ns = seconds_to_ns(scenario.link.heartbeat_s)
        self._boot_id = boot_id
        self._room = room
        self._recorder = recorder
        self.stopwatch = stopwatch or Stopwatch()
        self._clock = ClockMap(room, self._dt_ns)
        reach = max(1, round(REACH_S / control.dt))
        self._scheme: Scheme = (
            Replay(scenario, model, room, reach, self._clock)
            if control.commits
            else Estimator(model, room, reach, compensate=control.scheme == "predictive")
        )
        self._planner = Planner(scenario, model, room, self.stopwatch)
        self._trigger = make_trigger(control, room)
        self._vehicle = np.zeros(room, dtype=np.int64)
        self._epoch_ns = np.zeros(room, dtype=np.int64)
        """Step 0 of each [vehicle's clock]."""
        self._heard_ns = np.zeros(room, dtype=np.int64)
        self._sent_ns = np.zeros(room, dtype=np.int64)
        self._stale = np.zeros(room, dtype=np.int64)
        self._last_step = np.full(room, -1, dtype=np.int64)
        """The step of each that was ticked last, or -1."""
        self._sessions: dict[int, Session] = {}
        """By vehicle."""
        self._welcomed: dict[int, Session] = {}
        """New lives of vehicles, until their first observation; by vehicle."""
        self._by_row: dict[int, Session] = {}
        self._free_rows = list(range(room))
        """A heap: what is in use lies close together."""
        self._rows: Indices = np.zeros(0, dtype=np.int64)
        """Those in use, rising."""
        self._opened = 0
        self._due_ns: int | None = None
        self._expire_ns = 0
        """When to look for vehicles that are gone."""
        self.missed = 0
        self.ticks = Histogram(TICK_BIN_NS)
        """How long each took, as far as the stopwatch runs."""
        self.counts: Counter[str] = Counter()

    # -- datagrams ---------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """HELLO opens a session, OBSERVATION feeds it; anything else is dropped and counted."""
        self.stopwatch.start()
        try:
            message = decode(datagram.payload, self._terms)
            self.stopwatch.lap("decode")
            if isinstance(message, Observation):
                self._observe(message, datagram.peer, now_ns)
            elif isinstance(message, Hello):
                self._hello(message, datagram.peer, now_ns)
            else:
                raise ProtocolError("not for a server")
        except ProtocolError as error:
            self.counts[f"dropped: {error.reason}"] += 1
        self.stopwatch.lap("observe")

    def _hello(self, hello: Hello, address: Address, now_ns: int) -> None:
        if hello.terms != self._terms:
            differences = self._terms.differences(hello.terms)
            self._events.append(SessionRefused(vehicle=hello.vehicle, differences=differences))
            self._welcome(hello, 0, address, now_ns)
            return
        for known in (self._sessions, self._welcomed):
            session = known.get(hello.vehicle)
            if session is not None and session.boot_id == hello.boot_id:
                self._welcome(hello, session.session, address, now_ns)
                return
        taken = self._sessions.keys() | self._welcomed.keys()
        if hello.vehicle not in taken and len(taken) >= self._room:
            if not self._welcomed:
                raise ProtocolError("no room for another vehicle")
            del self._welcomed[next(iter(self._welcomed))]  # the oldest that never came
        # The session of an earlier life goes on until this one proves to be heard.
        self._opened += 1
        number = (self._boot_id + self._opened) % 2**32
        self._welcomed[hello.vehicle] = Session(hello.vehicle, number, hello.boot_id, address)
        self._welcome(hello, number, address, now_ns)

    def _welcome(self, hello: Hello, session: int, address: Address, now_ns: int) -> None:
        welcome = Welcome(hello.vehicle, session, hello.boot_id, self._boot_id, now_ns, self._terms)
        self._out.append(Datagram(encode(welcome), address))

    def _observe(self, observation: Observation, address: Address, now_ns: int) -> None:
        session = self._sessions.get(observation.vehicle)
        if session is None or session.session != observation.session:
            session = self._begin(observation, now_ns)
        row = session.row
        self._heard_ns[row] = now_ns
        self._clock.observe(
            row,
            now_ns - observation.stamp_ns,
            observation.received_ns - observation.server_ns,
            now_ns=now_ns,
        )
        if not self._scheme.observe(row, observation):
            self._stale[row] += 1
            return
        session.address = address
        session.observed_ns = observation.stamp_ns
        self._epoch_ns[row] = observation.stamp_ns - observation.step * self._dt_ns
        if self._due_ns is None:
            self._due_ns = -(-now_ns // self._dt_ns) * self._dt_ns  # the next of the grid, or now

    def _begin(self, observation: Observation, now_ns: int) -> Session:
        """The welcomed session of a first observation, now live."""
        session = self._welcomed.get(observation.vehicle)
        if session is None or session.session != observation.session:
            raise ProtocolError("unknown session")
        del self._welcomed[observation.vehicle]
        before = self._sessions.get(session.vehicle)
        row = session.row = heappop(self._free_rows) if before is None else before.row
        self._sessions[session.vehicle] = self._by_row[row] = session
        self._rows = np.array(sorted(self._by_row), dtype=np.int64)
        self._vehicle[row] = session.vehicle
        self._sent_ns[row] = now_ns
        self._stale[row] = 0
        self._clock.forget(row)
        self._last_step[row] = -1
        self._scheme.forget(row)
        self._planner.forget(row)
        host, port = session.address
        self._events.append(SessionOpened(vehicle=session.vehicle, host=host, port=port))
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
        if now_ns >= self._expire_ns:
            # On the grid of its clock: a vehicle is forgotten at the same time in any company.
            self._expire_ns = (now_ns // SECOND_NS + 1) * SECOND_NS
            self._expire(now_ns)
        if self._sessions:
            self._tick(tick_ns, now_ns)
        else:
            self._due_ns = None

    def _expire(self, now_ns: int) -> None:
        gone = self._rows[now_ns - self._heard_ns[self._rows] > SESSION_NS].tolist()
        for row in gone:
            session = self._by_row.pop(row)
            del self._sessions[session.vehicle]
            heappush(self._free_rows, row)
            self._events.append(SessionEnded(vehicle=session.vehicle))
        if gone:
            self._rows = np.array(sorted(self._by_row), dtype=np.int64)

    def _tick(self, tick_ns: int, now_ns: int) -> None:
        self.stopwatch.start()
        before_ns = self.stopwatch.spent_ns.total()
        rows = self._rows
        step = (tick_ns + self._clock.offset_ns(rows) - self._epoch_ns[rows]) // self._dt_ns
        able: Flags = (step > self._last_step[rows]) & self._scheme.within_reach(rows, step)
        able_rows, able_step = rows[able], step[able]
        for first in range(0, len(able_rows), BLOCK):
            block = slice(first, first + BLOCK)
            self._control(able_rows[block], able_step[block], now_ns)
        for row in rows[now_ns - self._sent_ns[rows] >= self._heartbeat_ns].tolist():
            session = self._by_row[row]
            self._send(session, Heartbeat(session.vehicle, session.session, now_ns), now_ns)
        self.stopwatch.lap("encode")
        self.ticks.add(self.stopwatch.spent_ns.total() - before_ns)

    def _control(self, rows: Indices, step: Indices, now_ns: int) -> None:
        """Algorithms 1 and 2 of the paper, for the vehicles in `rows` at their steps k."""
        foresight = self._scheme.foresee(rows, step)  # (13)
        self._last_step[rows] = step
        self.counts["steps"] += len(rows)
        self.stopwatch.lap("estimate")
        start = step + foresight.ahead
        planned, fresh = self._planner.planned(rows, start, foresight.start)

        @cache
        def deviation_m() -> Array:
            return self._planner.deviation_m(
                rows, start, foresight.start, foresight.held, foresight.disturbance
            )

        situation = Situation(rows, step, fresh, foresight.start, planned, deviation_m)
        verdict = self._trigger.test(situation)  # (16)
        self.stopwatch.lap("trigger")
        asked = verdict.perhaps | self._scheme.plans_always
        if asked.all():
            self._plan(situation, foresight, verdict, now_ns)
            return
        some, others = np.flatnonzero(asked), np.flatnonzero(~asked)
        idle = foresight.of(others)
        self._record(situation.of(others), idle, verdict.of(others), idle.committed[:, :, 0])
        if len(some):
            self._plan(situation.of(some), foresight.of(some), verdict.of(some), now_ns)

    def _plan(
        self, situation: Situation, foresight: Foresight, verdict: Verdict, now_ns: int
    ) -> None:
        """Plan for vehicles that the trigger asks it for, and send what it wants sent."""
        stopwatch, rows, step = self.stopwatch, situation.rows, situation.step
        plan = self._planner.plan(  # (14), (15)
            *(rows, step + foresight.ahead, foresight.start),
            *(situation.planned, situation.fresh, foresight.disturbance),
        )
        undecided = np.flatnonzero(verdict.perhaps != verdict.surely)
        if len(undecided):  # of the others nothing is found out, as if they were alone

            def cost_gap() -> Array:
                return self._planner.cost_gap(rows[undecided], foresight.held[undecided])

            now_known = replace(situation.of(undecided), cost_gap=cost_gap)
            verdict = verdict.settled(undecided, self._trigger.test(now_known))
        event = verdict.surely & plan.solved
        sent = np.flatnonzero(event)
        horizons, lengths = foresight.horizons(plan.inputs), foresight.ahead + self._terms.horizon
        self._scheme.remember(rows, step, foresight, horizons, sent)  # (12)
        self._trigger.sent(rows[sent], step[sent], verdict.error[sent])
        stopwatch.lap("plan")
        of_each = (sent, rows[sent], step[sent], lengths[sent])
        for i, row, k, length in zip(*map(np.ndarray.tolist, of_each), strict=True):
            session, inputs = self._by_row[row], horizons[i, :, :length]
            horizon = Horizon(
                *(session.vehicle, session.session, k, now_ns, session.observed_ns),
                *(inputs, foresight.feedback[i]),
            )
            self._send(session, horizon, now_ns)
        self.counts["events"] += len(sent)
        self.counts["unsolved"] += len(rows) - int(plan.solved.sum())
        stopwatch.lap("encode")
        now = horizons[:, :, 0]
        self._record(situation, foresight, verdict, now, event, plan.solved, plan.solve_ns)

    def _record(  # noqa: PLR0917 - all that was found out
        self,
        situation: Situation,
        foresight: Foresight,
        verdict: Verdict,
        input_: Array | NDArray[np.float32],
        event: Flags | bool = False,
        solved: Flags | bool = True,
        solve_ns: int = -1,
    ) -> None:
        if self._recorder is None:
            return
        rows = situation.rows
        self._recorder.append(
            len(rows),
            vehicle=self._vehicle[rows],
            step=situation.step,
            estimate=foresight.estimate,
            ahead=foresight.ahead,
            planned=situation.planned,
            input=input_,
            observed_step=self._scheme.observed_step[rows],
            error=verdict.error,
            threshold=verdict.threshold,
            event=event,
            solved=solved,
            solve_ns=solve_ns,
            stale=self._stale[rows],
            missed=self.missed,
        )
        self.stopwatch.lap("record")

    def _send(self, session: Session, message: Horizon | Heartbeat, now_ns: int) -> None:
        self._sent_ns[session.row] = now_ns
        self._out.append(Datagram(encode(message), session.address))

    def _counted(self) -> Counter[str]:
        return Counter({**self.counts, **self._scheme.counts})

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        each: dict[str, Any] = {}
        for session in islice(self._sessions.values(), VEHICLES_TOLD_MAX):
            bound_ns = self._clock.bound_ns(np.array([session.row]))[0]
            each[f"vehicle {session.vehicle}"] = {
                "step": int(self._last_step[session.row]),
                "clock_bound_ms": float(bound_ns) / MILLISECOND_NS,
            }
        if len(self._sessions) > VEHICLES_TOLD_MAX:
            each["and more"] = len(self._sessions) - VEHICLES_TOLD_MAX
        return {
            "vehicles": len(self._sessions),
            "missed": self.missed,
            "tick_ms_p50": self.ticks.quantile_ms(0.5),
            "tick_ms_p99": self.ticks.quantile_ms(0.99),
            "spent_ns": dict(self.stopwatch.spent_ns),
            "counts": dict(self._counted()),
            "each": each,
        }
