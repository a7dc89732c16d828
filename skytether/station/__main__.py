"""`python -m skytether.station`: a ground station that sends set-points, as a process."""

import sys

from skytether.shell.commandline.start import run

if __name__ == "__main__":  # called before the slow imports below
    sys.exit(run("skytether.station.__main__:fly", "station"))

from collections.abc import Sequence
from dataclasses import dataclass

from skytether.shell.commandline import command
from skytether.shell.commandline.command import CommandError, ScenarioName
from skytether.shell.host.udp import is_loopback, look_up
from skytether.shell.processes import process
from skytether.shell.processes.process import ProcessOptions
from skytether.station import laws
from skytether.station.endpoint import Station
from skytether.station.joined import station_columns
from skytether.station.laws import LawOptions


@dataclass(frozen=True)
class StationOptions(LawOptions, ProcessOptions):
    scenario: ScenarioName = "autopilot"
    """A scenario's name (`skytether list scenarios`) or a .toml file."""
    bind: str = "127.0.0.1:14550"
    """HOST:PORT to receive MAVLink at; the first autopilot that sends a heartbeat there is
    flown.
    """
    insecure: bool = False
    """Listen even where other machines can reach it: MAVLink has no keys."""


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
        message = f"got {options.bind}, where other machines can reach it, and MAVLink has no keys"
        raise CommandError(f"--bind: {message}: expected an address of 127.0.0.1, or --insecure", 2)
    columns = station_columns(scenario.model.axes)
    with process.begin("station", options, columns, secure=None) as running:
        station = Station(running.scenario, law, running.recorder)
        running.drive(station, bind=bind, waiting_for="an autopilot")
        if failure := station.failure:
            raise CommandError(str(failure))
