"""The client's side of the conversation: a session with the server, and what the server says in it.

    HELLO → WELCOME, or a refusal → HORIZON, HEARTBEAT … → CLOSE, silence or another WELCOME

Every packet of the session is echoed by its stamp, so that the server learns of the delays. What
follows for the vehicle from what is heard, and from silence, `client.failsafe` decides.
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
"""Time by which the server's clock goes on further than ours while we sleep [ns]; far more than
what delays that change make of it."""
UNANSWERED_NS = 5 * SECOND_NS
"""Time without a first answer after which this is said [ns]."""
REFUSED = {
    Refusal.OTHER_TERMS: Drop.OTHER_TERMS,
    Refusal.FULL: Drop.FULL,
    Refusal.TAKEN: Drop.TAKEN,
}
"""Why a WELCOME is dropped that refuses the vehicle."""
DEGRADED = "the server misses its deadlines"
"""Why no newer horizon comes, as it seems, of a server that plans and says that it is degraded."""


class Echo(NamedTuple):
    """The newest packet of the server, as the vehicle tells of it."""

    server_ns: int
    """The server's clock when it was sent [ns]."""
    received_ns: int
    """Time at which it came [ns; our clock]."""
    heard: int
    """Number of packets that have come with it, modulo NUMBERS."""


NEVER = Echo(0, 0, 0)
"""Echo of a server that was not heard yet."""


class ServerSession:
    """Agreement of one vehicle and its server, over all sessions of the vehicle's life.

    Args:
        terms: what the server has to agree to.
        vehicle: number of the vehicle.
        boot_id: number that no other life of this vehicle has had.
        server: address of the server, or of the netem before it.
        connect_s: time after which a vehicle that was never answered gives up [s].
        link: how messages become datagrams.
        hearing: finds what silence to ask of the server.
        failsafe: is told what is heard.
        out: takes what is sent.
        events: takes what the operator is told.
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
        """Link, which turns messages into datagrams."""
        self.hearing = hearing
        """Longest silence that is asked of the server."""
        self.asked = hearing.silence
        """Longest silence that the server asks of us [half steps]; 0 for none."""
        self.said = 0
        """Number of packets said in the session, modulo NUMBERS."""
        self._failsafe = failsafe
        self._out = out
        self._events = events
        self.hello_ns = 0
        """Time before which no HELLO is said again."""
        self._began_ns: int | None = None
        self._is_unanswered = False
        """Whether it has been said that nobody has answered yet."""
        self.number: int | None = None
        """Number of the session; None before the first."""
        self._is_open = False
        """Whether that session may go on; else nothing but a WELCOME is heard."""
        self._server_boot_id: int | None = None
        self.echo = NEVER
        """Newest packet of the server."""
        self.idle = str(Idle.PLANS)
        """Why no newer horizon comes, as far as the server has said."""
        self._refusal: NoSession | None = None
        """Why the server opens no session, as far as it has said so since the last one."""
        self.failure: Failure | None = None
        """Event after which there can be no session."""

    # -- what is heard -----------------------------------------------------------------------

    def hear(self, datagram: bytes, *, now_ns: int) -> Horizon | Trajectory | None:
        """Take what is said in this session.

        Returns:
            The horizon or trajectory, where it is one.

        Raises:
            ProtocolError: it is to be dropped.
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
        """Message in a payload; a malformed one is a mistake of the server, if it is its own.

        In plaintext anybody could make the vehicle brake by such mistakes: there they count for
        nothing.
        """
        try:
            return decode(payload, self._terms)
        except ProtocolError:
            # In plaintext a stranger could make the vehicle brake by five packets.
            if self.link.secure:
                self._failsafe.malformed(now_ns=now_ns)
            raise

    def _welcome(self, welcome: Welcome, now_ns: int) -> None:
        if (welcome.vehicle, welcome.boot_id) != (self._vehicle, self._boot_id):
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        if welcome.terms != self._terms:
            # Only before the first session: in flight the vehicle keeps its horizon, and its
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
            # Another life of the server has another clock: stamps of the two cannot be compared.
            self.echo = NEVER
        if self.number != welcome.session:
            self.said = 0
            self.hearing.begin()
        self.number, self._server_boot_id = welcome.session, welcome.server_boot_id
        self._is_open = True
        self.link.adopt(now_ns=now_ns)
        self._heard(welcome, now_ns)
        if restarted:
            self._failsafe.meet(Reason.RESTARTED, now_ns=now_ns)

    def _note_refusal(self, refusal: Refusal, now_ns: int) -> None:
        """Note why there is no session, and say it once; a refusal that comes late is none."""
        if not self._failsafe.is_lost(now_ns) or refusal not in (Refusal.FULL, Refusal.TAKEN):
            return
        host, port = self._server
        reason: Literal["full", "taken"] = "full" if refusal is Refusal.FULL else "taken"
        said = NoSession(vehicle=self._vehicle, host=host, port=port, reason=reason)
        if said != self._refusal:
            self._refusal = said
            self._events.append(said)

    def _check(self, message: Welcome | Horizon | Trajectory | Heartbeat | Close) -> None:
        named = message.vehicle, message.session
        if not self._is_open or named != (self._vehicle, self.number):
            raise ProtocolError(Drop.UNKNOWN_SESSION)

    def _heard(self, message: Welcome | Horizon | Trajectory | Heartbeat, now_ns: int) -> None:
        """Note a packet of the session, and a sleep that our own clock has not told of.

        A leap of it may be a clock that was set, or real time that was slept through
        (`shared.core.steady`): the server's clock has gone on as well then. Who sleeps for longer
        than stamps are good for is forgotten by the server, whose WELCOME tells the whole time.
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
            self.asked = message.silence
            self.hearing.hear(message.number, server_ns)

    # -- what is said ------------------------------------------------------------------------

    def ask(self, *, now_ns: int) -> None:
        """Say HELLO where nobody is heard, or where the link needs new keys."""
        # A motion of an earlier life is flown before there is a session.
        silent = self.number is None or self._failsafe.is_lost(now_ns)
        wanted = silent or self.link.wants_hello(now_ns)
        if wanted and now_ns >= self.hello_ns:
            unheard = self.number is None and self._refusal is None
            self.hello_ns = now_ns + (self.link.hello_ns if unheard else AGAIN_NS)
            hello = encode(Hello(self._vehicle, self._boot_id, self._terms))
            self._out.append(Datagram(self.link.hello(hello, now_ns=now_ns), self._server))

    def rest(self, *, now_ns: int) -> None:
        """Look later whether a HELLO is wanted, in a session that waits for its vehicle."""
        if self.number is not None:
            self.hello_ns = max(self.hello_ns, now_ns + AGAIN_NS)

    def send(self, message: Observation | Close) -> None:
        """Send a message in the session."""
        self.said = (self.said + 1) % NUMBERS
        self._out.append(Datagram(self.link.seal(encode(message)), self._server))

    def tell_time(self, step: int, epoch_us: int, error_us: int) -> None:
        """Tell the time of day of step 0; it is no packet by which losses are counted."""
        assert self.number is not None
        said = Time(self._vehicle, self.number, step, epoch_us, error_us)
        self._out.append(Datagram(self.link.seal(encode(said)), self._server))

    def close(self) -> None:
        """Close the session: only another WELCOME opens one again."""
        self._is_open = False

    def wait(self, *, now_ns: int) -> bool:
        """Whether to go on waiting for the flight; where no session has come for long, it fails."""
        if self.number is not None:  # it is the vehicle that is not up yet
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
        """Say once, after a while, that nobody has answered."""
        if self._is_unanswered or self._refusal is not None or waited_ns < UNANSWERED_NS:
            return
        self._is_unanswered = True
        host, port = self._server
        said = Unanswered(vehicle=self._vehicle, host=host, port=port, left_s=left_ns / SECOND_NS)
        self._events.append(said)

    def _give_up(self, waited_s: float) -> None:
        """Fail for want of a first session; a refusal has been said before."""
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
