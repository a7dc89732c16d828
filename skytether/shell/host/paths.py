"""Paths: connections of a client to its server, each from a local interface or address.

The socket of a path works again when its address, or its interface, is up again. After an interface
was removed and added again, as by a modem that restarts, the socket is still bound to the old
interface and must be opened again; a changed index of the interface is the only sign of this.
"""

import re
import socket
from typing import NamedTuple

from skytether.shared.endpoints.endpoint import Address
from skytether.shared.endpoints.line import parse_address
from skytether.shared.events.flight import address_text
from skytether.shell.host.udp import (
    Names,
    is_loopback,
    is_numeric,
    open_socket,
    to_kernel,
    within_reach_of,
)

PATH_FORM = (
    "LOCAL=HOST:PORT, where LOCAL is an interface, a numeric address of this machine, or empty; "
    "IPv6 addresses in brackets"
)
_INTERFACE = re.compile(r"[!-.0-9;-~]{1,15}")
"""Name of an interface: Linux allows neither "/" nor ":"."""


class NetworkPath(NamedTuple):
    local: str
    """Interface, or numeric address of this machine; empty for any."""
    peer: Address

    def __str__(self) -> str:
        local = f"[{self.local}]" if ":" in self.local else self.local
        return f"{local}={address_text(*self.peer)}"


def parse_path(text: str) -> NetworkPath | None:
    """Path from LOCAL=HOST:PORT; None if the text is invalid."""
    local, equals, host_port = text.rpartition("=")
    peer = parse_address(host_port)
    if not (equals and peer):
        return None
    if not local:
        return NetworkPath("", peer)
    address = parse_address(f"{local}:0")
    if address and (is_numeric(address[0]) or _INTERFACE.fullmatch(local)):
        return NetworkPath(address[0], peer)
    return None


class PathSockets:
    """Opens the socket of one path, and a new socket when the old one no longer works.

    Args:
        is_patient: whether the peer's name may be resolved later, see `Names`.

    Raises:
        AddressError: the peer's name cannot be resolved, or has another address family than LOCAL.
    """

    def __init__(self, path: NetworkPath, *, is_patient: bool) -> None:
        self.path = path
        self._interface, family = path.local, socket.AF_UNSPEC
        if is_numeric(path.local):
            self._interface = ""
            family = socket.AF_INET6 if ":" in path.local else socket.AF_INET
        self.names = Names([path.peer], is_patient=is_patient, family=family)
        self.problem = ""
        """Reason why nothing could be sent at the last check; empty if sending was possible."""
        self._index: int | None = None
        self._bind: Address = ("", 0)
        self.choose_address()

    @property
    def is_local(self) -> bool:
        """Whether both ends are on this machine; False while the peer's address is unknown."""
        addresses = [self._bind, *self.names.numbers()]
        return not self.names.missing and all(map(is_loopback, addresses))

    def choose_address(self) -> bool:
        """Choose the address that sockets are bound to; returns whether it has changed.

        This is done only at the start, and when the peer's name is resolved late. Otherwise a
        plaintext link that is allowed because it is local could become remote when a name is moved.
        """
        before, is_address = self._bind, self.path.local and not self._interface
        self._bind = (self.path.local, 0) if is_address else within_reach_of(self.names.numbers())
        return self._bind != before

    def open(self) -> socket.socket:
        """Open a socket of this path.

        Raises:
            AddressError: its interface or address does not exist, or cannot be used.
        """
        sock = open_socket(self._bind, interface=self._interface)
        self._index = self._index_now()
        return sock

    @property
    def is_outdated(self) -> bool:
        """Whether no socket was opened yet, or the socket's interface was removed since."""
        return self._index != self._index_now()

    def _index_now(self) -> int:
        """Kernel's index of the path's interface; 0 if there is no such interface."""
        try:
            return socket.if_nametoindex(self._interface) if self._interface else 0
        except OSError:
            return 0

    def check(self) -> bool:
        """Whether datagrams can be sent now, as far as this machine knows; updates `problem`."""
        try:
            with open_socket(self._bind, interface=self._interface) as probe:
                for number in self.names.numbers():
                    probe.connect(to_kernel(number))  # looks for a route, and sends nothing
        except OSError as error:
            self.problem = error.strerror or str(error)
            return False
        self.problem = ""
        return True
