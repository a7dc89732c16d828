"""UDP proxy that emulates the network and never decodes packets.

Clients send to netem's bound socket. Each client address is a flow with its own socket towards the
server, so that the server's answers are sent back to the right client. As in the paper, uplink is
server to client, downlink is client to server.

If no place is free, a new client replaces a flow that `places` chooses. netem detects a server
address that leads back to netem itself: before the server's first packet, a packet that has arrived
from LAPS_MAX new addresses, one after another, opens no further flow. netem reports the first
packet that is too long, and the first that does not reach the server.
"""

from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from skytether.netem.emulator import Emulator
from skytether.netem.link import QUEUE_MAX, Lane
from skytether.netem.places import Flow, Places
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.endpoints.endpoint import (
    Address,
    Datagram,
    host_of,
    make_datagram,
)
from skytether.shared.events.flight import FlowOpened, Returned, TooLong, Unreachable
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder

FLOWS_MAX = 512
"""Default largest number of clients at once; packets of further clients are dropped and counted."""
LAPS_MAX = 16
"""Largest number of flows that copies of one packet open before the server's first answer."""


class Proxy(Emulator):
    """Delays, reorders and loses datagrams between one server and at most `flows` clients.

    Args:
        directions, recorder, path: see `Emulator`.
    """

    patience_ns = MILLISECOND_NS // 4

    def __init__(
        self,
        scenario: Scenario,
        *,
        server: Address,
        flows: int = FLOWS_MAX,
        directions: Directions = FLIGHT,
        recorder: Recorder | None = None,
        path: int = 0,
    ) -> None:
        self._mtu = mtu = scenario.network.mtu
        super().__init__(scenario, mtu=mtu, directions=directions, recorder=recorder, path=path)
        self._flows_max = flows
        self._server = server
        self._places = Places(flows)
        self._by_socket: dict[int, Flow] = {}
        self._is_answered = False
        """Whether the server has ever sent a packet."""
        self._is_looped = False
        """Whether a loop of packets was reported."""
        self._is_too_long = False
        """Whether a packet that is too long was reported."""
        self._is_unreachable = False
        """Whether a packet to the server could not be delivered since the server's last answer."""
        self._passed: OrderedDict[int, tuple[int, Address]] = OrderedDict()
        """Number of new addresses (`_laps`) and latest client of each of the newest packets, by
        Python's keyed hash of the payload (64 bits); empty after the server's first answer."""
        self.refused = 0
        """Number of dropped packets: of clients that got no flow, and of senders other than the
        server to a flow's socket."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        payload, peer, socket = datagram
        if len(payload) > self._mtu and not self._is_too_long:
            self._is_too_long = True
            self._events.append(TooLong(size=len(payload), most=self._mtu))
        # Clients send to socket 0.
        if socket == 0:
            flow = self._places.find(peer) or self._open(datagram, now_ns)
            if flow is None:
                self.refused += 1
                return
            if not self._is_answered:
                self._note(payload, flow)
            onward = make_datagram((payload, self._server, flow.socket))
            may_leave = self.downlink.accept(onward, flow.downlink, now_ns=now_ns)
        else:
            flow = self._by_socket.get(socket)
            # Anybody can send to a flow's socket, but only the server may answer through it.
            if flow is None or peer != self._server:
                self.refused += 1
                return
            onward = make_datagram((payload, flow.client, 0))
            may_leave = self.uplink.accept(onward, flow.uplink, now_ns=now_ns)
            self._is_answered, self._is_unreachable = True, False
            self._passed.clear()
        if flow.uplink.fates.fault or flow.downlink.fates.fault:
            self._report(flow.uplink.fates.fault)
            self._report(flow.downlink.fates.fault)
        self._places.hear(flow, now_ns, is_answer=socket != 0)
        # A packet without delay leaves now, not at the next wake.
        if may_leave:
            self._forward(now_ns)

    def undelivered(self, socket: int, reason: str) -> None:
        """Count an undelivered packet. The first one to the server since the server's last answer
        is also reported; packets to clients are not, because clients may have ended.
        """
        counts = self.downlink.counts if socket else self.uplink.counts
        counts.forwarded -= 1
        counts.undelivered += 1
        if socket and not self._is_unreachable:
            self._is_unreachable = True
            host, port = self._server
            self._events.append(Unreachable(host=host, port=port, reason=reason))

    def _open(self, datagram: Datagram, now_ns: int) -> Flow | None:
        client = host, port = datagram.peer
        laps = self._laps(datagram)
        if laps > LAPS_MAX:
            return None
        socket = len(self._by_socket) + 1
        if socket > self._flows_max:
            # Sockets are never closed: a new flow takes over the socket of the flow that it
            # replaces.
            replaced = self._places.replace(host_of(client), now_ns)
            if replaced is None:
                return None
            socket = replaced.socket
        flow = Flow(
            client,
            socket,
            *self._open_lanes(now_ns),
            now_ns,
            host_of(client),
            self._places.others,
            laps,
        )
        flow.order.append(flow)
        self._by_socket[socket] = flow
        self._events.append(FlowOpened(flow=flow.uplink.flow, host=host, port=port))
        return flow

    def _laps(self, datagram: Datagram) -> int:
        """Number of new addresses, one after another, from which the same packet has arrived.

        Many such addresses before the server's first answer mean that netem's packets come back.
        """
        passed = self._passed.get(hash(datagram.payload)) if not self._is_answered else None
        if passed is None:
            return 0
        laps = passed[0] + (passed[1] != datagram.peer)
        if laps == LAPS_MAX + 1 and not self._is_looped:
            self._is_looped = True
            self._events.append(Returned(times=laps))
        return laps

    def _note(self, payload: bytes, flow: Flow) -> None:
        key = hash(payload)
        laps, client = self._passed.pop(key, (0, flow.client))
        self._passed[key] = (laps, client) if laps > flow.laps else (flow.laps, flow.client)
        if len(self._passed) > QUEUE_MAX:
            self._passed.popitem(last=False)

    def lanes(self) -> Iterable[tuple[Lane, Lane]]:
        return ((flow.uplink, flow.downlink) for flow in self._by_socket.values())

    def figures(self) -> dict[str, Any]:
        return {"flows": len(self._by_socket), "refused": self.refused} | super().figures()


def merged(each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of the netems of a session's paths, combined in the form of one netem's figures.

    Counts of several paths are added up, and `by_path` has the figures of each, from 1.
    """
    if len(each) == 1:
        return dict(each[0])
    return _added(each) | {"by_path": {str(i): dict(one) for i, one in enumerate(each, start=1)}}


def _added(each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sums of the counts of the same name, also within groups, without quantiles and maxima."""
    total: dict[str, Any] = {}
    for name in dict.fromkeys(name for one in each for name in one):
        values = [one[name] for one in each if name in one]
        if isinstance(values[0], Mapping):
            total[name] = _added(values)
        elif isinstance(values[0], int) and not name.endswith("_max"):
            total[name] = sum(values)
    return total
