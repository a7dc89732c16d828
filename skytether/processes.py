"""A flight over real UDP: server, netem and client as three processes on loopback."""

import asyncio
import contextlib
import re
import signal
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared.config import Scenario, to_toml
from shared.endpoint import Address
from shell.command import CommandError
from shell.driver import new_event_loop
from shell.workers import die_with_parent

NAMES = ("client", "server", "netem")
"""Of the processes, and of their parts of the record."""

START_S = 30.0
"""How long a process may take to say what it listens on."""
GRACE_S = 30.0
"""How much longer than planned a flight may take, beside the time to connect."""
STOP_S = 5.0
"""How long it may take to end once it is told to."""
LINES_MAX = 20
"""Last lines kept of what a process said, for when it fails."""

_LISTENING = re.compile(r"listening on (\S+):(\d+),")


@dataclass(slots=True)
class Child:
    """One of the three."""

    name: str
    process: asyncio.subprocess.Process
    said: list[str]
    address: Address = ("", 0)

    def last_words(self) -> str:
        """Why it ended, in its own words."""
        return self.said[-1] if self.said else f"{self.name}: ended with {self.process.returncode}"


@contextlib.asynccontextmanager
async def started(name: str, *arguments: str) -> AsyncIterator[Child]:
    """One process that listens, ended with the block: asked first, then killed.

    Raises:
        CommandError: it ended, or did not come to listen.
    """
    process = await asyncio.create_subprocess_exec(
        # -P: a folder called like one of ours, where the user happens to be, is not ours.
        *(sys.executable, "-P", "-m", name, *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        # Ctrl-C is for the command alone: it ends its children in order.
        start_new_session=True,
        preexec_fn=die_with_parent,
    )
    child = Child(name, process, [])
    assert process.stdout is not None
    listening = asyncio.get_running_loop().create_future()
    reader = asyncio.create_task(_read(child, process.stdout, listening))
    try:
        done, _ = await asyncio.wait(
            (listening, reader), timeout=START_S, return_when=asyncio.FIRST_COMPLETED
        )
        if listening not in done:
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
        await reader


async def _read(
    child: Child, stream: asyncio.StreamReader, listening: asyncio.Future[Address]
) -> None:
    async for line in stream:
        child.said = [*child.said, line.decode(errors="replace").rstrip()][-LINES_MAX:]
        found = _LISTENING.search(child.said[-1])
        if found and not listening.done():
            listening.set_result((found[1], int(found[2])))


def run(
    scenario: Scenario,
    parts: Path,
    *,
    on_second: Callable[[float], None],
    vehicles: int = 1,
    workers: int = 1,
    watched: bool = True,
) -> None:
    """Fly a scenario until its end, or Ctrl-C; what was flown until then comes to lie in a folder.

    Args:
        parts: the folder, for a record of each process and, as `.json`, its figures.
        on_second: called with the time flown [s], several times a second.
        vehicles: how many, all in one process.
        workers: processes of the server.
        watched: whether server and netem record, too.

    Raises:
        CommandError: one of the processes failed.
    """
    file = parts / "scenario.toml"
    file.write_bytes(to_toml(scenario))
    timeout_s = scenario.duration + scenario.link.connect_s + GRACE_S

    def common(name: str, *, recorded: bool) -> tuple[str, ...]:
        part = ("--record", str(parts / name)) if recorded else ()
        return (name, str(file), "--json", str(parts / f"{name}.json"), *part)

    fleet = ("--vehicles", str(vehicles))
    server = (*common("server", recorded=watched), *fleet, "--workers", str(workers))
    netem = (*common("netem", recorded=watched), "--flows", str(vehicles))
    client = (*common("client", recorded=True), *fleet)

    async def main() -> None:
        task = asyncio.current_task()
        assert task is not None
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, task.cancel)
        with contextlib.suppress(asyncio.CancelledError):
            await _fly(server, netem, client, timeout_s, on_second)

    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(main())


async def _fly(
    server_command: Sequence[str],
    netem_command: Sequence[str],
    client_command: Sequence[str],
    timeout_s: float,
    on_second: Callable[[float], None],
) -> None:
    anywhere = ("--bind", "127.0.0.1:0")
    async with (
        started(*server_command, *anywhere) as server,
        started(*netem_command, *anywhere, "--server", _text(server.address)) as netem,
        started(*client_command, "--server", _text(netem.address)) as client,
    ):
        loop = asyncio.get_running_loop()
        began_s, flying_s = loop.time(), None
        ended = [asyncio.create_task(child.process.wait()) for child in (client, netem, server)]
        try:
            while not any(task.done() for task in ended):
                await asyncio.wait(ended, timeout=0.2, return_when=asyncio.FIRST_COMPLETED)
                if flying_s is None and any("flying" in line for line in client.said):
                    flying_s = loop.time()
                on_second(0.0 if flying_s is None else loop.time() - flying_s)
                if loop.time() - began_s > timeout_s:
                    raise CommandError(f"the flight has not ended in {timeout_s:.0f} s")
        finally:
            for task in ended:
                task.cancel()
        for child in (server, netem, client):
            code = child.process.returncode
            if code is not None and (code != 0 or child is not client):
                raise CommandError(child.last_words())


def _text(address: Address) -> str:
    return f"{address[0]}:{address[1]}"
