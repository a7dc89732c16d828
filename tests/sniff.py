"""Write every UDP packet received or sent here to standard output, as a pcap file.

Runs as root in the network of a container: `python -c "$(cat sniff.py)" > capture.pcap`.
"""

import signal
import socket
import struct
import sys
import time

ETHERNET, EVERYTHING, UDP_IPV4 = 1, 0x0003, (0x0800, 17)
HEAD = struct.pack("=IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, ETHERNET)


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    out = sys.stdout.buffer
    out.write(HEAD)
    out.flush()
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(EVERYTHING)) as wire:
        while True:
            frame = wire.recv(65535)
            kind = int.from_bytes(frame[12:14])
            if len(frame) < 34 or (kind, frame[23]) != UDP_IPV4:
                continue
            now_ns = time.time_ns()
            seconds, micros = divmod(now_ns // 1000, 1_000_000)
            out.write(struct.pack("=IIII", seconds, micros, len(frame), len(frame)) + frame)
            out.flush()


if __name__ == "__main__":
    main()
