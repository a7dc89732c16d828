"""`python -m client`: one simulated UAV as a process."""

import secrets
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from client.fleet import Fleet
from client.plant import FirstOrderPlant
from client.vehicle import Client
from shared.chance import stream
from shared.config import Scenario
from shared.record import Recorder, client_columns, parse
from shared.summary import summarise
from shell import command
from shell.command import CommandError, ScenarioFlags, ScenarioName
from shell.udp import allow_sockets, within_reach_of


@dataclass(frozen=True)
class Options:
    """Of `skytether client`."""

    scenario: ScenarioName = "demo"
    """A scenario's name (see `skytether scenarios`) or a .toml file; the server's."""
    server: str = "127.0.0.1:47000"
    """HOST:PORT where the server is to be met: netem's, or its own."""
    number: Annotated[int, tyro.conf.arg(name="id")] = 1
    """Number of this vehicle, unlike any other of the server's (0 to 65535)."""
    vehicles: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Fly so many in this process, numbered from --id on."""
    record: Path | None = None
    """File for the client's part of the record."""
    json: Path | None = None
    """File for the summary of the flight, as far as the vehicle knows it; of a fleet, for what was
    counted, and what it cost."""
    config: ScenarioFlags = Scenario()


def fly(argv: Sequence[str]) -> None:
    """Fly one simulated UAV for `--duration` seconds, or until SIGINT or SIGTERM."""
    options = command.parse(Options(), argv, "skytether client", fly.__doc__)
    scenario, server = options.config, command.address(options.server)
    command.check_count("--vehicles", options.vehicles, 65_536)
    numbers = range(options.number, options.number + options.vehicles)
    if not (numbers[0] >= 0 and numbers[-1] < 2**16):
        given = f"{numbers[0]} to {numbers[-1]}" if len(numbers) > 1 else numbers[0]
        raise CommandError(f"--id: got {given}, expected 0 to 65535", 2)
    allow_sockets(len(numbers))
    with (
        command.open_record(options.record) if options.record else tempfile.TemporaryFile()
    ) as sink:
        recorder = Recorder(client_columns(scenario.model.axes), sink)
        clients = [
            Client(
                scenario,
                FirstOrderPlant(scenario, stream(scenario.seed, "wind", number)),
                server=server,
                vehicle=number,
                boot_id=secrets.randbits(64),
                recorder=recorder,
            )
            for number in numbers
        ]
        alone = len(clients) == 1
        endpoint = clients[0] if alone else Fleet(clients)
        command.drive(
            *("client", endpoint, within_reach_of([server]), [server]),
            f"the server at {options.server}",
            json=None if alone else options.json,
        )
        sink.flush()
        sink.seek(0)
        rows = parse(sink.read())
    if endpoint.failure:
        raise CommandError(endpoint.failure)
    if alone and len(rows):
        command.finish(summarise(scenario, options.scenario, rows), "client", options.json)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; the exit code."""
    return command.main(fly, argv, "client")


if __name__ == "__main__":
    sys.exit(main())
