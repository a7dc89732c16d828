"""UDP proxy that emulates the network and never decodes packets.

Clients send to netem's bound socket. Each client address is a flow with a socket of its own towards
the server, so that the server's answers are sent back to the right client. As in the paper, uplink
is server to client, downlink is client to server.

If no place is free for a new client, it replaces a flow chosen by `places`. A server address that
leads back to netem is detected: until the server has sent its first packet, a packet that has come
from LAPS_MAX new addresses, one after another, opens no further flow. The first packet that is too
long, and the first that does not reach the server, are reported.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from skytether.netem.fate import Fates
from skytether.netem.link import QUEUE_MAX, Lane, Link
from skytether.netem.places import Flow, Places
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.core.endpoint import (
    Address,
    Datagram,
    Endpoint,
    host_of,
    make_datagram,
)
from skytether.shared.core.events import Fault, FlowOpened, Returned, TooLong, Unreachable
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Recorder

FLOWS_MAX = 512
"""Default largest number of clients at once; packets of further clients are dropped and counted."""
LAPS_MAX = 16
"""Largest number of flows, each from another address, that one packet opens before an answer."""


class Proxy(Endpoint):
    """Delays, reorders and loses datagrams between one server and at most `flows` clients.

    Args:
        path: number of the session's path, from 0, in the record.
    """

    changeable = keys_of(InFlight.IMPAIRMENT)
    patience_ns = MILLISECOND_NS // 4

    def __init__(
        self,
        scenario: Scenario,
        *,
        server: Address,
        flows: int = FLOWS_MAX,
        recorder: Recorder | None = None,
        path: int = 0,
    ) -> None:
        super().__init__()
        self._flows_max = flows
        self._scenario = scenario
        self._server = server
        self._mtu = mtu = scenario.network.mtu
        self.uplink = Link(UPLINK, mtu, recorder, scenario.uplink, path)
        self.downlink = Link(DOWNLINK, mtu, recorder, scenario.downlink, path)
        self._places = Places(flows)
        self._by_socket: dict[int, Flow] = {}
        self._opened = 0
        self._is_answered = False
        """Whether the server has ever sent a packet."""
        self._is_looped = False
        """Whether a loop of packets was reported."""
        self._is_too_long = False
        """Whether a packet that is too long was reported."""
        self._is_unreachable = False
        """Whether packets to the server have failed since its last answer."""
        self._passed: OrderedDict[bytes, tuple[int, Address]] = OrderedDict()
        """Until the server answers: laps of each of the newest packets, and the latest client that
        sent it, by digest of the packet."""
        self._faults: set[str] = set()
        """Tracebacks of plug-ins' errors that were reported."""
        self.refused = 0
        """Number of packets from clients without a flow, and to a flow's socket not from the
        server."""

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
            self._report_faults(flow)
        self._places.hear(flow, now_ns, is_answer=socket != 0)
        # A packet without delay leaves now, not at the next wake.
        if may_leave:
            self._forward(now_ns)

    def _report_faults(self, flow: Flow) -> None:
        for lane in (flow.uplink, flow.downlink):
            if lane.fates.fault and lane.fates.fault not in self._faults:
                self._faults.add(lane.fates.fault)
                self._events.append(Fault(traceback=lane.fates.fault))

    def undelivered(self, socket: int, reason: str) -> None:
        """See `Endpoint`; undelivered packets to clients, which come and go, are only counted."""
        counts = self.downlink.counts if socket else self.uplink.counts
        counts.forwarded -= 1
        counts.undelivered += 1
        if socket and not self._is_unreachable:
            self._is_unreachable = True
            host, port = self._server
            self._events.append(Unreachable(host=host, port=port, reason=reason))

    def wake(self, *, now_ns: int) -> None:
        self._forward(now_ns)

    def _forward(self, now_ns: int) -> None:
        for link in (self.uplink, self.downlink):
            if link.is_due(now_ns):
                self._out += link.release(now_ns=now_ns)

    def next_wake_ns(self) -> int | None:
        up_ns, down_ns = self.uplink.next_due_ns(), self.downlink.next_due_ns()
        if up_ns is None or (down_ns is not None and down_ns < up_ns):
            return down_ns
        return up_ns

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
        number = self._opened
        self._opened += 1
        flow = Flow(
            client,
            socket,
            Lane(number, self._fates("uplink", number), now_ns),
            Lane(number, self._fates("downlink", number), now_ns),
            now_ns,
            host_of(client),
            self._places.others,
            laps,
        )
        flow.order.append(flow)
        self._by_socket[socket] = flow
        self._events.append(FlowOpened(flow=number, host=host, port=port))
        return flow

    def _laps(self, datagram: Datagram) -> int:
        """Number of new addresses, one after another, from which a packet has come.

        If no server answers, such a packet is one that netem itself has sent.
        """
        passed = self._passed.get(_digest(datagram.payload)) if not self._is_answered else None
        if passed is None:
            return 0
        laps = passed[0] + (passed[1] != datagram.peer)
        if laps == LAPS_MAX + 1 and not self._is_looped:
            self._is_looped = True
            self._events.append(Returned(times=laps))
        return laps

    def _note(self, payload: bytes, flow: Flow) -> None:
        digest = _digest(payload)
        laps, client = self._passed.pop(digest, (0, flow.client))
        self._passed[digest] = (laps, client) if laps > flow.laps else (flow.laps, flow.client)
        if len(self._passed) > QUEUE_MAX:
            self._passed.popitem(last=False)

    def _fates(self, name: Literal["uplink", "downlink"], flow: int) -> Fates:
        direction = getattr(self._scenario, name)
        return Fates(direction, self._scenario.seed, name, flow)

    def change(
        self,
        scenario: Scenario,
        keys: frozenset[str],  # noqa: ARG002
        *,
        now_ns: int,
    ) -> None:
        """See `Endpoint`; queued packets keep their fate."""
        self._scenario = scenario
        self.uplink.change(scenario.uplink, now_ns=now_ns)
        self.downlink.change(scenario.downlink, now_ns=now_ns)
        for flow in self._by_socket.values():
            flow.uplink.fates = self._fates("uplink", flow.uplink.flow)
            flow.downlink.fates = self._fates("downlink", flow.downlink.flow)

    def figures(self) -> dict[str, Any]:
        return {
            "flows": len(self._by_socket),
            "refused": self.refused,
            "uplink": self.uplink.figures(),
            "downlink": self.downlink.figures(),
        }


def of_paths(each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of the netems of a session's paths together, as those of one netem.

    Counts of several paths are added up, and `by_path` has the figures of each, from 1.
    """
    if len(each) == 1:
        return dict(each[0])
    return _added(each) | {"by_path": {str(i): dict(one) for i, one in enumerate(each, start=1)}}


def _added(each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sums of the counts with one name, in groups too; no quantiles and no maxima."""
    total: dict[str, Any] = {}
    for name in dict.fromkeys(name for one in each for name in one):
        values = [one[name] for one in each if name in one]
        if isinstance(values[0], Mapping):
            total[name] = _added(values)
        elif isinstance(values[0], int) and not name.endswith("_max"):
            total[name] = sum(values)
    return total


def _digest(payload: bytes) -> bytes:
    return hashlib.blake2s(payload, digest_size=16).digest()
