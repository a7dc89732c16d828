"""`python -m fuzz.torture`: encrypted flights through faults and attacks, all of them checked."""

import math
import secrets
import shlex
import sys
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fuzz.engine import dumps, flown
from fuzz.torture.faults import Trial, loads
from fuzz.torture.trials import TrialOutcome, fly, long_trial, short_trial, shrunk
from skytether.lab.commands import tables
from skytether.shared.base import input_files
from skytether.shared.base.errors import ConfigError
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.commandline.options import read

SEEDS = 2**32
HOURS_MAX = 10_000
SCHEDULES_BYTES_MAX = 64_000_000
SHOWN_MAX = 10
"""Number of failures that are shrunk and printed."""


@dataclass(frozen=True)
class TortureOptions:
    seed: Annotated[int | None, Argument(metavar="N")] = None
    """First seed; random unless given."""
    runs: Annotated[int, Argument(metavar="N")] = 100
    """Number of flights, with seeds that count up."""
    hours: Annotated[float | None, Argument(metavar="H")] = None
    """Number of hours to fly instead, in flights of an hour with faults throughout."""
    workers: Annotated[int | None, Argument(metavar="N")] = None
    """Number of worker processes; one per core unless given."""
    schedule: Annotated[str | None, Argument(metavar="JSON|FILE")] = None
    """Schedule to fly instead of random ones, as printed for a failure, or a file with one a line.
    """


def main(argv: Sequence[str]) -> None:
    """Fly server, netem and clients in virtual time, encrypted, under random faults and attacks.

    Packets are lost, duplicated, delayed, altered, recorded and replayed; hosts freeze, restart,
    and set their clocks; the solver fails, the server is overloaded, strangers flood. At each step
    of each vehicle it is checked that nothing unsafe is flown, and at the end that all vehicles fly
    again; docs/torture.md lists the invariants. If a flight fails, the exit code is 1, and its
    schedule is shrunk to the shortest that fails in the same way, and printed; --schedule flies it
    again.
    """
    options = read(TortureOptions(), argv, "python -m fuzz.torture", main.__doc__)
    command.check_count("--runs", options.runs, 10**6)
    trials, title = _trials(options)
    done, interrupted = flown(
        fly, dict(enumerate(trials)), TrialOutcome, title, options.workers, tell=_failures
    )
    counts: Counter[str] = Counter()
    for outcome in done:
        counts.update(outcome.counts)
    flown_h = sum(outcome.flown_s for outcome in done) / 3600.0
    rows = [("flights", f"{len(done)}, {flown_h:.2f} h in virtual time")]
    tables.show(title, (), [*rows, *sorted(counts.items())])
    failed = [each for each in done if each.failure]
    for outcome in map(shrunk, failed[:SHOWN_MAX]):
        print(f"seed {outcome.trial.seed}: {outcome.failure}")
        print(f"    python -m fuzz.torture --schedule {shlex.quote(dumps(outcome.trial))}")
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
    if options.schedule is not None:
        if options.seed is not None or options.hours is not None:
            message = "--schedule: expected neither --seed nor --hours beside it"
            raise CommandError(message, command.CONFIGURATION)
        if options.schedule.startswith("{"):
            return [loads(options.schedule)], "torture by a schedule"
        return _read(Path(options.schedule)), f"torture by {options.schedule}"
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
        ConfigError: a line is not a schedule.
    """
    try:
        lines = input_files.read(path, SCHEDULES_BYTES_MAX).decode().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CommandError(f"--schedule: {path}: {error}", command.CONFIGURATION) from None
    trials = []
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.startswith("#"):
            try:
                trials.append(loads(line))
            except ConfigError as error:
                raise ConfigError(f"--schedule: {path}: line {number}: {error}") from None
    return trials


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "torture"))
