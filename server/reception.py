"""Receives the messages of vehicles, checks and answers them.

HELLO is answered by a WELCOME or a refusal, OBSERVATION is checked and passed to the controller,
CLOSE ends a session, and TIME reports a vehicle's time of day. Other messages are dropped and
counted by reason.
"""

from collections import Counter, deque

from skytether.server.assignment import Decider
from skytether.server.gate import Gate, GateCall
from skytether.server.planning.clock import ClockMap, Contradiction
from skytether.server.plausibility import ANEW, BELIEVED, Belief, Plausibility
from skytether.server.sessions import Session, Sessions
from skytether.server.tick import Grid
from skytether.shared.base.errors import NotInstalledError
from skytether.shared.base.units import MICROSECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram, Events
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.endpoints.time_of_day import DRIFT, TimeOfDay
from skytether.shared.events.flight import (
    BegunAnew,
    CannotResume,
    ClockContradicted,
    Event,
    NumberTaken,
    ServerFull,
    SessionEnded,
    SessionOpened,
    SessionRefused,
    StateDoubted,
    Unauthenticated,
    address_text,
)
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.catalogue import differences
from skytether.shared.scenario.schema import LinkConfig
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.framing import Report, split
from skytether.shared.wire.protocol import (
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Observation,
    Refusal,
    RoomMessage,
    Time,
    Trajectory,
    Welcome,
    decode,
    encode,
    stamped_ns,
)

REFUSALS_REPORTED = 64
"""Number of stored refusals, so that the refusal of a repeated HELLO is not reported again."""
REPORT_NS = 10 * SECOND_NS
"""Interval between reports of unauthenticated datagrams [ns]."""
IMPLAUSIBLE: dict[int, Drop] = {
    Belief.CLOCK: Drop.IMPLAUSIBLE_CLOCK,
    Belief.HORIZON: Drop.IMPLAUSIBLE_HORIZON,
    Belief.JUMP: Drop.IMPLAUSIBLE_JUMP,
}

CONTRADICTED = {
    Contradiction.CLOCK: "a clock was set, or runs too fast or slow: its offset is estimated again",
    Contradiction.ASYMMETRY: "delays both ways differ by more than link.asymmetry_s: it is ignored",
    Contradiction.TIME_OF_DAY: "the time of day of one end is wrong: it is no longer used",
}
"""Contradictions of the clock estimate, in words for the operator."""


class Reception:
    """Receives messages of vehicles; appends answers to `out`, and events to `events`."""

    def __init__(
        self,
        terms: Terms,
        link: LinkConfig,
        boot_id: int,
        gate: Gate,
        sessions: Sessions,
        clock: ClockMap,
        controller: Decider,
        grid: Grid,
        stopwatch: Stopwatch,
        *,
        out: list[Datagram],
        events: Events,
    ) -> None:
        self._terms, self._spread = terms, link.spread
        self._timeout_ns = seconds_to_ns(link.timeout_s)
        self._boot_id = boot_id
        self._gate = gate
        self._sessions = sessions
        self._clock = clock
        self._controller = controller
        self._grid = grid
        self._stopwatch = stopwatch
        self._out = out
        self._events = events
        self._plausibility = Plausibility(terms, len(sessions.vehicle))
        self.observations = 0
        """Number of accepted observations, in any order of arrival."""
        self.dropped: Counter[str] = Counter()
        self.refused: Counter[Refusal] = Counter()
        self.time: TimeOfDay | None = None
        """Time of day; None if the host does not know it."""
        self._reported: deque[tuple[int, int, Refusal]] = deque(maxlen=REFUSALS_REPORTED)
        """Vehicle, boot id and refusal of the newest reported refusals."""
        self._unauthenticated = 0
        self._report_ns = 0
        """Earliest time of the next report of unauthenticated datagrams."""

    def hear(self, datagram: Datagram, *, now_ns: int) -> str | None:
        self._stopwatch.start()
        if self._sessions.routes.is_copy(datagram, now_ns):
            self.dropped[Drop.COPY] += 1
            return Drop.COPY
        try:
            call = self._gate.open(datagram, now_ns=now_ns)
        except ProtocolError as error:
            if error.reason is Drop.REPLAYED and self._note_repeat(datagram, now_ns):
                self.dropped[Drop.COPY] += 1
                return Drop.COPY
            self.dropped[error.reason] += 1
            self._unauthenticated += 1
            if now_ns >= self._report_ns:
                self._report_unauthenticated(datagram.peer, error.reason, now_ns)
            return error.reason
        finally:
            self._stopwatch.lap("open")
        if call is None:
            self._out += self._gate.outbox()
            return None
        dropped = None
        try:
            self._take(call, datagram, now_ns)
        except ProtocolError as error:
            dropped = error.reason
            self.dropped[dropped] += 1
        except NotInstalledError:  # the message needs a missing package
            dropped = Drop.NOT_FOR_A_SERVER
            self.dropped[dropped] += 1
        self._stopwatch.lap("observe")
        return dropped

    def _note_repeat(self, datagram: Datagram, now_ns: int) -> bool:
        """Note that a vehicle's recent packet came again from another address. Return whether the
        vehicle has several paths and the copy came over an unproven path.
        """
        vehicle = self._gate.repeated(datagram)
        session = None if vehicle is None else self._sessions.live(vehicle)
        if session is None:
            return False
        if datagram.peer not in (session.address, session.home):
            session.other, session.other_ns = datagram.peer, now_ns
        return self._sessions.routes.is_repeat(session, datagram)

    def _take(self, call: GateCall, datagram: Datagram, now_ns: int) -> None:
        """Process one message.

        Raises:
            ProtocolError: the message is not a vehicle's, or contains another vehicle's number.
        """
        report, payload = split(call.payload)
        message = decode(payload, self._terms)
        self._stopwatch.lap("decode")
        if call.vehicle not in (None, message.vehicle):
            raise ProtocolError(Drop.OF_ANOTHER_VEHICLE)
        match message:
            case Observation():
                self._observe(message, report, call, datagram, now_ns)
            case Hello():
                self._hello(message, call, datagram, now_ns)
            case Welcome() | Horizon() | Trajectory() | Heartbeat():
                raise ProtocolError(Drop.NOT_FOR_A_SERVER)
            case _:
                self._hear_in_session(message, report, call, datagram, now_ns)

    def _hear_in_session(
        self,
        message: Close | Time | RoomMessage,
        report: Report | None,
        call: GateCall,
        datagram: Datagram,
        now_ns: int,
    ) -> None:
        """Process a message of a session; refuse it if it is too old."""
        sessions = self._sessions
        assigns = sessions.assignment.takes(message)
        session = sessions.welcomed(message) if assigns else sessions.find(message)
        if session is None:
            raise ProtocolError(Drop.UNKNOWN_SESSION)
        step = getattr(message, "step", None)
        if step is not None:
            self._refuse_overtaken(session, step)
        if report:
            sessions.routes.hear(session, report, message, datagram, now_ns)
        match message:
            case Close():
                sessions.end(session)
                self._events.append(SessionEnded(vehicle=session.vehicle))
            case Time():
                self._hear_time(session, message, now_ns)
            case _ if assigns:
                sessions.assignment = sessions.assignment.of_several()
                session.heard_ns = now_ns
                self._answer(sessions.assignment.take(session, message), call, datagram)
            case _:
                answer = sessions.routes.take(session, message, datagram, now_ns)
                session.heard_ns = now_ns
                if answer:
                    self._answer(answer, call, datagram)

    def _refuse_overtaken(self, session: Session, step: int) -> None:
        """Refuse a message that was sent long before the vehicle's newest observation."""
        newest = self._controller.observed_step[session.row] if session.row >= 0 else step
        if (newest - step) * self._terms.dt_ns > session.hearing.overtaken_ns:
            raise ProtocolError(Drop.OVERTAKEN)

    def _report_unauthenticated(self, address: Address, reason: str, now_ns: int) -> None:
        host, port = address
        event = Unauthenticated(count=self._unauthenticated, host=host, port=port, reason=reason)
        self._events.append(event)
        self._report_ns = now_ns + REPORT_NS

    def _answer(self, message: Message, call: GateCall, datagram: Datagram) -> None:
        sealed = call.line.seal(encode(message))
        self._out.append(Datagram(sealed, datagram.peer, datagram.socket))

    def _hello(self, hello: Hello, call: GateCall, datagram: Datagram, now_ns: int) -> None:
        address = datagram.peer
        row = self._sessions.row_of_other_life(hello)
        if row is not None and self._controller.restart(row):
            self._events.append(BegunAnew(vehicle=hello.vehicle))
        refusal, number = self._refusal(hello, address, now_ns), 0
        if refusal is Refusal.ACCEPTED:
            session = self._sessions.welcome(hello, address, call.line, now_ns, datagram.socket)
            number = session.number
            self._sessions.routes.restart(session)
        welcome = Welcome(
            hello.vehicle, number, hello.boot_id, self._boot_id, now_ns, refusal, self._terms
        )
        self._answer(welcome, call, datagram)
        # The channel is kept only now, because sealing the answer has created it.
        if refusal is Refusal.ACCEPTED:
            self._gate.admit(call, now_ns=now_ns)

    def _refusal(self, hello: Hello, address: Address, now_ns: int) -> Refusal:
        """Reason why a HELLO is refused, or ACCEPTED; reported once per boot id and reason."""
        vehicle, (host, port) = hello.vehicle, address
        event: Event
        if hello.terms != self._terms:
            refusal, differing = Refusal.OTHER_TERMS, differences(self._terms, hello.terms)
            event = SessionRefused(vehicle=vehicle, differences=differing)
        elif (holder := self._sessions.holder(hello, now_ns)) is not None:
            refusal, holder_at = Refusal.TAKEN, address_text(*holder.address)
            event = NumberTaken(vehicle=vehicle, host=host, port=port, holder=holder_at)
        elif self._sessions.is_full(hello, now_ns):
            refusal, capacity = Refusal.FULL, len(self._sessions.vehicle)
            event = ServerFull(vehicle=vehicle, host=host, port=port, capacity=capacity)
        else:
            return Refusal.ACCEPTED
        self.refused[refusal] += 1
        refused_run = vehicle, hello.boot_id, refusal
        if refused_run not in self._reported:
            self._reported.append(refused_run)
            self._events.append(event)
        return refusal

    def _observe(
        self,
        observation: Observation,
        report: Report | None,
        call: GateCall,
        datagram: Datagram,
        now_ns: int,
    ) -> None:
        session = self._sessions.find(observation) or self._begin(observation, call, now_ns)
        row, forward_ns = session.row, now_ns - observation.step * self._terms.dt_ns
        # A round trip of half an hour or more becomes negative, and so is rejected.
        backward_ns = stamped_ns(observation.backward_us, near_ns=-forward_ns)
        verdict = self._plausibility.judge(row, observation, forward_ns, backward_ns)
        if verdict > BELIEVED:
            if verdict == Belief.JUMP and not session.doubted:
                self._events.append(StateDoubted(vehicle=session.vehicle))
            session.doubted = True
            raise ProtocolError(IMPLAUSIBLE[verdict])
        if verdict == ANEW:
            self._anew(row, None)
            session.hearing.begin()
        # Checked after the plausibility, whose check may discard the newest observation as wrong.
        self._refuse_overtaken(session, observation.step)
        session.doubted = False
        if report:
            self._hear_paths(session, report, call, datagram, now_ns)
        # Only an accepted observation keeps a session alive.
        session.heard_ns = now_ns
        session.asked_ns = observation.silence * self._terms.dt_ns // 2
        session.hearing.hear(observation.number, observation.step)
        self.observations += 1
        contradiction = self._clock.observe(
            row,
            forward_ns,
            backward_ns,
            heard=observation.heard,
            now_ns=now_ns,
            is_newest=observation.step > self._controller.observed_step[row],
        )
        self._report_clock(session.vehicle, contradiction)
        if not self._controller.observe(row, observation):
            self._sessions.stale[session.row] += 1
            return
        # Only the packet with the highest counter may change the address: once the original has
        # arrived, a copy from elsewhere cannot change it.
        if call.moves:
            session.move(datagram.peer, call.line, now_ns, datagram.socket)
            if not report:
                self._sessions.routes.narrow(session)
        if observation.unsaved > session.unsaved:
            self._events.append(CannotResume(vehicle=session.vehicle))
        session.unsaved = bool(observation.unsaved)
        self._grid.arm(now_ns)

    def _hear_paths(
        self,
        session: Session,
        report: Report,
        call: GateCall,
        datagram: Datagram,
        now_ns: int,
    ) -> None:
        """Note the loss report of an observation; request a proof of a new address."""
        sessions = self._sessions
        sessions.routes = sessions.routes.of_several(
            sessions.entropy, self._spread, self._timeout_ns
        )
        question = sessions.routes.observe(session, report, datagram, now_ns, is_newest=call.moves)
        if question:
            self._answer(question, call, datagram)

    def _hear_time(self, session: Session, message: Time, now_ns: int) -> None:
        """Narrow the bounds on the offset of the vehicle's clock by comparing the times of day of
        the vehicle and of this host.
        """
        error_ns = self.time and self.time.error_at(now_ns)
        if error_ns is None or self.time is None:
            return
        # The time stamp is modulo its range: choose the time closest to the estimate from delays.
        # The error has grown by the clocks' drift since the message was sent.
        offset_ns, bound_ns = self._clock.middle_ns(session.row, now_ns)
        ahead_ns = self.time.ahead_ns
        epoch_ns = stamped_ns(message.epoch_us, near_ns=ahead_ns - offset_ns)
        age_ns = max(now_ns + offset_ns + bound_ns - message.step * self._terms.dt_ns, 0)
        error_ns += message.error_us * MICROSECOND_NS + age_ns // DRIFT + MICROSECOND_NS
        contradiction = self._clock.tell(session.row, ahead_ns - epoch_ns, error_ns, now_ns=now_ns)
        self._report_clock(session.vehicle, contradiction)

    def _report_clock(self, vehicle: int, contradiction: Contradiction) -> None:
        if contradiction is not Contradiction.NOTHING:
            what = CONTRADICTED[contradiction]
            self._events.append(ClockContradicted(vehicle=vehicle, what=what))

    def _anew(self, row: int, life: tuple[int, int] | None) -> None:
        """Forget everything about a vehicle except its session; `life`: see `ClockMap.forget`."""
        self._clock.forget(row, life)
        self._controller.forget(row)
        self._sessions.idle[row] = Idle.PLANS

    def _begin(self, observation: Observation, call: GateCall, now_ns: int) -> Session:
        session = self._sessions.begin(observation, now_ns)
        session.line = call.line
        self._plausibility.forget(session.row)
        self._anew(session.row, (session.vehicle, session.boot_id))
        self._sessions.assignment.begin(session)
        self._controller.begin(session.row, session.vehicle)
        host, port = session.address
        self._events.append(SessionOpened(vehicle=session.vehicle, host=host, port=port))
        return session
