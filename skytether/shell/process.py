"""One endpoint as a process: its record, its feed and its figures, from start to end."""

import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from socket import socket
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import msgspec
import numpy as np

from skytether.shared.base import files
from skytether.shared.core.change import Running
from skytether.shared.core.endpoint import Address, Endpoint, Form
from skytether.shared.core.events import (
    Counted,
    Event,
    Listening,
    Measured,
    Plaintext,
    address_text,
)
from skytether.shared.core.line import Line
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.scenario import reading
from skytether.shared.telemetry.feed import Opened
from skytether.shared.telemetry.record import RECORDING, Recorder
from skytether.shell import recorder_process
from skytether.shell.command import CONFIGURATION, CommandError, Options, unsealed, write
from skytether.shell.control import controlled
from skytether.shell.driver import Shell, run
from skytether.shell.feed import Feed
from skytether.shell.journal import Journal
from skytether.shell.local import LocalError
from skytether.shell.log import Log, LogFormat
from skytether.shell.memory import MemoryFile
from skytether.shell.recording import RecordFile
from skytether.shell.time_of_day import host_time
from skytether.shell.udp import AddressError, is_loopback

# for type checking alone: they are slow to import, and a process that flies does without
if TYPE_CHECKING:
    from skytether.shell.exporter import Metrics


@contextmanager
def recorded(path: Path, columns: np.dtype[np.void]) -> Iterator[RecordFile]:
    """Record into a file; a disk that fails in flight makes the command fail, but not the flight.

    Raises:
        CommandError: the file cannot be opened; at the end, it does not hold all rows.
    """
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
    """Record into a temporary file; where none can be made, nothing is recorded.

    Raises:
        CommandError: at the end, the file does not hold all rows.
    """
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


def drive(
    process: str,
    endpoint: Endpoint,
    options: Options,
    *,
    bind: Address | socket | None,
    peers: Sequence[Address] = (),
    forms: Sequence[Form] = (),
    waiting_for: str,
    secure: bool | None,
    insecure: bool = False,
    log: LogFormat,
    json: Path | None = None,
    stopwatch: Stopwatch | None = None,
    recording: RecordFile | None = None,
    control: Path | None = None,
    journal: Journal | None = None,
    feed: Feed | None = None,
    metrics: Address | None = None,
    line: Line | None = None,
    is_patient: bool = False,
    memory: MemoryFile | None = None,
    warnings: Sequence[Event] = (),
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Run one endpoint as a process until it has finished or is told to stop.

    Args:
        process: name of the process in its log.
        endpoint: what to run.
        options: its options, with the scenario and its name.
        bind, peers, forms, stopwatch, line, is_patient, memory: see `Shell`.
        waiting_for: the peer whose datagrams it waits for, named to the operator.
        secure: whether it has keys; None for one that only forwards datagrams.
        insecure: whether it may run without keys even where other machines can reach it.
        log: form of its log on stdout.
        json: file for its last figures.
        recording: its recorder, which is waited for at the end.
        control: path of the socket for changes in flight.
        journal: what was set in flight in an earlier run, and will be in this one.
        feed: feed of its rows and events.
        metrics: HTTP address for its figures.
        warnings: warnings for the operator about the scenario.
        ready: called once all checks have passed, before the first datagram is received.

    Raises:
        CommandError: it cannot start, lacks the keys it needs, or a file cannot be written.
    """
    running = journal.running(endpoint) if journal else Running(endpoint, options.config)
    if feed:
        feed.open(opened(process, options.scenario, running, feed))
    with ExitStack() as stack:
        served = stack.enter_context(_served(metrics, process, options))
        try:
            heeds = stack.enter_context(controlled(control, running, journal))
            shell = Shell(
                endpoint,
                bind,
                peers,
                stopwatch,
                forms,
                heeds,
                feed,
                line,
                is_patient=is_patient,
                memory=memory,
            )
        except LocalError as error:
            raise CommandError(f"--control: {error}", CONFIGURATION) from None
        except AddressError as error:
            raise CommandError(str(error)) from None
        if secure is False and not (shell.is_local or insecure):
            raise unsealed(*peers or (shell.address,))
        ready()
        began_s = time.process_time()

        def start() -> None:
            host, port = shell.address
            out.say(Listening(host=host, port=port, waiting_for=waiting_for))
            if secure is False:
                out.say(Plaintext(local=shell.is_local))
            if served:
                host, port = served.address
                out.say(Measured(host=host, port=port, local=is_loopback(served.address)))
            for each in warnings:
                out.say(each)

        def figures() -> dict[str, Any]:
            counted = endpoint.figures() | {
                "cpu_s": time.process_time() - began_s,
                "kernel_drops": shell.kernel_drops(),
                "send_errors": shell.send_errors,
            }
            return counted | ({"feed": feed.figures()} if feed else {})

        def each_second(*, last: bool = False) -> None:
            for source in (recording, memory):
                if source and (news := source.news()):
                    out.say(news)
            out.each_second(last=last)
            _learn_time(endpoint, options)
            if feed or served:
                snapshot = figures()
                if feed:
                    feed.count(snapshot)
                if served:
                    served.take(snapshot)

        with (
            _told_once() as told,
            closing(Log(process, log, feed.say if feed else lambda _: None)) as out,
        ):
            run(
                [shell],
                on_start=start,
                on_event=out.hear,
                on_usr1=lambda: out.say(Counted(figures=figures())),
                on_second=each_second,
            )
            told()
            if recording:
                recording.end()
            each_second(last=True)
            last = figures()
            out.say(Counted(figures=last))
            if json:
                write(json, msgspec.json.encode(last))


def _learn_time(endpoint: Endpoint, options: Options) -> None:
    """Tell an endpoint the time of day, where it is asked for and known."""
    if options.config.link.time_of_day == "host" and (told := host_time()):
        endpoint.learn_time(told.utc_ns, told.error_ns, now_ns=told.now_ns)


@contextmanager
def _served(address: Address | None, process: str, options: Options) -> Iterator["Metrics | None"]:
    """Serve metrics over HTTP for as long as the block takes; none without an address.

    Raises:
        CommandError: the address cannot be listened at.
    """
    if address is None:
        yield None
        return
    from skytether.shell.exporter import Collected, Metrics, MetricsError

    collected = Collected(process, options.scenario, options.config.control.dt)
    try:
        metrics = Metrics(address, collected)
    except MetricsError as error:
        at = address_text(*address)
        raise CommandError(f"--metrics: cannot listen at {at}: {error}", CONFIGURATION) from None
    with closing(metrics):
        yield metrics


def opened(process: str, name: str, running: Running, feed: Feed) -> Callable[[], Opened]:
    """Function that makes the first frame of a feed."""
    wall_ns, time_ns = time.time_ns(), time.monotonic_ns()

    def make() -> Opened:
        return Opened(
            process=process,
            name=name,
            scenario=reading.to_toml(running.scenario).decode(),
            parts=feed.parts,
            wall_ns=wall_ns,
            time_ns=time_ns,
        )

    return make


def part_of(record: Path | None) -> Path | None:
    """File for a part of the record: `record`, unless it names a recording (see `fed`)."""
    return None if record and record.suffix == RECORDING else record


@contextmanager
def fed(
    path: Path | None, record: Path | None, process: str, options: Options, *, secure: bool
) -> Iterator[Feed | None]:
    """Open a feed for as long as the block takes; None where no feed was asked for.

    Args:
        path: path of its socket; None for no readers other than a recorder.
        record: output file; if it is a recording (.mcap), another process writes it from the feed.
        process: name of this process.
        options: its options, with the scenario and its name.
        secure: whether it has keys.

    Raises:
        CommandError: the socket cannot be made, or the recording is incomplete at the end.
    """
    recorded = record if record and not part_of(record) else None
    if path is None and recorded is None:
        yield None
        return
    with ExitStack() as stack:
        at = stack.enter_context(recorder_process.socket_of(path))
        try:
            feed = Feed(at)
        except LocalError as error:
            raise CommandError(f"--feed: {error}", CONFIGURATION) from None
        if recorded is None:
            with closing(feed):
                yield feed
            return
        name, scenario = options.scenario, options.config
        try:
            with (
                recorder_process.recorder(recorded, at, process, name, scenario, secure=secure),
                closing(feed),
            ):
                yield feed
        except recorder_process.RecorderError as error:
            raise CommandError(str(error)) from None


def recorder(
    part: str, columns: np.dtype[np.void], recording: RecordFile | None, feed: Feed | None
) -> Recorder | None:
    """Recorder of a part of the record, for a file, a feed or both; None for neither."""
    if feed is None:
        return recording.recorder if recording else None
    both = recording.recorder if recording else Recorder(columns)
    both.follow(feed.part(part, columns))
    return both


@contextmanager
def _told_once() -> Iterator[Callable[[], None]]:
    """Handle SIGINT and SIGTERM once: after the yielded function was called, later ones are
    ignored.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def ignore() -> None:
        for number in before:
            signal.signal(number, signal.SIG_IGN)

    try:
        yield ignore
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
