"""The server's clock as estimated by a vehicle from the time stamps of the server's packets.

Observations echo the newest packet, so that the server can estimate the delays. A packet is dropped
if a packet sent much later has already arrived. Only a WELCOME is always accepted, because it
answers a HELLO, and because a server whose clock was set back can then continue.
"""

from typing import NamedTuple

from skytether.shared.base.units import JUMP_NS
from skytether.shared.law.heartbeat import NUMBERS
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import stamped_ns

SLEPT_NS = JUMP_NS // 2
"""Gain of the server's clock on the client's above which this machine was suspended [ns]; changes
of the delay cause far less."""


class Echo(NamedTuple):
    """Newest packet of the server, as echoed in observations."""

    server_ns: int
    """Server time at which the packet was sent [ns]."""
    received_ns: int
    """Arrival time of the packet [ns; the client's clock]."""
    heard: int
    """Number of packets received up to and including this packet, modulo NUMBERS."""


NEVER = Echo(0, 0, 0)
"""Echo before the first packet of the server."""


class ServerClock:
    """Clock of one server.

    Args:
        overtaken_ns: time by which an accepted packet may be older than the newest [ns].
    """

    def __init__(self, overtaken_ns: int) -> None:
        self.echo = NEVER
        self._overtaken_ns = overtaken_ns

    def begin(self) -> None:
        """Begin again after a restart of the server: its time stamps cannot be compared with those
        of its earlier run.
        """
        self.echo = NEVER

    def sent_ns(self, server_us: int, now_ns: int) -> int:
        """Server's time at which a packet was sent [ns], from its time stamp.

        Raises:
            ProtocolError: a much newer packet has overtaken the packet.
        """
        server_ns = stamped_ns(server_us, self._expected_ns(now_ns))
        if self.echo.server_ns - server_ns > self._overtaken_ns:
            raise ProtocolError(Drop.OVERTAKEN)
        return server_ns

    def hear(self, server_ns: int, now_ns: int) -> bool:
        """Note a packet sent at a time of the server; returns whether this machine was suspended.

        In a suspension the client's clock may stand still. If it jumps forward instead, the client
        takes the jump for a clock that was set (`shared.endpoints.steady`). In both cases the
        server's clock is ahead. After a suspension too long for time stamps, the server has
        forgotten the session, and its WELCOME contains the full time.
        """
        slept = self.echo != NEVER and server_ns - self._expected_ns(now_ns) > SLEPT_NS
        self.echo = Echo(server_ns, now_ns, (self.echo.heard + 1) % NUMBERS)
        return slept

    def _expected_ns(self, now_ns: int) -> int:
        """Present time of the server [ns], if the delay has not changed since the newest packet."""
        return self.echo.server_ns + now_ns - self.echo.received_ns
