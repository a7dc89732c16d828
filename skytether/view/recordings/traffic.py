"""Packets through netem, for other programs: delay traces, and a capture in pcap format.

A recording of netem has each packet's time of entry, delay, size and whether it was lost, but not
its content. So the capture has made-up headers (clients are 10.path.x.y, the server is
10.255.255.254) and true lengths, which show rates, bursts and gaps.
"""

import struct
from collections.abc import Mapping

import numpy as np

from skytether.figures.tables import to_csv
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Rows

RAW_IP = 101
"""LINKTYPE_RAW: each packet begins with its IP header."""
SERVER = bytes((10, 255, 255, 254))
CLIENT_PORT, SERVER_PORT = 47000, 47001
_UDP = 17


def traces(packets: Rows, ways: Directions = FLIGHT) -> Mapping[str, str]:
    """Delay traces for the impairment `trace`, as CSV, by direction, flow and path."""
    csv = {}
    for way, direction in zip(ways, (UPLINK, DOWNLINK), strict=True):
        for path, flow in np.unique(packets[["path", "flow"]]).tolist():
            of_flow = (packets["path"] == path) & (packets["flow"] == flow)
            rows = packets[of_flow & (packets["direction"] == direction)]
            rows = rows[np.argsort(rows["arrived_ns"], kind="stable")]
            # a trace has one packet per time
            rows = rows[np.diff(rows["arrived_ns"], prepend=-1) > 0]
            if not len(rows):
                continue
            time_s = (rows["arrived_ns"] - rows["arrived_ns"][0]) / SECOND_NS
            columns = time_s, rows["delay_ns"] / SECOND_NS, rows["lost"].astype(int)
            lines = zip(*(column.tolist() for column in columns), strict=True)
            at = f"-path-{path + 1}" if path else ""
            csv[f"{way}-{flow}{at}"] = to_csv(("time_s", "delay_s", "lost"), lines)
    return csv


def pcap(packets: Rows, began_ns: int = 0, *, header_bytes: int = HEADER_BYTES) -> bytes:
    """Capture of the packets that netem sent, without lost ones.

    Args:
        began_ns: time of day at time 0 of the packets [ns since 1970].
        header_bytes: size of headers not included in recorded sizes [B]; 0 for IP packets.
    """
    rows = packets[~packets["lost"]]
    left_ns = rows["arrived_ns"] + rows["delay_ns"] + began_ns
    order = np.argsort(left_ns, kind="stable")
    # Magic number for nanosecond times; version 2.4; packets are truncated after the headers.
    pieces = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, HEADER_BYTES, RAW_IP)]
    for row, time_ns in zip(rows[order], left_ns[order].tolist(), strict=True):
        size = int(row["bytes"]) + header_bytes
        seconds, rest_ns = divmod(time_ns, SECOND_NS)
        header = _header(int(row["direction"]), int(row["path"]), int(row["flow"]), size)[:size]
        pieces += struct.pack("<IIII", seconds, rest_ns, len(header), size), header
    return b"".join(pieces)


def _header(direction: int, path: int, flow: int, size: int) -> bytes:
    """IP and UDP header of a packet of this size [B], headers included."""
    client = bytes((10, path, (flow + 1) >> 8 & 0xFF, flow + 1 & 0xFF)), CLIENT_PORT
    ends = [client, (SERVER, SERVER_PORT)]
    (source, source_port), (target, target_port) = ends if direction == DOWNLINK else ends[::-1]
    length = min(size, 0xFFFF)
    ip = struct.pack(">BBHHHBBH", 0x45, 0, length, 0, 0, 64, _UDP, 0) + source + target
    total = sum(struct.unpack(">10H", ip))
    checksum = 0xFFFF & ~((total & 0xFFFF) + (total >> 16))
    ip = ip[:10] + struct.pack(">H", checksum) + ip[12:]
    return ip + struct.pack(">HHHH", source_port, target_port, length - 20, 0)
