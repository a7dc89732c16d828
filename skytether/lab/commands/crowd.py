"""`skytether crowd`: number of vehicles that can share one network, scheme by scheme."""

import json
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from skytether.cli import processes
from skytether.lab import figures
from skytether.lab.commands import tables
from skytether.lab.commands.pool import Interrupted, writing
from skytether.lab.crowd import TITLES, Crowd, CrowdPoint, FlownScheme, Scheme, judge, points_csv
from skytether.lab.journal import Journal
from skytether.shared.base import files, kernel
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry import record
from skytether.shell import command, temporary, terminal
from skytether.shell.command import CommandError, ScenarioFlags, ScenarioName
from skytether.shell.terminal import Bar
from skytether.sim import flight

VEHICLES_MAX = 4096
"""Most vehicles of a flight."""


@dataclass(frozen=True)
class CrowdOptions:
    """Options of `skytether crowd`."""

    out: Path = Path("crowd")
    """Folder for the results; the same command continues there."""
    scenario: ScenarioName = "crowd"
    """A scenario's name (see `skytether scenarios`) or a .toml file; every vehicle flies it."""
    schemes: Annotated[tuple[Scheme, ...], tyro.conf.arg(metavar="SCHEME")] = get_args(Scheme)
    """Schemes to compare: paper (a packet at every step), threshold (the scenario's trigger for
    each vehicle) and budget (the same trigger, with control.shared_bytes_per_s)."""
    vehicles: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N")] = ()
    """Numbers of vehicles to fly; unless given, increasing numbers until they fail, then between
    the largest that flies and the smallest that fails."""
    most: Annotated[int, tyro.conf.arg(metavar="N")] = 256
    """Largest number of vehicles that is tried, unless numbers are given."""
    limit: Annotated[float, tyro.conf.arg(metavar="M")] = 1.0
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
    terminal.prepare(kernel.missing())
    with (
        writing(options.out),
        closing(Journal(options.out, plan.settings(), CrowdPoint)) as journal,
    ):
        with (
            command.interruptible() as interrupted,
            terminal.progress(f"flying {options.scenario}", len(options.schemes), "schemes") as bar,
        ):
            done = 0
            for scheme in options.schemes:
                if not _fly_all(
                    options, plan, scheme, journal, partial_bar(bar, done), interrupted
                ):
                    break
                done += 1
        if journal.entries:
            _finish(options, journal.entries)
    if done < len(options.schemes):
        raise Interrupted(done, len(options.schemes), "schemes")


def partial_bar(bar: Bar, done: int) -> Callable[[str], None]:
    """Function that shows a text in a bar at a number of finished schemes."""
    return lambda text: bar(done, text)


def _fly_all(
    options: CrowdOptions,
    plan: Crowd,
    scheme: Scheme,
    journal: Journal[CrowdPoint],
    tell: Callable[[str], None],
    interrupted: Callable[[], bool],
) -> bool:
    """Fly the missing points of a scheme; returns False if interrupted."""
    while True:
        flown = FlownScheme.of(journal.entries, scheme, options.limit)
        known = {point.vehicles for point in flown.points}
        left = [number for number in options.vehicles if number not in known]
        number = next(iter(left), None) if options.vehicles else flown.next(options.most)
        if number is None:
            return True
        point = _fly(plan, scheme, number, tell, interrupted)
        if point is None:
            return False
        journal.append(point)


def _fly(
    plan: Crowd,
    scheme: Scheme,
    vehicles: int,
    tell: Callable[[str], None],
    interrupted: Callable[[], bool],
) -> CrowdPoint | None:
    """Fly a number of vehicles; returns None if interrupted."""
    scenario = plan.of(scheme)

    def on_second(time_s: float) -> None:
        tell(f"{scheme}, {vehicles} vehicles, {min(time_s, scenario.duration):.0f} s")

    on_second(0.0)
    if not plan.udp:
        kernel.load()
        flown = flight.fly(scenario, vehicles=vehicles, on_second=on_second, stopped=interrupted)
        client, netem = flown.client, flown.figures["netem"]
    else:
        with temporary.folder() as parts:
            processes.run(
                scenario,
                parts,
                on_second=on_second,
                interrupted=interrupted,
                vehicles=vehicles,
                watched=False,
            )
            client = record.read(parts / "client")
            netem = json.loads((parts / "netem.json").read_bytes())
    if interrupted():
        return None
    return judge(scenario, scheme, vehicles, client, netem)


def _finish(options: CrowdOptions, points: Sequence[CrowdPoint]) -> None:
    """Write and print the results."""
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
