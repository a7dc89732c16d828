"""A flight over real UDP: server, netem and client as three processes on loopback.

Each process writes its events as JSON on its standard output (`--log json`); they are all that is
known here of what goes on in it. Anything else that it prints, a traceback or its one line for a
mistake, is kept for its last words.

The loop is asyncio's own: uvloop's would start them with signals that are no longer ignored.
"""

import asyncio
import contextlib
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from shared.config import Scenario, to_toml
from shared.endpoint import Address
from shared.events import (
    Counted,
    Event,
    Failure,
    Flying,
    Listening,
    NotFlown,
    RecordIncomplete,
    address_text,
)
from shell.command import INTERRUPTED, CommandError
from shell.log import Line
from shell.workers import die_with_parent
from skytether import keygen

NAMES = ("client", "server", "netem")
"""Names of the processes, and of their parts of the record."""

START_S = 120.0
"""Longest time that a process may take until it listens [s]: it may have to compile first."""
GRACE_S = 30.0
"""Longest time that a flight may take beyond its duration and the time to connect [s]."""
STOP_S = 5.0
"""Longest time that a process may take to end once it is told to [s]."""
POLL_S = 0.2
"""Time after which Ctrl-C is noticed [s]."""
LINES_MAX = 20
"""Number of last lines kept of what a process said, for when it fails."""

OnEvent = Callable[[Event], None]
Shortfall = RecordIncomplete | NotFlown
"""Events of a flight that goes on, and of which there is something to show."""
_DECODER = msgspec.json.Decoder(Line)


@dataclass(slots=True)
class Child:
    """A process that was started, and what it has said."""

    name: str
    process: asyncio.subprocess.Process
    reader: "asyncio.Task[None]" = field(init=False)
    """Task that takes in what it says, until it has said all."""
    said: deque[str] = field(default_factory=lambda: deque(maxlen=LINES_MAX))
    """Last lines, those of events as sentences."""
    address: Address = ("", 0)
    """Address that it listens on."""
    failed: bool = False
    """Whether it has told of something after which it could not fly."""
    fell_short: bool = False
    """Whether it has told of a shortfall, for which it ends with 1."""

    async def end(self) -> int:
        """Exit code, once it has ended and all that it said is known."""
        code = await self.process.wait()
        await asyncio.wait((self.reader,), timeout=STOP_S)
        return code

    def last_words(self) -> str:
        """Why it ended, in its own words."""
        if self.said:
            return self.said[-1]
        code = self.process.returncode
        said = f"does not listen after {START_S:.0f} s" if code is None else f"ended with {code}"
        return f"{self.name}: {said}"


@contextlib.asynccontextmanager
async def started(
    name: str, *arguments: str, on_event: OnEvent = lambda _: None
) -> AsyncIterator[Child]:
    """Start a process that listens; at the end of the block it is told to end, then killed.

    Args:
        name: module to run.
        arguments: its command line, beside `--log json`.
        on_event: called with each of its events.

    Raises:
        CommandError: it ended, or did not come to listen.
    """
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",  # a folder called like one of ours, where the user happens to be, is not ours
        "-m",
        name,
        *arguments,
        "--log",
        "json",
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        # Ctrl-C is for the command alone: it ends its children in order.
        start_new_session=True,
        preexec_fn=die_with_parent,
    )
    child = Child(name, process)
    assert process.stdout is not None
    listening: asyncio.Future[Address] = asyncio.get_running_loop().create_future()

    def hear(event: Event) -> None:
        if isinstance(event, Listening) and not listening.done():
            listening.set_result((event.host, event.port))
        child.fell_short |= isinstance(event, Shortfall)
        child.failed |= isinstance(event, Failure) and not isinstance(event, NotFlown)
        on_event(event)

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
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
            try:
                await asyncio.wait_for(process.wait(), STOP_S)
            except TimeoutError:
                process.kill()
                await process.wait()
        await child.reader


async def _read(child: Child, stream: asyncio.StreamReader, on_event: OnEvent) -> None:
    while True:
        try:
            line = await stream.readline()
        except ValueError:  # longer than the stream has room for
            continue
        if not line:
            return
        try:
            said = _DECODER.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError):  # no event: a traceback, or a mistake
            child.said.append(line.decode(errors="replace").rstrip())
            continue
        if not isinstance(said.event, Counted):  # numbers are no reason for an end
            child.said.extend(f"{said.process}: {said.event}".splitlines())
        on_event(said.event)


def feeds_in(folder: Path) -> dict[str, Path]:
    """Sockets of the feeds in a folder, by the names of the processes, see `run`."""
    return {name: folder / f"{name}.feed" for name in NAMES}


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
    control: Path | None = None,
    feeds: Path | None = None,
) -> list[Shortfall]:
    """Fly a scenario until its end, or Ctrl-C; what was flown until then comes to lie in a folder.

    Whoever calls it has Ctrl-C and SIGTERM under control (`command.interruptible`). Returns what
    the flight or its record fell short of, as the processes tell it; nothing in a good one.

    Args:
        scenario: what to fly.
        parts: the folder, for a record of each process and, as `.json`, its figures.
        on_second: called with the time flown [s], several times a second.
        interrupted: asked several times a second; once it says so, the flight ends in order.
        on_event: called with each event of the processes.
        vehicles: number of vehicles, all in one process.
        workers: number of processes of the server.
        watched: whether server and netem record, too.
        secure: whether the link is sealed, with keys that are made for this flight.
        control: folder for a socket of each process, through which keys change in flight.
        feeds: folder for the feed of each process, called as in `server.feed`; of several workers,
            as in `server.feed.1`.

    Raises:
        CommandError: one of the processes failed, the folder cannot be written to, or it was
            interrupted before the first step.
    """
    file = parts / "scenario.toml"
    try:
        file.write_bytes(to_toml(scenario))
    except OSError as error:
        raise CommandError(f"{file}: cannot be written: {error.strerror}") from None
    if secure:
        keygen.make(parts / "keys", range(1, vehicles + 1))
    keys = ["--keys", str(parts / "keys")] if secure else []
    shortfalls: list[Shortfall] = []
    timeout_s = scenario.duration + scenario.link.connect_s + GRACE_S

    def common(name: str, *, recorded: bool) -> list[str]:
        part = ["--record", str(parts / name)] if recorded else []
        heeds = ["--control", str(control / name)] if control else []
        tells = ["--feed", str(feeds_in(feeds)[name])] if feeds else []
        return [name, str(file), "--json", str(parts / f"{name}.json"), *part, *heeds, *tells]

    fleet = ["--vehicles", str(vehicles)]
    server = [*common("server", recorded=watched), *fleet, *keys, "--workers", str(workers)]
    netem = [*common("netem", recorded=watched), "--flows", str(vehicles)]
    client = [*common("client", recorded=True), *fleet, *keys]

    def hear(event: Event) -> None:
        if isinstance(event, Shortfall):
            shortfalls.append(event)
        on_event(event)

    async def main() -> None:
        flight = asyncio.create_task(
            _fly(server, netem, client, timeout_s=timeout_s, on_second=on_second, on_event=hear)
        )
        while not flight.done() and not interrupted():
            await asyncio.wait((flight,), timeout=POLL_S)
        flight.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await flight

    asyncio.run(main())
    if interrupted() and not (parts / "client.json").exists():
        raise CommandError("interrupted before the first step", INTERRUPTED)
    return shortfalls


async def _fly(
    server_command: Sequence[str],
    netem_command: Sequence[str],
    client_command: Sequence[str],
    *,
    timeout_s: float,
    on_second: Callable[[float], None],
    on_event: OnEvent,
) -> None:
    loop = asyncio.get_running_loop()
    flying_s: float | None = None

    def hear(event: Event) -> None:
        nonlocal flying_s
        if isinstance(event, Flying) and flying_s is None:
            flying_s = loop.time()
        on_event(event)

    anywhere = ("--bind", "127.0.0.1:0")
    async with (
        started(*server_command, *anywhere, on_event=hear) as server,
        started(
            *netem_command, *anywhere, "--server", address_text(*server.address), on_event=hear
        ) as netem,
        started(*client_command, "--server", address_text(*netem.address), on_event=hear) as client,
    ):
        began_s = loop.time()
        ended = [asyncio.create_task(child.end()) for child in (client, netem, server)]
        try:
            while not any(task.done() for task in ended):
                await asyncio.wait(ended, timeout=POLL_S, return_when=asyncio.FIRST_COMPLETED)
                on_second(0.0 if flying_s is None else loop.time() - flying_s)
                if loop.time() - began_s > timeout_s:
                    raise CommandError(f"the flight has not ended in {timeout_s:.0f} s")
        finally:
            for task in ended:
                task.cancel()
        for child in (server, netem, client):
            code = child.process.returncode
            # What it fell short of is told at the end, beside what was flown.
            flown = child is client and (code == 0 or (child.fell_short and not child.failed))
            if code is not None and not flown:
                raise CommandError(child.last_words())
