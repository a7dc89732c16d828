"""Places of netem: the flows that hold one, and the order in which they give way to new clients.

netem reads no payload, so it cannot tell a vehicle from somebody who repeats a vehicle's packets.
It can count. An exchange is a packet of the client's followed by one of the server's, and
EXCHANGES of them earn a flow its place for EARNED_NS. One answer earns nothing, because anybody can
provoke it. Where no place is free, the first of these gives way to a new client:

    1. the oldest flow that is not earned, if it is unused for IDLE_NS
    2. the oldest that is not earned of the new client's own host, if that has more than HOST_FLOWS
    3. where fewer than one place of TRIALS is not earned: the oldest flow of another host that has
       earned more than HOST_FLOWS places
    4. the oldest that is not earned of a host with more than HOST_FLOWS such flows
    5. the oldest that is not earned

So who holds a place must go on exchanging packets at the rate of a slow vehicle in each of them,
and who has one address keeps no more than HOST_FLOWS from others.
"""

from collections import OrderedDict
from dataclasses import dataclass

from skytether.netem.link import Lane
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.endpoint import Address

# A vehicle and its server each send a packet at least three times within `link.timeout_s`.
EXCHANGES = 8
"""Number of exchanges that earn a flow its place."""
EARNED_NS = 10 * SECOND_NS
"""Time for which a place is earned [ns]."""
IDLE_NS = 5 * SECOND_NS
"""Time without a packet after which a flow gives way before those of a crowded host [ns]."""
HOST_FLOWS = 64
"""Largest number of flows of a host that do not give way before those of other hosts."""
TRIALS = 8
"""Divisor of the number of places: so large a part of them is not kept from new clients by a host
with more than HOST_FLOWS."""


@dataclass(slots=True)
class Flow:
    """State of one client address."""

    client: Address
    socket: int
    """Number of its socket towards the server, from 1."""
    uplink: Lane
    downlink: Lane
    used_ns: int
    """Time of the newest packet of the flow, in either direction [ns]."""
    host: str
    """Host of the client, see `shared.core.endpoint.host_of`."""
    order: "Order"
    """Flows among which it stands: those that have earned their place, or the others."""
    laps: int
    """Number of times that the packet which opened it had passed from other addresses before."""
    asks: bool = False
    """Whether a packet of the client's has come since the newest exchange."""
    exchanges: int = 0
    """Number of exchanges since it earned its place last."""
    earned_ns: int = 0
    """Time at which it earned its place last."""


class Order:
    """Flows in an order, the oldest first, all together and by host."""

    def __init__(self) -> None:
        self.flows: OrderedDict[Address, Flow] = OrderedDict()
        """All flows by client."""
        self._hosts: dict[str, OrderedDict[Address, Flow]] = {}
        """Flows of each host by client."""
        self._crowded: dict[str, None] = {}
        """Hosts with more than HOST_FLOWS flows."""

    def append(self, flow: Flow) -> None:
        """Put a flow in as the newest."""
        of_host = self._hosts.setdefault(flow.host, OrderedDict())
        self.flows[flow.client] = of_host[flow.client] = flow
        if len(of_host) > HOST_FLOWS:
            self._crowded[flow.host] = None

    def remove(self, flow: Flow) -> None:
        """Take a flow out."""
        of_host = self._hosts[flow.host]
        del self.flows[flow.client], of_host[flow.client]
        if len(of_host) <= HOST_FLOWS:
            self._crowded.pop(flow.host, None)
        if not of_host:
            del self._hosts[flow.host]

    def renew(self, flow: Flow) -> None:
        """Make a flow the newest."""
        self.flows.move_to_end(flow.client)
        self._hosts[flow.host].move_to_end(flow.client)

    def count(self, host: str) -> int:
        """Number of flows of a host."""
        return len(self._hosts.get(host, ()))

    def oldest(self, host: str = "") -> Flow | None:
        """Oldest flow of all, or of one host; None where there is none."""
        flows = self._hosts.get(host) if host else self.flows
        return next(iter(flows.values())) if flows else None

    def oldest_of_a_crowd(self, but: str = "") -> Flow | None:
        """Oldest flow of a host with more than HOST_FLOWS; None where there is none.

        Args:
            but: host that does not count.
        """
        return next((self.oldest(host) for host in self._crowded if host != but), None)


class Places:
    """Flows that hold a place.

    Args:
        count: number of places.
    """

    def __init__(self, count: int) -> None:
        self._trials = count // TRIALS
        """Number of places that a host with more than HOST_FLOWS does not keep from others."""
        self._earned = Order()
        """Flows that have earned their place, in the order in which they last did."""
        self.others = Order()
        """All other flows, in the order of their last packets."""

    def find(self, client: Address) -> Flow | None:
        """Flow of a client, or None."""
        return self._earned.flows.get(client) or self.others.flows.get(client)

    def hear(self, flow: Flow, now_ns: int, *, is_answer: bool) -> None:
        """Note a packet of a flow.

        Args:
            flow: the flow.
            now_ns: time now.
            is_answer: whether the server has sent it, and not the client.
        """
        flow.used_ns = now_ns
        if is_answer and flow.asks:
            flow.exchanges += 1
        flow.asks = not is_answer
        if flow.exchanges == EXCHANGES:
            flow.exchanges, flow.earned_ns = 0, now_ns
            self._put(flow, self._earned)
        elif flow.order is self.others:
            flow.order.renew(flow)

    def gives_way(self, host: str, now_ns: int) -> Flow | None:
        """Flow that gives way to a new client of a host, now without a place; None if none does."""
        earned, others = self._earned, self.others
        while (last := earned.oldest()) and now_ns - last.earned_ns >= EARNED_NS:
            self._put(last, others)
        flow = others.oldest()
        if flow is None or now_ns - flow.used_ns < IDLE_NS:
            flow = self._crowding(host) or flow
        if flow is not None:
            flow.order.remove(flow)
        return flow

    def _crowding(self, host: str) -> Flow | None:
        """Flow of a host with more than HOST_FLOWS that gives way to a new client of a host."""
        earned, others = self._earned, self.others
        if earned.count(host) + others.count(host) > HOST_FLOWS and others.count(host):
            return others.oldest(host)
        if len(others.flows) < self._trials and (flow := earned.oldest_of_a_crowd(but=host)):
            return flow
        return others.oldest_of_a_crowd()

    def _put(self, flow: Flow, order: Order) -> None:
        flow.order.remove(flow)
        flow.order = order
        order.append(flow)
