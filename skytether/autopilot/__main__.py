"""`python -m skytether.autopilot`: a simulated vehicle that speaks MAVLink, as a process."""

import sys

from skytether.shell.commandline.start import run

if __name__ == "__main__":  # called first, because the imports below are slow
    sys.exit(run("skytether.autopilot.__main__:pilot", "autopilot"))

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from skytether.autopilot import faults
from skytether.autopilot.endpoint import TRUTH_COLUMNS, Autopilot
from skytether.autopilot.flavours import FlavourName
from skytether.shared.base import kernel, machine_code
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioName
from skytether.shell.host.paths import NetworkPath
from skytether.shell.host.udp import is_loopback, look_up
from skytether.shell.processes import process
from skytether.shell.processes.process import ProcessOptions

BIND = "127.0.0.1:14550"


@dataclass(frozen=True)
class AutopilotOptions(ProcessOptions):
    scenario: ScenarioName = "demo"
    """A scenario's name (`skytether list scenarios`) or a .toml file. Only its keys
    `vehicle.frame`, `vehicle.battery`, `vehicle.steady_wind_mps`, `vehicle.turbulence_mps` and
    `seed` are used."""
    flavour: FlavourName = "ardupilot"
    """Autopilot to simulate: ArduCopter 4.5 or PX4 1.17."""
    bind: str | None = None
    """HOST:PORT at which MAVLink is received; by default 127.0.0.1:14550, or a free port with --to.
    The autopilot answers each sender.
    """
    to: str | None = None
    """HOST:PORT to which heartbeats are sent from the start, for a companion computer that waits
    for the autopilot's first packet: 127.0.0.1:14540 for PX4.
    """
    ready: Annotated[float | None, Argument(metavar="SECONDS")] = None
    """Time from the start until the vehicle may be armed [s]; by default 41.5 for ArduCopter and
    4.6 for PX4.
    """
    fault: Annotated[
        tuple[str, ...],
        Argument(
            metavar="NAME@SECONDS",
            append=True,
            help="Fault to simulate, with its time after arming; may be repeated. "
            "silence@20-25: the autopilot sends nothing for 5 s; pilot@20: a pilot takes over; "
            "disarm@20: its rotors stop; battery@20: 5 percent of the charge are left; "
            "estimate@20-25: it has no position estimate; "
            "drift@20-25: its accelerometers fail, and it drifts without noticing; "
            "commander@20-25: a second station commands 3 m/s north, 50 times a second; "
            "leap@20: the position that it reports leaps by 12 m; "
            "shift@20: its receiver's position shifts by 3 m; fix@20: its receiver has no fix.",
        ),
    ] = ()
    insecure: bool = False
    """Listen at an address that other machines can reach, too. MAVLink has no keys, so anybody can
    then fly the vehicle.
    """


def pilot(argv: Sequence[str]) -> None:
    """Simulate a vehicle with an autopilot that speaks MAVLink, until SIGINT or SIGTERM.

    A simulated quadrotor responds to velocities, lost set-points, commands and parameters as was
    measured on ArduCopter or PX4. SIGUSR1 prints the counters so far.
    """
    options = command.parse(AutopilotOptions(), argv, "skytether autopilot", pilot.__doc__)
    if options.ready is not None and not 0.0 <= options.ready <= 3600.0:
        raise CommandError(f"--ready: got {options.ready:g}, expected 0 to 3600 s", 2)
    to = command.optional_address("--to", options.to)
    bind = command.optional_address("--bind", options.bind or (None if to else BIND))
    if bind and not (options.insecure or is_loopback(look_up(bind))):
        message = f"got {options.bind}, where other machines can reach it, and MAVLink has no keys"
        raise CommandError(f"--bind: {message}: expected an address of 127.0.0.1, or --insecure", 2)
    peers = [to] if to else []
    with process.begin("autopilot", options, TRUTH_COLUMNS, secure=None) as running:
        endpoint = Autopilot(
            running.scenario,
            options.flavour,
            peers=peers,
            ready_s=options.ready,
            faults=[faults.parse(each) for each in options.fault],
            recorder=running.recorder,
        )
        paths = {0: NetworkPath("", to)} if to and not bind else {}
        running.drive(
            endpoint, bind=bind, paths=paths, peers=peers, waiting_for="MAVLink", ready=_ready
        )


def _ready() -> None:
    """Import and compile the code of a flight at the start, so that no peer has to wait for it."""
    terminal.prepare(machine_code.missing())
    kernel.load()
