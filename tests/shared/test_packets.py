"""Packets of IP, against captured ones and the kernel's rules."""

import struct
from ipaddress import IPv4Address, IPv6Address, ip_address

import pytest

from skytether.shared.base.packets import (
    ADDRESS,
    ADDRESS6,
    GATEWAY,
    GATEWAY6,
    announcements,
    flow_of,
    framed,
    too_long,
    unframed,
)

TCP, UDP, ICMP, ICMP6 = 6, 17, 1, 58


def packet(
    source: str,
    to: str,
    protocol: int,
    payload: bytes,
    *,
    flags: int = 0x4000,
    options: bytes = b"",
) -> bytes:
    """Packet of either version, without checksums."""
    here, there = ip_address(source), ip_address(to)
    if isinstance(here, IPv6Address):
        head = struct.pack(">IHBB", 6 << 28, len(payload), protocol, 64)
    else:
        first, size = 0x45 + len(options) // 4, 20 + len(options) + len(payload)
        head = struct.pack(">BBHHHBBH", first, 0, size, 7, flags, 64, protocol, 0)
    return head + here.packed + there.packed + options + payload


def ports(source: int, to: int) -> bytes:
    return struct.pack(">HH", source, to) + bytes(16)


def checksum(data: bytes) -> int:
    """Sum of RFC 1071: 0xFFFF over data with a right checksum."""
    data += bytes(len(data) % 2)
    total = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return total


@pytest.mark.parametrize("hosts", [("10.0.2.100", "192.0.2.1"), ("fd00::100", "2001:db8::1")])
@pytest.mark.parametrize("protocol", [TCP, UDP])
def test_both_directions_of_a_connection_are_one_flow(
    hosts: tuple[str, str], protocol: int
) -> None:
    here, there = hosts
    out = flow_of(packet(here, there, protocol, ports(1025, 53)), is_outward=True)
    back = flow_of(packet(there, here, protocol, ports(53, 1025)), is_outward=False)
    other = flow_of(packet(here, there, protocol, ports(1026, 53)), is_outward=True)
    assert out == back
    assert out != other


def test_ports_are_found_behind_options() -> None:
    plain = packet("10.0.2.100", "192.0.2.1", UDP, ports(1, 2))
    longer = packet("10.0.2.100", "192.0.2.1", UDP, ports(1, 2), options=b"\x94\x04\0\0")
    assert flow_of(plain, is_outward=True) == flow_of(longer, is_outward=True)


def test_all_fragments_of_a_host_are_one_flow() -> None:
    first = packet("10.0.2.100", "192.0.2.1", UDP, ports(1, 2), flags=0x2000)
    last = packet("10.0.2.100", "192.0.2.1", UDP, b"rest of the data", flags=0x0010)
    assert flow_of(first, is_outward=True) == flow_of(last, is_outward=True)


@pytest.mark.parametrize("junk", [b"", b"E", bytes(40), b"E" + bytes(18), b"`" + bytes(38)])
def test_what_is_no_packet_has_no_flow(junk: bytes) -> None:
    assert flow_of(junk, is_outward=True) is None


def test_a_frame_contains_its_packet() -> None:
    for each in (
        packet("10.0.2.100", "192.0.2.1", UDP, b""),
        packet("fd00::1", "fd00::2", UDP, b""),
    ):
        assert unframed(framed(each)) == each


def test_neighbour_discovery_is_not_for_the_program() -> None:
    advertisement = packet("fe80::2", "ff02::1", ICMP6, bytes([134, 0, 0, 0]))
    solicitation = packet("fd00::2", str(ADDRESS6), ICMP6, bytes([135, 0, 0, 0]))
    echo = packet("fd00::2", str(ADDRESS6), ICMP6, bytes([129, 0, 0, 0]))
    assert [unframed(framed(each)) for each in (advertisement, solicitation, echo)] == [
        None,
        None,
        echo,
    ]
    arp = announcements()[0]
    assert unframed(arp) is None


def test_the_announcement_of_ipv6_is_valid() -> None:
    frame = announcements()[1]
    body = frame[54:]
    pseudo = ADDRESS6.packed + GATEWAY6.packed + struct.pack(">II", len(body), ICMP6)
    assert checksum(pseudo + body) == 0xFFFF
    assert frame[21] == 255  # RFC 4861: others are ignored
    assert body[0] == 136
    assert IPv6Address(body[8:24]) == ADDRESS6


def test_a_packet_too_long_is_answered_with_the_mtu() -> None:
    long = packet(str(ADDRESS), "192.0.2.1", UDP, ports(1, 2) + bytes(1400))
    answer = too_long(long, 1300)
    assert answer is not None
    assert checksum(answer[:20]) == checksum(answer[20:]) == 0xFFFF
    assert IPv4Address(answer[12:16]) == GATEWAY
    assert IPv4Address(answer[16:20]) == ADDRESS
    assert struct.unpack(">BBxxHH", answer[20:28]) == (3, 4, 0, 1300)
    assert long.startswith(answer[28:])
    assert len(answer) == int.from_bytes(answer[2:4], "big") <= 576


def test_a_packet_of_ipv6_too_long_is_answered_with_the_mtu() -> None:
    long = packet(str(ADDRESS6), "2001:db8::1", TCP, ports(1, 2) + bytes(1401))
    answer = too_long(long, 1300)
    assert answer is not None
    body = answer[40:]
    pseudo = answer[8:40] + struct.pack(">II", len(body), ICMP6)
    assert checksum(pseudo + body) == 0xFFFF
    assert struct.unpack(">BBxxI", body[:8]) == (2, 0, 1300)
    assert len(answer) == 1280


@pytest.mark.parametrize(
    "silent",
    [
        packet("10.0.2.100", "192.0.2.1", UDP, bytes(1400), flags=0),  # may be fragmented
        packet("10.0.2.100", "192.0.2.1", ICMP, bytes([3, 4]) + bytes(1400)),  # is an error itself
        packet("fd00::100", "2001:db8::1", ICMP6, bytes([1, 0]) + bytes(1400)),
    ],
)
def test_no_error_answers_an_error(silent: bytes) -> None:
    assert too_long(silent, 1300) is None


@pytest.mark.parametrize(
    "echo",
    [
        packet("10.0.2.100", "192.0.2.1", ICMP, bytes([8, 0]) + bytes(1400)),
        packet("fd00::100", "2001:db8::1", ICMP6, bytes([128, 0]) + bytes(1400)),
    ],
)
def test_a_ping_too_long_is_answered(echo: bytes) -> None:
    assert too_long(echo, 1300) is not None
