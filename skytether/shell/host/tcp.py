"""Sockets that listen for TCP connections."""

import socket

from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import address_text
from skytether.shell.host.udp import AddressError, to_kernel


def listen_tcp(bind: Address) -> socket.socket:
    """Socket that listens for TCP connections; port 0 takes a free one.

    Raises:
        AddressError: the address cannot be bound.
    """
    host, port = bind
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server(to_kernel(bind), family=family)
    except OSError as error:
        at = address_text(host, port)
        raise AddressError(f"cannot listen on {at}: {error.strerror or error}") from None
