"""`skytether straight`: a flight by set-points only, as autopilots are usually flown, over the same
network.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from skytether.autopilot.flavours import FlavourName
from skytether.cli import page_process, processes
from skytether.figures import flights as figures
from skytether.shared.base import files, kernel
from skytether.shared.events.aboard import AutopilotRefused, AutopilotText
from skytether.shared.events.flight import Event, Fault
from skytether.shared.scenario.reading import to_toml
from skytether.shared.telemetry.record import Record, read
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.command import CommandError, ScenarioName, ScenarioOptions
from skytether.shell.host import temporary
from skytether.sim import straight as virtual
from skytether.station import laws
from skytether.station.joined import joined, summary_of
from skytether.station.laws import Law, LawOptions

TOLD = AutopilotRefused, AutopilotText, Fault
"""Events that are printed during the flight."""


@dataclass(frozen=True)
class StraightOptions(LawOptions, ScenarioOptions):
    scenario: ScenarioName = "autopilot"
    """A scenario's name (`skytether list scenarios`) or a .toml file."""
    flavour: FlavourName = "ardupilot"
    """Autopilot that is simulated, see `skytether autopilot`."""
    udp: bool = False
    """Fly over real UDP, with ground station, netem and autopilot as processes on loopback, instead
    of virtual time."""
    json: Path | None = None
    """File for the summary of the flight."""
    figure: Path | None = None
    """File for a picture of the flight (.png, .pdf or .svg)."""


def straight(argv: Sequence[str]) -> None:
    """Fly a simulated autopilot by MAVLink set-points that a ground station sends straight to it.

    The network between them is the scenario's, as in `skytether fly`, and the summary has the same
    figures: errors are of the vehicle's true position, and packets are counted from the first step
    to the last. The flight is in virtual time unless --udp is given.
    """
    options = command.parse(StraightOptions(), argv, "skytether straight", straight.__doc__)
    law = laws.make(options.law, options.lead, options.gain)
    scenario = options.config
    if options.figure:
        figures.check(options.figure)
    terminal.prepare(kernel.missing())
    where = "over UDP on loopback" if options.udp else "in virtual time"
    title = f"{options.scenario}, {_words(law)}, {where}, seed {scenario.seed}"
    with (
        command.interruptible() as interrupted,
        terminal.progress(f"flying {title}", scenario.duration) as on_second,
    ):
        fly = _really if options.udp else _virtually
        flown = fly(options, law, on_second, interrupted)
    if flown.failure:
        raise CommandError(str(flown.failure))
    if not len(flown.client):
        raise CommandError("interrupted before the first step", command.INTERRUPTED)
    terminal.finish(summary_of(scenario, options.scenario, flown), title, options.json)
    if options.figure:
        figures.flights(options.figure, {title: (scenario, flown)})


def _words(law: Law) -> str:
    lead = [] if law.lead_s is None else [f"lead {law.lead_s:g} s"]
    gain = [] if law.gain is None else [f"gain {law.gain:g}"]
    return f"{law.name} ({', '.join(lead + gain)})"


def _virtually(
    options: StraightOptions,
    law: Law,
    on_second: Callable[[float], None],
    interrupted: Callable[[], bool],
) -> Record:
    flown = virtual.fly(
        options.config, law, options.flavour, on_second=on_second, stopped=interrupted
    )
    for line in flown.events:
        if line.host == "station":
            _tell(line.event)
    return flown


def _really(
    options: StraightOptions,
    law: Law,
    on_second: Callable[[float], None],
    interrupted: Callable[[], bool],
) -> Record:
    """Fly over UDP; after Ctrl-C, returns the flight so far."""
    scenario = options.config
    with temporary.folder() as parts:
        file = parts / "scenario.toml"
        files.write(file, to_toml(scenario))

        def process(name: str, *argv: str) -> list[str]:
            return [name, str(file), "--record", str(parts / name), *argv]

        processes.fly_chain(
            [
                [process("station", *laws.flags(law), *processes.ANYWHERE)],
                [process("netem", "--flows", "1", *processes.ANYWHERE, "--server={station}")],
                [
                    process(
                        "autopilot",
                        *("--flavour", options.flavour),
                        f"--ready={virtual.READY_S}",
                        "--to={netem}",
                    )
                ],
            ],
            flies="station",
            timeout_s=scenario.duration + virtual.AROUND_S,
            on_second=on_second,
            interrupted=interrupted,
            on_event=lambda line: _tell(line.event),
        )
        station, truth, netem = (read(parts / name) for name in ("station", "autopilot", "netem"))
        return joined(scenario, station, truth, netem)


def _tell(event: Event) -> None:
    """Print events of the vehicle above the progress bar."""
    if isinstance(event, TOLD):
        page_process.say(event)
