"""`skytether fly`: one flight, over real UDP or in virtual time, and its summary."""

import os
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec

from skytether.cli import page_process, processes
from skytether.client import vehicles
from skytether.server.schemes import loading
from skytether.shared.base import machine_code
from skytether.shared.base.errors import ConfigError
from skytether.shared.events.flight import (
    Changed,
    ChangeRefused,
    Event,
    Fault,
    ModeChanged,
    PlanningStopped,
    RecordIncomplete,
    ReferenceTooFast,
)
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.shared.wire.protocol import Idle, Mode
from skytether.shell.commandline import command, plugins, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioOptions
from skytether.shell.commandline.plugins import Plugin
from skytether.shell.host import system, temporary
from skytether.shell.host.web import HOST_PORT
from skytether.shell.processes import pool
from skytether.sim import flight

UNSEEN = Fault, ReferenceTooFast
"""Events of a flight in virtual time that are printed after the flight."""
PRINTED = (
    *(ModeChanged, PlanningStopped, RecordIncomplete, Changed, ChangeRefused),
    *UNSEEN,
)
"""Events that are printed during the flight."""
PRINTED_OF_ROOMS = ("LeaderChanged",)
"""Names of further printed events; their packages need not be installed."""
POLL_S = 0.2
"""Interval at which Ctrl-C is checked while the page stays open [s]."""
Flown = tuple[Scenario, "Future[Record]"]
"""Scenario of --beside, and a future with the record of its flight, flown in another process."""
ON_THE_GROUND = {str(mode) for mode in (Mode.INIT, Mode.SYNC, Mode.READY)}
"""Modes before the first plan is flown; changes between them are not printed."""


@dataclass(frozen=True)
class FlyOptions(ScenarioOptions):
    secure: bool = False
    """Encrypt and authenticate the link, with keys made for this flight. Without --secure, packets
    on loopback are plaintext."""
    standby: bool = False
    """Fly with a standby server, which takes over when the first server is silent. Two more
    processes are started, `server 2` and its netem. The flight goes on if one server ends.
    """
    virtual: bool = False
    """Fly in virtual time: the same code runs in one process, many times faster, reproducibly."""
    set_parameters: bool = False
    """Set the autopilot's parameters to values that are safe if set-points stop. Without
    --set-parameters, unsafe values are only reported, and the vehicle is not armed.
    """
    control: Path | None = None
    """Folder for the control sockets server, netem and client (with --standby also `server 2` and
    `netem 2`), for `skytether set`; created if necessary. Not in virtual time.
    """
    page: str | None = None
    """HOST:PORT of the page that shows and controls the flight, by default SKYTETHER_PAGE or
    127.0.0.1:8080; if the port is taken, the next free port. Visitors from other machines need the
    printed token to change anything. Not in virtual time: see `skytether replay`.
    """
    no_page: bool = False
    """Fly without a page."""
    linger: bool = False
    """Keep the page open after the flight, until Ctrl-C."""
    json: Path | None = None
    """File for the summary of the flight."""
    figure: Path | None = None
    """File for a picture of the flight (.png, .pdf or .svg)."""
    record: Path | None = None
    """File for a recording of the flight (.mcap): all rows and events of its processes, written
    during the flight. See `skytether report`, `replay` and `export`; Foxglove and Lichtblick can
    show the file.
    """
    beside: Annotated[tuple[str, ...], Argument(metavar="SCENARIO", append=True)] = ()
    """Scenario to compare with, flown in virtual time with the same duration and seed; may be
    repeated.
    """


def fly(argv: Sequence[str]) -> None:
    """Fly a scenario: server, netem and client as processes on loopback, or in virtual time.

    Ctrl-C ends the flight and still shows the results so far.
    """
    options = command.parse(FlyOptions(), argv, "skytether fly", fly.__doc__)
    scenario = options.config
    if options.figure:
        from skytether.figures import flights as figures

        figures.check(options.figure)
    if options.record:
        from skytether.cli import recorder

        recorder.check(options.record)
    if options.virtual and (options.linger or options.page not in (None, "none")):
        flag = "--linger" if options.linger else "--page"
        expected = "expected a flight in real time; `skytether replay` shows a --record"
        raise CommandError(f"{flag}: got --virtual as well, {expected}", command.CONFIGURATION)
    if options.control:
        _make_folder(options.control, virtual=options.virtual)
    beside = _beside(options)
    where = "in virtual time" if options.virtual else "over UDP on loopback"
    title = f"{options.scenario}, {where}, seed {scenario.seed}"
    if not options.virtual:
        for warning in command.flight_warnings(scenario):
            page_process.say(warning)
    # Compiles the vehicle's kernels; if the vehicle cannot be made, no process is started.
    vehicles.make(scenario, 0)
    at = options.page or os.environ.get(page_process.VARIABLE, HOST_PORT)
    page = None if options.virtual or options.no_page else at
    with page_process.paged(page, options.control) as sockets:
        together = [scenario, *beside.values()]
        missing = machine_code.missing(loading.others(*together))
        terminal.prepare(missing, sockets)
        with _flying(beside.values()) as others:
            with (
                command.interruptible() as interrupted,
                terminal.progress(f"flying {title}", scenario.duration) as on_second,
            ):
                if options.virtual:
                    flown, unrecorded = _virtually(options, on_second, interrupted)
                else:
                    flown, unrecorded = _really(options, sockets, on_second, interrupted)
            _show(options, title, flown, unrecorded, dict(zip(beside, others, strict=True)))
        if options.linger and sockets:
            with command.interruptible() as interrupted:
                while not interrupted():
                    time.sleep(POLL_S)


@contextmanager
def _flying(scenarios: Collection[Scenario]) -> Iterator[list[Flown]]:
    """Fly scenarios in virtual time, in a process that runs during the block."""
    if not scenarios:
        yield []
        return
    with pool.processes(1, polite=True) as worker:
        plugged = plugins.loaded()
        with system.blocked(signal.SIGINT):  # Ctrl-C ends this process, which ends the worker
            flying = [(each, worker.submit(_fly_beside, plugged, each)) for each in scenarios]
        try:
            yield flying
        except BrokenExecutor:
            raise CommandError("--beside: the process that flew the scenario has died") from None


def _fly_beside(plugged: tuple[Plugin, ...], scenario: Scenario) -> Record:
    plugins.use(plugged)
    return flight.fly(scenario)


def _show(
    options: FlyOptions,
    title: str,
    flown: Record,
    unrecorded: str | None,
    beside: Mapping[str, Flown],
) -> None:
    """Print the flight's summary, and write its picture."""
    scenario = options.config
    if flown.failure and not len(flown.client):
        raise CommandError(str(flown.failure))
    if flown.incomplete:
        title += ", as far as it is recorded"
    if not len(flown.client):
        missing = _missing(scenario, flown)
        code = command.RUN if missing else command.INTERRUPTED
        raise CommandError(missing or "interrupted before the first step", code)
    summary = _summarise(scenario, options.scenario, flown, secure=options.secure)
    flights, summaries = {title: (scenario, flown)}, []
    for name, (other, flying) in beside.items():
        flights[f"{name}, in virtual time, seed {other.seed}"] = other, flying.result()
        summaries.append(_summarise(other, name, flying.result()))
    if beside and not options.virtual:
        title += "; others in virtual time"
    terminal.finish(summary, title, options.json, summaries)
    if options.figure:
        from skytether.figures import flights as figures

        figures.flights(options.figure, flights)
    if missing := _missing(scenario, flown) or unrecorded:
        raise CommandError(missing)
    if flown.failure:
        raise CommandError(str(flown.failure))
    command.refuse_errors(summary.plugin_errors)


def _make_folder(folder: Path, *, virtual: bool) -> None:
    if virtual:
        message = "--control: got --virtual as well, expected a flight in real time"
        raise CommandError(message, command.CONFIGURATION)
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        message = f"--control: {folder}: cannot be created: {error.strerror}"
        raise CommandError(message, command.CONFIGURATION) from None


def _beside(options: FlyOptions) -> dict[str, Scenario]:
    same = {key: getattr(options.config, key) for key in ("duration", "seed", "settle")}
    try:
        scenarios = {
            name: msgspec.structs.replace(reading.load_base(name), **same)
            for name in options.beside
        }
        return {
            name: reading.check(reading.to_table(each), name) for name, each in scenarios.items()
        }
    except ConfigError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None


def _summarise(scenario: Scenario, name: str, flown: Record, *, secure: bool = False) -> Summary:
    parts = flown.client, flown.server, flown.netem
    return summarise(scenario, name, *parts, figures=flown.figures, secure=secure)


def _virtually(
    options: FlyOptions, on_second: Callable[[float], None], interrupted: Callable[[], bool]
) -> tuple[Record, str | None]:
    """Fly in virtual time. Returns the flight, and the error of its recording or None."""
    scenario, secure = options.config, options.secure
    flown = flight.fly(
        scenario,
        secure=secure,
        standby=options.standby,
        on_second=on_second,
        stopped=interrupted,
    )
    for line in flown.events:
        if isinstance(line.event, UNSEEN):
            _tell(line.event)
    if options.record is None:
        return flown, None
    from skytether.cli import recorder

    name = options.scenario
    summary = _summarise(scenario, name, flown, secure=secure)
    return flown, recorder.write(options.record, scenario, name, flown, summary)


def _really(
    options: FlyOptions,
    sockets: Path | None,
    on_second: Callable[[float], None],
    interrupted: Callable[[], bool],
) -> tuple[Record, str | None]:
    """Fly over UDP. Returns the flight, and the error of its recording or None."""
    scenario, name, secure = options.config, options.scenario, options.secure
    with ExitStack() as stack:
        live = None
        if options.record:
            from skytether.cli import recorder

            sockets = sockets or stack.enter_context(temporary.folder())
            feeds = processes.feeds_in(sockets, scenario, standby=options.standby)
            live = recorder.Live(options.record, feeds, scenario, name, secure=secure, tell=_tell)
            stack.callback(live.finish)
        run = partial(
            processes.run,
            on_second=on_second,
            interrupted=interrupted,
            on_event=lambda line: _tell(line.event),
            secure=secure,
            set_parameters=options.set_parameters,
            sockets=sockets,
            standby=options.standby,
        )
        flown = processes.flown(scenario, run)
        if live is None:
            return flown, None
        summary = _summarise(scenario, name, flown, secure=secure) if len(flown.client) else None
        return flown, live.finish(summary, flown)


def _missing(scenario: Scenario, flown: Record) -> str | None:
    """Sentence about rows that could not be recorded; None if the record is complete."""
    if not flown.incomplete:
        return None
    reasons = "; ".join(f"{part.file}: {part.reason}" for part in flown.incomplete)
    steps = flown.client["step"][-1] + 1 if len(flown.client) else 0
    recorded_s = steps * scenario.control.dt
    return f"{reasons}: recorded up to {recorded_s:g} of {scenario.duration:g} s"


def _tell(event: Event) -> None:
    """Print events of the link and of the record above the progress bar."""
    begins = isinstance(event, ModeChanged) and event.before in ON_THE_GROUND
    stands_by = isinstance(event, PlanningStopped) and event.why == str(Idle.OTHER_SERVER)
    is_printed = isinstance(event, PRINTED) or type(event).__name__ in PRINTED_OF_ROOMS
    if is_printed and not (begins or stands_by):
        page_process.say(event)
