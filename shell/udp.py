"""Sockets and names, as the shell needs them; all blocking calls about addresses are in here."""

import contextlib
import ipaddress
import resource
import socket
import struct
from collections.abc import Iterable

from shared.endpoint import Address

BUFFER_BYTES = 4 * 1024 * 1024
"""The default receive buffer holds 166 datagrams of 600 B."""

SPARE_FILES = 64
"""Open files beside the sockets."""

_SO_SNDBUFFORCE, _SO_RCVBUFFORCE, _SO_MEMINFO, _MEMINFO_DROPS = 32, 33, 55, 8


class AddressError(OSError):
    """An address that the user gave is of no use; the message says which and why."""


def within_reach_of(peers: Iterable[Address]) -> Address:
    """What to bind a socket to that talks to these: a free port, on loopback if all are there."""
    return ("127.0.0.1" if all(map(is_loopback, peers)) else "0.0.0.0", 0)


def is_loopback(address: Address) -> bool:
    """Whether only this machine can be, or reach, an address."""
    return _is_numeric(address[0]) and ipaddress.ip_address(address[0]).is_loopback


def open_socket(address: Address, *, shared: bool = False) -> socket.socket:
    """A non-blocking UDP socket with large buffers.

    Args:
        shared: several sockets may have this address; the kernel deals out peers among them.

    Raises:
        AddressError: the address cannot be bound.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        if shared:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        for plain, forced in (
            (socket.SO_RCVBUF, _SO_RCVBUFFORCE),
            (socket.SO_SNDBUF, _SO_SNDBUFFORCE),
        ):
            sock.setsockopt(socket.SOL_SOCKET, plain, BUFFER_BYTES)
            with contextlib.suppress(OSError):  # over the system's limit, for those who may
                sock.setsockopt(socket.SOL_SOCKET, forced, BUFFER_BYTES)
        sock.bind(address)
    except OSError as error:
        sock.close()
        reason = f"cannot listen on {address[0]}:{address[1]}: {error.strerror}"
        raise AddressError(reason) from None
    return sock


def allow_sockets(count: int) -> None:
    """Let this process have so many sockets open, as far as the system does."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + SPARE_FILES
    soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    if soft > resource.getrlimit(resource.RLIMIT_NOFILE)[0]:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def kernel_drops(sock: socket.socket) -> int:
    """Datagrams dropped because the receive buffer was full; 0 where the system won't say."""
    try:
        info = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1))
    except OSError:
        return 0
    return int(struct.unpack("=9I", info)[_MEMINFO_DROPS])


class Names:
    """Which numbers stand for the names of peers, as far as is known now.

    Raises:
        AddressError: one of them cannot be found.
    """

    def __init__(self, peers: Iterable[Address]) -> None:
        self._names = [peer for peer in peers if not _is_numeric(peer[0])]
        self._numbers: dict[Address, Address] = {}
        self._by_number: dict[Address, Address] = {}
        for name in self._names:
            try:
                self.learn({name: look_up(name)})
            except OSError as error:
                raise AddressError(f"cannot find {name[0]}: {error.strerror}") from None

    def __bool__(self) -> bool:
        return bool(self._names)

    def number(self, peer: Address) -> Address:
        """Where to send to."""
        return self._numbers.get(peer, peer)

    def name(self, number: Address) -> Address:
        """Who has sent: the peer by its name, where it has one."""
        return self._by_number.get(number, number)

    def look_up(self) -> dict[Address, Address]:
        """All names looked up anew, without those that cannot be found just now; blocks."""
        found = {}
        for name in self._names:
            with contextlib.suppress(OSError):
                found[name] = look_up(name)
        return found

    def learn(self, found: dict[Address, Address]) -> None:
        """From now on these numbers stand for these names."""
        self._numbers |= found
        self._by_number = {number: name for name, number in self._numbers.items()}


def look_up(peer: Address) -> Address:
    """The numeric address of a named one; blocks.

    Raises:
        OSError: it cannot be found.
    """
    found = socket.getaddrinfo(*peer, socket.AF_INET, socket.SOCK_DGRAM)
    host, port = found[0][4][:2]
    return str(host), int(port)


def _is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
