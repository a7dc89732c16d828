"""Scenarios, commands and shells for several rooms of tests."""

import asyncio
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from skytether.__main__ import main
from skytether.shared.base import kernel
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.flight import Fault
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shell.driving.driver import Shell

LOOPBACK: Address = ("127.0.0.1", 0)
SKYTETHER = (sys.executable, "-P", "-m", "skytether")
"""Command line prefix, as a user starts a command."""
PATIENCE_S = 180.0
"""Time within which what a test waits for must come [s]: machines are busy."""


def packaged(name: str, *layers: Mapping[str, Any], **changes: Any) -> Scenario:
    """Packaged scenario with other keys.

    Args:
        layers: tables laid over the scenario in order; a section keeps the keys that its layer does
            not name.
        changes: the last layer.

    Raises:
        ConfigError: the result is no scenario.
    """
    table = reading.to_table(reading.load(name))
    for layer in (*layers, changes):
        for key, value in layer.items():
            table[key] = table[key] | value if isinstance(value, dict) else value
    return reading.check(table, "test")


def demo_with(**keys: Any) -> Scenario:
    """Scenario `demo-committed` with some keys changed: `control__dt=0.1` is `control.dt`."""
    table = reading.to_table(reading.load("demo-committed"))
    set_keys({key.replace("__", "."): value for key, value in keys.items()}, table)
    return reading.check(table, "test")


def refusal(run: Callable[[], object]) -> str:
    """Message of the ConfigError that a call raises."""
    with pytest.raises(ConfigError) as caught:
        run()
    return str(caught.value)


def refused(argv: Sequence[str], capfd: pytest.CaptureFixture[str]) -> str:
    """Line with which a command is refused."""
    assert main([*argv]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    return line


def refused_before_writing(
    argv: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> str:
    """Line with which a command is refused before it writes into `folder`."""
    out = folder / "out"
    assert main([*argv, "--out", str(out)]) == 2
    assert not out.exists()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said.rstrip("\n")


def ran(*argv: object, **keys: Any) -> "subprocess.CompletedProcess[str]":
    line = [str(each) for each in argv]
    done: subprocess.CompletedProcess[str] = subprocess.run(
        line, capture_output=True, text=True, check=False, **keys
    )
    return done


def until(holds: Callable[[], object], within_s: float = PATIENCE_S) -> None:
    """Wait until a condition holds; fail after `within_s` [s]."""
    deadline_s = time.monotonic() + within_s
    while not holds():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


@contextmanager
def without_painting() -> Iterator[None]:
    """Save no figure: painting one takes a second or two."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
        yield


@contextmanager
def interpreted() -> Iterator[None]:
    """Clients run as plain Python, as aboard, until the end of the block."""
    kernel.interpret_all()
    try:
        yield
    finally:
        kernel.compile_all()


class Idle(Endpoint):
    """Endpoint that ignores datagrams and is never woken; subclasses may override that."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """See `Endpoint`."""

    def wake(self, *, now_ns: int) -> None:
        """See `Endpoint`."""

    def next_wake_ns(self) -> int | None:
        return None


class HandLoop:
    """Stand-in for an event loop: time passes and sockets are read only when a test says so."""

    def __init__(self) -> None:
        self.reads: Callable[[], None] | None = None
        self.writes: dict[socket.socket, Callable[[], None]] = {}
        self.later: list[tuple[float, Callable[[], None]]] = []

    def add_reader(self, _: socket.socket, read: Callable[[], None]) -> None:
        self.reads = read

    def remove_reader(self, _: socket.socket) -> None:
        self.reads = None

    def add_writer(self, sock: socket.socket, write: Callable[[Any], None], reader: Any) -> None:
        self.writes[sock] = lambda: write(reader)

    def remove_writer(self, sock: socket.socket) -> None:
        del self.writes[sock]

    def call_later(self, delay_s: float, then: Callable[[], None]) -> "HandLoop":
        self.later.append((delay_s, then))
        return self

    def cancel(self) -> None:
        """Like asyncio's `TimerHandle`."""

    def pass_time(self) -> None:
        """Run the callbacks that are due later."""
        later, self.later = self.later, []
        for _, then in later:
            then()

    def look(self) -> bool:
        """Read the sockets with a reader; returns whether there is one."""
        if self.reads is None:
            return False
        self.reads()
        return True


@asynccontextmanager
async def driven(*shells: Shell) -> AsyncIterator[None]:
    """Shells that run in this loop until the end of the block."""
    tasks = [asyncio.create_task(each.run()) for each in shells]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def faults(flight: Record) -> list[str]:
    """Last lines of the tracebacks that a flight reported."""
    events = (each.event for each in flight.events)
    return [each.traceback.splitlines()[-1] for each in events if isinstance(each, Fault)]


@contextmanager
def echo(host: str = "127.0.0.1") -> Iterator[int]:
    """Port of a UDP server on this machine that sends back what it hears."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as server:
        server.bind((host, 0))

        def answer() -> None:
            while True:
                data, peer = server.recvfrom(65536)
                if data == b"end":
                    return
                server.sendto(data, peer)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        server.sendto(b"end", server.getsockname()[:2])
        thread.join(PATIENCE_S)
