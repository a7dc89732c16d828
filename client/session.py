"""The client's side of the conversation: a session with the server, and the server's messages in
it.

    HELLO → WELCOME, or a refusal → HORIZON, HEARTBEAT … → CLOSE, silence or another WELCOME

The client echoes the time stamp of every packet of the session, from which the server estimates the
delays. `client.failsafe` decides how packets and silence change the vehicle's mode.
"""

from typing import Literal, NamedTuple

from skytether.client.failsafe import Failsafe
from skytether.client.link import AGAIN_NS, ClientLink
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.core.endpoint import Address, Datagram, Events
from skytether.shared.core.events import Failure, NoAnswer, NoSession, SessionRefused, Unanswered
from skytether.shared.core.steady import JUMP_NS
from skytether.shared.law.heartbeat import NUMBERS, Hearing
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.catalogue import differences
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import (
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Observation,
    Refusal,
    Time,
    Trajectory,
    Welcome,
    decode,
    encode,
    stamped_ns,
)

SLEPT_NS = JUMP_NS // 2
"""Advance of the server's clock over the client's that shows that this machine was suspended; far
more than changing delays cause."""
UNANSWERED_NS = 5 * SECOND_NS
"""Time without a first answer after which the log reports it."""
REFUSED = {
    Refusal.OTHER_TERMS: Drop.OTHER_TERMS,
    Refusal.FULL: Drop.FULL,
    Refusal.TAKEN: Drop.TAKEN,
}
"""Reason for dropping a WELCOME that refuses the vehicle."""
DEGRADED = "the server misses its deadlines"
"""Why there is no newer horizon although the server plans: it reports that it is degraded."""


class Echo(NamedTuple):
    """Newest packet of the server, as echoed in observations."""

    server_ns: int
    """Server time at which the packet was sent [ns]."""
    received_ns: int
    """Time of its arrival [ns; the client's clock]."""
    heard: int
    """Number of packets received up to and including that packet, modulo NUMBERS."""


NEVER = Echo(0, 0, 0)
"""Echo before the first packet of the server."""


class ServerSession:
    """Conversation between one vehicle and its server, over all sessions.

    Args:
        terms: terms that the server has to agree to.
        boot_id: number unique to this run of the client.
        server: address of the server, or of the netem in front of it.
        connect_s: time after which a vehicle that was never answered gives up [s].
        hearing: measures losses, and chooses the longest silence to allow the server.
        out: list to which datagrams are appended.
        events: list to which events for the operator are appended.
    """

    def __init__(
        self,
        terms: Terms,
        *,
        vehicle: int,
        boot_id: int,
        server: Address,
        connect_s: float,
        link: ClientLink,
        hearing: Hearing,
        failsafe: Failsafe,
        out: list[Datagram],
        events: Events,
    ) -> None:
        self._terms = terms
        self._vehicle = vehicle
        self._boot_id = boot_id
        self._server = server
        self._connect_ns = seconds_to_ns(connect_s)
        self.link = link
        self.hearing = hearing
        """Measures losses, and chooses the longest silence to allow the server."""
        self.silence_asked = hearing.silence
        """Longest silence that the server allows the vehicle [half steps]; 0 for no bound."""
        self.sent = 0
        """Number of packets sent in the session, modulo NUMBERS."""
        self._failsafe = failsafe
        self._out = out
        self._events = events
        self.hello_ns = 0
        """Time before which no further HELLO is sent."""
        self._began_ns: int | None = None
        self._is_unanswered = False
        self.number: int | None = None
        self._is_open = False
        """Whether the session may continue; otherwise only a WELCOME is accepted."""
        self._server_boot_id: int | None = None
        self.echo = NEVER
        self.idle = str(Idle.PLANS)
        """Why no newer horizon comes, as the server last reported."""
        self._refusal: NoSession | None = None
        """Newest refusal of a session by the server; None after a session was opened."""
        self.failure: Failure | None = None

    # -- receiving ---------------------------------------------------------------------------

    def hear(self, datagram: bytes, *, now_ns: int) -> Horizon | Trajectory | None:
        """Process a datagram of this session; return its horizon or trajectory, if it contains one.

        Raises:
            ProtocolError: the datagram must be dropped.
        """
        payload = self.link.open(datagram, now_ns=now_ns)
        if payload is None:
            self._out += [Datagram(answer, self._server) for answer in self.link.outbox()]
            # The answer to a CHALLENGE carries the HELLO, so none is due for a while.
            self.hello_ns = now_ns + AGAIN_NS
            return None
        match self._decode(payload, now_ns):
            case Welcome() as welcome:
                self._welcome(welcome, now_ns)
            case Horizon() | Trajectory() as horizon:
                self._heard(horizon, now_ns)
                self.idle = str(Idle.PLANS)
                return horizon
            case Heartbeat() as heartbeat:
                self._heard(heartbeat, now_ns)
                planning = heartbeat.idle == Idle.PLANS
                missing = planning and heartbeat.degraded
                self.idle = DEGRADED if missing else str(Idle(heartbeat.idle))
            case Close() as close:
                self._check(close)
                self._failsafe.meet(Reason.CLOSED, now_ns=now_ns)
            case _:
                raise ProtocolError(Drop.NOT_FOR_A_CLIENT)
        return None

    def _decode(self, payload: bytes, now_ns: int) -> Message:
        try:
            return decode(payload, self._terms)
        except ProtocolError:
            # In plaintext anybody could make the vehicle brake with five packets.
            if self.link.secure:
                self._failsafe.malformed(now_ns=now_ns)
            raise

    def _welcome(self, welcome: Welcome, now_ns: int) -> None:
        if (welcome.vehicle, welcome.boot_id) != (self._vehicle, self._boot_id):
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        if welcome.terms != self._terms:
            # Only before the first session: in flight the vehicle keeps its horizon, and the
            # failsafe decides.
            if self.number is None and self.failure is None:
                differing = differences(self._terms, welcome.terms)
                self._fail(SessionRefused(vehicle=self._vehicle, differences=differing))
            raise ProtocolError(Drop.OTHER_TERMS)
        if welcome.refusal != Refusal.ACCEPTED:
            refusal = Refusal(welcome.refusal)
            self._note_refusal(refusal, now_ns)
            raise ProtocolError(REFUSED[refusal])
        self._refusal = None
        restarted = self._server_boot_id not in (None, welcome.server_boot_id)
        if restarted:
            # A restarted server has another clock: its time stamps cannot be compared.
            self.echo = NEVER
        if self.number != welcome.session:
            self.sent = 0
            self.hearing.begin()
        self.number, self._server_boot_id = welcome.session, welcome.server_boot_id
        self._is_open = True
        self.link.adopt(now_ns=now_ns)
        self._heard(welcome, now_ns)
        if restarted:
            self._failsafe.meet(Reason.RESTARTED, now_ns=now_ns)

    def _note_refusal(self, refusal: Refusal, now_ns: int) -> None:
        """Report why there is no session, once per reason; a late refusal is ignored."""
        if not self._failsafe.is_lost(now_ns) or refusal not in (Refusal.FULL, Refusal.TAKEN):
            return
        host, port = self._server
        reason: Literal["full", "taken"] = "full" if refusal is Refusal.FULL else "taken"
        sent = NoSession(vehicle=self._vehicle, host=host, port=port, reason=reason)
        if sent != self._refusal:
            self._refusal = sent
            self._events.append(sent)

    def _check(self, message: Welcome | Horizon | Trajectory | Heartbeat | Close) -> None:
        named = message.vehicle, message.session
        if not self._is_open or named != (self._vehicle, self.number):
            raise ProtocolError(Drop.UNKNOWN_SESSION)

    def _heard(self, message: Welcome | Horizon | Trajectory | Heartbeat, now_ns: int) -> None:
        """Note a packet of the session, and detect that this machine was suspended.

        The client's clock may have stood still, or its jump was mistaken for a clock that was set
        (`shared.core.steady`); the server's clock has gone on in both cases. After a suspension
        longer than time stamps can express, the server has forgotten the session, and its WELCOME
        contains the full time.
        """
        self._check(message)
        expected_ns = self.echo.server_ns + now_ns - self.echo.received_ns
        if isinstance(message, Welcome):
            server_ns = message.server_ns
        else:
            server_ns = stamped_ns(message.server_us, expected_ns)
        if server_ns - expected_ns > SLEPT_NS and self.echo != NEVER:
            self._failsafe.meet(Reason.STALLED, now_ns=now_ns)
        self._failsafe.heard(now_ns=now_ns)
        self.echo = Echo(server_ns, now_ns, (self.echo.heard + 1) % NUMBERS)
        if not isinstance(message, Welcome):
            self.silence_asked = message.silence
            self.hearing.hear(message.number, server_ns)

    # -- sending -----------------------------------------------------------------------------

    def ask(self, *, now_ns: int) -> None:
        """Send HELLO if the server is silent, or the link needs new keys."""
        # The motion of an earlier run is flown before there is a session.
        silent = self.number is None or self._failsafe.is_lost(now_ns)
        wanted = silent or self.link.wants_hello(now_ns)
        if wanted and now_ns >= self.hello_ns:
            unheard = self.number is None and self._refusal is None
            self.hello_ns = now_ns + (self.link.hello_ns if unheard else AGAIN_NS)
            hello = encode(Hello(self._vehicle, self._boot_id, self._terms))
            self._out.append(Datagram(self.link.hello(hello, now_ns=now_ns), self._server))

    def rest(self, *, now_ns: int) -> None:
        """Delay the next HELLO of a session that waits for its vehicle to take off."""
        if self.number is not None:
            self.hello_ns = now_ns + AGAIN_NS

    def send(self, message: Observation | Close) -> None:
        self.sent = (self.sent + 1) % NUMBERS
        self._out.append(Datagram(self.link.seal(encode(message)), self._server))

    def tell_time(self, step: int, epoch_us: int, error_us: int) -> None:
        """Send the time of day of step 0; this packet does not count in the loss statistics."""
        assert self.number is not None
        sent = Time(self._vehicle, self.number, step, epoch_us, error_us)
        self._out.append(Datagram(self.link.seal(encode(sent)), self._server))

    def close(self) -> None:
        """Close the session; only another WELCOME opens one."""
        self._is_open = False

    def wait(self, *, now_ns: int) -> bool:
        """Whether to go on waiting for the flight; fails after too long without a session."""
        if self.number is not None:  # the vehicle is still on the ground
            return True
        if self._began_ns is None:
            self._began_ns = now_ns
        waited_ns = now_ns - self._began_ns
        if waited_ns <= self._connect_ns:
            self._say_unanswered(self._connect_ns - waited_ns, waited_ns)
            return True
        self._give_up(waited_ns / SECOND_NS)
        return False

    def _say_unanswered(self, left_ns: int, waited_ns: int) -> None:
        """Report once, after a while, that the server has not answered."""
        if self._is_unanswered or self._refusal is not None or waited_ns < UNANSWERED_NS:
            return
        self._is_unanswered = True
        host, port = self._server
        sent = Unanswered(vehicle=self._vehicle, host=host, port=port, left_s=left_ns / SECOND_NS)
        self._events.append(sent)

    def _give_up(self, waited_s: float) -> None:
        """Fail for lack of a first session; a refusal has been reported already."""
        if self._refusal is not None:
            self.failure = self._refusal
            return
        host, port = self._server
        self._fail(
            NoAnswer(
                vehicle=self._vehicle,
                host=host,
                port=port,
                waited_s=waited_s,
                secure=self.link.secure,
            )
        )

    def _fail(self, failure: Failure) -> None:
        self.failure = failure
        self._events.append(failure)
