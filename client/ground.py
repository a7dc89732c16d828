"""Log events of a vehicle on the ground: why it cannot fly yet, a server that does not answer, and
a server that falls silent.
"""

from skytether.client.session import ServerSession
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Events
from skytether.shared.events.ground import (
    AutopilotWaits,
    NoAnswer,
    ServerHeard,
    ServerSilent,
    Unanswered,
    Welcomed,
)

WAITED_NS = 2 * SECOND_NS
"""Time for which the vehicle waits before the log gives the reason [ns]."""
SILENT_NS = 3 * SECOND_NS
"""Time beyond the time-out after which the server of a vehicle on the ground counts as silent.

The server answers two HELLOs a second. Even if the network loses a fifth of the packets each way,
one of eight HELLOs is nearly always answered."""


def unanswered(session: ServerSession, left_ns: int) -> Unanswered:
    """Event: the session is not open yet; the client gives up after another `left_ns` [ns]."""
    (host, port), others = session.address, session.route.others
    left_s = left_ns / SECOND_NS
    return Unanswered(vehicle=session.vehicle, host=host, port=port, others=others, left_s=left_s)


def no_answer(session: ServerSession, waited_ns: int) -> NoAnswer:
    """Event: the client gives up the session, because no server answers."""
    host, port = session.address
    return NoAnswer(
        vehicle=session.vehicle,
        host=host,
        port=port,
        others=session.route.others,
        waited_s=waited_ns / SECOND_NS,
        secure=session.link.secure,
    )


class GroundReports:
    """Reporter of one vehicle on the ground; it appends log events to `events`.

    `timeout_ns` is the time of silence after which the link counts as lost.
    """

    def __init__(self, vehicle: int, server: Address, timeout_ns: int, events: Events) -> None:
        self._vehicle, self._server, self._events = vehicle, server, events
        self._silence_ns = timeout_ns + SILENT_NS
        self._waits_for, self._waits_ns, self._reported_wait = "", 0, ""
        """Present reason why the vehicle cannot fly, its start time, and the last logged reason."""
        self._welcomed: int | None = None
        self._silent_ns: int | None = None
        """Time of the newest packet before the server was reported as silent; None if not
        reported."""

    def wait(self, waits_for: str, *, now_ns: int) -> None:
        """Report the reason why the vehicle cannot fly (empty for none) if it persists."""
        if waits_for != self._waits_for:
            self._waits_for, self._waits_ns = waits_for, now_ns
        if now_ns - self._waits_ns >= WAITED_NS and waits_for != self._reported_wait:
            self._reported_wait = waits_for
            if waits_for:
                self._events.append(AutopilotWaits(vehicle=self._vehicle, waits_for=waits_for))

    def hear(self, session: int, newest_ns: int, *, now_ns: int) -> None:
        """Report a new session, silence of its server, and the end of the silence.

        Args:
            session: number of the session.
            newest_ns: time of the server's newest packet.
        """
        if session != self._welcomed:
            self._welcomed, (host, port) = session, self._server
            self._events.append(Welcomed(vehicle=self._vehicle, host=host, port=port))
        elif self._silent_ns is not None:
            if newest_ns > self._silent_ns:
                silent_s = (newest_ns - self._silent_ns) / SECOND_NS
                self._events.append(ServerHeard(vehicle=self._vehicle, silent_s=silent_s))
                self._silent_ns = None
        elif now_ns - newest_ns > self._silence_ns:
            self._silent_ns = newest_ns
            silent_s = (now_ns - newest_ns) / SECOND_NS
            self._events.append(ServerSilent(vehicle=self._vehicle, silent_s=silent_s))
