"""UDP proxy that stands for the network and never decodes what it carries.

Clients send to netem's bound socket. Each client address is a flow with a socket of its own towards
the server, so that the server's answers find their way back. Uplink is server to client, downlink
is client to server, as in the paper.

A flow that the server has answered keeps its place while it is used. Where no place is free, any
other gives way to a new client at once, the one first whose last packet is oldest: what strangers
send takes no place from those who fly, and none for long from those who come.
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Literal

from skytether.netem.fate import Fates
from skytether.netem.link import Lane, Link
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.core.endpoint import Address, Datagram, Endpoint, make_datagram
from skytether.shared.core.events import Fault, FlowOpened
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import DirectionConfig, Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Recorder

FLOWS_MAX = 512
"""Largest number of clients at once by default; packets of others are dropped and counted."""
IDLE_NS = 60 * SECOND_NS
"""Time without a packet after which a flow that was answered gives way to a new client [ns]."""


@dataclass(slots=True)
class Flow:
    """State of one client address."""

    client: Address
    socket: int
    """Number of its socket towards the server, from 1."""
    uplink: Lane
    downlink: Lane
    used_ns: int
    """Time of its newest packet, either way."""
    order: "OrderedDict[Address, Flow]"
    """Flows among which it stands, answered or unanswered, by client, oldest packet first."""


class Proxy(Endpoint):
    """Delays, reorders and loses datagrams between clients and one server.

    Args:
        scenario: `network` and `seed` of it are used.
        server: address of the server.
        flows: most clients at once, a socket each.
        recorder: takes one row a packet.
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
    ) -> None:
        super().__init__()
        self._flows_max = flows
        self._scenario = scenario
        self._server = server
        mtu = scenario.network.mtu
        network = scenario.network
        self.uplink = Link(UPLINK, mtu, recorder, network.uplink.path)
        self.downlink = Link(DOWNLINK, mtu, recorder, network.downlink.path)
        self._answered: OrderedDict[Address, Flow] = OrderedDict()
        """Flows through which a packet of the server's has come, by client, oldest packet first."""
        self._unanswered: OrderedDict[Address, Flow] = OrderedDict()
        """All other flows, by client, oldest packet first."""
        self._by_socket: dict[int, Flow] = {}
        self._opened = 0
        self._faults: set[str] = set()
        """Tracebacks of mistakes in plug-ins that were reported."""
        self.refused = 0
        """Packets of clients for which there is no flow, and of strangers at a flow's socket."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Take a packet that enters the network."""
        payload, peer, socket = datagram
        # Socket 0 is the one that clients send to.
        if socket == 0:
            flow = self._answered.get(peer) or self._unanswered.get(peer)
            flow = flow or self._open(peer, now_ns)
            if flow is None:
                self.refused += 1
                return
            onward = make_datagram((payload, self._server, flow.socket))
            may_leave = self.downlink.take(onward, flow.downlink, now_ns=now_ns)
        else:
            flow = self._by_socket.get(socket)
            # A flow's socket is open to anybody, and only the server may answer through it.
            if flow is None or peer != self._server:
                self.refused += 1
                return
            onward = make_datagram((payload, flow.client, 0))
            may_leave = self.uplink.take(onward, flow.uplink, now_ns=now_ns)
            # Its place is earned by the server's answer, for a sender's address can be made up.
            if flow.order is self._unanswered:
                flow.order = self._answered
                self._answered[flow.client] = self._unanswered.pop(flow.client)
        if flow.uplink.fates.fault or flow.downlink.fates.fault:
            self._tell_faults(flow)
        flow.used_ns = now_ns
        # Both dictionaries stay ordered by use: the oldest flow is found without a search, also in
        # a flood of new clients.
        flow.order.move_to_end(flow.client)
        # What is not delayed leaves now, and not a wake later.
        if may_leave:
            self._forward(now_ns)

    def _tell_faults(self, flow: Flow) -> None:
        for lane in (flow.uplink, flow.downlink):
            if lane.fates.fault and lane.fates.fault not in self._faults:
                self._faults.add(lane.fates.fault)
                self._events.append(Fault(traceback=lane.fates.fault))

    def wake(self, *, now_ns: int) -> None:
        """Send the packets that are due."""
        self._forward(now_ns)

    def _forward(self, now_ns: int) -> None:
        for link in (self.uplink, self.downlink):
            if link.is_due(now_ns):
                self._out += link.give(now_ns=now_ns)

    def next_wake_ns(self) -> int | None:
        """Time at which the next packet is due."""
        up_ns, down_ns = self.uplink.next_due_ns(), self.downlink.next_due_ns()
        if up_ns is None or (down_ns is not None and down_ns < up_ns):
            return down_ns
        return up_ns

    def _open(self, client: Address, now_ns: int) -> Flow | None:
        socket = len(self._by_socket) + 1
        if socket > self._flows_max:
            # Sockets are never closed: a flow that gives way leaves its own to the next.
            oldest = self._oldest(now_ns)
            if oldest is None:
                return None
            del oldest.order[oldest.client]
            socket = oldest.socket
        number = self._opened
        self._opened += 1
        flow = Flow(
            client,
            socket,
            Lane(number, self._fates("uplink", number), now_ns),
            Lane(number, self._fates("downlink", number), now_ns),
            now_ns,
            self._unanswered,
        )
        self._unanswered[client] = self._by_socket[socket] = flow
        host, port = client
        self._events.append(FlowOpened(flow=number, host=host, port=port))
        return flow

    def _fates(self, name: Literal["uplink", "downlink"], flow: int) -> Fates:
        """Fates of the packets of a flow in one direction."""
        direction: DirectionConfig = getattr(self._scenario.network, name)
        return Fates(direction, self._scenario.seed, name, flow)

    def change(
        self,
        scenario: Scenario,
        keys: frozenset[str],  # noqa: ARG002
        *,
        now_ns: int,
    ) -> None:
        """See `Endpoint`; packets that are under way keep their fate."""
        self._scenario = scenario
        self.uplink.change(scenario.network.uplink.path, now_ns=now_ns)
        self.downlink.change(scenario.network.downlink.path, now_ns=now_ns)
        for flow in self._by_socket.values():
            flow.uplink.fates = self._fates("uplink", flow.uplink.flow)
            flow.downlink.fates = self._fates("downlink", flow.downlink.flow)

    def _oldest(self, now_ns: int) -> Flow | None:
        """Flow that gives way to a new client; None where none does."""
        unanswered = next(iter(self._unanswered.values()), None)
        answered = next(iter(self._answered.values()), None)
        if answered is None or now_ns - answered.used_ns < IDLE_NS:
            return unanswered
        if unanswered is None or answered.used_ns < unanswered.used_ns:
            return answered
        return unanswered

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        return {
            "flows": len(self._by_socket),
            "refused": self.refused,
            "uplink": self.uplink.figures(),
            "downlink": self.downlink.figures(),
        }
