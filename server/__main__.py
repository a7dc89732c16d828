"""`python -m server`: the server as a process."""

import secrets
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from server.controller import Server
from shared import command
from shared.command import ScenarioFlags, ScenarioName
from shared.config import Scenario
from shared.record import Recorder, server_columns
from shared.stopwatch import Stopwatch


@dataclass(frozen=True)
class Options:
    """Of `skytether server`."""

    scenario: ScenarioName = "demo"
    """A scenario's name (see `skytether scenarios`) or a .toml file."""
    bind: str = "127.0.0.1:47001"
    """HOST:PORT to listen on; port 0 takes a free one."""
    record: Path | None = None
    """File for the server's part of the record."""
    config: ScenarioFlags = Scenario()


def serve(argv: Sequence[str]) -> None:
    """Plan for every vehicle that says HELLO, until SIGINT or SIGTERM."""
    options = command.parse(Options(), argv, "skytether server", serve.__doc__)
    sink = command.open_record(options.record) if options.record else None
    endpoint = Server(
        options.config,
        boot_id=secrets.randbits(64),
        recorder=Recorder(server_columns(options.config.model.axes), sink) if sink else None,
        stopwatch=Stopwatch(time.perf_counter_ns),
    )
    command.drive("server", endpoint, command.address(options.bind), (), "vehicles")
    if sink:
        sink.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return command.main(serve, argv, "server")


if __name__ == "__main__":
    sys.exit(main())
