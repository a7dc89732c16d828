"""IP packets of a program for netem: flows, Ethernet frames, answers to packets that are too long.

The addresses are the defaults of slirp4netns, which speaks Ethernet. The program's device has no
link layer, so only the program's own packets pass it: no ARP, no neighbour discovery (ND).
"""

import struct
from ipaddress import IPv4Address, IPv6Address

PROGRAM = ("program", 0)
"""Peer that represents the program; the payload of its datagrams is an IP packet."""
OUTSIDE = ("outside", 0)
"""Peer that represents all other hosts."""
ADDRESS, GATEWAY = IPv4Address("10.0.2.100"), IPv4Address("10.0.2.2")
"""Addresses of the program and of this machine, as the program sees them."""
ADDRESS6, GATEWAY6 = IPv6Address("fd00::100"), IPv6Address("fd00::2")
RESOLVER = IPv4Address("10.0.2.3")
"""Address at which slirp4netns passes queries on to this machine's resolver."""

ICMP, ICMP6 = 1, 58
ECHOES = (0, 8)
"""ICMP types of echo reply and echo request. Of all ICMP messages only these get an ICMP error in
reply."""
ERRORS6 = 128
"""Smallest ICMPv6 type that is not an error."""
DISCOVERY = range(133, 138)
"""ICMPv6's types of ND, which slirp4netns sends by itself."""
WITH_PORTS = frozenset((6, 17, 33, 132))
"""Protocols whose headers begin with two ports: TCP, UDP, DCCP, SCTP."""
SHORTEST, SHORTEST6 = 20, 40
"""Sizes of the headers of IPv4 and IPv6 without options [B]."""
QUOTED, QUOTED6 = 548, 1232
"""Largest part of a packet that an ICMP error quotes [B]: with its headers an error has at most
576 B with IPv4, and 1280 B with IPv6."""

_OUR_MAC, _ITS_MAC = bytes.fromhex("020000000001"), bytes.fromhex("52550a000202")
_IPV4, _IPV6, _ARP = b"\x08\x00", b"\x86\xdd", b"\x08\x06"
_HEAD, _HEAD6 = _ITS_MAC + _OUR_MAC + _IPV4, _ITS_MAC + _OUR_MAC + _IPV6


def flow_of(packet: bytes, *, is_outward: bool) -> bytes | None:
    """Key of a packet's flow, equal in both directions; None if it is not an IP packet.

    The key has protocol, addresses, and, if the packet has them, ports; fragments have none.

    Args:
        is_outward: whether the packet is from the program.
    """
    version = packet[0] >> 4 if packet else 0
    if version == 4 and len(packet) >= SHORTEST:
        start, protocol = 4 * (packet[0] & 15), packet[9]
        here, there = packet[12:16], packet[16:20]
        is_whole = not (packet[6] & 0x3F or packet[7])
    elif version == 6 and len(packet) >= SHORTEST6:
        start, protocol = SHORTEST6, packet[6]
        here, there = packet[8:24], packet[24:40]
        is_whole = True
    else:
        return None
    ports = packet[start : start + 4] if is_whole and protocol in WITH_PORTS else b""
    if not is_outward:
        here, there, ports = there, here, ports[2:] + ports[:2]
    return bytes((protocol,)) + here + there + ports


def framed(packet: bytes) -> bytes:
    """Ethernet frame that carries a packet to slirp4netns."""
    return (_HEAD if packet[0] >> 4 == 4 else _HEAD6) + packet


def unframed(frame: bytes) -> bytes | None:
    """Packet in a frame from slirp4netns; None if it is not for the program."""
    kind = frame[12:14]
    if kind == _IPV4:
        return frame[14:]
    if kind != _IPV6 or len(frame) < 14 + SHORTEST6 or frame[38] == 0xFF:  # ff00::/8: multicast
        return None
    if frame[20] == ICMP6 and frame[54:55] and frame[54] in DISCOVERY:
        return None
    return frame[14:]


def announcements() -> tuple[bytes, bytes]:
    """Frames by which slirp4netns learns the program's link-layer address: ARP and ND."""
    request = struct.pack(">HHBBH", 1, 0x0800, 6, 4, 1) + _OUR_MAC + ADDRESS.packed
    arp = b"\xff" * 6 + _OUR_MAC + _ARP + request + bytes(6) + GATEWAY.packed
    override, option = 0x20000000, b"\x02\x01" + _OUR_MAC
    body = struct.pack(">BBHI", 136, 0, 0, override) + ADDRESS6.packed + option
    return arp, framed(_icmp6(body, ADDRESS6.packed, GATEWAY6.packed, hops=255))


def too_long(packet: bytes, mtu: int) -> bytes | None:
    """Router's ICMP answer to a packet longer than the path's MTU; None if the packet gets none."""
    if packet[0] >> 4 == 6:
        if packet[6] == ICMP6 and packet[SHORTEST6] < ERRORS6:
            return None
        body = struct.pack(">BBHI", 2, 0, 0, mtu) + packet[:QUOTED6]
        return _icmp6(body, GATEWAY6.packed, packet[8:24], hops=64)
    may_fragment = not packet[6] & 0x40
    if may_fragment or (packet[9] == ICMP and packet[4 * (packet[0] & 15)] not in ECHOES):
        return None
    body = struct.pack(">BBHHH", 3, 4, 0, 0, mtu) + packet[:QUOTED]
    body = _summed(body, 2, b"")
    head = struct.pack(">BBHHHBBH", 0x45, 0, SHORTEST + len(body), 0, 0x4000, 64, ICMP, 0)
    return _summed(head + GATEWAY.packed + packet[12:16], 10, b"") + body


def _icmp6(body: bytes, source: bytes, to: bytes, *, hops: int) -> bytes:
    pseudo = source + to + struct.pack(">II", len(body), ICMP6)
    head = struct.pack(">IHBB", 6 << 28, len(body), ICMP6, hops) + source + to
    return head + _summed(body, 2, pseudo)


def _summed(data: bytes, place: int, pseudo: bytes) -> bytes:
    """Data with the Internet checksum (RFC 1071) of a pseudo-header and the data at `place`."""
    padded = pseudo + data + bytes(len(data) % 2)
    total = sum(struct.unpack(f">{len(padded) // 2}H", padded))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return data[:place] + struct.pack(">H", ~total & 0xFFFF) + data[place + 2 :]
