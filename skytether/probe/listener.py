"""Listening end of a measurement: answers each probe with one packet, at most as long as the probe.

An answer has the listener's time and a list of arrivals that the prober has not acknowledged, the
oldest first. So if an answer is lost, a later one repeats its arrivals. The probes of a train are
answered together once all have arrived, so that the answers form a train as well.

A HELLO creates no state: its session id is derived from a secret and the sender's address. The
first PROBE with this id creates state. Only a sender that has received the WELCOME at its address
knows the id. Without keys, answers go only to this address: otherwise anybody who has seen the
session id could direct answers at a third party. With keys a sender may change its address.
"""

import hashlib
import hmac
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from skytether.probe.wire import (
    COOKIE_BYTES,
    NO_NUMBER,
    NONCE_BYTES,
    Probe,
    ProbeAnswer,
    ProbeHello,
    ProbeWelcome,
    decode,
    encode,
)
from skytether.server.gate import Gate, GateCall
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint, by_name, host_of
from skytether.shared.wire.channel import OVERHEAD_BYTES
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX

SESSIONS_MAX = 16
"""Largest number of simultaneous measurements; for a new one, `Listener._gives_way` may end one."""
IDLE_NS = 60 * SECOND_NS
"""Time without a probe after which a measurement may be replaced by another [ns]."""
HISTORY_MAX = 65_536
"""Largest number of stored arrivals that the prober has not acknowledged; older ones are
dropped."""
HOLD_NS = 200 * MILLISECOND_NS
"""Longest wait for the next packet of a train [ns]."""
_ARRIVALS_MAX = PAYLOAD_BYTES_MAX // 12


@dataclass(slots=True)
class HeldPacket:
    """Packet of a train whose answer waits for the rest of the train."""

    number: int
    call: GateCall
    peer: Address
    size: int


@dataclass(slots=True)
class ProbeSession:
    """State of the measurement by one prober."""

    heard_ns: int
    """Time of the newest probe [ns]."""
    host: str
    logged: int = 0
    log: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=HISTORY_MAX))
    """Newest arrivals not yet acknowledged by the prober: number of the PROBE, and time [ns]."""
    train: list[HeldPacket] = field(default_factory=list)
    """Received packets of a train, which are answered once the whole train has arrived."""
    train_ns: int = 0
    """Time of the newest packet in `train` [ns]."""


class Listener(Endpoint):
    """Listener that answers probes.

    Args:
        gate: opens incoming packets, and encrypts answers.
        secret: random bytes, from which session ids are derived.
    """

    def __init__(self, gate: Gate, secret: bytes) -> None:
        super().__init__()
        self._gate, self._secret = gate, secret
        self._sessions: OrderedDict[bytes, ProbeSession] = OrderedDict()
        """Measurements by session id; the measurement that has been idle longest is first."""
        self._dropped: Counter[str] = Counter()
        self._answered = 0

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        try:
            call = self._gate.open(datagram, now_ns=now_ns)
            if call is not None:
                self._hear(call, datagram, now_ns)
        except ProtocolError as error:
            self._dropped[error.reason] += 1
        self._out += self._gate.outbox()

    def _hear(self, call: GateCall, datagram: Datagram, now_ns: int) -> None:
        message = decode(call.payload)
        if isinstance(message, ProbeHello):
            has_room = self._gives_way(datagram.peer, now_ns) is not None
            has_room = has_room or len(self._sessions) < SESSIONS_MAX
            welcome = ProbeWelcome(
                message.nonce, self._cookie(message.nonce, datagram.peer), has_room
            )
            packet = call.line.seal(encode(welcome))
            if len(packet) > len(datagram.payload):
                raise ProtocolError(Drop.LENGTH)
            self.send(packet, datagram.peer)
            self._gate.admit(call, now_ns=now_ns)
        elif isinstance(message, Probe):
            session = self._session(message.session, call, datagram.peer, now_ns)
            self._probe(session, message, call, datagram, now_ns)
        else:
            raise ProtocolError(Drop.NOT_FOR_A_SERVER)

    def _session(self, name: bytes, call: GateCall, peer: Address, now_ns: int) -> ProbeSession:
        """Measurement with the session id `name`; created if there is none.

        Raises:
            ProtocolError: the session id is wrong for this sender, or SESSIONS_MAX sessions are
                open and none may be ended.
        """
        session = self._sessions.get(name)
        if session is None or call.vehicle is None:
            nonce, cookie = name[:NONCE_BYTES], name[NONCE_BYTES:]
            if not hmac.compare_digest(cookie, self._cookie(nonce, peer)):
                raise ProtocolError(Drop.UNKNOWN_SESSION)
        if session is None:
            if len(self._sessions) >= SESSIONS_MAX:
                replaced = self._gives_way(peer, now_ns)
                if replaced is None:
                    raise ProtocolError(Drop.FULL)
                del self._sessions[replaced]
            session = self._sessions[name] = ProbeSession(now_ns, host_of(peer))
        session.heard_ns = now_ns
        self._sessions.move_to_end(name)
        return session

    def _gives_way(self, peer: Address, now_ns: int) -> bytes | None:
        """Id of the session to end for a new sender's session; None if no session may end.

        A session without a probe for IDLE_NS is the first to end. Otherwise the host with the most
        sessions loses its oldest session, if the sender's host has at least two sessions fewer. So
        no host can block others.
        """
        name, session = next(iter(self._sessions.items()), (None, None))
        if session is None or now_ns - session.heard_ns > IDLE_NS:
            return name
        counts = Counter(each.host for each in self._sessions.values())
        host, most = counts.most_common(1)[0]
        if most <= counts[host_of(peer)] + 1:
            return None
        return next(name for name, each in self._sessions.items() if each.host == host)

    def _probe(
        self, session: ProbeSession, probe: Probe, call: GateCall, datagram: Datagram, now_ns: int
    ) -> None:
        log = session.log
        while log and session.logged - len(log) < probe.held:
            log.popleft()
        if probe.number == NO_NUMBER:
            number = NO_NUMBER
        else:
            number = session.logged
            log.append((probe.number, now_ns))
            session.logged += 1
        waits = HeldPacket(number, call, datagram.peer, len(datagram.payload))
        if probe.train > 1 and number != NO_NUMBER:
            session.train.append(waits)
            session.train_ns = now_ns
            if len(session.train) >= probe.train:
                self._release(session, probe.session, now_ns)
        else:
            self._answer(session, probe.session, waits, now_ns)

    def _release(self, session: ProbeSession, name: bytes, now_ns: int) -> None:
        for each in session.train:
            self._answer(session, name, each, now_ns)
        session.train.clear()

    def _answer(self, session: ProbeSession, name: bytes, held: HeldPacket, now_ns: int) -> None:
        log, line = session.log, held.call.line
        first = session.logged - len(log)
        arrivals = tuple(islice(log, _ARRIVALS_MAX))
        answer = ProbeAnswer(name, held.number, now_ns, first, session.logged, arrivals)
        size = held.size - (0 if held.call.vehicle is None else OVERHEAD_BYTES)
        packet = line.seal(encode(answer, size))
        if len(packet) <= held.size:  # a probe that is too short gets no answer
            self.send(packet, held.peer)
            self._answered += 1

    def wake(self, *, now_ns: int) -> None:
        """Answer incomplete trains HOLD_NS after their newest packet."""
        for name, session in self._sessions.items():
            if session.train and now_ns >= session.train_ns + HOLD_NS:
                self._release(session, name, now_ns)

    def next_wake_ns(self) -> int | None:
        return min(
            (each.train_ns + HOLD_NS for each in self._sessions.values() if each.train),
            default=None,
        )

    def figures(self) -> dict[str, Any]:
        return {
            "sessions": len(self._sessions),
            "answered": self._answered,
            "dropped": by_name(self._dropped),
        }

    def _cookie(self, nonce: bytes, peer: Address) -> bytes:
        host, port = peer
        content = nonce + f"{host} {port}".encode()
        return hashlib.blake2s(content, key=self._secret, digest_size=COOKIE_BYTES).digest()
