"""Results of a measurement: figures of each direction, and the fitted models as scenario text."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isnan
from typing import Literal

import msgspec
import numpy as np

from skytether.probe import analysis, fits
from skytether.probe.analysis import QUANTILES, Clocks, Delays
from skytether.probe.outages import CommonOutages
from skytether.probe.prober import TRAIN, Longs, MeasuredPath, Way
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.telemetry.record import DOWNLINK, PACKET_COLUMNS, UPLINK, Rows

TEXT_CORRELATION_MIN = 0.5
"""Shortest correlation time in a model's text, as a multiple of the time between packets."""
ORDERED_SHARE = 0.01
"""A path counts as ordered if no packet was reordered, although independent delays would reorder
more than this share of the packets."""


class ModelFigures(msgspec.Struct, frozen=True):
    text: str
    bic: float
    """Bayesian information criterion; smaller is better."""


class DirectionFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one direction. Delays and losses exclude packets of trains."""

    sent: int
    came: int
    copies: int
    """Number of duplicate arrivals, including packets of trains."""
    loss: float
    loss_low: float
    loss_high: float
    """Bounds of the 95 % interval of the loss."""
    bursts: int
    burst_packets: float
    """Mean length of a run of lost packets [packets]."""
    reordered: float
    """Share of packets that arrived after a packet that was sent later."""
    mean_s: float
    sd_s: float
    quantiles_s: dict[str, float]
    """Quantiles of the delay [s], by probability."""
    correlation: list[tuple[float, float]]
    """For each lag, time between two packets [s] and correlation of their delays."""
    correlation_s: float
    """Time in which the correlation falls to 1/e [s]; 0 if no correlation is significant."""
    rate_bytes_per_s: float | None
    """Rate of the bottleneck, with headers [B/s]; None if trains give no finite rate."""
    rate_low: float | None
    rate_high: float | None
    """Bounds of the 95 % interval of the rate [B/s]."""
    trains: int
    """Number of trains from which the rate was estimated; 0 without a rate."""
    train_wait_s: float
    """Time for which the last packet of a train waits in the bottleneck's queue [s]."""
    delay_models: list[ModelFigures]
    """Models of the delay without the bottleneck's transmission time; the best is first."""
    loss_models: list[ModelFigures]
    text: str
    """Best models of delay and loss as a value of `network.uplink` or `network.downlink`."""


class PathFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a path, as written with --json."""

    listener: str
    """Address of the listener, or its path LOCAL=HOST:PORT, or the names of the log files."""
    secure: bool
    log: Literal["", "round trips", "one way"]
    """Kind of the log's times; "" for a measurement. A direction gets half of a round trip."""
    seconds: float
    bytes: int
    """UDP payload of a packet [B]; 0 for a log."""
    every_s: float
    offset_s: float
    """Offset of the listener's clock at the first probe [s]."""
    offset_doubt_s: float
    """Largest error of the offset and of one-way delays [s]; opposite in the two directions."""
    drift_ppm: float
    """Drift of the listener's clock [10⁻⁶]; 0 if the drift is not significant."""
    drift_doubt_ppm: float
    round_trip_mean_s: float
    """Mean round-trip time [s], which is independent of the clocks' offset."""
    round_trip_least_s: float
    """Sum of both directions' least delays [s]."""
    unreported: int
    """Number of arrivals that the listener dropped before reporting them."""
    uplink: DirectionFigures
    """Figures of the packets from the listener to the prober."""
    downlink: DirectionFigures
    """Figures of the packets from the prober to the listener."""


class PathsFigures(msgspec.Struct, frozen=True):
    """Figures of several paths, as written with --json."""

    paths: list[PathFigures]
    outages: CommonOutages


@dataclass(frozen=True, slots=True)
class ProbeOutcome:
    clocks: Clocks
    delays: Mapping[str, Delays]
    figures: PathFigures


def outcome(
    measured: MeasuredPath,
    listener: str,
    *,
    secure: bool,
    log: Literal["", "round trips", "one way"] = "",
) -> ProbeOutcome:
    """Result of a measurement.

    Args:
        listener: HOST:PORT of the other end, or the names of files.
        secure: whether packets were encrypted.
        log: kind of times in the log; empty for a measurement.

    Raises:
        ValueError: too few packets arrived.
    """
    ways = {"uplink": measured.uplink, "downlink": measured.downlink}
    clocks, down, up = (analysis.delays_of_log if log else analysis.delays)(measured)
    delays = {"uplink": up, "downlink": down}
    directions = {
        name: _direction_figures(way, delays[name], measured.size) for name, way in ways.items()
    }
    near = measured.downlink.sent_ns
    path = PathFigures(
        listener=listener,
        secure=secure,
        log=log,
        seconds=float(near[-1] - near[0]) / SECOND_NS,
        bytes=measured.size,
        every_s=measured.period_ns / SECOND_NS,
        offset_s=clocks.offset_s,
        offset_doubt_s=clocks.doubt_s,
        drift_ppm=clocks.drift * 1e6,
        drift_doubt_ppm=clocks.drift_doubt * 1e6,
        round_trip_mean_s=directions["uplink"].mean_s + directions["downlink"].mean_s,
        round_trip_least_s=clocks.least_sum_s,
        unreported=measured.unreported,
        **directions,
    )
    return ProbeOutcome(clocks, delays, path)


def _direction_figures(way: Way, delays: Delays, size: int) -> DirectionFigures:
    rate = delays.rate
    service_s = (size + HEADER_BYTES) / rate.bytes_per_s if rate else 0.0
    lost = ~delays.came
    delay_s = delays.delay_s[delays.came]
    apart_s, correlations = analysis.autocorrelation(delays.time_s, delays.delay_s)
    _, together = analysis.autocorrelation(delays.time_s, lost.astype(np.float64))
    correlation_s = analysis.correlation_time_s(apart_s, correlations, len(delay_s))
    loss = float(lost.mean())
    low, high = analysis.wilson(loss, analysis.effective(len(lost), together))
    runs, length = analysis.bursts(lost)
    independent = analysis.effective(len(delay_s), correlations)
    delay_models = fits.fit_delays(np.maximum(delay_s - service_s, 0.0), independent)
    loss_models = fits.fit_losses(delays.time_s, lost)
    reordered = analysis.reordered(way)
    spacing_s = float(apart_s[0]) if len(apart_s) else np.inf
    lasting_s = correlation_s if correlation_s > TEXT_CORRELATION_MIN * spacing_s else 0.0
    models = [ModelFigures(fit.text(lasting_s), fit.bic) for fit in delay_models]
    losses = [ModelFigures(fit.text(), fit.bic) for fit in loss_models]
    parts = [each[0].text for each in (models, losses) if each]
    if rate:
        parts.append(f"rate({rate.bytes_per_s:.4g})")
    if models and not reordered and _would_reorder(delays) > ORDERED_SHARE:
        parts.append("ordered")
    return DirectionFigures(
        sent=len(lost),
        came=len(delay_s),
        copies=way.copies,
        loss=loss,
        loss_low=low,
        loss_high=high,
        bursts=runs,
        burst_packets=length,
        reordered=reordered,
        mean_s=float(delay_s.mean()),
        sd_s=float(delay_s.std()),
        quantiles_s={f"{q:g}": float(np.quantile(delay_s, q)) for q in QUANTILES},
        correlation=list(zip(apart_s.tolist(), correlations.tolist(), strict=True)),
        correlation_s=correlation_s,
        rate_bytes_per_s=rate.bytes_per_s if rate else None,
        rate_low=rate.low if rate else None,
        rate_high=rate.high if rate else None,
        trains=rate.trains if rate else 0,
        train_wait_s=(TRAIN - 1) * service_s,
        delay_models=models,
        loss_models=losses,
        text=" & ".join(parts),
    )


def _would_reorder(delays: Delays) -> float:
    """Share of packets that would be overtaken if their delays were independent."""
    came = delays.came
    time_s, delay_s = delays.time_s[came], delays.delay_s[came]
    mixed = np.random.default_rng(0).permutation(delay_s)
    order = np.argsort(time_s + mixed, kind="stable")
    return float((order < np.maximum.accumulate(order)).mean())


def trace(delays: Delays, within_s: tuple[float, float] | None = None) -> str:
    """Packets of a direction as CSV text for the impairment `trace`, one row per packet.

    Args:
        within_s: beginning and end of the trace [s], by default the first and the last packet's
            time. Of the packets outside, the nearest one at each end is moved to that end.
    """
    lines, last = ["time_s,delay_s,lost"], -np.inf
    times_s, delays_s = delays.time_s, delays.delay_s
    if within_s:
        first = max(int(np.searchsorted(times_s, within_s[0], side="right")) - 1, 0)
        end = int(np.searchsorted(times_s, within_s[1])) + 1
        times_s, delays_s = times_s[first:end].copy(), delays_s[first:end]
        times_s[0], times_s[-1] = within_s
    begin = float(times_s[0])
    for time_s, delay_s in zip(times_s.tolist(), delays_s.tolist(), strict=True):
        at = round(time_s - begin, 6)
        if at > last:  # a trace has one packet per time: keep the first
            last = at
            lines.append(
                f"{at:.6f},,1" if isnan(delay_s) else f"{at:.6f},{max(delay_s, 0.0):.6f},0"
            )
    return "\n".join(lines) + "\n"


def rows(measured: MeasuredPath, clocks: Clocks, path: int = 0) -> Rows:
    """Packets of both directions as rows of netem's part of a record, including packets of trains.

    Times are on the prober's clock; `delay_ns` of a lost packet is 0. Paths count from 0.
    """
    parts = []
    for direction, way in ((DOWNLINK, measured.downlink), (UPLINK, measured.uplink)):
        ahead_ns = _ahead_ns(way, measured, clocks)
        part = np.zeros(len(way.sent_ns), PACKET_COLUMNS)
        sign = -1 if direction == DOWNLINK else 1
        part["direction"], part["bytes"], part["path"] = direction, measured.size, path
        part["number"] = np.arange(len(part))
        part["arrived_ns"] = way.sent_ns - (ahead_ns if direction == UPLINK else 0)
        delay_ns = way.came_ns - way.sent_ns + sign * ahead_ns
        part["delay_ns"] = np.where(way.came, delay_ns, 0)
        part["lost"] = ~way.came
        came = np.flatnonzero(way.came)
        order = came[np.argsort(way.came_ns[came], kind="stable")]
        part["overtaken"][order] = order < np.maximum.accumulate(order)
        parts.append(part)
    return np.concatenate(parts)


def _ahead_ns(way: Way, measured: MeasuredPath, clocks: Clocks) -> Longs:
    """Offset of the listener's clock when each packet is sent [ns]; shape (n,)."""
    near_ns = measured.downlink.sent_ns[0]
    base_ns = round(clocks.offset_s * SECOND_NS)
    since: Array = (way.sent_ns - near_ns).astype(np.float64)
    if way is measured.uplink:
        since -= base_ns
    ahead: Longs = base_ns + np.rint(since * clocks.drift).astype(np.int64)
    return ahead
