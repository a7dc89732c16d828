"""The `skytether` command: it hands each subcommand to the module that has it."""

import sys
from collections.abc import Sequence

from shell import start

USAGE = """usage: skytether COMMAND ...

Flies a UAV over a bad network: a server plans, a client flies, and netem, between them, delays,
reorders and loses their packets.

  fly [SCENARIO]        one flight, with everything it needs; the command to start with
  fleet [SCENARIO]      many vehicles on one server, and what each costs it
  sweep [SCENARIO]      a grid of scenarios, many flights each, on all cores or a cluster
  envelope [SCENARIO]   the networks and settings that a scenario bears, by random flights
  margins [SCENARIO]    whether its loop is stable, and with which vehicles, computed
  torture               flights through faults and attacks, and whether anything unsafe is flown
  reproduce             the paper's table and figures, and more, as a report
  compare               schemes and triggers on the same seeds, each at its best weights
  calibrate [SCENARIO]  search for the paper's numbers, or for the best ones
  duel ONE OTHER        two scenarios on the same network, side by side on one page
  replay FILE           a recording on the page that showed the flight
  page FOLDER...        the page of flights in a browser; `fly` serves one by itself
  report FILE           a recording as a page with figures, for the browser
  export FILE           a recording as tables, CSV or Parquet
  recover FILE          a recording whose flight was killed, mended
  set PATH KEY=VALUE    change something while it flies, at a process with --control
  scenarios             what can be flown
  keygen FILE           keys for vehicles, so that nobody else can fly them
  server [SCENARIO]     one process by hand: plans for vehicles
  netem [SCENARIO]      one process by hand: the network
  client [SCENARIO]     one process by hand: a vehicle

Each has a --help of its own. `skytether fly demo` flies a demonstration."""


def list_scenarios(argv: Sequence[str]) -> None:
    """Print the scenarios that come with Skytether, a line each."""
    from shared import config
    from shell.command import CommandError

    if argv:
        raise CommandError(f"got {argv[0]!r}, expected nothing", 2)
    names = config.names()
    width = max(map(len, names))
    for name in names:
        print(f"{name:{width}}  {config.load(name).title}")


COMMANDS = {
    "fly": "skytether.fly:fly",
    "fleet": "skytether.fleet:fleet",
    "sweep": "skytether.sweep:sweep",
    "envelope": "skytether.envelope:envelope",
    "margins": "skytether.margins:margins",
    "torture": "skytether.torture:torture",
    "reproduce": "skytether.reproduce:reproduce",
    "compare": "skytether.compare:compare",
    "calibrate": "skytether.calibrate:calibrate",
    "duel": "skytether.duel:duel",
    "replay": "skytether.replay:replay",
    "page": "view.__main__:show",
    "report": "skytether.report:report",
    "export": "skytether.export:export",
    "recover": "skytether.recover:recover",
    "set": "skytether.set:set_keys",
    "scenarios": "skytether.__main__:list_scenarios",
    "keygen": "skytether.keygen:keygen",
    "server": "server.__main__:serve",
    "netem": "netem.__main__:emulate",
    "client": "client.__main__:fly",
}
"""Function of each subcommand, imported once it is called: netem need not wait for what a server
compiles."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    name, *rest = argv or ["--help"]
    if name in COMMANDS:
        return start.run(COMMANDS[name], name, rest)
    return start.run("skytether.__main__:introduce", "skytether", argv)


def introduce(argv: Sequence[str]) -> None:
    """Print the commands, or the version."""
    from importlib import metadata

    from shared.hint import hint
    from shell.command import CONFIGURATION, CommandError

    match argv:
        case [] | ["-h" | "--help", *_]:
            print(USAGE)
        case ["--version", *_]:
            print(f"skytether {metadata.version('skytether')}")
        case [name, *_]:
            raise CommandError(f"no command {name!r}; {hint(name, COMMANDS)}", CONFIGURATION)


if __name__ == "__main__":
    sys.exit(main())
