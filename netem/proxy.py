"""netem: a UDP proxy that stands for the network and never decodes what it carries.

Clients send to its bound socket. Each client address is a flow with a socket of its own towards the
server, so that the server's answers find their way back. Uplink is server to client, downlink
client to server, as in the paper.
"""

from dataclasses import dataclass
from typing import Any

from netem.fate import fates
from netem.link import Counts, Lane, Link
from shared.config import Scenario
from shared.endpoint import SECOND_NS, Address, Datagram, Endpoint
from shared.record import DOWNLINK, UPLINK, Recorder

FLOWS_MAX = 512
"""Clients at once, unless more are asked for; a packet of a further one is dropped and counted."""
IDLE_NS = 60 * SECOND_NS
"""A flow without a packet for so long gives its place, and its socket, to a new client."""


@dataclass(slots=True)
class Flow:
    """One client address."""

    client: Address
    socket: int
    uplink: Lane
    downlink: Lane
    used_ns: int


class Proxy(Endpoint):
    """Delays, reorders and loses datagrams between clients and one server.

    Args:
        scenario: its `network` and `seed`.
        server: where the server is.
        flows: clients at once, a socket each.
        recorder: takes one row a packet.
    """

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
        self.uplink = Link(UPLINK, recorder)
        self.downlink = Link(DOWNLINK, recorder)
        self._by_client: dict[Address, Flow] = {}
        self._by_socket: dict[int, Flow] = {}
        self._opened = 0
        self.refused = 0
        """Packets of clients beyond the last flow, and of strangers at a flow's socket."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """A packet enters the network."""
        payload, peer, socket = datagram
        if socket == 0:
            flow = self._by_client.get(peer) or self._open(peer, now_ns)
            if flow is None:
                self.refused += 1
                return
            onward = Datagram(payload, self._server, flow.socket)
            self.downlink.take(onward, flow.downlink, now_ns=now_ns)
        else:
            flow = self._by_socket.get(socket)
            if flow is None or peer != self._server:
                self.refused += 1
                return
            self.uplink.take(Datagram(payload, flow.client), flow.uplink, now_ns=now_ns)
        flow.used_ns = now_ns
        self._forward(now_ns)

    def wake(self, *, now_ns: int) -> None:
        """Packets that are due leave it."""
        self._forward(now_ns)

    def _forward(self, now_ns: int) -> None:
        self._out += self.uplink.give(now_ns=now_ns)
        self._out += self.downlink.give(now_ns=now_ns)

    def next_wake_ns(self) -> int | None:
        """When the next packet is due."""
        up_ns, down_ns = self.uplink.next_due_ns(), self.downlink.next_due_ns()
        if up_ns is None or (down_ns is not None and down_ns < up_ns):
            return down_ns
        return up_ns

    def _open(self, client: Address, now_ns: int) -> Flow | None:
        socket = len(self._by_socket) + 1
        if socket > self._flows_max:
            idle = min(self._by_socket.values(), key=lambda flow: flow.used_ns)
            if now_ns - idle.used_ns < IDLE_NS:
                return None
            del self._by_client[idle.client]
            socket = idle.socket
        number = self._opened
        self._opened += 1
        network, seed = self._scenario.network, self._scenario.seed
        flow = Flow(
            client,
            socket,
            Lane(number, fates(network.uplink, seed, "uplink", number)),
            Lane(number, fates(network.downlink, seed, "downlink", number)),
            now_ns,
        )
        self._by_client[client] = self._by_socket[socket] = flow
        self._news.append(f"flow {number} for {client[0]}:{client[1]}")
        return flow

    def report(self) -> str:
        """See `Endpoint`."""
        return "\n".join(
            [
                f"{len(self._by_socket)} flows, {self.refused} packets refused",
                _describe("uplink", self.uplink.counts, self.uplink.depth()),
                _describe("downlink", self.downlink.counts, self.downlink.depth()),
            ]
        )

    def figures(self) -> dict[str, Any]:
        """See `Endpoint`."""
        figures: dict[str, Any] = {"flows": len(self._by_socket), "refused": self.refused}
        for name, link in (("uplink", self.uplink), ("downlink", self.downlink)):
            counts = link.counts
            figures[name] = {
                "packets": counts.packets,
                "bytes": counts.bytes,
                "lost": counts.lost,
                "overflowed": counts.overflowed,
                "error_ms_p99": counts.error.quantile_ms(0.99),
            }
        return figures


def _describe(name: str, counts: Counts, depth: int) -> str:
    error = counts.error
    return (
        f"{name}: {counts.packets} packets, {counts.forwarded} forwarded, {counts.lost} lost, "
        f"{counts.reordered} reordered, {counts.overflowed} overflowed, "
        f"queue {depth} (at most {counts.depth_max})\n"
        f"  delay: {counts.delay}\n"
        f"  added-delay error: p50 {error.quantile_ms(0.5):.2f} ms, "
        f"p99 {error.quantile_ms(0.99):.2f} ms, largest {error.largest_ns / 1e6:.2f} ms"
    )
