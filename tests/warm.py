"""Commands in processes of their own, forked from one that has imported what they need.

A server's imports and kernels take three seconds of CPU, and most tests are about what comes after
them. Where a process comes from `python -m`, or what it does before it has imported everything, is
tested with `subprocess`.
"""

import multiprocessing
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryFile
from typing import NoReturn

from skytether.__main__ import main

FORK = multiprocessing.get_context("forkserver")
FORK.set_forkserver_preload(
    [
        "pytest",  # each child imports the main module of this process: a script of pytest's
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
    """A `skytether` command that goes on, as `subprocess.Popen` has it."""

    def __init__(
        self,
        *argv: str,
        stdout: int | None = None,
        stderr: int | None = None,
        env: Mapping[str, str] | None = None,
        file_bytes: int | None = None,
    ) -> None:
        """Start it.

        Args:
            argv: the subcommand and its arguments.
            stdout: file that it prints to; a pipe, read at `self.stdout`, unless given.
            stderr: file for its mistakes; its standard output unless given.
            env: its environment; that of this process unless given.
            file_bytes: size at which the disk is full for it.
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
        """Wait until it has ended; where the test has failed, end it."""
        if kind is not None:
            self.kill()
        self._process.join()
        if hasattr(self, "stdout"):
            self.stdout.close()

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self._process.is_alive():
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float) -> int:
        """Wait until it has ended; returns its exit code, or the signal that ended it as -N."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("skytether", timeout)
        return self._process.exitcode


def skytether(*argv: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
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
        _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, hard))
    sys.argv = ["skytether", *argv]
    sys.exit(main(argv))
