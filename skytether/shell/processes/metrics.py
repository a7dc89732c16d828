"""Metrics of a process for Prometheus: tables of names, units and labels, and its health.

Each figure of an endpoint (`Endpoint.figures`) is in a table or in LEFT_OUT. Other figures are
counted, and fail a test. Names follow Prometheus: base units, `_total` for counters.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from prometheus_client.metrics_core import Metric as Exposed

from skytether.shared.wire.protocol import Mode

PREFIX = "skytether_"
UNITS = {"_ms": 1e-3, "_ns": 1e-9}


class Metric(NamedTuple):
    """Metric and the figure that it exports."""

    figure: str
    """Path of the figure: the names of its groups, then its own name, separated by slashes.
    `{label}` matches any name, which becomes the value of that label.
    """
    name: str
    labels: Mapping[str, str]
    """Labels with fixed values, which distinguish the figures that share the metric's name."""
    help: str

    @property
    def kind(self) -> str:
        if self.name.endswith("_total"):
            return "counter"
        if "{le}" in self.figure:
            return "histogram"
        return "summary" if "quantile" in self.labels else "gauge"

    @property
    def scale(self) -> float:
        return next((scale for unit, scale in UNITS.items() if unit in self.figure), 1.0)

    def exposed(self) -> Exposed:
        # prometheus_client adds the suffix of a counter's name itself.
        return Exposed((PREFIX + self.name).removesuffix("_total"), self.help, self.kind)

    def add(self, exposed: Exposed, labels: Mapping[str, str], value: Any) -> None:
        """Add a figure's value. A mode becomes one sample per mode, 1 for the present mode,
        otherwise 0; any other text becomes the label of a sample with value 1.
        """
        name, labels = PREFIX + self.name, {**labels, **self.labels}
        if isinstance(value, str) and not self.figure.endswith("mode"):
            label = self.figure.rpartition("/")[2]
            exposed.add_sample(name, {**labels, label: value}, 1.0)
        elif isinstance(value, str):
            for mode in map(str, Mode):
                exposed.add_sample(name, {**labels, "mode": mode}, float(mode == value))
        elif self.kind == "histogram":
            edge = float(labels.pop("le")) * self.scale
            last = edge == float("inf")
            le = "+Inf" if last else f"{edge:g}"
            exposed.add_sample(f"{name}_bucket", {**labels, "le": le}, float(value))
            if last:
                exposed.add_sample(f"{name}_count", labels, float(value))
        else:
            exposed.add_sample(name, labels, float(value) * self.scale)


def table(text: str) -> tuple[Metric, ...]:
    """Metrics of a text with two lines per metric: figure, name and labels; then the help."""
    lines = iter(text.strip().splitlines())
    metrics = []
    for head, description in zip(lines, lines, strict=True):
        figure, name, *fixed = head.split()
        metrics.append(
            Metric(figure, name, dict(each.split("=") for each in fixed), description.strip())
        )
    return tuple(metrics)


def _paths(process: str) -> tuple[Metric, ...]:
    """Metrics of each path of a session, in the direction in which the process sends."""
    return tuple(
        each._replace(
            figure=f"by_vehicle/{{vehicle}}/paths/{{path}}/{each.figure}",
            name=f"{process}_path_{each.name}",
        )
        for each in _PATH
    )


_PATH = table("""
packets packets_total
    Packets that were sent on the path, copies included.
bytes bytes_total
    UDP payload of the packets sent on the path.
loss loss_ratio
    Share of the packets on the path that are lost singly, not in outages.
failure failure_ratio
    Probability that a packet sent now on the path does not arrive.
delay_ms acknowledgement_seconds
    Shortest recent time from sending on the path to the acknowledgement.
first first_copies_total
    Packets from the other end whose first copy came over the path.
copies later_copies_total
    Further copies of packets from the other end that came over the path.
""")
_SERVER = table("""
vehicles server_vehicles
    Vehicles in session.
degraded server_degraded
    Whether the server misses more ticks than allowed: 1 or 0.
missed server_missed_ticks_total
    Ticks that were missed because the process was late.
observations server_observations_total
    Observations that were accepted as plausible.
ticks_within_ms/{le} server_tick_seconds
    Duration of a tick, for all vehicles together.
spent_ns/{part} server_spent_seconds_total
    Time spent on each part of the work.
counts/steps server_steps_total
    Steps of vehicles for which the server decided whether to send.
counts/events server_events_total
    Steps of vehicles for which the server sent a horizon.
counts/unsolved server_unsolved_total
    Steps of vehicles for which no plan was found.
counts/horizons_lost server_lost_horizons_total
    Horizons that were sent but did not come into force in time.
counts/scheme_errors server_scheme_errors_total
    Steps of vehicles for which a plug-in's scheme failed.
counts/left_tube server_left_tube_total
    On a mission: observations of vehicles outside their tube.
counts/left_motion server_left_motion_total
    On a mission: motions that a vehicle has left before their end.
margins/{assumed} server_margin_ratio
    On a mission: how near vehicles came to what the theorem assumes; 1 is the bound.
counts/trigger_errors server_trigger_errors_total
    Steps at which a plug-in's trigger failed; a horizon is sent then.
counts/planner_errors server_planner_errors_total
    Steps of vehicles for which a plug-in's planner failed.
counts/planner_late server_planner_late_total
    Steps of vehicles for which a plug-in's planner took too long.
counts/planner_not_called server_planner_not_called_total
    Steps of vehicles for which a plug-in's planner was not called, because too many hang.
dropped/{reason} server_dropped_datagrams_total
    Datagrams that were dropped because they came from no vehicle or could not be read, by reason.
refused/{reason} server_refused_vehicles_total
    Requests for a session (HELLO) that were refused, by reason.
by_vehicle/{vehicle}/step server_vehicle_step
    Newest step of the vehicle for which the server made a decision.
by_vehicle/{vehicle}/clock_bound_ms server_vehicle_clock_bound_seconds
    Uncertainty of the offset between the server's and the vehicle's clock, plus or minus.
by_vehicle/{vehicle}/clock_m server_vehicle_clock_metres
    Uncertainty of the vehicle's position along its motion that follows from its clock's offset.
""") + _paths("server")
_NETEM = table("""
flows netem_flows
    Clients whose packets are forwarded; of `netem run`, the flows that it knows.
refused netem_refused_packets_total
    Packets that were refused: of clients without a flow, or from an unknown address.
{direction}/packets netem_packets_total
    Packets received by netem.
{direction}/bytes netem_bytes_total
    UDP payload of the packets received; of `netem run`, packets of IP with their headers.
{direction}/forwarded netem_forwarded_packets_total
    Packets that were sent on.
{direction}/undelivered netem_undelivered_packets_total
    Packets that could not be sent on, or were reported undeliverable by ICMP.
{direction}/lost netem_lost_packets_total
    Packets that the scenario's loss model dropped.
{direction}/reordered netem_reordered_packets_total
    Packets overtaken by a later one.
{direction}/oversized netem_oversized_packets_total
    Packets longer than network.mtu.
{direction}/overflowed netem_overflowed_packets_total
    Packets that were dropped because netem's memory for packets was full.
{direction}/dropped netem_dropped_packets_total
    Packets that the queue of a limited rate dropped.
{direction}/duplicated netem_duplicated_packets_total
    Duplicates of packets that the network model made.
{direction}/corrupted netem_corrupted_packets_total
    Packets in which a bit was flipped.
{direction}/queue netem_queued_packets
    Packets that are being delayed.
{direction}/delays_within_ms/{le} netem_delay_seconds
    Delays that the network model drew for packets sent on.
{direction}/error_ms_p50 netem_lateness_seconds quantile=0.5
    Time by which packets were sent later than the network model demanded.
{direction}/error_ms_p99 netem_lateness_seconds quantile=0.99
    Time by which packets were sent later than the network model demanded.
{direction}/error_ms_max netem_lateness_seconds quantile=1
    Time by which packets were sent later than the network model demanded.
{direction}/queueing_ms_p50 netem_queueing_seconds quantile=0.5
    Time that packets waited for a limited rate.
{direction}/queueing_ms_p99 netem_queueing_seconds quantile=0.99
    Time that packets waited for a limited rate.
""")
_CLIENT = table("""
missed client_missed_steps_total
    Steps that were missed because the process was late.
by_vehicle/{vehicle}/mode client_mode
    Mode of the vehicle, see docs/failsafe.md: 1 for the present mode, 0 for the others.
by_vehicle/{vehicle}/step client_step
    Number of the vehicle's next step.
by_vehicle/{vehicle}/steps client_steps
    Steps of the whole flight.
by_vehicle/{vehicle}/late_ms client_step_lateness_seconds
    Largest time by which a step began late.
by_vehicle/{vehicle}/age_ms client_age_seconds
    Age of the observation from which the input in force was planned.
by_vehicle/{vehicle}/plan_age_ms client_plan_age_seconds
    Time since the first step of the horizon in force.
by_vehicle/{vehicle}/horizons client_horizons_total
    Horizons received.
by_vehicle/{vehicle}/leadership/number client_leadership
    With a standby server: number of the leadership, which rises when another server leads.
by_vehicle/{vehicle}/leadership/server client_leader
    With a standby server: address of the server that leads, as a label; the value is always 1.
by_vehicle/{vehicle}/dropped/{reason} client_dropped_datagrams_total
    Datagrams that were dropped: not the server's, too late or unreadable, by reason.
others_dropped/{reason} client_dropped_datagrams_total vehicle=others
    Datagrams that were dropped: not the server's, too late or unreadable, by reason.
by_vehicle/{vehicle}/autopilot/armed autopilot_armed
    Whether the autopilot is armed: 1 or 0.
by_vehicle/{vehicle}/autopilot/mode_number autopilot_mode
    Number of the autopilot's mode (custom_mode of its heartbeat).
by_vehicle/{vehicle}/autopilot/battery autopilot_battery_ratio
    Charge of the battery.
by_vehicle/{vehicle}/autopilot/voltage_v autopilot_battery_volts
    Voltage of the battery.
by_vehicle/{vehicle}/autopilot/home/{coordinate} autopilot_home
    Autopilot's home: latitude and longitude in degrees, altitude above the sea in metres.
by_vehicle/{vehicle}/autopilot/fence/{parameter} autopilot_fence
    Values of the autopilot's fence parameters.
by_vehicle/{vehicle}/autopilot/measurements autopilot_measurements_total
    Positions from the autopilot that were accepted.
by_vehicle/{vehicle}/autopilot/heard autopilot_messages_total
    Messages received from the autopilot.
by_vehicle/{vehicle}/autopilot/setpoints autopilot_setpoints_total
    Velocity set-points sent to the autopilot.
by_vehicle/{vehicle}/autopilot/ignored/{reason} autopilot_ignored_messages_total
    Messages that are usual on a line but not used: from or for other systems, or of unknown types.
by_vehicle/{vehicle}/autopilot/dropped/{reason} autopilot_dropped_messages_total
    Messages that were dropped: from an unknown address, or with an impossible time, by reason.
by_vehicle/{vehicle}/autopilot/garbage_bytes autopilot_garbage_bytes_total
    Bytes on the autopilot's line that belong to no valid message.
by_vehicle/{vehicle}/autopilot/round_trip_ms autopilot_round_trip_seconds
    Smallest recent round-trip time to the autopilot.
by_vehicle/{vehicle}/autopilot/drift_ppm autopilot_clock_drift_ppm
    Rate at which the client's clock runs faster than the autopilot's.
""") + _paths("client")
_PROCESS = table("""
cpu_s cpu_seconds_total
    CPU time of the process.
kernel_drops kernel_dropped_datagrams_total
    Datagrams that the kernel dropped at the process's sockets.
send_errors send_errors_total
    Datagrams that could not be sent.
feed/readers feed_readers
    Readers of the feed.
feed/dropped feed_dropped_readers_total
    Readers of the feed that were disconnected because they were too slow.
feed/refused feed_refused_readers_total
    Readers of the feed that were refused because the feed was full.
""")
TABLES = {"server": _PROCESS + _SERVER, "netem": _PROCESS + _NETEM, "client": _PROCESS + _CLIENT}
OWN = table("""
- info
    Name of the process and of its scenario, as labels; the value is always 1.
- step_seconds
    Length of a step, the deadline of a tick.
- snapshot_age_seconds
    Time since the other metrics were updated.
- unmapped_figures
    Figures of the process that no metric exports; more than 0 is a bug in Skytether.
""")
"""Metrics of the exporter itself, not of an endpoint's figures."""
LEFT_OUT = {
    "server": (
        "tick_ms_p50",
        "tick_ms_p99",
    ),  # cumulative since the start; the exported histogram suits any period
    "netem": (
        "{direction}/delay_ms_p50",
        "{direction}/delay_ms_p99",
        "{direction}/delays_ms/{ms}",  # up to 500 numbers
        "{direction}/queue_max",  # cumulative; Prometheus computes the maximum over any period
    ),
    "client": (
        "vehicles",  # the number of vehicles of a client never changes
        "by_vehicle/{vehicle}/missed",  # covered by the other metrics
        "by_vehicle/{vehicle}/began_s",  # a time on the client's own clock
        "by_vehicle/{vehicle}/autopilot/mode",  # the mode's number is exported instead
    ),
}
"""Figures that are deliberately not exported."""


def families(
    process: str, figures: Mapping[str, Any], own: Sequence[Metric] = ()
) -> tuple[list[Exposed], list[str]]:
    """Convert figures to metrics; also returns the paths of figures without a metric.

    Args:
        process: server, netem or client; other processes have only common metrics.
        figures: figures from `Endpoint.figures`, and figures that the process adds.
        own: metrics of the figures, for a process that is not in TABLES.
    """
    possible = (*_PROCESS, *own) if own else TABLES.get(process, _PROCESS)
    metrics: dict[str, Exposed] = {}
    unknown = []
    for path, value in flat(figures):
        for metric in possible:
            labels = matched(metric.figure, path)
            if labels is not None:
                if metric.name not in metrics:
                    metrics[metric.name] = metric.exposed()
                metric.add(metrics[metric.name], labels, value)
                break
        else:
            left_out = LEFT_OUT.get(process, ())
            if (own or process in TABLES) and all(matched(each, path) is None for each in left_out):
                unknown.append("/".join(path))
    return list(metrics.values()), unknown


def trouble(process: str, figures: Mapping[str, Any]) -> str:
    """Reason why a process is unhealthy, from its figures; empty if it is healthy.

    A server is unhealthy if it misses too many ticks, a client if a vehicle neither flies nor is
    ready.
    """
    if process == "server" and figures.get("degraded"):
        return "it misses more ticks than allowed"
    if process == "client":
        for vehicle, state in figures["by_vehicle"].items():
            if state["mode"] not in HEALTHY:
                return f"vehicle {vehicle} is in mode {state['mode']}"
    return ""


HEALTHY = {str(mode) for mode in (Mode.READY, Mode.TRACK, Mode.COAST)}
"""Modes of a vehicle that has a session and flies, or is ready to fly."""


def flat(
    figures: Mapping[str, Any], groups: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Figures with their paths: names of groups, then the figure's name. Items of a list are groups
    numbered from 1; None values are left out.
    """
    for name, value in figures.items():
        if isinstance(value, list):
            numbered = {str(number): each for number, each in enumerate(value, start=1)}
            yield from flat(numbered, (*groups, name))
        elif isinstance(value, Mapping):
            yield from flat(value, (*groups, name))
        elif value is not None:
            yield (*groups, name), value


def matched(figure: str, path: tuple[str, ...]) -> dict[str, str] | None:
    """Labels that a metric's path takes from a figure's path; None if the paths do not match."""
    pattern = figure.split("/")
    if len(pattern) != len(path):
        return None
    labels = {}
    for part, name in zip(pattern, path, strict=True):
        if part.startswith("{"):
            labels[part[1:-1]] = name
        elif part != name:
            return None
    return labels


def names() -> frozenset[str]:
    return frozenset(
        PREFIX + metric.name + suffix
        for table in (*TABLES.values(), OWN)
        for metric in table
        for suffix in (("_bucket", "_count") if metric.kind == "histogram" else ("",))
    )
