"""`python -m skytether.station`: a ground station that sends set-points, as a process."""

import sys

from skytether.shell.start import run

if __name__ == "__main__":  # first, before the imports below, which take a while
    sys.exit(run("skytether.station.__main__:fly", "station"))

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from skytether.shared.scenario.schema import Scenario
from skytether.shell import command, process
from skytether.shell.command import CommandError, ScenarioFlags, ScenarioName
from skytether.shell.log import LogFormat
from skytether.shell.udp import is_loopback, look_up
from skytether.station import laws
from skytether.station.endpoint import Station
from skytether.station.joined import station_columns
from skytether.station.laws import LawOptions


@dataclass(frozen=True)
class StationOptions(LawOptions):
    """Options of `skytether station`."""

    scenario: ScenarioName = "autopilot"
    """A scenario's name (see `skytether scenarios`) or a .toml file."""
    bind: str = "127.0.0.1:14550"
    """HOST:PORT to receive MAVLink at; the first autopilot that is heard there is flown."""
    insecure: bool = False
    """Listen even where other machines can reach it: MAVLink has no keys."""
    log: LogFormat = "text"
    """Form of printed events: sentences, or lines of JSON for a program."""
    record: Path | None = None
    """File for the station's part of the record: what it heard and sent at each step."""
    json: Path | None = None
    """File for counters and the CPU time used."""
    plugin: command.Plugins = ()
    config: ScenarioFlags = Scenario()


def fly(argv: Sequence[str]) -> None:
    """Fly an autopilot by set-points sent straight to it, from take-off to landing.

    This is how autopilots are usually flown, and serves for comparison. The exit code is 1 if the
    vehicle cannot be flown.
    """
    options = command.parse(StationOptions(), argv, "skytether station", fly.__doc__)
    scenario = options.config
    law = laws.make(options.law, options.lead, options.gain)
    bind = command.address("--bind", options.bind)
    if not (options.insecure or is_loopback(look_up(bind))):
        said = f"got {options.bind}, where other machines can reach it, and MAVLink has no keys"
        raise CommandError(f"--bind: {said}: expected an address of 127.0.0.1, or --insecure", 2)
    columns, record = station_columns(scenario.model.axes), options.record
    with process.recorded(record, columns) if record else nullcontext() as recording:
        station = Station(scenario, law, recording.recorder if recording else None)
        process.drive(
            "station",
            station,
            options,
            bind=bind,
            waiting_for="an autopilot",
            secure=None,
            log=options.log,
            json=options.json,
            recording=recording,
        )
        if failure := station.failure:
            raise CommandError(str(failure))
