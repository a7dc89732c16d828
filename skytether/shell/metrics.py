"""Tables of metrics: names, units and labels of a process's figures for Prometheus, and its health.

Each figure of an endpoint (`Endpoint.figures`) is either exported by a metric or left out on
purpose; one that is neither is counted, and a test finds it. Names follow Prometheus: base units,
`_total` for counters. `shell.exporter` serves the metrics.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

from skytether.shared.wire.protocol import Mode

PREFIX = "skytether_"
"""Prefix of all metrics' names."""
Kind = Literal["counter", "gauge", "histogram", "summary", "modes"]
"""Kind of a metric; "modes" is one gauge per mode of a vehicle, 1 for its present mode."""
MILLI, NANO = 1e-3, 1e-9


class Label(NamedTuple):
    """Label that takes the place of any name in a figure's path, and has this name as its value."""

    name: str


Path = tuple[str | Label, ...]
"""Path of a figure: names of its groups, the outermost first, and its own name."""


class Metric(NamedTuple):
    """Metric, and the path of the figure that it exports."""

    figure: Path
    name: str
    """Name of the metric, without the prefix."""
    kind: Kind
    help: str
    """Help text of the metric: one sentence."""
    scale: float = 1.0
    """Factor from the figure's unit to the metric's."""
    labels: tuple[tuple[str, str], ...] = ()
    """Names and values of fixed labels that separate figures of the same metric."""


class MetricValue(NamedTuple):
    """Number of a metric, with its labels."""

    suffix: str
    labels: dict[str, str]
    value: float


class Family(NamedTuple):
    """Metric and its numbers."""

    metric: Metric
    samples: list[MetricValue]


def _each_way(
    figure: Path, name: str, kind: Kind, help_: str, scale: float = 1.0, **labels: str
) -> list[Metric]:
    """Metric of both directions; arguments as for `Metric`."""
    return [
        Metric((way, *figure), name, kind, help_, scale, (("direction", way), *labels.items()))
        for way in ("uplink", "downlink")
    ]


_VEHICLE = ("by_vehicle", Label("vehicle"))
"""Path of the figures of one vehicle."""
_PROCESS = (
    Metric(("cpu_s",), "cpu_seconds_total", "counter", "CPU time used."),
    Metric(
        ("kernel_drops",),
        "kernel_dropped_datagrams_total",
        "counter",
        "Datagrams that the kernel dropped at the process's sockets.",
    ),
    Metric(("send_errors",), "send_errors_total", "counter", "Datagrams that could not be sent."),
    Metric(("feed", "readers"), "feed_readers", "gauge", "Readers of the feed."),
    Metric(
        ("feed", "dropped"),
        "feed_dropped_readers_total",
        "counter",
        "Readers of the feed that were disconnected because they were too slow.",
    ),
    Metric(
        ("feed", "refused"),
        "feed_refused_readers_total",
        "counter",
        "Readers of the feed that were refused because the feed was full.",
    ),
)
_SERVER = (
    Metric(("vehicles",), "server_vehicles", "gauge", "Vehicles in session."),
    Metric(
        ("degraded",),
        "server_degraded",
        "gauge",
        "Whether the server misses more ticks than allowed: 1 or 0.",
    ),
    Metric(
        ("missed",),
        "server_missed_ticks_total",
        "counter",
        "Ticks that were missed because the process ran too late.",
    ),
    Metric(
        ("observations",),
        "server_observations_total",
        "counter",
        "Observations that were accepted as plausible.",
    ),
    Metric(
        ("ticks_within_ms", Label("le")),
        "server_tick_seconds",
        "histogram",
        "Duration of a tick, for all vehicles together.",
        MILLI,
    ),
    Metric(
        ("spent_ns", Label("part")),
        "server_spent_seconds_total",
        "counter",
        "Time spent on each part of the work.",
        NANO,
    ),
    Metric(
        ("counts", "steps"),
        "server_steps_total",
        "counter",
        "Steps of vehicles at which the server decided whether to send.",
    ),
    Metric(
        ("counts", "events"),
        "server_events_total",
        "counter",
        "Steps of vehicles at which the server sent a horizon.",
    ),
    Metric(
        ("counts", "unsolved"),
        "server_unsolved_total",
        "counter",
        "Steps for which no plan was found.",
    ),
    Metric(
        ("counts", "horizons_lost"),
        "server_lost_horizons_total",
        "counter",
        "Horizons that were sent but did not come into force in time.",
    ),
    Metric(
        ("dropped", Label("reason")),
        "server_dropped_datagrams_total",
        "counter",
        "Datagrams that came from no vehicle or could not be read, by reason.",
    ),
    Metric(
        ("refused", Label("reason")),
        "server_refused_vehicles_total",
        "counter",
        "Requests for a session (HELLO) that were refused, by reason.",
    ),
    Metric(
        (*_VEHICLE, "step"),
        "server_vehicle_step",
        "gauge",
        "Newest step of the vehicle for which the server made a decision.",
    ),
    Metric(
        (*_VEHICLE, "clock_bound_ms"),
        "server_vehicle_clock_bound_seconds",
        "gauge",
        "Half of the time that the vehicle's clock may lie apart, as far as the server knows.",
        MILLI,
    ),
    Metric(
        (*_VEHICLE, "clock_m"),
        "server_vehicle_clock_metres",
        "gauge",
        "Distance by which the vehicle may be elsewhere on its motion, for want of its clock.",
    ),
)
_NETEM = (
    Metric(("flows",), "netem_flows", "gauge", "Clients whose packets are forwarded."),
    Metric(
        ("refused",),
        "netem_refused_packets_total",
        "counter",
        "Packets of clients without a flow, or of strangers at the socket of a flow.",
    ),
    *_each_way(("packets",), "netem_packets_total", "counter", "Packets that entered."),
    *_each_way(
        ("bytes",), "netem_bytes_total", "counter", "UDP payload of the packets that entered."
    ),
    *_each_way(("forwarded",), "netem_forwarded_packets_total", "counter", "Packets that left."),
    *_each_way(
        ("lost",),
        "netem_lost_packets_total",
        "counter",
        "Packets that the scenario's loss model dropped.",
    ),
    *_each_way(
        ("reordered",),
        "netem_reordered_packets_total",
        "counter",
        "Packets overtaken by a later one.",
    ),
    *_each_way(
        ("oversized",),
        "netem_oversized_packets_total",
        "counter",
        "Packets longer than network.mtu.",
    ),
    *_each_way(
        ("overflowed",),
        "netem_overflowed_packets_total",
        "counter",
        "Packets that were dropped because netem's memory for packets was full.",
    ),
    *_each_way(
        ("dropped",),
        "netem_dropped_packets_total",
        "counter",
        "Packets that the queue of a limited rate dropped.",
    ),
    *_each_way(
        ("duplicated",),
        "netem_duplicated_packets_total",
        "counter",
        "Duplicates of packets that were made.",
    ),
    *_each_way(
        ("corrupted",),
        "netem_corrupted_packets_total",
        "counter",
        "Packets in which a bit was flipped.",
    ),
    *_each_way(
        ("queue",),
        "netem_queued_packets",
        "gauge",
        "Packets that are delayed now and have not left.",
    ),
    *_each_way(
        ("delays_within_ms", Label("le")),
        "netem_delay_seconds",
        "histogram",
        "Delays that the network model drew for packets that left.",
        MILLI,
    ),
    *(
        metric
        for figure, quantile in (("p50", "0.5"), ("p99", "0.99"), ("max", "1"))
        for metric in _each_way(
            (f"error_ms_{figure}",),
            "netem_lateness_seconds",
            "summary",
            "Time by which packets left later than the network model demanded.",
            MILLI,
            quantile=quantile,
        )
    ),
    *(
        metric
        for figure, quantile in (("p50", "0.5"), ("p99", "0.99"))
        for metric in _each_way(
            (f"queueing_ms_{figure}",),
            "netem_queueing_seconds",
            "summary",
            "Time that packets waited for a limited rate.",
            MILLI,
            quantile=quantile,
        )
    ),
)
_CLIENT = (
    Metric(
        ("missed",),
        "client_missed_steps_total",
        "counter",
        "Steps that were missed because the process ran too late.",
    ),
    Metric(
        (*_VEHICLE, "mode"),
        "client_mode",
        "modes",
        "Mode of the vehicle, see docs/failsafe.md: 1 for the present mode, 0 for the others.",
    ),
    Metric((*_VEHICLE, "step"), "client_step", "gauge", "Number of the vehicle's next step."),
    Metric((*_VEHICLE, "steps"), "client_steps", "gauge", "Number of steps of the whole flight."),
    Metric(
        (*_VEHICLE, "age_ms"),
        "client_age_seconds",
        "gauge",
        "Age of the observation from which the input in force was planned.",
        MILLI,
    ),
    Metric(
        (*_VEHICLE, "plan_age_ms"),
        "client_plan_age_seconds",
        "gauge",
        "Time since the step that the horizon in force was made for.",
        MILLI,
    ),
    Metric(
        (*_VEHICLE, "horizons"),
        "client_horizons_total",
        "counter",
        "Horizons received.",
    ),
    Metric(
        (*_VEHICLE, "dropped", Label("reason")),
        "client_dropped_datagrams_total",
        "counter",
        "Datagrams that were not the server's, came too late or could not be read, by reason.",
    ),
)
_AUTOPILOT = (*_VEHICLE, "autopilot")
"""Path of the figures of a vehicle's own autopilot."""
_ABOARD = (
    Metric(
        (*_AUTOPILOT, "armed"),
        "autopilot_armed",
        "gauge",
        "Whether the autopilot is armed: 1 or 0.",
    ),
    Metric(
        (*_AUTOPILOT, "mode_number"),
        "autopilot_mode",
        "gauge",
        "Number of the autopilot's mode (custom_mode of its heartbeat).",
    ),
    Metric((*_AUTOPILOT, "battery"), "autopilot_battery_ratio", "gauge", "Charge of the battery."),
    Metric(
        (*_AUTOPILOT, "voltage_v"), "autopilot_battery_volts", "gauge", "Voltage of the battery."
    ),
    Metric(
        (*_AUTOPILOT, "home", Label("coordinate")),
        "autopilot_home",
        "gauge",
        "Autopilot's home: latitude and longitude in degrees, altitude above the sea in metres.",
    ),
    Metric(
        (*_AUTOPILOT, "fence", Label("parameter")),
        "autopilot_fence",
        "gauge",
        "Values of the autopilot's own fence parameters.",
    ),
    Metric(
        (*_AUTOPILOT, "measurements"),
        "autopilot_measurements_total",
        "counter",
        "Positions from the autopilot that were accepted.",
    ),
    Metric(
        (*_AUTOPILOT, "heard"),
        "autopilot_messages_total",
        "counter",
        "Messages received from the autopilot.",
    ),
    Metric(
        (*_AUTOPILOT, "setpoints"),
        "autopilot_setpoints_total",
        "counter",
        "Velocity set-points sent to the autopilot.",
    ),
    Metric(
        (*_AUTOPILOT, "dropped", Label("reason")),
        "autopilot_dropped_messages_total",
        "counter",
        "Messages on the autopilot's line from others, for others, or with an impossible time.",
    ),
    Metric(
        (*_AUTOPILOT, "garbage_bytes"),
        "autopilot_garbage_bytes_total",
        "counter",
        "Bytes on the autopilot's line that belong to no valid message.",
    ),
    Metric(
        (*_AUTOPILOT, "round_trip_ms"),
        "autopilot_round_trip_seconds",
        "gauge",
        "Smallest recent round-trip time to the autopilot.",
        MILLI,
    ),
    Metric(
        (*_AUTOPILOT, "drift_ppm"),
        "autopilot_clock_drift_ppm",
        "gauge",
        "Rate at which the client's clock runs faster than the autopilot's.",
    ),
)
TABLES = {
    "server": _SERVER + _PROCESS,
    "netem": _NETEM + _PROCESS,
    "client": _CLIENT + _ABOARD + _PROCESS,
}
"""Metrics of each kind of process."""
LEFT_OUT: dict[str, tuple[Path, ...]] = {
    "server": (
        ("tick_ms_p50",),  # since the start; the histogram gives quantiles over any period
        ("tick_ms_p99",),
    ),
    "netem": (
        *((way, f"delay_ms_{each}") for way in ("uplink", "downlink") for each in ("p50", "p99")),
        ("uplink", "delays_ms", Label("ms")),  # up to 500 numbers
        ("downlink", "delays_ms", Label("ms")),
        ("uplink", "queue_max"),  # since the start; Prometheus has the largest over any period
        ("downlink", "queue_max"),
    ),
    "client": (
        ("vehicles",),  # constant
        (*_VEHICLE, "missed"),  # covered by the other metrics
        (*_VEHICLE, "began_s"),  # from a clock that Prometheus does not know
        (*_AUTOPILOT, "mode"),  # its number is exported
    ),
}
"""Figures that are deliberately not exported."""
OWN = (
    Metric(
        (),
        "info",
        "gauge",
        "Labels that name the process and what it flies; the value is always 1.",
    ),
    Metric((), "step_seconds", "gauge", "Length of a step, the deadline of a tick."),
    Metric((), "snapshot_age_seconds", "gauge", "Time since the other metrics were updated."),
    Metric(
        (),
        "unmapped_figures",
        "gauge",
        "Figures of the process that no metric exports; more than 0 is a mistake in Skytether.",
    ),
)
"""Metrics of the process itself and of the exporter, which export no figure."""


def families(process: str, figures: Mapping[str, Any]) -> tuple[list[Family], list[str]]:
    """Metrics made of figures, and the paths of figures that no table has.

    Args:
        process: server, netem or client.
        figures: from `Endpoint.figures`, and those that the process adds.
    """
    found: dict[str, Family] = {}
    unknown = []
    for path, value in flat(figures):
        for metric in TABLES[process]:
            labels = matched(metric.figure, path)
            if labels is not None:
                family = found.setdefault(metric.name, Family(metric, []))
                family.samples.extend(_samples(metric, labels, value))
                break
        else:
            if not any(matched(figure, path) is not None for figure in LEFT_OUT[process]):
                unknown.append("/".join(path))
    return list(found.values()), unknown


def trouble(process: str, figures: Mapping[str, Any]) -> str:
    """Reason why a process is unhealthy, as its figures show; empty for a healthy one.

    A server is unhealthy if it misses ticks, and a client if one of its vehicles neither flies nor
    is ready to.

    Args:
        process, figures: see `families`.
    """
    if process == "server" and figures.get("degraded"):
        return "it misses more ticks than allowed"
    if process == "client":
        for vehicle, told in figures["by_vehicle"].items():
            if told["mode"] not in HEALTHY:
                return f"vehicle {vehicle} is in mode {told['mode']}"
    return ""


HEALTHY = {str(mode) for mode in (Mode.READY, Mode.TRACK, Mode.COAST)}
"""Names of the modes of a vehicle that has a session and flies, or is ready to."""


def flat(
    figures: Mapping[str, Any], groups: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Figures by their paths: the names of their groups, and their own."""
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from flat(value, (*groups, name))
        else:
            yield (*groups, name), value


def matched(figure: Path, path: tuple[str, ...]) -> dict[str, str] | None:
    """Labels of a figure with this path; None where the metric's path does not match."""
    if len(figure) != len(path):
        return None
    labels = {}
    for meant, name in zip(figure, path, strict=True):
        if isinstance(meant, Label):
            labels[meant.name] = name
        elif meant != name:
            return None
    return labels


def _samples(metric: Metric, labels: dict[str, str], value: Any) -> Iterator[MetricValue]:
    labels = {**labels, **dict(metric.labels)}
    match metric.kind:
        case "modes":
            for mode in Mode:
                yield MetricValue("", {**labels, "mode": str(mode)}, float(str(mode) == value))
        case "histogram":
            edge = float(labels["le"]) * metric.scale
            if edge == float("inf"):
                others = {name: text for name, text in labels.items() if name != "le"}
                yield MetricValue("_bucket", labels | {"le": "+Inf"}, float(value))
                yield MetricValue("_count", others, float(value))
            else:
                yield MetricValue("_bucket", labels | {"le": f"{edge:g}"}, float(value))
        case _:
            yield MetricValue("", labels, float(value) * metric.scale)
