"""Commands: what all of them have in common, from arguments to the one line for a mistake.

A command's options are a dataclass with a field `scenario` for the name and a field `config` for
the scenario itself, whose every key is a flag: the file comes first, flags lie over it.
"""

import ipaddress
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from errno import EMFILE
from inspect import cleandoc
from pathlib import Path
from socket import socket
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Protocol, TypeVar, cast

import msgspec
import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from shared import config
from shared.change import Running
from shared.config import ConfigError, Scenario
from shared.endpoint import Address, Endpoint, Form
from shared.events import Counted, Listening, Measured, Plaintext, address_text
from shared.feed import Opened
from shared.record import Recorder
from shared.stopwatch import Stopwatch
from shared.summary import Summary
from shell.control import controlled
from shell.driver import Shell, run
from shell.feed import Feed
from shell.local import LocalError
from shell.log import Log, LogFormat
from shell.recording import Recording
from shell.udp import SPARE_FILES, AddressError, allow_sockets, files_max, sockets_max

if TYPE_CHECKING:  # it takes a while to import, and is rarely wanted
    from shell.metrics import Metrics

CONFIGURATION, RUN, INTERRUPTED = 2, 1, 128 + signal.SIGINT
"""Exit codes: what the command asked for is impossible, something went wrong on the way, or it was
ended by Ctrl-C."""
OUTPUTS = ("json", "figure", "record")
"""Options of all commands that name a file to write."""

ScenarioName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")]
ScenarioFlags = Annotated[Scenario, tyro.conf.arg(name="")]


class CommandError(Exception):
    """What ends a command: one line for the user, and the exit code."""

    def __init__(self, message: str, code: int = RUN) -> None:
        super().__init__(message)
        self.code = code


class Options(Protocol):
    """The options of a command that is about a scenario."""

    @property
    def scenario(self) -> str:
        """Name or file of the scenario."""

    @property
    def config(self) -> Scenario:
        """The scenario."""


T = TypeVar("T")
O = TypeVar("O", bound=Options)  # noqa: E741 - the options of one command


def read(default: T, argv: Sequence[str], prog: str, help_: str | None) -> T:
    """Options of a command line, laid over others; `help_` says what the command does.

    Raises:
        SystemExit: tyro has shown the help, or what is wrong with a flag.
    """
    about = cleandoc(help_ or "")
    return tyro.cli(type(default), args=argv, default=default, prog=prog, description=about)


def parse(defaults: O, argv: Sequence[str], prog: str, help_: str | None) -> O:
    """Parse a command line; returns its options, laid over the scenario it names.

    Raises:
        CommandError: a file that it is to write cannot be written.
        ConfigError: the scenario cannot be flown.
        SystemExit: tyro has shown the help, or what is wrong with a flag.
    """
    name = argv[0] if argv and not argv[0].startswith("-") else defaults.scenario
    while True:
        default = replace(defaults, scenario=name, config=config.load(name))  # type: ignore[type-var]
        options = read(default, argv, prog, help_)
        if options.scenario == name:
            break
        name = options.scenario
    checked = config.check(config.to_table(options.config), f"{name} and the command line")
    for option in OUTPUTS:
        check_output(f"--{option}", getattr(options, option, None))
    return replace(options, config=checked)  # type: ignore[type-var]


def address(flag: str, text: str) -> Address:
    """Address that a flag was given as HOST:PORT, with an IPv6 host in brackets.

    Raises:
        CommandError: it is none.
    """
    host, _, port = text.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    host = host[1:-1] if bracketed else host
    if not (
        host
        and bracketed == (":" in host)
        and (not bracketed or _is_ipv6(host))
        and (port.isascii() and port.isdigit() and int(port) < 65536)
    ):
        expected = "expected HOST:PORT, or [HOST]:PORT where HOST is an IPv6 address"
        raise CommandError(f"{flag}: got {text!r}, {expected}", CONFIGURATION)
    return host, int(port)


def optional_address(flag: str, text: str | None) -> Address | None:
    """Address that a flag was given, see `address`; None where it was given none."""
    return None if text is None else address(flag, text)


def _is_ipv6(host: str) -> bool:
    try:
        ipaddress.IPv6Address(host)
    except ValueError:
        return False
    return True


def check_count(flag: str, given: int, most: int) -> None:
    """Refuse a number of things that is less than 1 or more than `most`.

    Raises:
        CommandError: with the flag, what it was given and what was expected.
    """
    if not 1 <= given <= most:
        raise CommandError(f"{flag}: got {given}, expected 1 to {most}", CONFIGURATION)


def check_sockets(flag: str, given: int) -> None:
    """Let this process open a socket for each of so many things.

    Raises:
        CommandError: the system does not allow as many.
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
        try:
            path.open("xb").close()
        except FileExistsError:
            if path.is_file() or path.is_dir():  # opening a pipe would wait for its reader
                path.open("ab").close()
        else:
            path.unlink()
    except OSError as error:
        said = f"{flag}: {path}: cannot be written: {error.strerror}"
        raise CommandError(said, CONFIGURATION) from None


@contextmanager
def recorded(path: Path, columns: np.dtype[np.void]) -> Iterator[Recording]:
    """Record into a file; a disk that fails in flight ends the command, but not the flight.

    Raises:
        CommandError: the file cannot be opened; at the end, it does not hold all rows.
    """
    try:
        file = path.open("w+b", buffering=0)
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}", CONFIGURATION) from None
    yield from _until_the_end(Recording(str(path), columns, file))


@contextmanager
def recorded_meanwhile(columns: np.dtype[np.void]) -> Iterator[Recording]:
    """Record into a temporary file; where there can be none, nothing is recorded.

    Raises:
        CommandError: at the end, the file does not hold all rows.
    """
    file: BinaryIO | OSError
    try:
        temporary = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - the recording closes it
        file = cast(BinaryIO, temporary)
    except OSError as error:
        file = error
    yield from _until_the_end(Recording("temporary record", columns, file))


def _until_the_end(recording: Recording) -> Iterator[Recording]:
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
    recording: Recording | None = None,
    control: Path | None = None,
    feed: Feed | None = None,
    metrics: Address | None = None,
) -> None:
    """Run one endpoint as a process until it has finished or is told to stop.

    Args:
        process: name of the process in its log.
        endpoint: what to run.
        options: its options: what it flies, and the name of that.
        bind, peers, forms, stopwatch: see `Shell`.
        waiting_for: whose datagrams it waits for, for the operator.
        secure: whether it has keys; None of one that only passes on what others say.
        insecure: whether it may do without keys even where other machines are reached.
        log: form of its log on stdout.
        json: file for its last figures.
        recording: where it records; waited for at the end.
        control: where the socket for changes in flight is made.
        feed: where it tells what is recorded and said.
        metrics: where its figures are served over HTTP.

    Raises:
        CommandError: it cannot start, must not without keys, or the file cannot be written.
    """
    running = Running(endpoint, options.config)
    if feed:
        feed.open(opened(process, options.scenario, running, feed))
    with ExitStack() as stack:
        served = stack.enter_context(_served(metrics, process, options))
        try:
            heeds = stack.enter_context(controlled(control, running))
            shell = Shell(endpoint, bind, peers, stopwatch, forms, heeds, feed)
        except LocalError as error:
            raise CommandError(f"--control: {error}", CONFIGURATION) from None
        except AddressError as error:
            raise CommandError(str(error)) from None
        if secure is False and not (shell.is_local or insecure):
            at = ", ".join(address_text(*peer) for peer in peers) or address_text(*shell.address)
            expected = "expected --keys FILE (see skytether keygen), or --insecure"
            said = f"{at} is not on this machine alone, and there are no keys: {expected}"
            raise CommandError(said, CONFIGURATION)
        began_s = time.process_time()

        def start() -> None:
            host, port = shell.address
            out.say(Listening(host=host, port=port, waiting_for=waiting_for))
            if secure is False:
                out.say(Plaintext(local=shell.is_local))
            if served:
                host, port = served.address
                out.say(Measured(host=host, port=port))

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
    """Serve metrics for as long as the block takes; none without an address.

    Raises:
        CommandError: nothing can listen there.
    """
    if address is None:
        yield None
        return
    from shell.metrics import Collected, Metrics, MetricsError

    collected = Collected(process, options.scenario, options.config.control.dt)
    try:
        metrics = Metrics(address, collected)
    except MetricsError as error:
        at = address_text(*address)
        raise CommandError(f"--metrics: cannot listen at {at}: {error}", CONFIGURATION) from None
    with closing(metrics):
        yield metrics


def opened(process: str, name: str, running: Running, feed: Feed) -> Callable[[], Opened]:
    """What makes the first frame of a feed."""
    wall_ns, time_ns = time.time_ns(), time.monotonic_ns()

    def make() -> Opened:
        return Opened(
            process=process,
            name=name,
            scenario=config.to_toml(running.scenario).decode(),
            parts=feed.parts,
            wall_ns=wall_ns,
            time_ns=time_ns,
        )

    return make


@contextmanager
def fed(path: Path | None) -> Iterator[Feed | None]:
    """Have a feed for as long as the block takes; none without a path.

    Raises:
        CommandError: its socket cannot be made.
    """
    if path is None:
        yield None
        return
    try:
        feed = Feed(path)
    except LocalError as error:
        raise CommandError(f"--feed: {error}", CONFIGURATION) from None
    with closing(feed):
        yield feed


def recorder(
    part: str, columns: np.dtype[np.void], recording: Recording | None, feed: Feed | None
) -> Recorder | None:
    """Recorder of a part of the record, for a file, a feed or both; None where there is neither."""
    if feed is None:
        return recording.recorder if recording else None
    both = recording.recorder if recording else Recorder(columns)
    both.follow(feed.part(part, columns))
    return both


@contextmanager
def _told_once() -> Iterator[Callable[[], None]]:
    """Heed SIGINT and SIGTERM once: from the call of what is yielded on, an end takes its time."""
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
        """Show how much is done, in the bar's unit, and what to say of it."""


@contextmanager
def progress(title: str, total: float, unit: str = "s") -> Iterator[Bar]:
    """A bar on stderr: title, how much of the total is done, and the time remaining.

    It vanishes at the end, and is not shown where stderr is no terminal, or one that cannot move
    its cursor. What is printed on stderr meanwhile is shown above the bar.
    """
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} " + unit),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}", markup=False),
        console=console,
        transient=True,
        speed_estimate_period=600.0,  # a step may take minutes
        disable=not console.is_interactive,
    ) as shown:
        row = shown.add_task(title, total=total, text="")

        def show(done: float, text: str = "") -> None:
            shown.update(row, completed=min(done, total), text=text)

        yield show


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C, or SIGTERM, end work in order; yields what tells whether one has come."""
    interrupted = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: interrupted.set()) for number in numbers]
    try:
        yield interrupted.is_set
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def main(command: Callable[[Sequence[str]], None], argv: Sequence[str] | None, prog: str) -> int:
    """Run a command, with one line on stderr for what went wrong; returns its exit code."""
    try:
        try:
            command(sys.argv[1:] if argv is None else argv)
        finally:
            sys.stdout.flush()
    except CommandError as error:
        return _refuse(prog, str(error), error.code)
    except ConfigError as error:
        return _refuse(prog, str(error), CONFIGURATION)
    except KeyboardInterrupt:  # before there was anything to end in order
        return INTERRUPTED
    except OSError as error:  # the machine's: a full disk, too few open files, a broken pipe
        gone = isinstance(error, BrokenPipeError)  # whoever read our output has seen enough
        with suppress(OSError):
            sys.stdout.flush()
            return RUN if gone else _refuse(prog, _reason(error), RUN)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return RUN if gone else _refuse(prog, _reason(error), RUN)
    return 0


def _refuse(prog: str, message: str, code: int) -> int:
    """Say what went wrong in one line, whatever stands in it; returns the exit code."""
    shown = (
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in f"{prog}: {message}"
    )
    print("".join(shown), file=sys.stderr)
    return code


def _reason(error: OSError) -> str:
    """What the system has against it, and where."""
    where = f"{error.filename}: " if error.filename else ""
    allowed = f"; {files_max()} may be open here (ulimit -n)" if error.errno == EMFILE else ""
    return f"{where}{error.strerror or error}{allowed}"


def show(table: Table) -> None:
    """Print a table in full width: a number cut off would be worse than a line too long."""
    Console(width=max(Console().width, Console(width=1000).measure(table).maximum)).print(table)


def finish(summary: Summary, title: str, json: Path | None = None) -> None:
    """Print a summary as a table, and write it to a file.

    Raises:
        CommandError: the file cannot be written.
    """
    if json is not None:  # first: whoever was to read the table may be gone
        write(json, msgspec.json.encode(summary))
    table = Table(title=title, title_justify="left", show_header=False)
    for row in summary_rows(summary):
        table.add_row(*map(Text, row))  # as text: "[m]" would be markup
    Console().print(table)


def write(path: Path, json: bytes) -> None:
    """Write a file of indented JSON.

    Raises:
        CommandError: it cannot be written.
    """
    try:
        path.write_bytes(msgspec.json.format(json, indent=2) + b"\n")
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}") from None


def summary_rows(summary: Summary) -> list[tuple[str, str]]:
    """Names and values of what a summary knows, as a table shows them."""
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
        ("uplink packets, bytes", _values("d", s.uplink_packets, s.uplink_bytes)),
        ("downlink packets, bytes", _values("d", s.downlink_packets, s.downlink_bytes)),
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


def _values(spec: str, *values: float | None) -> str:
    return ", ".join(format(value, spec) for value in values if value is not None)
