"""`skytether torture`: encrypted flights through faults and attacks, with checked invariants."""

import math
import secrets
import shlex
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from skytether.lab.commands import tables
from skytether.lab.commands.pool import Flags, Interrupted, crew
from skytether.lab.engine import dumps
from skytether.lab.faults import Trial, loads
from skytether.lab.torture import TrialOutcome, fly, long_trial, short_trial, shrunk
from skytether.shared.base import input_files
from skytether.shared.base.errors import ConfigError
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.commandline.options import read

SEEDS = 2**32
HOURS_MAX = 10_000
SCHEDULES_BYTES_MAX = 64_000_000
TOLD_MAX = 10


@dataclass(frozen=True)
class TortureOptions:
    """Options of `skytether torture`."""

    seed: Annotated[int | None, Argument(metavar="N")] = None
    """First seed; random unless given."""
    runs: Annotated[int, Argument(metavar="N")] = 100
    """Number of flights, with seeds that count up."""
    hours: Annotated[float | None, Argument(metavar="H")] = None
    """Number of hours to fly instead, in flights of an hour with faults throughout."""
    workers: Annotated[int | None, Argument(metavar="N")] = None
    """Number of worker processes; one per core unless given."""
    replay: Path | None = None
    """File with one schedule per line, flown instead of random ones."""
    schedule: str | None = None
    """Schedule to fly instead of random ones, as printed for a failure."""
    json: Path | None = None
    """File for the counters, and for the failures."""


def torture(argv: Sequence[str]) -> None:
    """Fly server, netem and clients in virtual time, encrypted, under random faults and attacks.

    Packets are lost, duplicated, delayed, altered, recorded and replayed; hosts freeze, restart,
    and set their clocks; the solver fails, the server is overloaded, strangers flood. At each step
    of each vehicle it is checked that nothing unsafe is flown, and at the end that all vehicles fly
    again; docs/torture.md lists the invariants. If a flight fails, the exit code is 1, and its
    schedule is shrunk to the shortest that fails in the same way, and printed; --schedule flies it
    again.
    """
    options = read(TortureOptions(), argv, "skytether torture", torture.__doc__)
    command.check_count("--runs", options.runs, 10**6)
    command.claim_output("--json", options.json)
    pool = Flags(workers=options.workers)
    pool.check()
    trials, title = _trials(options)
    done: Collection[TrialOutcome] = ()
    interrupted = ""
    try:
        with crew(pool, title, len(trials), "flights") as flyers:
            done = flyers.study(fly, dict(enumerate(trials)), tell=_failures).values()
            failed = [each for each in done if each.failure]
            failed[:TOLD_MAX] = flyers.map(shrunk, failed[:TOLD_MAX])
    except Interrupted as early:
        done = done or early.results.values()
        interrupted = (
            f"interrupted with {len(done)} of {terminal.counted(len(trials), 'flight')} done"
        )
        failed = [each for each in done if each.failure]
    _finish(options, title, done, failed)
    if failed:
        message = f"{len(failed)} of {terminal.counted(len(done), 'flight')} failed"
        raise CommandError(f"{interrupted}, and {message}" if interrupted else message)
    if interrupted:
        raise CommandError(interrupted, command.INTERRUPTED)


def _failures(done: Collection[TrialOutcome]) -> str:
    failed = sum(bool(each.failure) for each in done)
    return f"{failed} failed" if failed else ""


def _trials(options: TortureOptions) -> tuple[list[Trial], str]:
    """Trials to fly, and their name for the output.

    Raises:
        CommandError: the options are impossible, or exclude each other.
        ConfigError: a text is not a schedule.
    """
    asked = ("seed", "hours", "replay", "schedule")
    given_options = [name for name in asked if getattr(options, name) is not None]
    if len(given_options) > 1 and given_options != ["seed", "hours"]:
        together = " and ".join(f"--{name}" for name in given_options)
        raise CommandError(f"got {together}, expected one of them", command.CONFIGURATION)
    if options.schedule is not None:
        return [loads(options.schedule)], "torture by a schedule"
    if options.replay is not None:
        return _read(options.replay), f"torture by {options.replay}"
    seed = secrets.randbelow(SEEDS) if options.seed is None else options.seed
    if not 0 <= seed < SEEDS:
        expected = f"expected 0 to {SEEDS - 1}"
        raise CommandError(f"--seed: got {seed}, {expected}", command.CONFIGURATION)
    if options.hours is None:
        seeds = [(seed + number) % SEEDS for number in range(options.runs)]
        return list(map(short_trial, seeds)), f"torture from seed {seed}"
    if not 0.0 < options.hours <= HOURS_MAX:
        expected = f"expected more than 0, at most {HOURS_MAX}"
        raise CommandError(f"--hours: got {options.hours:g}, {expected}", command.CONFIGURATION)
    each = [min(1.0, options.hours - begun) for begun in range(math.ceil(options.hours))]
    trials = [long_trial((seed + number) % SEEDS, hours) for number, hours in enumerate(each)]
    return trials, f"torture for {options.hours:g} h from seed {seed}"


def _read(path: Path) -> list[Trial]:
    """Trials in a file, one per line; lines that begin with # are comments.

    Raises:
        CommandError: the file cannot be read.
        ConfigError: a line is not a schedule, or the file has none.
    """
    try:
        lines = input_files.read(path, SCHEDULES_BYTES_MAX).decode().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CommandError(f"--replay: {path}: {error}", command.CONFIGURATION) from None
    trials = []
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.startswith("#"):
            try:
                trials.append(loads(line))
            except ConfigError as error:
                raise ConfigError(f"--replay: {path}: line {number}: {error}") from None
    if not trials:
        raise ConfigError(f"{path}: no schedules, expected one a line")
    return trials


def _finish(
    options: TortureOptions, title: str, done: Collection[TrialOutcome], failed: list[TrialOutcome]
) -> None:
    counts: Counter[str] = Counter()
    for outcome in done:
        counts.update(outcome.counts)
    flown_s = sum(outcome.flown_s for outcome in done)
    if options.json is not None:
        figures = {
            "title": title,
            "flights": len(done),
            "flown_s": flown_s,
            "failed": len(failed),
            "counts": dict(sorted(counts.items())),
            "failures": failed,
        }
        command.write(options.json, msgspec.json.encode(figures))
    rows = [("flights", f"{len(done)}, {flown_s / 3600:.2f} h in virtual time")]
    tables.show(title, (), [*rows, *sorted(counts.items())])
    for outcome in failed[:TOLD_MAX]:
        print(f"seed {outcome.trial.seed}: {outcome.failure}")
        print(f"    skytether torture --schedule {shlex.quote(dumps(outcome.trial))}")
    if len(failed) > TOLD_MAX:
        print(f"and {len(failed) - TOLD_MAX} more, in the file of --json")
