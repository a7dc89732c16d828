"""Which step it is aboard each vehicle: the server's clock mapped to the vehicle's.

Neither clock is set. Every observation gives F = t2 - t1 (sent by the vehicle, received here) and,
by its echo of our own stamp, G = t4 - t3 (sent here, received aboard). Over the last 20 s

    offset = (min G - min F) / 2,    bound = (min F + min G) / 2,

vehicle's clock minus server's. Half of any asymmetry of the two smallest delays stays unknown: the
offset is right to within the bound and no better.
"""

import numpy as np

from shared.endpoint import MILLISECOND_NS, SECOND_NS
from shared.model import Flags, Indices

BUCKET_NS = SECOND_NS // 2
BUCKETS = 40
"""Minima are kept for each half second, over 20 s."""
RECENT = slice(0, 3)
OLD = slice(8, BUCKETS)
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
        self._drop(row, np.arange(BUCKETS))
        self._adopted[row] = UNSEEN

    def _drop(self, row: int, slots: Indices) -> None:
        self._minimum[row][:, slots] = UNSEEN
        self._samples[row, slots] = 0

    def observe(self, row: int, forward_ns: int, backward_ns: int, *, now_ns: int) -> None:
        """One F and one G of a vehicle, received at `now_ns`."""
        bucket = now_ns // BUCKET_NS
        passed = min(bucket - int(self._newest[row]), BUCKETS)
        if passed > 0:
            self._drop(row, (bucket - np.arange(passed)) % BUCKETS)
            self._newest[row] = bucket
        slot, minimum = bucket % BUCKETS, self._minimum[row]
        minimum[0, slot] = min(minimum[0, slot], forward_ns)
        minimum[1, slot] = min(minimum[1, slot], backward_ns)
        self._samples[row, slot] += 1

    def offset_ns(self, rows: Indices) -> Indices:
        """Vehicle's clock minus ours, for vehicles observed at least once; shape (n,).

        It follows the estimate only when that has moved by more than half a step: a step index that
        went back and forth at a boundary would skip and repeat steps for nothing.
        """
        self._drop_stepped(rows)
        smallest = self._minimum[rows].min(axis=2)
        estimate = (smallest[:, 1] - smallest[:, 0]) // 2
        adopted = self._adopted[rows]
        moved = (adopted == UNSEEN) | (np.abs(estimate - adopted) > self._half_step_ns)
        self._adopted[rows] = adopted = np.where(moved, estimate, adopted)
        return adopted

    def bound_ns(self, rows: Indices) -> Indices:
        """How far the offset may be off; shape (n,)."""
        bound: Indices = self._minimum[rows].min(axis=2).sum(axis=1) // 2
        return bound

    def _drop_stepped(self, rows: Indices) -> None:
        """Where one of the two clocks has stepped, keep only what came since."""
        newest_first = (self._newest[rows, None] - np.arange(BUCKETS)) % BUCKETS
        samples = np.take_along_axis(self._samples[rows], newest_first, axis=1)
        minimum = np.take_along_axis(self._minimum[rows], newest_first[:, None], axis=2)
        enough: Flags = (samples[:, RECENT].sum(axis=1) >= STEP_SAMPLES) & (
            samples[:, OLD].sum(axis=1) >= STEP_SAMPLES
        )
        forward, backward = (minimum[:, :, RECENT].min(axis=2) - minimum[:, :, OLD].min(axis=2)).T
        opposite = np.abs(forward + backward) < np.maximum(STEP_NS, 0.2 * np.abs(forward))
        large = np.minimum(np.abs(forward), np.abs(backward)) > STEP_NS
        for row, order in zip(
            rows[enough & opposite & large], newest_first[enough & opposite & large], strict=True
        ):
            self._drop(int(row), order[RECENT.stop :])
