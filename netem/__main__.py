"""`python -m netem`: the network as a process."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from netem.proxy import FLOWS_MAX, Proxy
from shared.config import Scenario
from shared.record import PACKET_COLUMNS, Recorder
from shell import command
from shell.command import ScenarioFlags, ScenarioName
from shell.udp import allow_sockets


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
    flows: Annotated[int, tyro.conf.arg(metavar="N")] = FLOWS_MAX
    """Clients at once; each takes a socket."""
    json: Path | None = None
    """File for what was counted, and what it cost."""
    config: ScenarioFlags = Scenario()


def emulate(argv: Sequence[str]) -> None:
    """Delay, reorder and lose datagrams between clients and a server; statistics at SIGUSR1."""
    options = command.parse(Options(), argv, "skytether netem", emulate.__doc__)
    command.check_count("--flows", options.flows, 65_536)
    allow_sockets(1 + options.flows)
    sink = command.open_record(options.record) if options.record else None
    server = command.address(options.server)
    recorder = Recorder(PACKET_COLUMNS, sink) if sink else None
    endpoint = Proxy(options.config, server=server, flows=options.flows, recorder=recorder)
    bind = command.address(options.bind)
    waiting_for = f"clients of {options.server}"
    command.drive("netem", endpoint, bind, [server], waiting_for, json=options.json)
    if sink:
        sink.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return command.main(emulate, argv, "netem")


if __name__ == "__main__":
    sys.exit(main())
