"""Flight over real UDP: server, netem and client as processes on loopback.

Each process writes its events as JSON on its standard output (`--log json`). Other output, such as
a traceback or an error message, is kept to report why the process failed. The event loop is
asyncio's own, because uvloop would reset signals that the children must continue to ignore.
"""

import asyncio
import contextlib
import json
import signal
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

import msgspec
import numpy as np

from skytether.cli.page_process import say
from skytether.netem.proxy import merged
from skytether.shared.base import files
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import Failure, Flying, NotFlown, RecordIncomplete, address_text
from skytether.shared.events.processes import Counted, Listening
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.record import (
    PACKET_COLUMNS,
    FlightEvent,
    Record,
    Rows,
    client_columns,
    plan_columns,
    server_columns,
)
from skytether.shell.commandline import plugins
from skytether.shell.commandline.command import INTERRUPTED, CommandError
from skytether.shell.driving.control import NETEMS
from skytether.shell.host import system, temporary
from skytether.shell.processes.log import LogLine, line_of
from skytether.shell.processes.workers import die_with_parent

ANYWHERE = ("--bind", "127.0.0.1:0")
NAMES = ("client", "server", "netem")
"""Names of the processes and of their parts of the record; further paths add `netem 2`, …"""
STANDBY = "server 2"
"""Name of the standby server."""

START_S = 120.0
"""Longest time until a process listens [s]. The process may have to compile kernels first."""
GRACE_S = 30.0
"""Longest time that a flight may take beyond its duration and the time to connect [s]."""
ASKED_S, STOP_S = 3.0, 5.0
"""Longest time for a process to end after the first SIGTERM, and after the second [s]."""
POLL_S = 0.2
"""Interval at which Ctrl-C is checked [s]."""
LINES_MAX = 20
"""Number of a process's last lines that are kept, to be printed if it fails."""

Chain = Sequence[Sequence[Sequence[str]]]
"""Processes in stages, each process as its name and arguments. At the end of an argument,
`{server}` is replaced by the address of the process `server` of an earlier stage."""
OnEvent = Callable[[LogLine], None]
Shortfall = RecordIncomplete | NotFlown
"""Events that do not end a flight; the command reports them at the end."""


@dataclass(slots=True)
class Child:
    """Process that was started, and its newest output."""

    name: str
    process: asyncio.subprocess.Process
    reader: "asyncio.Task[None]" = field(init=False)
    said: deque[str] = field(default_factory=lambda: deque(maxlen=LINES_MAX))
    """Last lines of output, with events as sentences."""
    address: Address = ("", 0)
    failed: bool = False
    """Whether the process has reported an event after which it could not fly."""
    fell_short: bool = False
    """Whether the process has reported a shortfall; its exit code is then 1."""

    async def end(self) -> int:
        """Exit code, once the process has ended and all its output was read."""
        code = await self.process.wait()
        await asyncio.wait((self.reader,), timeout=STOP_S)
        return code

    def last_words(self) -> str:
        """Reason why the process has ended or cannot be used: the signal that ended it, or else the
        last line of its output. Without output: its exit code, or that it does not listen in time.
        """
        code = self.process.returncode
        if code is not None and code < 0:  # a signal ended it, so its last line is not the reason
            return f"{self.name}: ended by a signal: {signal.strsignal(-code)}"
        if self.said:
            return self.said[-1]
        message = f"does not listen after {START_S:.0f} s" if code is None else f"ended with {code}"
        return f"{self.name}: {message}"


@contextlib.asynccontextmanager
async def started(
    name: str, *arguments: str, on_event: OnEvent = lambda _: None
) -> AsyncIterator[Child]:
    """Start a process that listens; at the end of the block it gets SIGTERM, then SIGKILL.

    Args:
        name: process to run: server, netem or client; `netem N` is the netem of path N, and
            `server 2` the standby server.
        arguments: the process's command line, without `--log json`.
        on_event: called with each line of the process's log.

    Raises:
        CommandError: the process ended, or did not listen in time.
    """
    if not system.FORKS:
        flies = "this system can fly in virtual time, with `fly --virtual`"
        raise CommandError(f"flights over UDP need Linux or macOS; {flies}")
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",  # -P: a folder in the user's working directory must not shadow our package.
        "-m",
        f"skytether.{name.partition(' ')[0]}",
        *arguments,
        "--log",
        "json",
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        # Ctrl-C must reach only the command, which ends its children in order.
        start_new_session=True,
        preexec_fn=die_with_parent,
    )
    child = Child(name, process)
    assert process.stdout is not None
    listening: asyncio.Future[Address] = asyncio.get_running_loop().create_future()

    def hear(line: LogLine) -> None:
        event = line.event
        if isinstance(event, Listening) and not listening.done():
            listening.set_result((event.host, event.port))
        child.fell_short |= isinstance(event, Shortfall)
        child.failed |= isinstance(event, Failure) and not isinstance(event, NotFlown)
        on_event(line)

    child.reader = asyncio.create_task(_read(child, process.stdout, hear))
    try:
        done, _ = await asyncio.wait(
            (listening, child.reader), timeout=START_S, return_when=asyncio.FIRST_COMPLETED
        )
        if listening not in done:
            if child.reader in done:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(process.wait(), STOP_S)
            raise CommandError(child.last_words())
        child.address = listening.result()
        yield child
    finally:
        # After a second SIGTERM an endpoint does not wait for its vehicles.
        for stop, most_s in (
            (process.terminate, ASKED_S),
            (process.terminate, STOP_S),
            (process.kill, None),
        ):
            if process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    stop()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(process.wait(), most_s)
        await child.reader


async def _read(child: Child, stream: asyncio.StreamReader, on_event: OnEvent) -> None:
    while True:
        try:
            line = await stream.readline()
        except ValueError:  # a line longer than the stream's limit is skipped
            continue
        if not line:
            return
        logged = line_of(line)
        if logged is None:
            child.said.append(line.decode(errors="replace").rstrip())
            continue
        kind = child.name.partition(" ")[0]
        if logged.process.partition(".")[0] == kind:  # the standby server's log says "server", too
            process = child.name + logged.process.removeprefix(kind)
            logged = msgspec.structs.replace(logged, process=process)
        if not isinstance(logged.event, Counted):  # counters do not say why a process ended
            child.said.extend(f"{logged.process}: {logged.event}".splitlines())
        on_event(logged)


def netems(scenario: Scenario, *, standby: bool = False) -> list[str]:
    """Names of the netems of a scenario's paths, and of the standby server's netem."""
    return list(NETEMS[: len(scenario.paths) + standby])


def feeds_in(folder: Path, scenario: Scenario, *, standby: bool = False) -> dict[str, Path]:
    names = ("client", "server", *[STANDBY] * standby, *netems(scenario, standby=standby))
    return {name: folder / f"{name}.feed" for name in names}


def run(
    scenario: Scenario,
    parts: Path,
    *,
    on_second: Callable[[float], None],
    interrupted: Callable[[], bool],
    on_event: OnEvent = lambda _: None,
    vehicles: int = 1,
    workers: int = 1,
    watched: bool = True,
    secure: bool = False,
    set_parameters: bool = False,
    sockets: Path | None = None,
    standby: bool = False,
) -> list[Shortfall]:
    """Fly a scenario until its end, or Ctrl-C; the processes write their records to a folder.

    The caller must handle Ctrl-C and SIGTERM (`command.interruptible`). Returns the shortfalls of
    the flight or its record that the processes reported; empty for a good flight.

    Args:
        parts: the folder. Each process writes its record there and, as `.json`, its figures.
        on_second: called with the time flown [s], several times a second.
        interrupted: called several times a second; once it returns True, the flight ends in order.
        on_event: called with each line of the processes' logs.
        vehicles: number of vehicles, all in one process.
        workers: number of processes of the server.
        watched: whether server and netem record, too.
        secure: whether the link is encrypted, with keys made for this flight.
        set_parameters: whether the client makes its autopilot's parameters safe.
        sockets: folder for two sockets of each process, such as `server` for changes in flight and
            `server.feed` for the feed; several workers have `server.1`, `server.feed.1` and so on.
        standby: whether there is a standby server, `server 2`, behind a netem of its own. One of
            the two servers may then end during the flight.

    Raises:
        CommandError: one of the processes failed, the folder cannot be written to, or the flight
            was interrupted before the first step.
    """
    file = parts / "scenario.toml"
    try:
        files.write(file, to_toml(scenario))
    except OSError as error:
        raise CommandError(f"{file}: cannot be written: {error.strerror}") from None
    if secure:
        from skytether.cli import keygen  # imported here: importing tyro takes 0.05 s

        keygen.make(parts / "keys", range(1, vehicles + 1))
    keys = ["--keys", str(parts / "keys")] if secure else []
    shortfalls: list[Shortfall] = []
    timeout_s = scenario.duration + scenario.link.connect_s + GRACE_S

    def common(name: str, *, recorded: bool) -> list[str]:
        # `skytether fly` always begins a new flight, so no client continues an earlier one.
        arguments = ["--json", str(parts / f"{name}.json"), "--new-flight"]
        if recorded:
            arguments += ["--record", str(parts / name)]
        if sockets:
            arguments += ["--control", str(sockets / name)]
            arguments += ["--feed", str(sockets / f"{name}.feed")]
        return [name, str(file), *arguments, *plugins.flags()]

    fleet = ["--vehicles", str(vehicles)]
    names = ["server", *[STANDBY] * standby]
    servers = [
        [*common(name, recorded=watched), *fleet, *keys, "--workers", str(workers), *ANYWHERE]
        for name in names
    ]
    paths = [
        [*common(name, recorded=watched), "--path", str(number), "--flows", str(vehicles)]
        for number, name in enumerate(netems(scenario, standby=standby), start=1)
    ]
    leads_to = ["server"] * len(scenario.paths) + [STANDBY] * standby
    client = [*common("client", recorded=True), *fleet, *keys]
    client += ["--set-parameters"] * set_parameters
    several = len(scenario.paths) > 1
    client += [
        f"--path=127.0.0.1={{{name}}}" if several else f"--server={{{name}}}"
        for name in netems(scenario)
    ]
    client += [f"--standby={{{paths[-1][0]}}}"] * standby

    def hear(line: LogLine) -> None:
        if isinstance(line.event, Shortfall):
            shortfalls.append(line.event)
        on_event(line)

    relays = [
        [*netem, *ANYWHERE, f"--server={{{server}}}"]
        for netem, server in zip(paths, leads_to, strict=True)
    ]
    chain = [servers, relays, [client]]

    async def main() -> None:
        flight = asyncio.create_task(_fly(chain, names, timeout_s, on_second, hear))
        while not flight.done() and not interrupted():
            await asyncio.wait((flight,), timeout=POLL_S)
        flight.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await flight

    asyncio.run(main())
    client_figures = parts / "client.json"  # empty until the client ends
    if interrupted() and not (client_figures.exists() and client_figures.stat().st_size):
        raise CommandError("interrupted before the first step", INTERRUPTED)
    return shortfalls


def flown(scenario: Scenario, fly: Callable[[Scenario, Path], list[Shortfall]]) -> Record:
    """Fly with `fly`, such as `partial(run, workers=2)`, and return the record of the flight."""
    with temporary.folder() as parts:
        return record_of(parts, scenario, fly(scenario, parts))


def record_of(
    parts: Path, scenario: Scenario, shortfalls: Sequence[Shortfall], said: Sequence[LogLine] = ()
) -> Record:
    """Record of a flight, from its processes' files. Time 0 is the processes' first event.

    Args:
        parts: see `run`.
        shortfalls: return value of `run`.
        said: lines of the processes' logs, in any order.
    """
    axes = scenario.model.axes
    said = sorted(said, key=attrgetter("time_ns"))
    standby = (parts / STANDBY).exists()
    names = netems(scenario, standby=standby)
    netem = np.concatenate([_rows(parts / name, PACKET_COLUMNS) for name in names])
    zero_ns = said[0].time_ns if said else 0
    netem["arrived_ns"] -= zero_ns
    counted = {
        path.name.replace(".json", ""): path.read_bytes()
        for path in parts.glob("*.json*")
        if ".part" not in path.name  # a partial file of a process that was killed while writing
    }
    figures = {name: json.loads(text) for name, text in counted.items() if text}
    server = _rows(parts / "server", server_columns(axes, scenario.control.scheme))
    if standby:
        server = np.concatenate([server, _rows(parts / STANDBY, server.dtype)])
        server = server[np.argsort(server["step"], kind="stable")]
    if paths := [figures.pop(name) for name in names if name in figures]:
        figures["netem"] = merged(paths)
    return Record(
        client=_rows(parts / "client", client_columns(axes)),
        server=server,
        netem=netem,
        failure=next((each for each in shortfalls if isinstance(each, NotFlown)), None),
        figures=figures,
        events=tuple(
            FlightEvent(each.time_ns - zero_ns, each.process, each.event) for each in said
        ),
        incomplete=tuple(each for each in shortfalls if not isinstance(each, NotFlown)),
        plan=np.empty(0, plan_columns(axes, scenario.control.horizon)),
    )


def _rows(part: Path, columns: np.dtype[np.void]) -> Rows:
    """Rows of a part of the record; empty if the file is missing or has no header."""
    try:
        return read(part)
    except (ValueError, FileNotFoundError):
        return np.empty(0, columns)


def _with_address(argument: str, addresses: Mapping[str, str]) -> str:
    """Argument of a `Chain`, with an address in place of the name at its end."""
    head, brace, name = argument.removesuffix("}").rpartition("{")
    return head + addresses[name] if brace and name in addresses else argument


async def _fly(
    chain: Chain,
    spares: Collection[str],
    timeout_s: float,
    on_second: Callable[[float], None],
    on_event: OnEvent,
) -> None:
    """Run processes, each connected to those of earlier stages, until the client's flight ends.

    Args:
        spares: names of processes; all but one of them may end during the flight.
        timeout_s: longest time that the processes run [s].
        on_second, on_event: see `run`.

    Raises:
        CommandError: a process failed, or the time ran out.
    """
    loop = asyncio.get_running_loop()
    flying_s: float | None = None

    def hear(line: LogLine) -> None:
        nonlocal flying_s
        if isinstance(line.event, Flying) and flying_s is None:
            flying_s = loop.time()
        on_event(line)

    async with contextlib.AsyncExitStack() as stack:
        children: list[Child] = []
        for stage in chain:
            addresses = {child.name: address_text(*child.address) for child in children}
            for name, *argv in stage:
                flags = [_with_address(argument, addresses) for argument in argv]
                starting = started(name, *flags, on_event=hear)
                children.append(await stack.enter_async_context(starting))
        began_s = loop.time()
        ended = {child.name: asyncio.create_task(child.end()) for child in children}
        try:
            while not any(task.done() for task in ended.values()):
                await asyncio.wait(
                    ended.values(), timeout=POLL_S, return_when=asyncio.FIRST_COMPLETED
                )
                for child in children:
                    is_spare = child.name in spares and len(ended.keys() & {*spares}) > 1
                    if is_spare and child.name in ended and ended[child.name].done():
                        del ended[child.name]
                        say(f"{child.last_words()}; the flight goes on without {child.name}")
                on_second(0.0 if flying_s is None else loop.time() - flying_s)
                if loop.time() - (flying_s or began_s) > timeout_s:
                    raise CommandError(f"the flight has not ended in {timeout_s:.0f} s")
        finally:
            for task in ended.values():
                task.cancel()
        for child in (each for each in children if each.name in ended):
            code = child.process.returncode
            # Shortfalls are reported at the end, together with the flight's summary.
            has_flown = child.name == "client" and (
                code == 0 or (child.fell_short and not child.failed)
            )
            if code is not None and not has_flown:
                raise CommandError(child.last_words())
