"""Linux at both ends of a TCP connection behind `skytether netem run`.

The far end of a program's TCP is otherwise libslirp, whose retransmission time-out is 1.2 s or
more, where Linux has 200 ms and a round trip (measured with 20 round trips of 200 B a second and a
loss of 5 % in one direction: a lost segment from libslirp takes 1.25 s or 1.75 s, one to libslirp
0.23 s). So the packets of a wire travel as UDP datagrams, one each, and a lost datagram is a lost
segment of TCP. Each end of the wire is a TUN device in a network namespace of its own. The
congestion control is BBR if Linux has it, which suffers less from losses than the default.
"""

import os
import select
import socket
import struct
import subprocess
from contextlib import suppress
from pathlib import Path

from skytether.shared.endpoints.endpoint import Address
from skytether.shell.host import system
from skytether.shell.processes.workers import die_with_parent

SERVER = "10.77.0.1"
MTU = 1400
PACKET_BYTES_MAX = 2048
HEADER_BYTES = 28
"""Headers of IP and UDP around each packet of the wire [B]."""
_NEWUSER, _NEWNET = 0x10000000, 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000


def robot_address(number: int) -> str:
    """Address of a robot on the wire; the number is 1 to 65 000."""
    return f"10.77.{1 + number // 256}.{number % 256}"


def lay(address: str, sock: socket.socket, peers: dict[str, Address]) -> None:
    """Move this process to a new network namespace, whose packets a child process sends by `sock`.

    The CPU time of this process does not include the child's.

    Args:
        address: address of this process on the wire.
        sock: UDP socket, made in the previous namespace.
        peers: UDP address to which packets for each address on the wire are sent; further ones are
            learned from received packets.
    """
    flags = _NEWNET if os.geteuid() == 0 else _NEWNET | _NEWUSER
    if system.LIBC.unshare(flags):
        raise OSError("no network namespace for the wire")
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    system.fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", b"wire", _IFF_TUN | _IFF_NO_PI))
    lines = (
        "link set lo up",
        "link set wire addrgenmode none",
        f"link set wire mtu {MTU} up",
        f"addr add {address}/14 dev wire",
    )
    subprocess.run(["ip", "-batch", "-"], input="\n".join(lines).encode(), check=True)
    with suppress(OSError):
        Path("/proc/sys/net/ipv4/tcp_congestion_control").write_text("bbr")
    sock.setblocking(False)
    if os.fork() == 0:
        die_with_parent()
        _carry(device, sock, {socket.inet_aton(name): peer for name, peer in peers.items()})
    os.close(device)
    sock.close()


def _carry(device: int, sock: socket.socket, peers: dict[bytes, Address]) -> None:
    while True:
        select.select([device, sock.fileno()], [], [])
        with suppress(OSError):
            while True:
                packet = os.read(device, PACKET_BYTES_MAX)
                if peer := peers.get(packet[16:20]):
                    sock.sendto(packet, peer)
        with suppress(OSError):
            while True:
                packet, sender = sock.recvfrom(PACKET_BYTES_MAX)
                peers[packet[12:16]] = sender
                os.write(device, packet)
