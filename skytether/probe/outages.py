"""Outages of paths that were measured at the same time, and outages that they have in common.

T is OUTAGE_S or, if longer, SPARSE times the median time between two probes. A probe fails if no
answer arrives within T. A path is out from the first of consecutive failed probes until the next
answered probe, if the failed probes cover at least T. A probe covers the time until the next probe,
but at most SPARSE times the median, because no probes are sent during a train.

    share_k = |out_k and covered| / |covered|        covered: by a probe of every path
    common  = |out_1 and out_2 and ... and covered| / |covered|

If paths are independent, the common share is the product of their shares.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

import msgspec
import numpy as np

from skytether.shared.law.model import Array

OUTAGE_S = 0.5
"""Smallest value of the threshold T, see the module [s]."""
SPARSE = 2.0

Intervals = Array
"""Beginning and end of each interval [s], in ascending order, without overlap; shape (n, 2)."""


@dataclass(frozen=True, slots=True)
class RoundTrips:
    """Probes of a path that were sent alone, not in a train, in order of sending."""

    sent_s: Array
    """Time of sending, on a common clock of all paths [s]; shape (n,)."""
    trip_s: Array
    """Round-trip time [s]; NaN without an answer; shape (n,)."""

    @property
    def every_s(self) -> float:
        return float(np.median(np.diff(self.sent_s))) if len(self.sent_s) > 1 else 0.0


class OutageFigures(msgspec.Struct, frozen=True):
    share: float
    """Share of the covered time in which the path was out, or for `common` all paths were out."""
    count: int
    longest_s: float


class CommonOutages(msgspec.Struct, frozen=True, kw_only=True):
    """Outages of each path, and common outages of all paths."""

    threshold_s: float
    """Longest round trip of an answered probe, and shortest outage: T of the module [s]."""
    seconds: float
    """Time covered by probes of all paths [s]."""
    paths: list[OutageFigures]
    common: OutageFigures
    """Outages of all paths at once."""
    product: float
    """Product of the paths' shares: the common share if the paths are independent."""


def compare(paths: Sequence[RoundTrips]) -> CommonOutages:
    """Compute the outages of paths, and their common outages.

    Raises:
        ValueError: the paths were not measured at the same time.
    """
    threshold_s = max(OUTAGE_S, *(SPARSE * path.every_s for path in paths))
    found = [outages(path, threshold_s) for path in paths]
    covered = overlap([each for _, each in found], len(paths))
    if not len(covered):
        raise ValueError("got paths measured at different times, expected the same time")
    together = np.array([[covered[0, 0], covered[-1, 1]]])
    out = [overlap([each, together], 2) for each, _ in found]
    figures = [_figures(each, covered) for each in out]
    return CommonOutages(
        threshold_s=threshold_s,
        seconds=length_s(covered),
        paths=figures,
        common=_figures(overlap(out, len(out)), covered),
        product=prod(each.share for each in figures),
    )


def common_time(paths: Sequence[RoundTrips]) -> Sequence[tuple[float, float]]:
    """For each path, beginning and end of the time that all measurements share [s], counted from
    this path's first probe.
    """
    begin_s = max(float(path.sent_s[0]) for path in paths)
    end_s = min(float(path.sent_s[-1]) for path in paths)
    return [(begin_s - float(path.sent_s[0]), end_s - float(path.sent_s[0])) for path in paths]


def _figures(out: Intervals, covered: Intervals) -> OutageFigures:
    share = length_s(overlap([out, covered], 2)) / length_s(covered)
    return OutageFigures(share, len(out), float(np.diff(out).max(initial=0.0)))


def outages(path: RoundTrips, threshold_s: float) -> tuple[Intervals, Intervals]:
    """Outages of one path, and the times covered by its probes [s]; shapes (n, 2)."""
    sent_s, most_s = path.sent_s, SPARSE * path.every_s
    ends_s = np.minimum(np.append(sent_s[1:], np.inf), sent_s + most_s)
    failed = ~(path.trip_s <= threshold_s)  # NaN (no answer) counts as failed
    edges = np.diff(failed.astype(np.int8), prepend=0, append=0)
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    covered_s = np.append(0.0, np.cumsum(ends_s - sent_s))
    # Two lost probes around a train are not an outage, although they are far apart.
    lasting = covered_s[last + 1] - covered_s[first] >= threshold_s - 1e-6
    out = np.column_stack((sent_s[first], ends_s[last]))[lasting]
    return out, overlap([np.column_stack((sent_s, ends_s))], 1)


def overlap(sets: Sequence[Intervals], least: int) -> Intervals:
    """Intervals of the times that are in at least `least` of the given sets of intervals."""
    at_s = np.concatenate(sets).T.ravel()
    step = np.repeat((1, -1), len(at_s) // 2)
    order = np.lexsort((-step, at_s))  # beginnings first, so that touching intervals are joined
    inside = np.cumsum(step[order]) >= least
    edges = np.diff(inside.astype(np.int8), prepend=0)
    found: Intervals = np.column_stack((at_s[order][edges == 1], at_s[order][edges == -1]))
    return found[found[:, 1] > found[:, 0]]


def length_s(intervals: Intervals) -> float:
    return float(np.diff(intervals).sum())
