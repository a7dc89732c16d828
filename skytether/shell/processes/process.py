"""Process of one endpoint, with record, feed and counters, from start to end."""

import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from socket import socket
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import msgspec
import numpy as np

from skytether.shared.base import extras, files
from skytether.shared.endpoints.change import Running
from skytether.shared.endpoints.endpoint import Address, Endpoint, Form
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.flight import Event, address_text
from skytether.shared.events.processes import Counted, Listening, Measured, Plaintext
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import RECORDING, Recorder
from skytether.shell.commandline import command
from skytether.shell.commandline.command import (
    CONFIGURATION,
    CommandError,
    ScenarioOptions,
    unsealed,
    write,
)
from skytether.shell.driving.driver import Shell, run
from skytether.shell.driving.recording import RecordFile
from skytether.shell.host.paths import NetworkPath
from skytether.shell.host.udp import AddressError, is_loopback
from skytether.shell.processes.log import Log, LogFormat

# for type checking only: slow to import, and not needed in flight
if TYPE_CHECKING:
    from skytether.shared.telemetry.feed import Opened
    from skytether.shell.driving.control import Control
    from skytether.shell.driving.driver import AnyLine
    from skytether.shell.driving.feed import Feed
    from skytether.shell.driving.journal import Journal
    from skytether.shell.driving.memory import MemoryFile
    from skytether.shell.host.time_of_day import TimeTeller
    from skytether.shell.processes.exporter import Metrics


@dataclass(frozen=True)
class ProcessOptions(ScenarioOptions):
    log: LogFormat = "text"
    """Format in which each event is printed: a sentence, or a line of JSON for a program."""
    record: Path | None = None
    """File for the process's part of the record; a name that ends in .mcap makes a recording with
    its rows and events, see `skytether join`.
    """
    json: Path | None = None
    """File for the process's counters and its CPU time, as JSON."""
    control: Path | None = None
    """Unix socket to create, through which keys change in flight, see `skytether set`."""
    new_flight: bool = False
    """Begin a new flight: discard values that were set in an earlier run, which are stored beside
    the socket of --control. Give this flag by hand; never put it into the command of a service.
    """
    feed: Path | None = None
    """Unix socket to create, at which other programs read the rows and events of this process."""
    metrics: str | None = None
    """HTTP address for Prometheus metrics and /healthz, HOST:PORT."""


@contextmanager
def recorded(path: Path, columns: np.dtype[np.void]) -> Iterator[RecordFile]:
    """Record to a file; if the disk fails in flight, the flight goes on and the command fails."""
    try:
        growing = files.Growing(path, buffering=0)
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}", CONFIGURATION) from None
    recording = RecordFile(str(growing.at), columns, growing.file)
    try:
        yield from _until_the_end(recording)
    finally:
        growing.end(empty=recording.is_empty, whole=recording.fault() is None)


@contextmanager
def recorded_meanwhile(columns: np.dtype[np.void]) -> Iterator[RecordFile]:
    """Record to a temporary file; if it cannot be created, nothing is recorded."""
    file: BinaryIO | OSError
    try:
        temporary = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - the recording closes it
        file = cast(BinaryIO, temporary)
    except OSError as error:
        file = error
    yield from _until_the_end(RecordFile("temporary record", columns, file))


def _until_the_end(recording: RecordFile) -> Iterator[RecordFile]:
    with closing(recording):
        yield recording
        recording.end()
    if fault := recording.fault():
        raise CommandError(fault)


@dataclass(slots=True)
class Process:
    name: str
    options: ProcessOptions
    secure: bool | None
    """Whether the endpoint has keys; None for netem, which only forwards datagrams."""
    scenario: Scenario
    journal: "Journal | None"
    warnings: list[Event]
    recording: RecordFile | None
    """File of the endpoint's rows. The process ends only after all rows are written."""
    feed: "Feed | None"
    recorder: Recorder | None
    """Recorder of the endpoint's rows, for a file, a feed or both; None without file and feed."""

    def fed(self, part: str, columns: np.dtype[np.void]) -> Recorder | None:
        """Recorder of a further part of the record, for the feed only; None without a feed."""
        return _followed(Recorder(columns), self.feed, part, columns) if self.feed else None

    def _watched(self, endpoint: Endpoint, line: int | None) -> Endpoint:
        """Endpoint that also records the packets of `endpoint` in the feed, if there is a feed."""
        if self.feed is None or self.secure is None:
            return endpoint
        from skytether.shared.telemetry import ends  # imported only with a feed
        from skytether.shell.driving.ends import Watched

        end = ends.End.CLIENT if self.name == "client" else ends.End.SERVER
        recorder = _followed(Recorder(ends.COLUMNS), self.feed, ends.PART, ends.COLUMNS)
        return Watched(endpoint, end, recorder, line)

    def _log(self, *, to_stderr: bool) -> Log:
        beside: Callable[[Event], None] = self.feed.say if self.feed else lambda _: None
        return Log(self.name, self.options.log, beside, to_stderr=to_stderr)

    def _running(self, endpoint: Endpoint) -> Running:
        """Running endpoint with its scenario, for changes in flight."""
        if journal := self.journal:
            from skytether.shell.processes.preloading import preload

            preload(endpoint.changeable)
            return journal.running(endpoint)
        return Running(endpoint, self.options.config)

    def drive(
        self,
        endpoint: Endpoint,
        *,
        bind: list[Address | socket] | Address | None,
        waiting_for: str,
        paths: Mapping[int, NetworkPath] = MappingProxyType({}),
        peers: Sequence[Address] = (),
        forms: Sequence[Form] = (),
        insecure: bool = False,
        stopwatch: Stopwatch | None = None,
        line: "AnyLine | None" = None,
        is_patient: bool = False,
        memory: "MemoryFile | None" = None,
        ready: Callable[[], None] = lambda: None,
        on_signal: Callable[[int], None] | None = None,
    ) -> None:
        """Run an endpoint until it has finished or is stopped.

        Args:
            bind, paths, peers, forms, stopwatch, line, is_patient, memory: see `Shell`.
            waiting_for: name of the peer whose datagrams the endpoint waits for, for the log.
            insecure: whether to run without keys at an address that other machines can reach.
            ready: called after all checks, before the first datagram is received.
            on_signal: called with the number of a signal that is to be passed on to another
                program, which uses the stdout of this process. If it is given, events are printed
                on stderr, and the final counters go only to the feed and the `--json` file.
        """
        options, feed, journal = self.options, self.feed, self.journal
        endpoint = self._watched(endpoint, None if line is None else 1)  # socket 1 is the line
        clocks = [_clock(endpoint)] if options.config.link.time_of_day == "host" else []
        running = self._running(endpoint)
        if feed:
            feed.open(opened(self.name, options.scenario, running, feed))
        with ExitStack() as stack:
            about = self.name, options.scenario, options.config.control.dt
            served = stack.enter_context(serving(options.metrics, *about))
            try:
                heeds = stack.enter_context(_controlled(options.control, running, journal))
                shell = Shell(
                    endpoint,
                    bind,
                    peers,
                    stopwatch,
                    forms,
                    heeds,
                    feed,
                    line,
                    paths=paths,
                    is_patient=is_patient,
                    memory=memory,
                )
            except AddressError as error:
                raise CommandError(str(error)) from None
            if self.secure is False and not (shell.is_local or insecure):
                to = dict.fromkeys(path.peer for path in paths.values()) or shell.addresses.values()
                raise unsealed(*to)
            ready()
            began_s = time.process_time()

            def start() -> None:
                for host, port in shell.addresses.values():
                    out.say(Listening(host=host, port=port, waiting_for=waiting_for))
                if self.secure is False:
                    out.say(Plaintext(local=shell.is_local))
                if served:
                    host, port = served.address
                    out.say(Measured(host=host, port=port, local=is_loopback(served.address)))
                for each in self.warnings:
                    out.say(each)

            def figures() -> dict[str, Any]:
                counted = endpoint.figures() | {
                    "cpu_s": time.process_time() - began_s,
                    "kernel_drops": shell.kernel_drops(),
                    "send_errors": shell.send_errors,
                }
                return counted | ({"feed": feed.figures()} if feed else {})

            def each_second(*, last: bool = False) -> None:
                for source in (self.recording, memory, *clocks):
                    if source and (news := source.news()):
                        out.say(news)
                out.each_second(last=last)
                snapshot = figures() if feed or served else {}
                if feed:
                    feed.count(snapshot)
                if served:
                    served.take(snapshot)

            with (
                _handling_signals() as ignore_signals,
                closing(self._log(to_stderr=bool(on_signal))) as out,
            ):
                run(
                    [shell],
                    on_start=start,
                    on_event=out.hear,
                    on_usr1=lambda: out.say(Counted(figures=figures())),
                    on_second=each_second,
                    on_signal=on_signal,
                )
                ignore_signals()
                if self.recording:
                    self.recording.end()
                each_second(last=True)
                last = figures()
                (out.note if on_signal else out.say)(Counted(figures=last))
                if options.json:
                    write(options.json, msgspec.json.encode(last))


@contextmanager
def begin(
    name: str,
    options: ProcessOptions,
    columns: np.dtype[np.void],
    *,
    secure: bool | None,
    number: int = 0,
    warnings: Sequence[Event] = (),
    keeps_rows: bool = False,
) -> Iterator[Process]:
    """Restore values set in an earlier run, and open record and feed during the block.

    Args:
        name, options, secure, warnings: see `Process`.
        columns: columns of the endpoint's rows.
        number: number of a worker, which is appended to its name; 0 for a single process.
        keeps_rows: whether rows go to a temporary file if no record is asked for.

    Raises:
        CommandError: a file or socket cannot be created, or the record is incomplete at the end.
    """
    journal, scenario, recalled = _journal(options)
    file = None if options.record and options.record.suffix == RECORDING else options.record
    with ExitStack() as stack:
        recording = None
        if file:
            recording = stack.enter_context(recorded(file, columns))
        elif keeps_rows:
            recording = stack.enter_context(recorded_meanwhile(columns))
        feed = stack.enter_context(_fed(name, options, secure=bool(secure)))
        recorder = recording.recorder if recording else None
        if feed:
            part = name.partition(" ")[0]
            recorder = _followed(recorder or Recorder(columns), feed, part, columns)
        yield Process(
            f"{name}.{number}" if number else name,
            options,
            secure,
            scenario,
            journal,
            [*warnings, *recalled],
            recording,
            feed,
            recorder,
        )


def _journal(options: ProcessOptions) -> "tuple[Journal | None, Scenario, Sequence[Event]]":
    """Journal beside the control socket, and the scenario with the values restored from it."""
    if options.control is None:
        return None, options.config, []
    from skytether.shell.driving.journal import take_up

    return take_up(options.control, options.config, new_flight=options.new_flight)


@contextmanager
def _controlled(
    path: Path | None, running: Running, journal: "Journal | None"
) -> "Iterator[Control | None]":
    if path is None:
        yield None
        return
    from skytether.shell.driving.control import controlled
    from skytether.shell.host.local import LocalError

    with ExitStack() as stack:
        try:
            control = stack.enter_context(controlled(path, running, journal))
        except LocalError as error:
            raise CommandError(f"--control: {error}", CONFIGURATION) from None
        yield control


def _clock(endpoint: Endpoint) -> "TimeTeller":
    from skytether.shell.host.time_of_day import TimeTeller

    return TimeTeller(endpoint)


def _followed(recorder: Recorder, feed: "Feed", part: str, columns: np.dtype[np.void]) -> Recorder:
    recorder.follow(feed.part(part, columns))
    return recorder


@contextmanager
def serving(at: str | None, *about: Any) -> Iterator["Metrics | None"]:
    """Serve metrics of `Collected(*about)` at HOST:PORT in the block; yields None without `at`."""
    if at is None:
        yield None
        return
    address = command.address("--metrics", at)
    from skytether.shell.processes.exporter import Collected, Metrics, MetricsError

    try:
        metrics = Metrics(address, Collected(*about))
    except MetricsError as error:
        at = address_text(*address)
        raise CommandError(f"--metrics: cannot listen at {at}: {error}", CONFIGURATION) from None
    with closing(metrics):
        yield metrics


def opened(process: str, name: str, running: Running, feed: "Feed") -> "Callable[[], Opened]":
    from skytether.shared.telemetry.feed import Opened

    wall_ns, time_ns = time.time_ns(), time.monotonic_ns()
    return lambda: Opened(
        process=process,
        name=name,
        scenario=reading.to_toml(running.scenario).decode(),
        parts=feed.parts,
        directions=running.endpoint.directions,
        wall_ns=wall_ns,
        time_ns=time_ns,
    )


@contextmanager
def _fed(process: str, options: ProcessOptions, *, secure: bool) -> "Iterator[Feed | None]":
    """Open a feed during the block; None if neither a feed nor a recording is requested.

    A recording (.mcap) is written from the feed by another process.
    """
    record = options.record if options.record and options.record.suffix == RECORDING else None
    if not (options.feed or record):
        yield None
        return
    from skytether.shell.driving.feed import Feed
    from skytether.shell.host.local import LocalError
    from skytether.shell.processes import recorder_process

    if record:
        extras.need("record")
    with ExitStack() as stack:
        at = stack.enter_context(recorder_process.socket_of(options.feed))
        try:
            feed = Feed(at)
        except LocalError as error:
            raise CommandError(f"--feed: {error}", CONFIGURATION) from None
        try:
            if record:
                arguments = record, at, process, options.scenario, options.config
                stack.enter_context(recorder_process.recorder(*arguments, secure=secure))
            stack.enter_context(closing(feed))
            yield feed
            stack.close()
        except recorder_process.RecorderError as error:
            raise CommandError(str(error)) from None


@contextmanager
def _handling_signals() -> Iterator[Callable[[], None]]:
    """Handle SIGINT and SIGTERM until the yielded function is called; then ignore them."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def ignore() -> None:
        for number in before:
            signal.signal(number, signal.SIG_IGN)

    try:
        yield ignore
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
