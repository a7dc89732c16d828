"""Places of netem: a limited number of flows, and the order in which new clients replace them.

netem reads no payload, so it cannot distinguish a vehicle from an attacker who repeats a vehicle's
packets. netem counts exchanges instead. An exchange is a packet of the client followed by one of
the server; EXCHANGES exchanges earn a flow its place for EARNED_NS. One exchange is not enough,
because anybody can make the server answer once. If no place is free, a new client replaces the
first of these that exists:

    1. the oldest unearned flow, if it is unused for IDLE_NS
    2. the oldest unearned flow of the new client's host, if that host has over HOST_FLOWS flows
    3. if fewer than one place in TRIALS is unearned: the oldest flow of another host that has
       earned more than HOST_FLOWS places
    4. the oldest unearned flow of a host with more than HOST_FLOWS such flows
    5. the oldest unearned flow

So a flow keeps its place only if it exchanges packets at least as often as a slow vehicle, and a
single host can occupy at most HOST_FLOWS places that others need.
"""

from collections import OrderedDict
from dataclasses import dataclass

from skytether.netem.link import Lane
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address

# These values suit vehicles: a vehicle and its server each send at least three packets within
# `link.timeout_s`.
EXCHANGES = 8
"""Number of exchanges that earn a flow its place."""
EARNED_NS = 10 * SECOND_NS
"""Time for which a flow keeps a place that it has earned [ns]."""
IDLE_NS = 5 * SECOND_NS
"""Time without a packet after which a flow is replaced before those of a crowded host [ns]."""
HOST_FLOWS = 64
"""Number of flows above which a host's flows are replaced before those of other hosts."""
TRIALS = 8
"""Hosts with over HOST_FLOWS flows must leave one place in TRIALS to other hosts."""


@dataclass(slots=True)
class Flow:
    client: Address
    socket: int
    """Number of the flow's socket towards the server, from 1."""
    uplink: Lane
    downlink: Lane
    used_ns: int
    """Time of the newest packet of the flow, in either direction [ns]."""
    host: str
    """Host of the client, see `shared.endpoints.endpoint.host_of`."""
    order: "Order"
    """Order that contains this flow: `Places._earned` or `Places.others`."""
    laps: int
    """Number of earlier addresses that sent the same packet as the flow's first."""
    asks: bool = False
    """Whether a packet of the client has arrived since the newest exchange."""
    exchanges: int = 0
    """Number of exchanges since the flow last earned its place."""
    earned_ns: int = 0
    """Time at which the flow last earned its place [ns]."""


class Order:
    """Flows ordered by time, oldest first: all flows, and the flows of each host."""

    def __init__(self) -> None:
        self.flows: OrderedDict[Address, Flow] = OrderedDict()
        self._hosts: dict[str, OrderedDict[Address, Flow]] = {}
        self._crowded: dict[str, None] = {}
        """Hosts with more than HOST_FLOWS flows."""

    def append(self, flow: Flow) -> None:
        of_host = self._hosts.setdefault(flow.host, OrderedDict())
        self.flows[flow.client] = of_host[flow.client] = flow
        if len(of_host) > HOST_FLOWS:
            self._crowded[flow.host] = None

    def remove(self, flow: Flow) -> None:
        of_host = self._hosts[flow.host]
        del self.flows[flow.client], of_host[flow.client]
        if len(of_host) <= HOST_FLOWS:
            self._crowded.pop(flow.host, None)
        if not of_host:
            del self._hosts[flow.host]

    def renew(self, flow: Flow) -> None:
        self.flows.move_to_end(flow.client)
        self._hosts[flow.host].move_to_end(flow.client)

    def count(self, host: str) -> int:
        return len(self._hosts.get(host, ()))

    def oldest(self, host: str = "") -> Flow | None:
        """Oldest flow of all, or of one host; None if there is none."""
        flows = self._hosts.get(host) if host else self.flows
        return next(iter(flows.values())) if flows else None

    def oldest_of_a_crowd(self, but: str = "") -> Flow | None:
        """Oldest flow of any host with more than HOST_FLOWS flows except `but`, or None."""
        return next((self.oldest(host) for host in self._crowded if host != but), None)


class Places:
    def __init__(self, count: int) -> None:
        self._trials = count // TRIALS
        """Number of places that hosts with over HOST_FLOWS flows must leave to others."""
        self._earned = Order()
        """Flows that have earned their place, by the time at which they last earned it."""
        self.others = Order()
        """All other flows, by the time of their last packets."""

    def find(self, client: Address) -> Flow | None:
        return self._earned.flows.get(client) or self.others.flows.get(client)

    def hear(self, flow: Flow, now_ns: int, *, is_answer: bool) -> None:
        """Note a packet of a flow, sent by the server if `is_answer`, otherwise by the client."""
        flow.used_ns = now_ns
        if is_answer and flow.asks:
            flow.exchanges += 1
        flow.asks = not is_answer
        if flow.exchanges == EXCHANGES:
            flow.exchanges, flow.earned_ns = 0, now_ns
            self._put(flow, self._earned)
        elif flow.order is self.others:
            flow.order.renew(flow)

    def replace(self, host: str, now_ns: int) -> Flow | None:
        """Remove and return the flow that a new client of a host replaces, or None."""
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
        """Flow that a new client of `host` replaces, if a host has over HOST_FLOWS flows."""
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
