"""What the figures of a process are called where machines gather them: names, units, and health.

Each figure of an endpoint (`Endpoint.figures`) is either told by a metric or left out on purpose;
one that is neither is counted, and a test finds it. Names follow Prometheus: base units, `_total`
for what only grows. `shell.metrics` serves them.
"""

import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Literal, NamedTuple

from shared.protocol import Mode

PREFIX = "skytether_"
"""What all names begin with."""
Kind = Literal["counter", "gauge", "histogram", "summary", "modes"]
"""What a metric is; "modes" is a gauge for each mode of a vehicle, 1 for the one it is in."""
MILLI, NANO = 1e-3, 1e-9


class Metric(NamedTuple):
    """A metric, and the figure that it tells."""

    figure: str
    """Names of the figure and of the groups around it, with `/` between them; a name in braces
    stands for any text, and is a label."""
    name: str
    """Name of the metric, without the prefix."""
    kind: Kind
    help: str
    """What it is, in a sentence."""
    scale: float = 1.0
    """Factor that makes the metric's unit of the figure's."""
    labels: tuple[tuple[str, str], ...] = ()
    """Labels that tell it from other figures of the same metric, and their values."""


class Sample(NamedTuple):
    """A number of a metric."""

    suffix: str
    labels: dict[str, str]
    value: float


class Family(NamedTuple):
    """A metric and its numbers."""

    metric: Metric
    samples: list[Sample]


def _each_way(
    figure: str, name: str, kind: Kind, help_: str, scale: float = 1.0, **labels: str
) -> list[Metric]:
    """A metric of both directions; arguments as of `Metric`."""
    return [
        Metric(f"{way}/{figure}", name, kind, help_, scale, (("direction", way), *labels.items()))
        for way in ("uplink", "downlink")
    ]


_PROCESS = (
    Metric("cpu_s", "cpu_seconds_total", "counter", "CPU time used."),
    Metric(
        "kernel_drops",
        "kernel_dropped_datagrams_total",
        "counter",
        "Datagrams that the kernel dropped at the process's sockets.",
    ),
    Metric("send_errors", "send_errors_total", "counter", "Datagrams that could not be sent."),
    Metric("feed/readers", "feed_readers", "gauge", "Readers of the feed."),
    Metric(
        "feed/dropped",
        "feed_dropped_readers_total",
        "counter",
        "Readers of the feed that were too slow, and dropped.",
    ),
    Metric(
        "feed/refused",
        "feed_refused_readers_total",
        "counter",
        "Readers of the feed that were turned away for want of a place.",
    ),
)
_SERVER = (
    Metric("vehicles", "server_vehicles", "gauge", "Vehicles in session."),
    Metric("degraded", "server_degraded", "gauge", "Whether it misses more ticks than it may."),
    Metric("missed", "server_missed_ticks_total", "counter", "Ticks that were slept through."),
    Metric(
        "observations", "server_observations_total", "counter", "Observations that were believed."
    ),
    Metric(
        "ticks_within/{le} ms",
        "server_tick_seconds",
        "histogram",
        "How long a tick took, all vehicles together.",
        MILLI,
    ),
    Metric(
        "spent_ns/{part}",
        "server_spent_seconds_total",
        "counter",
        "Time spent on each part of the work.",
        NANO,
    ),
    Metric("counts/steps", "server_steps_total", "counter", "Steps of vehicles decided on."),
    Metric(
        "counts/events",
        "server_events_total",
        "counter",
        "Steps among them at which a horizon was sent.",
    ),
    Metric(
        "counts/unsolved", "server_unsolved_total", "counter", "Steps for which no plan was found."
    ),
    Metric(
        "counts/horizons lost",
        "server_lost_horizons_total",
        "counter",
        "Horizons that were sent, and not flown in time.",
    ),
    Metric(
        "counts/dropped: {reason}",
        "server_dropped_datagrams_total",
        "counter",
        "Datagrams that were no vehicle's, or made no sense.",
    ),
    Metric(
        "counts/refused: {reason}",
        "server_refused_vehicles_total",
        "counter",
        "HELLOs of vehicles that were refused.",
    ),
    Metric(
        "each/vehicle {vehicle}/step",
        "server_vehicle_step",
        "gauge",
        "Step of the vehicle that was decided on last.",
    ),
    Metric(
        "each/vehicle {vehicle}/clock_bound_ms",
        "server_vehicle_clock_bound_seconds",
        "gauge",
        "How far off the map of the vehicle's clock may be.",
        MILLI,
    ),
)
_NETEM = (
    Metric("flows", "netem_flows", "gauge", "Clients that packets pass for."),
    Metric(
        "refused", "netem_refused_packets_total", "counter", "Packets for which there was no flow."
    ),
    *_each_way("packets", "netem_packets_total", "counter", "Packets that entered."),
    *_each_way("bytes", "netem_bytes_total", "counter", "UDP payload of these."),
    *_each_way("forwarded", "netem_forwarded_packets_total", "counter", "Packets that left."),
    *_each_way("lost", "netem_lost_packets_total", "counter", "Packets lost, as was drawn."),
    *_each_way(
        "reordered", "netem_reordered_packets_total", "counter", "Packets overtaken by a later one."
    ),
    *_each_way(
        "oversized", "netem_oversized_packets_total", "counter", "Packets longer than network.mtu."
    ),
    *_each_way(
        "overflowed",
        "netem_overflowed_packets_total",
        "counter",
        "Packets for which there was no room.",
    ),
    *_each_way("queue", "netem_queued_packets", "gauge", "Packets under way."),
    *_each_way(
        "delays_within/{le} ms",
        "netem_delay_seconds",
        "histogram",
        "Delays of packets that left, as drawn.",
        MILLI,
    ),
    *(
        metric
        for figure, quantile in (("p50", "0.5"), ("p99", "0.99"), ("max", "1"))
        for metric in _each_way(
            f"error_ms_{figure}",
            "netem_lateness_seconds",
            "summary",
            "Time by which packets left later than drawn.",
            MILLI,
            quantile=quantile,
        )
    ),
)
_CLIENT = (
    Metric("missed", "client_missed_steps_total", "counter", "Steps that were slept through."),
    Metric(
        "each/vehicle {vehicle}/mode",
        "client_mode",
        "modes",
        "Whether the vehicle is in the mode, see docs/failsafe.md.",
    ),
    Metric("each/vehicle {vehicle}/step", "client_step", "gauge", "Step that comes next."),
    Metric("each/vehicle {vehicle}/steps", "client_steps", "gauge", "Steps of the flight."),
    Metric(
        "each/vehicle {vehicle}/age_ms",
        "client_age_seconds",
        "gauge",
        "Age of the observation behind the input that is flown.",
        MILLI,
    ),
    Metric(
        "each/vehicle {vehicle}/plan_age_ms",
        "client_plan_age_seconds",
        "gauge",
        "Time since the step that the horizon in force was made for.",
        MILLI,
    ),
    Metric(
        "each/vehicle {vehicle}/counts/horizons",
        "client_horizons_total",
        "counter",
        "Horizons received.",
    ),
    Metric(
        "each/vehicle {vehicle}/counts/dropped: {reason}",
        "client_dropped_datagrams_total",
        "counter",
        "Datagrams that were not the server's, too late, or made no sense.",
    ),
)
TABLES = {"server": _SERVER + _PROCESS, "netem": _NETEM + _PROCESS, "client": _CLIENT + _PROCESS}
"""Metrics of each kind of process."""
LEFT_OUT = {
    "server": (
        "tick_ms_p50",  # of all ticks since the start; the histogram tells of any time
        "tick_ms_p99",
        "each/and more",
    ),
    "netem": (
        "uplink/delays/{ms}",  # up to 500 numbers
        "downlink/delays/{ms}",
        "uplink/queue_max",  # of all time; a gatherer has the largest of any time
        "downlink/queue_max",
    ),
    "client": (
        "each/vehicle {vehicle}/vehicle",  # its number is the label
        "each/vehicle {vehicle}/missed",  # told of all of them
        "each/and more",
    ),
}
"""Figures that no metric tells."""
OWN = (
    Metric("", "info", "gauge", "What the process is, and what it flies; always 1."),
    Metric("", "step_seconds", "gauge", "Length of a step, the deadline of a tick."),
    Metric("", "snapshot_age_seconds", "gauge", "Age of all other numbers."),
    Metric("", "unmapped_figures", "gauge", "Figures of the process that no metric tells."),
)
"""Metrics that tell no figure: what the process is, and of the others."""


def families(process: str, figures: Mapping[str, Any]) -> tuple[list[Family], list[str]]:
    """Metrics that figures have a number for, and the figures that are not known.

    Args:
        process: server, netem or client.
        figures: as `Endpoint.figures` has them, and what the process adds.
    """
    found: dict[str, Family] = {}
    unknown = []
    for figure, value in _flat(_each_vehicles(process, figures)):
        for metric, pattern in _patterns(process):
            match = pattern.fullmatch(figure)
            if match is None:
                continue
            if metric is not None:
                family = found.setdefault(metric.name, Family(metric, []))
                family.samples.extend(_samples(metric, match.groupdict(), value))
            break
        else:
            unknown.append(figure)
    return list(found.values()), unknown


def trouble(process: str, figures: Mapping[str, Any]) -> str:
    """What is wrong with a process, as far as its figures tell; empty where nothing is.

    A server that misses its ticks is in trouble, and a client one of whose vehicles is not flown,
    or about to be.

    Args:
        process, figures: see `families`.
    """
    if process == "server" and figures.get("degraded"):
        return "it misses more ticks than it may"
    if process == "client":
        each = _each_vehicles(process, figures)["each"]
        for vehicle, told in each.items():
            if isinstance(told, Mapping) and told["mode"] not in HEALTHY:
                return f"{vehicle} is in mode {told['mode']}"
    return ""


HEALTHY = {str(mode) for mode in (Mode.READY, Mode.TRACK, Mode.COAST)}
"""Names of the modes of a vehicle that has a session and is flown, or could be."""


def _each_vehicles(process: str, figures: Mapping[str, Any]) -> Mapping[str, Any]:
    """Figures of a client of one vehicle, as if it had several."""
    if process != "client" or "vehicle" not in figures:
        return figures
    own = {"vehicle", "mode", "step", "steps", "age_ms", "plan_age_ms", "missed", "counts"}
    each = {f"vehicle {figures['vehicle']}": {k: v for k, v in figures.items() if k in own}}
    others = {key: value for key, value in figures.items() if key not in own}
    return {"missed": figures["missed"], "each": each, **others}


def _flat(figures: Mapping[str, Any], group: str = "") -> Iterator[tuple[str, Any]]:
    """Figures with the names of their groups."""
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{group}{name}/")
        else:
            yield f"{group}{name}", value


@cache
def _patterns(process: str) -> list[tuple[Metric | None, re.Pattern[str]]]:
    """Every metric of a process, or None for what is left out, and what its figures look like."""
    told = [(metric, _pattern(metric.figure)) for metric in TABLES[process]]
    return told + [(None, _pattern(figure)) for figure in LEFT_OUT[process]]


def _pattern(figure: str) -> re.Pattern[str]:
    return re.compile(re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]+)", re.escape(figure)))


def _samples(metric: Metric, labels: dict[str, str], value: Any) -> Iterator[Sample]:
    labels = {**labels, **dict(metric.labels)}
    match metric.kind:
        case "modes":
            for mode in Mode:
                yield Sample("", {**labels, "mode": str(mode)}, float(str(mode) == value))
        case "histogram":
            edge = float(labels["le"]) * metric.scale
            if edge == float("inf"):
                others = {name: text for name, text in labels.items() if name != "le"}
                yield Sample("_bucket", labels | {"le": "+Inf"}, float(value))
                yield Sample("_count", others, float(value))
            else:
                yield Sample("_bucket", labels | {"le": f"{edge:g}"}, float(value))
        case _:
            yield Sample("", labels, float(value) * metric.scale)
