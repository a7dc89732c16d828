"""`skytether crowd`: number of vehicles that can share one network, scheme by scheme."""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, get_args

from skytether.cli import processes
from skytether.lab import figures
from skytether.lab.commands import tables
from skytether.lab.commands.pool import Flags, Interrupted, crew, writing
from skytether.lab.crowd import TITLES, Crowd, CrowdPoint, FlownScheme, Scheme, judge, points_csv
from skytether.lab.journal import StudyJournal
from skytether.shared.base import files
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import record
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioFlags, ScenarioName
from skytether.shell.host import temporary
from skytether.sim import flight

VEHICLES_MAX = 4096


@dataclass(frozen=True)
class CrowdOptions:
    """Options of `skytether crowd`."""

    out: Path = Path("crowd")
    """Folder for the results; the same command continues there."""
    scenario: ScenarioName = "crowd"
    """A scenario's name (`skytether list scenarios`) or a .toml file; every vehicle flies it."""
    schemes: Annotated[tuple[Scheme, ...], Argument(metavar="SCHEME")] = get_args(Scheme)
    """Schemes to compare: paper (a packet at every step), threshold (the scenario's trigger for
    each vehicle) and budget (the same trigger, with control.shared_bytes_per_s)."""
    vehicles: Annotated[tuple[int, ...], Argument(metavar="N")] = ()
    """Numbers of vehicles to fly; unless given, increasing numbers until they fail, then between
    the largest that flies and the smallest that fails."""
    most: Annotated[int, Argument(metavar="N")] = 256
    """Largest number of vehicles that is tried, unless numbers are given."""
    limit: Annotated[float, Argument(metavar="M")] = 1.0
    """Root mean square error above which vehicles count as failed [m]."""
    udp: bool = False
    """Fly over real UDP on loopback, in real time, instead of virtual time."""
    plugin: command.Plugins = ()
    config: ScenarioFlags = Scenario()


def crowd(argv: Sequence[str]) -> None:
    """Find the largest number of vehicles that can share one network, for each scheme.

    All vehicles share the rates and queues of the scenario's network, one for each direction. A
    number of vehicles flies if none brakes and the error stays within --limit. OUT/crowd.csv has a
    row for each flight, OUT/crowd.png shows error, queueing delay and loss over the number of
    vehicles. All flights are kept: after Ctrl-C the same command continues.
    """
    options = command.parse(CrowdOptions(), argv, "skytether crowd", crowd.__doc__)
    command.check_count("--most", options.most, VEHICLES_MAX)
    for number in options.vehicles:
        command.check_count("--vehicles", number, VEHICLES_MAX)
    if options.udp:
        command.check_sockets("--vehicles", max(options.vehicles, default=options.most))
    if not options.limit > 0:
        raise CommandError(f"--limit: got {options.limit:g}, expected more than 0", 2)
    plan = Crowd(options.scenario, options.config, options.udp)
    for scheme in options.schemes:
        plan.of(scheme)
    command.claim_folder("--out", options.out, "crowd.csv", "crowd.png")
    early: Interrupted | None = None
    with writing(options.out):
        with closing(StudyJournal(options.out, plan.settings(), CrowdPoint)) as journal:
            points = {(each.scheme, each.vehicles): each for each in journal.results.values()}
        try:
            with crew(
                # One after the other over UDP: parallel flights would compete for the processor.
                Flags(1 if options.udp else None),
                f"flying {options.scenario}",
                len(options.schemes),
                "schemes",
            ) as flyers:
                while cells := _missing(options, list(points.values())):
                    left = len({scheme for scheme, _ in cells})
                    flyers.advance(len(options.schemes) - left - flyers.done, _doing(cells))
                    points |= flyers.study(
                        partial(_fly, plan),
                        {cell: cell for cell in cells},
                        CrowdPoint,
                        plan.settings(),
                        options.out,
                        size=lambda _: 0.0,
                        tell=partial(_doing, cells),
                    )
        except Interrupted as interrupted:
            early = interrupted
            points |= interrupted.results
        if points:
            _finish(options, list(points.values()))
    if early:
        raise early


Cell = tuple[Scheme, int]


def _missing(options: CrowdOptions, points: Sequence[CrowdPoint]) -> list[Cell]:
    """Flights to fly next; empty when every scheme's limit is found."""
    cells: list[Cell] = []
    for scheme in options.schemes:
        flown = FlownScheme.of(points, scheme, options.limit)
        numbers = options.vehicles or (flown.next(options.most),)
        flown_numbers = {None, *(point.vehicles for point in flown.points)}
        cells += [(scheme, number) for number in numbers if number and number not in flown_numbers]
    return cells


def _doing(cells: Sequence[Cell], _: object = None) -> str:
    return ", ".join(f"{scheme} {vehicles}" for scheme, vehicles in cells)


def _fly(plan: Crowd, cell: Cell) -> CrowdPoint:
    scheme, vehicles = cell
    scenario = plan.of(scheme)
    if not plan.udp:
        flown = flight.fly(scenario, vehicles=vehicles)
        return judge(scenario, scheme, vehicles, flown.client, flown.figures["netem"])
    with temporary.folder() as parts:
        processes.run(
            scenario,
            parts,
            on_second=lambda _: None,
            interrupted=lambda: (
                False
            ),  # The crew's Ctrl-C ends the worker process, and with it the flight.
            vehicles=vehicles,
            watched=False,
        )
        client = record.read(parts / "client")
        netem = json.loads((parts / "netem.json").read_bytes())
    return judge(scenario, scheme, vehicles, client, netem)


def _finish(options: CrowdOptions, points: Sequence[CrowdPoint]) -> None:
    flown = {scheme: FlownScheme.of(points, scheme, options.limit) for scheme in TITLES}
    where = "over UDP" if options.udp else "in virtual time"
    title = f"{options.scenario}, {where}, seed {options.config.seed}"
    rows = [point for each in flown.values() for point in each.points]
    files.write(options.out / "crowd.csv", points_csv(rows).encode())
    figures.crowd(options.out / "crowd.png", title, flown, options.limit)
    headings = ("scheme", "vehicles", "fly", "RMSE [m]", "worst [m]", "brake or end")
    way = ("up, down [B/s]", "queueing up p50, p99 [ms]", "down", "lost up, down")
    tables.show(title, (*headings, *way), [_cells(point, options.limit) for point in rows])
    for scheme, each in flown.items():
        if each.points:
            beyond = f"{each.too_many} do not" if each.too_many else "no more were tried"
            fly = "vehicle flies" if each.flying == 1 else "vehicles fly"
            print(f"{TITLES[scheme]}: {each.flying} {fly}, {beyond}")
    print(f"{options.out}: crowd.csv, crowd.png")


def _cells(point: CrowdPoint, limit_m: float) -> list[str]:
    p = point
    return [
        p.scheme,
        str(p.vehicles),
        "yes" if p.flies(limit_m) else "no",
        "-" if p.rmse_m is None else f"{p.rmse_m:.3f}",
        "-" if p.rmse_worst_m is None else f"{p.rmse_worst_m:.3f}",
        str(p.braked + p.ended),
        f"{p.up_bytes_per_s:.0f}, {p.down_bytes_per_s:.0f}",
        f"{p.up_queueing_ms_p50:.0f}, {p.up_queueing_ms_p99:.0f}",
        f"{p.down_queueing_ms_p50:.0f}, {p.down_queueing_ms_p99:.0f}",
        f"{p.up_lost:.3f}, {p.down_lost:.3f}",
    ]
