"""What the figures of a process are called where machines gather them: names, units, and health.

Each figure of an endpoint (`Endpoint.figures`) is either told by a metric or left out on purpose;
one that is neither is counted, and a test finds it. Names follow Prometheus: base units, `_total`
for what only grows. `shell.exporter` serves them.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

from skytether.shared.wire.protocol import Mode

PREFIX = "skytether_"
"""What all names begin with."""
Kind = Literal["counter", "gauge", "histogram", "summary", "modes"]
"""What a metric is; "modes" is a gauge for each mode of a vehicle, 1 for the one it is in."""
MILLI, NANO = 1e-3, 1e-9


class Label(NamedTuple):
    """Name of a label, in place of any name among figures, which is then its value."""

    name: str


Path = tuple[str | Label, ...]
"""Names of the groups that a figure is in, the outermost first, and of itself."""


class Metric(NamedTuple):
    """A metric, and the figure that it tells."""

    figure: Path
    name: str
    """Name of the metric, without the prefix."""
    kind: Kind
    help: str
    """What it is, in a sentence."""
    scale: float = 1.0
    """Factor that makes the metric's unit of the figure's."""
    labels: tuple[tuple[str, str], ...] = ()
    """Labels that tell it from other figures of the same metric, and their values."""


class MetricValue(NamedTuple):
    """A number of a metric."""

    suffix: str
    labels: dict[str, str]
    value: float


class Family(NamedTuple):
    """A metric and its numbers."""

    metric: Metric
    samples: list[MetricValue]


def _each_way(
    figure: Path, name: str, kind: Kind, help_: str, scale: float = 1.0, **labels: str
) -> list[Metric]:
    """A metric of both directions; arguments as of `Metric`."""
    return [
        Metric((way, *figure), name, kind, help_, scale, (("direction", way), *labels.items()))
        for way in ("uplink", "downlink")
    ]


_VEHICLE = ("by_vehicle", Label("vehicle"))
"""Group of the figures of one vehicle."""
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
        "Readers of the feed that were too slow, and dropped.",
    ),
    Metric(
        ("feed", "refused"),
        "feed_refused_readers_total",
        "counter",
        "Readers of the feed that were turned away for want of a place.",
    ),
)
_SERVER = (
    Metric(("vehicles",), "server_vehicles", "gauge", "Vehicles in session."),
    Metric(("degraded",), "server_degraded", "gauge", "Whether it misses more ticks than it may."),
    Metric(("missed",), "server_missed_ticks_total", "counter", "Ticks that were slept through."),
    Metric(
        ("observations",),
        "server_observations_total",
        "counter",
        "Observations that were believed.",
    ),
    Metric(
        ("ticks_within_ms", Label("le")),
        "server_tick_seconds",
        "histogram",
        "How long a tick took, all vehicles together.",
        MILLI,
    ),
    Metric(
        ("spent_ns", Label("part")),
        "server_spent_seconds_total",
        "counter",
        "Time spent on each part of the work.",
        NANO,
    ),
    Metric(("counts", "steps"), "server_steps_total", "counter", "Steps of vehicles decided on."),
    Metric(
        ("counts", "events"),
        "server_events_total",
        "counter",
        "Steps among them at which a horizon was sent.",
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
        "Horizons that were sent, and not flown in time.",
    ),
    Metric(
        ("dropped", Label("reason")),
        "server_dropped_datagrams_total",
        "counter",
        "Datagrams that were no vehicle's, or made no sense.",
    ),
    Metric(
        ("refused", Label("reason")),
        "server_refused_vehicles_total",
        "counter",
        "HELLOs of vehicles that were refused.",
    ),
    Metric(
        (*_VEHICLE, "step"),
        "server_vehicle_step",
        "gauge",
        "Step of the vehicle that was decided on last.",
    ),
    Metric(
        (*_VEHICLE, "clock_bound_ms"),
        "server_vehicle_clock_bound_seconds",
        "gauge",
        "How far off the map of the vehicle's clock may be.",
        MILLI,
    ),
)
_NETEM = (
    Metric(("flows",), "netem_flows", "gauge", "Clients that packets pass for."),
    Metric(
        ("refused",),
        "netem_refused_packets_total",
        "counter",
        "Packets for which there was no flow.",
    ),
    *_each_way(("packets",), "netem_packets_total", "counter", "Packets that entered."),
    *_each_way(("bytes",), "netem_bytes_total", "counter", "UDP payload of these."),
    *_each_way(("forwarded",), "netem_forwarded_packets_total", "counter", "Packets that left."),
    *_each_way(("lost",), "netem_lost_packets_total", "counter", "Packets lost, as was drawn."),
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
        "Packets for which there was no room.",
    ),
    *_each_way(
        ("dropped",),
        "netem_dropped_packets_total",
        "counter",
        "Packets that the queue of a finite rate has dropped.",
    ),
    *_each_way(("duplicated",), "netem_duplicated_packets_total", "counter", "Copies made."),
    *_each_way(
        ("corrupted",),
        "netem_corrupted_packets_total",
        "counter",
        "Packets of which a bit was flipped.",
    ),
    *_each_way(("queue",), "netem_queued_packets", "gauge", "Packets under way."),
    *_each_way(
        ("delays_within_ms", Label("le")),
        "netem_delay_seconds",
        "histogram",
        "Delays of packets that left, as drawn.",
        MILLI,
    ),
    *(
        metric
        for figure, quantile in (("p50", "0.5"), ("p99", "0.99"), ("max", "1"))
        for metric in _each_way(
            (f"error_ms_{figure}",),
            "netem_lateness_seconds",
            "summary",
            "Time by which packets left later than drawn.",
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
            "Time that packets took to pass a finite rate.",
            MILLI,
            quantile=quantile,
        )
    ),
)
_CLIENT = (
    Metric(("missed",), "client_missed_steps_total", "counter", "Steps that were slept through."),
    Metric(
        (*_VEHICLE, "mode"),
        "client_mode",
        "modes",
        "Whether the vehicle is in the mode, see docs/failsafe.md.",
    ),
    Metric((*_VEHICLE, "step"), "client_step", "gauge", "Step that comes next."),
    Metric((*_VEHICLE, "steps"), "client_steps", "gauge", "Steps of the flight."),
    Metric(
        (*_VEHICLE, "age_ms"),
        "client_age_seconds",
        "gauge",
        "Age of the observation behind the input that is flown.",
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
        "Datagrams that were not the server's, too late, or made no sense.",
    ),
)
_AUTOPILOT = (*_VEHICLE, "autopilot")
"""Group of the figures of a vehicle's own autopilot."""
_ABOARD = (
    Metric((*_AUTOPILOT, "armed"), "autopilot_armed", "gauge", "Whether it is armed."),
    Metric(
        (*_AUTOPILOT, "mode_number"),
        "autopilot_mode",
        "gauge",
        "Number of its mode, as MAVLink's heartbeat has it.",
    ),
    Metric((*_AUTOPILOT, "battery"), "autopilot_battery_ratio", "gauge", "Charge of the battery."),
    Metric(
        (*_AUTOPILOT, "voltage_v"), "autopilot_battery_volts", "gauge", "Voltage of the battery."
    ),
    Metric(
        (*_AUTOPILOT, "home", Label("coordinate")),
        "autopilot_home",
        "gauge",
        "Home: latitude and longitude in degrees, altitude above the sea in metres.",
    ),
    Metric(
        (*_AUTOPILOT, "fence", Label("parameter")),
        "autopilot_fence",
        "gauge",
        "Parameters of its own fence.",
    ),
    Metric(
        (*_AUTOPILOT, "measurements"),
        "autopilot_measurements_total",
        "counter",
        "Positions of the autopilot that were taken.",
    ),
    Metric((*_AUTOPILOT, "heard"), "autopilot_messages_total", "counter", "Messages it sent us."),
    Metric(
        (*_AUTOPILOT, "setpoints"), "autopilot_setpoints_total", "counter", "Velocities sent to it."
    ),
    Metric(
        (*_AUTOPILOT, "dropped", Label("reason")),
        "autopilot_dropped_messages_total",
        "counter",
        "Messages at its line that were not its own, not for us, or of an impossible time.",
    ),
    Metric(
        (*_AUTOPILOT, "garbage_bytes"),
        "autopilot_garbage_bytes_total",
        "counter",
        "Bytes at its line that belong to no message.",
    ),
    Metric(
        (*_AUTOPILOT, "round_trip_ms"),
        "autopilot_round_trip_seconds",
        "gauge",
        "Least round trip to it of late.",
        MILLI,
    ),
    Metric(
        (*_AUTOPILOT, "drift_ppm"),
        "autopilot_clock_drift_ppm",
        "gauge",
        "Rate at which our clock gains on its clock.",
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
        ("tick_ms_p50",),  # of all ticks since the start; the histogram tells of any time
        ("tick_ms_p99",),
    ),
    "netem": (
        *((way, f"delay_ms_{each}") for way in ("uplink", "downlink") for each in ("p50", "p99")),
        ("uplink", "delays_ms", Label("ms")),  # up to 500 numbers
        ("downlink", "delays_ms", Label("ms")),
        ("uplink", "queue_max"),  # of all time; a gatherer has the largest of any time
        ("downlink", "queue_max"),
    ),
    "client": (
        ("vehicles",),  # it never changes
        (*_VEHICLE, "missed"),  # told of all of them
        (*_VEHICLE, "began_s"),  # of no clock that a gatherer knows
        (*_AUTOPILOT, "mode"),  # its number is told
    ),
}
"""Figures that no metric tells."""
OWN = (
    Metric((), "info", "gauge", "What the process is, and what it flies; always 1."),
    Metric((), "step_seconds", "gauge", "Length of a step, the deadline of a tick."),
    Metric((), "snapshot_age_seconds", "gauge", "Age of all other numbers."),
    Metric((), "unmapped_figures", "gauge", "Figures of the process that no metric tells."),
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
    """What is wrong with a process, as far as its figures tell; empty where nothing is.

    A server that misses its ticks is in trouble, and a client one of whose vehicles is not flown,
    or about to be.

    Args:
        process, figures: see `families`.
    """
    if process == "server" and figures.get("degraded"):
        return "it misses more ticks than it may"
    if process == "client":
        for vehicle, told in figures["by_vehicle"].items():
            if told["mode"] not in HEALTHY:
                return f"vehicle {vehicle} is in mode {told['mode']}"
    return ""


HEALTHY = {str(mode) for mode in (Mode.READY, Mode.TRACK, Mode.COAST)}
"""Names of the modes of a vehicle that has a session and is flown, or could be."""


def flat(
    figures: Mapping[str, Any], groups: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Figures with the names of the groups that they are in, and their own."""
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from flat(value, (*groups, name))
        else:
            yield (*groups, name), value


def matched(figure: Path, path: tuple[str, ...]) -> dict[str, str] | None:
    """Labels of a figure with these names; None where it is not the one that is meant."""
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
