"""The server's side of the conversation: who speaks, what is said, and what of it is believed.

HELLO is answered by a WELCOME or a refusal, OBSERVATION is judged and handed to the controller,
CLOSE ends a session. All else is dropped and counted by its reason.
"""

from collections import Counter, deque

from skytether.server.common.clock import ClockMap, Contradiction
from skytether.server.controller import Controller
from skytether.server.gate import Call, Gate
from skytether.server.plausibility import ANEW, BELIEVED, Belief, Plausibility
from skytether.server.sessions import Session, Sessions
from skytether.server.tick import Grid
from skytether.shared.base.units import MICROSECOND_NS, SECOND_NS
from skytether.shared.core.endpoint import Address, Datagram, Events
from skytether.shared.core.events import (
    BegunAnew,
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
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.core.time_of_day import DRIFT, TimeOfDay
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.catalogue import differences
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import (
    Close,
    Hello,
    Idle,
    Observation,
    Refusal,
    Time,
    Welcome,
    decode,
    encode,
    stamped_ns,
)

REFUSALS_TOLD_MAX = 64
"""Newest refusals that are remembered, so as not to tell the operator of each HELLO anew."""
TELL_NS = 10 * SECOND_NS
"""Time from one word about datagrams of strangers to the next [ns]."""
IMPLAUSIBLE: dict[int, Drop] = {
    Belief.CLOCK: Drop.IMPLAUSIBLE_CLOCK,
    Belief.HORIZON: Drop.IMPLAUSIBLE_HORIZON,
    Belief.JUMP: Drop.IMPLAUSIBLE_JUMP,
}
"""Why an observation is dropped that is not believed."""

CONTRADICTED = {
    Contradiction.CLOCK: "a clock was set, or runs wrong: it is measured anew",
    Contradiction.ASYMMETRY: "link.asymmetry_s does not hold: not believed any more",
    Contradiction.TIME_OF_DAY: "the time of day of one end is wrong: all times count that may be",
}
"""What was contradicted that was known of a vehicle's clock, in words."""


class Reception:
    """Hears vehicles.

    Args:
        terms: what is agreed upon with every vehicle.
        boot_id: a number that no other life of the server has had.
        gate: who may speak, and how.
        sessions: who flies.
        clock: learns of the vehicles' clocks.
        controller: is given the observations that are believed.
        grid: is armed by an observation.
        stopwatch: measures the parts of the work.
        out: takes the answers.
        events: takes what the operator is told.
    """

    def __init__(
        self,
        terms: Terms,
        boot_id: int,
        gate: Gate,
        sessions: Sessions,
        clock: ClockMap,
        controller: Controller,
        grid: Grid,
        stopwatch: Stopwatch,
        *,
        out: list[Datagram],
        events: Events,
    ) -> None:
        self._terms = terms
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
        """Number of observations that were believed, in whatever order they came."""
        self.dropped: Counter[Drop] = Counter()
        """Number of datagrams dropped, by reason."""
        self.refused: Counter[Refusal] = Counter()
        """Number of HELLOs of vehicles that were refused, by reason."""
        self.time: TimeOfDay | None = None
        """Time of day; None where the host does not know it."""
        self._told: deque[tuple[int, int, Refusal]] = deque(maxlen=REFUSALS_TOLD_MAX)
        """Vehicle, boot id and refusal of the newest refusals that the operator was told."""
        self._strangers = 0
        """Number of datagrams that the gate has not let pass."""
        self._tell_ns = 0
        """Time from which the operator may be told of these again."""

    def hear(self, datagram: Datagram, *, now_ns: int) -> None:
        """HELLO opens a session, OBSERVATION feeds it, CLOSE ends it; all else is only counted."""
        self._stopwatch.start()
        try:
            call = self._gate.open(datagram, now_ns=now_ns)
        except ProtocolError as error:
            self.dropped[error.reason] += 1
            self._strangers += 1
            if now_ns >= self._tell_ns:
                self._tell_of_strangers(datagram.peer, error.reason, now_ns)
            return
        finally:
            self._stopwatch.lap("open")
        if call is None:
            self._out += self._gate.outbox()
            return
        try:
            self._take(call, datagram.peer, now_ns)
        except ProtocolError as error:
            self.dropped[error.reason] += 1
        self._stopwatch.lap("observe")

    def _take(self, call: Call, address: Address, now_ns: int) -> None:
        """Take one message.

        Raises:
            ProtocolError: it is not one of a vehicle's, or not its own.
        """
        message = decode(call.payload, self._terms)
        self._stopwatch.lap("decode")
        if call.vehicle not in (None, message.vehicle):
            raise ProtocolError(Drop.OF_ANOTHER_VEHICLE)
        match message:
            case Observation():
                self._observe(message, call, address, now_ns)
            case Hello():
                self._hello(message, call, address, now_ns)
            case Close():
                self._sessions.end(message.vehicle, message.session)
                self._events.append(SessionEnded(vehicle=message.vehicle))
            case Time():
                self._hear_time(message, now_ns)
            case _:
                raise ProtocolError(Drop.NOT_FOR_A_SERVER)

    def _tell_of_strangers(self, address: Address, reason: Drop, now_ns: int) -> None:
        host, port = address
        told = Unauthenticated(count=self._strangers, host=host, port=port, reason=reason)
        self._events.append(told)
        self._tell_ns = now_ns + TELL_NS

    def _hello(self, hello: Hello, call: Call, address: Address, now_ns: int) -> None:
        row = self._sessions.row_of_other_life(hello)
        if row is not None and self._controller.scheme.restart(row):
            self._events.append(BegunAnew(vehicle=hello.vehicle))
        refusal, number = self._refusal(hello, address, now_ns), 0
        if refusal is Refusal.ACCEPTED:
            number = self._sessions.welcome(hello, address, call.line, now_ns).number
        welcome = Welcome(
            hello.vehicle, number, hello.boot_id, self._boot_id, now_ns, refusal, self._terms
        )
        self._out.append(Datagram(call.line.seal(encode(welcome)), address))
        # After the answer is sealed, which is what makes the channel.
        if refusal is Refusal.ACCEPTED:
            self._gate.admit(call, now_ns=now_ns)

    def _refusal(self, hello: Hello, address: Address, now_ns: int) -> Refusal:
        """Why a HELLO is refused, if not ACCEPTED; the operator is told once a life and reason."""
        vehicle, (host, port) = hello.vehicle, address
        event: Event
        if hello.terms != self._terms:
            refusal, differing = Refusal.OTHER_TERMS, differences(self._terms, hello.terms)
            event = SessionRefused(vehicle=vehicle, differences=differing)
        elif (holder := self._sessions.holder(hello, now_ns)) is not None:
            refusal, holder_at = Refusal.TAKEN, address_text(*holder.address)
            event = NumberTaken(vehicle=vehicle, host=host, port=port, holder=holder_at)
        elif self._sessions.is_full(hello, now_ns):
            refusal, room = Refusal.FULL, len(self._sessions.vehicle)
            event = ServerFull(vehicle=vehicle, host=host, port=port, room=room)
        else:
            return Refusal.ACCEPTED
        self.refused[refusal] += 1
        told = vehicle, hello.boot_id, refusal
        # Said once a life and reason, for a vehicle that is refused says HELLO every 0.4 s.
        if told not in self._told:
            self._told.append(told)
            self._events.append(event)
        return refusal

    def _observe(self, observation: Observation, call: Call, address: Address, now_ns: int) -> None:
        session = self._sessions.find(observation) or self._begin(observation, call, now_ns)
        row, forward_ns = session.row, now_ns - observation.step * self._terms.dt_ns
        # A round trip of half an hour or more is none: less than nothing is made of it.
        backward_ns = stamped_ns(observation.backward_us, near_ns=-forward_ns)
        verdict = self._plausibility.judge(row, observation, forward_ns, backward_ns)
        if verdict > BELIEVED:
            if verdict == Belief.JUMP and not session.doubted:
                self._events.append(StateDoubted(vehicle=session.vehicle))
            session.doubted = True
            raise ProtocolError(IMPLAUSIBLE[verdict])
        session.doubted = False
        if verdict == ANEW:
            self._anew(row, None)
            session.hearing.begin()
        # Only after it was believed: an observation that is not does not keep a session alive.
        session.heard_ns = now_ns
        session.asked_ns = observation.silence * self._terms.dt_ns // 2
        session.hearing.hear(observation.number, observation.step)
        self.observations += 1
        found = self._clock.observe(
            row,
            forward_ns,
            backward_ns,
            heard=observation.heard,
            now_ns=now_ns,
            is_newest=observation.step > self._controller.observed_step[row],
        )
        self._tell_of_clock(session.vehicle, found)
        if not self._controller.observe(row, observation):
            session.stale += 1
            return
        # Only the packet with the highest counter moves the address: a copy that is sent on from
        # elsewhere does not, once the original has come.
        if call.moves:
            session.address, session.line = address, call.line
        self._grid.arm(now_ns)

    def _hear_time(self, told: Time, now_ns: int) -> None:
        """Narrow the bounds of a vehicle's clock by the time of day that it has sent.

        Without a time of day at this host as well it says nothing.
        """
        session = self._sessions.find(told)
        if session is None:
            raise ProtocolError(Drop.UNKNOWN_SESSION)
        error_ns = self.time and self.time.error_at(now_ns)
        if error_ns is None or self.time is None:
            return
        # Of all times with the stamp that which the delays speak for; the clocks have drifted apart
        # since it was told.
        offset_ns, bound_ns = self._clock.middle_ns(session.row, now_ns)
        ahead_ns = self.time.ahead_ns
        epoch_ns = stamped_ns(told.epoch_us, near_ns=ahead_ns - offset_ns)
        age_ns = max(now_ns + offset_ns + bound_ns - told.step * self._terms.dt_ns, 0)
        error_ns += told.error_us * MICROSECOND_NS + age_ns // DRIFT + MICROSECOND_NS
        found = self._clock.tell(session.row, ahead_ns - epoch_ns, error_ns, now_ns=now_ns)
        self._tell_of_clock(session.vehicle, found)

    def _tell_of_clock(self, vehicle: int, found: Contradiction) -> None:
        """Tell the operator what was contradicted that was known of a vehicle's clock."""
        if found is not Contradiction.NOTHING:
            what = CONTRADICTED[found]
            self._events.append(ClockContradicted(vehicle=vehicle, what=what))

    def _anew(self, row: int, life: tuple[int, int] | None) -> None:
        """Forget all that is known of a vehicle but its session.

        Args:
            row: the vehicle.
            life: its number and boot id, if its clock may be the one that is known.
        """
        self._clock.forget(row, life)
        self._controller.forget(row)
        self._sessions.idle[row] = Idle.PLANS

    def _begin(self, observation: Observation, call: Call, now_ns: int) -> Session:
        """The session of a first observation, now live."""
        session = self._sessions.begin(observation, now_ns)
        session.line = call.line
        self._plausibility.forget(session.row)
        self._anew(session.row, (session.vehicle, session.boot_id))
        self._controller.desired.assign(session.row, session.vehicle)
        host, port = session.address
        self._events.append(SessionOpened(vehicle=session.vehicle, host=host, port=port))
        return session
