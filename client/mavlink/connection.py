"""Connection to the autopilot: its address, its numbers, and the sorting of messages by sender.

The client flies the first autopilot that sends a heartbeat. If that autopilot falls silent and its
heartbeats then come from another address, it has restarted: on a UDP line, the client uses the new
address if the autopilot is disarmed.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from skytether.client.mavlink.keys import MavlinkConfig
from skytether.mavlink.codec import Codec, Message
from skytether.mavlink.dialect import dialect
from skytether.shared.endpoints.endpoint import Address, Datagram, Events
from skytether.shared.endpoints.line import Line
from skytether.shared.events.aboard import AutopilotElsewhere, AutopilotMoved
from skytether.shared.events.flight import address_text
from skytether.shared.scenario.schema import Scenario

ADDRESSES_REPORTED = 4
"""Largest number of foreign addresses reported while the autopilot is silent."""
AUTOPILOT_COMPONENT = int(dialect.MAV_COMP_ID_AUTOPILOT1)


class Arrivals(NamedTuple):
    """Messages of one datagram, by sender."""

    heard: Sequence[Message] = ()
    """Messages of the autopilot to the client, or to every system."""
    others: Sequence[Message] = ()
    """Messages of other senders than autopilot and client, once the autopilot is known."""
    met: Message | None = None
    moved: bool = False


class Connection:
    def __init__(self, scenario: Scenario, vehicle: int, line: Line, events: Events) -> None:
        self._keys = keys = scenario.section(MavlinkConfig)
        self._vehicle, self._events = vehicle, events
        self.line = scenario.vehicle.address
        self._may_move = line.kind == "udp"
        self.peer: Address | None = line.peer
        self.target: tuple[int, int] | None = None
        """Numbers of the autopilot's system and component; None until its first heartbeat."""
        self.unmet: tuple[Address, tuple[int, int]] | None = None
        """Address and numbers of a sender that may be the autopilot, before its first heartbeat."""
        self.codec = Codec(keys.system, keys.component, stream=line.kind in ("tcp", "serial"))
        self.counts: Counter[str] = Counter()
        """Number of messages from the autopilot (`heard`), from other senders (`foreign`) and to
        other receivers (`for_others`), and of datagrams from other addresses (`elsewhere`)."""
        self._elsewhere: list[Address] = []
        """Other addresses from which datagrams arrived while the autopilot was silent."""

    def receive(self, datagram: Datagram, *, is_quiet: bool, armed: bool) -> Arrivals:
        """Sort the messages of a datagram.

        Args:
            is_quiet: whether the autopilot has been silent for a while.
            armed: whether the autopilot was armed in its newest heartbeat.
        """
        if self.peer is not None and datagram.peer != self.peer:
            self.counts["elsewhere"] += 1
            return self._hear_elsewhere(datagram, armed) if is_quiet else Arrivals()
        messages = self.codec.decode(datagram.payload)
        arrivals = self._sorted(messages, datagram.peer)
        if self.target is None and is_quiet and self._may_move:
            self._report_elsewhere(datagram.peer, messages)
        return arrivals

    def _sorted(self, messages: Sequence[Message], peer: Address) -> Arrivals:
        """Messages by sender; the first heartbeat of an autopilot makes it the client's own."""
        heard, others, met = [], [], None
        for message in messages:
            sender = _sender(message)
            if self.target is None and self._is_autopilot(message):
                self.target, self.peer, met, self.unmet = sender, peer, message, None
            elif self.target is None and self._is_wanted(sender):
                self.unmet = peer, sender
            if sender != self.target:
                self.counts["foreign"] += 1
                if self.target is not None and sender != (self._keys.system, self._keys.component):
                    others.append(message)
            elif not self._is_for_us(message):
                self.counts["for_others"] += 1
            else:
                self.counts["heard"] += 1
                heard.append(message)
        return Arrivals(heard, others, met)

    def _is_autopilot(self, message: Message) -> bool:
        """Whether a message is a heartbeat of the autopilot that the scenario asks for."""
        return (
            message.get_type() == "HEARTBEAT"
            and self._is_wanted(_sender(message))
            and message.autopilot != dialect.MAV_AUTOPILOT_INVALID
        )

    def _is_wanted(self, sender: tuple[int, int]) -> bool:
        """Whether a sender's numbers are those of an autopilot that may be flown."""
        system, component = sender
        return component == AUTOPILOT_COMPONENT and self._keys.autopilot in (0, system)

    def _is_for_us(self, message: Message) -> bool:
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self._keys.system) and component in (0, self._keys.component)

    def _hear_elsewhere(self, datagram: Datagram, armed: bool) -> Arrivals:
        """Follow the autopilot to a new address if that is allowed; otherwise report the sender."""
        messages = Codec(self._keys.system, self._keys.component).decode(datagram.payload)
        for message in messages:
            same = _sender(message) == self.target and message.get_type() == "HEARTBEAT"
            if not (same and self._may_move and not armed):
                continue
            if not message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED:
                self._move(datagram.peer)
                arrivals = self._sorted(self.codec.decode(datagram.payload), datagram.peer)
                return arrivals._replace(moved=True)
        self._report_elsewhere(datagram.peer, messages)
        return Arrivals()

    def _move(self, peer: Address) -> None:
        assert self.peer is not None
        before, after = address_text(*self.peer), address_text(*peer)
        self._events.append(AutopilotMoved(vehicle=self._vehicle, before=before, after=after))
        self.peer = peer
        self._elsewhere.clear()

    def _report_elsewhere(self, peer: Address, messages: Sequence[Message]) -> None:
        """Report once for each address that its datagrams are not from the autopilot."""
        if peer in self._elsewhere or len(self._elsewhere) == ADDRESSES_REPORTED:
            return
        self._elsewhere.append(peer)
        elsewhere = AutopilotElsewhere(
            vehicle=self._vehicle,
            came_from=address_text(*peer),
            expected=address_text(*self.peer) if self.peer else self.line,
            content=_content(messages),
        )
        self._events.append(elsewhere)


def _sender(message: Message) -> tuple[int, int]:
    return message.get_srcSystem(), message.get_srcComponent()


def _content(messages: Sequence[Message]) -> str:
    if not messages:
        return "data that is not MAVLink"
    system, component = _sender(messages[-1])
    return f"{messages[-1].get_type()} of system {system}, component {component}"
