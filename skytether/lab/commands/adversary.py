"""`skytether adversary`: search for events that bring vehicles of a mission together."""

import shlex
from argparse import ArgumentParser
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from skytether.lab.adversary import (
    CLIMB,
    COVERED,
    MOVES_MAX,
    PATIENCE,
    Approach,
    Climb,
    Climbed,
    MoveKind,
    Moves,
    climb,
    fly,
    shrunk,
    spare_m,
)
from skytether.lab.commands import tables
from skytether.lab.commands.pool import Flags, Interrupted, crew, writing
from skytether.lab.engine import dumps, loads
from skytether.lab.journal import ENTRIES, digests
from skytether.shared.base import input_files
from skytether.shared.base.errors import ConfigError
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


class Kept(msgspec.Struct, frozen=True):
    """Content of the file that `--json` writes."""

    nearest: Approach
    spares_m: Sequence[float]
    """Distance minus the required one for each flight [m]."""


ATTACK_BYTES_MAX = 16_000_000
OWN = ("with", "runs", "moves", "climb", "workers", "out", "json")
"""Options of the search, which are left out of the command line of a single flight."""


@dataclass(frozen=True)
class AdversaryOptions:
    """Options of `skytether adversary`."""

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
    climb: Annotated[int, Argument(metavar="N")] = 0
    """Number of the first climb, which seeds its random moves."""
    workers: Annotated[int | None, Argument(metavar="N")] = None
    """Number of worker processes; one per core unless given."""
    out: Path | None = None
    """Folder for the results of the search: after Ctrl-C, or with more flights, the same command
    continues there."""
    attack: Annotated[str | None, Argument(metavar="JSON|FILE")] = None
    """Moves to fly once: as printed by a search, or the file of its --json."""
    json: Path | None = None
    """File for the moves that brought vehicles nearest, and for the spare distance of each
    flight."""
    plugin: command.Plugins = ()
    config: ScenarioFlags = Scenario()


def adversary(argv: Sequence[str]) -> None:
    """Search for delays, losses, restarts, goals and zones that bring vehicles together.

    The adversary controls the network of a mission: it delays, loses and copies packets of each
    vehicle, in each direction. If asked for, server and clients restart, and goals and zones
    change. The search is a hill climb towards the flight in which two vehicles are nearest, or a
    vehicle is nearest to a zone. If a required distance is violated, the exit code is 1, and the
    shortest moves that violate it are printed; --attack flies them again.
    """
    options = command.parse(AdversaryOptions(), argv, "skytether adversary", adversary.__doc__)
    if not isinstance(options.config.unallocated_reference(), Mission):
        message = f"{options.scenario}: expected a mission, such as swap"
        raise CommandError(message, command.CONFIGURATION)
    title = f"{options.scenario}, seed {options.config.seed}"
    if options.attack is not None:
        found = fly(options.config, _moves(options.attack))
        searched = Climbed(found, [], found.margins, found.strays)
    else:
        searched = _search(options, title)
    _finish(options, argv, title, searched)
    spares_m = searched.spares_m
    if spares_m and len(spares_m) < options.runs:
        message = f"interrupted with {len(spares_m)} of {options.runs} flights done"
        raise CommandError(message, command.INTERRUPTED)


def _search(options: AdversaryOptions, title: str) -> Climbed:
    """All climbs together.

    Raises CommandError if interrupted before any climb was done.
    """
    command.check_count("--runs", options.runs, TRIES_MAX)
    command.claim_folder("--out", options.out, ENTRIES)
    command.check_count("--moves", options.moves, MOVES_MAX)
    pool, patience = Flags(workers=options.workers), 0 if options.random else PATIENCE
    pool.check()
    kinds = _kinds(options.kinds)
    sizes = [min(CLIMB, options.runs - begun) for begun in range(0, options.runs, CLIMB)]
    tasks = {
        (number, tries): Climb(options.config, kinds, number, tries, options.moves, patience)
        for number, tries in enumerate(sizes, start=options.climb)
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

    try:
        with (
            writing(options.out),
            crew(pool, f"against {title}", options.runs, "flights") as flyers,
        ):
            results = flyers.study(
                climb, tasks, Climbed, settings, options.out, size=lambda t: t.tries, tell=least
            )
            done = list(results.values())
    except Interrupted as interrupted:
        done = [interrupted.results[number] for number in sorted(interrupted.results)]
        if not done:
            raise
    spares_m = [each for climbed in done for each in climbed.spares_m]
    best = min((each.best for each in done), key=lambda each: spare_m(options.config, each))
    margins = {name: max(each.margins[name] for each in done) for name in best.margins}
    return Climbed(best, spares_m, margins, sum(each.strays for each in done))


def _moves(text: str) -> Moves:
    """Moves in a JSON text, or in the file of `--json` that the text names.

    Raises:
        CommandError: the file cannot be read.
        ConfigError: text or file has no valid moves.
    """
    if text.startswith("["):
        return loads(text, Moves)
    try:
        content = input_files.read(Path(text), ATTACK_BYTES_MAX)
        return msgspec.json.decode(content, type=Kept).nearest.moves
    except OSError as error:
        raise CommandError(f"--attack: {text}: {error.strerror}", command.CONFIGURATION) from None
    except msgspec.DecodeError as error:
        raise ConfigError(f"--attack: {text}: expected a file of --json ({error})") from None


def _kinds(text: str) -> tuple[MoveKind, ...]:
    try:
        return (
            COVERED if text == "covered" else tuple(map(MoveKind, dict.fromkeys(text.split(","))))
        )
    except ValueError:
        expected = f"expected covered, or some of {','.join(MoveKind)}"
        raise CommandError(f"--with: got {text}, {expected}", command.CONFIGURATION) from None


def _finish(
    options: AdversaryOptions,
    argv: Sequence[str],
    title: str,
    searched: Climbed,
) -> None:
    """Write and print the result; raises CommandError if a required distance was violated."""
    found, spares_m = searched.best, searched.spares_m
    if options.json is not None:
        command.write(options.json, msgspec.json.encode(Kept(found, spares_m)))
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
            again = shlex.join(["adversary", *_of_flight(argv), "--attack", dumps(fewest.moves)])
            print(f"fewest moves, {fewest.apart.distance_m:.3f} m:\n    skytether {again}")
        raise CommandError("a required distance was violated")


def _of_flight(argv: Sequence[str]) -> list[str]:
    """Command line without the options of the search."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    for option in (*OWN, "attack"):
        parser.add_argument(f"--{option}")
    parser.add_argument("--random", action="store_true")
    return parser.parse_known_args(list(argv))[1]
