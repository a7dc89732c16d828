"""`skytether envelope`: networks and settings under which a scenario flies, by many flights."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from skytether.lab import figures
from skytether.lab.commands import tables
from skytether.lab.commands.pool import Flags, PoolFlags, study, writing
from skytether.lab.envelope import BAD, Envelope, EnvelopePoint, Outcome, worst_first
from skytether.shared.base import files
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioFlags, ScenarioName

TOLD_MAX = 10


@dataclass(frozen=True)
class EnvelopeOptions:
    """Options of `skytether envelope`."""

    out: Path
    """Folder for the results; the same command continues there, also with more points."""
    scenario: ScenarioName = "demo-committed"
    """Name of a scenario (see `skytether scenarios`) or path of a .toml file."""
    runs: Annotated[int, Argument(metavar="N")] = 1000
    """Number of points, flown once each; point n depends only on --seed and n."""
    pool: PoolFlags = Flags()
    config: ScenarioFlags = Scenario()


def envelope(argv: Sequence[str]) -> None:
    """Find the networks and settings under which a scenario flies, by flights in virtual time.

    A point has a delay of up to 3 s and a loss of up to 0.99 in each direction, steps of 5 ms to
    0.5 s, horizons of 1 to 120 steps, and the scheme committed or feedback; all other keys are the
    scenario's. A point is "flown" if it stays within 1 m of the reference, "refused" with one line,
    or "hovering" if it ends without a plan and brakes. A vehicle that moves when it should brake,
    or leaves the reference's surroundings, is a "flyaway": the exit code is then 1, and the printed
    command line flies the point again. docs/studies.md explains each outcome.

    OUT/points.csv has a row for each point, OUT/envelope.png shows the outcomes. All flights are
    kept: after Ctrl-C or a crash, the same command continues.
    """
    options = command.parse(
        EnvelopeOptions(tyro.MISSING), argv, "skytether envelope", envelope.__doc__
    )
    command.check_count("--runs", options.runs, 10**6)
    options.pool.check()
    plan = Envelope(options.scenario, options.config)
    command.claim_folder("--out", options.out, "points.csv", "envelope.png")
    title = f"flying points of {options.scenario}"
    numbers, settings = range(options.runs), plan.settings()
    points = study(
        plan.fly, numbers, EnvelopePoint, settings, options.out, options.pool, title, "points"
    )
    with writing(options.out):
        _finish(options, plan, points)


def _finish(options: EnvelopeOptions, plan: Envelope, points: Sequence[EnvelopePoint]) -> None:
    """Write and print all outcomes; raises CommandError if some points flew away or crashed."""
    flown = terminal.counted(len(points), "point")
    title = f"{options.scenario}, {flown}, in virtual time, seed {plan.scenario.seed}"
    files.write(options.out / "points.csv", plan.csv(points).encode())
    figures.envelope(options.out / "envelope.png", title, plan, points)
    counts = Counter(point.outcome for point in points)
    rows = [(each, counts[each], f"{counts[each] / len(points):.1%}") for each in get_args(Outcome)]
    tables.show(title, ("outcome", "points", "share"), rows)
    for number, point in worst_first(points)[:TOLD_MAX]:
        detail = (
            f": {point.line}" if point.line else f": {point.error_max:.2f} m from the reference"
        )
        print(f"{point.outcome}{detail}\n    {plan.command(number)}")
    print(f"{options.out}: points.csv, envelope.png")
    if bad := sum(counts[outcome] for outcome in BAD):
        raise CommandError(f"{bad} of {flown} flew away or crashed")
