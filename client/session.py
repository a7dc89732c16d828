"""The client's side of a session with a server: opening it, and the messages in both directions.

    HELLO → WELCOME, or a refusal → HORIZON, HEARTBEAT … → CLOSE, silence or another WELCOME

The client echoes the time stamp of every packet of the session, from which the server estimates the
delays. `client.failsafe` decides how packets and silence change the vehicle's mode.
"""

from typing import Any, Literal

from skytether.client.alone import Role
from skytether.client.link import AGAIN_NS, ClientLink
from skytether.client.route import Route
from skytether.client.server_clock import ServerClock
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Events
from skytether.shared.events.flight import Failure, NoSession, SessionRefused
from skytether.shared.law.heartbeat import NUMBERS, RARE_TIMES, Hearing
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.catalogue import differences
from skytether.shared.scenario.registry import load
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.framing import split
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
    encode,
)

UNANSWERED_NS = 5 * SECOND_NS
"""Time after which the log reports that the server has not answered yet."""
REFUSED = {
    Refusal.OTHER_TERMS: Drop.OTHER_TERMS,
    Refusal.FULL: Drop.FULL,
    Refusal.TAKEN: Drop.TAKEN,
}
"""Reason for dropping a WELCOME that refuses the vehicle, by the refusal."""
DEAF = frozenset({Idle.OBSERVATION, Idle.DELAY})
"""Reasons why one server cannot plan for the vehicle, although another server may be able to."""
DEGRADED = "the server misses its deadlines"
"""Reason for the lack of newer plans if the server reports that it is degraded."""


Stamped = Horizon | Trajectory | Heartbeat
"""Messages that contain the server's time."""
FromServer = Stamped | Close | RoomMessage
"""Messages that a server sends in a session."""
FromVehicle = Hello | Observation | Time


class ServerSession:
    """Conversation between one vehicle and one of its servers, over all sessions.

    Args:
        terms: terms that the server has to agree to.
        boot_id: number unique to this run of the client.
        role: role of the server for the vehicle.
        route: route to the server.
        timeout_ns: time without a packet after which an end considers the link lost [ns].
        connect_s: time after which the vehicle gives up if no server answers [s].
        hearing: measures losses, and chooses the longest silence to allow the server.
        events: list to which events for the operator are appended.
    """

    def __init__(
        self,
        terms: Terms,
        *,
        vehicle: int,
        boot_id: int,
        role: Role,
        route: Route,
        timeout_ns: int,
        connect_s: float,
        link: ClientLink,
        hearing: Hearing,
        events: Events,
    ) -> None:
        self._terms, self.vehicle, self._boot_id = terms, vehicle, boot_id
        self.role, self.route, self._timeout_ns = role, route, timeout_ns
        self._connect_ns = seconds_to_ns(connect_s)
        self.link = link
        self.hearing = hearing
        """Loss statistics, which determine the longest silence to allow the server."""
        self.silence_asked = hearing.silence
        """Longest silence that the server allows the vehicle [half steps]; 0 for no bound."""
        self.sent = 0
        """Number of packets sent in the session, modulo NUMBERS."""
        self.heard_ns: int | None = None
        """Time of the newest packet of the session [ns]; None before the first one and after the
        end."""
        self.useful_ns: int | None = None
        """Time of the newest packet [ns], except heartbeats that report that the server cannot
        plan."""
        self.sent_step = -1
        """Step of the newest observation; -1 before the first of the session."""
        self._events = events
        self.hello_ns = 0
        """Time before which no further HELLO is sent."""
        self._awaits_welcome = False
        """Whether a HELLO was sent, and no packet of a session has arrived since then."""
        self._began_ns: int | None = None
        self._is_unanswered = False
        self.number: int | None = None
        self._is_open = False
        """Whether the session may continue; otherwise only a WELCOME is accepted."""
        self._server_boot_id: int | None = None
        self.clock = ServerClock(hearing.overtaken_ns)
        self.idle = str(Idle.PLANS)
        """Reason for the lack of newer plans, as the server last reported it."""
        self._refusal: NoSession | None = None
        """Newest refusal by the server; None without one, and after a session was opened."""
        self.failure: Failure | None = None

    @property
    def address(self) -> Address:
        return self.route.addresses[0]

    def is_lost(self, now_ns: int) -> bool:
        timeout_ns = self._timeout_ns
        if self.heard_ns is None or now_ns - self.heard_ns <= timeout_ns:
            return self.heard_ns is None
        return now_ns - self.heard_ns > self.role.lost_after_ns(timeout_ns)

    @property
    def silence(self) -> int:
        """Longest silence that the vehicle allows the server [half steps]."""
        return self.hearing.silence if self.role.is_followed else self.hearing.rare

    # -- receiving ---------------------------------------------------------------------------

    def hear(self, datagram: bytes, *, path: int = 0, now_ns: int) -> Horizon | Trajectory | None:
        """Process a datagram of this session; return its horizon or trajectory, if it contains one.

        Args:
            path: number of the path over which the datagram arrived.

        Raises:
            ProtocolError: the datagram must be dropped.
        """
        if self.route.is_copy(datagram, path):
            raise ProtocolError(Drop.COPY)
        payload = self.link.open(datagram, now_ns=now_ns)
        if payload is None:
            for answer in self.link.outbox():
                self.route.put(answer, path)
            # The answer to a CHALLENGE contains the HELLO, so the next HELLO is delayed. If no
            # WELCOME is awaited, the CHALLENGE answers an old HELLO that an attacker has replayed.
            if self._awaits_welcome:
                self.hello_ns = now_ns + AGAIN_NS
            return None
        report, payload = split(payload)
        message = self._decode(payload, now_ns)
        if isinstance(message, Welcome):
            self._welcome(message, now_ns)
            return None
        if isinstance(message, FromVehicle):
            raise ProtocolError(Drop.NOT_FOR_A_CLIENT)
        # A message's content is used only if the message is recent and of this session.
        self._check(message)
        server_ns = 0
        if isinstance(message, Stamped):
            server_ns = self.clock.sent_ns(message.server_us, now_ns)
        if report:
            self.route.heard(report, message, datagram, path, now_ns)
        if isinstance(message, Stamped):
            return self._take_stamped(message, server_ns, now_ns)
        if isinstance(message, Close):
            self.role.meet(Reason.CLOSED, now_ns=now_ns)
        elif not (self.route.take(self, message, path, now_ns) or self.role.take(message, now_ns)):
            raise ProtocolError(Drop.NOT_FOR_A_CLIENT)
        return None

    def _take_stamped(
        self, message: Stamped, server_ns: int, now_ns: int
    ) -> Horizon | Trajectory | None:
        useful_ns = self.useful_ns
        self._heard(server_ns, now_ns)
        self.silence_asked = message.silence
        self.hearing.hear(message.number, server_ns)
        if not isinstance(message, Heartbeat):
            self.role.check_plan()
            self.idle = str(Idle.PLANS)
            return message
        if message.idle in DEAF:
            self.useful_ns = useful_ns
        is_degraded = message.idle == Idle.PLANS and message.degraded
        self.idle = DEGRADED if is_degraded else str(Idle(message.idle))
        return None

    def _decode(self, payload: bytes, now_ns: int) -> Message:
        try:
            return self.role.decode(payload, self._terms)
        except ProtocolError:
            # Malformed plaintext does not count: anybody could make the vehicle brake with it.
            if self.link.secure:
                self.role.malformed(now_ns=now_ns)
            raise

    def _welcome(self, welcome: Welcome, now_ns: int) -> None:
        if (welcome.vehicle, welcome.boot_id) != (self.vehicle, self._boot_id):
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        if not self._awaits_welcome:
            # No session is requested now, so the WELCOME is a late copy, or answers a late copy of
            # a HELLO.
            raise ProtocolError(Drop.UNASKED)
        if welcome.terms != self._terms:
            # Different terms end the client only before its first session. In flight the vehicle
            # keeps its plan, and the failsafe decides.
            if self.number is None and self.failure is None:
                differing = differences(self._terms, welcome.terms)
                self._fail(SessionRefused(vehicle=self.vehicle, differences=differing))
            raise ProtocolError(Drop.OTHER_TERMS)
        if welcome.refusal != Refusal.ACCEPTED:
            refusal = Refusal(welcome.refusal)
            self._note_refusal(refusal, now_ns)
            raise ProtocolError(REFUSED[refusal])
        self._refusal = None
        restarted = self._server_boot_id not in (None, welcome.server_boot_id)
        if restarted:
            self.clock.begin()
        if self.number != welcome.session:
            self.sent, self.sent_step = 0, -1
            self.role.begin()
            self.hearing.begin()
            self.route.begin()
        self.number, self._server_boot_id = welcome.session, welcome.server_boot_id
        self._is_open = True
        self.link.adopt(now_ns=now_ns)
        self._heard(welcome.server_ns, now_ns)
        self._awaits_welcome = True  # repeated HELLOs may open a newer session
        if restarted:
            self.role.meet(Reason.RESTARTED, now_ns=now_ns)

    def _note_refusal(self, refusal: Refusal, now_ns: int) -> None:
        """Report why there is no session, once per reason; a late refusal is ignored."""
        if not self.is_lost(now_ns) or refusal not in (Refusal.FULL, Refusal.TAKEN):
            return
        host, port = self.address
        reason: Literal["full", "taken"] = "full" if refusal is Refusal.FULL else "taken"
        sent = NoSession(vehicle=self.vehicle, host=host, port=port, reason=reason)
        if sent != self._refusal:
            self._refusal = sent
            self._events.append(sent)

    def _check(self, message: FromServer) -> None:
        named = message.vehicle, message.session
        if not self._is_open or named != (self.vehicle, self.number):
            raise ProtocolError(Drop.UNKNOWN_SESSION)

    def _heard(self, server_ns: int, now_ns: int) -> None:
        """Note a packet of the session, sent at the server's time `server_ns` [ns]."""
        if self.clock.hear(server_ns, now_ns):
            self.role.meet(Reason.STALLED, now_ns=now_ns)
        self.note_heard(now_ns)

    def note_heard(self, now_ns: int) -> None:
        """Note a packet of the session."""
        self._awaits_welcome = False
        self.heard_ns = self.useful_ns = now_ns
        self.role.heard(now_ns=now_ns)

    # -- sending -----------------------------------------------------------------------------

    def ask(self, *, now_ns: int) -> None:
        """Send HELLO if the server is silent, or the link needs new keys."""
        # A session may be missing in flight, too: an earlier run's motion is flown without one.
        silent = self.number is None or self.is_lost(now_ns)
        wanted = silent or self.link.wants_hello(now_ns)
        if wanted and now_ns >= self.hello_ns:
            unheard = self.number is None and self._refusal is None
            again_ns = self.link.hello_ns if unheard else AGAIN_NS
            self.hello_ns = now_ns + again_ns * (1 if self.role.is_followed else RARE_TIMES)
            self._awaits_welcome = True
            hello = encode(Hello(self.vehicle, self._boot_id, self._terms))
            self.route.greet(self.link.hello(hello, now_ns=now_ns))

    def rest(self, *, now_ns: int) -> None:
        """Delay the next HELLO: the session is open, but its vehicle has not taken off yet."""
        if self.number is not None:
            self.hello_ns = now_ns + AGAIN_NS

    def send(self, message: Observation | Close, *, now_ns: int) -> None:
        self.sent = (self.sent + 1) % NUMBERS
        if isinstance(message, Observation):
            self.sent_step = message.step
        self.post(message, now_ns)

    def tell_time(self, step: int, epoch_us: int, error_us: int, *, now_ns: int) -> None:
        """Send the time of day of step 0; this packet does not count in the loss statistics."""
        assert self.number is not None
        self.post(Time(self.vehicle, self.number, step, epoch_us, error_us), now_ns)

    def is_observation_due(self, step: int) -> bool:
        """Whether an observation is due for a server that the vehicle does not follow."""
        return self.sent_step < 0 or 2 * (step - self.sent_step) >= self.hearing.rare

    def post(self, message: Message, now_ns: int) -> None:
        """Seal a message and send it."""
        self.route.post(self.link.seal, message, now_ns)

    def close(self) -> None:
        """Close the session; the next session needs another WELCOME."""
        self._is_open, self.heard_ns, self.useful_ns = False, None, None

    def wait(self, *, now_ns: int) -> bool:
        """Whether to go on waiting for the flight; sets `failure` after `connect_s` in vain."""
        if self.number is not None:  # a session was opened before
            return True
        if self._began_ns is None:
            self._began_ns = now_ns
        waited_ns = now_ns - self._began_ns
        if waited_ns > self._connect_ns:
            if self._refusal is None:
                self._fail(_ground().no_answer(self, waited_ns))
            else:
                self.failure = self._refusal  # `_note_refusal` has reported it
            return False
        if not self._is_unanswered and self._refusal is None and waited_ns >= UNANSWERED_NS:
            self._is_unanswered = True
            self._events.append(_ground().unanswered(self, self._connect_ns - waited_ns))
        return True

    def _fail(self, failure: Failure) -> None:
        self.failure = failure
        self._events.append(failure)


def _ground() -> Any:
    return load("skytether.client.ground", "a server that does not answer")
