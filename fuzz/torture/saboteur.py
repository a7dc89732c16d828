"""Attackers: a man in the middle between vehicles and netem, and an observer on another host.

Neither can read packets. Without an active fault (`faults`) packets pass unchanged. During a fault
they are lost, duplicated, delayed, altered or replayed, or an attacker sends additional
packets.
"""

from collections import Counter, deque
from collections.abc import Sequence

import numpy as np

from fuzz.engine import HeldPackets
from fuzz.torture.faults import FaultKind, ScheduledFault
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.wire.channel import kind as kind_of
from skytether.shared.wire.handshake import INITIATION

SERVER: Address = ("server", 0)
NETEM: Address = ("netem", 0)
OBSERVER = "observer"
SABOTEUR: Address = ("saboteur", 0)

RECORDED = 2048
"""Number of newest packets of a direction that an attacker keeps for replay."""
FLOOD_NS = 10 * MILLISECOND_NS
OTHER_SOCKET, STRANGERS_SOCKET, STRANGERS = 100, 200, 8
"""First number of the sockets that replay vehicles' packets; first number and count of the sockets
that send forged packets.
"""
COPIER_SOCKET, COPIERS = 300, 16
"""First number and count of the sockets that send copies and receive the answers."""
OTHER_PORTS = 1000
"""Offset from a vehicle's socket to its socket after NAT has changed the port."""
CROWD_PORTS = (100, 600)
"""Fewest and most ports from which an observer sends."""
HELLOS = 0.8
"""Share of handshake packets among an observer's copies; the server answers every one."""
COPY_S = 0.3
"""Longest delay of a copy, or of the answer to a copy [s]."""
SWIFT = 0.5
"""Share of attackers whose copies are faster than the network."""
ASTRAY = 0.2
"""Share of copies and answers that go to a wrong destination."""


class Saboteur(HeldPackets):
    """Man in the middle between vehicles and netem: replays and alters packets, but cannot read
    them.

    Netem sees vehicle n as socket n, and as another socket once NAT has changed the port. `clients`
    are the addresses of vehicles 1, 2, ….
    """

    def __init__(self, rng: np.random.Generator, clients: Sequence[Address]) -> None:
        super().__init__()
        self._rng = rng
        self._addresses = clients
        self._clients = dict(enumerate(clients, start=1))
        self._numbers = {client: number for number, client in self._clients.items()}
        self._on: list[ScheduledFault] = []
        self._left: dict[ScheduledFault, int] = {}
        """Number of packets that a burst still drops."""
        self._recorded: dict[str, deque[tuple[int, Datagram]]] = {
            direction: deque(maxlen=RECORDED) for direction in ("uplink", "downlink")
        }
        """Newest packets of each direction, and the times at which they passed."""
        self.initiations: deque[bytes] = deque(maxlen=RECORDED)
        """Newest INITIATIONs of the vehicles."""
        self._swift: set[ScheduledFault] = set()
        """Attackers whose copies of vehicles' packets reach the server before the originals."""
        self._copied: dict[int, Address] = {}
        """Vehicle whose packet each socket copied last, by the socket's number."""
        self._volley_ns: int | None = None
        """Time of the next burst of forged packets."""
        self.counts: Counter[str] = Counter()

    def begin(self, fault: ScheduledFault, now_ns: int) -> None:
        self._on.append(fault)
        if fault.kind is FaultKind.FLOOD:
            self._volley_ns = now_ns
        if fault.kind is FaultKind.COPY and self._rng.random() < SWIFT:
            self._swift.add(fault)
        if fault.kind is FaultKind.REPLAY:
            for direction in self._directions(fault):
                for passed_ns, datagram in self._recorded[direction]:
                    self._replay(fault, datagram, passed_ns, now_ns)

    def end(self, fault: ScheduledFault) -> None:
        self._on.remove(fault)
        self._left.pop(fault, None)
        self._swift.discard(fault)

    def change_ports(self) -> None:
        """Give each vehicle another socket towards netem, as NAT does when it changes ports."""
        first = max(self._clients) + OTHER_PORTS
        self._clients = dict(enumerate(self._addresses, start=first))
        self._numbers = {client: number for number, client in self._clients.items()}

    def copy(self) -> bytes | None:
        """Recorded packet of a vehicle for an observer to repeat; None before the first packet."""
        rng, sent = self._rng, self._recorded["downlink"]
        if self.initiations and rng.random() < HELLOS:
            return self.initiations[-1]
        return sent[int(rng.integers(len(sent)))][1].payload if sent else None

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        payload, peer, socket = datagram
        if socket == 0:
            number = self._numbers.get(peer)
            if peer[0] == OBSERVER:
                clients = list(self._clients.values())
                self._send_copy(payload, clients[int(self._rng.integers(len(clients)))], 0, now_ns)
            elif number is not None:
                if kind_of(payload) == INITIATION:
                    self.initiations.append(payload)
                self._pass("downlink", Datagram(payload, NETEM, number), now_ns)
        elif socket in self._clients:
            self._pass("uplink", Datagram(payload, self._clients[socket]), now_ns)
        elif socket in self._copied:
            self._hand_on(payload, socket, now_ns)
        super().wake(now_ns=now_ns)

    def wake(self, *, now_ns: int) -> None:
        if self._volley_ns is not None and now_ns >= self._volley_ns:
            floods = [fault for fault in self._on if fault.kind is FaultKind.FLOOD]
            for fault in floods:
                for _ in range(self._rng.poisson(fault.amount * FLOOD_NS / SECOND_NS)):
                    self._forge(fault.where)
            self._volley_ns = now_ns + FLOOD_NS if floods else None
        super().wake(now_ns=now_ns)

    def next_wake_ns(self) -> int | None:
        due_ns = super().next_wake_ns()
        if due_ns is None or (self._volley_ns is not None and self._volley_ns < due_ns):
            return self._volley_ns
        return due_ns

    @staticmethod
    def _directions(fault: ScheduledFault) -> tuple[str, ...]:
        return ("uplink", "downlink") if fault.where == "both" else (fault.where,)

    def _pass(  # noqa: PLR0912 - a branch for each kind of fault
        self, direction: str, datagram: Datagram, now_ns: int
    ) -> None:
        self._recorded[direction].append((now_ns, datagram))
        delay_ns, copies = 0, 1
        for fault in self._on:
            if fault.where not in (direction, "both"):
                continue
            rng, amount = self._rng, fault.amount
            match fault.kind:
                case FaultKind.PARTITION:
                    copies = 0
                case FaultKind.LOSS if rng.random() < amount:
                    copies = 0
                case FaultKind.BURST:
                    left = self._left.get(fault, 0)
                    if not left and rng.random() < 1.0 / amount:
                        left = round(amount)
                    self._left[fault] = max(0, left - 1)
                    copies = 0 if left else copies
                case FaultKind.DUPLICATES if rng.random() < amount:
                    copies *= 2
                case FaultKind.REORDERING:
                    delay_ns += seconds_to_ns(amount * rng.random())
                case FaultKind.DELAY:
                    delay_ns += seconds_to_ns(amount)
                case FaultKind.CORRUPTION if rng.random() < amount:
                    datagram = datagram._replace(payload=self._flipped(datagram.payload))
                case FaultKind.REPLAY:
                    self._replay(fault, datagram, now_ns, now_ns)
                    continue
                case FaultKind.COPY:
                    self._copy(fault, direction, datagram, now_ns)
                    continue
                case _:
                    continue
            self.counts[f"packets: {fault.kind}"] += 1
        for _ in range(copies):
            self.hold(now_ns + delay_ns, datagram)

    def _replay(
        self, fault: ScheduledFault, datagram: Datagram, passed_ns: int, now_ns: int
    ) -> None:
        """Replay a packet if the replay falls within the fault, sometimes from another address."""
        again_ns = passed_ns + seconds_to_ns(fault.amount)
        if not now_ns <= again_ns < fault.end_ns:
            return
        if self._rng.random() < 0.5:
            other = datagram.socket + OTHER_SOCKET
            datagram = datagram._replace(socket=other)
        self.counts[f"packets: {fault.kind}"] += 1
        self.hold(again_ns, datagram)

    def _copy(self, fault: ScheduledFault, direction: str, datagram: Datagram, now_ns: int) -> None:
        swift = fault in self._swift
        if not swift and self._rng.random() >= fault.amount:
            return
        self.counts[f"packets: {FaultKind.COPY}"] += 1
        socket = COPIER_SOCKET + int(self._rng.integers(COPIERS))
        if direction == "uplink":
            self._send_copy(datagram.payload, datagram.peer, socket, now_ns)
            return
        self._copied[socket] = self._clients[datagram.socket]
        to, later_ns = (SERVER, NETEM)[self._rng.integers(2)], self._later_ns()
        if swift:
            to, later_ns = SERVER, 0
        self.hold(now_ns + later_ns, Datagram(datagram.payload, to, socket))

    def _hand_on(self, payload: bytes, socket: int, now_ns: int) -> None:
        """Forward the answer to a copied packet to its vehicle, sometimes twice."""
        for _ in range(1 + self._rng.integers(2)):
            self._send_copy(payload, self._copied[socket], socket, now_ns)

    def _send_copy(self, payload: bytes, client: Address, socket: int, now_ns: int) -> None:
        """Send a packet to its vehicle or sometimes to a wrong one, as the server or from another
        address.
        """
        rng = self._rng
        if rng.random() < ASTRAY:
            client = list(self._clients.values())[rng.integers(len(self._clients))]
        socket = socket if rng.random() < 0.5 else 0
        self.hold(now_ns + self._later_ns(), Datagram(payload, client, socket))

    def _later_ns(self) -> int:
        """Delay of a copy [ns]; half of the copies have none."""
        return seconds_to_ns(COPY_S * max(0.0, self._rng.uniform(-1.0, 1.0)))

    def _flipped(self, payload: bytes) -> bytes:
        bit = int(self._rng.integers(8 * len(payload)))
        flipped = bytearray(payload)
        flipped[bit // 8] ^= 1 << bit % 8
        return bytes(flipped)

    def _forge(self, where: str) -> None:
        """Send forged packets: random bytes, or altered copies of recorded packets."""
        rng = self._rng
        recorded = self._recorded["downlink" if where == "server" else "uplink"]
        payload = rng.bytes(int(rng.integers(1, 600)))
        if recorded and rng.random() < 0.8:
            payload = recorded[int(rng.integers(len(recorded)))][1].payload
            size, at = len(payload), int(rng.integers(len(payload)))
            match rng.integers(4):
                case 0:
                    payload = self._flipped(payload)
                case 1:
                    payload = payload[:at]
                case 2:
                    payload = payload[:at] + rng.bytes(size - at)
                case _:  # a higher counter, so that the packet looks newer
                    payload = payload[:8] + rng.bytes(8) + payload[16:]
        socket = STRANGERS_SOCKET + int(rng.integers(STRANGERS))
        clients = list(self._clients.values())
        to = (
            (SERVER, NETEM)[rng.integers(2)]
            if where == "server"
            else clients[int(rng.integers(len(clients)))]
        )
        self._out.append(Datagram(payload, to, socket))
        self.counts[f"packets: {FaultKind.FLOOD}"] += 1


class Observer(Endpoint):
    """Attacker on another host that sends copies of vehicles' packets to netem from many ports.

    The answers go to the vehicles through `saboteur`, under the server's address.
    """

    def __init__(self, rng: np.random.Generator, saboteur: Saboteur) -> None:
        super().__init__()
        self._rng, self._saboteur = rng, saboteur
        self._on: dict[ScheduledFault, int] = {}
        """Number of ports that each active fault sends from."""
        self._sent = 0
        self._volley_ns: int | None = None

    def begin(self, fault: ScheduledFault, now_ns: int) -> None:
        self._on[fault] = int(self._rng.integers(*CROWD_PORTS))
        self._volley_ns = now_ns

    def end(self, fault: ScheduledFault) -> None:
        del self._on[fault]

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        self.send(datagram.payload, SABOTEUR)

    def wake(self, *, now_ns: int) -> None:
        if self._volley_ns is None or now_ns < self._volley_ns:
            return
        for fault, ports in self._on.items():
            for _ in range(self._rng.poisson(fault.amount * FLOOD_NS / SECOND_NS)):
                payload = self._saboteur.copy()
                if payload is not None:
                    self._sent += 1
                    self.send(payload, NETEM, self._sent % ports)
                    self._saboteur.counts[f"packets: {FaultKind.CROWD}"] += 1
        self._volley_ns = now_ns + FLOOD_NS if self._on else None

    def next_wake_ns(self) -> int | None:
        return self._volley_ns
