"""Rate control: the rate at which the server sends, from the queueing delay of its packets.

A shared radio channel carries a limited number of bytes a second; further bytes have to queue.
Every echo reports the delay G of a packet; its excess over the vehicle's smallest G in 20 s
(`server.planning.clock`) is jitter and queue. A standing queue delays all packets, jitter only
some. With the low quantile Q and the median M of this excess over an epoch,

    q = Q - min Q of the last BASE epochs        queueing delay
    s = TARGET_S + M - Q                         largest delay not certainly due to a queue

and with the rate r, and b bytes a second sent in the epoch,

    r ← CUT p,  p = b / (1 + Δq / Δt)     if q > s, and q does not fall by itself
    r ← p (1 + (1 - CUT) (t / K - 1)³)    if q ≤ LOW s, a packet had to wait, b > USED r

If a queue grows by Δq in an epoch of Δt, the channel passes correspondingly less than is sent: p,
with the b of the previous epoch, whose packets the echoes report. After a cut, r returns to p after
the time K, is flattest there, and then rises ever faster (the window of CUBIC, RFC 9438); t is the
time for which it has risen. Until q first exceeds s, r ← r FIRST_GAIN. While rising, r never falls
below b. The epochs just after a cut concern packets sent before it and change nothing.

Losses are not used. If they are random, a lower rate loses the same share and delivers less; if a
queue overflows, the delay has grown before. A queue too short to delay by TARGET_S is not detected.
"""

from collections import deque

import numpy as np

from skytether.server.planning.clock import UNSEEN, ClockMap
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array, Indices

START, LEAST, MOST = 2_000.0, 500.0, 1e9
"""First, smallest and largest rate [B/s]."""
EPOCH_NS, PATIENCE_NS = SECOND_NS // 2, 5 * SECOND_NS
"""Shortest epoch (at least a round trip), and time after which fewer echoes suffice [ns]."""
SAMPLES = 5
"""Number of echoes needed for q."""
QUANTILE = 0.2
"""Quantile of the echoes for Q: some may come from vehicles that never saw an empty queue."""
BASE = 32
"""Number of epochs in which the queue is assumed to have been empty at least once."""
TARGET_S, LOW = 0.05, 0.6
"""Accepted queueing delay [s], and the share of it up to which r rises."""
FALLS = 0.7
"""If q has fallen to this share of the previous q, it counts as falling by itself."""
USED = 0.8
"""Share of r that must have been sent for r to rise: from unused rate no delay can be measured."""
FIRST_GAIN = 1.25
"""Factor of a rise before the first cut."""
K_S = 8.0
"""Time in which r rises from a cut to the rate that was too large [s]."""
IGNORED_EPOCHS = 2
"""Number of epochs after a cut whose echoes still concern packets sent before it."""
CUT = 0.85
"""Share of p to which r is cut, so that the queue empties."""


class RateControl:
    def __init__(self, clock: ClockMap, capacity: int) -> None:
        self._seen = clock.seen
        self._echoes_used = np.zeros(capacity, dtype=np.int64)
        """Number of echoes of each vehicle used so far."""
        self._delays_s: list[float] = []
        """Excess delays of the epoch's echoes, at most one per vehicle and step [s]."""
        self._began_ns: int | None = None
        self._spent = 0.0
        self._passes: float | None = None
        """Rate p that passed at the last cut [B/s]; None before the first cut."""
        self._risen_s, self._ignored_epochs = 0.0, 0
        """Time t since which r has risen [s], and number of epochs still to be ignored."""
        self._low_s: deque[float] = deque(maxlen=BASE)
        """Q of the newest epochs [s]."""
        self._sent = 0.0
        """Rate sent in the previous epoch [B/s]."""
        self._trip_ns = 0
        self.needed = False
        """Whether a packet had to wait for the rate in this epoch."""
        self.bytes_per_s = START
        self.queueing_s = 0.0
        """Queueing delay of the newest epoch [s]."""

    def update(self, rows: Indices, spent_bytes: float, now_ns: int) -> None:
        """Process the echoes and the bytes sent since the last update."""
        self._listen(rows)
        self._spent += spent_bytes
        if self._began_ns is None:
            self._began_ns = now_ns
        passed_ns = now_ns - self._began_ns
        patient = len(self._delays_s) < SAMPLES and passed_ns < PATIENCE_NS
        if passed_ns < max(EPOCH_NS, self._trip_ns) or patient:
            return
        if self._delays_s:
            self._end(np.array(self._delays_s), self._spent * SECOND_NS / passed_ns, passed_ns)
        self._began_ns, self._spent, self.needed = now_ns, 0.0, False
        self._delays_s.clear()

    def _listen(self, rows: Indices) -> None:
        echoes = self._seen.vehicles["echoes"][rows]
        new = rows[echoes != self._echoes_used[rows]]
        self._echoes_used[rows] = echoes
        if not len(new):
            return
        slot = (self._seen.vehicles["echoes"][new] - 1) % self._seen.echoes.shape[1]
        least = self._seen.minimum[new].min(axis=2)
        above = self._seen.echoes[new, slot] - least[:, 1]
        self._delays_s += (above[least[:, 1] < UNSEEN] / SECOND_NS).tolist()
        self._trip_ns = int(np.median(least.sum(axis=1)))

    def _end(self, delays_s: Array, sent: float, passed_ns: int) -> None:
        low, middle = np.quantile(delays_s, (QUANTILE, 0.5)).tolist()
        self._low_s.append(low)
        before, q, most = self.queueing_s, low - min(self._low_s), TARGET_S + middle - low
        sent_before, self._sent = min(sent, self._sent), sent
        self.queueing_s = q
        # These echoes are of packets sent before the cut: cutting again would count one queue
        # twice.
        if self._ignored_epochs:
            self._ignored_epochs -= 1
        elif q > most and q > FALLS * before:
            self._passes = sent_before / (1.0 + max(q - before, 0.0) * SECOND_NS / passed_ns)
            self._risen_s, self._ignored_epochs = 0.0, IGNORED_EPOCHS
            self.bytes_per_s = max(CUT * self._passes, LEAST)
        elif q <= LOW * most and self.needed and sent > USED * self.bytes_per_s:
            self._risen_s += passed_ns / SECOND_NS
            self.bytes_per_s = min(max(self.bytes_per_s, sent, self._risen()), MOST)

    def _risen(self) -> float:
        if self._passes is None:
            return self.bytes_per_s * FIRST_GAIN
        return self._passes * (1.0 + (1.0 - CUT) * (self._risen_s / K_S - 1.0) ** 3)
