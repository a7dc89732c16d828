"""Measurements from files: a log of round-trip times, or two captures of one UDP flow.

A log (`shared.formats.recorded`) has one clock and one series of delays, which is used for both
directions.

Two captures, one at each end, are matched by payload, for the flow with most packets in both. A
payload that was sent twice is left out, because its arrivals are ambiguous. The clocks may differ.
Of the flow's two directions, the downlink is the one with the larger far time minus near time; the
difference between the two directions is a round-trip time. A packet is lost if it is in the
sender's capture only, between the first and the last packets that are in both.
"""

import struct
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping

import numpy as np

from skytether.probe.outages import RoundTrips
from skytether.probe.prober import PROBES_MAX, MeasuredPath, Way
from skytether.shared.base.units import SECOND_NS
from skytether.shared.formats.recorded import CAPTURES, CAPTURES_NEW, RecordedPath

RECORDS_MAX = 4 * PROBES_MAX
"""Largest number of records in a capture, those of other protocols included."""
PAYLOAD_BYTES_MIN = 8
"""Smallest payload by which packets are matched [B]."""
TIME_MAX_NS = 2**62
"""Latest time of a packet, which is in 2116 [ns since 1970]."""
SIZES_MAX = 8
"""Number of packet sizes, the most frequent ones, into which longer packets are split."""
UDP = 17


def is_capture(content: bytes) -> bool:
    return content[:4] in {*CAPTURES, CAPTURES_NEW}


def of_log(path: RecordedPath) -> MeasuredPath:
    """Measurement from a log: both ways alike, on one clock."""
    sent_ns = np.rint(path.time_s * SECOND_NS).astype(np.int64)
    delay_ns = np.rint(path.delay_s * SECOND_NS).astype(np.int64)
    came = ~path.lost
    alone = np.full(len(sent_ns), -1, np.int64)
    way = Way(sent_ns, np.where(came, sent_ns + delay_ns, 0), came, alone, path.copies)
    return MeasuredPath(way, way, 0, _period_ns(way), 0)


def round_trips(path: RecordedPath) -> RoundTrips:
    """Round trips of a log, on the clock of the file."""
    trip_s = np.where(path.lost, np.nan, 2.0 * path.delay_s)
    return RoundTrips(path.begin_s + path.time_s, trip_s)


def _period_ns(way: Way) -> int:
    return int(np.median(np.diff(way.sent_ns))) if len(way.sent_ns) > 1 else SECOND_NS


# -- two captures ---------------------------------------------------------------------------------

Ends = tuple[bytes, bytes]
"""Address and port of the sender, and of the receiver."""
Packets = list[tuple[int, bytes]]
"""Time [ns] and payload of each packet of a direction, in order of time."""


def of_captures(near: bytes, far: bytes) -> MeasuredPath:
    """Measurement of the UDP flow that is in two captures.

    Args:
        near: capture at the vehicle's end.
        far: capture at the server's end.

    Raises:
        ValueError: one cannot be read, or they have too few packets in common.
    """
    near_flows, far_flows = _directions(near), _directions(far)
    where = {payload: ends for ends, packets in far_flows.items() for _, payload in packets}
    shared = Counter(
        (ends, where[payload])
        for ends, packets in near_flows.items()
        for _, payload in packets
        if payload in where
    )
    if not shared:
        raise ValueError("no UDP packet is in both captures with its payload")
    ends, far_ends = shared.most_common(1)[0][0]
    flow = [
        _as_sent(near_flows.get(one, []), far_flows.get(other, []))
        for one, other in ((ends, far_ends), (ends[::-1], far_ends[::-1]))
    ]
    ahead_ns = [_ahead_ns(*direction) for direction in flow]
    if ahead_ns[0] == ahead_ns[1]:
        raise ValueError("got the same times in both captures, expected one of each end")
    (near_down, far_down), (near_up, far_up) = flow if ahead_ns[0] > ahead_ns[1] else flow[::-1]
    downlink, left_down = _way(near_down, far_down)
    uplink, left_up = _way(far_up, near_up)
    size = int(np.median([len(payload) for _, payload in near_down]))
    return MeasuredPath(downlink, uplink, size, _period_ns(downlink), left_down + left_up)


def _as_sent(near: Packets, far: Packets) -> tuple[Packets, Packets]:
    """Packets of a direction in both captures, as they were on the wire.

    If a kernel splits packets late (UDP segmentation offload), a capture has several as one.
    """

    def split(packets: Packets, others: Packets) -> Packets:
        whole = {payload for _, payload in others}
        sizes = [size for size, _ in Counter(map(len, whole)).most_common(SIZES_MAX)]
        found: Packets = []
        for time_ns, payload in packets:
            pieces = [payload]
            for size in sizes if payload not in whole else []:
                parts = [payload[at : at + size] for at in range(0, len(payload), size)]
                if not whole.isdisjoint(parts):
                    pieces = parts
                    break
            found += [(time_ns, piece) for piece in pieces]
        return found

    return split(near, far), split(far, near)


def _ahead_ns(near: Packets, far: Packets) -> float:
    """Far time minus near time of the packets of a direction: the median.

    Raises:
        ValueError: fewer than two packets are in both captures.
    """
    times = {payload: time_ns for time_ns, payload in far}
    ahead = [times[payload] - time_ns for time_ns, payload in near if payload in times]
    if len(ahead) < 2:
        raise ValueError(
            "the captures share packets of one direction only, which does not separate delays from "
            "clock offsets: expected a flow that goes both ways"
        )
    return float(np.median(ahead))


def _way(sent: Packets, came: Packets) -> tuple[Way, int]:
    """Packets of a direction, and the number of those that were left out.

    Raises:
        ValueError: too few have a unique payload, or there are too many.
    """
    counts = Counter(payload for _, payload in sent)
    arrivals = defaultdict[bytes, list[int]](list)
    for time_ns, payload in came:
        arrivals[payload].append(time_ns)
    unique = [(time_ns, payload) for time_ns, payload in sent if counts[payload] == 1]
    both = [place for place, (_, payload) in enumerate(unique) if payload in arrivals]
    if len(both) < 2 or 2 * len(unique) < len(sent):
        raise ValueError(
            f"of {len(sent)} packets of a direction {len(unique)} have a unique payload: "
            "expected most; a capture on one interface has each packet once"
        )
    unique = unique[both[0] : both[-1] + 1]
    if len(unique) > PROBES_MAX:
        raise ValueError(f"got {len(unique)} packets of a direction, expected at most {PROBES_MAX}")
    heard = [arrivals.get(payload, []) for _, payload in unique]
    way = Way(
        np.array([time_ns for time_ns, _ in unique], np.int64),
        np.array([times_ns[0] if times_ns else 0 for times_ns in heard], np.int64),
        np.array([bool(times_ns) for times_ns in heard]),
        np.full(len(unique), -1, np.int64),
        sum(max(len(times_ns) - 1, 0) for times_ns in heard),
    )
    return way, len(sent) - sum(counts[payload] == 1 for _, payload in sent)


def _directions(content: bytes) -> Mapping[Ends, Packets]:
    flows = defaultdict[Ends, Packets](list)
    for number, (time_ns, link, frame) in enumerate(_records(content)):
        if number >= RECORDS_MAX:
            raise ValueError(f"got a capture of more packets than {RECORDS_MAX}")
        packet = _udp(link, frame)
        if packet is not None:
            ends, payload = packet
            flows[ends].append((time_ns, payload))
    for packets in flows.values():
        packets.sort(key=lambda packet: packet[0])
    return flows


# -- pcap and pcapng ------------------------------------------------------------------------------

Record = tuple[int, int, bytes]
"""Time [ns], link type, and frame."""


def _records(content: bytes) -> Iterator[Record]:
    """Records of a capture; a truncated file ends at its last whole record."""
    return _pcapng(content) if content[:4] == CAPTURES_NEW else _pcap(content)


def _pcap(content: bytes) -> Iterator[Record]:
    order = "<" if CAPTURES.index(content[:4]) % 2 == 0 else ">"
    unit_ns = 1000 if CAPTURES.index(content[:4]) < 2 else 1
    if len(content) < 24:
        return
    (link,) = struct.unpack_from(order + "I", content, 20)
    at = 24
    while at + 16 <= len(content):
        seconds, rest, size, _ = struct.unpack_from(order + "IIII", content, at)
        frame = content[at + 16 : at + 16 + size]
        if len(frame) < size:
            return
        yield seconds * SECOND_NS + rest * unit_ns, link & 0xFFFF, frame
        at += 16 + size


def _pcapng(content: bytes) -> Iterator[Record]:
    order, at = "<", 0
    interfaces: list[tuple[int, int]] = []
    while at + 12 <= len(content):
        if content[at : at + 4] == CAPTURES_NEW:
            order = "<" if content[at + 8 : at + 12] == b"\x4d\x3c\x2b\x1a" else ">"
            interfaces = []
        kind, size = struct.unpack_from(order + "II", content, at)
        block = content[at + 8 : at + size - 4]
        if size < 12 or at + size > len(content):
            return
        if kind == 1 and len(block) >= 8:  # interface description
            (link,) = struct.unpack_from(order + "H", block)
            interfaces.append((link, _ticks_per_s(order, block[8:])))
        elif kind == 6 and len(block) >= 20:  # enhanced packet
            interface, high, low, length, _ = struct.unpack_from(order + "IIIII", block)
            if interface < len(interfaces):
                link, per_s = interfaces[interface]
                time_ns = ((high << 32) | low) * SECOND_NS // per_s
                if time_ns > TIME_MAX_NS:
                    raise ValueError(f"got a packet at {time_ns / SECOND_NS:.3g} s since 1970")
                yield time_ns, link, block[20 : 20 + length]
        at += size


def _ticks_per_s(order: str, options: bytes) -> int:
    """Time resolution of an interface, from its option if_tsresol [1/s]."""
    at = 0
    while at + 4 < len(options):
        code, size = struct.unpack_from(order + "HH", options, at)
        if code == 9:
            value: int = options[at + 4]
            return 2 ** (value & 0x7F) if value & 0x80 else 10 ** min(value, 18)
        at += 4 + size + -size % 4
    return 1_000_000


_LINKS = {0: 4, 1: 14, 12: 0, 14: 0, 101: 0, 108: 4, 113: 16, 228: 0, 229: 0, 276: 20}
"""Bytes before the IP header by type of the link: loopback, Ethernet, raw IP, Linux `any`."""
_VLANS = (b"\x81\x00", b"\x88\xa8")


def _udp(link: int, frame: bytes) -> tuple[Ends, bytes] | None:
    """Ends and payload of a UDP packet in a frame; None for anything else, and for fragments."""
    at = _LINKS.get(link)
    if at is None:
        return None
    if link == 1:
        while frame[at - 2 : at] in _VLANS and at < 26:
            at += 4
        if frame[at - 2 : at] not in (b"\x08\x00", b"\x86\xdd"):
            return None
    ip = frame[at:]
    version = ip[0] >> 4 if len(ip) >= 28 else 0
    if version == 4 and ip[9] == UDP and not int.from_bytes(ip[6:8]) & 0x3FFF:
        head, source, target = 4 * (ip[0] & 15), ip[12:16], ip[16:20]
    elif version == 6 and ip[6] == UDP:
        head, source, target = 40, ip[8:24], ip[24:40]
    else:
        return None
    udp = ip[head:]
    payload = udp[8 : int.from_bytes(udp[4:6])]
    ends = source + udp[:2], target + udp[2:4]
    return (ends, payload) if len(payload) >= PAYLOAD_BYTES_MIN else None
