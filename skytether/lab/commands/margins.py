"""`skytether margins`: stability of a scenario's loop, and the vehicles for which it holds."""

from collections import defaultdict
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tyro
from rich.table import Table

from skytether.lab import maps
from skytether.lab import margins as lab
from skytether.lab.commands.pool import Flags, PoolFlags, crew, writing
from skytether.lab.journal import Journal
from skytether.lab.maps import Box, MapPoint
from skytether.lab.margins import Margin
from skytether.shared.base import files, kernel
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shell import command, terminal
from skytether.shell.command import CommandError, ScenarioFlags, ScenarioName

POINTS_MAX = 100_000
"""Most points of a map."""


@dataclass(frozen=True)
class MarginsOptions:
    """Options of `skytether margins`."""

    scenario: ScenarioName = "demo"
    """Name of a scenario (see `skytether scenarios`) or path of a .toml file."""
    runs: Annotated[int, tyro.conf.arg(metavar="N")] = 16
    """Number of flights whose packet timing is used, with seeds that count up from the
    scenario's."""
    json: Path | None = None
    """File for the figures."""
    maps: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder for maps, made by flights: for each vehicle of a box, whether it comes to rest without
    wind. The same command continues with the folder's results."""
    tau: tuple[float, ...] = (0.5, 1.0, 2.0)
    """Time constants of the box, relative to the model's."""
    gain: tuple[float, ...] = (0.7, 1.0, 1.3)
    """Gains of the box, relative to the model's."""
    dead_time: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3)
    """Dead times of the box, minus the model's [s]."""
    burst: tuple[float, ...] = (0.0, 2.0)
    """Mean burst lengths of loss in the box, both ways [s]."""
    pool: PoolFlags = Flags()
    config: ScenarioFlags = Scenario()


def margins(argv: Sequence[str]) -> None:
    """Compute whether a scenario's loop is stable, for its own vehicle and for others.

    While no bound is active, the loop is linear for a given timing of packets. Along the timings of
    some flights, the decay of the mean square after a disturbance is computed:

      growth   of the mean square per step; below 1 the loop is stable in the mean square
      RMS      of the position's deviation, under the scenario's white wind and noise alone
      bound    share of the steps at which an input would exceed its bound: above some percent
               the loop is not linear, and the true RMS is larger

    The server plans with the scenario's model. The first row has the scenario's own vehicle; in the
    other rows the vehicle differs as stated, which shows how wrong the model may be. With a trigger
    that looks at the state the loop is not linear; then a periodic trigger with the same rate is
    used.

    With --maps FOLDER every vehicle of a box is flown as well, without wind: FOLDER/points.csv has
    a row for each, FOLDER/maps.png shows where the flight ends in a limit cycle, and the RMSE. The
    box of 72 vehicles takes some minutes; --tau, --gain, --dead-time and --burst set another.
    """
    options = command.parse(MarginsOptions(), argv, "skytether margins", margins.__doc__)
    command.check_count("--runs", options.runs, 1000)
    options.pool.check()
    scenario = options.config
    if options.maps is not None:
        _box(options, scenario.control.trigger)
        command.claim_folder("--maps", options.maps, "points.csv", "maps.png")
    rates = lab.looks_at_state(scenario)
    rows = {lab.AS_IT_IS: scenario}
    rows |= {name: each.of(scenario) for name, each in lab.VEHICLES.items() if each.is_of(scenario)}
    total = len(rows) + 1 + rates
    terminal.prepare(kernel.missing())
    with (
        command.interruptible() as interrupted,
        terminal.progress("computing margins", total, "parts") as bar,
    ):

        def check(done: int) -> None:
            bar(done)
            if interrupted():
                raise CommandError("interrupted", command.INTERRUPTED)

        if rates:
            scenario = lab.equivalent_period(scenario, stopped=interrupted)
            check(1)
        trigger = scenario.control.trigger
        given = lab.timings(scenario, options.runs, stopped=interrupted)
        check(1 + rates)
        found = []
        for name, each in rows.items():
            alike = msgspec.structs.replace(each, control=scenario.control)
            found.append(lab.margin(alike, name, given))
            check(1 + rates + len(found))
    if options.json is not None:
        content = {"scenario": options.scenario, "trigger": trigger}
        command.write(options.json, msgspec.json.encode(content | {"margins": found}))
    _show(options, scenario, found)
    if options.maps is not None:
        _map(options, options.maps, trigger)


def _box(options: MarginsOptions, trigger: str) -> Box:
    """Box given by the options.

    Raises:
        CommandError: the box is empty, or too large.
        ConfigError: a value is impossible for a vehicle or a network.
    """
    box = Box(
        options.scenario,
        options.config,
        trigger,
        options.tau,
        options.gain,
        options.dead_time,
        options.burst,
    )
    count = len(box.places)
    command.check_count("--tau, --gain, --dead-time and --burst, all in all", count, POINTS_MAX)
    for number in range(count):
        reading.check(reading.to_table(box.scenario_of(number)), options.scenario)
    return box


def _map(options: MarginsOptions, folder: Path, trigger: str) -> None:
    """Fly the missing points of the box; write and print the results of all."""
    box = _box(options, trigger)
    count = len(box.places)
    title = f"flying vehicles like {options.scenario}'s"
    with writing(folder), closing(Journal(folder, box.settings(), MapPoint)) as journal:
        done = {point.number for point in journal.entries}
        with crew(options.pool, title, count, "points") as flyers:
            flyers.advance(len(done))

            def keep(_: int, point: MapPoint) -> None:
                journal.append(point)
                flyers.advance(1)

            flyers.share(box.fly, [number for number in range(count) if number not in done], keep)
        points = sorted(journal.entries, key=lambda point: point.number)
        files.write(folder / "points.csv", box.csv(points).encode())
        title = f"{options.scenario}, without wind, {maps.RUNS} flights a point"
        maps.draw(folder / "maps.png", title, box, points)
    _show_points(title, box, points)
    print(f"{folder}: points.csv, maps.png")


def _show_points(title: str, box: Box, points: Sequence[MapPoint]) -> None:
    """Print a row for each map."""
    groups: dict[tuple[float, float], list[MapPoint]] = defaultdict(list)
    for place, point in zip(box.places, points, strict=True):
        groups[place.burst_s, place.dead_time_s].append(point)
    table = Table(title=title, title_justify="left", min_width=len(title))
    headings = ("bursts [s]", "dead time [s]", "vehicles", "limit cycles", "not stable")
    for heading in (*headings, "RMSE xy, median [m]", "largest [m]", "saturated"):
        table.add_column(heading, justify="right")
    for (burst_s, dead_time_s), group in groups.items():
        rmse = np.array([point.rmse_m or np.nan for point in group])
        saturated = max(point.saturated or 0.0 for point in group)
        table.add_row(
            f"{burst_s:g}",
            f"{dead_time_s:g}",
            str(len(group)),
            str(sum(point.cycles for point in group)),
            str(sum(point.growth >= 1.0 for point in group)),
            f"{np.nanmedian(rmse):.3f}",
            f"{np.nanmax(rmse):.3f}",
            f"{saturated:.1%}",
        )
    terminal.show(table)


def _show(options: MarginsOptions, scenario: Scenario, found: Sequence[Margin]) -> None:
    wind, noises = lab.strengths(scenario)
    strengths = f"white wind {wind:g}"
    if any(noises):
        strengths += f", noise {noises[0]:g} m and {noises[1]:g} m/s"
    title = f"{options.scenario}, {options.runs} timings, {strengths}"
    if scenario.control.trigger != options.config.control.trigger:
        print(
            f"control.trigger: {options.config.control.trigger!r} looks at the state, so that the "
            f"loop is not linear: computed for {scenario.control.trigger!r}, which sends as often"
        )
    table = Table(title=title, title_justify="left", min_width=len(title))
    table.add_column("vehicle")
    table.add_column("growth")
    table.add_column("stable")
    for axis in "xyz"[: scenario.model.axes]:
        table.add_column(f"RMS {axis} [m]", justify="right")
    table.add_column("bound", justify="right")
    for each in found:
        half = "" if each.growth_ci95 is None else f" ± {each.growth_ci95:.4f}"
        rms = ["-"] * scenario.model.axes
        if each.rms_m is not None:
            halves: Sequence[Any] = each.rms_ci95_m or [None] * len(rms)
            rms = [
                f"{value:.4f}" + ("" if around is None else f" ± {around:.4f}")
                for value, around in zip(each.rms_m, halves, strict=True)
            ]
        beyond = each.saturated(scenario.u_max.tolist())
        table.add_row(
            each.vehicle,
            f"{each.growth:.4f}{half}",
            "yes" if each.stable else "no",
            *rms,
            "-" if beyond is None else f"{beyond:.1%}",
        )
    terminal.show(table)
