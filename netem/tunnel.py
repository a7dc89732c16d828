"""Tunnel: the network of one program, which carries the program's IP packets both ways.

The uplink leads to the program, as it does to a vehicle; the downlink leads from the program. A
program that sends the same packets gets the same network in each run, see `impairments.draws`.
"""

from collections import OrderedDict
from collections.abc import Iterable
from typing import Any

from skytether.netem.emulator import Direction, Emulator
from skytether.netem.fate import Fates
from skytether.netem.link import Lane
from skytether.shared.base.packets import OUTSIDE, PROGRAM, flow_of, too_long
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.endpoints.other_directions import RUN
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import Recorder

FLOWS_MAX = 16_384
"""Largest number of flows stored; a further flow replaces the flow that was silent longest."""


class Tunnel(Emulator):
    """Delays, reorders and loses packets between a program and the outside.

    A datagram's peer is PROGRAM or OUTSIDE, and its payload a packet of IP; an empty payload means
    that the peer has ended. The tunnel ends when OUTSIDE ends, or when PROGRAM has ended and its
    last packet has left.

    Args:
        mtu: largest packet that passes [B]; the program gets an ICMP error for a longer one.
    """

    def __init__(self, scenario: Scenario, *, mtu: int, recorder: Recorder | None = None) -> None:
        super().__init__(scenario, mtu=mtu, directions=RUN, recorder=recorder, header_bytes=0)
        self._mtu = mtu
        self._flows: OrderedDict[bytes, tuple[Lane, Lane]] = OrderedDict()
        """Uplink and downlink of each flow by its key; the flow that was silent longest is first.

        A flow is all packets, both ways, with the same protocol, addresses and ports."""
        self._began_ns = 0
        """Time of the first packet [ns]; outages and traces of all flows count from this time."""
        self._has_ended = self._is_cut = False
        """Whether an empty payload has arrived from PROGRAM, and whether one has from OUTSIDE."""
        self.refused = 0
        """Number of packets that were not IP packets."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        packet, peer, number = datagram
        is_outward = peer == PROGRAM
        if not packet:
            self._has_ended |= is_outward
            self._is_cut |= not is_outward
            return
        key = flow_of(packet, is_outward=is_outward)
        if key is None:
            self.refused += 1
            return
        if key not in self._flows:
            self._began_ns = self._began_ns or now_ns
            self._flows[key] = self._open_lanes(self._began_ns)
            if len(self._flows) > FLOWS_MAX:
                self._flows.popitem(last=False)
        up, down = self._flows[key]
        self._flows.move_to_end(key)
        link, lane = (self.downlink, down) if is_outward else (self.uplink, up)
        onward = Datagram(packet, OUTSIDE if is_outward else PROGRAM, number)
        may_leave = link.accept(onward, lane, now_ns=now_ns)
        if len(packet) > self._mtu and is_outward and (answer := too_long(packet, self._mtu)):
            self.send(answer, PROGRAM, number)
        self._report(lane.fates.fault)
        if may_leave:  # a packet without delay leaves now, not at the next wake
            self._forward(now_ns)

    @property
    def finished(self) -> bool:
        return self._is_cut or (self._has_ended and self.downlink.next_due_ns() is None)

    def lanes(self) -> Iterable[tuple[Lane, Lane]]:
        return self._flows.values()

    def fates(self, name: Direction, flow: int) -> Fates:
        at = self._scenario.seed, name, flow
        return Fates(self.link(name).impairments, *at, by_number=True, is_common=True)

    def figures(self) -> dict[str, Any]:
        counts = {"flows": len(self._flows), "refused": self.refused, "header_bytes": 0}
        return counts | super().figures()
