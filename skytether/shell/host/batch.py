"""Batches of datagrams: one system call receives or sends many of them, on Linux.

`recvmmsg` and `sendmmsg` take an array of message headers, which is allocated once. `recvmmsg` also
returns the kernel's arrival time of each datagram, so that reading late does not count as network
delay. UDP segmentation offload sends datagrams of one size to one peer as one long datagram, which
the kernel splits just before sending.

None of these calls says which datagram failed, or why. If a call sends or receives fewer than
asked, the caller tries the next datagram by the socket's plain call, which raises the error.
"""

import contextlib
import ctypes
import errno
import mmap
import socket
import struct
import sys
import time
from array import array
from collections.abc import Sequence
from operator import ne
from typing import Any

from skytether.shared.base.units import SECOND_NS

BATCH_MAX = 128
NEAR_NS, READINGS = 5_000, 4
"""Longest time between clock readings that count as simultaneous [ns]; number of attempts."""
SIZE_MAX = 2048
"""Largest payload that `DatagramBatch.send` takes [B]; packets of a flight have at most 1200."""
SEGMENTS_MAX = 64
"""Largest number of datagrams sent as one long datagram; older kernels refuse more."""
SEGMENTED_BYTES_MAX = 65_000
"""Largest total payload of datagrams sent as one long datagram [B]; IP allows a little more."""
SEGMENT_BYTES_MAX = SEGMENTED_BYTES_MAX // 2
"""Largest payload with which two datagrams fit into one long datagram [B]."""

_STRIDE = 65_536 + 4096 + 64
"""Distance of two receive buffers [B]: the longest datagram plus an odd number of cache lines, so
that the first bytes of datagrams do not all map to the same cache set.
"""
_STARTS = range(0, _STRIDE * BATCH_MAX, _STRIDE)
_SOL_UDP, _UDP_SEGMENT = 17, 103
_HEADER = struct.Struct("@QI4xQQQQi4xI4x")
"""Layout of `struct mmsghdr`: address of the name and its size, address and number of the buffers,
address and size of control data, flags, size of the payload received or sent."""
_BUFFER = struct.Struct("@QQ")
"""Layout of `struct iovec`: address of a buffer and its size."""
_MSG_DONTWAIT = 0x40
_SO_TIMESTAMPNS = 35
_STAMP = struct.Struct("@Qiiqq")
"""Layout of control data with a time stamp: size, level and type, seconds and nanoseconds."""
_IPV4, _IPV6 = struct.Struct("=HH4s8x"), struct.Struct("=HHI16sI")
"""Layouts of `struct sockaddr_in` and `sockaddr_in6`; ports are in network order."""
_WHOLE = memoryview(array("Q", [_STAMP.size] * BATCH_MAX))
"""Size of the space for each datagram's control data [B]."""

RawAddress = bytes
"""Address of a peer in the kernel's own form, `struct sockaddr_in` or `sockaddr_in6`."""


def pack_address(address: tuple[str, int] | tuple[str, int, int, int]) -> RawAddress:
    """Address in the kernel's form.

    Args:
        address: (host, port) for IPv4, and for IPv6 without a scope; otherwise (host, port, flow,
            scope).

    Raises:
        OSError: the host is not a numeric address.
        OverflowError: the port is not between 0 and 65535.
    """
    host, port, flow, scope = address if len(address) == 4 else (*address, 0, 0)
    if not 0 <= port <= 0xFFFF:
        raise OverflowError(f"got port {port}, expected 0 to 65535")
    if ":" in host:
        number = socket.inet_pton(socket.AF_INET6, host)
        return _IPV6.pack(socket.AF_INET6, socket.htons(port), socket.htonl(flow), number, scope)
    number = socket.inet_pton(socket.AF_INET, host)
    return _IPV4.pack(socket.AF_INET, socket.htons(port), number)


def unpack_address(raw: RawAddress) -> tuple[str, int] | tuple[str, int, int, int]:
    if len(raw) == _IPV4.size:
        _, port, number = _IPV4.unpack(raw)
        return socket.inet_ntop(socket.AF_INET, number), socket.ntohs(port)
    _, port, flow, number, scope = _IPV6.unpack(raw)
    host = socket.inet_ntop(socket.AF_INET6, number)
    return host, socket.ntohs(port), socket.ntohl(flow), scope


class _Headers:
    """Array of `struct mmsghdr`, each with one buffer and one address.

    Args:
        stride: distance of two buffers [B].
        size: size of each buffer [B].
        name_bytes: size of an address of the sockets' family [B].
    """

    def __init__(self, stride: int, size: int, name_bytes: int) -> None:
        # An anonymous mapping takes memory only for pages that were written to: a process that
        # receives one datagram at a time uses one page. A bytearray or huge pages would take 9 MB.
        memory = mmap.mmap(-1, stride * BATCH_MAX, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        with contextlib.suppress(OSError):  # a kernel without huge pages
            memory.madvise(mmap.MADV_NOHUGEPAGE)
        self.memory = memoryview(memory)
        self.names = bytearray(name_bytes * BATCH_MAX)
        buffers, headers = bytearray(_BUFFER.size * BATCH_MAX), bytearray(_HEADER.size * BATCH_MAX)
        stamps = bytearray(_STAMP.size * BATCH_MAX)
        parts = memory, self.names, buffers, stamps
        at, names_at, buffers_at, stamps_at = (_address(each) for each in parts)
        for i in range(BATCH_MAX):
            _BUFFER.pack_into(buffers, i * _BUFFER.size, at + i * stride, size)
            name, buffer = names_at + i * name_bytes, buffers_at + i * _BUFFER.size
            stamp = stamps_at + i * _STAMP.size
            row = name, name_bytes, buffer, 1, stamp, 0, 0, 0
            _HEADER.pack_into(headers, i * _HEADER.size, *row)
        self.first = ctypes.c_void_p(_address(headers))
        self.sizes = memoryview(buffers).cast("Q")[1::2]
        """Sizes of the buffers, or of the payloads to be sent [B]; shape (BATCH_MAX,)."""
        self.done = memoryview(headers).cast("I")[_HEADER.size // 4 - 2 :: _HEADER.size // 4]
        """Sizes of received payloads; shape (BATCH_MAX,) [B]."""
        self.stamp_sizes = memoryview(headers).cast("Q")[5 :: _HEADER.size // 8]
        """Sizes of the control data [B]; the kernel sets each to the size that it has written."""
        words = memoryview(stamps).cast("q")
        self.stamps_s, self.stamps_ns = words[2 :: _STAMP.size // 8], words[3 :: _STAMP.size // 8]
        """Arrival times by CLOCK_REALTIME: whole seconds, and nanoseconds; shape (BATCH_MAX,)."""


def _address(memory: bytearray | mmap.mmap) -> int:
    """Address of a memory block; a bytearray cannot be resized any more after this."""
    return ctypes.addressof(ctypes.c_char.from_buffer(memory))


class DatagramBatch:
    """Preallocated arrays with which all sockets of one family receive and send.

    Raises:
        OSError: this system has no recvmmsg.
    """

    def __init__(self, family: int) -> None:
        if sys.platform != "linux" or _HEADER.size != 64:
            raise OSError(errno.ENOSYS, "recvmmsg and sendmmsg are used on 64-bit Linux only")
        # `PyDLL` keeps the interpreter's lock, because the calls never wait, and another thread
        # could hold the lock for 5 ms.
        libc = ctypes.PyDLL(None)
        try:
            self._receive, self._send = libc.recvmmsg, libc.sendmmsg
        except AttributeError as missing:
            raise OSError(errno.ENOSYS, "this libc has no recvmmsg") from missing
        self._name_bytes = (_IPV4 if family == socket.AF_INET else _IPV6).size
        self._in = _Headers(_STRIDE, 65_536, self._name_bytes)
        self._out = _Headers(SIZE_MAX, 0, self._name_bytes)

    @staticmethod
    def stamp(sock: socket.socket) -> None:
        """Let the kernel stamp datagrams on arrival.

        Linux starts to stamp some milliseconds later, unless another socket of the machine uses
        stamps already; until then a datagram has the time at which it is read.
        """
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def receive(self, sock: socket.socket) -> tuple[list[bytes], list[RawAddress], list[int]]:
        """Receive the datagrams that have arrived, at most BATCH_MAX.

        Args:
            sock: socket of this family, prepared by `stamp`.

        Returns:
            payloads, senders, and arrival times [ns; CLOCK_MONOTONIC], in the order of arrival; all
            empty if there was no datagram, or an error. Arrival times are converted from the
            kernel's time of day, so a step of this clock shifts them by as much. A datagram
            without an arrival time gets the present time.
        """
        rows, size = self._in, self._name_bytes
        rows.stamp_sizes[:] = _WHOLE
        count = self._receive(sock.fileno(), rows.first, BATCH_MAX, _MSG_DONTWAIT, None)
        ahead_ns, now_ns = _clocks()
        if count <= 0:
            return [], [], []
        memory, names, ends = rows.memory, bytes(rows.names[: count * size]), size * count
        lengths = rows.done[:count].tolist()
        payloads = [
            memory[at : at + length].tobytes() for at, length in zip(_STARTS, lengths, strict=False)
        ]
        columns = rows.stamp_sizes, rows.stamps_s, rows.stamps_ns
        times = zip(*(column[:count].tolist() for column in columns), strict=True)
        came_ns = [SECOND_NS * s + ns - ahead_ns if stamp else now_ns for stamp, s, ns in times]
        return payloads, [names[at : at + size] for at in range(0, ends, size)], came_ns

    def send(
        self, sock: socket.socket, payloads: Sequence[bytes], peers: Sequence[RawAddress]
    ) -> int:
        """Send datagrams in order; returns how many were sent, from the first on.

        Nothing is sent if a payload is longer than SIZE_MAX, or a peer has another address family.

        Args:
            payloads: at most BATCH_MAX.
            peers: address of each payload's receiver.
        """
        rows, count, at, name_bytes = self._out, len(payloads), 0, self._name_bytes
        if max(map(len, payloads)) > SIZE_MAX or any(len(peer) != name_bytes for peer in peers):
            return 0
        memory, sizes = rows.memory, rows.sizes
        for i, payload in enumerate(payloads):
            size = sizes[i] = len(payload)
            memory[at : at + size] = payload
            at += SIZE_MAX
        rows.names[: count * name_bytes] = b"".join(peers)
        return max(0, self._send(sock.fileno(), rows.first, count, _MSG_DONTWAIT))


class Segments:
    """UDP segmentation offload: sends datagrams of one size to one peer in one call."""

    def __init__(self) -> None:
        self.size_max = SEGMENT_BYTES_MAX if sys.platform == "linux" else 0
        """Largest payload for which segmentation is tried [B]; 0 except on Linux. It is lowered
        below any size that the kernel refuses, for example because the size exceeds the path's MTU.
        """

    def suits(self, payloads: Sequence[bytes]) -> bool:
        """Whether segmentation is faster than single calls for payloads in this order."""
        sizes = list(map(len, payloads))
        if not 0 < min(sizes) <= max(sizes) <= self.size_max:
            return False
        # A call with segments takes as long as sending two datagrams.
        changes = sum(map(ne, sizes, sizes[1:]))
        return 2 * (changes + 1) <= len(sizes)

    def send(self, sock: socket.socket, payloads: Sequence[bytes], peer: tuple[Any, ...]) -> int:
        """Send datagrams in order; returns how many were sent, from the first on.

        Args:
            payloads: payloads for which `suits` is true.
            peer: receiver of all payloads, as `socket.sendmsg` takes it.
        """
        first, count = 0, len(payloads)
        while first < count:
            size, last = len(payloads[first]), first + 1
            most = min(count, first + min(SEGMENTS_MAX, SEGMENTED_BYTES_MAX // size))
            # All payloads usually have one size.
            if len(set(map(len, payloads[first:most]))) == 1:
                last = most
            while last < most and len(payloads[last]) == size:
                last += 1
            control = [(_SOL_UDP, _UDP_SEGMENT, size.to_bytes(2, sys.byteorder))]
            try:
                sock.sendmsg(payloads[first:last], control, 0, peer)
            except BlockingIOError:
                break  # the send buffer has no space for all of them, but perhaps for one
            except OSError:
                self.size_max = min(self.size_max, size - 1)
                break
            first = last
        return first


def _clocks() -> tuple[int, int]:
    """CLOCK_REALTIME minus CLOCK_MONOTONIC, and the time of CLOCK_MONOTONIC [ns].

    The process may be preempted between the two readings, which shifted arrival times by 20 ms on a
    busy machine. So both clocks are read again unless the readings are within NEAR_NS.
    """
    nearest: tuple[int, int, int] | None = None
    for _ in range(READINGS):
        before_ns = time.monotonic_ns()
        day_ns = time.time_ns()
        now_ns = time.monotonic_ns()
        reading = now_ns - before_ns, day_ns - now_ns, now_ns
        nearest = min(nearest or reading, reading)
        if nearest[0] < NEAR_NS:
            break
    assert nearest is not None
    return nearest[1:]
