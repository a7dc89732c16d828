"""Processes of a flight as child processes, which can be killed, stopped and monitored."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from skytether.shared.base import files
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import Event, address_text
from skytether.shared.events.processes import Counted, Listening
from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire import keys
from skytether.shell.processes.log import LogLine, line_of
from skytether.shell.processes.workers import die_with_parent

HOST = "127.0.0.1"
PATIENCE_S = 60.0
"""Longest time to wait for an event of a process [s]; it may have to compile first."""


class ChildProcess:
    """A process of a flight, from its start to its end.

    Args:
        stack: kills the process when the stack closes.
        name: module to run: server, netem or client.
        arguments: its arguments, besides `--log json`.
    """

    def __init__(self, stack: ExitStack, name: str, *arguments: str) -> None:
        self.name = name
        # -P: a folder in the user's working directory must not shadow our package.
        command = [sys.executable, "-P", "-m", f"skytether.{name}", *arguments, "--log", "json"]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            preexec_fn=die_with_parent,  # noqa: PLW1509 - one call of the kernel, which takes no lock
        )
        stack.callback(self.kill)
        self.lines: list[LogLine] = []
        self.words: list[str] = []
        """Lines of output that are not events."""
        self._heard = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as output:
            for text in output:
                line = line_of(text)
                if line is None:
                    self.words.append(text.decode(errors="replace").rstrip())
                    continue
                with self._heard:
                    self.lines.append(line)
                    self._heard.notify_all()

    def wait_for(self, kind: type[Event], count: int = 1) -> LogLine:
        """Wait for the event number `count` of a kind, and return its log line.

        Raises:
            TimeoutError: the event has not come; the message contains the process's last output.
        """
        with self._heard:
            if not self._heard.wait_for(lambda: len(self.all(kind)) >= count, PATIENCE_S):
                output = [*self.words, *(str(line.event) for line in self.lines)][-3:]
                raise TimeoutError(f"{self.name}: no event {kind.__name__}; its output: {output}")
            return self.all(kind)[count - 1]

    def all(self, kind: type[Event]) -> list[LogLine]:
        return [line for line in self.lines if isinstance(line.event, kind)]

    @property
    def address(self) -> Address:
        """Address that the process listens on; waits for it."""
        event = self.wait_for(Listening).event
        assert isinstance(event, Listening)
        return event.host, event.port

    def listening_ns(self) -> int:
        """Time since which the process has listened [ns; CLOCK_MONOTONIC]; waits for it."""
        return self.wait_for(Listening).time_ns

    def figures(self) -> dict[str, Any]:
        """Figures of the process, requested by SIGUSR1."""
        count = len(self.all(Counted)) + 1
        self.process.send_signal(signal.SIGUSR1)
        event = self.wait_for(Counted, count).event
        assert isinstance(event, Counted)
        return event.figures

    def kill(self) -> int:
        """Kill the process with SIGKILL, and wait for its end; returns when it was killed [ns]."""
        killed_ns = time.monotonic_ns()
        self.process.kill()
        self.process.wait()
        self._reader.join()
        return killed_ns

    def stop(self) -> int:
        """Stop the process by SIGTERM; returns its exit code."""
        with contextlib.suppress(ProcessLookupError):
            self.process.terminate()
        code = self.process.wait(PATIENCE_S)
        self._reader.join()
        return code

    def freeze(self, seconds: float) -> tuple[int, int]:
        """Stop the process with SIGSTOP for some time; returns beginning and end [ns]."""
        began_ns = time.monotonic_ns()
        self.process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            ended_ns = time.monotonic_ns()
            self.process.send_signal(signal.SIGCONT)
        return began_ns, ended_ns

    def resident_bytes(self) -> int:
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")


class Lab:
    """Server, netem and clients of one scenario, with keys, on loopback.

    Args:
        stack: ends all processes when it closes.
        folder: folder for the scenario, the keys and the records.
        vehicles: ids of the vehicles that have a key.
    """

    def __init__(
        self, stack: ExitStack, folder: Path, scenario: Scenario, vehicles: Iterable[int] = (1,)
    ) -> None:
        self._stack = stack
        self.folder = folder
        self._file = folder / "scenario.toml"
        files.write(self._file, to_toml(scenario))
        self.key_file = folder / "keys"
        secrets = [(vehicle, os.urandom(keys.SECRET_BYTES)) for vehicle in vehicles]
        with files.replacing(self.key_file, mode=0o600, is_new=True) as file:
            file.write("".join(keys.write(vehicle, 1, it) for vehicle, it in secrets).encode())

    def server(self, bind: Address = (HOST, 0), *more: str) -> ChildProcess:
        return self._start("server", "--bind", address_text(*bind), *self._keys(), *more)

    def netem(self, server: Address, bind: Address = (HOST, 0), *, seed: int = 1) -> ChildProcess:
        """Start netem in front of a server; its random numbers differ with `seed`."""
        arguments = ("--bind", address_text(*bind), "--server", address_text(*server))
        return self._start("netem", *arguments, "--seed", str(seed))

    def client(self, server: Address, record: Path, vehicle: int = 1, *more: str) -> ChildProcess:
        arguments = ("--server", address_text(*server), "--id", str(vehicle))
        return self._start("client", *arguments, *self._keys(), "--record", str(record), *more)

    def _keys(self) -> tuple[str, str]:
        return "--keys", str(self.key_file)

    def _start(self, name: str, *arguments: str) -> ChildProcess:
        return ChildProcess(self._stack, name, str(self._file), *arguments)
