"""Part of the record about server and client: their wakes, and the datagrams that they received
and sent.

The order of the rows shows whether an end handled a packet before or after a tick:

    woken       by the end's timer
    received    a datagram
    sent        a datagram, in response to the newest previous row "woken" or "received"
"""

from enum import IntEnum

import numpy as np

PART = "ends"
"""Name of the part."""
COLUMNS: np.dtype[np.void] = np.dtype(
    [
        ("end", "<u1"),  # an `End`
        ("happened", "<u1"),  # a `Happened`
        ("kind", "<u1"),  # type of the message, see docs/protocol.md; 0 if encrypted, or for a wake
        ("peer", "<u2"),  # number of the peer's address, in the order of first packets
        ("bytes", "<u2"),  # size of the UDP payload
        ("packet", "<i8"),  # hash of the payload, the same at both ends
        ("time_ns", "<i8"),  # time of the row, on the clock of the process
        ("due_ns", "<i8"),  # time for which a wake's timer was set [same clock]; 0 in other rows
    ]
)
"""Columns of the part: a row for each wake and each datagram, except an autopilot's datagrams."""


class End(IntEnum):
    SERVER = 0
    CLIENT = 1

    def __str__(self) -> str:
        return self.name.lower()


class Happened(IntEnum):
    WOKEN = 0
    RECEIVED = 1
    SENT = 2

    def __str__(self) -> str:
        return self.name.lower()
