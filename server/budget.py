"""Byte budget shared by all vehicles of a server, spent on the plans with the largest gain.

The trigger decides whether a vehicle requests a packet. The budget grants requests while it has
bytes, in this order:

1. urgent packets: a plan that replaces a heartbeat, and the first plan of a vehicle. They are
   always granted, like heartbeats, and leave fewer bytes for the others;
2. vehicles that got no packet for WAIT_S, the longest wait first, so that each gets plans;
3. all other vehicles, those with the largest figure of the trigger per byte first.

The budget is a token bucket with b bytes: b ← b + r Δt, within ± r BURST_S, minus the bytes sent,
headers included. Urgent packets may make b negative. So a window of T seconds has at most r (T +
BURST_S) bytes of packets that are not urgent. The rate r is `control.shared_bytes_per_s`.

A refused vehicle asks again at the next step. The server plans for vehicles in blocks, one after
another. Each time the ranking covers the vehicles of all blocks, each with its latest request,
which is at most one step old.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.law.model import Array, Flags, Indices

BURST_S = 0.1
"""Size of the token bucket, divided by the rate r [s]."""
WAIT_S = 1.0
"""Time without a packet after which a vehicle takes precedence [s]."""
NEVER = -2
"""Value of `_asked` for a vehicle without a refused request: less than any tick's number."""
GUESS_BYTES = 100
"""Assumed size of a packet, with headers, until the first is sent [B]."""


class SharedBudget:
    """Shares one rate among up to `capacity` vehicles.

    Args:
        bytes_per_s: the rate [B/s].
    """

    def __init__(self, bytes_per_s: float, capacity: int) -> None:
        self.bytes_per_s = bytes_per_s
        self._tokens = bytes_per_s * BURST_S
        self._filled_ns: int | None = None
        self._spent = 0
        self._bytes = np.full(capacity, GUESS_BYTES, dtype=np.int64)
        """Size of the newest packet to each vehicle, with headers [B]; shape (capacity,)."""
        self._tick = 0
        self._asked = np.full(capacity, NEVER)
        """Number of the tick of each vehicle's latest refused request; shape (capacity,)."""
        self._gain = np.zeros(capacity)
        """Figure of the trigger at the latest decision, per byte of a packet; shape (capacity,)."""
        self._waited_s = np.zeros(capacity)
        """Time since the last packet [s], or 0 if less than WAIT_S; shape (capacity,)."""
        self.deferred = 0
        """Number of refused requests."""

    def forget(self, row: int) -> None:
        self._bytes[row], self._asked[row] = GUESS_BYTES, NEVER

    def fill(self, now_ns: int) -> None:
        passed_s = 0.0 if self._filled_ns is None else (now_ns - self._filled_ns) / SECOND_NS
        self._filled_ns = now_ns
        rate = self.bytes_per_s
        tokens, most = self._tokens - self._spent + rate * passed_s, rate * BURST_S
        # A negative balance is bounded, too, so that urgent packets cannot delay plans for long.
        self._tokens, self._spent = min(max(tokens, -most), most), 0
        self._tick += 1

    def choose(
        self, rows: Indices, event: Flags, urgent: Flags, worth: Array, since_s: Array
    ) -> Flags:
        """Flags of the vehicles whose requests are granted; all arrays have shape (n,).

        Args:
            rows: the vehicles.
            event: whether each vehicle requests a packet.
            urgent: whether each request must be granted.
            worth: figure that the trigger compares.
            since_s: time since the last packet to each [s].
        """
        asks = event & ~urgent
        self._asked[rows] = np.where(asks, self._tick, NEVER)
        self._gain[rows] = np.nan_to_num(worth) / self._bytes[rows]
        self._waited_s[rows] = np.where(since_s >= WAIT_S, since_s, 0.0)
        left = self._tokens - self._spent - self._bytes[rows[event & urgent]].sum()
        waiting = (self._asked >= self._tick - 1).nonzero()[0]
        # np.lexsort sorts by its last key first: longest wait, then largest gain.
        order = np.lexsort((-self._gain[waiting], -self._waited_s[waiting]))
        ranked = waiting[order]
        # After the first request that exceeds the budget, no further request is granted: otherwise
        # smaller packets could always overtake a large one.
        goes = ranked[np.cumsum(self._bytes[ranked]) <= left]
        chosen = urgent & event | np.isin(rows, goes) & asks
        late = int(asks.sum() - (chosen & asks).sum())
        self.deferred += late
        self._asked[rows[chosen]] = NEVER
        return chosen

    def charge(self, row: int, packet: Sequence[Datagram], *, is_plan: bool) -> None:
        """Subtract the bytes of a packet and its copies. `is_plan` is False for a heartbeat."""
        # The network also carries headers of IP and UDP: 28 bytes, more than a whole heartbeat.
        size = sum(len(each.payload) + HEADER_BYTES for each in packet)
        self._spent += size
        if is_plan:
            self._bytes[row] = size

    def figures(self) -> dict[str, Any]:
        return {"bytes_per_s": self.bytes_per_s, "deferred": self.deferred}
