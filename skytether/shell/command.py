"""Common parts of all commands, from arguments to the one line that reports an error.

A command's options are a dataclass with a field `scenario` for the name and a field `config` for
the scenario itself, whose every key is a flag: the file comes first, flags lie over it.
"""

import os
import signal
import sys
import tempfile
import threading
import time
from argparse import ArgumentError, ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from errno import EMFILE
from pathlib import Path
from socket import socket
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Protocol, TypeVar, cast

import msgspec
import numpy as np

from skytether.shared.base import extras, files
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.extras import ExtraMissing
from skytether.shared.core.change import Running
from skytether.shared.core.endpoint import Address, Endpoint, Form
from skytether.shared.core.events import (
    Counted,
    Event,
    Listening,
    Measured,
    NoFailsafe,
    Plaintext,
    address_text,
)
from skytether.shared.core.line import HOST_PORT, Line, parse_address
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.feed import Opened
from skytether.shared.telemetry.record import RECORDING, Recorder
from skytether.shared.telemetry.summary import Summary
from skytether.shell import beside, plugins
from skytether.shell.control import controlled
from skytether.shell.driver import Shell, run
from skytether.shell.feed import Feed
from skytether.shell.local import LocalError
from skytether.shell.log import Log, LogFormat
from skytether.shell.options import Argument, read
from skytether.shell.recording import RecordFile
from skytether.shell.udp import (
    SPARE_FILES,
    AddressError,
    allow_sockets,
    files_max,
    is_loopback,
    look_up,
    sockets_max,
)

# for type checking alone: they are slow to import, and a process that flies does without
if TYPE_CHECKING:
    from rich.table import Table

    from skytether.shell.exporter import Metrics

CONFIGURATION, RUN, INTERRUPTED = 2, 1, 128 + signal.SIGINT
"""Exit codes: 2 the request is impossible, 1 something failed on the way, 130 ended by Ctrl-C."""
OUTPUTS = ("json", "figure", "record")
"""Options of all commands that name a file to write."""

ScenarioName = Annotated[str, Argument(metavar="SCENARIO", positional=True)]
ScenarioFlags = Annotated[Scenario, Argument(name="")]
Plugins = Annotated[
    tuple[Path, ...],
    Argument(
        metavar="FILE",
        append=True,
        help="Python file with triggers or references of one's own; may come several times. See "
        "`skytether triggers` and `skytether references`.",
    ),
]


class CommandError(Exception):
    """Error that ends a command: one line for the user, and the exit code."""

    def __init__(self, message: str, code: int = RUN) -> None:
        super().__init__(message)
        self.code = code


class Options(Protocol):
    """Options of a command that is about a scenario."""

    @property
    def scenario(self) -> str:
        """Name or file of the scenario."""

    @property
    def config(self) -> Scenario:
        """The scenario."""


T = TypeVar("T")
O = TypeVar("O", bound=Options)  # noqa: E741 - the options of one command


def parse(
    defaults: O, argv: Sequence[str], prog: str, help_: str | None, *, leads: bool = True
) -> O:
    """Parse a command line; returns its options, laid over the scenario it names.

    Args:
        defaults: options where nothing is given.
        argv: arguments of the command.
        prog: its name.
        help_: what it does.
        leads: whether an argument without a flag, at the front, is the scenario's name.

    Raises:
        CommandError: an output file cannot be written.
        ConfigError: the scenario cannot be flown, or a plug-in cannot be imported.
        SystemExit: tyro has shown the help, or what is wrong with a flag.
    """
    plugins.load(plugins.named(argv))
    named = leads and argv and not argv[0].startswith("-")
    name = argv[0] if named else defaults.scenario
    argv, directions = _directions(argv)
    while True:
        config = reading.with_directions(reading.load(name), directions)
        default = replace(defaults, scenario=name, config=config)  # type: ignore[type-var]
        options = read(default, argv, prog, help_)
        if options.scenario == name:
            break
        name = options.scenario
    checked = reading.check(reading.to_table(options.config), f"{name} and the command line")
    for option in OUTPUTS:
        check_output(f"--{option}", getattr(options, option, None))
    return replace(options, config=checked)  # type: ignore[type-var]


def _directions(argv: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Command line without network directions given as texts, and these directions."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for way in reading.DIRECTIONS:
        parser.add_argument(f"--network.{way}", dest=way)
    try:
        found, rest = parser.parse_known_args(list(argv))
    except ArgumentError as error:
        raise CommandError(f"{error.argument_name}: expected a text", CONFIGURATION) from None
    return rest, {way: text for way, text in vars(found).items() if text is not None}


def address(flag: str, text: str) -> Address:
    """Address given to a flag as HOST:PORT, with an IPv6 host in brackets.

    Raises:
        CommandError: the text is no address.
    """
    found = parse_address(text)
    if found is None:
        raise CommandError(f"{flag}: got {text!r}, expected {HOST_PORT}", CONFIGURATION)
    return found


def flight_warnings(scenario: Scenario) -> list[Event]:
    """Warnings for the operator before a scenario is flown."""
    return [NoFailsafe()] if scenario.vehicle.exhausted == "hold" else []


def optional_address(flag: str, text: str | None) -> Address | None:
    """Address given to a flag, see `address`; None where the flag was given none."""
    return None if text is None else address(flag, text)


def check_count(flag: str, given: int, most: int) -> None:
    """Refuse a count that is less than 1 or more than `most`.

    Raises:
        CommandError: with the flag, its value and what was expected.
    """
    if not 1 <= given <= most:
        raise CommandError(f"{flag}: got {given}, expected 1 to {most}", CONFIGURATION)


def check_sealed(bind: Address, *, secure: bool) -> None:
    """Refuse to run without keys at an address that other machines can reach.

    Raises:
        CommandError: with the options that would be accepted.
    """
    with suppress(OSError):  # an unusable address is reported when the socket is bound
        if not (secure or is_loopback(look_up(bind))):
            raise _unsealed(bind)


def _unsealed(*addresses: Address) -> CommandError:
    at = ", ".join(address_text(*address) for address in addresses)
    expected = "expected --keys FILE (see skytether keygen), or --insecure"
    said = f"{at}: other machines can reach it and there are no keys, {expected}"
    return CommandError(said, CONFIGURATION)


def check_sockets(flag: str, given: int) -> None:
    """Let this process open so many sockets.

    Raises:
        CommandError: the system does not allow as many open files.
    """
    most = sockets_max()
    if given > most:
        needed = f"got {given}, which takes {given + SPARE_FILES} open files"
        allowed = f"expected at most {max(most, 0)}, for {files_max()} may be open here (ulimit -n)"
        raise CommandError(f"{flag}: {needed}; {allowed}", CONFIGURATION)
    allow_sockets(given)


def check_output(flag: str, path: Path | None) -> None:
    """Refuse a file that cannot be written, before anything is flown for it.

    Raises:
        CommandError: with the system's reason.
    """
    if path is None:
        return
    try:
        files.check(path)
        try:
            path.open("xb").close()
        except FileExistsError:
            path.open("ab").close()
        else:
            path.unlink()
    except OSError as error:
        said = f"{flag}: {path}: cannot be written: {error.strerror}"
        raise CommandError(said, CONFIGURATION) from None


@contextmanager
def recorded(path: Path, columns: np.dtype[np.void]) -> Iterator[RecordFile]:
    """Record into a file; a disk that fails in flight makes the command fail, but not the flight.

    Raises:
        CommandError: the file cannot be opened; at the end, it does not hold all rows.
    """
    try:
        file = files.create(path, buffering=0)
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}", CONFIGURATION) from None
    yield from _until_the_end(RecordFile(str(path), columns, file))


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
    feed: Feed | None = None,
    metrics: Address | None = None,
    line: Line | None = None,
    warnings: Sequence[Event] = (),
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Run one endpoint as a process until it has finished or is told to stop.

    Args:
        process: name of the process in its log.
        endpoint: what to run.
        options: its options, with the scenario and its name.
        bind, peers, forms, stopwatch, line: see `Shell`.
        waiting_for: the peer whose datagrams it waits for, named to the operator.
        secure: whether it has keys; None for one that only forwards datagrams.
        insecure: whether it may run without keys even where other machines can reach it.
        log: form of its log on stdout.
        json: file for its last figures.
        recording: its recorder, which is waited for at the end.
        control: path of the socket for changes in flight.
        feed: feed of its rows and events.
        metrics: HTTP address for its figures.
        warnings: warnings for the operator about the scenario.
        ready: called once all checks have passed, before the first datagram is received.

    Raises:
        CommandError: it cannot start, lacks the keys it needs, or a file cannot be written.
    """
    running = Running(endpoint, options.config)
    if feed:
        feed.open(opened(process, options.scenario, running, feed))
    with ExitStack() as stack:
        served = stack.enter_context(_served(metrics, process, options))
        try:
            heeds = stack.enter_context(controlled(control, running))
            shell = Shell(endpoint, bind, peers, stopwatch, forms, heeds, feed, line)
        except LocalError as error:
            raise CommandError(f"--control: {error}", CONFIGURATION) from None
        except AddressError as error:
            raise CommandError(str(error)) from None
        if secure is False and not (shell.is_local or insecure):
            raise _unsealed(*peers or (shell.address,))
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
            if recording and (news := recording.news()):
                out.say(news)
            out.each_second(last=last)
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
        at = stack.enter_context(beside.socket_of(path))
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
                beside.recorder(recorded, at, process, name, scenario, secure=secure),
                closing(feed),
            ):
                yield feed
        except beside.RecorderError as error:
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


class Bar(Protocol):
    """A progress bar."""

    def __call__(self, done: float, text: str = "") -> None:
        """Set how much is done, in the bar's unit, and a remark."""


@contextmanager
def progress(title: str, total: float, unit: str = "s") -> Iterator[Bar]:
    """Progress bar on stderr: title, how much of the total is done, and the time remaining.

    The bar vanishes at the end. It is not shown where stderr is no terminal, or a terminal that
    cannot move its cursor. Lines printed on stderr meanwhile appear above the bar.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} " + unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}", markup=False),
        console=console,
        transient=True,
        speed_estimate_period=600.0,  # one step may take minutes: the clock must go on meanwhile
        disable=not console.is_interactive,
    ) as shown:
        row = shown.add_task(title, total=total, text="")

        def show(done: float, text: str = "") -> None:
            shown.update(row, completed=min(done, total), text=text)

        yield show


def prepare(kernels: Sequence[Callable[[], None]]) -> None:
    """Compile the kernels that this machine has not compiled yet, with a note on stderr.

    Args:
        kernels: functions that compile one kernel each, from the server's `missing`.
    """
    if not kernels:
        return
    title = "compiling the control loops, once on this machine"
    print(f"{title}: it takes up to a minute", file=sys.stderr, flush=True)
    with progress(title, len(kernels), "kernels") as bar:
        for done, compile_one in enumerate(kernels):
            bar(done)
            compile_one()


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C or SIGTERM end work in order; yields a function that tells whether one has
    come.
    """
    interrupted = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: interrupted.set()) for number in numbers]
    try:
        yield interrupted.is_set
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def main(command: Callable[[Sequence[str]], None], argv: Sequence[str] | None, prog: str) -> int:
    """Run a command, with one line on stderr if it fails; returns its exit code."""
    try:
        try:
            with extras.named():
                command(sys.argv[1:] if argv is None else argv)
        finally:
            sys.stdout.flush()
    except CommandError as error:
        return _refuse(prog, str(error), error.code)
    except (ConfigError, ExtraMissing) as error:
        return _refuse(prog, str(error), CONFIGURATION)
    except KeyboardInterrupt:  # Ctrl-C before `interruptible` was entered
        return INTERRUPTED
    # a fault of the machine: a full disk, too few open files, a broken pipe
    except OSError as error:
        # the reader of our output has closed it, as `head` does
        gone = isinstance(error, BrokenPipeError)
        with suppress(OSError):
            sys.stdout.flush()
            return RUN if gone else _refuse(prog, _reason(error), RUN)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return RUN if gone else _refuse(prog, _reason(error), RUN)
    return 0


def _refuse(prog: str, message: str, code: int) -> int:
    """Print an error as a single line, whatever characters are in it; returns the exit code."""
    shown = (
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in f"{prog}: {message}"
    )
    print("".join(shown), file=sys.stderr)
    return code


def _reason(error: OSError) -> str:
    """Text of a system's error, and the file it is about."""
    where = f"{error.filename}: " if error.filename else ""
    allowed = f"; {files_max()} may be open here (ulimit -n)" if error.errno == EMFILE else ""
    return f"{where}{error.strerror or error}{allowed}"


def show(table: "Table") -> None:
    """Print a table in full width: a number cut off would be worse than a line too long."""
    from rich.console import Console

    Console(width=max(Console().width, Console(width=1000).measure(table).maximum)).print(table)


def finish(summary: Summary, title: str, json: Path | None = None) -> None:
    """Print a summary as a table, and write it to a file.

    Raises:
        CommandError: the file cannot be written.
    """
    # The file comes first: the table's reader may be gone, and printing then fails.
    if json is not None:
        write(json, msgspec.json.encode(summary))
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", show_header=False)
    for row in summary_rows(summary):
        table.add_row(*map(Text, row))  # Rendered as text: rich would take "[m]" for markup.
    Console().print(table)


def write(path: Path, json: bytes) -> None:
    """Write a file of indented JSON.

    Raises:
        CommandError: the file cannot be written.
    """
    try:
        files.write(path, msgspec.json.format(json, indent=2) + b"\n")
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}") from None


def summary_rows(summary: Summary) -> list[tuple[str, str]]:
    """Names and values of a summary's known figures, for a table."""
    s = summary
    ages = _values(".3f", s.aoi_s_mean, s.aoi_s_peak, s.plan_age_s_mean)
    rows = [
        ("steps", f"{s.steps} in {s.duration_s:g} s"),
        ("RMSE x, y, xy [m]", _values(".4f", s.rmse_x, s.rmse_y, s.rmse_xy)),
        ("RMSE z [m]", _values(".4f", s.rmse_z)),
        ("largest error [m]", _values(".4f", s.error_max)),
        ("error of the estimate [m]", _values(".4f", s.estimate_error_m)),
        ("steps with a planned input", _values(".3f", s.covered)),
        ("modes [s]", ", ".join(f"{mode} {seconds:g}" for mode, seconds in s.modes.items())),
        ("event ratio", _values(".3f", s.event_ratio)),
        ("uplink horizons, other packets", _values("d", *_uplink(s))),
        ("uplink packets, bytes", _values("d", s.uplink_packets, s.uplink_bytes)),
        ("downlink packets, bytes", _values("d", s.downlink_packets, s.downlink_bytes)),
        (
            "packets/s up, down, both",
            _values(".2f", s.uplink_packets_per_s, s.downlink_packets_per_s, s.packets_per_s),
        ),
        (
            "bytes/s with headers up, down, both",
            _values(".0f", s.uplink_bytes_per_s, s.downlink_bytes_per_s, s.bytes_per_s),
        ),
        ("lost, reordered packets", _values("d", s.lost, s.reordered)),
        ("stale packets", _values("d", s.stale)),
        ("link", "sealed" if s.secure else "plaintext"),
        ("age p50, p99 [ms]", _values(".0f", s.age_ms_p50, s.age_ms_p99)),
        ("mean age, its peaks, age of the plan [s]", ages),
        ("effort [m/s], share of steps at a bound", _values(".3f", s.effort_mps, s.saturated)),
        ("solve p50, p99 [ms]", _values(".2f", s.solve_ms_p50, s.solve_ms_p99)),
        ("deadline misses", _values("d", s.deadline_misses)),
    ]
    return [(name, values) for name, values in rows if values]


def _uplink(s: Summary) -> tuple[int, ...]:
    """Numbers of horizons and of other packets sent up, where both are known."""
    if s.uplink_horizons is None or s.uplink_packets is None:
        return ()
    return s.uplink_horizons, max(0, s.uplink_packets - s.uplink_horizons)


def _values(spec: str, *values: float | None) -> str:
    return ", ".join(format(value, spec) for value in values if value is not None)
