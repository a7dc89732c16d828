"""`python -m fuzz.adversary`: search for events that bring vehicles of a mission together."""

import shlex
import sys
from argparse import ArgumentParser
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fuzz.adversary.climb import CLIMB, MOVES_MAX, PATIENCE, Climb, Climbed, climb
from fuzz.adversary.raid import COVERED, MoveKind, Moves, fly, shrunk, spare_m
from fuzz.engine import dumps, flown, loads
from skytether.lab.commands import tables
from skytether.lab.engine.journal import ENTRIES, digests
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioFlags, ScenarioName

TRIES_MAX = 10**6
ASSUMES = {
    "tube": "largest distance from a motion",
    "join": "latest acceptance of a motion",
}
"""What the theorem assumes, by the names of `Approach.margins`."""
OWN = ("with", "runs", "moves", "workers", "out")
"""Options of the search, which are left out of the command line of a single flight."""


@dataclass(frozen=True)
class AdversaryOptions:
    scenario: ScenarioName = "swap"
    """Name of a mission (swap, sphere, rings, corridor, warehouse) or a .toml file."""
    kinds: Annotated[str, Argument(name="with", metavar="KINDS")] = "delays,losses,cuts,copies"
    """Kinds of moves, with commas, see docs/together-measured.md; `covered` stands for all against
    which the distances must hold."""
    runs: Annotated[int, Argument(metavar="N")] = 200
    """Number of flights."""
    moves: Annotated[int, Argument(metavar="N")] = MOVES_MAX
    """Largest number of moves of a flight."""
    random: bool = False
    """Draw the moves of each flight at random, without a search."""
    workers: Annotated[int | None, Argument(metavar="N")] = None
    """Number of worker processes; one per core unless given."""
    out: Path | None = None
    """Folder for the results of the search: after Ctrl-C, or with more flights, the same command
    continues there."""
    attack: Annotated[str | None, Argument(metavar="JSON")] = None
    """Moves to fly once, as printed by a search."""
    config: ScenarioFlags = Scenario()


def main(argv: Sequence[str]) -> None:
    """Search for delays, losses, restarts, goals and zones that bring vehicles together.

    The adversary controls the network of a mission: it delays, loses and copies packets of each
    vehicle, in each direction. If asked for, server and clients restart, and goals and zones
    change. The search is a hill climb towards the flight in which two vehicles are nearest, or a
    vehicle is nearest to a zone. If a required distance is violated, the exit code is 1, and the
    shortest moves that violate it are printed; --attack flies them again.
    """
    options = command.parse(AdversaryOptions(), argv, "python -m fuzz.adversary", main.__doc__)
    if not isinstance(options.config.unallocated_reference(), Mission):
        message = f"{options.scenario}: expected a mission, such as swap"
        raise CommandError(message, command.CONFIGURATION)
    title = f"{options.scenario}, seed {options.config.seed}"
    if options.attack is not None:
        found = fly(options.config, loads(options.attack, Moves))
        searched, interrupted = Climbed(found, [], found.margins, found.strays), ""
    else:
        searched, interrupted = _search(options, title)
    _finish(options, argv, title, searched)
    if interrupted:
        raise CommandError(interrupted, command.INTERRUPTED)


def _search(options: AdversaryOptions, title: str) -> tuple[Climbed, str]:
    """All climbs together, and how many flights were done if it was interrupted."""
    command.check_count("--runs", options.runs, TRIES_MAX)
    command.claim_folder("--out", options.out, ENTRIES)
    command.check_count("--moves", options.moves, MOVES_MAX)
    kinds, patience = _kinds(options.kinds), 0 if options.random else PATIENCE
    sizes = [min(CLIMB, options.runs - begun) for begun in range(0, options.runs, CLIMB)]
    tasks = {
        (number, tries): Climb(options.config, kinds, number, tries, options.moves, patience)
        for number, tries in enumerate(sizes)
    }
    settings = {
        "kinds": [*kinds],
        "moves": options.moves,
        "patience": patience,
        "files": digests([options.config]),
        "scenario": reading.to_table(options.config),
    }

    def least(done: Collection[Climbed]) -> str:
        spares_m = (min(each.spares_m) for each in done)
        return f"{min(spares_m):.3f} m left" if done else ""

    done, interrupted = flown(
        climb,
        tasks,
        Climbed,
        f"against {title}",
        options.workers,
        settings=settings,
        out=options.out,
        size=lambda task: task.tries,
        tell=least,
    )
    spares_m = [each for climbed in done for each in climbed.spares_m]
    best = min((each.best for each in done), key=lambda each: spare_m(options.config, each))
    margins = {name: max(each.margins[name] for each in done) for name in best.margins}
    return Climbed(best, spares_m, margins, sum(each.strays for each in done)), interrupted


def _kinds(text: str) -> tuple[MoveKind, ...]:
    try:
        return (
            COVERED if text == "covered" else tuple(map(MoveKind, dict.fromkeys(text.split(","))))
        )
    except ValueError:
        expected = f"expected covered, or some of {','.join(MoveKind)}"
        raise CommandError(f"--with: got {text}, {expected}", command.CONFIGURATION) from None


def _finish(options: AdversaryOptions, argv: Sequence[str], title: str, searched: Climbed) -> None:
    """Print the result; raises CommandError if a required distance was violated."""
    found, spares_m = searched.best, searched.spares_m
    failed, apart, clear = sum(each < 0.0 for each in spares_m), found.apart, found.clear
    asked_m = options.config.mission.separation_m
    rows: list[tuple[str, object]] = []
    if spares_m:
        rows.append(("flights", f"{len(spares_m)}, with {options.kinds}"))
        rows.append(("with a violated distance", failed))
    rows.append(("least separation, required [m]", f"{apart.away_m:.3f}, {asked_m:g}"))
    pair = " and ".join(map(str, apart.vehicles))
    rows.append(("  at [s], of vehicles", f"{apart.at_s:.2f}, {pair}"))
    if clear.vehicles:
        rows.append(("least distance from a zone [m]", clear.distance_m))
        rows.append(("  at [s], of vehicle", f"{clear.at_s:.2f}, {clear.vehicles[0]}"))
    for name, share in searched.margins.items():
        rows.append((f"{ASSUMES[name]}, as a share of what is assumed", f"{share:.3f}"))
    rows.append(("motions left before their end, or begun too late", searched.strays))
    rows.append(("observations outside a tube", found.left))
    rows.append(("moves", ", ".join(sorted({each.kind for each in found.moves})) or "none"))
    tables.show(f"adversary against {title}", (), rows)
    if spare_m(options.config, found) < 0.0:
        if spares_m:
            fewest = shrunk(options.config, found)
            again = shlex.join([*_of_flight(argv), "--attack", dumps(fewest.moves)])
            print(f"fewest moves, {fewest.apart.distance_m:.3f} m:")
            print(f"    python -m fuzz.adversary {again}")
        raise CommandError("a required distance was violated")


def _of_flight(argv: Sequence[str]) -> list[str]:
    """Command line without the options of the search."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    for option in OWN:
        parser.add_argument(f"--{option}")
    parser.add_argument("--random", action="store_true")
    return parser.parse_known_args(list(argv))[1]


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "adversary"))
