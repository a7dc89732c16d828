"""What follows from packets that went both ways, as functions of arrays.

Clocks: an apparent delay is the true one and the offset of the clocks, t_receiver - t_sender =
d + o(t), one way, and d - o(t) the other. With o(t) = o + s t, the line of least delays below all
points of a direction has the slope s, or -s. As Moon, Skelly and Towsley (1999) do, the line is
taken that is highest in the mean; both directions together give one slope. What lies above a line
is the delay beyond the least one. Of the two least delays only the sum is known, in which the
offset cancels: half of it is taken for each direction.

Loss: the interval is Wilson's, of as many packets as were lost independently of each other.

Rate: packets of a train that are sent at once leave a bottleneck one behind the other, each after
size / rate. A straight line through arrivals over places in the train, with one slope for all
trains, has that slope (packet dispersion).
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from skytether.probe.prober import Longs, Measured, Way
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import Array

Bools = NDArray[np.bool_]

DRIFT_MAX = 500e-6
"""Largest drift between two clocks that is believed: as fast as clocks are slewed."""
WINDOWS = 12
"""Number of parts of a measurement whose least delays tell how sure the drift is."""
Z95 = 1.959964
"""Quantile of the standard normal distribution, of an interval of 95 %."""
ALIKE_S = 50e-6
"""Standard deviation of values that are taken to be all alike [s]."""
LAGS = 20
"""Number of lags of the autocorrelation."""
TOGETHER_NS = 2 * MILLISECOND_NS
"""Longest time in which the packets of a train are sent [ns]."""
SPREAD_MIN_S = 1e-3
"""Spread of a train that tells a finite rate from a machine that is busy [s]."""
QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 0.999, 1.0)
"""Shares of which quantiles are told."""


@dataclass(frozen=True, slots=True)
class Clocks:
    """The listener's clock against the prober's."""

    offset_s: float
    """Offset at the first probe, half of the least round trip being taken for each way [s]."""
    drift: float
    """Rate by which the listener's clock runs faster; 0 where none is sure."""
    drift_doubt: float
    """Standard error of the drift."""
    least_sum_s: float
    """Sum of the two least delays [s]."""
    doubt_s: float
    """Largest error of the offset, and so of all one-way delays: half of the least delays, without
    times that are known [s]."""


@dataclass(frozen=True, slots=True)
class Delays:
    """Packets of one direction that were sent alone, in the order of sending."""

    time_s: Array
    """Time of sending, by the prober's clock from the first probe on [s]; shape (n,)."""
    delay_s: Array
    """One-way delay [s]; NaN of a lost packet; shape (n,)."""

    @property
    def came(self) -> Bools:
        """Whether each arrived; shape (n,)."""
        return np.isfinite(self.delay_s)


@dataclass(frozen=True, slots=True)
class Rate:
    """Rate of the narrowest part of a path."""

    bytes_per_s: float
    """Rate, headers of IP and UDP included [B/s]."""
    low: float
    high: float
    """Bounds of the interval of 95 % [B/s]."""
    trains: int
    """Number of trains that it was found from."""


# -- clocks and delays --------------------------------------------------------------------------


def delays(
    measured: Measured, service_down_s: float = 0.0, service_up_s: float = 0.0
) -> tuple[Clocks, Delays, Delays]:
    """Clocks, and delays of the downlink and of the uplink.

    Args:
        service_down_s, service_up_s: times that a packet takes to pass a finite rate [s].

    Raises:
        ValueError: too few packets went a way.
    """
    down, up = measured.downlink, measured.uplink
    alone = down.came & (down.train < 0), up.came & (up.train < 0)
    if min(each.sum() for each in alone) < 2:
        raise ValueError("fewer than two packets went each way")
    near_ns, far_ns = int(down.sent_ns[0]), int(down.came_ns[down.came].min())
    x_down, y_down = _points(down.sent_ns - near_ns, down.came_ns - far_ns)
    y_up = (up.came_ns - near_ns - (up.sent_ns - far_ns)) / SECOND_NS
    x_up = (up.came_ns - near_ns) / SECOND_NS
    at = x_down[alone[0]], y_down[alone[0]], x_up[alone[1]], y_up[alone[1]]
    drift, doubt = _drift(*at)
    floor_down = float(np.min(at[1] - drift * at[0]))
    floor_up = float(np.min(at[3] + drift * at[2]))
    least_sum_s = max(floor_down + floor_up, 0.0)
    half = max(least_sum_s - service_down_s - service_up_s, 0.0) / 2.0
    offset_s = floor_down - half - service_down_s
    clocks = Clocks((far_ns - near_ns) / SECOND_NS + offset_s, drift, doubt, least_sum_s, half)
    delay_down = y_down - drift * x_down - offset_s
    delay_up = y_up + drift * x_up + offset_s
    # A lost answer has no arrival: it was sent when its probe arrived there.
    x_up = (up.sent_ns - far_ns) / SECOND_NS - offset_s
    return clocks, _alone(down, x_down, delay_down), _alone(up, x_up, delay_up)


def _points(sent_ns: Longs, came_ns: Longs) -> tuple[Array, Array]:
    return sent_ns / SECOND_NS, (came_ns - sent_ns) / SECOND_NS


def _alone(way: Way, time_s: Array, delay_s: Array) -> Delays:
    alone = way.train < 0
    return Delays(time_s[alone], np.where(way.came, delay_s, np.nan)[alone])


def _drift(x_down: Array, y_down: Array, x_up: Array, y_up: Array) -> tuple[float, float]:
    """Slope of both lines, and its standard error; 0 where it is less than twice that."""
    if x_down[-1] - x_down[0] <= 0.0:
        return 0.0, DRIFT_MAX
    down, up = lower_hull(x_down, y_down), lower_hull(x_up, y_up)
    mean = float(np.mean(x_down)), float(np.mean(x_up))

    def height(slope: float) -> float:
        """Mean height of both lines; concave in the slope."""
        below = float(np.min(down[1] - slope * (down[0] - mean[0])))
        return below + float(np.min(up[1] + slope * (up[0] - mean[1])))

    slope = highest(height, -DRIFT_MAX, DRIFT_MAX)
    doubt = _drift_doubt(x_down, y_down - slope * x_down, x_up, y_up + slope * x_up)
    return (slope if abs(slope) > 2.0 * doubt else 0.0), doubt


def _drift_doubt(x_down: Array, y_down: Array, x_up: Array, y_up: Array) -> float:
    """Standard error of the slope, from least delays in parts of the measurement.

    Half the difference of the two least delays is the offset there; its scatter over time tells
    how well a line through it is known.
    """
    edges = np.linspace(0.0, max(x_down[-1], x_up.max()), WINDOWS + 1)
    offsets, times = [], []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        in_down = (x_down >= low) & (x_down <= high)
        in_up = (x_up >= low) & (x_up <= high)
        if in_down.any() and in_up.any():
            offsets.append((y_down[in_down].min() - y_up[in_up].min()) / 2.0)
            times.append((low + high) / 2.0)
    if len(times) < 4:
        return DRIFT_MAX
    slopes = np.polyfit(times, offsets, 1)
    left = np.asarray(offsets) - np.polyval(slopes, times)
    spread = float(np.std(times)) * sqrt(len(times))
    return sqrt(float(left @ left) / (len(times) - 2)) / spread


def lower_hull(x: Array, y: Array) -> tuple[Array, Array]:
    """Corners of the lower convex hull of points, from left to right (monotone chain)."""
    kept: list[tuple[float, float]] = []
    order = np.lexsort((y, x))
    for point in zip(x[order].tolist(), y[order].tolist(), strict=True):
        while len(kept) > 1:
            (ax, ay), (bx, by) = kept[-2], kept[-1]
            if (bx - ax) * (point[1] - ay) > (by - ay) * (point[0] - ax):
                break
            kept.pop()
        kept.append(point)
    corners = np.array(kept)
    return corners[:, 0], corners[:, 1]


def highest(function: Callable[[float], float], low: float, high: float, steps: int = 100) -> float:
    """Place between two at which a concave function is highest (golden section)."""
    ratio = (sqrt(5.0) - 1.0) / 2.0
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    at_left, at_right = function(left), function(right)
    for _ in range(steps):
        if at_left < at_right:
            low, left, at_left = left, right, at_right
            right = low + ratio * (high - low)
            at_right = function(right)
        else:
            high, right, at_right = right, left, at_left
            left = high - ratio * (high - low)
            at_left = function(left)
    return (low + high) / 2.0


# -- losses, order, correlation -----------------------------------------------------------------


def autocorrelation(time_s: Array, values: Array, lags: int = LAGS) -> tuple[Array, Array]:
    """Mean time between packets so many places apart, and the correlation of their values.

    Pairs with a gap between them are left out, as those around a train.

    Args:
        time_s: times of sending, in the order of sending [s]; shape (n,).
        values: NaN for what is not known; shape (n,).

    Returns:
        Two arrays of shape (lags,), with fewer entries where there are few packets.
    """
    centred = values - np.nanmean(values)
    variance = float(np.nanmean(centred**2))
    apart, found = [], []
    typical = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    for lag in range(1, min(lags, len(values) // 4) + 1):
        between = time_s[lag:] - time_s[:-lag]
        product = centred[lag:] * centred[:-lag]
        pairs = np.isfinite(product) & (between < (lag + 1.5) * typical)
        if pairs.sum() < 10 or variance <= ALIKE_S**2:
            break
        apart.append(float(between[pairs].mean()))
        found.append(float(product[pairs].mean()) / variance)
    return np.array(apart), np.array(found)


def effective(count: int, correlations: Array) -> float:
    """Number of independent values that tell as much of a mean as so many correlated ones.

    Correlations count as long as they differ from chance.
    """
    certain = 2.0 / sqrt(max(count, 1))
    lasting = 0.0
    for each in correlations.tolist():
        if each < certain:
            break
        lasting += each
    return count / (1.0 + 2.0 * lasting)


def correlation_time_s(apart_s: Array, correlations: Array, count: int) -> float:
    """Time in which the autocorrelation falls to 1/e [s]; 0 where there is none to speak of."""
    if not len(correlations) or correlations[0] < max(4.0 / sqrt(count), 0.02):
        return 0.0
    low = np.flatnonzero(correlations < max(0.1, 2.0 / sqrt(count)))
    end = max(1, int(low[0])) if len(low) else len(correlations)
    x, y = apart_s[:end], -np.log(np.clip(correlations[:end], 1e-9, 1.0 - 1e-9))
    return float((x @ x) / (x @ y))


def wilson(share: float, count: float) -> tuple[float, float]:
    """Interval of 95 % of a share of so many independent packets (Wilson's)."""
    if count <= 0.0:
        return 0.0, 1.0
    z2 = Z95 * Z95
    middle = (share + z2 / (2.0 * count)) / (1.0 + z2 / count)
    half = Z95 * sqrt(share * (1.0 - share) / count + z2 / (4.0 * count * count))
    half /= 1.0 + z2 / count
    return max(0.0, middle - half), min(1.0, middle + half)


def bursts(lost: Bools) -> tuple[int, float]:
    """Number of runs of lost packets, and their mean length in packets; 0 without any."""
    edges = np.diff(lost.astype(np.int8), prepend=0)
    count = int((edges == 1).sum())
    return count, float(lost.sum()) / count if count else 0.0


def reordered(way: Way) -> float:
    """Share of the packets that arrived after one that was sent later (RFC 4737)."""
    alone = way.came & (way.train < 0)
    came_ns = way.came_ns[alone]
    order = np.argsort(came_ns, kind="stable")
    newest = np.maximum.accumulate(order)
    return float((order < newest).mean()) if len(order) else 0.0


# -- rate ---------------------------------------------------------------------------------------


def rate(way: Way, size: int) -> Rate | None:
    """Rate of the narrowest part of a path; None where trains show none.

    Args:
        size: UDP payload of each packet [B].
    """
    sxx = sxy = left = 0.0
    trains, points = 0, 0
    rows: list[tuple[Array, Array]] = []
    for number in range(int(way.train.max(initial=-1)) + 1):
        at = np.flatnonzero(way.train == number)
        at = at[way.sent_ns[at] - way.sent_ns[at[0]] <= TOGETHER_NS] if len(at) else at
        came = way.came[at]
        if came.sum() < 4:
            continue
        x = np.flatnonzero(came).astype(np.float64)
        y = (way.came_ns[at][came] - way.came_ns[at][came].min()) / SECOND_NS
        x, y = x - x.mean(), y - y.mean()
        sxx, sxy = sxx + float(x @ x), sxy + float(x @ y)
        rows.append((x, y))
        trains, points = trains + 1, points + len(x)
    if not trains or points - trains < 2:
        return None
    slope = sxy / sxx
    for x, y in rows:
        off = y - slope * x
        left += float(off @ off)
    error = sqrt(left / (points - trains - 1) / sxx)
    if slope * (points / trains - 1.0) < SPREAD_MIN_S or slope < 4.0 * error:
        return None
    wire = size + HEADER_BYTES
    fastest = slope - Z95 * error
    return Rate(wire / slope, wire / (slope + Z95 * error), wire / fastest, trains)
