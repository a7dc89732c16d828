"""The `skytether` command: it passes each subcommand to the module that implements it."""

import sys
from collections.abc import Sequence

from skytether.shell import start

USAGE = """usage: skytether COMMAND ...

Flies a UAV over a bad network: a server plans, a client flies, and netem, between them, delays,
reorders and loses their packets.

  fly [SCENARIO]        one flight, with everything it needs; the command to start with
  straight [SCENARIO]   the same by set-points sent straight to an autopilot, to compare with
  fleet [SCENARIO]      many vehicles on one server, and the CPU time of each
  crowd [SCENARIO]      how many vehicles can share one radio channel, scheme by scheme
  sweep [SCENARIO]      a grid of scenarios, many flights each, on all cores or a cluster
  envelope [SCENARIO]   the networks and settings that a scenario tolerates, by random flights
  margins [SCENARIO]    whether its loop is stable, and with which vehicles, by flights
  identify KIND         a vehicle's gain, time constant and dead time, from its step responses
  torture               flights under faults and attacks, and a check that nothing unsafe is flown
  adversary [MISSION]   a search for faults that bring vehicles of a mission too close
  reproduce             the paper's table and figures, and more, as a report
  compare               schemes and triggers on the same seeds, each at its best weights
  calibrate [SCENARIO]  search for the paper's numbers, or for the best ones
  duel SCENARIO...      two or more scenarios on the same network, side by side on one page
  replay FILE           a recording on the page that showed the flight
  page FOLDER...        the page of flights in a browser; `fly` has its own
  ros2 FOLDER           plans and goals of a flight for RViz and other tools of ROS 2
  report FILE           a recording as an HTML page with figures
  export FILE           a recording as tables, CSV or Parquet
  join FILE...          recordings of server, netem and client, as one
  set PATH KEY=VALUE    change keys in flight, at a process with --control
  probe HOST:PORT       delay and loss of a real path, each way; with --listen, its far end
  scenarios             scenarios that come with Skytether
  triggers              policies for control.trigger, a sentence each
  reports               policies for vehicle.report, a sentence each
  schemes               schemes for control.scheme, a sentence each
  planners              planners for control.planner, a sentence each
  references            shapes for reference.shape, a sentence each
  impairments           effects of a network on packets, a sentence each
  vehicles              vehicle models for vehicle.kind, a sentence each
  keygen FILE           keys for vehicles, so that nobody else can fly them
  server [SCENARIO]     one process by hand: plans for vehicles
  netem [SCENARIO]      one process by hand: the network; `netem run` starts a program in it
  client [SCENARIO]     one process by hand: a vehicle
  autopilot [SCENARIO]  one process by hand: an autopilot that speaks MAVLink, simulated
  station [SCENARIO]    one process by hand: a ground station that sends set-points to one

Each has a --help of its own. `skytether fly demo` flies a demonstration."""


def list_scenarios(argv: Sequence[str]) -> None:
    from skytether.shared.scenario import reading
    from skytether.shell.command import CommandError

    match argv:
        case ["-h" | "--help", *_]:
            print("usage: skytether scenarios\n\nPrint the scenarios that come with Skytether.")
            return
        case [word, *_]:
            raise CommandError(f"got {word!r}, expected nothing", 2)
    names = reading.names()
    width = max(map(len, names))
    for name in names:
        print(f"{name:{width}}  {reading.load(name).title}")


COMMANDS = {
    "fly": "skytether.cli.fly:fly",
    "straight": "skytether.cli.straight:straight",
    "fleet": "skytether.cli.fleet:fleet",
    "crowd": "skytether.lab.commands.crowd:crowd",
    "sweep": "skytether.lab.commands.sweep:sweep",
    "envelope": "skytether.lab.commands.envelope:envelope",
    "margins": "skytether.lab.commands.margins:margins",
    "identify": "skytether.lab.commands.identify:identify",
    "torture": "skytether.lab.commands.torture:torture",
    "adversary": "skytether.lab.commands.adversary:adversary",
    "reproduce": "skytether.lab.commands.reproduce:reproduce",
    "compare": "skytether.lab.commands.compare:compare",
    "calibrate": "skytether.lab.commands.calibrate:calibrate",
    "duel": "skytether.cli.duel:duel",
    "replay": "skytether.cli.replay:replay",
    "page": "skytether.view.__main__:show",
    "ros2": "skytether.cli.ros2:connect",
    "report": "skytether.cli.report:report",
    "export": "skytether.cli.export:export",
    "join": "skytether.cli.join:join",
    "set": "skytether.cli.set:set_keys",
    "probe": "skytether.cli.probe:probe",
    "scenarios": "skytether.__main__:list_scenarios",
    "triggers": "skytether.cli.names:triggers",
    "reports": "skytether.cli.names:reports",
    "schemes": "skytether.cli.names:schemes",
    "planners": "skytether.cli.names:planners",
    "references": "skytether.cli.names:references",
    "impairments": "skytether.cli.names:impairments",
    "vehicles": "skytether.cli.names:vehicles",
    "keygen": "skytether.cli.keygen:keygen",
    "server": "skytether.server.__main__:serve",
    "netem": "skytether.netem.__main__:emulate",
    "client": "skytether.client.__main__:fly",
    "autopilot": "skytether.autopilot.__main__:pilot",
    "station": "skytether.station.__main__:fly",
}
"""Function of each subcommand; imported when called, so that netem does not import the kernels of a
server.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    name, *rest = argv or ["--help"]
    if name in COMMANDS:
        return start.run(COMMANDS[name], name, rest)
    return start.run("skytether.__main__:introduce", "skytether", argv)


def introduce(argv: Sequence[str]) -> None:
    from importlib import metadata

    from skytether.shared.base.hint import hint
    from skytether.shell.command import CONFIGURATION, CommandError

    match argv:
        case [] | ["-h" | "--help", *_]:
            print(USAGE)
        case ["--version", *_]:
            print(f"skytether {metadata.version('skytether')}")
        case [name, *_]:
            raise CommandError(f"no command {name!r}; {hint(name, COMMANDS)}", CONFIGURATION)


if __name__ == "__main__":
    sys.exit(main())
