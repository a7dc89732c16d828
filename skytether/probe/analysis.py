"""Analysis of packets in both directions, with functions of arrays.

Clocks: a packet's apparent delay, time of arrival on the receiver's clock minus time of sending on
the sender's clock, is d + o(t) from the prober to the listener and d - o(t) back. Here d is the
true delay and o(t) = o + s t the offset of the listener's clock. So a line below the points (time,
apparent delay) has the slope s in one direction and -s in the other. Following Moon, Skelly and
Towsley (1999), the line is the one with the highest mean among all lines below the points, with one
s for both directions. The height of a point above the line is the packet's delay minus the least
delay. Only the sum of both directions' least delays can be measured, because the offset cancels
only in the sum; each direction is assumed to have half of the sum.

Loss: the confidence interval is Wilson's, with the effective sample size as number of packets.

Rate: packets of a train are sent at once and leave a bottleneck at intervals of size / rate (packet
dispersion). So the i-th packet of a train has the delay of a packet sent alone, plus i size / rate.
The time size / rate is estimated in two ways, and the estimate with the smaller error is used. The
first estimate is the common slope of lines through the delays over the places in the train; delays
that vary slowly hardly affect it. The second is the maximum-likelihood estimate, given the measured
distribution of the delays of packets sent alone; it is better if delays vary fast.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import pi, sqrt

import numpy as np

from skytether.probe.prober import Longs, MeasuredPath, Way
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS, SECOND_NS
from skytether.shared.law.model import Array, Flags

DRIFT_MAX = 500e-6
"""Largest plausible drift between two clocks, as a relative rate: the fastest rate of slewing a
clock."""
WINDOWS = 12
"""Number of parts of a measurement whose least delays give the drift's standard error."""
CERTAIN = 5.0
"""Number of standard errors above which a drift is significant; large, because WINDOWS is small."""
Z95 = 1.959963984540054
"""Quantile of the standard normal distribution for a two-sided 95 % interval."""
ALIKE_S = 50e-6
"""Standard deviation below which values count as equal, and least width of a kernel [s]."""
LAGS = 20
TOGETHER_NS = 2 * MILLISECOND_NS
"""Packets sent later than this after the first of their train are ignored for the rate [ns]."""
SPREAD_MIN_S = 1e-3
"""Shortest spread of a train's arrivals that indicates a bottleneck, not a busy machine [s]."""
ARRIVED_MIN = 4
"""Smallest number of received packets of a train that is used for the rate."""
GROUPS_MIN, GROUPS_MAX = 4, 10
"""Smallest and largest number of groups of trains for a jackknife error."""
ALONE_MIN, KERNELS = 100, 500
"""Smallest number of delays for a density estimate, and largest number of its kernels."""
QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 0.999, 1.0)


@dataclass(frozen=True, slots=True)
class Clocks:
    """Offset and drift of the listener's clock, relative to the prober's clock."""

    offset_s: float
    """Offset at the first probe [s], assuming equal least delays in both directions."""
    drift: float
    """Relative rate by which the listener's clock is faster; 0 if the drift is not significant."""
    drift_doubt: float
    least_sum_s: float
    """Sum of the two directions' least delays [s]."""
    doubt_s: float
    """Largest error of one-way delays [s]: half of `least_sum_s` without both bottlenecks'
    transmission times."""


@dataclass(frozen=True, slots=True)
class BottleneckRate:
    """Rate of a path's bottleneck, in one direction."""

    bytes_per_s: float
    """Rate, including headers of IP and UDP [B/s]."""
    low: float
    high: float
    """Bounds of the 95 % interval [B/s]."""
    trains: int


@dataclass(frozen=True, slots=True)
class Delays:
    """Packets of one direction that were sent alone, not in a train, in order of sending."""

    time_s: Array
    """Time of sending on the prober's clock, from the first probe [s]; shape (n,)."""
    delay_s: Array
    """One-way delay [s]; NaN for a lost packet; shape (n,)."""
    rate: BottleneckRate | None
    """Rate of the bottleneck; None if trains give no finite rate."""

    @property
    def came(self) -> Flags:
        return np.isfinite(self.delay_s)


# -- clocks and delays --------------------------------------------------------------------------


def delays(measured: MeasuredPath) -> tuple[Clocks, Delays, Delays]:
    """Relation of the two clocks, and delays of the downlink and of the uplink.

    Raises:
        ValueError: fewer than two packets sent alone arrived in a direction.
    """
    down, up = measured.downlink, measured.uplink
    alone = down.came & (down.train < 0), up.came & (up.train < 0)
    if min(each.sum() for each in alone) < 2:
        raise ValueError("fewer than two packets sent alone arrived in a direction")
    near_ns, far_ns = int(down.sent_ns[0]), int(down.came_ns[down.came].min())
    x_down, y_down = _points(down.sent_ns - near_ns, down.came_ns - far_ns)
    y_up = (up.came_ns - near_ns - (up.sent_ns - far_ns)) / SECOND_NS
    x_up = (up.came_ns - near_ns) / SECOND_NS
    drift, doubt = _drift(x_down[alone[0]], y_down[alone[0]], x_up[alone[1]], y_up[alone[1]])
    y_down, y_up = y_down - drift * x_down, y_up + drift * x_up
    rates = [rate(way, y, measured.size) for way, y in ((down, y_down), (up, y_up))]
    wire = measured.size + HEADER_BYTES
    service_down, service_up = (wire / each.bytes_per_s if each else 0.0 for each in rates)
    floor_down, floor_up = float(y_down[alone[0]].min()), float(y_up[alone[1]].min())
    least_sum_s = max(floor_down + floor_up, 0.0)
    half = max(least_sum_s - service_down - service_up, 0.0) / 2.0
    offset_s = floor_down - half - service_down
    clocks = Clocks((far_ns - near_ns) / SECOND_NS + offset_s, drift, doubt, least_sum_s, half)
    # A lost answer has no sending time; its probe's arrival time at the listener is used.
    x_up = (up.sent_ns - far_ns) / SECOND_NS - offset_s
    return (
        clocks,
        _alone(down, x_down, y_down - offset_s, rates[0]),
        _alone(up, x_up, y_up + offset_s, rates[1]),
    )


def delays_of_log(measured: MeasuredPath) -> tuple[Clocks, Delays, Delays]:
    """Clocks and delays of a log. Its single series of delays, on one clock, is used for both
    directions.

    Raises:
        ValueError: fewer than two packets arrived.
    """
    way = measured.downlink
    if way.came.sum() < 2:
        raise ValueError("fewer than two packets arrived")
    time_s, delay_s = _points(way.sent_ns, way.came_ns)
    result = _alone(way, time_s, delay_s, None)
    least_s = float(delay_s[way.came].min())
    return Clocks(0.0, 0.0, 0.0, 2.0 * least_s, least_s), result, result


def _points(sent_ns: Longs, came_ns: Longs) -> tuple[Array, Array]:
    return sent_ns / SECOND_NS, (came_ns - sent_ns) / SECOND_NS


def _alone(way: Way, time_s: Array, delay_s: Array, found: BottleneckRate | None) -> Delays:
    alone = way.train < 0
    return Delays(time_s[alone], np.where(way.came, delay_s, np.nan)[alone], found)


def _drift(x_down: Array, y_down: Array, x_up: Array, y_up: Array) -> tuple[float, float]:
    """Drift of the listener's clock and its standard error. A drift that is not significant is set
    to 0.
    """
    if x_down[-1] - x_down[0] <= 0.0:
        return 0.0, DRIFT_MAX
    down, up = lower_hull(x_down, y_down), lower_hull(x_up, y_up)
    mean = float(np.mean(x_down)), float(np.mean(x_up))

    def height(slope: float) -> float:
        """Sum of both lines' mean heights, each line just below its points; concave in `slope`."""
        below = float(np.min(down[1] - slope * (down[0] - mean[0])))
        return below + float(np.min(up[1] + slope * (up[0] - mean[1])))

    slope = highest(height, -DRIFT_MAX, DRIFT_MAX)
    doubt = _drift_doubt(x_down, y_down - slope * x_down, x_up, y_up + slope * x_up)
    return (slope if abs(slope) > CERTAIN * doubt else 0.0), doubt


def _drift_doubt(x_down: Array, y_down: Array, x_up: Array, y_up: Array) -> float:
    """Standard error of the slope, from least delays in parts of the measurement.

    Half the difference of both directions' least delays in a part is the offset in that part; the
    scatter of these offsets over time gives the uncertainty of a line through them.
    """
    edges = np.linspace(0.0, max(x_down[-1], x_up.max()), WINDOWS + 1)
    offsets, times = [], []
    for low, high in pairwise(edges.tolist()):
        in_down = (x_down >= low) & (x_down <= high)
        in_up = (x_up >= low) & (x_up <= high)
        if in_down.any() and in_up.any():
            offsets.append((y_down[in_down].min() - y_up[in_up].min()) / 2.0)
            times.append((low + high) / 2.0)
    if len(times) < 4:
        return DRIFT_MAX
    slopes = np.polyfit(times, offsets, 1)
    residuals = np.asarray(offsets) - np.polyval(slopes, times)
    spread = float(np.std(times)) * sqrt(len(times))
    return sqrt(float(residuals @ residuals) / (len(times) - 2)) / spread


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
    """Argument between two bounds that maximises a concave function, by golden-section search."""
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
    """For each lag, the mean time between two packets [s], and the correlation of their values.

    Pairs of packets with a gap between them, such as the pairs around a train, are left out.

    Args:
        time_s: times of sending, in the order of sending; shape (n,).
        values: value of each packet, NaN if unknown; shape (n,).

    Returns:
        Two arrays of shape (lags,), shorter if there are few packets.
    """
    centred = values - np.nanmean(values)
    variance = float(np.nanmean(centred**2))
    apart, correlations = [], []
    typical = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    for lag in range(1, min(lags, len(values) // 4) + 1):
        between = time_s[lag:] - time_s[:-lag]
        product = centred[lag:] * centred[:-lag]
        pairs = np.isfinite(product) & (between < (lag + 1.5) * typical)
        if pairs.sum() < 10 or variance <= ALIKE_S**2:
            break
        apart.append(float(between[pairs].mean()))
        correlations.append(float(product[pairs].mean()) / variance)
    return np.array(apart), np.array(correlations)


def effective(count: int, correlations: Array) -> float:
    """Effective sample size: number of independent values whose mean would have the same variance.

    Correlations are summed up to the first lag whose correlation is not significantly above 0.
    """
    certain = 2.0 / sqrt(max(count, 1))
    lasting = 0.0
    for each in correlations.tolist():
        if each < certain:
            break
        lasting += each
    return count / (1.0 + 2.0 * lasting)


def correlation_time_s(apart_s: Array, correlations: Array, count: int) -> float:
    """Time after which the autocorrelation is 1/e [s]; 0 if no correlation is significant."""
    if not len(correlations) or correlations[0] < max(4.0 / sqrt(count), 0.02):
        return 0.0
    low = np.flatnonzero(correlations < max(0.1, 2.0 / sqrt(count)))
    end = max(1, int(low[0])) if len(low) else len(correlations)
    x, y = apart_s[:end], -np.log(np.clip(correlations[:end], 1e-9, 1.0 - 1e-9))
    return float((x @ x) / (x @ y))


def wilson(share: float, count: float) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a share that was measured in `count` independent
    packets.
    """
    if count <= 0.0:
        return 0.0, 1.0
    z2 = Z95 * Z95
    middle = (share + z2 / (2.0 * count)) / (1.0 + z2 / count)
    half = Z95 * sqrt(share * (1.0 - share) / count + z2 / (4.0 * count * count))
    half /= 1.0 + z2 / count
    return max(0.0, middle - half), min(1.0, middle + half)


def bursts(lost: Flags) -> tuple[int, float]:
    """Number of runs of lost packets, and their mean length [packets]; 0 and 0 without losses."""
    edges = np.diff(lost.astype(np.int8), prepend=0)
    count = int((edges == 1).sum())
    return count, float(lost.sum()) / count if count else 0.0


def reordered(way: Way) -> float:
    """Share of packets that arrived after a packet that was sent later (RFC 4737)."""
    alone = way.came & (way.train < 0)
    came_ns = way.came_ns[alone]
    order = np.argsort(came_ns, kind="stable")
    newest = np.maximum.accumulate(order)
    return float((order < newest).mean()) if len(order) else 0.0


# -- rate ---------------------------------------------------------------------------------------


def rate(way: Way, delay_s: Array, size: int) -> BottleneckRate | None:
    """Rate of the bottleneck of a path; None if the packet trains give no finite rate.

    Args:
        delay_s: delays of all packets, to which any constant may be added [s]; delays of lost
            packets are ignored; shape (n,).
        size: UDP payload of each packet [B].
    """
    trains = []
    for number in range(int(way.train.max(initial=-1)) + 1):
        at = np.flatnonzero(way.train == number)
        at = at[way.sent_ns[at] - way.sent_ns[at[0]] <= TOGETHER_NS] if len(at) else at
        came = np.flatnonzero(way.came[at])
        if len(came) >= ARRIVED_MIN:
            trains.append((came.astype(np.float64), delay_s[at[came]]))
    if not trains:
        return None
    alone = np.sort(delay_s[way.came & (way.train < 0)])
    estimates = [_slope(trains)]
    if len(trains) >= GROUPS_MIN and len(alone) >= ALONE_MIN:
        estimates.append(_likeliest(trains, alone, *estimates[0]))
    time_s, error = min(estimates, key=lambda each: each[1])
    spread_s = time_s * max(float(places[-1]) for places, _ in trains)
    if spread_s < SPREAD_MIN_S or time_s < 4.0 * error:
        return None
    wire = size + HEADER_BYTES
    low, high = wire / (time_s + Z95 * error), wire / (time_s - Z95 * error)
    return BottleneckRate(wire / time_s, low, high, len(trains))


Trains = list[tuple[Array, Array]]
"""For each train, the places of the received packets in the train, from 0, and their delays [s]."""


def _slope(trains: Trains) -> tuple[float, float]:
    """Common slope of lines through the trains with own intercepts, and its standard error [s]."""
    centred = [(x - x.mean(), y - y.mean()) for x, y in trains]
    sxx = sum(float(x @ x) for x, _ in centred)
    slope = sum(float(x @ y) for x, y in centred) / sxx
    residual = sum(float((y - slope * x) @ (y - slope * x)) for x, y in centred)
    free = max(sum(len(x) - 1 for x, _ in centred) - 1, 1)
    return slope, sqrt(residual / free / sxx)


def _likeliest(trains: Trains, alone: Array, first: float, doubt: float) -> tuple[float, float]:
    """Most likely transmission time of a packet, and its jackknife standard error [s].

    Args:
        alone: sorted delays of packets that were sent alone [s].
        first, doubt: initial estimate of the transmission time, and its standard error [s].
    """
    count = min(len(alone), KERNELS)
    kernels = np.quantile(alone, (np.arange(count) + 0.5) / count)
    middle = float(np.subtract(*np.quantile(alone, (0.75, 0.25)))) / 1.34
    width = max(0.9 * min(float(alone.std()), middle) * count**-0.2, ALIKE_S)
    floor = 1e-3 / (float(alone[-1] - alone[0]) + width)

    def likelihood(time_s: float, some: Trains) -> float:
        total = 0.0
        for places, delay_s in some:
            off = (delay_s - time_s * places)[:, None] - kernels
            density = np.exp(-0.5 * (off / width) ** 2).mean(axis=1) / (width * sqrt(2.0 * pi))
            total += float(np.log(density + floor).sum())
        return total

    def best(some: Trains, low: float, high: float, steps: int) -> float:
        return highest(lambda each: likelihood(each, some), low, high, steps)

    reach = 4.0 * doubt
    grid = np.linspace(max(first - reach, 0.0), first + reach, 41)
    near = float(grid[np.argmax([likelihood(each, trains) for each in grid.tolist()])])
    cell = float(grid[1] - grid[0])
    time_s = best(trains, near - cell, near + cell, 25)
    groups = min(len(trains), GROUPS_MAX)
    without = [
        best(
            [one for n, one in enumerate(trains) if n % groups != group],
            near - 3 * cell,
            near + 3 * cell,
            20,
        )
        for group in range(groups)
    ]
    spread = np.array(without) - np.mean(without)
    error = sqrt((groups - 1) / groups * float(spread @ spread))
    # A time that is hardly more likely than zero is uncertain, even if its scatter is small.
    gain = likelihood(time_s, trains) - likelihood(0.0, trains)
    error = max(error, time_s / sqrt(2.0 * max(gain, 1e-9)))
    # factor by which Student's t is wider than the normal distribution
    few = 1.0 + (Z95**2 + 1.0) / (4.0 * (groups - 1))
    return time_s, max(few * error, 1e-9)
