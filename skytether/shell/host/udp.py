"""UDP sockets and peers' addresses; all blocking calls about addresses are in this module.

Other modules use `(host, port)`. The kernel's form for IPv6 has four values; one of them, the scope
(interface of a link-local address), becomes a part of the host, as in `fe80::1%eth0`.
"""

import contextlib
import ipaddress
import os
import socket
import struct
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, cast

from skytether.shared.endpoints.endpoint import Address, Form
from skytether.shared.events.flight import address_text
from skytether.shell.host import system
from skytether.shell.host.batch import RawAddress, pack_address, unpack_address

BUFFER_BYTES = 4 * 1024 * 1024
"""Size of a socket's buffers [B]: the default receive buffer holds 166 datagrams of 600 B."""

FLOODED_BYTES = 16 * 1024 * 1024
"""Receive buffer of a socket that may be flooded [B]: half a second of 50 000 packets/s."""

ADDRESSES_MAX = 4096
"""Largest number of cached addresses, each in the user's and the kernel's form (360 B); bounded,
because a flood of HELLO packets may fill the cache."""

SPARE_FILES = 48
"""Number of open files that a process may need beside its sockets, for feed and metrics."""

FIND_S = 2.0
"""Longest wait for DNS at the start [s]; then the process starts without the address."""

_SO_BINDTODEVICE = 25
_SO_SNDBUFFORCE, _SO_RCVBUFFORCE, _SO_MEMINFO, _MEMINFO_DROPS = 32, 33, 55, 8
_IP_RECVERR, _IPV6_RECVERR, _MSG_ERRQUEUE, _FROM_THIS_MACHINE = 11, 25, 0x2000, 1
_SO_ATTACH_FILTER, _UDP_HEADER_BYTES = 26, 8
_BYTE, _LENGTH, _IF_EQUAL, _IF_AT_LEAST, _RETURN = 0x30, 0x80, 0x15, 0x35, 0x06
"""Instructions of classic BPF, Linux's packet filter: load a byte, load the length, jump if equal,
jump if at least, accept this number of bytes.
"""


class AddressError(OSError):
    """An address given by the user cannot be used; the message has the address and the reason."""


def within_reach_of(peers: Iterable[Address]) -> Address:
    """Address with port 0 to bind a socket to: loopback if all peers are on it, else the wildcard.

    Args:
        peers: numeric addresses of one family; if there are none, IPv4 is assumed.
    """
    peers = list(peers)
    six = any(":" in host for host, _ in peers)
    loopback, anywhere = ("::1", "::") if six else ("127.0.0.1", "0.0.0.0")
    return (loopback if all(map(is_loopback, peers)) else anywhere, 0)


def is_loopback(address: Address) -> bool:
    return is_numeric(address[0]) and ipaddress.ip_address(address[0]).is_loopback


def leads_back(address: Address, bound: Address) -> bool:
    """Whether datagrams to an address of this machine arrive at a given socket; blocks.

    Args:
        address: name or number that datagrams are sent to.
        bound: address of the socket; a wildcard address is allowed.

    Raises:
        OSError: an address cannot be resolved.
    """
    (host, port), (bound_host, bound_port) = look_up(address), look_up(bound)
    if port != bound_port or (":" in host) != (":" in bound_host):
        return False
    if _is_unspecified(host):  # packets to a wildcard address go to loopback
        host = "::1" if ":" in host else "127.0.0.1"
    return host == bound_host or (_is_unspecified(bound_host) and _is_own(host))


def _is_unspecified(host: str) -> bool:
    return ipaddress.ip_address(host).is_unspecified


def _is_own(host: str) -> bool:
    """Whether a numeric address belongs to this machine: a socket can be bound to it."""
    try:
        open_socket((host, 0)).close()
    except AddressError:
        return False
    return True


def open_socket(address: Address, *, shared: bool = False, interface: str = "") -> socket.socket:
    """Open a non-blocking UDP socket with large buffers; an IPv6 socket receives only IPv6.

    Args:
        address: a name or a number, of either family.
        shared: whether several sockets may have this address; the kernel then distributes peers
            over them.
        interface: network interface for all its datagrams; empty for any.

    Raises:
        AddressError: the address or the interface cannot be used.
    """
    try:
        if not is_numeric(address[0]):
            address = look_up(address)
        six = ":" in address[0]
        sock = socket.socket(socket.AF_INET6 if six else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            _prepare(sock, shared=shared)
            if interface:
                _bind_to_interface(sock, interface)
            sock.bind(to_kernel(address))
        except OSError:
            sock.close()
            raise
    except OSError as error:
        at, reason = interface or address_text(*address), error.strerror or error
        raise AddressError(f"cannot listen on {at}: {reason}") from None
    return sock


def _bind_to_interface(sock: socket.socket, interface: str) -> None:
    if sys.platform != "linux":
        raise OSError("only Linux binds a socket to an interface; give a local address instead")
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_BINDTODEVICE, interface.encode())
    except PermissionError as error:
        expected = "Linux before 5.7 requires CAP_NET_RAW; give a local address instead"
        raise OSError(f"{error.strerror}; {expected}") from None


def _prepare(sock: socket.socket, *, shared: bool) -> None:
    sock.setblocking(False)
    if sock.family == socket.AF_INET6:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    if shared:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    _make_room(sock, socket.SO_RCVBUF, _SO_RCVBUFFORCE, BUFFER_BYTES)
    _make_room(sock, socket.SO_SNDBUF, _SO_SNDBUFFORCE, BUFFER_BYTES)


def _make_room(sock: socket.socket, plain: int, forced: int, size: int) -> None:
    sock.setsockopt(socket.SOL_SOCKET, plain, size)
    with contextlib.suppress(OSError):  # may exceed the system's limit; needs CAP_NET_ADMIN
        sock.setsockopt(socket.SOL_SOCKET, forced, size)


def from_kernel(address: tuple[Any, ...]) -> Address:
    """Address from the kernel's form: without the IPv6 flow, with the scope in the host."""
    if len(address) == 2:
        return address
    host, port, _, scope = address
    return (f"{host}%{socket.if_indextoname(scope)}" if scope else host, port)


def to_kernel(address: Address) -> tuple[Any, ...]:
    """Numeric address in the kernel's form.

    Raises:
        OSError: the interface of its scope does not exist.
    """
    host, percent, scope = address[0].partition("%")
    return (host, address[1], 0, socket.if_nametoindex(scope)) if percent else address


def sockets_max() -> int:
    return system.files_max() - SPARE_FILES


def allow_sockets(count: int) -> None:
    """Raise this process's limit of open files for this number of sockets, as far as the system
    allows.
    """
    system.allow_files(count + SPARE_FILES)


def admit_only(sock: socket.socket, forms: Sequence[Form]) -> None:
    """Let the kernel drop datagrams that have none of these forms; on Linux only.

    A dropped datagram takes no space in the receive buffer and no time of the process. The receive
    buffer is enlarged as well.

    Args:
        sock: a UDP socket.
        forms: accepted forms, the most frequent first. The kernel also drops a datagram that is
            shorter than the head of any form listed before its own.
    """
    _make_room(sock, socket.SO_RCVBUF, _SO_RCVBUFFORCE, FLOODED_BYTES)
    if sys.platform != "linux":
        return
    instruction = struct.Struct("=HBBI")
    program = b""
    for head, least, most in forms:
        left = 2 * len(head) + 4
        for at, byte in enumerate(head, start=_UDP_HEADER_BYTES):
            program += instruction.pack(_BYTE, 0, 0, at)
            left -= 2
            program += instruction.pack(_IF_EQUAL, 0, left, byte)
        program += instruction.pack(_LENGTH, 0, 0, 0)
        program += instruction.pack(_IF_AT_LEAST, 0, 2, least + _UDP_HEADER_BYTES)
        program += instruction.pack(_IF_AT_LEAST, 1, 0, most + _UDP_HEADER_BYTES + 1)
        program += instruction.pack(_RETURN, 0, 0, 2**32 - 1)
    program += instruction.pack(_RETURN, 0, 0, 0)
    import ctypes  # needed only by a server

    code = ctypes.create_string_buffer(program, len(program))
    filter_ = struct.pack("@HP", len(program) // instruction.size, ctypes.addressof(code))
    sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, filter_)


def heed_refusals(sock: socket.socket) -> None:
    """Let the kernel store ICMP errors about datagrams from a socket; on Linux only."""
    if sys.platform == "linux":
        six = sock.family == socket.AF_INET6
        level, option = (socket.IPPROTO_IPV6, _IPV6_RECVERR) if six else (0, _IP_RECVERR)
        sock.setsockopt(level, option, 1)


def refusals(sock: socket.socket) -> Iterator[str]:
    """Reasons in stored ICMP errors about datagrams from a socket, one for each error."""
    while True:
        try:
            _, news, _, _ = sock.recvmsg(0, 512, _MSG_ERRQUEUE)
        except OSError:  # no more errors
            return
        for _, kind, error in news:
            # Errors of this machine are skipped: sending the datagram has raised them already.
            if kind in (_IP_RECVERR, _IPV6_RECVERR) and error[4] != _FROM_THIS_MACHINE:
                yield os.strerror(int.from_bytes(error[:4], sys.byteorder))


def kernel_drops(sock: socket.socket) -> int:
    """Number of datagrams that the kernel dropped; 0 if the system does not report it.

    The kernel drops datagrams if the receive buffer is full, or if no form admits them.
    """
    try:
        info = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1))
    except OSError:
        return 0
    return int(struct.unpack("=9I", info)[_MEMINFO_DROPS])


class Names:
    """Numeric addresses of peers, by the names that the user gave.

    Args:
        peers: names or numbers.
        is_patient: whether a name that cannot be resolved now may be resolved later by `look_up`;
            before that, nothing can be sent to it.
        family: address family of all numbers.

    Raises:
        AddressError: a name cannot be resolved, and `is_patient` is false.
    """

    def __init__(
        self,
        peers: Iterable[Address],
        *,
        is_patient: bool = False,
        family: int = socket.AF_UNSPEC,
    ) -> None:
        self._family = family
        self.missing: dict[Address, str] = {}
        self._numbers: dict[Address, Address] = {}
        self._by_number: dict[Address, Address] = {}
        self._names: list[Address] = []
        self._heard: dict[RawAddress, Address] = {}
        self._reached: dict[Address, tuple[tuple[Any, ...], RawAddress]] = {}
        for peer in peers:
            if is_patient and not is_numeric(peer[0]):
                self._add_patiently(peer)
            else:
                self.add(peer)

    def _add_patiently(self, peer: Address) -> None:
        """Add a peer whose name need not be resolvable yet; blocks for at most FIND_S."""
        self._names.append(peer)
        self.missing[peer] = "no answer yet"
        addresses: dict[Address, Address] = {}

        def find() -> None:
            try:
                addresses[peer] = look_up(peer, self._family)
            except OSError as error:
                self.missing[peer] = error.strerror or str(error)

        # A thread: without a network a lookup may take 20 s, and the vehicle may be in the air.
        thread = threading.Thread(target=find, daemon=True)
        thread.start()
        thread.join(FIND_S)
        self.learn(dict(addresses))

    def add(self, peer: Address) -> None:
        """Add a peer; blocks until its name is resolved.

        Raises:
            AddressError: its name cannot be resolved.
        """
        try:
            self.learn({peer: look_up(peer, self._family)})
        except OSError as error:
            raise AddressError(f"cannot find {peer[0]}: {error.strerror or error}") from None
        if not is_numeric(peer[0]):
            self._names.append(peer)

    @property
    def may_change(self) -> bool:
        return bool(self._names)

    def numbers(self) -> list[Address]:
        return list(self._numbers.values())

    def number(self, peer: Address) -> Address:
        return self._numbers.get(peer, peer)

    def name(self, number: Address) -> Address:
        """Address of a peer as the user gave it, from its numeric address."""
        return self._by_number.get(number, number)

    def heard(self, raw: RawAddress) -> Address:
        """Address of a peer as the user gave it, from its address in the kernel's form.

        Raises:
            OSError: the interface of its scope does not exist.
        """
        peer = self._heard.get(raw)
        if peer is None:
            number = from_kernel(unpack_address(raw))
            peer = self.name(number)
            # Not cached with a scope: a replugged interface may have another index.
            if "%" not in number[0]:
                if len(self._heard) >= ADDRESSES_MAX:
                    self._heard.clear()
                self._heard[raw] = peer
        return peer

    def heard_all(self, raws: Sequence[RawAddress]) -> list[Address]:
        """Addresses of peers as the user gave them, from addresses in the kernel's form; raises the
        errors of `heard`.
        """
        peers = list(map(self._heard.get, raws))
        if None not in peers:
            return cast("list[Address]", peers)
        return list(map(self.heard, raws))

    def kernel(self, peer: Address) -> tuple[Any, ...]:
        """Numeric address of a peer, in the form that `sendto` takes.

        Raises:
            OSError: the interface of its scope does not exist, or its name is not resolved yet.
        """
        return self._reach(peer)[0]

    def raw(self, peer: Address) -> RawAddress:
        """Numeric address of a peer as `struct sockaddr`; empty if it cannot be packed.

        Raises:
            OSError: the interface of its scope does not exist, or its name is not resolved yet.
        """
        return self._reach(peer)[1]

    def _reach(self, peer: Address) -> tuple[tuple[Any, ...], RawAddress]:
        reached = self._reached.get(peer)
        if reached is None:
            if peer in self.missing:
                raise OSError(f"cannot find {peer[0]}")
            address, raw = to_kernel(self.number(peer)), b""
            # If an address cannot be packed, the later plain call of the socket raises the error.
            with contextlib.suppress(OSError, OverflowError):
                raw = pack_address(address)
            reached = address, raw
            if len(address) == 2:  # without a scope, see `heard`
                if len(self._reached) >= ADDRESSES_MAX:
                    self._reached.clear()
                self._reached[peer] = reached
        return reached

    def look_up(self) -> dict[Address, Address]:
        """Numeric addresses of all names that can be resolved now; blocks."""
        addresses = {}
        for name in self._names:
            with contextlib.suppress(OSError):
                addresses[name] = look_up(name, self._family)
        return addresses

    def learn(self, found: dict[Address, Address]) -> None:
        for peer in found:
            self.missing.pop(peer, None)
        self._numbers |= found
        self._by_number = {number: name for name, number in self._numbers.items()}
        self._heard.clear()
        self._reached.clear()


def look_up(peer: Address, family: int = socket.AF_UNSPEC) -> Address:
    """Numeric address of a name or number, IPv4 if a name has addresses of both families; blocks.

    Raises:
        OSError: the name cannot be resolved.
    """
    entries = socket.getaddrinfo(*peer, family=family, type=socket.SOCK_DGRAM)
    four = [entry for entry in entries if entry[0] == socket.AF_INET]
    return from_kernel((four or entries)[0][4])


def is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
