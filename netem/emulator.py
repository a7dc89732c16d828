"""Both directions of an emulated network, as a base class: `proxy` carries datagrams, `relay` byte
streams, and `tunnel` packets of IP.

As in the paper, the uplink leads to the vehicle. Without a vehicle, it leads to a proxy's client or
a tunnel's program (other names: `shared.endpoints.other_directions`).
"""

from abc import abstractmethod
from collections.abc import Iterable
from typing import Any, Literal

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments
from skytether.netem.link import Lane, Link
from skytether.shared.base.units import HEADER_BYTES
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.endpoints.endpoint import Datagram, Endpoint
from skytether.shared.events.flight import Fault
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Recorder

Direction = Literal["uplink", "downlink"]


class Emulator(Endpoint):
    """Delays, reorders and loses packets or stream pieces in two directions.

    Args:
        mtu: largest payload that passes [B].
        directions: names of both directions. With the names FLIGHT a packet's fate depends on its
            time, because controllers that are compared send at different times; otherwise on its
            number in its flow.
        path: number of the session's path, from 0, in the record.
        header_bytes: size of the headers that precede the payload, see `Link`.
    """

    changeable = keys_of(InFlight.IMPAIRMENT)

    def __init__(
        self,
        scenario: Scenario,
        *,
        mtu: int,
        directions: Directions,
        recorder: Recorder | None,
        path: int = 0,
        header_bytes: int = HEADER_BYTES,
    ) -> None:
        super().__init__()
        self._scenario, self.directions = scenario, directions

        def make(direction: int, name: Direction) -> Link:
            of = self.impairments(name)
            return Link(direction, mtu, recorder, of, path, header_bytes=header_bytes)

        self.uplink, self.downlink = make(UPLINK, "uplink"), make(DOWNLINK, "downlink")
        self._opened = 0
        """Number of flows opened so far; also the number that the next flow gets."""
        self._faults: set[str] = set()
        """Tracebacks of the errors of plug-ins that were reported; each error is reported once."""

    @abstractmethod
    def lanes(self) -> Iterable[tuple[Lane, Lane]]:
        """Uplink and downlink of each flow."""

    def impairments(self, name: Direction) -> Impairments:
        of: Impairments = getattr(self._scenario, name)
        return of

    def link(self, name: Direction) -> Link:
        return self.uplink if name == "uplink" else self.downlink

    def fates(self, name: Direction, flow: int) -> Fates:
        """Fates of the packets of one flow in a direction."""
        at = self._scenario.seed, name, flow
        return Fates(self.link(name).impairments, *at, by_number=self.directions != FLIGHT)

    def _open_lanes(self, began_ns: int) -> tuple[Lane, Lane]:
        """Uplink and downlink of a new flow, whose slots count from `began_ns`."""
        flow = self._opened
        self._opened += 1
        up, down = self.fates("uplink", flow), self.fates("downlink", flow)
        return Lane(flow, up, began_ns), Lane(flow, down, began_ns)

    def wake(self, *, now_ns: int) -> None:
        self._forward(now_ns)

    def _forward(self, now_ns: int) -> None:
        for link in (self.uplink, self.downlink):
            due_ns = link.next_due_ns()
            if due_ns is not None and due_ns <= now_ns:
                self._leave(link.release(now_ns=now_ns))

    def _leave(self, datagrams: list[Datagram]) -> None:
        self._out += datagrams

    def next_wake_ns(self) -> int | None:
        up_ns, down_ns = self.uplink.next_due_ns(), self.downlink.next_due_ns()
        if up_ns is None or (down_ns is not None and down_ns < up_ns):
            return down_ns
        return up_ns

    def change(
        self,
        scenario: Scenario,
        keys: frozenset[str],  # noqa: ARG002
        *,
        now_ns: int,
    ) -> None:
        """See `Endpoint`; packets that are already queued keep their delays."""
        self._scenario = scenario
        self.uplink.change(self.impairments("uplink"), now_ns=now_ns)
        self.downlink.change(self.impairments("downlink"), now_ns=now_ns)
        for up, down in self.lanes():
            up.fates, down.fates = self.fates("uplink", up.flow), self.fates("downlink", down.flow)

    def _report(self, fault: str) -> None:
        """Report a plug-in's error, given as a traceback or empty; each error only once."""
        if fault and fault not in self._faults:
            self._faults.add(fault)
            self._events.append(Fault(traceback=fault))

    def figures(self) -> dict[str, Any]:
        up, down = self.directions
        return {up: self.uplink.figures(), down: self.downlink.figures()}
