"""The server as an endpoint: datagrams in, datagrams out, and a tick on its own grid of Δt.

At a tick, for all vehicles in session: which step is it aboard (`clock`), what to do about it
(`controller`), and a packet where there is one. Ticks have absolute deadlines; one whose time has
passed is skipped and counted, never caught up with.
"""

from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from server.clock import ClockMap
from server.controller import BLOCK, Controller, Decisions
from server.gate import Call, Gate, Plain
from server.plausibility import ANEW, BELIEVED, Plausibility, Verdict
from server.scheme import in_a_row
from server.sessions import Session, Sessions
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
from shared.events import (
    Degraded,
    Event,
    NumberTaken,
    PlanningResumed,
    PlanningStopped,
    ServerFull,
    SessionEnded,
    SessionOpened,
    SessionRefused,
    Unauthenticated,
    address_text,
)
from shared.histogram import Histogram
from shared.protocol import (
    ACCEPTED,
    CLOSES,
    FEEDBACK,
    FULL,
    OTHER_TERMS,
    REFUSALS,
    TAKEN,
    Close,
    Heartbeat,
    Hello,
    Idle,
    Message,
    Observation,
    ProtocolError,
    Welcome,
    decode,
    encode,
    encode_horizon,
)
from shared.record import Recorder
from shared.reference import Reference
from shared.stopwatch import Stopwatch
from shared.terms import keys_of

VEHICLES_MAX = 64
"""Vehicles at once, unless room is made for more."""
REFUSALS_TOLD_MAX = 64
"""Newest refusals that are remembered, so as not to tell the operator of each HELLO anew."""
TELL_NS = 10 * SECOND_NS
"""Time from one word about datagrams of strangers to the next [ns]."""
MISSES_MAX = 5
"""Number of ticks that may be missed in a second before the server calls itself degraded."""
TICK_BIN_NS = MILLISECOND_NS // 20
"""Resolution at which the length of a tick is counted [ns]."""
TICK_EDGES_MS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
"""Edges between which ticks are counted for those who draw them over time [ms]."""


TRIGGER = keys_of("the server's: when it sends")
"""Keys of when horizons are sent."""
POINT = frozenset({"reference.points_m", "reference.velocity_mps"})
"""Keys of a point that is led by hand."""


class Server(Endpoint):
    """Plans for every vehicle that asks.

    Args:
        scenario: what to fly, and how to plan.
        boot_id: a number that no other life of the server has had.
        entropy: makes so many random bytes.
        gate: who may speak, and how.
        room: for how many vehicles at once.
        recorder: takes one row a tick and vehicle.
        plans: takes one row for each horizon that is sent, see `shared.record.plan_columns`.
        stopwatch: measures the parts of a tick; the core has no clock of its own.
        references: desired trajectory of each vehicle, by its number, where they differ; left out:
            the scenario's for all.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        boot_id: int,
        entropy: Callable[[int], bytes],
        gate: Gate | None = None,
        room: int = VEHICLES_MAX,
        recorder: Recorder | None = None,
        plans: Recorder | None = None,
        stopwatch: Stopwatch | None = None,
        references: Callable[[int], Reference] | None = None,
    ) -> None:
        super().__init__()
        self.changeable = TRIGGER | POINT if scenario.reference.shape == "live" else TRIGGER
        self._terms = scenario.terms()
        self._heartbeat_ns = seconds_to_ns(self._terms.heartbeat_s)
        self._boot_id = boot_id
        self._gate = gate or Plain()
        self._recorder, self._plans = recorder, plans
        self.stopwatch = stopwatch or Stopwatch()
        self._clock = ClockMap(room, self._terms.dt_ns)
        self._plausibility = Plausibility(self._terms, room)
        self.controller = Controller(
            scenario, self._terms, room, self._clock, self.stopwatch, references
        )
        self.sessions = Sessions(room, entropy, seconds_to_ns(scenario.link.timeout_s))
        """Who flies."""
        self._idle = np.zeros(room, dtype=np.int64)
        """Why no plan is made for each vehicle, as it was told last; shape (room,)."""
        self._due_ns: int | None = None
        self._expire_ns = 0
        """When to look for vehicles that are gone."""
        self.missed = 0
        """Number of ticks that were slept through."""
        self.observations = 0
        """Number of observations that were believed, in whatever order they came."""
        self.ticks = Histogram(TICK_BIN_NS)
        """How long each tick took, as far as the stopwatch runs."""
        self._dropped: Counter[str] = Counter()
        """Number of datagrams dropped, and of vehicles refused, by reason."""
        self._told: deque[tuple[int, int, int]] = deque(maxlen=REFUSALS_TOLD_MAX)
        """Vehicle, boot id and refusal of the newest refusals that the operator was told."""
        self._strangers = 0
        """Number of datagrams that the gate has not let pass."""
        self._tell_ns = 0
        """When the operator may be told of these again."""
        self._missed_ns: deque[int] = deque(maxlen=MISSES_MAX + 1)
        """Times of the newest ticks that were missed."""
        self._degraded = False

    # -- datagrams ---------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """HELLO opens a session, OBSERVATION feeds it, CLOSE ends it; all else is only counted."""
        self.stopwatch.start()
        try:
            call = self._gate.open(datagram, now_ns=now_ns)
        except ProtocolError as error:
            self._dropped[f"dropped: {error.reason}"] += 1
            self._strangers += 1
            if now_ns >= self._tell_ns:
                self._tell_of_strangers(datagram.peer, error.reason, now_ns)
            return
        finally:
            self.stopwatch.lap("open")
        if call is None:
            self._out += self._gate.outbox()
            return
        try:
            self._hear(call, datagram.peer, now_ns)
        except ProtocolError as error:
            self._dropped[f"dropped: {error.reason}"] += 1
        self.stopwatch.lap("observe")

    def _hear(self, call: Call, address: Address, now_ns: int) -> None:
        """Take one message.

        Raises:
            ProtocolError: it is not one of a vehicle's, or not its own.
        """
        message = decode(call.payload, self._terms)
        self.stopwatch.lap("decode")
        if call.vehicle not in (None, message.vehicle):
            raise ProtocolError("of another vehicle")
        match message:
            case Observation():
                self._observe(message, call, address, now_ns)
            case Hello():
                self._hello(message, call, address, now_ns)
            case Close():
                self.sessions.end(message.vehicle, message.session)
                self._events.append(SessionEnded(vehicle=message.vehicle))
            case _:
                raise ProtocolError("not for a server")

    def _tell_of_strangers(self, address: Address, reason: str, now_ns: int) -> None:
        host, port = address
        told = Unauthenticated(count=self._strangers, host=host, port=port, reason=reason)
        self._events.append(told)
        self._tell_ns = now_ns + TELL_NS

    def _hello(self, hello: Hello, call: Call, address: Address, now_ns: int) -> None:
        refusal, number = self._refusal(hello, address, now_ns), 0
        if refusal == ACCEPTED:
            number = self.sessions.welcome(hello, address, call.line, now_ns).number
        welcome = Welcome(
            hello.vehicle, number, hello.boot_id, self._boot_id, now_ns, refusal, self._terms
        )
        self._out.append(Datagram(call.line.seal(encode(welcome)), address))
        if refusal == ACCEPTED:
            self._gate.admit(call, now_ns=now_ns)

    def _refusal(self, hello: Hello, address: Address, now_ns: int) -> int:
        """Why a HELLO is refused, if not ACCEPTED; the operator is told once a life and reason."""
        vehicle, (host, port) = hello.vehicle, address
        event: Event
        if hello.terms != self._terms:
            refusal, differences = OTHER_TERMS, self._terms.differences(hello.terms)
            event = SessionRefused(vehicle=vehicle, differences=differences)
        elif (holder := self.sessions.holder(hello, now_ns)) is not None:
            refusal, holder_at = TAKEN, address_text(*holder.address)
            event = NumberTaken(vehicle=vehicle, host=host, port=port, holder=holder_at)
        elif self.sessions.is_full(hello, now_ns):
            refusal, room = FULL, len(self.sessions.vehicle)
            event = ServerFull(vehicle=vehicle, host=host, port=port, room=room)
        else:
            return ACCEPTED
        self._dropped[f"refused: {REFUSALS[refusal]}"] += 1
        told = vehicle, hello.boot_id, refusal
        if told not in self._told:
            self._told.append(told)
            self._events.append(event)
        return refusal

    def _observe(self, observation: Observation, call: Call, address: Address, now_ns: int) -> None:
        session = self.sessions.find(observation) or self._begin(observation, call, now_ns)
        row, stamp_ns, echo_ns = session.row, observation.stamp_ns, observation.server_ns
        epoch_ns = stamp_ns - observation.step * self._terms.dt_ns
        forward_ns, backward_ns = now_ns - stamp_ns, observation.received_ns - echo_ns
        verdict = self._plausibility.judge(row, observation, epoch_ns, forward_ns, backward_ns)
        if verdict > BELIEVED:
            raise ProtocolError(f"implausible: {Verdict(verdict).name.lower()}")
        if verdict == ANEW:
            self._anew(row)
        session.heard_ns = now_ns
        self.observations += 1
        self._clock.observe(row, forward_ns, backward_ns, echo_ns=echo_ns, now_ns=now_ns)
        if not self.controller.observe(row, observation):
            session.stale += 1
            return
        if call.moves:
            session.address, session.line = address, call.line
        session.observed_ns = stamp_ns
        self._clock.epoch_ns[row] = epoch_ns
        dt_ns = self._terms.dt_ns
        if self._due_ns is None or self._due_ns > now_ns + dt_ns:  # also where our clock went back
            self._due_ns = -(-now_ns // dt_ns) * dt_ns  # the next, or now

    def _anew(self, row: int) -> None:
        """Forget all that is known of a vehicle but its session."""
        self._clock.forget(row)
        self.controller.forget(row)
        self._idle[row] = Idle.PLANS

    def _begin(self, observation: Observation, call: Call, now_ns: int) -> Session:
        """The session of a first observation, now live."""
        session = self.sessions.begin(observation, now_ns)
        session.line = call.line
        self._plausibility.forget(session.row)
        self._anew(session.row)
        self.controller.desired.assign(session.row, session.vehicle)
        host, port = session.address
        self._events.append(SessionOpened(vehicle=session.vehicle, host=host, port=port))
        return session

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        """See `Endpoint`; the terms of the flight stay as they were agreed upon."""
        if keys & TRIGGER:
            self.controller.change_trigger(scenario.control)
        if keys & POINT:
            moved = "reference.points_m" in keys
            position = scenario.make_reference()(np.zeros(()))[:, 0] if moved else None
            velocity = np.array(scenario.reference.velocity_mps)
            self.controller.desired.move(position, velocity if velocity.size else None, now_ns)

    # -- time --------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        """When the next tick is due, while there is anybody to tick for."""
        return self._due_ns

    def wake(self, *, now_ns: int) -> None:
        """The tick that is due; those that were slept through are only counted."""
        if self._due_ns is None or now_ns < self._due_ns:
            return
        dt_ns = self._terms.dt_ns
        late = (now_ns - self._due_ns) // dt_ns
        self.missed += late
        self._note_missed(late, now_ns)
        tick_ns = self._due_ns + late * dt_ns
        self._due_ns = tick_ns + dt_ns
        if now_ns >= self._expire_ns:
            # On the grid of its clock: a vehicle is forgotten at the same time in any company.
            self._expire_ns = (now_ns // SECOND_NS + 1) * SECOND_NS
            for session in self.sessions.expire(now_ns):
                self._events.append(SessionEnded(vehicle=session.vehicle))
        if len(self.sessions):
            self._tick(tick_ns, now_ns)
        else:
            self._due_ns = None

    def _note_missed(self, count: int, now_ns: int) -> None:
        """Note the ticks that were missed, and whether these are too many in a second."""
        self._missed_ns += [now_ns] * min(count, MISSES_MAX + 1)
        many = len(self._missed_ns) > MISSES_MAX and now_ns - self._missed_ns[0] <= SECOND_NS
        if many != self._degraded:
            self._degraded = many
            self._events.append(Degraded(degraded=many))

    def _tick(self, tick_ns: int, now_ns: int) -> None:
        self.stopwatch.start()
        before_ns = self.stopwatch.spent_ns.total()
        rows = self.sessions.rows
        step = self._clock.steps(rows, tick_ns)
        self.controller.desired.tick(tick_ns)
        able = self.controller.able(rows, step)
        if not able.all():
            rows, step = rows[able], step[able]
        for first in range(0, len(rows), BLOCK):
            block = slice(first, first + BLOCK)
            decisions = self.controller.decide(rows[block], step[block])
            self._send_horizons(decisions, now_ns)
            self.stopwatch.lap("encode")
            self._record(decisions)
        self._tell_idle()
        for session in self.sessions:
            if now_ns - session.sent_ns >= self._heartbeat_ns:
                session.sent_ns = now_ns
                idle = int(self._idle[session.row])
                self._say(
                    session,
                    Heartbeat(session.vehicle, session.number, now_ns, idle, int(self._degraded)),
                )
        self.stopwatch.lap("encode")
        self.ticks.add(self.stopwatch.spent_ns.total() - before_ns)

    def _tell_idle(self) -> None:
        """Say where planning has stopped, and where it goes on."""
        idle = self.controller.idle
        for row in np.flatnonzero(idle != self._idle).tolist():
            self._idle[row] = idle[row]
            vehicle, why = self.sessions.at(row).vehicle, Idle(idle[row])
            if why == Idle.PLANS:
                self._events.append(PlanningResumed(vehicle=vehicle))
            else:
                self._events.append(PlanningStopped(vehicle=vehicle, why=str(why)))

    def _send_horizons(self, decisions: Decisions, now_ns: int) -> None:
        sent, found = decisions.sent, decisions.found
        if not len(sent):
            return
        # Bytes of one input on all axes, and of what goes with a horizon.
        width = 4 * self._terms.axes
        feedback, told = found.feedback.data.cast("B"), 0
        if self._terms.feedback:
            told = width * FEEDBACK
        inputs, begin = in_a_row(found, sent), 0
        columns = (sent, decisions.rows[sent], decisions.step[sent], found.ahead[sent])
        for i, row, step, d in zip(*(column.tolist() for column in columns), strict=True):
            session, end = self.sessions.at(row), begin + width * (d + self._terms.planned)
            payload = encode_horizon(
                session.vehicle,
                session.number,
                step,
                now_ns,
                session.observed_ns,
                inputs[begin:end],
                feedback[i * told : (i + 1) * told],
            )
            session.sent_ns, begin = now_ns, end
            self._out.append(Datagram(session.line.seal(payload), session.address))

    def _say(self, session: Session, message: Message) -> None:
        self._out.append(Datagram(session.line.seal(encode(message)), session.address))

    def close(self, *, now_ns: int) -> None:  # noqa: ARG002 - see `Endpoint`
        """Tell every vehicle that the server ends."""
        for _ in range(CLOSES):
            for session in self.sessions:
                self._say(session, Close(session.vehicle, session.number))

    def _record(self, decisions: Decisions) -> None:
        if self._plans is not None and len(decisions.sent):
            self._record_plans(self._plans, decisions)
        if self._recorder is None:
            return
        rows, found, figures = decisions.rows, decisions.found, decisions.figures
        n = len(rows)
        self._recorder.append(
            n,
            vehicle=self.sessions.vehicle[rows],
            step=decisions.step,
            reference=self.controller.desired.now(rows, decisions.step),
            estimate=found.estimate[:n],
            ahead=found.ahead[:n],
            planned=decisions.planned,
            input=found.horizons[:n, :, 0],
            observed_step=self.controller.observed_step[rows],
            error=decisions.verdict.figure,
            threshold=decisions.verdict.threshold,
            event=decisions.event,
            solved=figures["solved"],
            solve_ns=decisions.solve_ns,
            stale=[self.sessions.at(row).stale for row in rows.tolist()],
            missed=self.missed,
        )
        self.stopwatch.lap("record")

    def _record_plans(self, plans: Recorder, decisions: Decisions) -> None:
        sent, found = decisions.sent, decisions.found
        step, ahead = decisions.step[sent], found.ahead[sent]
        # Behind d committed inputs, another d of each vehicle.
        stages = ahead[:, None] + np.arange(self._terms.planned)
        reckons = self._terms.reckons
        plans.append(
            len(sent),
            vehicle=self.sessions.vehicle[decisions.rows[sent]],
            step=step,
            begins=step + ahead,
            state=found.feedback[sent][:, :, :2] if reckons else found.start[sent],
            inputs=np.take_along_axis(found.horizons[sent], stages[:, None], axis=2),
            disturbance=found.disturbance[sent],
        )

    @property
    def counts(self) -> Counter[str]:
        """Events that were counted, by name."""
        return Counter({**self._dropped, **self.controller.counts})

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        each: dict[str, Any] = {}
        for session in self.sessions.first(VEHICLES_TOLD_MAX):
            each[f"vehicle {session.vehicle}"] = {
                "step": int(self.controller.last_step[session.row]),
                "clock_bound_ms": self._clock.bound_ns(session.row) / MILLISECOND_NS,
            }
        if len(self.sessions) > VEHICLES_TOLD_MAX:
            each["and more"] = len(self.sessions) - VEHICLES_TOLD_MAX
        return {
            "vehicles": len(self.sessions),
            "degraded": self._degraded,
            "missed": self.missed,
            "observations": self.observations,
            "tick_ms_p50": self.ticks.quantile_ms(0.5),
            "tick_ms_p99": self.ticks.quantile_ms(0.99),
            "ticks_within": self.ticks.within(TICK_EDGES_MS),
            "spent_ns": dict(self.stopwatch.spent_ns),
            "counts": dict(self.counts),
            "each": each,
        }
