"""Commands in processes forked from one that has imported everything they need.

A server's imports and kernels take three seconds of CPU, and most tests concern what comes after.
Tests of the start itself use `subprocess`.
"""

import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryFile
from typing import NoReturn

import msgspec

from helpers import PATIENCE_S
from skytether.__main__ import main
from skytether.shared.events.flight import Event, address_text
from skytether.shell.processes.log import LogLine

FORK = multiprocessing.get_context("forkserver")
FORK.set_forkserver_preload(
    [
        "pytest",  # each child imports the main module of this process, a script of pytest's
        "skytether.autopilot.__main__",
        "skytether.cli.fleet",
        "skytether.cli.fly",
        "skytether.client.__main__",
        "skytether.figures.flights",
        "skytether.netem.__main__",
        "skytether.server.__main__",
        "warm_kernels",
    ]
)


class Command:
    """Running `skytether` command, with the interface of `subprocess.Popen`."""

    def __init__(
        self,
        *argv: str,
        stdout: int | None = None,
        stderr: int | None = None,
        env: Mapping[str, str] | None = None,
        file_bytes: int | None = None,
    ) -> None:
        """Start the command.

        Args:
            argv: the subcommand and its arguments.
            stdout: file for its output; a pipe, read at `self.stdout`, unless given.
            stderr: file for its errors; its standard output unless given.
            env: its environment; that of this process unless given.
            file_bytes: size at which the disk is full for the command.
        """
        pipe = None
        if stdout is None:
            reading, stdout = os.pipe()
            pipe = stdout
            self.stdout = os.fdopen(reading, encoding="utf-8")
        streams = [Connection(os.dup(each)) for each in (stdout, stderr or stdout)]
        given = (argv, streams, dict(env or os.environ), str(Path.cwd()), file_bytes)
        self._process = FORK.Process(target=_become, args=given)
        self._process.start()
        for stream in streams:
            stream.close()
        if pipe is not None:
            os.close(pipe)
        assert self._process.pid is not None
        self.pid = self._process.pid

    def __enter__(self) -> "Command":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait for its end; if the test has failed, kill it."""
        if kind is not None:
            self.kill()
        self._process.join()
        if hasattr(self, "stdout"):
            self.stdout.close()

    def send_signal(self, number: int) -> None:
        if self._process.is_alive():
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float) -> int:
        """Wait for its end; returns its exit code, or the signal that ended it as -N."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("skytether", timeout)
        return self._process.exitcode


class Process:
    """Running command, and its output.

    Args:
        stack: kills the command at its end.
        argv: see `Command`.
        file_bytes: see `Command`.
    """

    def __init__(self, stack: ExitStack, *argv: str, file_bytes: int | None = None) -> None:
        self.popen = stack.enter_context(Command(*argv, file_bytes=file_bytes))
        stack.callback(self.popen.kill)
        self.said: list[str] = []

    def wait_for(self, pattern: str) -> re.Match[str]:
        for line in self.popen.stdout:
            self.said.append(line.rstrip())
            found = re.search(pattern, line)
            if found:
                return found
        raise AssertionError(f"{pattern!r} was never said; this was: {self.said}")

    def address(self) -> str:
        found = self.wait_for(r'listening on (\S+:\d+)|"Listening"')
        if found[1]:
            return found[1]
        event = msgspec.json.decode(found.string)["event"]
        return address_text(event["host"], event["port"])

    def events(self) -> list[Event]:
        return [msgspec.json.decode(line, type=LogLine).event for line in self.said]

    def counted(self, name: str) -> int:
        """One of its counters, requested by SIGUSR1; 0 if absent."""
        self.popen.send_signal(signal.SIGUSR1)
        self.wait_for("counted so far:")
        first = len(self.said)
        self.wait_for("send_errors")  # the last line
        found = [re.search(rf": +{name} +(\d+)$", line) for line in self.said[first:]]
        return next((int(match[1]) for match in found if match), 0)

    def end(self, number: int = signal.SIGTERM) -> int:
        self.popen.send_signal(number)
        return self.ended()

    def ended(self) -> int:
        self.said += self.popen.stdout.read().splitlines()
        return self.popen.wait(PATIENCE_S)


def skytether(*argv: str, timeout_s: float = 180.0) -> subprocess.CompletedProcess[str]:
    with TemporaryFile() as out, TemporaryFile() as err:
        with Command(*argv, stdout=out.fileno(), stderr=err.fileno()) as command:
            try:
                code = command.wait(timeout_s)
            finally:
                command.kill()
        said = []
        for file in (out, err):
            file.seek(0)
            said.append(file.read().decode())
    return subprocess.CompletedProcess(argv, code, *said)


def _become(
    argv: tuple[str, ...],
    streams: list[Connection],
    environment: dict[str, str],
    folder: str,
    file_bytes: int | None,
) -> NoReturn:
    for number, stream in enumerate(streams, start=1):
        os.dup2(stream.fileno(), number)
        stream.close()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.stdout = os.fdopen(1, "w", buffering=1, encoding="utf-8", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, encoding="utf-8", closefd=False)
    if file_bytes is not None:
        sys.dont_write_bytecode = True  # Python would leave a truncated .pyc and read it later
        _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, hard))
    sys.argv = ["skytether", *argv]
    sys.exit(main(argv))
