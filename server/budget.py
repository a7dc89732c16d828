"""Budget of bytes for all vehicles of a server, spent where flying on is expected to cost most.

The trigger says of each vehicle whether it is worth a packet at all. Of those that are, the budget
lets go as many as it has bytes for, in this order:

1. what is urgent: a packet in the place of a heartbeat, and the first of a vehicle that has nothing
   to fly on with. It goes in any case, as heartbeats do, and the others pay for it.
2. vehicles that were sent nothing for WAIT_S, longest first, so that nobody starves;
3. all others by what their trigger compares, a byte.

A token bucket: b ← b + r Δt, within ± r BURST_S, less what is sent, headers included; the urgent
may take it below zero. So a window of T seconds has at most r (T + BURST_S) beside the urgent.
The rate r is `control.shared_bytes_per_s`, or follows the queueing delay (`server.rate`).

Who waits asks again at the next step. Vehicles of other blocks are ranked by what they asked for
last, a step ago at most, so that blocks that are decided one after the other share one ranking.
"""

from typing import Any, Literal

import numpy as np

from skytether.server.common.clock import ClockMap
from skytether.server.rate import RateControl
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array, Flags, Indices

BURST_S = 0.1
"""Time for which the bucket has room [s]."""
WAIT_S = 1.0
"""Time after its last packet from which a vehicle goes before others [s]."""
NEVER = -2
"""Tick of a vehicle that has not asked: before all ticks."""
GUESS_BYTES = 100
"""Size of a packet on the line before one was sent [B]."""


class SharedBudget:
    """Shares one rate among up to `capacity` vehicles.

    Args:
        bytes_per_s: the rate [B/s]; auto: as the queueing delay allows.
        clock: tells delays.
    """

    def __init__(
        self, bytes_per_s: float | Literal["auto"], clock: ClockMap, capacity: int
    ) -> None:
        self._fixed = None if bytes_per_s == "auto" else bytes_per_s
        self._control = RateControl(clock, capacity)
        self._tokens = self.bytes_per_s * BURST_S
        self._filled_ns: int | None = None
        self._spent = 0
        """Bytes sent since the bucket was filled [B]."""
        self._bytes = np.full(capacity, GUESS_BYTES, dtype=np.int64)
        """Size of the newest packet to each vehicle on the line [B]; shape (capacity,)."""
        self._tick = 0
        self._asked = np.full(capacity, NEVER)
        """Tick at which each vehicle asked last and was not sent anything; shape (capacity,)."""
        self._gain = np.zeros(capacity)
        """Figure that the trigger compared then, per byte of the packet; shape (capacity,)."""
        self._waited_s = np.zeros(capacity)
        """Time since its last packet where that is WAIT_S or more, else 0 [s]; shape
        (capacity,)."""
        self.deferred = 0
        """Number of times that a vehicle had to wait for another step."""

    @property
    def bytes_per_s(self) -> float:
        """The rate [B/s]."""
        return self._control.bytes_per_s if self._fixed is None else self._fixed

    def forget(self, row: int) -> None:
        """Begin anew with a vehicle in this row."""
        self._bytes[row], self._asked[row] = GUESS_BYTES, NEVER

    def fill(self, rows: Indices, now_ns: int) -> None:
        """Begin a tick: pay for what was sent, and fill the bucket.

        Args:
            rows: vehicles in session; shape (n,).
        """
        passed_s = 0.0 if self._filled_ns is None else (now_ns - self._filled_ns) / SECOND_NS
        self._filled_ns = now_ns
        if self._fixed is None:
            self._control.update(rows, self._spent, now_ns)
        rate = self.bytes_per_s
        tokens, most = self._tokens - self._spent + rate * passed_s, rate * BURST_S
        # Debts are bounded as well, so that what is urgent cannot keep plans waiting for long.
        self._tokens, self._spent = min(max(tokens, -most), most), 0
        self._tick += 1

    def choose(
        self, rows: Indices, event: Flags, urgent: Flags, worth: Array, since_s: Array
    ) -> Flags:
        """Flags of the vehicles whose requests are granted.

        Args:
            rows: the vehicles; shape (n,).
            event: which ask; shape (n,).
            urgent: which of these cannot wait; shape (n,).
            worth: what the trigger compares; shape (n,).
            since_s: time since each was sent something [s]; shape (n,).
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
        # The first that does not fit holds up all behind it: smaller packets must not pass it for
        # ever.
        goes = ranked[np.cumsum(self._bytes[ranked]) <= left]
        chosen = urgent & event | np.isin(rows, goes) & asks
        late = int(asks.sum() - (chosen & asks).sum())
        if late:
            self.deferred += late
            self._control.needed = True
        self._asked[rows[chosen]] = NEVER
        return chosen

    def charge(self, row: int, size: int, *, is_plan: bool) -> None:
        """Take note of what was sent to a vehicle.

        Args:
            size: bytes of its payloads with a header each [B].
            is_plan: whether it is what `choose` has chosen, and not a heartbeat.
        """
        self._spent += size
        if is_plan:
            self._bytes[row] = size

    def figures(self) -> dict[str, Any]:
        """Figures of the budget."""
        return {
            "bytes_per_s": self.bytes_per_s,
            "queueing_ms": self._control.queueing_s * 1e3,
            "deferred": self.deferred,
        }
