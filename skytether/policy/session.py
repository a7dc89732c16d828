"""Robot end's session with the policy end: HELLO until it is answered, keep-alives, and messages.

    HELLO → WELCOME, or a refusal → PART, REPORT … → 3 s without a datagram, HELLO again

A keep-alive is a REPORT on no part. It says whether the policy's metadata have arrived; otherwise
the policy end sends them again.
"""

from skytether.client.link import ClientLink
from skytether.policy import events
from skytether.policy.exchange import Exchange
from skytether.policy.messages import (
    CHUNK,
    METADATA,
    OBSERVATION,
    Hello,
    MetadataContent,
    Report,
    Welcome,
    content,
    decode,
    encode,
)
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.flight import address_text
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Refusal

SILENCE_NS = 3 * SECOND_NS
"""Time without a datagram after which the robot end sends HELLO again [ns]."""
HELLOS = 4
"""Number of unanswered HELLOs after which the log says so."""
REFUSALS = {
    Refusal.TAKEN: "another robot end has this number; each robot needs its own --id",
    Refusal.FULL: "it has as many robots as it can serve",
}
ALIVE_NS = SECOND_NS
"""Time after the last sent datagram at which a keep-alive is sent [ns]."""


class Session:
    """Session of a robot end, also over restarts of the policy end.

    Args:
        end: robot end, which sends the datagrams and reports the events.
        robot, servers, link, boot_id: see `RobotEnd`.
        rate_max: largest send rate [B/s].
    """

    def __init__(
        self,
        end: Endpoint,
        robot: int,
        servers: dict[int, Address],
        link: ClientLink,
        boot_id: int,
        rate_max: float,
    ) -> None:
        self._end, self._robot, self._servers, self._link = end, robot, dict(servers), link
        self._boot_id, self._rate_max = boot_id, rate_max
        self.exchange: Exchange | None = None
        """Messages of the newest session; None before the first."""
        self.server_boot_id = 0
        """Random number of the policy end's run; 0 before the first session."""
        self._hello_ns: int | None = 0
        """Time of the next HELLO [ns]; None during a session."""
        self._hellos = 0
        """Number of HELLOs since the newest WELCOME."""
        self.heard_ns = self._sent_ns = self._alive_ns = 0
        self.metadata: bytes | None = None
        """Newest metadata of the policy; None before the first."""
        self._has_metadata = False
        """Whether the metadata of this run of the policy end have arrived."""
        self.wants_rows = False
        """Whether observations include the next rows, for `PolicyEnd.gives_rows`."""

    def hear(self, datagram: Datagram, *, now_ns: int) -> Report | bytes | None:
        """Process a datagram; returns a report on an observation, or a complete chunk.

        Raises:
            ProtocolError: the datagram must be dropped.
        """
        if datagram.peer not in self._servers.values():
            raise ProtocolError(Drop.ELSEWHERE)
        opened = self._link.open(datagram.payload, now_ns=now_ns)
        if opened is None:
            return None
        message, exchange = decode(opened), self.exchange
        if isinstance(message, Welcome):
            self._welcome(message, datagram.peer, now_ns)
            return None
        if isinstance(message, Hello) or exchange is None or message.session != exchange.session:
            raise ProtocolError(Drop.UNKNOWN_SESSION)
        self.heard_ns = now_ns
        if isinstance(message, Report):
            if not message.came:
                return None  # a keep-alive that the policy end has returned
            exchange.learn(message, now_ns=now_ns)
            return message if message.stream == OBSERVATION else None
        arrived = exchange.accept(message, now_ns=now_ns)
        if arrived and message.stream == METADATA:
            self._learn_metadata(arrived)
        return arrived if message.stream == CHUNK else None

    def _welcome(self, welcome: Welcome, peer: Address, now_ns: int) -> None:
        if welcome.robot != self._robot or welcome.boot_id != self._boot_id:
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        if welcome.refusal:
            reason = REFUSALS.get(Refusal(welcome.refusal), "unknown")
            self._end.tell(events.JoinRefused(robot=self._robot, reason=reason))
            return
        self._link.adopt(now_ns=now_ns)
        self.heard_ns, self._hello_ns, self._hellos = now_ns, None, 0
        before = self.exchange and self.exchange.session, self.server_boot_id
        if before == (welcome.session, welcome.server_boot_id):
            return
        self.exchange = Exchange(welcome.session, self._rate_max)
        self.server_boot_id, self._has_metadata = welcome.server_boot_id, False
        self._end.tell(events.PolicyJoined(robot=self._robot, peer=address_text(*peer)))
        self._say_alive(self.exchange, now_ns)

    def _learn_metadata(self, message: bytes) -> None:
        self.wants_rows, self.metadata = content(MetadataContent, message)
        self._has_metadata = True

    def _say_alive(self, exchange: Exchange, now_ns: int) -> None:
        self._sent_ns = self._alive_ns = now_ns
        has = int(self._has_metadata)
        alive = Report(exchange.session, METADATA, has, *[0] * 9)
        self._send_on_all(self._link.seal(encode(alive)))

    def _send_on_all(self, datagram: bytes) -> None:
        for socket, server in self._servers.items():
            self._end.send(datagram, server, socket)

    def due_ns(self) -> int:
        """Time at which `wake` must be called next [ns]."""
        due = [self.heard_ns + SILENCE_NS, self._sent_ns + ALIVE_NS]
        if self._hello_ns is not None:
            due = [self._hello_ns]
        if self.exchange and (sends_ns := self.exchange.due_ns()) is not None:
            due.append(sends_ns)
        return min(due)

    def wake(self, *, now_ns: int) -> None:
        """Begin to send HELLO, if the policy end is silent or new keys are needed."""
        silence_ns = now_ns - self.heard_ns
        if self._hello_ns is not None:
            return
        if silence_ns >= SILENCE_NS:
            silence_s = silence_ns / SECOND_NS
            self._end.tell(events.PolicySilent(robot=self._robot, silence_s=silence_s))
        if silence_ns >= SILENCE_NS or self._link.wants_hello(now_ns):
            self._hello_ns = now_ns

    def send(self, *, now_ns: int) -> None:
        """Send all datagrams that are due."""
        if self._hello_ns is not None and now_ns >= self._hello_ns:
            self._hello_ns = now_ns + self._link.hello_ns
            hello = encode(Hello(self._robot, self._boot_id))
            self._send_on_all(self._link.hello(hello, now_ns=now_ns))
            self._hellos += 1
            if self._hellos == HELLOS:
                peers = ", ".join(address_text(*each) for each in self._servers.values())
                self._end.tell(events.NoWelcome(robot=self._robot, peers=peers))
        for answer in self._link.outbox():
            self._send_on_all(answer)
        if self.exchange is None:
            return
        for payload in self.exchange.outbox(now_ns=now_ns):
            self._send_on_all(self._link.seal(payload))
            self._sent_ns = now_ns
        since_ns = self._sent_ns if self._has_metadata else self._alive_ns
        if now_ns - since_ns >= ALIVE_NS:
            self._say_alive(self.exchange, now_ns)
