"""`skytether fleet`: many vehicles on one server, over real UDP or in virtual time."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from skytether.cli import page_process, processes
from skytether.figures import film
from skytether.figures import flights as figures
from skytether.server.schemes import loading
from skytether.shared import formats
from skytether.shared.base import kernel, machine_code
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.flight import NotFlown
from skytether.shared.formats import plans, tracks
from skytether.shared.law.model import Array
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.drops import drops
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.sent import sent_by
from skytether.shared.telemetry.summary import plugin_errors, separations, summarise
from skytether.shell.commandline import command, plugins, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioName, ScenarioOptions
from skytether.sim import flight as sim

VEHICLES = 20
"""Default of --vehicles without a mission."""
AFTER_S = 30.0
"""Time flown after the last goal of a mission's table [s]."""
STAGES = ("receive", "open", "decode", "observe", "estimate", "plan", "trigger", "encode", "send")
"""Stages of the server's work in a tick, in order, except recording."""


@dataclass(frozen=True)
class FleetOptions(ScenarioOptions):
    scenario: ScenarioName = "fleet"
    """A scenario's name (`skytether list scenarios`) or a .toml file; every vehicle flies it."""
    mission: Annotated[str | None, Argument(metavar="NAME|FILE")] = None
    """Mission instead of a scenario: swap, sphere, rings, corridor, warehouse, or a file of timed
    goals: CSV with the columns vehicle, t, x, y (and z), or a .plan of QGroundControl."""
    show: Annotated[Path | None, Argument(metavar="FILE")] = None
    """Drone show instead of a scenario: timed paths in a CSV file, or a folder or zip with one file
    for each vehicle, as written by Skybrush, Crazyswarm or MAVSDK."""
    vehicles: Annotated[int | None, Argument(metavar="N")] = None
    """Number of vehicles; by default 20, or as many as the mission has."""
    workers: Annotated[int, Argument(metavar="N")] = 1
    """Number of server processes, which share the vehicles."""
    secure: bool = False
    """Encrypt and authenticate the link, with keys made for this flight. Without --secure, packets
    on loopback are plaintext."""
    virtual: bool = False
    """Fly in virtual time: everything in one process, as fast as possible."""
    page: Annotated[str | None, Argument(metavar="HOST:PORT")] = None
    """HOST:PORT of a page with all vehicles, as in `skytether fly`. By default there is no page,
    because a page uses CPU time, and `fleet` measures CPU time. Not in virtual time.
    """
    json: Path | None = None
    """File for the summary of the flight."""
    figure: Path | None = None
    """File for a picture of the flight (.png, .pdf or .svg), or a film (.gif)."""


class FleetSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of a fleet's flight and its CPU costs; None for figures that were not measured."""

    scenario: str
    seed: int
    vehicles: int
    workers: int
    duration_s: float
    """Time flown by the vehicle that flew longest [s]."""
    steps: int
    secure: bool
    server_steps: int
    """Number of steps for which the server planned, all vehicles together."""
    event_ratio: float
    uplink_above: int | None
    """Number of plans sent because of the trigger's figure; in virtual time only."""
    uplink_due: int | None
    """Number of plans sent as heartbeat, by schedule, or as first plan; in virtual time only."""
    rmse_xy: tuple[float, float, float] | None
    """Smallest, median and largest RMSE of the vehicles [m]."""
    separation_m: float | None
    """Distance that vehicles of a mission must keep [m]."""
    least_separation_m: float | None
    """Smallest distance between two vehicles of a mission [m]."""
    left_tube: int | None
    """Number of observations outside a tube (`mission.tube_m`); above 0, separation is unproven."""
    uplink_packets_per_s: float
    """Rate of packets from the server into the network [1/s]."""
    downlink_packets_per_s: float
    """Rate of packets from the vehicles into the network [1/s]."""
    lost: int
    """Number of packets that the network lost, both ways."""
    dropped: int
    """Number of packets dropped because a queue of the kernels or of netem was full."""
    drops: dict[str, dict[str, int]]
    """Number of packets that server, netem and vehicles dropped, by reason, see `Summary.drops`."""
    plugin_errors: dict[str, int]
    """Number of errors in plug-ins' code, by kind of plug-in, see `Summary.plugin_errors`."""
    tick_ms_p50: float
    """Median duration of a server's tick, all vehicles together, in the slowest worker [ms]."""
    tick_ms_p99: float
    """99th percentile of the duration of a server's tick, in the slowest worker [ms]."""
    server_missed: int
    """Number of ticks that the server's workers missed because they woke too late."""
    client_missed: int
    """Number of steps that vehicles missed because their process woke too late."""
    client_late_ms_max: float
    """Longest delay with which a vehicle's step began [ms]."""
    machine_missed: int | None
    """Number of steps missed by a thread that only sleeps. The machine causes these misses."""
    machine_late_ms_max: float | None
    """Longest delay with which the sleeping thread woke [ms]."""
    server_cpu_us: dict[str, float]
    """Server's time per vehicle and step [µs]: `total` is CPU time, stages are wall-clock time."""
    client_cpu_us: float | None
    """CPU time of the vehicles' process per vehicle and step [µs]."""
    netem_cpu_us: float | None
    """CPU time of netem per packet [µs]."""
    vehicle_steps_per_core_s: float | None
    """Number of vehicle steps flown per second of total CPU time [1/s]; in virtual time only."""


@dataclass(frozen=True, slots=True)
class FleetFlight:
    record: Record
    machine: "Lateness | None" = None
    cpu_s: float | None = None
    """CPU time of a flight in virtual time [s]."""


def fleet(argv: Sequence[str]) -> None:
    """Fly many vehicles on one server, each over its own network.

    Server, netem and all vehicles run as three processes on loopback, or in virtual time in one
    process. The results show the server's CPU time per vehicle and step. Ctrl-C ends the flight and
    still shows the results so far.
    """
    argv = _with_mission(argv)
    options = command.parse(FleetOptions(), argv, "skytether fleet", fleet.__doc__)
    vehicles = _vehicles(options)
    command.check_count("--vehicles", vehicles, 65_535)
    command.check_count("--workers", options.workers, 64)
    if options.virtual and options.workers > 1:
        raise CommandError("--workers: got --virtual as well, expected 1 in virtual time", 2)
    if options.page:
        command.address("--page", options.page)
        if options.virtual:
            raise CommandError("--page: got --virtual as well, expected a flight in real time", 2)
    if options.figure:
        figures.check(options.figure, film.SUFFIX)
    where = "in virtual time" if options.virtual else "over UDP on loopback"
    name = Path(options.config.reference.file).name or options.scenario
    count = terminal.counted(vehicles, "vehicle")
    title = f"{count}, {name}, {where}, seed {options.config.seed}"
    terminal.prepare(machine_code.missing(loading.others(options.config)))
    with (
        command.interruptible() as interrupted,
        terminal.progress(f"flying {title}", options.config.duration) as on_second,
    ):
        fly = _virtually if options.virtual else _really
        flight = fly(options, vehicles, on_second, interrupted)
    flown = flight.record
    if not len(flown.client):
        raise CommandError("interrupted before the first step", command.INTERRUPTED)
    apart = _separations(options.config, flown)
    summary = _summarise(options, flight, apart and float(np.nanmin(apart[1])))
    _show(summary, title)
    if options.json:
        command.write(options.json, msgspec.json.encode(summary))
    if options.figure and options.figure.suffix == film.SUFFIX:
        shown = options.config, flown.client
        with terminal.progress("drawing the film", film.length(*shown), "frames") as bar:
            film.write(options.figure, title, *shown, apart, bar)
    elif options.figure:
        server = flown.server if options.virtual else None
        figures.fleet(options.figure, title, options.config, flown.client, server, apart)
    if flown.failure:
        raise CommandError(str(flown.failure))
    command.refuse_errors(summary.plugin_errors)


def _with_mission(argv: Sequence[str]) -> list[str]:
    """Replace `--mission` or `--show` by the scenario and the flags that name its file."""
    missions, rest = plugins.flag_values(argv, "--mission")
    shows, rest = plugins.flag_values(rest, "--show")
    for flag in ("--mission", "--show"):
        if flag in rest:
            raise CommandError(f"{flag}: expected a name or a file", command.CONFIGURATION)
    if not (missions or shows):
        return rest
    flag, file = ("--show", shows[-1]) if shows else ("--mission", missions[-1])
    other = missions[-1:] if shows else []
    if rest and not rest[0].startswith("-"):
        other = rest[:1]
    if other:
        message = f"{flag}: got {other[0]} as well, expected one of the two"
        raise CommandError(message, command.CONFIGURATION)
    is_folder = Path(file).is_dir() and file not in reading.names()
    is_file = Path(file).suffix.lower() in formats.SUFFIXES or is_folder
    if not (shows or is_file):
        if file not in reading.names() and not file.endswith(".toml"):
            expected = "swap, sphere, rings, corridor, warehouse, a folder, or a file that ends in"
            ends = f"{', '.join(formats.SUFFIXES)} or .toml"
            message = f"{flag}: got {file!r}, expected {expected} {ends}"
            raise CommandError(message, command.CONFIGURATION)
        return [file, *rest]
    try:
        (read,) = reading.files_of(flag, file)
        axes = tracks.axes_of(read.content)
        speeds, _ = plugins.flag_values(rest, "--reference.speed-mps")
        lasts_s = tracks.lasts_s(read.content, axes, float((speeds or ["1"])[-1]))
        is_fenced = file.endswith(".plan") and plans.has_fence(read.content)
    except ValueError as error:
        raise CommandError(f"{flag}: {file}: {error}", command.CONFIGURATION) from None
    shape = ["--reference.shape", flag.removeprefix("--"), "--reference.file", file]
    fence = ["--mission.zones", f'plan("{file}")'] if is_fenced else []
    flown = ["--model.axes", str(axes), "--duration", f"{lasts_s + AFTER_S:g}"]
    return ["swap", *shape, *fence, *flown, *rest]


def _virtually(
    options: FleetOptions,
    vehicles: int,
    on_second: Callable[[float], None],
    interrupted: Callable[[], bool],
) -> FleetFlight:
    kernel.load(loading.others(options.config))
    began_s = time.process_time()
    flown = sim.fly(
        options.config,
        vehicles=vehicles,
        secure=options.secure,
        stopwatch=Stopwatch(time.perf_counter_ns),
        on_second=on_second,
        stopped=interrupted,
    )
    if flown.failure and not isinstance(flown.failure, NotFlown):
        raise CommandError(str(flown.failure))
    return FleetFlight(flown, cpu_s=time.process_time() - began_s)


def _really(
    options: FleetOptions,
    vehicles: int,
    on_second: Callable[[float], None],
    interrupted: Callable[[], bool],
) -> FleetFlight:
    with (
        page_process.paged(options.page) as sockets,
        metronome(options.config.control.dt) as machine,
    ):
        run = partial(
            processes.run,
            on_second=on_second,
            interrupted=interrupted,
            vehicles=vehicles,
            workers=options.workers,
            watched=False,
            secure=options.secure,
            sockets=sockets,
        )
        flown = processes.flown(options.config, run)
    if flown.incomplete:
        raise CommandError("; ".join(map(str, flown.incomplete)))
    return FleetFlight(flown, machine)


@dataclass(slots=True)
class Lateness:
    """Delays with which the machine woke a thread that only sleeps."""

    missed: int = 0
    max_s: float = 0.0


@contextmanager
def metronome(dt_s: float) -> Iterator[Lateness]:
    """During the block, run a thread that only sleeps from step to step of `dt_s`. If this thread
    misses a step, the machine is the cause and not our code.
    """
    late, over = Lateness(), threading.Event()

    def sleep() -> None:
        due_s = time.monotonic()
        while not over.is_set():
            due_s += dt_s
            time.sleep(max(0.0, due_s - time.monotonic()))
            late_s = time.monotonic() - due_s
            late.max_s = max(late.max_s, late_s)
            missed = int(late_s / dt_s)
            late.missed += missed
            due_s += missed * dt_s

    thread = threading.Thread(target=sleep, daemon=True)
    thread.start()
    try:
        yield late
    finally:
        over.set()
        thread.join()


def _vehicles(options: FleetOptions) -> int:
    if not options.config.is_mission:
        return VEHICLES if options.vehicles is None else options.vehicles
    mission = options.config.unallocated_reference()
    assert isinstance(mission, Mission)
    count = len(mission.vehicles)
    if options.vehicles not in (None, count):
        message = f"got {options.vehicles}, expected {count} on this mission"
        raise CommandError(f"--vehicles: {message}", command.CONFIGURATION)
    return count


def _separations(scenario: Scenario, flown: Record) -> tuple[Array, Array] | None:
    """Distances between a mission's vehicles over time, see `separations`; None if unknown."""
    client, vehicles = flown.client, flown.figures["client"].get("by_vehicle", {})
    numbers = np.unique(client["vehicle"]).tolist()
    if not scenario.is_mission or any("began_s" not in vehicles.get(str(n), {}) for n in numbers):
        return None
    rows_by_vehicle = [client[client["vehicle"] == number] for number in numbers]
    began_s = [vehicles[str(number)]["began_s"] for number in numbers]
    times_s, nearest_m = separations(
        rows_by_vehicle, began_s, scenario.control.dt, scenario.mission.height_scale
    )
    return (times_s, nearest_m) if np.isfinite(nearest_m).any() else None


def _summarise(options: FleetOptions, flight: FleetFlight, least_m: float | None) -> FleetSummary:
    scenario, flown, machine = options.config, flight.record, flight.machine
    client, counted = flown.client, flown.figures
    server = flown.server if options.virtual else None
    sent = None if server is None else sent_by(server)
    servers = [counted[name] for name in counted if name.startswith("server")]
    measured = [counters for counters in counted.values() if "cpu_s" in counters]
    steps = sum(server["counts"].get("steps", 0) for server in servers)
    spent_us = {
        stage: sum(server["spent_ns"].get(stage, 0) for server in servers) / 1e3 / max(steps, 1)
        for stage in STAGES
    }
    spent_us = {stage: us for stage, us in spent_us.items() if us}
    if measured:
        spent_us["total"] = sum(server["cpu_s"] for server in servers) * 1e6 / max(steps, 1)
    duration_s = (int(client["step"].max()) + 1) * scenario.control.dt
    rows_by_vehicle = [
        client[client["vehicle"] == vehicle] for vehicle in np.unique(client["vehicle"])
    ]
    rmse = [summarise(scenario, options.scenario, rows, server).rmse_xy for rows in rows_by_vehicle]
    finite_rmse = [value for value in rmse if value is not None]
    links = (counted["netem"]["uplink"], counted["netem"]["downlink"])
    packets = sum(link["packets"] for link in links)
    cpu_us = {
        name: counters["cpu_s"] * 1e6 for name, counters in counted.items() if "cpu_s" in counters
    }
    return FleetSummary(
        scenario=options.scenario,
        seed=scenario.seed,
        vehicles=len(rows_by_vehicle),
        workers=len(servers),
        duration_s=duration_s,
        steps=len(client),
        secure=options.secure,
        server_steps=steps,
        event_ratio=sum(server["counts"].get("events", 0) for server in servers) / max(steps, 1),
        uplink_above=sent.above if sent else None,
        uplink_due=sent.due if sent else None,
        rmse_xy=(min(finite_rmse), float(np.median(finite_rmse)), max(finite_rmse))
        if finite_rmse
        else None,
        separation_m=scenario.mission.separation_m if scenario.is_mission else None,
        least_separation_m=least_m,
        left_tube=sum(server["counts"].get("left_tube", 0) for server in servers)
        if scenario.is_mission
        else None,
        uplink_packets_per_s=links[0]["packets"] / duration_s,
        downlink_packets_per_s=links[1]["packets"] / duration_s,
        lost=sum(link["lost"] for link in links),
        dropped=sum(link["overflowed"] for link in links)
        + sum(counters["kernel_drops"] + counters["send_errors"] for counters in measured),
        drops=drops(counted),
        plugin_errors=plugin_errors(counted),
        tick_ms_p50=max(server["tick_ms_p50"] for server in servers),
        tick_ms_p99=max(server["tick_ms_p99"] for server in servers),
        server_missed=sum(server["missed"] for server in servers),
        client_missed=sum(int(rows["missed"][-1]) for rows in rows_by_vehicle),
        client_late_ms_max=max(
            vehicle["late_ms"] for vehicle in counted["client"]["by_vehicle"].values()
        ),
        machine_missed=machine.missed if machine else None,
        machine_late_ms_max=machine.max_s * 1e3 if machine else None,
        server_cpu_us=spent_us,
        client_cpu_us=cpu_us["client"] / len(client) if "client" in cpu_us else None,
        netem_cpu_us=cpu_us["netem"] / max(packets, 1) if cpu_us else None,
        vehicle_steps_per_core_s=len(client) / flight.cpu_s if flight.cpu_s else None,
    )


def _show(summary: FleetSummary, title: str) -> None:
    s = summary
    up, down = s.uplink_packets_per_s, s.downlink_packets_per_s
    rows = [
        ("vehicles, server's workers", f"{s.vehicles}, {s.workers}"),
        ("steps flown, planned for", f"{s.steps}, {s.server_steps} in {s.duration_s:g} s"),
        ("RMSE xy min, median, max [m]", s.rmse_xy and ", ".join(f"{x:.4f}" for x in s.rmse_xy)),
        (
            "smallest, required separation [m]",
            None
            if s.least_separation_m is None
            else f"{s.least_separation_m:.3f}, {s.separation_m:g}",
        ),
        ("observations outside a tube", None if s.left_tube is None else str(s.left_tube)),
        ("link", "sealed" if s.secure else "plaintext"),
        ("event ratio", f"{s.event_ratio:.3f}"),
        (
            "  horizons by the trigger's figure, due",
            None if s.uplink_above is None else f"{s.uplink_above}, {s.uplink_due}",
        ),
        (
            "packets/s up, down, both",
            ", ".join(f"{rate:.0f}" for rate in (up, down, up + down)),
        ),
        ("packets lost, dropped by full queues", f"{s.lost}, {s.dropped}"),
        *terminal.drops(s.drops),
        ("errors of plug-ins", terminal.listed(s.plugin_errors) or None),
        ("tick p50, p99 [ms]", f"{s.tick_ms_p50:.2f}, {s.tick_ms_p99:.2f}"),
        (
            "deadlines missed by server, clients",
            f"{s.server_missed}, {s.client_missed}; {s.client_late_ms_max:.1f} ms late at worst",
        ),
        (
            "  by a process that only sleeps",
            None
            if s.machine_late_ms_max is None
            else f"{s.machine_missed}; {s.machine_late_ms_max:.1f} ms late at worst",
        ),
        *((f"server's {stage} [µs]", f"{us:.2f}") for stage, us in s.server_cpu_us.items()),
        ("client, a step [µs]", _value(s.client_cpu_us)),
        ("netem, a packet [µs]", _value(s.netem_cpu_us)),
        (
            "vehicle-steps per core-second",
            _value(s.vehicle_steps_per_core_s, ".0f"),
        ),
    ]
    table = Table(title=title, title_justify="left", show_header=False)
    for name, value in rows:
        if value is not None:
            table.add_row(Text(name), value)  # `Text`, because rich would take "[m]" for markup
    Console().print(table)


def _value(value: float | None, spec: str = ".1f") -> str | None:
    return None if value is None else format(value, spec)
