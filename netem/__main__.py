"""`python -m netem`: the network as a process."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from netem.proxy import Proxy
from shared import command
from shared.command import ScenarioFlags, ScenarioName
from shared.config import Scenario
from shared.record import PACKET_COLUMNS, Recorder


@dataclass(frozen=True)
class Options:
    """Of `skytether netem`."""

    scenario: ScenarioName = "demo"
    """A scenario's name (see `skytether scenarios`) or a .toml file."""
    bind: str = "127.0.0.1:47000"
    """HOST:PORT where clients find it; port 0 takes a free one."""
    server: str = "127.0.0.1:47001"
    """HOST:PORT of the server."""
    record: Path | None = None
    """File for the fate of every packet."""
    config: ScenarioFlags = Scenario()


def emulate(argv: Sequence[str]) -> None:
    """Delay, reorder and lose datagrams between clients and a server; statistics at SIGUSR1."""
    options = command.parse(Options(), argv, "skytether netem", emulate.__doc__)
    sink = command.open_record(options.record) if options.record else None
    server = command.address(options.server)
    recorder = Recorder(PACKET_COLUMNS, sink) if sink else None
    endpoint = Proxy(options.config, server=server, recorder=recorder)
    bind = command.address(options.bind)
    command.drive("netem", endpoint, bind, [server], f"clients of {options.server}")
    if sink:
        sink.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return command.main(emulate, argv, "netem")


if __name__ == "__main__":
    sys.exit(main())
