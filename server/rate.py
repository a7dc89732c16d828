"""The rate at which a server may send, found from how long packets queue on the way.

A shared air passes so many bytes a second, and what is more waits. Every echo tells the delay G of
a packet; above the least G of its vehicle in 20 s (`server.common.clock`) that is jitter and
queue. A standing queue delays all packets, jitter not those that are lucky. With the low quantile Q
and the median M of what the echoes of an epoch are above the least,

    q = Q - min Q of the last BASE epochs        queueing delay
    s = TARGET_S + M - Q                         what is not certainly a queue

and with the rate r, and b bytes a second sent in the epoch,

    r ← CUT p,  p = b / (1 + Δq / Δt)     q > s, and it does not fall by itself
    r ← p (1 + (1 - CUT) (t / K - 1)³)    q ≤ LOW s, something had to wait, b > USED r

Where a queue grows by Δq in an epoch of Δt, so much less passes than is sent: p, with the b of the
epoch before, which the echoes tell of. After a cut r is p again when it has risen for K, where it
stays longest, and from there on rises ever faster (the window of CUBIC, RFC 9438); t is the time
for which it rises. Until q has been above s once, r ← r FIRST_GAIN. r never falls below b as it
rises. The epochs after a cut tell of packets that were sent before it, and change nothing.

Losses are not asked for. Where chance loses packets a lower rate would lose as many of them and
deliver less; where a queue overflows the delay has grown before. A queue too short to delay by
TARGET_S cannot be told from chance, and is not.
"""

from collections import deque

import numpy as np

from skytether.server.common.clock import UNSEEN, ClockMap
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array, Indices

START, LEAST, MOST = 2_000.0, 500.0, 1e9
"""First, smallest and largest rate [B/s]."""
EPOCH_NS, PATIENCE_NS = SECOND_NS // 2, 5 * SECOND_NS
"""Shortest epoch, which also lasts a round trip, and time after which few echoes will do [ns]."""
SAMPLES = 5
"""Echoes that tell q."""
QUANTILE = 0.2
"""Quantile of the echoes that is Q: a few may be of vehicles that know no empty queue."""
BASE = 32
"""Number of epochs in one of which the queue was empty."""
TARGET_S, LOW = 0.05, 0.6
"""Queueing delay that is put up with [s], and share of it up to which r rises."""
FALLS = 0.7
"""Share of the q before, at most which q falls by itself."""
USED = 0.8
"""Share of r that must have been sent for it to rise: what nobody uses says nothing of the air."""
FIRST_GAIN = 1.25
"""Factor of a rise, before the first cut."""
K_S = 8.0
"""Time for which r rises from a cut to where it was too large [s]."""
DEAF = 2
"""Number of epochs after a cut that tell of what was sent before: a report is awaited, too."""
CUT = 0.85
"""Share of what passes that is sent after a cut, so that the queue empties."""


class RateControl:
    """A rate that follows the queueing delay.

    Args:
        clock: has the echoes of up to `capacity` vehicles.
    """

    def __init__(self, clock: ClockMap, capacity: int) -> None:
        self._seen = clock.seen
        self._told = np.zeros(capacity, dtype=np.int64)
        """Number of echoes of each vehicle that were counted."""
        self._delays_s: list[float] = []
        """Delays above the least of the epoch's echoes, one a vehicle and step at most [s]."""
        self._began_ns: int | None = None
        self._spent = 0.0
        self._passes: float | None = None
        """Rate that passed when r was cut last, p [B/s]; None before."""
        self._risen_s, self._deaf = 0.0, 0
        """Time t for which r has risen since then [s], and epochs that tell of what was before."""
        self._low_s: deque[float] = deque(maxlen=BASE)
        """Q of the newest epochs [s]."""
        self._sent = 0.0
        """Bytes a second of the epoch before [B/s]."""
        self._trip_ns = 0
        self.needed = False
        """Whether something had to wait in the epoch because of the rate."""
        self.bytes_per_s = START
        """The rate [B/s]."""
        self.queueing_s = 0.0
        """Queueing delay of the newest epoch [s]."""

    def update(self, rows: Indices, spent_bytes: float, now_ns: int) -> None:
        """Take what was heard and sent since the last update.

        Args:
            rows: vehicles in session; shape (n,).
            spent_bytes: bytes sent since then [B].
            now_ns: time now.
        """
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
        """Take the newest echo of each vehicle that has told another."""
        heard = self._seen.vehicles["echoes"][rows]
        new = rows[heard != self._told[rows]]
        self._told[rows] = heard
        if not len(new):
            return
        slot = (self._seen.vehicles["echoes"][new] - 1) % self._seen.echoes.shape[1]
        least = self._seen.minimum[new].min(axis=2)
        above = self._seen.echoes[new, slot] - least[:, 1]
        self._delays_s += (above[least[:, 1] < UNSEEN] / SECOND_NS).tolist()
        self._trip_ns = int(np.median(least.sum(axis=1)))

    def _end(self, delays_s: Array, sent: float, passed_ns: int) -> None:
        """End an epoch of some length [ns], in which so many bytes were sent a second [B/s]."""
        low, middle = np.quantile(delays_s, (QUANTILE, 0.5)).tolist()
        self._low_s.append(low)
        before, q, most = self.queueing_s, low - min(self._low_s), TARGET_S + middle - low
        told, self._sent = min(sent, self._sent), sent
        self.queueing_s = q
        # Packets of these echoes were sent before the cut: cutting again for them would cut twice
        # for one queue.
        if self._deaf:
            self._deaf -= 1
        elif q > most and q > FALLS * before:
            self._passes = told / (1.0 + max(q - before, 0.0) * SECOND_NS / passed_ns)
            self._risen_s, self._deaf = 0.0, DEAF
            self.bytes_per_s = max(CUT * self._passes, LEAST)
        elif q <= LOW * most and self.needed and sent > USED * self.bytes_per_s:
            self._risen_s += passed_ns / SECOND_NS
            self.bytes_per_s = min(max(self.bytes_per_s, sent, self._risen()), MOST)

    def _risen(self) -> float:
        """The rate after a rise [B/s]."""
        if self._passes is None:
            return self.bytes_per_s * FIRST_GAIN
        return self._passes * (1.0 + (1.0 - CUT) * (self._risen_s / K_S - 1.0) ** 3)
