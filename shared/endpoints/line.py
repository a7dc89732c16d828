"""Addresses as users write them: HOST:PORT of a UDP peer, and lines to a vehicle's own hardware.

    udp:HOST:PORT       listen there, and answer the first sender
    udpout:HOST:PORT    send to this address
    tcp:HOST:PORT       connect to this address
    serial:PATH:BAUD    a serial port, as in serial:/dev/ttyACM0:57600

TCP and serial lines are byte streams: an endpoint receives them in pieces, all from the peer
`LINE`.
"""

import ipaddress
from typing import Literal, NamedTuple

from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.endpoint import Address

HOST_PORT = "HOST:PORT with a PORT of at most 65535, or [HOST]:PORT where HOST is an IPv6 address"
LINE: Address = ("line", 0)
"""Peer at the other end of a TCP or serial line."""
CLIENT, SERVER = "client", "server"
"""Ends of a relayed connection; the peers are `(CLIENT, number)` and `(SERVER, number)`."""
PIECE_BYTES = 1448
"""Largest piece of a relayed connection: as much as one TCP packet carries on Ethernet [B]."""
FORMS = "udp:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:PATH:BAUD"


class Line(NamedTuple):
    kind: Literal["udp", "udpout", "tcp", "serial"]
    host: str
    """Host, or path of a serial port."""
    number: int
    """Port, or baud rate of a serial port [bit/s]."""

    @property
    def address(self) -> Address:
        return self.host, self.number

    @property
    def peer(self) -> Address | None:
        """Peer at the other end; None if the first sender becomes the peer."""
        return {"udp": None, "udpout": self.address}.get(self.kind, LINE)


CONNECTIONS_MAX = 128
"""Largest number of TCP connections at once, so that their pieces fit into the queue of a link."""


class Listen(NamedTuple):
    """TCP connections to relay: address for clients, and address of the server."""

    bind: Address
    """Address for clients; port 0 takes a free port."""
    server: Address
    most: int = CONNECTIONS_MAX
    """Largest number of connections at once; further connections are closed."""


def parse_address(text: str) -> Address | None:
    """Address from HOST:PORT, with an IPv6 host in brackets; None if the text is invalid."""
    host, _, port = text.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    host = host[1:-1] if bracketed else host
    if not (
        host
        and bracketed == (":" in host)
        and (not bracketed or _is_ipv6(host))
        and (port.isascii() and port.isdigit() and int(port) < 65536)
    ):
        return None
    return host, int(port)


def parse_line(key: str, text: str) -> Line:
    """Line that a text describes, see FORMS.

    Raises:
        ConfigError: the text is invalid; the message names `key`.
    """
    kind, _, rest = text.partition(":")
    if kind == "serial":
        path, _, baud = rest.rpartition(":")
        if path and baud.isascii() and baud.isdigit() and 0 < int(baud) <= 10_000_000:
            return Line("serial", path, int(baud))
    elif kind in ("udp", "udpout", "tcp") and (address := parse_address(rest)):
        return Line(kind, *address)  # type: ignore[arg-type] # one of these three
    raise ConfigError(f"{key}: got {text!r}, expected {FORMS}")


def _is_ipv6(host: str) -> bool:
    try:
        ipaddress.IPv6Address(host)
    except ValueError:
        return False
    return True
