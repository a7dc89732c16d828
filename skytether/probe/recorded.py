"""Measurements from logs of delays, such as those of ping (`shared.formats.recorded`).

A log has one clock and one series of delays, which is used for both directions.
"""

import numpy as np

from skytether.probe.outages import RoundTrips
from skytether.probe.prober import MeasuredPath, Way
from skytether.shared.base.units import SECOND_NS
from skytether.shared.formats.recorded import RecordedPath


def of_log(path: RecordedPath) -> MeasuredPath:
    """Measurement from a log, with the same packets for both directions and one clock."""
    sent_ns = np.rint(path.time_s * SECOND_NS).astype(np.int64)
    delay_ns = np.rint(path.delay_s * SECOND_NS).astype(np.int64)
    came = ~path.lost
    alone = np.full(len(sent_ns), -1, np.int64)
    way = Way(sent_ns, np.where(came, sent_ns + delay_ns, 0), came, alone, path.copies)
    return MeasuredPath(way, way, 0, _period_ns(way), 0)


def round_trips(path: RecordedPath) -> RoundTrips:
    """Round trips of a log, on the log's clock."""
    trip_s = np.where(path.lost, np.nan, 2.0 * path.delay_s)
    return RoundTrips(path.begin_s + path.time_s, trip_s)


def _period_ns(way: Way) -> int:
    return int(np.median(np.diff(way.sent_ns))) if len(way.sent_ns) > 1 else SECOND_NS
