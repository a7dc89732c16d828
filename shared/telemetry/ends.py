"""Packets at the ends: when an end was woken, and what it received and sent.

netem sees a packet on its way; whether an end handled it before or after a tick follows from the
order of these rows:

    woken       by its timer
    received    a datagram
    sent        a datagram, in response to the newest row before it that is not of this kind
"""

from enum import IntEnum

import numpy as np

PART = "ends"
"""Name of the part."""
COLUMNS: np.dtype[np.void] = np.dtype(
    [
        ("end", "<u1"),  # an `End`
        ("happened", "<u1"),  # a `Happened`
        ("kind", "<u1"),  # type of the message, see docs/protocol.md; 0 if sealed, or of a wake
        ("peer", "<u2"),  # number of the other address, in the order of their first packets
        ("bytes", "<u2"),  # UDP payload
        ("packet", "<i8"),  # hash of the payload, the same at both ends
        ("time_ns", "<i8"),  # [clock of the process]
        ("due_ns", "<i8"),  # of a wake, the time for which the timer was set [same clock]; else 0
    ]
)
"""Columns of the part: a row for each wake and each datagram, without those of an autopilot."""


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
