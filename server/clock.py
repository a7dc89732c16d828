"""Which step it is aboard each vehicle: the server's clock mapped to the vehicle's.

Neither clock is set. Every observation gives F = t2 - t1 (sent by the vehicle, received here) and,
by its echo of our own stamp, G = t4 - t3 (sent here, received aboard). Over the last 20 s

    offset = (min G - min F) / 2,    bound = (min F + min G) / 2,

vehicle's clock minus server's. Half of any asymmetry of the two smallest delays stays unknown: the
offset is right to within the bound and no better.
"""

import numpy as np
from numba import njit

from shared.endpoint import MILLISECOND_NS, SECOND_NS
from shared.model import Indices

BUCKET_NS = SECOND_NS // 2
BUCKETS = 40
"""Minima are kept for each half second, over 20 s."""
RECENT, OLD = 3, 8
"""A clock that stepped shows between the last 1.5 s and what is older than 4 s,"""
STEP_SAMPLES = 5
"""in so many samples of each,"""
STEP_NS = 40 * MILLISECOND_NS
"""as a change by this much: up in one direction, and down by about as much in the other."""

UNSEEN = 2**61


class ClockMap:
    """Offsets of up to `capacity` vehicles [ns]."""

    def __init__(self, capacity: int, dt_ns: int) -> None:
        self._half_step_ns = dt_ns // 2
        self._minimum = np.full((capacity, 2, BUCKETS), UNSEEN, dtype=np.int64)
        """min F and min G of each half second: a ring over the server's time."""
        self._samples = np.zeros((capacity, BUCKETS), dtype=np.int64)
        self._newest = np.zeros(capacity, dtype=np.int64)
        """Half second of the newest sample."""
        self._adopted = np.full(capacity, UNSEEN, dtype=np.int64)

    def forget(self, row: int) -> None:
        """A new vehicle in this row, or a new life of it."""
        self._minimum[row] = UNSEEN
        self._samples[row] = 0
        self._adopted[row] = UNSEEN

    def observe(self, row: int, forward_ns: int, backward_ns: int, *, now_ns: int) -> None:
        """One F and one G of a vehicle, received at `now_ns`."""
        history = (self._minimum[row], self._samples[row], self._newest[row : row + 1])
        _observe(*history, forward_ns, backward_ns, now_ns // BUCKET_NS)

    def offset_ns(self, rows: Indices) -> Indices:
        """Vehicle's clock minus ours, for vehicles observed at least once; shape (n,).

        It follows the estimate only when that has moved by more than half a step: a step index that
        went back and forth at a boundary would skip and repeat steps for nothing.
        """
        self._drop_stepped(rows)
        offset: Indices = _follow(self._minimum, self._adopted, rows, self._half_step_ns)
        return offset

    def bound_ns(self, rows: Indices) -> Indices:
        """How far the offset may be off; shape (n,)."""
        bound: Indices = self._minimum[rows].min(axis=2).sum(axis=1) // 2
        return bound

    def _drop_stepped(self, rows: Indices) -> None:
        """Where one of the two clocks has stepped, keep only what came since."""
        _drop_stepped(self._minimum, self._samples, self._newest, rows)


@njit("(i8[:,::1], i8[::1], i8[::1], i8, i8, i8)", cache=True)
def _observe(minimum, samples, newest, forward, backward, bucket):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0917 - compiled
    for passed in range(max(newest[0] + 1, bucket - BUCKETS + 1), bucket + 1):
        minimum[:, passed % BUCKETS], samples[passed % BUCKETS] = UNSEEN, 0
    newest[0] = max(newest[0], bucket)
    slot = bucket % BUCKETS
    minimum[0, slot] = min(minimum[0, slot], forward)
    minimum[1, slot] = min(minimum[1, slot], backward)
    samples[slot] += 1


@njit("i8[::1](i8[:,:,::1], i8[::1], i8[:], i8)", cache=True)
def _follow(minimum, adopted, rows, half_step):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    offset = np.empty(len(rows), dtype=np.int64)
    for i in range(len(rows)):
        row = rows[i]
        estimate = (minimum[row, 1].min() - minimum[row, 0].min()) // 2
        if adopted[row] == UNSEEN or abs(estimate - adopted[row]) > half_step:
            adopted[row] = estimate
        offset[i] = adopted[row]
    return offset


@njit("i8(i8[::1], i8)", cache=True)
def _change(minimum, newest):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    """Smallest delay of the last 1.5 s, less that of what is older than 4 s."""
    recent, old = UNSEEN, UNSEEN
    for age in range(BUCKETS):
        value = minimum[(newest - age) % BUCKETS]
        if age < RECENT:
            recent = min(recent, value)
        elif age >= OLD:
            old = min(old, value)
    return recent - old


@njit("(i8[:,:,::1], i8[:,::1], i8[::1], i8[:])", cache=True)
def _drop_stepped(minimum, samples, newest, rows):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202 - compiled
    for row in rows:
        counts, recent, old = samples[row], 0, 0
        for age in range(BUCKETS):
            count = counts[(newest[row] - age) % BUCKETS]
            if age < RECENT:
                recent += count
            elif age >= OLD:
                old += count
        if min(recent, old) < STEP_SAMPLES:
            continue
        forward = _change(minimum[row, 0], newest[row])
        backward = _change(minimum[row, 1], newest[row])
        large = min(abs(forward), abs(backward)) > STEP_NS
        if large and abs(forward + backward) < max(STEP_NS, 0.2 * abs(forward)):
            for age in range(RECENT, BUCKETS):
                slot = (newest[row] - age) % BUCKETS
                minimum[row, :, slot], samples[row, slot] = UNSEEN, 0
